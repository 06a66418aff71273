"""Centring: a grasp that is turned and shifted comes back to the middle of the wall that the cloud shows."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tdf_jax.geometry.sampling import sample_surface
from tdf_jax.shapes import FAMILIES
from tdf_jax.sim.centring import centred
from tdf_jax.sim.grasps import grip_of


@pytest.fixture(
    scope="module", params=[("mug", 0), ("mug", 1), ("bowl", 2), ("bottle", 2)], ids=lambda one: f"{one[0]}{one[1]}"
)
def held(request, robot):
    category, seed = request.param
    family = FAMILIES[category]
    shape = family.build(family.sample(np.random.default_rng(seed)))
    cloud = sample_surface(shape.mesh, 1500, np.random.default_rng(3))
    return cloud, grip_of(shape, robot.fingers), {"mug": (2, 1e-3), "bowl": (3, 1e-3), "bottle": (2, 0.5e-3)}[category]


def moved_grip(T, degrees, shift, fingers):
    """Turned about the x axis at the pads, and shifted along the closing direction."""
    turn = np.eye(4)
    turn[:3, :3] = Rotation.from_euler("x", degrees, degrees=True).as_matrix()
    pads = np.array([0, 0, fingers.depth(0.0)])
    turn[:3, 3] = pads - turn[:3, :3] @ pads + (0, shift, 0)
    return T @ turn


def errors(T, true, fingers):
    """Angle about the x axis, degrees, and offset along the closing direction at the pads, metres."""
    local = np.linalg.inv(true) @ T
    at = local @ [0, 0, fingers.depth(0.0), 1]
    return abs(np.degrees(np.arctan2(local[2, 1], local[1, 1]))), abs(at[1])


def test_a_grasp_that_is_turned_and_shifted_comes_back(held, robot):
    cloud, grip, (most_degrees, most_offset) = held
    for degrees, shift in ((15, 0.005), (-15, 0.005), (15, -0.005), (-15, -0.005)):
        T = moved_grip(grip.T_object_grip, degrees, shift, robot.fingers)
        assert errors(T, grip.T_object_grip, robot.fingers)[0] == pytest.approx(15)
        angle, offset = errors(centred(T, cloud, grip.opening, robot.fingers), grip.T_object_grip, robot.fingers)
        assert angle < most_degrees and offset < most_offset, (degrees, shift)


def test_a_grasp_in_the_middle_stays(held, robot):
    cloud, grip, (most_degrees, most_offset) = held
    angle, offset = errors(
        centred(grip.T_object_grip, cloud, grip.opening, robot.fingers), grip.T_object_grip, robot.fingers
    )
    assert angle < most_degrees and offset < most_offset


def test_what_moves_is_the_closing_direction_alone(held, robot):
    """Along x, where the wall goes on, nothing is known."""
    cloud, grip, _ = held
    T = moved_grip(grip.T_object_grip, 10, 0.003, robot.fingers)
    local = np.linalg.inv(grip.T_object_grip) @ centred(T, cloud, grip.opening, robot.fingers)
    assert abs(local[0, 3]) < 1e-9
    np.testing.assert_allclose(local[0, :3], (1, 0, 0), atol=1e-9)


def test_with_nothing_between_the_fingers_a_grasp_stays(held, robot):
    cloud, grip, _ = held
    away = grip.T_object_grip.copy()
    away[:3, 3] += 0.5
    np.testing.assert_array_equal(centred(away, cloud, grip.opening, robot.fingers), away)
