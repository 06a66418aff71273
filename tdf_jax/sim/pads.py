"""Flat pads of a parallel gripper: the turn at which what they clamp lies flush with them."""

import numpy as np
from jaxtyping import Float

TIPS = 0.0187  # metres from the middle of the pads to their tips
HALF_PAD = 0.011  # metres, half the width of the pads
WIDEST_TURN, STEP = np.radians(15), np.radians(0.5)  # turns that are tried, either way


def flush_turn(points: Float[np.ndarray, "points 3"], tip: float, pivot: float) -> tuple[float, float]:
    """The turn of a gripper about its x axis at which two flat pads are nearest to each other, and their middle there.

    Closing pads turn what is between them until it is narrowest: where the middle of a wall bends, that is not where
    they are parallel to it. A grasp that is turned so from the start does not turn the object.

    Args:
        points: points of the surfaces that the pads meet on both sides, (points, 3), metres, in the gripper's frame.
        tip: tips of the pads along the approach, metres.
        pivot: where the axis of the turn is along the approach, metres; it is at y = 0.

    Returns:
        The turn, radians; 0 if no points are between the pads. And the middle between the pads along the closing
        direction after the turn, metres.
    """
    x, y, z = np.asarray(points, float).T
    y, z = y[np.abs(x) < HALF_PAD], z[np.abs(x) < HALF_PAD] - pivot
    angles = np.arange(-WIDEST_TURN, WIDEST_TURN + STEP / 2, STEP)
    best = (np.inf, 0.0, 0.0)
    for angle in sorted(angles, key=abs):  # of equal widths that of the smallest turn
        across, along = np.cos(angle) * y + np.sin(angle) * z, np.cos(angle) * z - np.sin(angle) * y + pivot
        pads = across[(along < tip) & (along > tip - 2 * TIPS)]
        if len(pads):
            best = min(
                best, (float(np.ptp(pads)), float(angle), float(pads.min() + pads.max()) / 2), key=lambda one: one[0]
            )
    return best[1:]


def turned_about_x(T: Float[np.ndarray, "4 4"], angle: float, pivot: float, shift: float) -> Float[np.ndarray, "4 4"]:
    """A gripper's frame, turned about its x axis and then moved along its closing direction.

    Args:
        T: pose of the gripper's frame, 4x4, metres.
        angle: the turn, radians.
        pivot: where the axis of the turn is along the approach, metres.
        shift: movement along the closing direction after the turn, metres.
    """
    turn, (cos, sin) = np.eye(4), (np.cos(angle), np.sin(angle))
    turn[1:3, 1:3] = [[cos, -sin], [sin, cos]]
    turn[:3, 3] = np.array([0.0, 0.0, pivot]) - turn[:3, :3] @ [0.0, -shift, pivot]
    return T @ turn


def turned_about_approach(T: Float[np.ndarray, "4 4"], angle: float) -> Float[np.ndarray, "4 4"]:
    """A gripper's frame, turned about its approach.

    Args:
        T: pose of the gripper's frame, 4x4, metres.
        angle: the turn, radians.
    """
    turn, (cos, sin) = np.eye(4), (np.cos(angle), np.sin(angle))
    turn[:2, :2] = [[cos, -sin], [sin, cos]]
    return T @ turn
