"""A joint trajectory in the viewer: where the robot is at every time."""

import numpy as np
import pytest

import tdf_jax as tdf
from tdf_jax.viewer.joints import PATH, JointStage
from tdf_jax.viewer.local_server import serving

pytest.importorskip("viser", reason="the extra 'viewer' is not installed")


@pytest.fixture(scope="module")
def trajectory(robot):
    """Half a second of the base joint and of the fingers; its columns are not in the order of the robot's joints."""
    positions = np.repeat(robot.home[None], 3, axis=0)
    positions[:, 0] += [0.0, 0.1, 0.3]
    return tdf.JointTrajectory(
        [0.0, 0.2, 0.5], positions[:, ::-1], robot.joints[::-1], [0.08, 0.08, 0.02], (("path", 0), ("grasp", 2))
    )


def test_the_robot_moves_through_the_trajectory(robot, trajectory):
    with serving("test", 0) as server:
        shown = JointStage(server, trajectory, robot)
        start = shown.gripper_at(0.0)
        assert shown.state.content.startswith("0.00 s: path  \ngripper x ")
        shown.player.value = 0.5
        shown._show_time()
        assert shown.state.content.startswith("0.50 s: grasp  \n") and "opening 2.0 cm" in shown.state.content
        turn = np.array([[np.cos(0.3), -np.sin(0.3)], [np.sin(0.3), np.cos(0.3)]])
        end = shown.gripper_at(0.5)
        np.testing.assert_allclose(end[:2, 3], turn @ start[:2, 3], atol=1e-9)
        np.testing.assert_allclose(shown._shown[PATH].points[-1, 1], end[:3, 3], atol=1e-6)
        site = shown._cell.model.site_bodyid[shown._cell.site]
        body = shown._cell.model.body(site).name
        np.testing.assert_allclose(shown.bodies[body].position, shown._data.body(body).xpos, atol=1e-9)
        shown.close()


def test_a_trajectory_of_another_robot_is_refused(robot, trajectory):
    other = tdf.JointTrajectory(trajectory.times, trajectory.positions[:, :2], ("a", "b"), trajectory.gripper)
    with serving("test", 0) as server, pytest.raises(tdf.InputError, match="has the joints a, b; expected those of"):
        JointStage(server, other, robot)
