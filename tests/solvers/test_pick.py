"""The demonstration carried by both of its ends, and the pick it is carried from."""

import dataclasses
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import CARRY, composed, random_cloud, random_poses, trajectory_energy
from scipy.spatial.transform import Rotation

import tdf_jax as tdf
from tdf_jax._internal.errors import InputError

KEY = jax.random.key(0)
CONFIG = CARRY


def motion_of(new, old):
    """The motion (R, t) that takes an old pose to a new one, by scipy."""
    turns = [Rotation.from_quat(np.array(pose[:4], float), scalar_first=True) for pose in (new, old)]
    turn = turns[0] * turns[1].inv()
    return turn, np.array(new[4:], float) - turn.apply(np.array(old[4:], float))


@pytest.fixture(scope="module")
def shown():
    return tdf.Trajectory(jnp.asarray(random_poses(5, 6), jnp.float32))


@pytest.fixture(scope="module")
def ends():
    return jnp.asarray(random_poses(6, 2, reach=0.5), jnp.float32)


# ---- carrying ----


def test_each_waypoint_is_moved_by_what_lies_between_the_motions_of_the_ends(shown, ends):
    """By scipy: rotations on the geodesic between both motions, translations on the line between their results."""
    found = tdf.carry_trajectory(shown, *ends)
    (turn_a, move_a), (turn_g, move_g) = motion_of(ends[0], shown.wxyz_xyz[0]), motion_of(ends[1], shown.wxyz_xyz[-1])
    between = (turn_a.inv() * turn_g).as_rotvec()
    for i, (wxyz_xyz, pose) in enumerate(zip(np.array(found.wxyz_xyz, float), np.array(shown.wxyz_xyz, float))):
        s = i / 5
        turn = turn_a * Rotation.from_rotvec(s * between) * Rotation.from_quat(pose[:4], scalar_first=True)
        assert (turn.inv() * Rotation.from_quat(wxyz_xyz[:4], scalar_first=True)).magnitude() < 1e-5
        place = (1 - s) * (turn_a.apply(pose[4:]) + move_a) + s * (turn_g.apply(pose[4:]) + move_g)
        np.testing.assert_allclose(wxyz_xyz[4:], place, atol=1e-5)


def test_the_ends_are_the_pick_and_the_goal(shown, ends):
    found = np.asarray(tdf.carry_trajectory(shown, *ends).wxyz_xyz)
    for pose, end in zip(found[[0, -1]], ends):
        np.testing.assert_allclose(pose[4:], end[4:], atol=1e-6)
        assert abs(pose[:4] @ np.asarray(end[:4])) > 1 - 1e-6


def test_ends_that_moved_together_carry_rigidly_and_so_does_no_goal(shown):
    motion = random_poses(7, 1)[0]
    expected = composed(motion, shown.wxyz_xyz)
    moved = jnp.asarray(expected, jnp.float32)
    for goal in (moved[-1], None):
        found = np.array(tdf.carry_trajectory(shown, moved[0], goal).wxyz_xyz)
        np.testing.assert_allclose(found[:, 4:], expected[:, 4:], atol=1e-5)
        assert np.abs(np.sum(found[:, :4] * expected[:, :4], axis=1)).min() > 1 - 1e-6


def test_the_frame_of_the_demonstration_does_not_matter(shown, ends):
    """A reference's trajectory is relative to its object: the same poses carried from any frame."""
    moved = shown.transformed(jnp.asarray(random_poses(8, 1)[0], jnp.float32))
    a, b = (np.array(tdf.carry_trajectory(one, *ends).wxyz_xyz) for one in (shown, moved))
    np.testing.assert_allclose(a[:, 4:], b[:, 4:], atol=1e-5)
    assert np.abs(np.sum(a[:, :4] * b[:, :4], axis=1)).min() > 1 - 1e-5


def test_carrying_turns_with_the_world(shown, ends):
    motion = jnp.asarray(random_poses(9, 1)[0], jnp.float32)
    moved = tdf.carry_trajectory(shown, *tdf.Trajectory(ends).transformed(motion).wxyz_xyz)
    expected = composed(np.asarray(motion), tdf.carry_trajectory(shown, *ends).wxyz_xyz)
    np.testing.assert_allclose(moved.wxyz_xyz[:, 4:], expected[:, 4:], atol=1e-5)


@pytest.mark.parametrize("name", ["pick", "goal"])
def test_several_poses_are_no_end(shown, ends, name):
    with pytest.raises(InputError, match=rf"{name} has shape \(2, 7\); expected one pose"):
        tdf.carry_trajectory(shown, **{"pick": ends[0], "goal": ends[1]} | {name: ends})


def test_one_pose_becomes_the_pick(ends):
    found = tdf.carry_trajectory(tdf.Trajectory(jnp.asarray(random_poses(1, 1), jnp.float32)), ends[0], None)
    np.testing.assert_allclose(np.asarray(found.wxyz_xyz[0, 4:]), ends[0, 4:], atol=1e-6)


def test_carrying_is_differentiable_where_nothing_turns(shown):
    """The demonstration carried to itself: geodesics of no length."""

    def last(pick):
        return jnp.sum(tdf.carry_trajectory(shown, pick, shown.wxyz_xyz[-1]).wxyz_xyz[2, 4:])

    assert np.isfinite(jax.jit(jax.grad(last))(shown.wxyz_xyz[0])).all()


# ---- the pick ----


@pytest.fixture(scope="module")
def result(field, reference):
    return tdf.carry(field, reference, KEY, config=CONFIG)


@pytest.fixture(scope="module")
def picked(field, reference):
    """The pick alone, by the solver."""
    alone = dataclasses.replace(
        reference, descriptors=reference.descriptors[:1], trajectory=tdf.Trajectory(reference.trajectory.wxyz_xyz[:1])
    )
    return alone, tdf.solve(field, alone, KEY, fix_last=False, energy=tdf.EnergyWeights(0.0), config=CONFIG.solver)


def test_picks_are_those_of_descriptors_alone(result, picked, field):
    alone, solved = picked
    np.testing.assert_allclose(result.trajectories[:, 0, 4:], solved.trajectories[:, 0, 4:], atol=1e-5)
    np.testing.assert_array_equal(result.energies, solved.energies)
    energies = [
        trajectory_energy(tdf.Trajectory(one), field, alone, tdf.EnergyWeights(0.0)) for one in solved.trajectories
    ]
    np.testing.assert_allclose(result.energies, energies, rtol=1e-5)
    assert result.energies[0] < result.candidate_history[:, 0].max()


def test_rows_are_carried_from_their_picks_to_the_goal(result, reference, field):
    goal = np.array(reference.trajectory.wxyz_xyz[-1])
    goal[4:] += field.origin
    for row in np.asarray(result.trajectories):
        np.testing.assert_allclose(row[-1, 4:], goal[4:], atol=1e-5)
        expected = tdf.carry_trajectory(reference.trajectory, jnp.asarray(row[0]), jnp.asarray(goal))
        np.testing.assert_allclose(row, expected.wxyz_xyz, atol=1e-5)


def test_a_goal_is_where_it_ends_and_without_one_it_is_carried_rigidly(field, reference):
    goal = jnp.asarray(random_poses(3, 1)[0], jnp.float32)
    found = tdf.carry(field, reference, KEY, goal=goal, config=CONFIG).trajectory
    np.testing.assert_allclose(found.translations[-1], goal[4:], atol=1e-5)
    with pytest.raises(InputError, match="fix_last=False does not keep it"):
        tdf.carry(field, reference, KEY, goal=goal, fix_last=False, config=CONFIG)
    free = tdf.carry(field, reference, KEY, fix_last=False, config=CONFIG).trajectory
    motion = motion_of(free.wxyz_xyz[0], reference.trajectory.wxyz_xyz[0])
    np.testing.assert_allclose(
        free.translations, motion[0].apply(np.array(reference.trajectory.translations, float)) + motion[1], atol=1e-5
    )


def test_the_residual_is_that_of_the_best_pick(result, picked):
    alone, solved = picked
    descriptors = np.asarray(alone.descriptors[0], float)
    expected = solved.loss / np.abs(descriptors - descriptors.mean(axis=0)).mean()
    np.testing.assert_allclose(result.residual, expected, rtol=1e-5)
    assert np.isnan(result.confidence)  # `imitate` knows the weights, and whether a curve was fitted to them


@pytest.mark.slow
def test_one_query_point_has_no_residual(small_model, field, demonstration):
    reference = tdf.describe(small_model, dataclasses.replace(demonstration, query=demonstration.query[:1]))
    assert np.isnan(tdf.carry(field, reference, KEY, config=CONFIG).residual)


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({"goal": np.zeros(7)}, "a quaternion of norm 0"),
        ({"goal": np.ones(6)}, "shape"),
        ({"key": 3}, "key"),
        ({"device_mesh": "all"}, "device_mesh"),
        ({"config": tdf.SolveConfig()}, "expected a CarryConfig"),
    ],
)
def test_bad_input_is_refused(field, reference, settings, words):
    with pytest.raises(InputError, match=words):
        tdf.carry(field, reference, **{"key": KEY} | settings)


def test_one_pose_that_is_kept_leaves_nothing_to_find(field, reference):
    one = dataclasses.replace(
        reference, descriptors=reference.descriptors[:1], trajectory=tdf.Trajectory(reference.trajectory.wxyz_xyz[:1])
    )
    with pytest.raises(InputError, match="fix_last=False"):
        tdf.carry(field, one, KEY)


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({"num_starts": 0}, r"^CarryConfig\(\): num_starts is 0"),
        ({"refine_steps": 1.5}, r"^CarryConfig\(\): refine_steps is 1.5; expected a whole number of at least 1"),
        ({"polish_steps": 0}, r"^CarryConfig\(\): polish_steps is 0"),
        ({"tolerance": -1}, r"^CarryConfig\(\): tolerance"),
    ],
)
def test_settings_are_checked(settings, words):
    with pytest.raises(InputError, match=words):
        tdf.CarryConfig(**settings)


def test_the_calibration_is_for_the_shipped_weights(small_model, reference):
    """Others have a residual, and `confidence` may be fitted to theirs."""
    cloud = random_cloud(3).astype(np.float32)
    result = tdf.imitate(small_model, reference, cloud, key=KEY, config=CONFIG)
    assert np.isnan(result.confidence) and result.residual > 0
    named = dataclasses.replace(small_model, info=dataclasses.replace(small_model.info, name="mug"))
    assert tdf.imitate(named, reference, cloud, key=KEY, config=CONFIG).confidence == np.float32(
        tdf.confidence(float(result.residual))
    )


def test_without_a_finite_start_the_result_says_so(monkeypatch, field, reference, result):
    lost = dataclasses.replace(result, energies=jnp.full(3, jnp.inf))
    monkeypatch.setattr(sys.modules["tdf_jax.solvers.pick"], "solve", lambda *arguments, **settings: lost)
    found = tdf.carry(field, reference, KEY, config=CONFIG)
    assert np.isnan(found.residual) and "non-finite" in found.status


def carried_parts(field, reference, key, goal):
    result = tdf.carry(field, reference, key, goal=goal, config=CONFIG)
    return result.trajectories, result.energies, result.residual, result.candidate_history, result.pick, result.loss


def test_from_a_cloud_to_trajectories_in_a_batch_that_is_traced_once(small_model, reference):
    """Clouds, denser than the network's, keys and goals are traced: `encode` and `carry` are one program."""
    model = dataclasses.replace(small_model, info=dataclasses.replace(small_model.info, cloud_points=24))
    traces = []

    @jax.jit
    @jax.vmap
    def batch(points, key, goal):
        traces.append(None)
        return carried_parts(tdf.encode(model, points), reference, key, goal)

    for seed in (0, 1):
        clouds = np.stack([random_cloud(10 * seed + index, 90) for index in range(2)]).astype(np.float32)
        keys, goals = jax.random.split(jax.random.key(seed), 2), jnp.asarray(random_poses(seed, 2), jnp.float32)
        found = batch(clouds, keys, goals)
        for index in range(2):
            expected = carried_parts(tdf.encode(model, clouds[index]), reference, keys[index], goals[index])
            for one, other in zip(found, expected, strict=True):
                np.testing.assert_allclose(one[index], other, rtol=1e-3, atol=1e-4)
    assert traces == [None]


@pytest.mark.slow
def test_a_traced_reference_of_one_query_point_has_no_residual(small_model, field, demonstration):
    reference = tdf.describe(small_model, dataclasses.replace(demonstration, query=demonstration.query[:1]))
    found = jax.jit(lambda reference: tdf.carry(field, reference, KEY, config=CONFIG).residual)(reference)
    assert np.isinf(found)


def test_imitate_carries_by_default(small_model, demonstration, reference, field, result):
    found = tdf.imitate(small_model, demonstration, random_cloud(3).astype(np.float32), key=KEY, config=CONFIG)
    np.testing.assert_array_equal(found.trajectories, result.trajectories)
    with pytest.raises(InputError, match="energy is given"):
        tdf.imitate(
            small_model,
            reference,
            random_cloud(3).astype(np.float32),
            key=KEY,
            config=CONFIG,
            energy=tdf.EnergyWeights(),
        )
