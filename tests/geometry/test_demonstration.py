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
