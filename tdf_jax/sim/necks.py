"""Necks: how deep flat pads hold a neck from its end and how far they are opened for it, and a neck in a cloud."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.optimize import least_squares

from tdf_jax.sim.fingers import Fingers
from tdf_jax.sim.pads import TIPS, flush_turn, turned_about_approach

CLEARANCE, LEAST_CLEARANCE = 0.010, 0.005  # metres between each finger and a neck, whose middle the cloud shows well
DEPTHS = (0.012, 0.049)  # metres from the end of the neck to the tips; the palm is 0.055 m behind them
LEVEL_STEP = 0.001  # metres between levels at which a neck is measured
TOUCHED = 0.0003  # metres: pads touch where the width is the largest between them, up to this
STEADY = np.radians(1)  # a neck that closing pads turn by so much is held half as well as one that stays
# Metres from the tips within which pads slide off a slope, and the share that a grasp is worth there.
EDGE, AT_EDGE = 0.005, 0.3
STEEP = 0.4  # radius over length of a slope on which the tips do not hold at all
NEAR = 0.020  # metres between pads and centre of mass, below which nearer is no better
RECESS = 0.003  # metres by which the fingers are further apart behind the pads
# In a cloud, a neck is round about an axis to this, metres, in the median; its radius is linear between levels so far
# apart. As many points are needed, and a span along the axis, metres.
ROUND_TO, KNOTS, LEAST, SPREAD = 0.001, 0.004, 16, 0.006
NOISE = 0.001  # metres; points further from a neck count less
STEEPEST, FARTHEST = np.radians(20), 0.015  # largest turn onto the axis, radians, and movement to it, metres
# Metres beyond the tips up to which a neck is sought: descriptors know its axis better than the height on it.
BEYOND = (0.02, 0.004)
GAP = 0.008  # metres along a neck without points, beyond which is something else
# Points of the inside of a hollow neck have others outside of them, on both sides along the axis, where those of a
# neck above a shoulder have them on one: further from the axis by this, and near the line outwards, across and along
# the axis, metres.
OUTSIDE, ACROSS, LEVEL = 0.0015, 0.006, 0.012
SHOULDER = 1.4  # points further out than this many medians of the radius are of a shoulder
FINE, SMOOTH = 0.003, 0.2  # metres between the knots of a neck's radii, and the weight of their bends
UNSURE, WORST = 2, 1e-4  # levels by which the depth of a neck in a cloud may be off; score where pads cannot hold
ALONG, WORTH = 0.04, 0.03  # metres: largest movement along a neck, and the one for which pads must hold e times better
# Sine of the tilt of a neck from which on the turn about it matters, and turns about the best one, radians.
TILTED, OFF_PLANE = 0.02, tuple(np.radians([0.0, 5.0, -5.0]))


class Hold(NamedTuple):
    """How pads hold a neck.

    Attributes:
        depth: distance from the end of the neck to the tips, metres.
        width: width of what the pads touch, metres.
        opening: opening of the fingers before they close, metres.
        score: how well they hold it; only the order means something.
    """

    depth: float
    width: float
    opening: float
    score: float


def neck_holds(
    levels: Float[np.ndarray, " levels"], widths: Float[np.ndarray, " levels"], centre: float, widest: float
) -> list[Hold]:
    """The depths at which pads can hold a neck.

    Closing pads turn a neck until it is narrowest between them: a cone lies flush with one of them, and a bottle that
    is held at a ring turns until something beside the ring touches too. A depth is better where that turn is small,
    where the pads are near the centre of mass, and where their tips do not slide off a slope. Depths are exact to some
    levels only, so a score is the geometric mean over `UNSURE` levels either way.

    Args:
        levels: distances from the end of the neck, (levels,), metres, `LEVEL_STEP` apart.
        widths: widths of the object there, (levels,), metres.
        centre: distance of its centre of mass from the end of the neck, metres.
        widest: the widest opening of the gripper, metres.
    """
    holds, scores = {}, np.full(len(levels) + 2 * UNSURE, WORST)
    for tips in np.flatnonzero(levels >= DEPTHS[0]):
        depth, inserted = levels[tips], widths[: tips + 1]
        pads = levels[: tips + 1] > depth - 2 * TIPS
        width = float(inserted[pads].max())
        clearance = min(CLEARANCE, (widest - float(inserted.max())) / 2)
        if clearance < LEAST_CLEARANCE or inserted.max() > width + RECESS:
            continue
        sides = np.concatenate([inserted, -inserted]) / 2
        section = np.column_stack([np.zeros(len(sides)), sides, np.tile(levels[: tips + 1], 2)])
        turn, _ = flush_turn(section, depth + LEVEL_STEP / 2, depth - TIPS)
        touching = float(levels[: tips + 1][pads & (inserted > width - TOUCHED)].mean())
        score = 1 / (1 + abs(turn / STEADY) ** 3) / max(abs(touching - centre), NEAR)
        if depth - touching < EDGE:
            slope = float(inserted[-1] - inserted[max(0, tips - 3)]) / (6 * LEVEL_STEP)
            score *= AT_EDGE * min(max(1 - slope / STEEP, 0.01), 1)
        scores[tips + UNSURE] = max(score, WORST)
        holds[tips] = Hold(float(depth), width, float(inserted.max()) + 2 * clearance, 0.0)
    means = np.exp(np.lib.stride_tricks.sliding_window_view(np.log(scores), 2 * UNSURE + 1).mean(axis=1))
    return [one._replace(score=float(means[tips])) for tips, one in holds.items()]


def neck_grasps(
    T: Float[np.ndarray, "4 4"], points: Float[np.ndarray, "points 3"], opening: float, fingers: Fingers
) -> list[tuple[Float[np.ndarray, "4 4"], float]]:
    """Grasps along the axis of the round neck between the fingers, as deep as pads hold best.

    Args:
        T: pose of the gripper's frame, 4x4, metres, world frame.
        points: cloud of the object, (points, 3), metres, world frame.
        opening: opening of the fingers before they close, metres, such as the demonstrated one.
        fingers: how the gripper answers to commands.

    Returns:
        Poses and openings, metres, the best first; several of a tilted neck, turned about it. None if there is no neck.
    """
    held = None
    for _ in range(2):  # again at the depth that was found, where the axis is measured
        tip = fingers.tip(max(opening - 2 * CLEARANCE, 0.0))
        found = [_along_neck(T, points, fingers.widest, tip, beyond) for beyond in BEYOND]
        aligned, misfit = min(found, key=lambda one: one[1])
        if not np.isfinite(misfit):
            break
        deepened = _deepened(aligned, points, tip, fingers)
        if deepened is None:
            break
        T, opening = held = deepened
    return [] if held is None else [(turned, opening) for turned in _about_neck(T)]


def _deepened(T, points, tip: float, fingers: Fingers) -> tuple[np.ndarray, float] | None:
    """A grasp along the axis of a neck, moved along it to where pads hold best, and the opening there."""
    x, y, z = ((points - T[:3, 3]) @ T[:3, :3]).T
    along = np.sort(z[np.hypot(x, y) < fingers.widest / 2])
    ends = np.flatnonzero((np.diff(along) > GAP) & (along[:-1] < tip))
    end = float(along[ends[-1] + 1 if len(ends) else 0])
    levels = np.arange(LEVEL_STEP, DEPTHS[1], LEVEL_STEP)
    outside = _outside(x, y, z, end + DEPTHS[1])
    widths = 2 * _profile(z[outside] - end, np.hypot(x, y)[outside], levels)
    holds = neck_holds(levels, widths, float(z.mean()) - end, fingers.widest)
    moves = [end + one.depth - fingers.tip(one.width) for one in holds]
    reached = [number for number, move in enumerate(moves) if abs(move) < ALONG]
    if not reached:
        return None
    best = max(reached, key=lambda number: holds[number].score * np.exp(-abs(moves[number]) / WORTH))
    T = T.copy()
    T[:3, 3] += moves[best] * T[:3, 2]
    return T, holds[best].opening


def _outside(x, y, z, end: float) -> np.ndarray:
    """Which points up to `end` along the axis, metres, have none outside of them; the others count."""
    kept, near = np.ones(len(z), bool), np.flatnonzero(z < end)
    x, y, z = x[near], y[near], z[near]
    radii = np.maximum(np.hypot(x, y), 1e-9)
    outwards = (np.outer(x, x) + np.outer(y, y)) / radii[:, None]  # row: along the line outwards through a point
    across = np.abs(np.outer(x, y) - np.outer(y, x)) / radii[:, None]
    covers, along = (outwards > radii[:, None] + OUTSIDE) & (across < ACROSS), z - z[:, None]
    sides = [(covers & (np.abs(along) < LEVEL) & (sign * along >= 0)).any(axis=1) for sign in (1, -1)]
    kept[near] = ~(sides[0] & sides[1])
    return kept


def _about_neck(T) -> list[np.ndarray]:
    """A grasp, turned about its approach to where what it holds swings least, the best first."""
    along, closing = T[2, 0], T[2, 1]  # the vertical, in the gripper's frame
    if np.hypot(along, closing) < TILTED:
        return [T]
    plane = np.arctan2(-along, closing)  # from the closing direction
    plane -= np.pi * np.round(plane / np.pi)  # the same gripper, half a turn about
    return [turned_about_approach(T, angle) for angle in plane + np.array(OFF_PLANE)]


def _profile(heights, radii, levels) -> np.ndarray:
    """Radii at levels of a round body, linear between knots `FINE` metres apart; points off it count little."""
    knots = np.arange(0.0, levels[-1] + FINE, FINE)
    inside = (heights > -FINE) & (heights < knots[-1])
    heights, radii = heights[inside], radii[inside]
    rows = np.stack([np.interp(heights, knots, row) for row in np.eye(len(knots))], axis=1)
    bend = SMOOTH * np.diff(np.eye(len(knots)), n=2, axis=0)
    weights, fit = np.ones(len(radii)), np.zeros(len(knots))
    for _ in range(10):
        weighted = np.concatenate([weights[:, None] * rows, bend])
        values = np.concatenate([weights * radii, np.zeros(len(bend))])
        fit = np.linalg.lstsq(weighted, values, rcond=None)[0]
        weights = np.sqrt(1 / np.maximum(np.abs(radii - rows @ fit), NOISE / 4))
        weights /= weights.max()
    return np.interp(levels, knots, fit)


def _along_neck(T, points, widest: float, tip: float, beyond: float):
    """Turn and move a grasp so that its approach is the axis of a round neck, and the misfit; inf if there is none."""
    last = np.inf
    for _ in range(2):
        x, y, z = ((points - T[:3, 3]) @ T[:3, :3]).T
        inside = (np.hypot(x, y) < widest / 2) & (z > tip - 2 * TIPS) & (z < tip + beyond)
        if inside.sum() < LEAST:
            break
        x, y, z = x[inside], y[inside], z[inside]
        middle = (x.mean(), y.mean()) if np.isinf(last) else (0.0, 0.0)  # points of a shoulder are on one side
        outside = _outside(x - middle[0], y - middle[1], z, np.inf)
        x, y, z = x[outside], y[outside], z[outside]
        radii = np.hypot(x - middle[0], y - middle[1])
        slim = radii < SHOULDER * np.median(radii)
        x, y, z = x[slim], y[slim], z[slim]
        if len(y) < LEAST or np.ptp(z) < SPREAD:
            break
        centre = float(z.mean())
        at, axis, misfit = _axis(x, y, z - centre)
        if misfit > ROUND_TO or axis[2] < np.cos(STEEPEST) or np.hypot(*at) > FARTHEST:
            break
        across = np.cross(axis, (1.0, 0.0, 0.0))
        across /= np.linalg.norm(across)
        turn = np.eye(4)
        turn[:3, :3] = np.stack([np.cross(across, axis), across, axis], axis=1)
        turn[:3, 3] = np.array([*at, centre]) - turn[:3, :3] @ (0.0, 0.0, centre)
        T, last = T @ turn, misfit
    return T, last


def _axis(x, y, z) -> tuple[np.ndarray, np.ndarray, float]:
    """Where the axis of a round body is at z = 0, (2,), its direction, (3,), and the median distance of its points."""
    levels = max(2, int(np.ptp(z) / KNOTS) + 1)
    knots = np.linspace(z.min(), z.max(), levels)
    share = np.stack([np.interp(z, knots, row) for row in np.eye(levels)], axis=1)

    def errors(fit):
        return np.hypot(x - fit[0] - fit[1] * z, y - fit[2] - fit[3] * z) - share @ fit[4:]

    start = np.concatenate([[x.mean(), 0, y.mean(), 0], np.full(levels, np.hypot(x, y).mean())])
    fit = least_squares(errors, start, loss="soft_l1", f_scale=NOISE).x
    fit = least_squares(errors, fit, loss="cauchy", f_scale=NOISE / 4).x  # points of the end are on no wall
    axis = np.array([fit[1], fit[3], 1.0])
    return fit[[0, 2]], axis / np.linalg.norm(axis), float(np.median(np.abs(errors(fit))))
