"""The paper's experiments: settings say what is run, runs are measured, kept and tabulated."""

import csv
import dataclasses
import io

import jax.numpy as jnp
import numpy as np
import pytest
from conftest import POINTS, POSES, QUERIES, STARTS, random_poses, trajectory_energy
from scipy.spatial.transform import Rotation

import tdf_jax as tdf
from tdf_jax._internal.errors import InputError
from tdf_jax.evaluation.metrics import shape_error
from tdf_jax.geometry.grid import distance_from_polyline
from tdf_jax.paper import energy_maps, figures, setting as settings, table
from tdf_jax.paper.runs import Run, imitation
from tdf_jax.paper.setting import Setting
from tdf_jax.paper.store import Store

TINY = Setting(num_poses=POSES, iterations=4, queries=QUERIES, num_starts=STARTS)


@pytest.fixture(scope="module", autouse=True)
def small():
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(settings, "POINTS", POINTS)
        yield


@pytest.fixture(scope="module")
def run(small_model, small):
    return imitation(small_model, TINY)


def made(curve=(1.0, 0.5), found=None, expected=None, **fields):
    """A run of made-up numbers: one start."""
    found = random_poses(0, 4) if found is None else found
    expected = found if expected is None else expected
    values = {
        "reference": found,
        "initial_trajectories": found[None],
        "trajectories": found[None],
        "losses": np.array([curve]),
    }
    values |= {
        "expected": expected,
        "path": expected[:, 4:],
        "descriptor": np.zeros(2),
        "expected_energy": np.array(0.0),
    }
    return Run(**(values | fields))


# ---- settings ----


def test_the_test_mug_is_rotated_by_the_given_angle():
    for turn in (0.0, 60.0, 180.0):
        R = settings.rotation(dataclasses.replace(TINY, turn=turn))
        np.testing.assert_allclose(np.degrees(Rotation.from_matrix(R).magnitude()), turn, atol=1e-6)
    free = [settings.rotation(dataclasses.replace(TINY, turn="any", seed=seed)) for seed in range(40)]
    angles = np.degrees(Rotation.from_matrix(np.stack(free)).magnitude())
    assert 110 < angles.mean() < 142  # uniform rotations: 126 degrees


def test_mugs_have_the_diagonal_asked_for_and_differ():
    for which in (0, 1):
        mug = settings.mug(dataclasses.replace(TINY, diagonal=0.2), which)
        np.testing.assert_allclose(np.linalg.norm(mug.mesh.extents), 0.2, rtol=1e-9)
    shapes = [
        settings.mug(dataclasses.replace(TINY, seed=seed), which).parameters for seed in (0, 1) for which in (0, 1)
    ]
    assert len({shape.top_radius / shape.height for shape in shapes}) == 4


def test_the_demonstration_runs_from_the_handle_to_the_end_that_figure_2_marks():
    scene = settings.scene(dataclasses.replace(TINY, unit=0.5))
    first, last = np.asarray(scene.demonstration.trajectory.translations)[[0, -1]]
    np.testing.assert_allclose(first, settings.mug(TINY, 0).handle_frame[:3, 3], atol=1e-6)
    np.testing.assert_allclose(last - first, (0, 0.415, 0), atol=1e-6)


def test_a_distance_puts_the_first_pose_so_far_from_the_clouds_centre():
    scene = settings.scene(dataclasses.replace(TINY, distance=0.5))
    shown = scene.demonstration
    away = np.asarray(shown.trajectory.translations[0]) - np.asarray(shown.points).mean(axis=0)
    np.testing.assert_allclose(np.linalg.norm(away), 0.5, rtol=1e-5)
    assert away[0] > 0.4  # on the handle's side


def test_a_displaced_end_moves_the_goal_and_a_displaced_start_moves_the_mug(small_model):
    """Everything is relative to the clouds' centres, so the second is the first with the sign reversed."""
    offset = (-0.2, 0.1, 0.3)
    scenes, goals = {}, {}
    for displaced in ("goal", "start"):
        setting = dataclasses.replace(TINY, displacement=offset, displaced=displaced)
        scenes[displaced] = scene = settings.scene(setting)
        field, reference = tdf.encode(small_model, scene.points), tdf.describe(small_model, scene.demonstration)
        goals[displaced] = np.asarray(settings.goal(setting, field, reference))[4:] - np.asarray(field.origin)
    np.testing.assert_allclose(scenes["start"].points - scenes["goal"].points, np.tile(offset, (40, 1)), atol=1e-6)
    np.testing.assert_allclose(goals["goal"] - goals["start"], 2 * np.array(offset), atol=1e-6)


def test_the_weight_k_is_for_the_papers_unit():
    assert dataclasses.replace(TINY, unit=0.25, k=0.02).energy.correlation == 0.08


def test_query_points_are_of_the_kind_and_size_asked_for():
    box = np.asarray(settings.query(dataclasses.replace(TINY, queries=2000)))
    assert 0.095 < np.ptp(box, axis=0).min() <= np.ptp(box, axis=0).max() <= 0.1
    bell = np.asarray(settings.query(dataclasses.replace(TINY, queries=2000, query="gaussian", query_size=0.04)))
    np.testing.assert_allclose(bell.std(axis=0), 0.04, rtol=0.1)


def test_the_optimiser_has_the_numbers_of_the_setting():
    setting = dataclasses.replace(
        TINY, num_starts=3, iterations=7, translation_rate=0.02, start="carried", diagonal=0.2
    )
    expected = tdf.OptimizeConfig(num_starts=3, iterations=7, translation_rate=0.02, start="carried", start_radius=0.2)
    assert setting.optimiser == expected
    energy = dataclasses.replace(
        TINY,
        k=0.1,
        compensator=0.3,
        rotation_scale=0.2,
        pose_norm="metres_radians",
        compensator_order="infinity",
        unit=0.5,
    ).energy
    assert energy == tdf.EnergyWeights(0.2, 0.3, 0.2, "metres_radians", "infinity")


def test_the_test_mug_its_mesh_and_its_handle_lie_where_the_truth_says():
    setting = dataclasses.replace(TINY, displaced="start", displacement=(0.1, 0.2, 0.3))
    scene = settings.scene(setting)
    T, mug = scene.T_world_target, settings.mug(setting, 1)
    np.testing.assert_allclose(T[:3, :3], settings.rotation(setting))
    np.testing.assert_allclose(T[:3, 3], (0.1, 0.2, 0.3))
    np.testing.assert_allclose(scene.T_world_places[1], T @ mug.handle_frame)
    np.testing.assert_allclose(scene.T_world_places[0], settings.mug(setting, 0).handle_frame)
    np.testing.assert_allclose(scene.meshes[1].vertices, mug.mesh.vertices @ T[:3, :3].T + T[:3, 3])
    low, high = mug.mesh.bounds
    canonical = (scene.points - T[:3, 3]) @ T[:3, :3]
    assert (canonical > low - 1e-6).all() and (canonical < high + 1e-6).all()
    np.testing.assert_allclose(np.ptp(canonical, axis=0), high - low, rtol=0.25)


def test_the_correlation_term_may_pull_towards_the_stretched_demonstration(reference):
    same = settings.aim(dataclasses.replace(TINY, displacement=(0.1, 0.0, 0.3)), reference)
    assert same is reference
    for displaced, sign in (("goal", 1), ("start", -1)):
        setting = dataclasses.replace(
            TINY, num_poses=4, displacement=(0.1, 0.0, 0.3), displaced=displaced, correlated="stretched"
        )
        moved = settings.aim(setting, reference)
        steps = np.asarray(moved.trajectory.translations - reference.trajectory.translations)
        np.testing.assert_allclose(steps, sign * np.outer([0, 1 / 3, 2 / 3, 1], (0.1, 0.0, 0.3)), atol=1e-6)
        assert moved.descriptors is reference.descriptors


@pytest.mark.parametrize(
    "changes",
    [
        {"trajectory": "circle"},
        {"displaced": "middle"},
        {"pose_norm": "l1"},
        {"query": "cone"},
        {"start": "here"},
        {"compensator_order": "one"},
        {"num_poses": 1},
        {"num_starts": 0},
        {"seed": -1},
        {"seed": 2**32},
        {"correlated": "both"},
        {"field_energy": "most"},
        {"diagonal": 0.0},
        {"unit": float("inf")},
        {"distance": -1.0},
        {"translation_rate": 0.0},
        {"k": -0.1},
        {"turn": 181.0},
        {"displacement": (0.0, float("nan"), 0.0)},
    ],
)
def test_settings_that_make_no_sense_are_refused(changes):
    (name,) = changes
    with pytest.raises(InputError, match=name):
        dataclasses.replace(TINY, **changes)


# ---- runs ----


def test_a_run_keeps_every_start_and_its_losses(run):
    assert run.initial_trajectories.shape == run.trajectories.shape == (STARTS, POSES, 7)
    assert run.losses.shape == (STARTS, 5)
    assert run.loss == run.losses[:, -1].min()
    assert run.start_loss == run.losses[run.best, 0]
    np.testing.assert_array_equal(run.trajectory, run.trajectories[run.best])
    np.testing.assert_allclose(run.trajectory[-1], run.expected[-1], atol=1e-6)  # the goal, held


def test_a_run_is_the_optimisation_of_its_settings(small_model, run):
    """By hand, from the public functions."""
    scene = settings.scene(TINY)
    reference = tdf.describe(small_model, scene.demonstration)
    field = tdf.encode(small_model, scene.points)
    weights = tdf.EnergyWeights(0.02, 0.0, 0.05)
    energy = trajectory_energy(tdf.Trajectory(jnp.asarray(run.trajectory)), field, reference, weights)
    np.testing.assert_allclose(run.loss, energy, rtol=1e-4)
    alone = tdf.EnergyWeights(0.0)
    descriptor = trajectory_energy(tdf.Trajectory(jnp.asarray(run.expected)), field, reference, alone)
    np.testing.assert_allclose(run.descriptor[1], descriptor, rtol=1e-4)
    energy = trajectory_energy(tdf.Trajectory(jnp.asarray(run.expected)), field, reference, weights)
    np.testing.assert_allclose(run.expected_energy, energy, rtol=1e-4)


@pytest.mark.slow
def test_a_free_last_pose_moves_and_another_seed_is_another_experiment(small_model, run):
    free = imitation(small_model, dataclasses.replace(TINY, fix_last=False))
    np.testing.assert_allclose(free.initial_trajectories[:, -1], run.initial_trajectories[:, -1])
    assert np.abs(free.trajectory[-1] - free.expected[-1]).max() > 1e-3
    other = imitation(small_model, dataclasses.replace(TINY, seed=1))
    assert np.abs(other.initial_trajectories[:, 0] - run.initial_trajectories[:, 0]).max() > 0.01


def test_a_displaced_goal_moves_no_other_pose_unless_the_demonstration_is_stretched(small_model, run):
    """Each pose has terms of its own only, and the last is held: docs/results/paper.md says so."""
    displaced = dataclasses.replace(TINY, displacement=(-0.2, 0.1, 0.3))
    moved = imitation(small_model, displaced)
    np.testing.assert_array_equal(moved.trajectories[:, :-1], run.trajectories[:, :-1])
    np.testing.assert_allclose(moved.trajectories[0, -1, 4:] - run.trajectories[0, -1, 4:], (-0.2, 0.1, 0.3), atol=1e-6)
    stretched = imitation(small_model, dataclasses.replace(displaced, correlated="stretched"))
    assert np.abs(stretched.trajectories[:, 1] - run.trajectories[:, 1]).max() > 1e-4


def test_the_loss_has_settled_when_95_percent_of_its_drop_are_made_for_good():
    assert made([1.0, 0.5, 0.06, 0.2, 0.049, 0.0]).settled == 4
    assert made([1.0, 0.0, 0.0]).settled == 1


def test_errors_are_measured_against_the_true_path():
    found = np.array([[1, 0, 0, 0, 0, 0, 0.0], [1, 0, 0, 0, 1, 0, 0], [1, 0, 0, 0, 3, 0, 0]])
    expected = found.copy()
    expected[0, :4] = Rotation.from_euler("x", 30, degrees=True).as_quat(scalar_first=True)
    expected[0, 4:] = (0.03, 0, 0.04)
    run = made(found=found, expected=expected)
    np.testing.assert_allclose(run.pick_error, (0.05, np.radians(30)), rtol=1e-5)
    np.testing.assert_allclose(run.waypoint_error, (0.05 / 3, np.radians(10)), rtol=1e-5)
    np.testing.assert_allclose(run.longest_step, 2 / 1.5)
    assert not run.flipped
    turned = found.copy()
    turned[0, :4] = Rotation.from_euler("x", 175, degrees=True).as_quat(scalar_first=True)
    assert made(found=turned, expected=found).flipped


def test_the_path_error_sees_the_corners_that_few_poses_cut():
    # a V: its corner at (1, 0)
    path = np.stack([np.linspace(0, 2, 61), np.abs(np.linspace(-1, 1, 61)), np.zeros(61)], axis=1)
    three, two = np.zeros((3, 7)), np.zeros((2, 7))
    three[:, 4:], two[:, 4:] = path[[0, 30, 60]], path[[0, 60]]
    assert made(found=three, path=path).path_error < 1e-12
    np.testing.assert_allclose(made(found=two, path=path).path_error, np.mean(1 - path[:, 1]), rtol=1e-9)
    np.testing.assert_allclose(
        distance_from_polyline(np.array([[-3.0, 4, 0], [1, -2, 0]]), np.array([[0.0, 0, 0], [2, 0, 0]])), [5, 2]
    )


def test_the_shape_error_ignores_where_a_path_lies_but_not_its_mirror_image():
    path = random_poses(4, 6)[:, 4:]
    moved = path @ Rotation.random(random_state=1).as_matrix().T + (1.0, 2.0, 3.0)
    assert shape_error(path, moved) < 1e-7
    assert shape_error(path * (1, 1, -1), moved) > 0.01
    wider = shape_error(1.1 * path, moved)
    np.testing.assert_allclose(
        wider, 0.1 * np.sqrt(np.mean(np.sum((path - path.mean(axis=0)) ** 2, axis=1))), rtol=1e-6
    )


def test_what_was_computed_is_kept(small_model, run, tmp_path, monkeypatch):
    store = Store(small_model, tmp_path)
    first = store.run(TINY)
    for field in dataclasses.fields(Run):
        np.testing.assert_array_equal(getattr(first, field.name), getattr(run, field.name))
    monkeypatch.setattr("tdf_jax.paper.store.imitation", lambda *_: pytest.fail("computed again"))
    again = store.run(TINY)
    for field in dataclasses.fields(Run):
        np.testing.assert_array_equal(getattr(again, field.name), getattr(run, field.name))
    with pytest.raises(pytest.fail.Exception):
        store.run(dataclasses.replace(TINY, k=0.03))
    others = {"params": {"x": np.zeros(3)}, "info": dataclasses.replace(small_model.info, cloud_points=7)}
    for name, value in others.items():
        with pytest.raises(pytest.fail.Exception):
            Store(dataclasses.replace(small_model, **{name: value}), tmp_path).run(TINY)
    (path,) = tmp_path.iterdir()
    path.write_bytes(b"PK cut short")
    with pytest.raises(InputError, match="delete it"):
        store.run(TINY)
    np.savez(path, something=np.zeros(3))
    with pytest.raises(InputError, match="delete it"):
        store.run(TINY)


# ---- table 1 ----


def test_the_table_has_the_papers_nine_rows_over_the_seeds_and_the_variations():
    plan = table.planned(dataclasses.replace(TINY, num_poses=7), 2)
    rows = [settings for group, settings in plan if group == "table 1"]
    assert [(one.trajectory, one.displacement) for one, _ in rows] == list(table.PAPER)
    assert [setting.seed for setting in rows[0]] == [0, 1]
    assert len(plan) == 9 + 3 * len(table.VARIATIONS)
    first = {group: settings[0] for group, settings in reversed(plan)}
    assert [first[f"n = {n}"].num_poses for n in (3, 5, 13, 25)] == [3, 5, 13, 25]
    assert [first[f"k = {k}"].k for k in ("0", "0.002", "0.2")] == [0.0, 0.002, 0.2]
    assert first["last pose free"].fix_last is False and first["nothing"] == dataclasses.replace(
        TINY, num_poses=7, trajectory="line"
    )
    assert first["l_p for l_c, infinity"].energy.compensator_order == "infinity"
    # Every variation but the first changes something, and no two are the same.
    del first["table 1"]
    assert len(set(first.values())) == len(table.VARIATIONS)


def test_rows_are_means_over_seeds():
    found = np.array([[1.0, 0, 0, 0, 0, 0, 0], [1, 0, 0, 0, 1, 0, 0], [1, 0, 0, 0, 3, 0, 0]])
    expected = found.copy()
    expected[0, :4] = Rotation.from_euler("x", 30, degrees=True).as_quat(scalar_first=True)
    expected[0, 4:] = (0.03, 0, 0.04)
    errors = {
        "found": found,
        "expected": expected,
        "descriptor": np.array([0.1, 0.3]),
        "expected_energy": np.array(0.4),
    }
    runs = iter([made((1.0, 0.02), **errors), made((3.0, 0.04), **errors)])
    setting = dataclasses.replace(TINY, trajectory="line", displacement=(0.0, 0.0, 0.4))
    (row,) = table.rows(lambda _: next(runs), [("table 1", [setting, setting])])
    numbers = row.numbers()
    known = {
        "pick_cm": 5,
        "pick_degrees": 30,
        "waypoint_cm": 5 / 3,
        "waypoint_degrees": 10,
        "settled": 1,
        "longest_step": 4 / 3,
        "flips": 0,
    }
    known |= {
        "descriptor_loss": 0.1,
        "true_descriptor_loss": 0.3,
        "true_loss": 0.4,
        "path_cm": 100 * row.runs[0].path_error,
    }
    known |= {"shape_cm": 100 * row.runs[0].shape_error, "seeds": 2}
    for name, value in known.items():
        np.testing.assert_allclose(numbers[name], value, rtol=1e-5, err_msg=name)
    assert 0.1 < numbers["path_cm"] < numbers["shape_cm"] < 5
    started = dataclasses.replace(setting, displaced="start")
    assert table.Row("table 1", started, row.runs).numbers()["paper_loss"] is None
    assert numbers["paper_loss"] == 0.011077
    np.testing.assert_allclose((numbers["loss"], numbers["start_loss"]), (0.03, 2.0))
    np.testing.assert_allclose(numbers["loss_spread"], np.std([0.02, 0.04], ddof=1))


def test_tables_show_the_papers_numbers_beside_ours_and_every_variation():
    plan = table.planned(dataclasses.replace(TINY, num_poses=3), 1, ("k = 0", "n = 3"))
    rows = table.rows(lambda setting: made((1.0, 0.001 * setting.num_poses)), plan)
    lines = table.as_markdown(rows).splitlines()
    assert sum(line.startswith(("| line", "| semicircle", "| wave")) for line in lines) == 9
    assert "| line | (0, 0, 0) | 0.0068 | 0.0030 |" in "\n".join(lines)
    assert [line.split(" | ")[0] for line in lines[-2:]] == ["| k = 0", "| n = 3"]
    assert "0.0030, 0.0030, 0.0030" in lines[-1]
    read = list(csv.DictReader(io.StringIO(table.as_csv(rows))))
    assert len(read) == len(plan) and set(read[0]) == set(table.COLUMNS)
    assert read[1]["displacement"] == "0 0 0.4" and read[1]["paper_loss"] == "0.011077"
    assert read[-1]["paper_loss"] == "" and float(read[-1]["loss"]) == 0.003


# ---- figures ----


def test_figures_ask_for_what_the_paper_shows():
    first = figures.figure1(TINY)
    assert (first["l_t"].k, first["l_t + l_c"].k) == (0.0, 0.02) and first["l_t"].seed == first["l_t + l_c"].seed
    assert set(figures.figure4(TINY)) == {
        (s, d) for s in ("line", "semicircle", "wave") for d in ((0, 0, 0), (-0.2, 0.1, 0.3))
    }
    assert {setting.trajectory for setting in figures.figure5(TINY).values()} == {"line", "semicircle", "wave"}
    third = figures.figure3(TINY)
    assert set(figures.PAPER_DISTANCES) < {setting.distance for setting in third.values()}
    assert not first["l_t"].fix_last and not first["l_t + l_c"].fix_last
    assert figures.collected(lambda setting: setting.k, first) == {"l_t": 0.0, "l_t + l_c": 0.02}


def test_figure_3_averages_over_seeds():
    runs = {(k, d, seed): made((1.0, k + d + seed)) for k in (0.0, 1.0) for d in (0.5, 2.0) for seed in (0, 1)}
    found = figures.mean_over_seeds(runs, lambda run: run.loss)
    assert found == {0.0: {0.5: 1.0, 2.0: 2.5}, 1.0: {0.5: 2.0, 2.0: 3.5}}


def test_the_turn_along_a_path_is_the_angle_from_the_demonstration():
    angles = np.array([60.0, 20.0, 0.0])
    path = np.zeros((3, 7))
    path[:, :4] = Rotation.from_euler("z", angles[:, None], degrees=True).as_quat(scalar_first=True)
    still = np.tile([1.0, 0, 0, 0, 0, 0, 0], (3, 1))
    np.testing.assert_allclose(figures.turned(path, still), angles, atol=1e-4)


def test_landscapes_are_of_the_named_mug_with_the_demonstrations_orientation(small_model):
    """On its own mug, the demonstration's waypoints are the minimisers, to the pitch of the grid."""
    base = dataclasses.replace(TINY, queries=4, seed=2)
    own = energy_maps.figure2(small_model, base, "reference mug", 25)
    assert set(own) == {"line", "semicircle", "wave"}
    for panel in own.values():
        assert panel.energies.shape == (25, 25)
        np.testing.assert_allclose(panel.x, np.linspace(-1.2, 1.2, 25))
        np.testing.assert_allclose(panel.path[[0, -1]], [(0, 0), (0, 0.83)], atol=1e-6)
    line = own["line"]
    assert line.energies[12, 12] < 1e-6  # the first waypoint is a point of the grid
    np.testing.assert_allclose(line.minimisers[0], 0, atol=1e-9)
    np.testing.assert_allclose(line.carried, line.path)
    others = {name: energy_maps.figure2(small_model, base, name, 5)["wave"] for name in energy_maps.FIELDS}
    turned = others["reference mug, rotated"]
    flat = [panel.path - panel.outline.mean(axis=0) for panel in (own["wave"], turned)]
    R = Rotation.from_euler("z", 60, degrees=True).as_matrix()[:2, :2]
    np.testing.assert_allclose(turned.carried - turned.outline.mean(axis=0), flat[0] @ R.T, atol=1e-5)
    np.testing.assert_allclose(
        turned.outline - turned.outline.mean(axis=0),
        (own["wave"].outline - own["wave"].outline.mean(axis=0)) @ R.T,
        atol=1e-5,
    )
    mean = energy_maps.figure2(small_model, dataclasses.replace(base, field_energy="mean"), "reference mug", 5)["wave"]
    assert (mean.energies > others["reference mug"].energies).all()
    outlines = [panel.outline for panel in others.values()]
    assert all(np.abs(a - b).max() > 0.01 for i, a in enumerate(outlines) for b in outlines[:i])


def test_kept_landscapes_are_read_again(small_model, tmp_path, monkeypatch):
    store = Store(small_model, tmp_path)
    first = store.landscapes(TINY, "test mug", 4)
    monkeypatch.setattr("tdf_jax.paper.store.figure2", lambda *_: pytest.fail("computed again"))
    again = store.landscapes(TINY, "test mug", 4)
    for name, panel in first.items():
        for field in dataclasses.fields(panel):
            np.testing.assert_array_equal(getattr(panel, field.name), getattr(again[name], field.name))
