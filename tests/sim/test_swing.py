"""Turning a hand so that what it holds does not swing, and the arm of the weight about the closing direction."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tdf_jax.sim.swing import level_rotations

SHARES = np.linspace(0, 1, 21)


def rotations(seed, count=2):
    return Rotation.random(count, rng=np.random.default_rng(seed)).as_matrix()


@pytest.mark.parametrize("seed", range(5))
def test_the_vertical_takes_the_shortest_way_evenly(seed):
    start, end = rotations(seed)
    between = level_rotations(start, end, SHARES)
    np.testing.assert_allclose(between[[0, -1]], [start, end], atol=1e-9)
    np.testing.assert_allclose(np.linalg.det(between), 1)
    up = between[:, 2, :]  # in the frame that is turned
    angle = np.arccos(np.clip(up[0] @ up[-1], -1, 1))
    steps = np.arccos(np.clip((up[1:] * up[:-1]).sum(axis=1), -1, 1))
    np.testing.assert_allclose(steps, angle / 20, atol=1e-6)  # even, and no longer than the great circle


def test_a_turn_about_the_vertical_alone_is_the_geodesic():
    start = rotations(3)[0]
    end = Rotation.from_euler("z", 2.5).as_matrix() @ start
    expected = Rotation.from_euler("z", 2.5 * SHARES[:, None]).as_matrix() @ start
    np.testing.assert_allclose(level_rotations(start, end, SHARES), expected, atol=1e-9)


def test_what_is_turned_over_has_orientations_too():
    start = np.eye(3)
    end = np.diag([1.0, -1.0, -1.0])
    between = level_rotations(start, end, SHARES)
    np.testing.assert_allclose(between[-1], end, atol=1e-9)
    np.testing.assert_allclose(between @ between.transpose(0, 2, 1), np.tile(np.eye(3), (21, 1, 1)), atol=1e-9)


def test_a_bottle_does_not_swing_in_the_plane_of_its_tilt():
    """Held at the neck and closed in the vertical plane of its axis, then set upright and turned about the vertical."""
    tilt = Rotation.from_euler("y", 50, degrees=True).as_matrix()  # the axis is in the plane of x and z
    grip = np.array([[0.0, 1, 0], [1, 0, 0], [0, 0, -1]])  # from above; closing along x, and across along y
    across = grip @ Rotation.from_euler("z", 90, degrees=True).as_matrix()
    upright = Rotation.from_euler("z", 120, degrees=True).as_matrix()
    arms = []
    for local in (grip, across):
        hand = level_rotations(tilt @ local, upright @ local, SHARES)
        centre = hand @ local.T @ [0, 0, -0.1]  # of mass, from the hand, in the world
        # The arm of its weight about the closing direction, y, against which two pads hold least.
        arms.append(np.abs(np.einsum("si,si->s", np.cross(centre, (0, 0, -1.0)), hand[:, :, 1])).max())
    assert arms[0] < 1e-6
    assert arms[1] == pytest.approx(0.1 * np.sin(np.radians(50)), rel=1e-3)
