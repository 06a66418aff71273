"""Names of the release before: accepted with a warning, and equal in what they do."""

import contextlib
import dataclasses
import json

import jax
import numpy as np
import pytest

import tdf_jax as tdf
from tdf_jax._internal.errors import InputError
from tdf_jax.geometry import se3
from tdf_jax.landscape.storage import Landscape, load_landscape, save_landscape
from tdf_jax.paper.setting import Setting
from tdf_jax.solvers.result import Result
from tdf_jax.training import run_folder
from tdf_jax.training.config import TrainConfig

PATHS = ["line", "semicircle", "wave", "lift_over", "tilt_and_pour", "hang_on_rack"]


@pytest.mark.parametrize("name", PATHS)
def test_paths_take_poses(name):
    path = getattr(tdf, name)
    with pytest.warns(DeprecationWarning, match=rf"^{name}\(poses=...\) is deprecated; use num_poses=$"):
        old = path(poses=4)
    np.testing.assert_array_equal(old.wxyz_xyz, path(num_poses=4).wxyz_xyz)


def test_resample_takes_poses():
    with pytest.warns(DeprecationWarning, match=r"^resample\(poses=...\) is deprecated; use num_poses=$"):
        old = tdf.resample(tdf.line(), poses=4)
    np.testing.assert_array_equal(old.wxyz_xyz, tdf.resample(tdf.line(), num_poses=4).wxyz_xyz)


def test_both_names_at_once_are_refused():
    with pytest.raises(InputError, match=r"^line\(\): got num_poses and poses, its former name; expected num_poses$"):
        tdf.line(poses=4, num_poses=4)


def test_a_trajectory_has_poses():
    with pytest.warns(DeprecationWarning, match=r"^Trajectory.poses is deprecated; use Trajectory.num_poses$"):
        assert tdf.line(5).poses == 5


@pytest.mark.parametrize(
    ("config", "old", "new"),
    [
        (tdf.OptimizeConfig, {"inits": 3, "chunk": 2}, {"num_starts": 3, "chunk_poses": 2}),
        (
            tdf.SolveConfig,
            {"inits": 3, "scouts": 5, "points": 8, "finalists": 1, "chunk": 64},
            {
                "num_trajectory_starts": 3,
                "num_starts": 5,
                "num_coarse_queries": 8,
                "num_candidates": 1,
                "chunk_queries": 64,
            },
        ),
        (
            tdf.CarryConfig,
            {"scouts": 5, "points": 8, "finalists": 2, "chunk": 64},
            {"num_starts": 5, "num_coarse_queries": 8, "num_candidates": 2, "chunk_queries": 64},
        ),
        (tdf.EnergyWeights, {"lever": 0.1}, {"rotation_scale": 0.1}),
    ],
)
def test_settings_take_their_former_names(config, old, new):
    with pytest.warns(DeprecationWarning) as warned:
        made = config(**old)
    assert made == config(**new)
    assert {str(one.message) for one in warned} == {
        f"{config.__name__}({name}=...) is deprecated; use {now}=" for name, now in zip(old, new)
    }
    for name, value in old.items():
        with pytest.warns(DeprecationWarning, match=rf"{config.__name__}.{name} is deprecated"):
            assert getattr(made, name) == value


def test_steps_by_position_become_stages_by_name():
    with pytest.warns(DeprecationWarning, match="use coarse_steps=, prune_steps=, search_steps=, propagate_steps="):
        solver = tdf.SolveConfig(steps=(1, 2, 3, 4, 5, 6))
    assert (solver.coarse_steps, solver.search_steps, solver.polish_steps, solver.num_steps) == (1, 3, 6, 21)
    with pytest.warns(DeprecationWarning):
        assert solver.steps == (1, 2, 3, 4, 5, 6)
    with pytest.warns(DeprecationWarning):
        assert tdf.CarryConfig(steps=(1, 2, 3, 4)) == tdf.CarryConfig(
            coarse_steps=1, prune_steps=2, refine_steps=3, polish_steps=4
        )
    with pytest.raises(InputError, match=r"CarryConfig\(\): steps is \(1, 2\); expected coarse_steps, prune_steps"):
        tdf.CarryConfig(steps=(1, 2))


def test_a_result_has_losses_and_starts():
    parts = {
        "trajectories": np.zeros((1, 2, 7)),
        "energies": np.zeros(1),
        "candidate_history": np.ones((1, 3)),
        "initial_trajectories": np.full((4, 2, 7), 2.0),
        "history": np.zeros((4, 3)),
    }
    result = Result(**parts)
    for old, new in (("losses", "candidate_history"), ("starts", "initial_trajectories")):
        with pytest.warns(DeprecationWarning, match=f"Result.{old} is deprecated; use Result.{new}"):
            assert getattr(result, old) is parts[new]


def test_a_device_mesh_may_be_called_mesh(field, reference):
    """Every function that takes one: what is no mesh is refused under the new name, so the old one was taken."""
    key = jax.random.key(0)
    for function, arguments in (
        (tdf.optimize, (field, reference, key)),
        (tdf.solve, (field, reference, key)),
        (tdf.carry, (field, reference, key)),
        (tdf.energy_landscape, (field, reference, tdf.plane_grid(0.1, 3))),
    ):
        with (
            pytest.warns(DeprecationWarning, match=r"\(mesh=...\) is deprecated; use device_mesh="),
            pytest.raises(InputError, match="device_mesh is 3; expected a jax.sharding.Mesh"),
        ):
            function(*arguments, mesh=3)


def test_the_correlation_loss_takes_a_lever(field, reference):
    trajectory = reference.trajectory.shifted(field.origin)
    with pytest.warns(DeprecationWarning, match="use rotation_scale="):
        old = tdf.correlation_loss(trajectory, field.origin, reference, lever=0.3)
    np.testing.assert_array_equal(old, tdf.correlation_loss(trajectory, field.origin, reference, rotation_scale=0.3))


def test_the_module_of_poses_is_still_there():
    with pytest.warns(
        DeprecationWarning, match="tdf_jax.poses is deprecated; use tdf_jax.turns and tdf_jax.rotation_grid"
    ):
        assert tdf.poses is se3
    with pytest.raises(AttributeError, match="has no attribute 'nothing'"):
        _ = tdf.nothing


def test_warnings_point_to_the_callers_line(small_model, demonstration):
    """There, and not in the library's files, Python shows them by default."""
    cloud = demonstration.points
    calls = (
        lambda: tdf.line(poses=4),
        lambda: tdf.CarryConfig(scouts=3),
        lambda: tdf.line(5).poses,
        lambda: dataclasses.replace(tdf.OptimizeConfig(), inits=2),
        lambda: tdf.poses,
        lambda: tdf.imitate(small_model, demonstration, cloud, key=jax.random.key(0), mesh=3),
        lambda: tdf.imitate_batch(small_model, demonstration, [cloud], key=jax.random.key(0), mesh=3),
    )
    for call in calls:
        with pytest.warns(DeprecationWarning) as warned, contextlib.suppress(InputError):
            call()
        assert [one.filename for one in warned] == [__file__]


def test_replace_takes_former_names_too():
    """It goes through the constructor, which gets the current value under the new name as well."""
    assert dataclasses.replace(tdf.OptimizeConfig(), num_starts=2).num_starts == 2
    with pytest.warns(DeprecationWarning, match="use num_starts="):
        assert dataclasses.replace(tdf.OptimizeConfig(), inits=2).num_starts == 2
    with pytest.warns(DeprecationWarning, match="use coarse_steps="):
        assert dataclasses.replace(tdf.CarryConfig(), steps=(1, 2, 3, 4)).polish_steps == 4


def test_clearance_takes_lever_and_has_least():
    with pytest.warns(DeprecationWarning, match=r"^ClearanceConfig\(lever=...\) is deprecated; use rotation_scale=$"):
        config = tdf.ClearanceConfig(lever=0.2)
    with pytest.warns(DeprecationWarning, match=r"^ClearanceConfig.lever is deprecated; use ClearanceConfig.rotation_"):
        assert config.lever == config.rotation_scale == 0.2
    found = tdf.clearance(tdf.line(2), np.zeros((1, 3)), [tdf.box_obstacle((0.5, 0, 0), (0.2, 1, 1))], between=0)
    with pytest.warns(DeprecationWarning, match=r"^Clearance.least is deprecated; use Clearance.min$"):
        assert found.least == found.min == pytest.approx(0.4)


def test_a_network_takes_asymmetry():
    with pytest.warns(
        DeprecationWarning, match=r"^NetworkConfig\(asymmetry=...\) is deprecated; use symmetry_breaking_offset=$"
    ):
        config = tdf.NetworkConfig(asymmetry=0.1)
    with pytest.warns(DeprecationWarning, match=r"^NetworkConfig.asymmetry is deprecated; use NetworkConfig.symmetry_"):
        assert config.asymmetry == config.symmetry_breaking_offset == 0.1


def test_encode_takes_thinnings(small_model):
    cloud = np.random.default_rng(0).normal(size=(30, 3)).astype(np.float32)
    with pytest.warns(DeprecationWarning, match=r"^encode\(thinnings=...\) is deprecated; use num_subsamples=$"):
        old = tdf.encode(small_model, cloud, thinnings=0)
    np.testing.assert_array_equal(old.latent, tdf.encode(small_model, cloud, num_subsamples=0).latent)


def test_training_takes_poses():
    with pytest.warns(DeprecationWarning, match=r"^TrainConfig\(poses=...\) is deprecated; use num_poses=$"):
        config = TrainConfig(poses=5)
    with pytest.warns(DeprecationWarning, match=r"^TrainConfig.poses is deprecated; use TrainConfig.num_poses$"):
        assert config.poses == config.num_poses == 5


def test_a_run_of_the_release_before_is_resumed(tmp_path):
    """Its settings have former names, in the run's part and in the network's."""
    settings = dataclasses.asdict(TrainConfig())
    former = settings | {"poses": settings["num_poses"], "network": dict(settings["network"])}
    former["network"]["asymmetry"] = former["network"].pop("symmetry_breaking_offset")
    del former["num_poses"]
    (tmp_path / run_folder.CONFIG).write_text(json.dumps(former))
    run_folder.claim(tmp_path, settings)
    assert run_folder.settings_of(tmp_path) == json.loads((tmp_path / run_folder.CONFIG).read_text()) == settings


def test_a_shape_has_clay():
    mug = tdf.build_mug()
    with pytest.warns(DeprecationWarning, match=r"^Mug.clay is deprecated; use Mug.solid$"):
        assert mug.clay is mug.solid


def test_a_setting_of_the_paper_takes_the_former_energy():
    with pytest.warns(
        DeprecationWarning, match=r"^Setting\(field_energy='least'\) is deprecated; use field_energy='min'$"
    ):
        assert Setting(**{"field_energy": "least"}) == Setting(field_energy="min")


@pytest.mark.parametrize(("old", "new"), [("least", "min"), ("soft_least", "softmin")])
def test_landscapes_take_the_former_reductions(field, reference, tmp_path, old, new):
    parts = (tdf.plane_grid(1.0, 2), np.ones((1, 2, 2)), np.zeros((1, 3)), np.eye(3)[None], np.zeros((1, 2, 2), int))
    with pytest.warns(
        DeprecationWarning, match=rf"^Landscape\(reduce='{old}'\) is deprecated; use reduce='{new}'$"
    ) as w:
        assert Landscape(*parts, reduce=old).reduce == new
    assert w[0].filename == __file__
    with pytest.warns(DeprecationWarning, match=rf"^energy_landscape\(reduce='{old}'\) is deprecated; use") as w:
        landscape = tdf.energy_landscape(field, reference, tdf.plane_grid(0.1, 2), reduce=old)
    assert [one.filename for one in w] == [__file__]
    assert landscape.reduce == new
    # Files of the release before have the former choice; they are read without a warning.
    save_landscape(tmp_path / "new.npz", landscape)
    with np.load(tmp_path / "new.npz") as file:
        arrays = dict(file)
    header = str(arrays.pop("header")).replace(f'"reduce": "{new}"', f'"reduce": "{old}"')
    header = header.replace('"format": 2', '"format": 1')
    assert '"format": 1' in header
    assert old in header
    np.savez(tmp_path / "old.npz", header=np.array(header), **arrays)
    again, _ = load_landscape(tmp_path / "old.npz")
    assert again.reduce == new
    np.testing.assert_array_equal(again.combined, landscape.combined)
