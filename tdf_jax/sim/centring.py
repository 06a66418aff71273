"""Centring of a grasp on what is between the fingers: the middle and the slope of a wall, or a neck, by the cloud."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from tdf_jax.sim import necks
from tdf_jax.sim.fingers import Fingers
from tdf_jax.sim.grasps import CLEARANCE, MOST_DEPTH
from tdf_jax.sim.pads import HALF_PAD, TIPS, flush_turn, turned_about_approach, turned_about_x

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
FLUSH, ALONG = 0.005, 0.02  # radians; smaller turns about x and about the approach end the search
WIDEST_TWIST = np.radians(30)  # about the approach; a wall that is turned further is another surface
FINGER, CLOSE_BY, FARTHEST = 0.010, 0.001, 0.015  # metres: thickness of a finger, clearance, and largest withdrawal
LEAST_DEPTH = 0.016  # metres; a cloud that is thinner than its object, such as that of one camera, asks for no less


class Wall(NamedTuple):
    """A wall that is fitted to the points between the fingers.

    Attributes:
        surfaces: points of both of its surfaces, (points, 3), metres, in the gripper's frame.
        thickness: its thickness, metres.
        twist: turn about the approach after which the closing direction is along its normal, radians.
    """

    surfaces: Float[np.ndarray, "points 3"]
    thickness: float
    twist: float


class Centred(NamedTuple):
    """A grasp that is centred on a cloud.

    Attributes:
        T_world_grip: pose of the gripper's frame, 4x4, metres, world frame.
        opening: opening of the fingers before they close, metres.
    """

    T_world_grip: Float[np.ndarray, "4 4"]
    opening: float


def centred(
    T_world_grip: Float[np.ndarray, "4 4"],
    points: Float[np.ndarray, "points 3"],
    opening: float,
    fingers: Fingers,
) -> list[Centred]:
    """Centre a grasp on what is between the fingers, and open them for it.

    A wall: pads press flat on one that is parallel to them; on a sloping one they touch at an edge, and the object
    turns in the hand. So the grasp moves along its closing direction to the middle, and turns about its x axis. A wall
    may bend: the last turn is the one at which it is narrowest between the pads; see `tdf_jax.sim.pads.flush_turn`.
    Towards its floor a low bowl bends most, so the tips go no deeper below its rim than a demonstration's do, see
    `tdf_jax.sim.grasps.grip_of`.

    A neck, round about an axis along the approach: the gripper comes along the axis, as deep as pads hold best (see
    `tdf_jax.sim.necks`), and where the neck is tilted it closes in the vertical plane of the axis, where what it holds
    swings least.

    Args:
        T_world_grip: pose of the gripper's frame, 4x4, metres, world frame.
        points: cloud of the object, (points, 3), metres, world frame.
        opening: opening of the fingers before they close, metres, such as the demonstrated one.
        fingers: how the gripper answers to commands.

    Returns:
        The grasp; of a tilted neck also others, turned about it, the best first. As it was if too few points are
        between the fingers.
    """
    T = np.array(T_world_grip, float)
    points = np.asarray(points, float)
    grasps = necks.neck_grasps(T, points, opening, fingers)
    if not grasps:
        grasps = [_on_rim(T, points, opening, fingers)]
    return [Centred(_withdrawn(T, points, gap, fingers.tip(gap)), gap) for T, gap in grasps]


def _on_rim(T, points, opening: float, fingers: Fingers) -> tuple[np.ndarray, float]:
    """A grasp on the wall between the fingers, not too deep below the rim of a low bowl, and the opening."""
    deepest = max(MOST_DEPTH * _thinnest(points), LEAST_DEPTH)
    for _ in range(ROUNDS):
        grasp, gap = _on_wall(T, points, opening, fingers)
        tip = fingers.tip(max(opening - 2 * CLEARANCE, 0.0))
        _, _, z = _between(grasp, points, HALF_PAD, opening, tip)
        excess = tip - float(z.min()) - deepest if len(z) else 0.0
        if excess <= CLOSE_BY:
            break
        T = T.copy()  # from the grasp as found: the one that is too deep was turned along another part of the wall
        T[:3, 3] -= excess * T[:3, 2]
    return grasp, gap


def _thinnest(points) -> float:
    """Extent of a cloud along the direction in which it varies least, metres: the height of a low bowl."""
    if len(points) < LEAST:
        return np.inf
    _, axes = np.linalg.eigh(np.cov(points.T))
    return float(np.ptp(points @ axes[:, 0]))


def _on_wall(T, points, opening: float, fingers: Fingers) -> tuple[np.ndarray, float]:
    """A grasp in the middle of the wall between the fingers and flush with it, and the opening."""
    tip = fingers.tip(max(opening - 2 * CLEARANCE, 0.0))  # as far as the fingers reach once they have closed
    flush = _along_wall(T, points, opening, tip)
    x, y, z = _between(flush, points, WALL_BESIDE, opening, tip)
    if len(y) >= LEAST_OF_WALL:
        wall = _wall(x, y, z, tip + BEYOND)
        if wall.thickness <= THICKEST:
            return flush, min(2 * float(np.abs(wall.surfaces[:, 1]).max()) + 2 * CLEARANCE, fingers.widest)
    _, y, _ = _between(T, points, HALF_PAD, fingers.widest, tip)
    if not len(y) or np.ptp(y) <= THICKEST:
        return flush, opening
    T = T.copy()  # a neck that is not round
    T[:3, 3] += np.clip((y.min() + y.max()) / 2, -LONGEST, LONGEST) * T[:3, 1]
    return T, min(float(np.ptp(y)) + 2 * necks.CLEARANCE, fingers.widest)


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
    x, y, z = ((points - T[:3, 3]) @ T[:3, :3]).T
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
    x, y, z = ((points - T[:3, 3]) @ T[:3, :3]).T
    inside = (np.abs(x) < beside) & (np.abs(y) < opening / 2) & (z > tip - 2 * TIPS) & (z < tip + BEYOND)
    return x[inside], y[inside], z[inside]


def _flush(T, points, opening: float, tip: float):
    """Turn a grasp to where the wall between the fingers is narrowest, along its normal, and to the middle there."""
    for _ in range(2 * ROUNDS):
        x, y, z = _between(T, points, WALL_BESIDE, opening, tip)
        if len(y) < LEAST_OF_WALL:
            return T
        wall = _wall(x, y, z, tip + BEYOND)
        if wall.thickness > THICKEST or abs(wall.twist) > WIDEST_TWIST:  # a neck, or another surface
            return T
        pivot = float(z.min() + tip) / 2
        angle, shift = flush_turn(wall.surfaces, tip, pivot)
        if abs(shift) > LONGEST / 3:  # the wall was in the middle already: the fit is of something else
            return T
        T = turned_about_approach(turned_about_x(T, angle, pivot, shift), wall.twist)
        if abs(angle) < FLUSH and abs(wall.twist) < ALONG:
            break
    return T


def _wall(x, y, z, end: float) -> Wall:
    """A wall, as far along the approach as `end`, metres.

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
    return Wall(np.concatenate(surfaces), 2 * abs(float(half)), float(np.arctan(fit[1])))


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
