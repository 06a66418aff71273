"""Grasps of demonstrations: poses of a parallel gripper on generated objects that hold in physics."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from tdf_jax._internal.errors import InputError
from tdf_jax.geometry.sampling import sample_surface
from tdf_jax.geometry.symmetry import ROUND
from tdf_jax.shapes import Shape
from tdf_jax.sim.fingers import Fingers
from tdf_jax.sim.necks import DEPTHS, LEVEL_STEP, neck_holds
from tdf_jax.sim.pads import HALF_PAD, flush_turn, turned_about_x

CLEARANCE = 0.018  # metres between each finger and the wall before closing
LEAST_CLEARANCE = 0.002  # metres, where the fingers do not open so far
RIM_DEPTH = 0.030  # metres from the rim down the wall to the tips of the fingers
MOST_DEPTH = 0.6  # of the height of a low bowl
DIRECTIONS, ROUND_TOLERANCE = 24, 0.0015  # about the axis, and difference of the widths along them, metres, when round
# Where a wall's middle is measured below the rim, metres: the gripper lies along the line through both.
WALL_LEVELS = (0.004, 0.025)
WALL_SEARCH = np.linspace(-0.07, 0.025, 951)  # metres along the outward direction
SURFACE = 200_000  # points of the surface, of which some hundreds are between the pads


class Grip(NamedTuple):
    """A grasp of an object.

    Attributes:
        T_object_grip: pose of the gripper's frame, 4x4, metres, object frame.
        width: width of what is held, metres.
        opening: opening of the fingers before they close, metres.
        fold: symmetry of the grasp about the object's z axis, see `tdf_jax.geometry.symmetry`: `ROUND` if every turn
            about it is the same grasp, 1 if only this one is demonstrated.
    """

    T_object_grip: Float[np.ndarray, "4 4"]
    width: float
    opening: float
    fold: int = 1


def grip_of(shape: Shape, fingers: Fingers) -> Grip:
    """The demonstrated grasp of a generated object: a mug or a bowl at the wall of the rim, a bottle at the neck.

    A mug is held opposite to its handle, which is then free for a peg. The gripper closes across the wall, turned so
    that the pads lie flush with it.

    Args:
        shape: the object.
        fingers: how the gripper answers to commands: the pads move along the approach as it closes.

    Raises:
        InputError: there is no grasp of this category.
    """
    if shape.category in ("mug", "bowl"):
        return _rim_grip(shape, fingers)
    if shape.category == "bottle":
        return _neck_grip(shape, fingers)
    raise InputError(f"grip_of(): there is no grasp of a {shape.category}; expected a mug, a bowl or a bottle")


def _rim_grip(shape: Shape, fingers: Fingers) -> Grip:
    rim = shape.frames["rim"]
    outward, up = rim[:3, 0], rim[:3, 2]
    depth = min(RIM_DEPTH, MOST_DEPTH * shape.height)
    levels = [min(level, 0.8 * depth) for level in WALL_LEVELS]
    walls = [_wall(shape, rim, level) for level in levels]
    (upper, width), (lower, lower_width) = walls
    down = (lower - upper) / np.linalg.norm(lower - upper)
    across = outward - (outward @ down) * down
    across /= np.linalg.norm(across)
    T = np.eye(4)
    T[:3, :3] = np.stack([np.cross(across, down), across, down], axis=1)
    width = max(width, lower_width)
    if width + 2 * LEAST_CLEARANCE > fingers.widest:
        raise InputError(
            f"grip_of(): the wall of the {shape.category} is {1e3 * width:.1f} mm thick, and the fingers open to "
            f"{1e3 * fingers.widest:.1f} mm; expected {1e3 * LEAST_CLEARANCE:.0f} mm more on each side. Take a gripper "
            "that opens wider"
        )
    top = upper - down * (levels[0] / max(float(-down @ up), 0.5))
    tip = fingers.tip(width)
    T[:3, 3] = top + down * (depth - tip)
    opening = min(width + 2 * CLEARANCE, fingers.widest)
    points = (sample_surface(shape.mesh, SURFACE, np.random.default_rng(0)) - T[:3, 3]) @ T[:3, :3]
    pivot = tip - depth / 2
    angle, shift = flush_turn(points[np.abs(points[:, 1]) < opening / 2], tip, pivot)
    return Grip(turned_about_x(T, angle, pivot, shift), width, opening)


def _wall(shape: Shape, rim, level: float) -> tuple[np.ndarray, float]:
    """Middle and thickness of the wall at a level below the rim."""
    line = rim[:3, 3] + WALL_SEARCH[:, None] * rim[:3, 0] - level * rim[:3, 2]
    inside = np.flatnonzero(shape.contains(line))
    if not len(inside):
        raise InputError(f"grip_of(): the {shape.category} has no wall {1e3 * level:.0f} mm below its rim")
    runs = np.split(inside, np.flatnonzero(np.diff(inside) > 1) + 1)
    run = max(runs, key=lambda indices: WALL_SEARCH[indices[-1]])  # the outermost
    return (line[run[0]] + line[run[-1]]) / 2, float(WALL_SEARCH[run[-1]] - WALL_SEARCH[run[0]])


def _neck_grip(shape: Shape, fingers: Fingers) -> Grip:
    """From above, closing along the y axis, which is any direction where the neck and all above it are round.

    Of all depths the one is taken at which they hold best; see `tdf_jax.sim.necks`.
    """
    mesh = shape.mesh
    top, centre = float(mesh.bounds[1, 2]), float(mesh.center_mass[2])
    levels = np.arange(LEVEL_STEP, min(DEPTHS[1], 0.8 * shape.height), LEVEL_STEP)  # below the top
    widths, spreads = _widths(mesh, top - levels)
    holds = neck_holds(levels, widths, top - centre, fingers.widest)
    if not holds:
        raise InputError(f"grip_of(): the neck of the bottle is wider than the gripper, {1e3 * fingers.widest:.0f} mm")
    is_round, best = max(
        ((bool((spreads[levels <= one.depth] < ROUND_TOLERANCE).all()), one) for one in holds),
        key=lambda pair: (pair[0], pair[1].score),
    )
    T = np.diag([-1.0, 1.0, -1.0, 1.0])
    T[2, 3] = top - (best.depth - fingers.tip(best.width))
    return Grip(T, best.width, best.opening, ROUND if is_round else 1)


def _widths(mesh, heights) -> tuple[np.ndarray, np.ndarray]:
    """Widths of a mesh along y between the pads at heights, and how much those about the z axis differ, metres."""
    ends = np.asarray(mesh.vertices)[np.asarray(mesh.edges_unique)]
    low, high = np.sort(ends[:, :, 2], axis=1).T
    widths, spreads = np.zeros(len(heights)), np.zeros(len(heights))
    turns = np.linspace(0, 2 * np.pi, DIRECTIONS, endpoint=False)
    directions = np.stack([np.cos(turns), np.sin(turns)])
    for number, height in enumerate(heights):
        start, end = ends[(low <= height) & (high > height)].transpose(1, 0, 2)
        share = (height - start[:, 2:]) / (end[:, 2:] - start[:, 2:])
        section = (start + share * (end - start))[:, :2]
        between = section[np.abs(section[:, 0]) < HALF_PAD]
        if len(between):
            widths[number] = 2 * np.abs(between[:, 1]).max()
            spreads[number] = 2 * np.ptp((section @ directions).max(axis=0))
    return widths, spreads
