"""Flat pads: they lie flush with what they clamp where it is narrowest between them."""

import numpy as np
import pytest

from tdf_jax.sim.pads import TIPS, flush_turn, turned_about_x

TIP, PIVOT = 0.018, 0.0


def turned(points, degrees):
    """Points as the gripper sees them that is turned about its x axis at the pivot."""
    T = turned_about_x(np.eye(4), np.radians(degrees), PIVOT, 0.0)
    return points @ T[:3, :3] - T[:3, 3] @ T[:3, :3]


def wall(bend=0.0):
    """Two parallel surfaces 6 mm apart, at 2 mm along y; `bend` is their curvature along the approach, 1/m."""
    x, z = (one.ravel() for one in np.meshgrid(np.linspace(-0.01, 0.01, 5), np.linspace(-0.06, 0.06, 241)))
    middle = 0.002 + bend * z**2 / 2
    return np.concatenate([np.stack([x, middle + side, z], axis=1) for side in (-0.003, 0.003)])


@pytest.mark.parametrize("degrees", [-12, 0, 5])
@pytest.mark.parametrize("bend", [0.0, 3.0])
def test_a_turned_gripper_turns_back_and_is_in_the_middle(degrees, bend):
    seen = turned(wall(bend), degrees)
    angle, shift = flush_turn(seen, TIP, PIVOT)
    T = turned_about_x(turned_about_x(np.eye(4), np.radians(degrees), PIVOT, 0.0), angle, PIVOT, shift)
    tangent = bend * (TIP - TIPS)  # in the middle of the pads
    assert np.degrees(np.arctan2(T[2, 1], T[1, 1])) == pytest.approx(-np.degrees(tangent), abs=1.0)
    final = (wall(bend) - T[:3, 3]) @ T[:3, :3]
    pads = final[(final[:, 2] < TIP) & (final[:, 2] > TIP - 2 * TIPS), 1]
    assert pads.max() + pads.min() == pytest.approx(0, abs=3e-4)


def test_a_wedge_turns_so_that_one_pad_lies_along_it():
    """Narrowest is not where the pads are along the middle of the wedge alone: turned either way it is wider."""
    x, z = (one.ravel() for one in np.meshgrid(np.linspace(-0.01, 0.01, 5), np.linspace(-0.06, 0.06, 241)))
    wedge = np.concatenate([np.stack([x, side * (0.004 + 0.1 * z), z], axis=1) for side in (-1, 1)])
    angle, _ = flush_turn(wedge, TIP, PIVOT)

    def width(turn):
        seen = turned(wedge, np.degrees(turn))
        return np.ptp(seen[(seen[:, 2] < TIP) & (seen[:, 2] > TIP - 2 * TIPS), 1])

    assert width(angle) < min(width(angle + 0.05), width(angle - 0.05)) + 1e-9


def test_with_nothing_between_the_pads_nothing_turns():
    assert flush_turn(np.array([[0.5, 0.0, 0.0]]), TIP, PIVOT) == (0.0, 0.0)
