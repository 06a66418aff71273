"""Grasps that a demonstration shows: poses of a parallel gripper on generated objects that hold in physics."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from tdf_jax._internal.errors import InputError
from tdf_jax.shapes import Shape
from tdf_jax.sim.robot import Fingers

CLEARANCE = 0.018  # metres between each finger and the wall before closing
NECK_CLEARANCE = 0.010  # of a neck, whose middle the cloud shows well
RIM_DEPTH = 0.030  # metres from the rim down the wall to the tips of the fingers
MOST_DEPTH = 0.6  # of the height of a low bowl
NECK_DEPTHS = (0.022, 0.070)  # metres from a bottle's top to the tips
LEVEL, STEP = 0.0015, 0.002  # metres: pads touch where the width is the largest between them, up to `LEVEL`
TIPS = 0.0187  # metres from the middle of the pads to their tips
# Where a wall's middle is measured below the rim, metres: the gripper lies along the line through both.
WALL_LEVELS = (0.004, 0.025)
WALL_SEARCH = np.linspace(-0.07, 0.025, 951)  # metres along the outward direction


class Grip(NamedTuple):
    """A grasp of an object.

    Attributes:
        T_object_grip: pose of the gripper's frame, 4x4, metres, object frame.
        width: width of what is held, metres.
        opening: opening of the fingers before they close, metres.
    """

    T_object_grip: Float[np.ndarray, "4 4"]
    width: float
    opening: float


def grip_of(shape: Shape, fingers: Fingers) -> Grip:
    """The demonstrated grasp of a generated object: a mug or a bowl at the wall of the rim, a bottle at the neck.

    A mug is held opposite to its handle, which is then free for a peg. The gripper lies along the wall, closes across
    it, and its pads are as deep as the tips allow.

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
    top = upper - down * (levels[0] / max(float(-down @ up), 0.5))
    T[:3, 3] = top + down * (depth - TIPS - fingers.depth(width))
    return Grip(T, width, min(width + 2 * CLEARANCE, fingers.widest))


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
    """From above, closing along the y axis; the axis of a round bottle leaves the turn about it free.

    The tips are where the pads touch along the greatest length: a bottle that is held at one point swings.
    """
    top = float(shape.mesh.bounds[1, 2])
    below = np.arange(0.001, NECK_DEPTHS[1], STEP)
    widths = np.array([_width(shape, top - level) for level in below])
    widest = fingers.widest - 2 * NECK_CLEARANCE
    depths = [depth for depth in np.arange(*NECK_DEPTHS, STEP) if widths[below <= depth].max() <= widest]
    lengths = []
    for depth in depths:
        between = widths[(below <= depth) & (below > depth - 2 * TIPS)]
        lengths.append(int((between > between.max() - LEVEL).sum()))
    if not depths:
        raise InputError(f"grip_of(): the neck of the bottle is wider than the gripper, {1e3 * fingers.widest:.0f} mm")
    depth = depths[int(np.argmax(lengths))]
    width = float(widths[(below <= depth) & (below > depth - 2 * TIPS)].max())
    T = np.diag([-1.0, 1.0, -1.0, 1.0])
    T[2, 3] = top - (depth - TIPS - fingers.depth(width))
    return Grip(T, width, min(float(widths[below <= depth].max()) + 2 * NECK_CLEARANCE, fingers.widest))


def _width(shape: Shape, level: float) -> float:
    """Width of an object along y at a height, metres."""
    y = np.linspace(0, 0.06, 301)
    inside = np.flatnonzero(shape.contains(np.stack([np.zeros_like(y), y, np.full_like(y, level)], axis=1)))
    return 2 * float(y[inside[-1]]) if len(inside) else 0.0
