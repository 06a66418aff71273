"""The whole way in one call: one target and many, goals, several demonstrations, bad input."""

import dataclasses

import jax
import numpy as np
import pytest
from conftest import CARRY, compilations, random_cloud, random_poses

import tdf_jax as tdf
from tdf_jax._internal.errors import InputError
from tdf_jax.geometry.sampling import thin
from tdf_jax.networks.field import stacked, stacked_axes, with_decoder_of

CONFIG = tdf.OptimizeConfig(num_starts=3, iterations=5)
KEY = jax.random.key(0)
TARGET = random_cloud(3).astype(np.float32)


def assert_equal(found, expected):
    for a, b in zip(jax.tree.leaves(found), jax.tree.leaves(expected), strict=True):
        np.testing.assert_array_equal(a, b)


@pytest.fixture(scope="module")
def imitate(small_model):
    def call(demonstration, points=TARGET, key=KEY, **settings):
        return tdf.imitate(small_model, demonstration, points, key=key, **{"config": CONFIG} | settings)

    return call


@pytest.fixture(scope="module")
def result(imitate, demonstration):
    return imitate(demonstration)


def test_it_is_describe_encode_optimize(result, field, reference):
    assert_equal(result, tdf.optimize(field, reference, KEY, config=CONFIG))
    assert isinstance(result.trajectory, tdf.Trajectory) and result.trajectory.num_poses == 4
    assert result.candidate_history.shape == (3, 5)


def test_a_reference_can_be_shared_between_calls(imitate, demonstration, result, reference):
    assert_equal(imitate(reference), result)
    assert_equal(imitate([demonstration]), result)


def test_several_views_are_merged(imitate, reference, result):
    assert_equal(imitate(reference, points=[TARGET[:15], TARGET[15:]]), result)
    with pytest.raises(InputError, match=r"imitate\(\): points\[1\] has shape \(5, 2\)"):
        imitate(reference, points=[TARGET, TARGET[:5, :2]])


@pytest.mark.parametrize("config", [CONFIG, CARRY])
def test_foreign_points_are_counted_and_change_nothing_else(imitate, reference, config):
    points = np.insert(TARGET, 7, [0.2, 3.0, -0.1], axis=0)
    found, expected = imitate(reference, points, config=config), imitate(reference, config=config)
    assert (found.foreign_points, expected.foreign_points) == (1, 0)
    assert_equal(dataclasses.replace(found, foreign_points=expected.foreign_points), expected)
    left = imitate(reference, points, config=config, clean=False)
    assert left.foreign_points == 0 and np.abs(left.pick - expected.pick).max() > 1e-3


def test_several_demonstrations(imitate, small_model, demonstration, result):
    other = dataclasses.replace(demonstration, points=random_cloud(7).astype(np.float32))
    both = imitate([demonstration, other])
    assert_equal(both, imitate(tdf.describe(small_model, [demonstration, other])))
    assert_equal(both.initial_trajectories, result.initial_trajectories)  # the first one's trajectory
    assert np.abs(both.candidate_history - result.candidate_history).min() > 1e-6


def test_the_goal_is_the_demonstrations_carried_by_the_centroids(result, demonstration):
    expected = np.array(demonstration.trajectory.wxyz_xyz[-1], np.float64)
    expected[4:] += random_cloud(3).mean(axis=0) - random_cloud(0).mean(axis=0)
    np.testing.assert_allclose(result.trajectory.wxyz_xyz[-1], expected, atol=1e-6)


def test_goal_and_offset(imitate, reference, result):
    goal, offset = random_poses(9, 1)[0].astype(np.float32), (-0.2, 0.1, 0.3)
    np.testing.assert_array_equal(imitate(reference, goal=goal).trajectories[:, -1], np.tile(goal, (3, 1)))
    shifted = np.array(result.trajectory.wxyz_xyz[-1]) + np.pad(np.float32(offset), (4, 0))
    np.testing.assert_allclose(imitate(reference, goal_offset=offset).trajectory.wxyz_xyz[-1], shifted, atol=1e-7)
    both = imitate(reference, goal=goal, goal_offset=np.array(offset))
    np.testing.assert_allclose(both.trajectory.wxyz_xyz[-1], goal + np.pad(np.float32(offset), (4, 0)), atol=1e-7)
    whole = imitate(reference, goal=[1, 0, 0, 0, 0, 0, 1])  # whole numbers
    np.testing.assert_array_equal(whole.trajectory.wxyz_xyz[-1], [1, 0, 0, 0, 0, 0, 1])


def test_dense_clouds_are_thinned_to_the_networks_density(small_model, reference, result):
    dense = np.concatenate([TARGET, TARGET + np.float32(1e-3)])
    model = dataclasses.replace(small_model, info=tdf.ModelInfo("small", "random numbers", cloud_points=40))
    found = tdf.imitate(model, reference, dense, key=KEY, config=CONFIG)
    expected = tdf.imitate(small_model, reference, thin(dense, 40), key=KEY, config=CONFIG)
    np.testing.assert_allclose(found.energies, expected.energies, rtol=1e-4)
    np.testing.assert_allclose(found.trajectories, expected.trajectories, atol=1e-4)


def test_a_batch_is_every_target_with_a_key_of_its_own(small_model, imitate, demonstration, reference, result):
    clouds = [random_cloud(seed).astype(np.float32) for seed in (3, 20, 21)]
    with compilations() as compiled:
        results = tdf.imitate_batch(small_model, demonstration, iter(clouds), key=KEY, config=CONFIG)
    assert not {"jit(_run)", "jit(_encode)", "jit(_begin)"} & set(compiled)  # one program, compiled for `result`
    assert len(results) == 3
    for index, (found, cloud) in enumerate(zip(results, clouds, strict=True)):
        assert_equal(found, imitate(reference, cloud, key=jax.random.fold_in(KEY, index)))


@pytest.mark.parametrize("options", [{}, {"goal_offset": (0, 0, 0.1)}, {"fix_last": False}])
def test_objects_together_are_objects_alone(small_model, demonstration, options):
    """Clouds of three sizes, in two chunks of one program, whose second one is not full; with an approach."""
    longer = dataclasses.replace(demonstration, grasp=1)
    reference = tdf.describe(small_model, longer)
    clouds = [random_cloud(seed, 40 + 5 * seed).astype(np.float32) for seed in (3, 5, 4)]
    alone = tdf.imitate_batch(small_model, reference, clouds, key=KEY, config=CARRY, **options)
    with compilations() as compiled:
        together = tdf.imitate_batch(small_model, reference, clouds, key=KEY, chunk_targets=2, config=CARRY, **options)
    assert compiled.count("jit(_carried)") <= 1  # none, if an earlier test has compiled it
    for found, expected in zip(together, alone, strict=True):
        assert (found.grasp, found.release, found.best) == (expected.grasp, expected.release, expected.best)
        for field in dataclasses.fields(found):
            one, other = (np.asarray(getattr(result, field.name)) for result in (found, expected))
            assert one.shape == other.shape
            np.testing.assert_allclose(one, other, rtol=1e-3, atol=1e-4, err_msg=field.name)


def test_the_decoder_is_shared_by_the_fields_of_a_chunk(small_model, field):
    other = tdf.encode(small_model, random_cloud(8).astype(np.float32))
    shared = with_decoder_of(other, field)
    assert shared.conditioned.blocks is field.conditioned.blocks
    x = random_cloud(1)[:5].astype(np.float32)
    np.testing.assert_array_equal(shared.descriptors(x), other.descriptors(x))
    both = stacked([field, shared])
    assert both.conditioned.blocks is field.conditioned.blocks
    found = jax.vmap(lambda one: one.descriptors(x), in_axes=(stacked_axes(both),))(both)
    np.testing.assert_allclose(found[0], field.descriptors(x), atol=1e-6)
    np.testing.assert_allclose(found[1], other.descriptors(x), atol=1e-6)


@pytest.mark.parametrize("chunk", [1, 2])
def test_what_is_about_one_object_names_it(small_model, reference, chunk):
    sized = dataclasses.replace(
        small_model, info=dataclasses.replace(small_model.info, smallest_diagonal=0.1, largest_diagonal=0.5)
    )
    clouds = [TARGET, TARGET * np.float32(100)]
    settings = {"key": KEY, "config": CARRY, "chunk_targets": chunk, "clean": False}
    with pytest.warns(tdf.SizeWarning, match=r"^imitate_batch\(\): object 1: encode\(\): the bounding box") as caught:
        tdf.imitate_batch(sized, reference, clouds, **settings)
    assert len(caught) == 1 and caught[0].filename == __file__
    with pytest.raises(InputError, match=r"^imitate_batch\(\): object 1: .*20 points; expected at least 21"):
        tdf.imitate_batch(small_model, reference, [TARGET, TARGET[:20]], **settings)


def test_what_one_program_cannot_do_is_refused(small_model, reference):
    for settings, words in (
        ({"config": tdf.SolveConfig()}, "not that of a CarryConfig"),
        ({"progress": print}, "there is a progress"),
        ({"fix_last": False, "goal_offset": (0, 0, 1)}, "does not keep it"),
        ({"chunk_targets": 0}, "chunk_targets is 0"),
    ):
        with pytest.raises(InputError, match=words):
            tdf.imitate_batch(small_model, reference, [TARGET], **{"key": KEY, "chunk_targets": 2} | settings)
    with pytest.raises(TypeError, match="goals"):
        tdf.imitate_batch(small_model, reference, [TARGET], key=KEY, chunk_targets=2, goals=None)


def test_a_batch_shares_its_settings(small_model, reference):
    results = tdf.imitate_batch(small_model, reference, [TARGET] * 2, key=KEY, config=CONFIG, goal_offset=(0, 0, 1))
    np.testing.assert_allclose(results[0].trajectory.wxyz_xyz[-1], results[1].trajectory.wxyz_xyz[-1])
    assert np.abs(results[0].initial_trajectories - results[1].initial_trajectories).max() > 0.01


def test_progress_is_passed_on(imitate, reference):
    calls = []
    imitate(reference, progress=lambda done, energies: calls.append((done, energies.shape)))
    assert calls == [(5, (3,))]


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"points": TARGET[:20]}, "20 points; expected at least 21"),
        ({"points": TARGET * np.float32(np.nan)}, "NaN or infinite"),
        ({"points": np.zeros((40, 3))}, "all equal"),
        ({"points": TARGET[:, :2]}, "shape"),
        ({"goal": np.zeros(6)}, r"goal has shape \(6,\); expected one pose wxyz_xyz, \(7,\)"),
        ({"goal": np.full(7, np.inf)}, "goal is .*expected one finite pose"),
        ({"goal": np.zeros(7)}, "a quaternion of norm 0"),
        ({"goal_offset": (0, 1)}, r"goal_offset is \(0, 1\); expected three finite numbers"),
        ({"goal_offset": (0, 1, np.nan)}, "goal_offset is .*expected three finite"),
        ({"config": 100}, "config is 100; expected a CarryConfig, SolveConfig or OptimizeConfig"),
        ({"energy": 0.02}, "energy is 0.02; expected EnergyWeights"),
        ({"energy": 0.02, "config": tdf.SolveConfig()}, r"solve\(\): energy is 0.02; expected EnergyWeights"),
        ({"device_mesh": jax.devices()}, "device_mesh is .*expected a jax.sharding.Mesh"),
    ],
)
def test_bad_input_is_refused(imitate, reference, settings, message):
    with pytest.raises(InputError, match=message):
        imitate(reference, **settings)


@pytest.mark.slow
@pytest.mark.parametrize("starts", [3, pytest.param(1, marks=pytest.mark.slow)])
@pytest.mark.parametrize("config", [CONFIG, CARRY.solver])
def test_a_demonstration_of_one_pose_is_found_where_it_is_free(imitate, demonstration, config, starts):
    one = dataclasses.replace(demonstration, trajectory=tdf.Trajectory(demonstration.trajectory.wxyz_xyz[:1]))
    counts = {"num_starts": starts} if config is CONFIG else {"num_trajectory_starts": starts}
    result = imitate(one, fix_last=False, config=dataclasses.replace(config, **counts))
    assert result.trajectory.num_poses == 1 and np.isfinite(result.energies).all()
    with pytest.raises(InputError, match="one pose and fix_last keeps it; expected fix_last=False"):
        imitate(one, config=config)


def test_what_is_no_demonstration_is_refused(small_model):
    for call in (tdf.imitate, tdf.imitate_batch):
        with pytest.raises(InputError, match="expected one or more of tdf.Demonstration"):
            call(small_model, tdf.wave(), [TARGET], key=KEY)


def test_no_clouds_are_refused(small_model, reference):
    with pytest.raises(InputError, match=r"imitate_batch\(\): there are no clouds"):
        tdf.imitate_batch(small_model, reference, [], key=KEY)


def test_one_cloud_is_no_batch(small_model, reference):
    with pytest.raises(InputError, match="shape"):
        tdf.imitate_batch(small_model, reference, TARGET, key=KEY)
