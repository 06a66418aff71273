"""Demonstrated grasps: the wall or the neck is between the pads, and the gripper lies where it must."""

import dataclasses

import numpy as np
import pytest

import tdf_jax as tdf
from tdf_jax._internal.errors import InputError
from tdf_jax.geometry.symmetry import ROUND
from tdf_jax.shapes import FAMILIES
from tdf_jax.sim.grasps import grip_of
from tdf_jax.sim.necks import EDGE
from tdf_jax.sim.pads import TIPS


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


@pytest.mark.parametrize("seed", range(4))
def test_a_bottle_is_held_at_the_neck_from_above(robot, seed):
    bottle, fingers = drawn_shape("bottle", seed), robot.fingers
    grip = grip_of(bottle, fingers)
    T = grip.T_object_grip
    np.testing.assert_allclose(T[:3, 2], (0, 0, -1), atol=1e-9)
    np.testing.assert_allclose(T[:2, 3], 0, atol=1e-9)
    # The widest of what is between the pads, from their tips over their length.
    tips = fingers.tip(grip.width) - fingers.depth(grip.width)
    inside = [between(bottle, grip, fingers, tips - back) for back in np.linspace(0, 2 * TIPS, 40)]
    spans = np.array([np.ptp(part) if len(part) else 0.0 for part in inside])
    assert spans.max() == pytest.approx(grip.width, abs=0.0015)
    assert abs(inside[int(spans.argmax())].mean()) < 1e-3
    # Open fingers pass beside all that is above their tips, by 5 mm at least.
    above = [between(bottle, grip, fingers, tips - back, 1201) for back in np.linspace(0, 0.055, 56)]
    assert max(np.ptp(part) for part in above if len(part)) < grip.opening - 0.0099
    assert grip.opening <= fingers.widest + 1e-9
    # They end above the table.
    assert T[2, 3] - fingers.tip(grip.width) > bottle.mesh.bounds[0, 2] + 0.02


def test_pads_touch_a_cap_at_its_widest_ring_and_a_straight_neck_along_its_length(robot):
    fingers = robot.fingers
    cone = tdf.build_bottle(tdf.BottleParameters(cap_height=0.03, cap_radius=0.020, cap_taper=0.5))
    grip = grip_of(cone, fingers)
    assert grip.width == pytest.approx(0.040, abs=0.001)  # not higher on the cone, off which pads slide
    ring = cone.mesh.bounds[1, 2] - 0.03
    above_tips = ring - (grip.T_object_grip[2, 3] - fingers.tip(grip.width))
    assert above_tips > EDGE - 0.001
    long = tdf.build_bottle(tdf.BottleParameters(cap_height=0.0, shoulder_bottom=0.11, shoulder_top=0.14))
    grip = grip_of(long, fingers)
    assert grip.width == pytest.approx(0.028, abs=0.001)
    tips = grip.T_object_grip[2, 3] - fingers.tip(grip.width)
    assert 0.14 - long.height / 2 < tips < long.mesh.bounds[1, 2] - 2 * TIPS + 0.001  # all of the pads


def test_a_grasp_of_a_round_neck_is_the_same_at_every_turn(robot):
    flat = tdf.build_bottle(tdf.BottleParameters(aspect=0.6))
    assert grip_of(flat, robot.fingers).fold == ROUND  # its body is flat, its neck is not
    assert grip_of(tdf.build_mug(), robot.fingers).fold == 1
    # A flat bottle whose fingers reach below the shoulder everywhere is held across its narrow side alone.
    stub = tdf.build_bottle(
        tdf.BottleParameters(height=0.12, aspect=0.6, shoulder_bottom=0.108, shoulder_top=0.113, cap_height=0.004)
    )
    grip = grip_of(stub, robot.fingers)
    assert grip.fold == 1 and grip.width == pytest.approx(0.6 * 0.072, abs=0.004)


def test_what_has_no_grasp_is_refused(robot):
    with pytest.raises(InputError, match=r"grip_of\(\): there is no grasp of a rack; expected a mug"):
        grip_of(tdf.build_rack(), robot.fingers)
    narrow = dataclasses.replace(robot.fingers, openings=robot.fingers.openings * 0.3)
    with pytest.raises(InputError, match=r"the neck of the bottle is wider than the gripper, 26 mm"):
        grip_of(tdf.build_bottle(), narrow)
    thin = dataclasses.replace(robot.fingers, openings=robot.fingers.openings * 0.05)
    with pytest.raises(
        InputError, match=r"the wall of the mug is \d\.\d mm thick, and the fingers open to 4\.\d mm; exp"
    ):
        grip_of(tdf.build_mug(), thin)
