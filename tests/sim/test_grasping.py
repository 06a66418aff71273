"""The grasp test: what is between the fingers is held, lifted and turned by friction, and what is beside is not."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import tdf_jax as tdf
from tdf_jax.sim import physics
from tdf_jax.sim.bodies import body_of
from tdf_jax.sim.grasping import FloatingHand, evaluate_grasp
from tdf_jax.sim.grasps import grip_of
from tdf_jax.sim.workcell import OBJECT, build_workcell


@pytest.fixture(scope="module")
def mug(robot):
    """A mug on the table, its body, pose, and grasp."""
    shape = tdf.build_mug()
    T = np.eye(4)
    T[:3, 3] = 0.5, 0.0, -shape.mesh.bounds[0, 2]
    return body_of(shape), T, grip_of(shape, robot.fingers)


def test_a_mug_at_its_rim_is_held(robot, mug):
    body, T, grip = mug
    upright = evaluate_grasp(robot, body, T, T @ grip.T_object_grip, grip.opening)
    assert upright.held and upright.slip < 0.005 and upright.turn < 5 and upright.pulled < 0.01
    assert upright.struck == 0


def test_a_hand_beside_the_mug_holds_nothing(robot, mug):
    body, T, grip = mug
    beside = T @ grip.T_object_grip
    beside[:3, 3] += (0, 0.15, 0.02)
    empty = evaluate_grasp(robot, body, T, beside, grip.opening)
    assert not empty.held and empty.pulled < 1e-3 and empty.slip > 0.1  # the hand leaves, the mug stays


def test_a_hand_in_the_wall_is_struck(robot, mug):
    body, T, grip = mug
    inside = T @ grip.T_object_grip
    inside[:3, :3] = inside[:3, :3] @ np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    assert evaluate_grasp(robot, body, T, inside, 0.0).struck > 0.002


@pytest.mark.slow
def test_a_turned_and_a_fixed_mug_are_held(robot, mug):
    body, T, grip = mug
    pick = T @ grip.T_object_grip
    sideways = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]]) @ pick[:3, :3]
    assert evaluate_grasp(robot, body, T, pick, grip.opening, rotation=sideways).held
    above = np.eye(4)
    above[2, 3] = 0.2
    fixed = evaluate_grasp(robot, body, above @ T, above @ pick, grip.opening, fixture=True)
    assert fixed.held and fixed.pulled < 0.01


@pytest.mark.slow
def test_without_friction_the_mug_falls(robot, mug, monkeypatch):
    """It is friction that holds: no weld, nothing that is set."""
    body, T, grip = mug
    cell = build_workcell(robot, body, T, floating=True)
    cell.model.geom_friction[:] = 1e-5
    monkeypatch.setattr("tdf_jax.sim.grasping.build_workcell", lambda *arguments, **options: cell)
    assert physics.FRICTION[0] > 0.5
    assert not evaluate_grasp(robot, body, T, T @ grip.T_object_grip, grip.opening).held


def test_a_floating_hand_is_where_it_is_driven_to(robot, mug):
    body, T, grip = mug
    cell = build_workcell(robot, body, T, floating=True)
    start, end = np.diag([1.0, -1, -1, 1]), np.diag([-1.0, 1, -1, 1])
    start[:3, 3], end[:3, 3] = (0.3, 0.3, 0.4), (0.35, 0.25, 0.5)
    hand = FloatingHand(cell, start, 0.05)
    np.testing.assert_allclose(cell.gripper_pose(hand.data), start, atol=1e-9)
    hand.move(end, 1.0)
    hand.wait(0.3)
    np.testing.assert_allclose(cell.gripper_pose(hand.data), end, atol=1e-3)
    assert not hand.holds() and hand.penetration() == 0
    np.testing.assert_allclose(cell.body_pose(hand.data, OBJECT), T, atol=1e-3)


@pytest.mark.slow
def test_a_heavy_tilted_bottle_is_held_in_the_plane_of_its_tilt_and_swings_across_it(robot):
    """A cap that is a cone is touched at one ring, by a point of either pad; it swings when the fixture lets go."""
    bottle = tdf.build_bottle(tdf.BottleParameters(cap_height=0.03, cap_radius=0.018, cap_taper=0.9))
    body, grip = body_of(bottle, 0.3), grip_of(bottle, robot.fingers)
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = Rotation.from_euler("xz", (55, 40), degrees=True).as_matrix(), (0.5, 0, 0.3)
    held = []
    for turn in (0.0, 90.0):
        about = np.eye(4)
        about[:3, :3] = Rotation.from_euler("z", turn, degrees=True).as_matrix()
        held.append(evaluate_grasp(robot, body, T, T @ about @ grip.T_object_grip, grip.opening, fixture=True))
    plane, across = held
    assert plane.held and plane.slip < 0.006 and plane.turn < 4 and plane.pulled < 0.002
    assert not across.held and across.slip > 0.03 and across.turn > 20
