"""Demonstrated grasps: the wall or the neck is between the pads, and the gripper lies where it must."""

import dataclasses

import numpy as np
import pytest

import tdf_jax as tdf
from tdf_jax._internal.errors import InputError
from tdf_jax.shapes import FAMILIES
from tdf_jax.sim.grasps import grip_of


def drawn_shape(category, seed):
    family = FAMILIES[category]
    return family.build(family.sample(np.random.default_rng(seed)))


def between(shape, grip, fingers, depth=0.0, count=801):
    """What of the object is on the closing line, in the gripper's frame: y of points inside, metres."""
    y = np.linspace(-grip.opening / 2, grip.opening / 2, count)
    z = fingers.depth(grip.width) + depth
    line = grip.T_object_grip[:3, 3] + y[:, None] * grip.T_object_grip[:3, 1] + z * grip.T_object_grip[:3, 2]
    return y[shape.contains(line)]


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("category", ["mug", "bowl"])
def test_the_wall_of_a_rim_is_midway_between_the_pads(robot, category, seed):
    shape = drawn_shape(category, seed)
    grip = grip_of(shape, robot.fingers)
    T = grip.T_object_grip
    np.testing.assert_allclose(T[:3, :3].T @ T[:3, :3], np.eye(3), atol=1e-9)
    assert np.linalg.det(T[:3, :3]) == pytest.approx(1)
    wall = between(shape, grip, robot.fingers, 0.01)
    assert len(wall) and abs(wall.mean()) < 0.004
    assert np.ptp(wall) == pytest.approx(grip.width, abs=0.004)
    assert grip.width < grip.opening <= robot.fingers.widest
    assert T[2, 2] < -0.5  # from above
    # The outermost of the pads are inside and outside: nothing of the object is there.
    assert np.abs(wall).max() < grip.opening / 2 - 0.005


@pytest.mark.parametrize("seed", range(3))
def test_a_mug_is_held_opposite_to_its_handle(robot, seed):
    mug = drawn_shape("mug", seed)
    grip = grip_of(mug, robot.fingers)
    assert grip.T_object_grip[0, 3] < 0 < mug.handle_frame[0, 3]
    assert abs(grip.T_object_grip[1, 3]) < 1e-9


@pytest.mark.parametrize("seed", range(3))
def test_a_bottle_is_held_at_the_neck_from_above(robot, seed):
    bottle = drawn_shape("bottle", seed)
    grip = grip_of(bottle, robot.fingers)
    T = grip.T_object_grip
    np.testing.assert_allclose(T[:3, 2], (0, 0, -1), atol=1e-9)
    np.testing.assert_allclose(T[:2, 3], 0, atol=1e-9)
    neck = between(bottle, grip, robot.fingers)
    assert abs(neck.mean()) < 1e-3
    # The widest of what is between the fingers, over the length of the pads.
    inside = [between(bottle, grip, robot.fingers, depth) for depth in np.linspace(-0.018, 0.018, 19)]
    assert max(np.ptp(part) for part in inside if len(part)) == pytest.approx(grip.width, abs=0.003)
    # The tips, even those of open fingers, are above the table.
    assert T[2, 3] - robot.fingers.depth(grip.opening) - 0.0187 > bottle.mesh.bounds[0, 2]


def test_what_has_no_grasp_is_refused(robot):
    with pytest.raises(InputError, match=r"grip_of\(\): there is no grasp of a rack; expected a mug"):
        grip_of(tdf.build_rack(), robot.fingers)
    narrow = dataclasses.replace(robot.fingers, openings=robot.fingers.openings * 0.3)
    with pytest.raises(InputError, match=r"the neck of the bottle is wider than the gripper, 26 mm"):
        grip_of(tdf.build_bottle(), narrow)
