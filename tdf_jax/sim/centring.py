"""Centring of a grasp on what is between the fingers: the middle and the slope of a wall or a neck, by the cloud."""

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from tdf_jax.sim.grasps import NECK_CLEARANCE, TIPS
from tdf_jax.sim.robot import Fingers

BESIDE = 0.014  # metres, half width of the region between the fingers, along x
BEHIND, BEYOND = 0.038, 0.004  # metres behind and beyond the tips of the pads, along the approach
LEAST = 8  # points; with fewer the grasp stays as it is
STEEPEST = np.radians(40)  # a steeper wall is another surface
LONGEST = 0.015  # metres, largest movement along the closing direction
ROUNDS = 4
MISFIT = 0.0025  # metres, of points from two parallel lines
SPREAD = 0.006  # metres along the approach that the points must span for a slope


def centred(
    T_world_grip: Float[np.ndarray, "4 4"],
    points: Float[np.ndarray, "points 3"],
    opening: float,
    fingers: Fingers,
) -> Float[np.ndarray, "4 4"]:
    """Move a grasp along its closing direction to the middle of what is between the fingers, and turn it along a wall.

    Pads press flat on a wall that is parallel to them; on a sloping one they touch at an edge, and the object turns in
    the hand. The turn is about the x axis, through the middle of what is between the fingers.

    Args:
        T_world_grip: pose of the gripper's frame, 4x4, metres, world frame.
        points: cloud of the object, (points, 3), metres, world frame.
        opening: opening of the fingers before they close, metres.
        fingers: how the gripper answers to commands.

    Returns:
        The pose, 4x4; as it was if too few points are between the fingers.
    """
    T = np.array(T_world_grip, float)
    tips = fingers.depth(0.0) + TIPS
    shorter = fingers.tip(max(opening - 2 * NECK_CLEARANCE, 0.0))
    for _ in range(ROUNDS):
        x, y, z = _local(T, points)
        between = (np.abs(x) < BESIDE) & (np.abs(y) < opening / 2) & (z > tips - BEHIND) & (z < tips + BEYOND)
        if between.sum() < LEAST:
            return T
        # Below a neck is the shoulder, which is no wall: then what is between the pads alone counts.
        pads = between & (z < shorter + BEYOND)
        if pads.sum() >= LEAST and _misfit(y[between], z[between]) > MISFIT:
            between = pads
        y, z = y[between], z[between]
        slope, middle = _line(y, z)
        angle = float(np.clip(np.arctan(slope), -STEEPEST, STEEPEST))
        shift = float(np.clip(middle + slope * z.mean(), -LONGEST, LONGEST))
        turn = np.eye(4)
        turn[:3, :3] = Rotation.from_euler("x", -angle).as_matrix()
        pivot = np.array([0.0, shift, z.mean()])
        turn[:3, 3] = pivot - turn[:3, :3] @ [0.0, 0.0, z.mean()]
        T = T @ turn
    return T


def _local(T, points):
    return ((np.asarray(points, float) - T[:3, 3]) @ T[:3, :3]).T


def _misfit(y, z) -> float:
    """Root of the mean squared distance, metres, of points from two lines parallel to their middle line."""
    slope, offset = _line(y, z)
    half = np.abs(y - offset - slope * z)
    return float(half.std())


def _line(y, z) -> tuple[float, float]:
    """Slope and offset of the middle line y(z) between both surfaces: y is the same on both but for the side."""
    if np.ptp(z) < SPREAD:
        return 0.0, float((y.min() + y.max()) / 2)
    # Two parallel lines: each point is assigned to the nearer one, from the two halves about the common line.
    slope, offset = np.polyfit(z, y, 1)
    for _ in range(5):
        above = y > offset + slope * z
        if above.sum() < 3 or (~above).sum() < 3:
            break
        side = np.where(above, 1.0, -1.0)
        slope, offset, _ = np.linalg.lstsq(np.stack([z, np.ones_like(z), side], axis=1), y, rcond=None)[0]
    return float(slope), float(offset)
