"""Truth and errors by hand, and the shipped weights on three pairs of unseen mugs."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import tdf_jax as tdf
from tdf_jax import poses
from tdf_jax.evaluation.cases import mug_case, random_pose
from tdf_jax.evaluation.transfer import mean_iou, summary, transfer_errors
from tdf_jax.evaluation.truth import expected_trajectory, path_error, pose_error
from tdf_jax.network import initialise
from tdf_jax.optimize import random_starts


def rigid(rotation_vector, translation):
    T = np.eye(4)
    T[:3, :3] = poses.exp(jnp.asarray(rotation_vector, jnp.float32))
    T[:3, 3] = translation
    return T


def test_the_expected_trajectory_goes_from_the_carried_pick_to_the_goal():
    shown = tdf.line(5, start=(0.05, 0, 0), end=(0.05, 0.4, 0))
    place_a, place_b = rigid([0, 0, 0], [0.05, 0, 0]), rigid([0, 0, np.pi / 2], [0.0, 0.07, 0.2])
    goal = poses.pose(jnp.eye(3), jnp.array([0.05, 0.4, 0.3]))
    expected = expected_trajectory(shown, place_a, place_b, goal)
    np.testing.assert_allclose(expected.translations[0], [0.0, 0.07, 0.2], atol=1e-6)  # the handle goes to the handle
    np.testing.assert_allclose(expected.wxyz_xyz[-1], goal, atol=1e-6)
    turns = poses.rotation_distance(expected.rotations, jnp.eye(3)[None])
    np.testing.assert_allclose(turns, np.linspace(np.pi / 2, 0, 5), atol=1e-6)
    # Half way: the mean of where the pick's motion (x, y -> -y, x + ...) and the goal's (0.3 m up) carry (0.05, 0.2, 0).
    np.testing.assert_allclose(expected.translations[2], (np.array([-0.2, 0.07, 0.2]) + [0.05, 0.2, 0.3]) / 2, atol=1e-6)


def test_the_same_object_moved_is_expected_to_carry_its_trajectory():
    shown, moved = tdf.wave(6), rigid([0.3, -0.8, 0.5], [0.1, 0.2, 0.3])
    place = rigid([0, 0.4, 0], [0.05, 0, 0.02])
    carried = shown.transformed(poses.pose(jnp.asarray(moved[:3, :3]), jnp.asarray(moved[:3, 3])))
    expected = expected_trajectory(shown, place, moved @ place, carried.wxyz_xyz[-1])
    distance, angle = pose_error(expected.wxyz_xyz, carried.wxyz_xyz)
    assert distance.max() < 1e-6 and angle.max() < 1e-3
    assert path_error(expected, carried) < 1e-6
    assert path_error(expected, carried.shifted(jnp.array([0.0, 0.03, 0.04]))) == pytest.approx(0.05, abs=1e-6)


def test_summary_counts():
    distance = np.array([0.005, 0.015, 0.03, 0.005])
    angle = np.array([5.0, 15.0, 5.0, 175.0])
    row = summary(distance, angle)
    assert row["success_1cm_10deg"] == 0.25 and row["success_2cm_20deg"] == 0.5 and row["flips"] == 1
    assert row["position_median_cm"] == pytest.approx(1.0)
    low, high = row["interval_2cm_20deg"]
    assert low < 0.5 < high


def test_cases_are_functions_of_seed_and_index():
    first, again, other = mug_case(3, 1, points=50), mug_case(3, 1, points=50), mug_case(3, 2, points=50)
    np.testing.assert_array_equal(first.points_b, again.points_b)
    assert np.abs(first.points_b - other.points_b).max() > 1e-3
    for mug in (first.object_a, first.object_b):
        assert mug.parameters.height == pytest.approx(0.12)
    # The truth is the handle of the mug as it lies, and the cloud lies there too.
    T = first.T_world_b
    np.testing.assert_allclose(first.T_world_place_b, T @ first.object_b.handle_frame)
    back = (first.points_b - T[:3, 3]) @ T[:3, :3]
    low, high = first.object_b.mesh.bounds
    assert (back > low - 1e-5).all() and (back < high + 1e-5).all()


def test_no_start_is_the_true_rotation(small_model, reference, field):
    """Poses and starts are both drawn from a seed; a start equal to the answer would make every number worthless."""
    for seed in range(3):
        starts = random_starts(jax.random.key(seed), field, reference, 10, "carried", 0.1)
        for index in range(10):
            turns = poses.rotation(starts[:, 0]) @ jnp.swapaxes(reference.trajectory.rotations[0], -1, -2)
            truth = jnp.asarray(random_pose(seed, index)[:3, :3], jnp.float32)
            assert float(poses.rotation_distance(turns, truth[None]).min()) > 0.01


def test_the_shipped_weights_transfer_a_pose_and_random_ones_do_not():
    model = tdf.load_model("mug")
    cases = [mug_case(0, index) for index in range(3)]
    config = tdf.OptimizeConfig(inits=5, iterations=60)
    distance, angle = transfer_errors(model, cases, config=config, progress=False)
    assert (distance < 0.02).all() and (angle < 20).all(), (distance, angle)
    assert mean_iou(model, cases[:1], samples=4000) > 0.7
    blank = dataclasses.replace(model, params=initialise(jax.random.key(0), model.config))
    distance, angle = transfer_errors(blank, cases, config=config, progress=False)
    assert ((distance > 0.02) | (angle > 20)).sum() >= 2
