"""Demonstrations with an approach and a retreat."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import CARRY, composed, random_poses

import tdf_jax as tdf
from tdf_jax._internal.errors import InputError
from tdf_jax.geometry import se3
from tdf_jax.geometry.demonstration import check_apart

POSES = random_poses(4, 9) + [0, 0, 0, 0, 0.3, -0.2, 0.1]  # as many from the grasp to the release as other tests have
GRASP, RELEASE = 3, 6
KEY = jax.random.key(5)
SOLVERS = {
    "carry": (tdf.carry, CARRY),
    "solve": (
        tdf.solve,
        tdf.SolveConfig(num_trajectory_starts=3, num_starts=8, num_coarse_queries=3, num_candidates=3),
    ),
    "optimize": (tdf.optimize, tdf.OptimizeConfig(num_starts=3, iterations=2)),
}


@pytest.fixture
def recording(demonstration):
    path = tdf.Trajectory(jnp.asarray(POSES, jnp.float32))
    return dataclasses.replace(demonstration, trajectory=path, grasp=GRASP, release=RELEASE)


def test_a_recording_has_three_parts(recording):
    for part, rows in (("approach", POSES[:3]), ("transfer", POSES[3:7]), ("retreat", POSES[7:])):
        np.testing.assert_allclose(getattr(recording, part).wxyz_xyz, rows, atol=1e-6)
    negative = dataclasses.replace(recording, grasp=-6, release=-3)
    np.testing.assert_array_equal(negative.transfer.wxyz_xyz, recording.transfer.wxyz_xyz)


def test_resampling_changes_the_part_between_grasp_and_release_only(recording):
    longer = recording.resampled(7)
    assert (longer.grasp, longer.release, longer.trajectory.num_poses) == (3, 9, 12)
    counted = dataclasses.replace(recording, release=-3).resampled(7)
    assert (counted.grasp, counted.release) == (3, -3)
    np.testing.assert_array_equal(counted.trajectory.wxyz_xyz, longer.trajectory.wxyz_xyz)
    np.testing.assert_array_equal(longer.approach.wxyz_xyz, recording.approach.wxyz_xyz)
    np.testing.assert_array_equal(longer.retreat.wxyz_xyz, recording.retreat.wxyz_xyz)
    np.testing.assert_allclose(longer.transfer.matrices, tdf.resample(recording.transfer, 7).matrices, atol=1e-6)


@pytest.mark.parametrize("name", ["carry", pytest.param("solve", marks=pytest.mark.slow), "optimize"])
def test_approach_and_retreat_follow_the_pick_and_the_goal_rigidly(name, small_model, recording, field):
    solver, config = SOLVERS[name]
    plain = dataclasses.replace(recording, trajectory=recording.transfer, grasp=0, release=-1)
    goal = POSES[0]
    alone = solver(field, tdf.describe(small_model, plain), KEY, goal=goal, config=config)
    result = solver(field, tdf.describe(small_model, recording), KEY, goal=goal, config=config)
    assert (result.grasp, result.release) == (3, -3)
    np.testing.assert_array_equal(result.energies, alone.energies)
    np.testing.assert_array_equal(np.asarray(result.trajectories)[:, 3:7], alone.trajectories)
    np.testing.assert_array_equal(result.pick, alone.trajectory.wxyz_xyz[0])
    np.testing.assert_allclose(matrices(result.goal[None]), matrices(goal[None]), atol=1e-6)
    inverse = np.asarray(se3.inverse(jnp.asarray(POSES[[GRASP, RELEASE]])))
    best = np.asarray(result.trajectory.wxyz_xyz, float)
    for part, motion in ((slice(0, 3), (best[3], inverse[0])), (slice(7, 9), (best[6], inverse[1]))):
        expected = composed(composed(motion[0], motion[1][None])[0], POSES[part])
        np.testing.assert_allclose(matrices(best[part]), matrices(expected), atol=2e-5)


def matrices(wxyz_xyz):
    return tdf.Trajectory(jnp.asarray(wxyz_xyz, jnp.float32)).matrices


@pytest.mark.parametrize(
    ("indices", "message"),
    [
        ((0, 9), "release is 9; expected a whole number from -9 to 8"),
        ((-10, -1), "grasp is -10"),
        ((1.0, 4), "grasp is 1.0"),
        ((5, 4), "grasp is pose 5 and release pose 4 of 9; expected the grasp first"),
    ],
)
def test_bad_indices_are_refused(recording, indices, message):
    with pytest.raises(InputError, match=rf"Demonstration\(\): {message}"):
        dataclasses.replace(recording, grasp=indices[0], release=indices[1])


ORDERS = {"x y z qx qy qz qw": [4, 5, 6, 1, 2, 3, 0], "x y z qw qx qy qz": [4, 5, 6, 0, 1, 2, 3]}


@pytest.mark.parametrize("order", ORDERS)
def test_poses_of_another_order_are_refused_wherever_they_come_in(order, recording, small_model, field):
    wrong = POSES[:, ORDERS[order]]
    message = r"quaternion of norm .*expected wxyz_xyz.*probably x y z qx qy qz qw, as in ROS"
    with pytest.raises(InputError, match=message):
        dataclasses.replace(recording, trajectory=tdf.Trajectory(jnp.asarray(wrong)))
    with pytest.raises(InputError, match=rf"imitate\(\): goal has a {message}"):
        tdf.imitate(small_model, recording, recording.points, key=KEY, goal=wrong[0])
    with pytest.raises(InputError, match=f"pick has a {message}"):
        tdf.carry_trajectory(recording.trajectory, wrong[0], None)
    restored = wrong[:, [6, 3, 4, 5, 0, 1, 2]] if order.endswith("qw") else wrong[:, [3, 4, 5, 6, 0, 1, 2]]
    np.testing.assert_array_equal(restored, POSES)  # the fix that the message gives


def test_rounded_quaternions_are_accepted(recording):
    rounded = np.round(POSES, 3)
    assert dataclasses.replace(recording, trajectory=tdf.Trajectory(jnp.asarray(rounded))).transfer.num_poses == 4
    with pytest.raises(InputError, match="divide each quaternion by its norm"):
        dataclasses.replace(recording, trajectory=tdf.Trajectory(jnp.asarray(POSES * [2, 2, 2, 2, 1, 1, 1])))


# Two clouds of one object, and of two that meet


def _cup(rng, radius, count=1500, height=0.1):
    """Wall and floor of a cup without thickness that stands on z = 0."""
    on_wall = rng.uniform(size=count) < 2 * height / (2 * height + radius)
    angle, out = rng.uniform(0, 2 * np.pi, count), np.sqrt(rng.uniform(size=count))
    out = radius * np.where(on_wall, 1.0, out)
    return np.stack([out * np.cos(angle), out * np.sin(angle), on_wall * rng.uniform(0, height, count)], axis=1)


@pytest.mark.parametrize("noise", [0.0, 0.002])
@pytest.mark.parametrize("seed", range(10))
def test_two_samples_of_one_object_are_refused(seed, noise):
    rng = np.random.default_rng(seed)
    one, other = (_cup(rng, 0.04) + rng.normal(0, noise, (1500, 3)) for _ in range(2))
    with pytest.raises(InputError, match=r"f\(\): the object's points lie on the target's surface \(\d\d% of them\)"):
        check_apart("f()", one, other)


@pytest.mark.parametrize("seed", range(5))
def test_a_part_of_the_target_is_warned_of(seed):
    rng = np.random.default_rng(seed)
    one, other = _cup(rng, 0.04, 4000), _cup(rng, 0.04)
    with pytest.warns(tdf.ForeignPointsWarning, match="points lie on the target's surface; check that the object's"):
        check_apart("f()", one[one[:, 0] > 0.01], other)


@pytest.mark.parametrize("noise", [0.0, 0.002])
@pytest.mark.parametrize("seed", range(5))
def test_objects_that_touch_or_stand_in_each_other_are_two(seed, noise):
    rng = np.random.default_rng(seed)
    board = rng.uniform(-0.25, 0.25, (3000, 3)) * [1, 1, 0]
    plate = rng.uniform(-0.1, 0.1, (1500, 3)) * [1, 1, 0] + 0.01 * rng.integers(0, 2, (1500, 1)) * [0, 0, 1]
    for one, target in (
        (_cup(rng, 0.04), board),
        (plate, board),
        (_cup(rng, 0.03) + [0.003, 0, 0.004], _cup(rng, 0.04)),  # in the other
        (_cup(rng, 0.04) + [0, 0, 0.1], _cup(rng, 0.04)),  # on its rim
        (_cup(rng, 0.04) + [0.08, 0, 0], _cup(rng, 0.04)),  # beside it, wall at wall
        (
            _cup(rng, 0.04) + [0.03, 0, 0.02],
            _cup(rng, 0.04),
        ),  # through it, which is not known from an object on another
    ):
        one, target = (cloud + rng.normal(0, noise, cloud.shape) for cloud in (one, target))
        check_apart("f()", one, target)  # a warning would be an error
