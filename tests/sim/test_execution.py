"""Execution: in physics an empty arm is where it is planned to be, at every moment."""

import numpy as np
import pytest
from conftest import angle

from tdf_jax.sim.execution import Controller, Payload, execute
from tdf_jax.sim.joint_trajectory import JointTrajectory
from tdf_jax.sim.kinematics import kinematics_of
from tdf_jax.sim.physics import TIMESTEP
from tdf_jax.sim.workcell import build_workcell


@pytest.fixture(scope="module")
def followed(robot, planned):
    """Time, errors in metres and degrees, and phase, while the motion runs; and the state at its end."""
    kinematics, cell = kinematics_of(robot), build_workcell(robot)
    data, rows, phases = cell.data(), [], []

    def watch(data, step, phase):
        phases.append(phase)
        if step % 20 == 0:
            joints, _ = planned.at(min(step * TIMESTEP, planned.duration))
            expected, found = kinematics.pose(joints), cell.gripper_pose(data)
            rows.append((data.time, np.linalg.norm(expected[:3, 3] - found[:3, 3]), angle(expected, found)))

    execute(cell, data, planned, watch)
    return cell, data, np.array(rows), phases


def test_an_empty_arm_follows(followed):
    _, _, rows, _ = followed
    _, distances, angles = rows.T
    # Poses and errors are of the same moment: the state of the sites is one step before that of the joints.
    assert distances.max() < 5e-4 and angles.max() < 0.1
    assert np.median(distances) < 1e-4


def test_it_ends_at_home_with_open_fingers(robot, planned, followed):
    cell, data, _, _ = followed
    assert data.time == pytest.approx(planned.duration, abs=2 * TIMESTEP)
    np.testing.assert_allclose(data.qpos[cell.arm], robot.home, atol=1e-3)
    assert data.ctrl[cell.finger_actuator] == pytest.approx(robot.fingers.command(robot.fingers.widest))


def test_the_phases_are_those_of_the_motion(planned, followed):
    *_, phases = followed
    order = [phases[0]] + [after for before, after in zip(phases, phases[1:]) if after != before]
    assert order == [name for name, _ in planned.segments]
    for name, part in planned.segment_slices().items():
        seconds = planned.times[min(part.stop, planned.num_samples - 1)] - planned.times[part.start]
        assert phases.count(name) * TIMESTEP == pytest.approx(seconds, abs=0.01)


def test_a_motion_of_one_sample_stands(robot):
    motion = JointTrajectory(np.zeros(1), robot.home[None], robot.joints, np.array([0.05]))
    cell = build_workcell(robot)
    controller = Controller(cell, motion)
    assert controller.num_steps == 1
    data = cell.data()
    controller.command(data, 0)
    np.testing.assert_allclose(data.ctrl[cell.arm_actuators], robot.home, atol=1e-12)
    assert data.ctrl[cell.finger_actuator] == pytest.approx(robot.fingers.command(0.05))


def sag(cell, motion, kinematics, mass, centre, payload):
    """How much lower than planned the gripper is in the median, metres, while a weight pulls at it along the path."""
    body = int(cell.model.site_bodyid[cell.site])
    data, rows = cell.data(), []

    def watch(data, step, phase):
        data.xfrc_applied[body] = 0
        if phase != "path":
            return
        T = cell.gripper_pose(data)
        force = mass * cell.model.opt.gravity
        arm = T[:3, :3] @ centre + T[:3, 3] - data.xipos[body]
        data.xfrc_applied[body] = [*force, *np.cross(arm, force)]
        if step % 20 == 0:
            joints, _ = motion.at(min(step * TIMESTEP, motion.duration))
            rows.append(kinematics.pose(joints)[2, 3] - T[2, 3])

    execute(cell, data, motion, watch, payload)
    return np.median(rows)


def test_a_payload_that_is_told_does_not_pull_the_arm_down(robot, planned):
    cell, centre = build_workcell(robot), np.array([0.0, 0.01, 0.03])
    used = cell, planned, kinematics_of(robot), 0.4, centre
    assert sag(*used, None) > 8e-4
    assert abs(sag(*used, Payload(0.4, centre))) < 5e-5
