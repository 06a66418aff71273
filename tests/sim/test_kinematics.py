"""Inverse kinematics: poses of configurations are reached again, as the arm of a cell has them."""

import numpy as np
import pytest
from conftest import downward

from tdf_jax.sim.kinematics import POSITION_TOLERANCE, ROTATION_TOLERANCE, kinematics_of
from tdf_jax.sim.workcell import build_workcell


@pytest.fixture(scope="module")
def kinematics(robot):
    return kinematics_of(robot)


def test_poses_are_those_of_the_physics(robot, kinematics):
    import mujoco

    cell = build_workcell(robot)
    data = cell.data()
    for seed in range(3):
        joints = np.random.default_rng(seed).uniform(-2, 2, robot.num_joints)
        data.qpos[cell.arm] = joints
        mujoco.mj_kinematics(cell.model, data)
        np.testing.assert_allclose(kinematics.pose(joints), cell.gripper_pose(data), atol=1e-9)


def test_pose_solve_pose(robot, kinematics):
    for seed in range(8):
        joints = robot.home + np.random.default_rng(seed).uniform(-0.4, 0.4, robot.num_joints)
        T = kinematics.pose(joints)
        found = kinematics.solve(T, robot.home)
        assert found is not None and (found >= robot.lower).all() and (found <= robot.upper).all()
        reached = kinematics.pose(found)
        assert np.linalg.norm(reached[:3, 3] - T[:3, 3]) < 2 * POSITION_TOLERANCE
        assert np.linalg.norm(reached[:3, :3] - T[:3, :3]) < 2 * ROTATION_TOLERANCE


def test_a_search_from_anywhere_finds_all_eight_configurations_of_an_arm_of_six_joints(robot, kinematics):
    T, rng, found = downward(0.45, 0.1, 0.2), np.random.default_rng(3), []
    for _ in range(80):
        joints = kinematics.search(T, rng.uniform(-np.pi, np.pi, 6))
        if joints is None:
            continue
        assert (joints >= robot.lower).all() and (joints <= robot.upper).all()
        reached = kinematics.pose(joints)
        assert np.linalg.norm(reached[:3, 3] - T[:3, 3]) < 2 * POSITION_TOLERANCE
        assert np.linalg.norm(reached[:3, :3] - T[:3, :3]) < 2 * ROTATION_TOLERANCE
        turned = np.exp(1j * joints)  # without whole turns
        if all(np.abs(turned - other).max() > 0.05 for other in found):
            found.append(turned)
    assert len(found) == 8  # shoulder left or right, elbow up or down, wrist flipped or not


def test_the_same_question_has_the_same_answer(robot, kinematics):
    T = kinematics.pose(robot.home + 0.3)
    first = kinematics.solve(T, robot.home)
    kinematics.solve(kinematics.pose(robot.home - 0.3), robot.home + 0.1)
    np.testing.assert_array_equal(kinematics.solve(T, robot.home), first)


def test_what_is_out_of_reach_is_not_found(robot, kinematics):
    T = kinematics.pose(robot.home)
    T[0, 3] += 2.0
    assert kinematics.solve(T, robot.home) is None and kinematics.search(T, robot.home) is None
    near = kinematics.pose(robot.home)
    near[0, 3] += 0.1
    assert kinematics.solve(near, robot.home, iterations=1) is None
    assert kinematics.search(near, robot.home, iterations=1) is None
