"""Centring of a grasp on what is between the fingers: the middle and the slope of a wall or a neck, by the cloud."""

import numpy as np
from jaxtyping import Float
from scipy.optimize import least_squares

from tdf_jax.sim.grasps import NECK_CLEARANCE
from tdf_jax.sim.pads import HALF_PAD, TIPS, flush_turn, turned_about_x
from tdf_jax.sim.robot import Fingers

BESIDE = 0.014  # metres, half width of the region between the fingers, along x
BEYOND = 0.004  # metres beyond the tips of the pads, along the approach
LEAST = 8  # points; with fewer the grasp stays as it is
STEEPEST = np.radians(40)  # a steeper wall is another surface
LONGEST = 0.015  # metres, largest movement along the closing direction
ROUNDS = 4
SPREAD = 0.006  # metres along the approach that the points must span for a slope
# A wall is fitted over this half width, metres, where it is no thicker than this; its two surfaces have common
# curvatures. Points of its rim are on neither: beyond this many medians and metres they are left out.
WALL_BESIDE, THICKEST = 0.022, 0.018
OUTLIERS, NEAR = 2.5, 0.0004
LEAST_OF_WALL, LEAST_OF_SIDE = 10, 6  # points for a fit, and on both sides for a taper
GRID = 0.001  # metres between points of the fitted surfaces
FLUSH = 0.005  # radians; a smaller turn ends the search
# A neck is round about an axis to this, metres, in the median; its radius is linear between levels so far apart.
ROUND_TO, KNOTS, LEAST_OF_NECK = 0.001, 0.006, 16
NOISE = 0.001  # metres; points further from a neck count less
STEEPEST_NECK = np.radians(20)
FINGER, CLOSE_BY, FARTHEST = 0.010, 0.001, 0.015  # metres: thickness of a finger, clearance, and largest withdrawal


def centred(
    T_world_grip: Float[np.ndarray, "4 4"],
    points: Float[np.ndarray, "points 3"],
    opening: float,
    fingers: Fingers,
) -> Float[np.ndarray, "4 4"]:
    """Move a grasp along its closing direction to the middle of what is between the fingers, and turn it along a wall.

    Pads press flat on a wall that is parallel to them; on a sloping one they touch at an edge, and the object turns in
    the hand. The turn is about the x axis, through the middle of what is between the fingers. Where that is round, such
    as a neck, its axis is found. A wall may bend: the last turn is the one at which it is narrowest between the pads;
    see `tdf_jax.sim.pads.flush_turn`.

    Args:
        T_world_grip: pose of the gripper's frame, 4x4, metres, world frame.
        points: cloud of the object, (points, 3), metres, world frame.
        opening: opening of the fingers before they close, metres.
        fingers: how the gripper answers to commands.

    Returns:
        The pose, 4x4; as it was if too few points are between the fingers.
    """
    T = np.array(T_world_grip, float)
    tip = fingers.tip(max(opening - 2 * NECK_CLEARANCE, 0.0))  # as far as the fingers reach once they have closed
    neck = _along_neck(T, points, opening, tip)
    if neck is None:
        neck = _along_wall(T, points, opening, tip)
    return _withdrawn(neck, points, opening, fingers.tip(opening))


def _along_wall(T, points, opening: float, tip: float):
    """Turn and move a grasp along the middle between the points on both sides."""
    T = T.copy()
    for _ in range(ROUNDS):
        _, y, z = _between(T, points, BESIDE, opening, tip)
        if len(y) < LEAST:
            return T
        slope, middle = _line(y, z)
        angle = float(np.clip(np.arctan(slope), -STEEPEST, STEEPEST))
        shift = float(np.clip(middle + slope * z.mean(), -LONGEST, LONGEST))
        T[:3, 3] += shift * T[:3, 1]
        T = turned_about_x(T, -angle, float(z.mean()), 0.0)
    return _flush(T, points, opening, tip)


def _withdrawn(T, points, opening: float, tip: float):
    """Move a grasp back along the approach until no point, such as one of a shoulder, is where the open fingers are."""
    x, y, z = ((np.asarray(points, float) - T[:3, 3]) @ T[:3, :3]).T
    y = np.abs(y) - opening / 2
    struck = (np.abs(x) < HALF_PAD) & (y > -CLOSE_BY) & (y < FINGER) & (z > tip - 2 * TIPS) & (z < tip + CLOSE_BY)
    back = tip + CLOSE_BY - float(z[struck].min()) if struck.any() else 0.0
    if not 0 < back < FARTHEST:  # further back it would be another grasp
        return T
    T = T.copy()
    T[:3, 3] -= back * T[:3, 2]
    return T


def _between(T, points, beside: float, opening: float, tip: float):
    """Coordinates x, y, z in the gripper's frame of the points between the fingers."""
    x, y, z = ((np.asarray(points, float) - T[:3, 3]) @ T[:3, :3]).T
    inside = (np.abs(x) < beside) & (np.abs(y) < opening / 2) & (z > tip - 2 * TIPS) & (z < tip + BEYOND)
    return x[inside], y[inside], z[inside]


def _along_neck(T, points, opening: float, tip: float):
    """Turn and move a grasp so that the axis of a round neck is in its xz plane; None if there is no neck."""
    for number in range(2):
        x, y, z = _between(T, points, opening / 2, opening, tip)
        inside = np.hypot(x, y) < opening / 2
        x, y, z = x[inside], y[inside], z[inside]
        if len(y) < LEAST_OF_NECK or np.ptp(z) < SPREAD:
            return None if number == 0 else T
        centre = float(z.mean())
        offset, slope, misfit = _axis(x, y, z - centre)
        angle = float(np.arctan(slope))
        if misfit > ROUND_TO or abs(angle) > STEEPEST_NECK or abs(offset) > LONGEST:
            return None if number == 0 else T
        T = T.copy()
        T[:3, 3] += offset * T[:3, 1]
        T = turned_about_x(T, -angle, centre, 0.0)
    return T


def _axis(x, y, z) -> tuple[float, float, float]:
    """Offset and slope of y(z) on the axis of a round body, and the median distance of its points, metres."""
    levels = max(2, int(np.ptp(z) / KNOTS) + 1)
    knots = np.linspace(z.min(), z.max(), levels)
    share = np.stack([np.interp(z, knots, row) for row in np.eye(levels)], axis=1)

    def errors(fit):
        return np.hypot(x - fit[0] - fit[1] * z, y - fit[2] - fit[3] * z) - share @ fit[4:]

    start = np.concatenate([[x.mean(), 0, y.mean(), 0], np.full(levels, np.hypot(x, y).mean())])
    fit = least_squares(errors, start, loss="soft_l1", f_scale=NOISE).x
    return float(fit[2]), float(fit[3]), float(np.median(np.abs(errors(fit))))


def _flush(T, points, opening: float, tip: float):
    """Turn a grasp to where the wall between the fingers is narrowest, and move it to the middle there."""
    for _ in range(ROUNDS):
        x, y, z = _between(T, points, WALL_BESIDE, opening, tip)
        if len(y) < LEAST_OF_WALL:
            return T
        surfaces, thickness = _wall(x, y, z, tip + BEYOND)
        if thickness > THICKEST:  # a neck
            return T
        pivot = float(z.min() + tip) / 2
        angle, shift = flush_turn(surfaces, tip, pivot)
        if abs(shift) > LONGEST / 3:  # the wall was in the middle already: the fit is of something else
            return T
        T = turned_about_x(T, angle, pivot, shift)
        if abs(angle) < FLUSH:
            break
    return T


def _wall(x, y, z, end: float) -> tuple[np.ndarray, float]:
    """Points of both surfaces of a wall, as far along the approach as `end`, and its thickness, metres.

    The middle y(x, z) is a polynomial of second degree, and half of the thickness one of first degree in z.
    """
    centre = float(z.mean())
    rows, keep = _monomials(x, z - centre), np.ones(len(y), bool)
    slope, offset = _line(y, z)
    side = np.where(y > offset + slope * z, 1.0, -1.0)
    for number in range(8):
        fewest = min(int((side[keep] > 0).sum()), int((side[keep] < 0).sum()))
        thickness = [side, side * (z - centre)][: 0 if fewest < 3 else 1 if fewest < LEAST_OF_SIDE else 2]
        columns = np.column_stack([rows, *thickness])
        fit = np.linalg.lstsq(columns[keep], y[keep], rcond=None)[0]
        above = np.where(y > rows @ fit[: rows.shape[1]], 1.0, -1.0)
        near = keep
        if thickness and number >= 2:
            errors = np.abs(y - columns @ fit)
            near = errors < max(OUTLIERS * float(np.median(errors[keep])), NEAR)
            near = near if near.sum() >= LEAST_OF_WALL else keep
        if number > 2 and (above == side).all() and (near == keep).all():
            break
        side, keep = above, near
    wide = np.linspace(-HALF_PAD, HALF_PAD, 5) * 0.999
    across, along = (one.ravel() for one in np.meshgrid(wide, np.arange(z.min(), max(end, z.max()), GRID)))
    middle = _monomials(across, along - centre) @ fit[: rows.shape[1]]
    half, taper = (*fit[rows.shape[1] :], 0.0, 0.0)[:2]
    half_there = np.maximum(half + taper * (along - centre), 0.0)
    surfaces = [np.column_stack([across, middle + sign * half_there, along]) for sign in (1, -1)]
    return np.concatenate(surfaces), 2 * abs(float(half))


def _monomials(x, z) -> np.ndarray:
    return np.column_stack([np.ones_like(x), x, z, x * x, z * z])


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
