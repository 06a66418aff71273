"""Convex parts of generated objects, from their construction, as collision shapes of physics engines.

Bodies are cut at levels, and a wall around a hollow into sectors as well. The corners of a part are placed so that the
error of its flat faces is the same on both sides of the true surface, which needs the fewest parts.
"""

from collections.abc import Iterator

import numpy as np
from jaxtyping import Float

from tdf_jax._internal.errors import InputError
from tdf_jax.shapes.container import Container
from tdf_jax.shapes.frusta import frusta_of
from tdf_jax.shapes.sectors import sectors_of
from tdf_jax.shapes.shape import Shape
from tdf_jax.shapes.solid import Bar, Part, Tube, rings, tube_rings
from tdf_jax.shapes.stacks import CORNERS, Stack, at_heights, hull_planes, on_ring

_BEND = 4.2e-4  # intended distance of the parts of a handle from its surface, metres, on either side
_THINNEST = 3e-4  # thinnest part worth having, metres


def convex_parts(shape: Shape) -> list[Float[np.ndarray, "corners 3"]]:
    """Split an object into convex parts, whose union is its material.

    The surface of the union is less than 0.5 mm from that of the mesh, both ways, for objects of the sizes that the
    families sample. Hollows and finger holes stay open. The parts may overlap. Larger objects give more parts.

    Args:
        shape: a mug, bowl, bottle, rack or container.

    Returns:
        Corners of every part, (corners, 3), metres, object frame; a part is their convex hull.

    Raises:
        InputError: the shape is none of the five families, whose construction is known.
    """
    if not isinstance(shape, Shape):
        raise InputError(
            f"convex_parts(): got {type(shape).__name__}; expected a generated object, such as build_mug(); decompose "
            "other meshes with a tool for meshes"
        )
    if isinstance(shape, Container) and shape.parameters.style == "shelf":
        found = _shelf(shape)
    else:
        found = list(_parts(shape))
    return [_hull_corners(part) for part in found]


def _parts(shape: Shape) -> Iterator[np.ndarray]:
    parts, hollows = shape.solid
    hollow_stacks = [_stack(hollow) for hollow in hollows]
    bodies = [part for part in parts if not isinstance(part, Tube)]
    if hollows and len(bodies) > 1:  # a bin's rim: the wall ends below it
        wall, rim = (_stack(body) for body in bodies)
        yield from _body(wall, hollow_stacks, wall.heights[0], rim.heights[0])
        yield from _body(rim, hollow_stacks, rim.heights[0], rim.heights[-1])
    else:
        for body in bodies:
            stack = _stack(body)
            yield from _body(stack, hollow_stacks, stack.heights[0], stack.heights[-1])
    for tube in parts:
        if isinstance(tube, Tube):
            for piece in _chain(tube_rings(tube)):
                yield from _outside(piece, hollow_stacks, _stack(bodies[0]))


def _stack(part: Part) -> Stack:
    if isinstance(part, Bar):
        return Stack(part.heights, part.scales[:, None, None] * part.outline, part.T_object_bar)
    corners = rings(part)
    return Stack(corners[:, 0, 2], corners[..., :2], np.eye(4))


def _body(outer: Stack, hollows: list[Stack], low: float, high: float) -> Iterator[np.ndarray]:
    """Parts of a body between two heights, around its hollows."""
    ends = np.concatenate([[low, high], *([hollow.heights[[0, -1]]] for hollow in hollows)], axis=None)
    ends = np.unique(np.clip(ends, low, high))
    for below, above in zip(ends[:-1], ends[1:]):
        middle = (below + above) / 2
        around = [hollow for hollow in hollows if hollow.heights[0] < middle < hollow.heights[-1]]
        levels = outer.heights[(outer.heights > below) & (outer.heights < above)]
        levels = np.concatenate([[below], levels, [above]])
        if around:
            found = sectors_of(outer, around[0], levels)
        else:
            found = frusta_of(Stack(levels, outer.at(levels), outer.frame))
        for corners in found:
            yield corners @ outer.frame[:3, :3].T + outer.frame[:3, 3]


def _chain(corners: np.ndarray) -> Iterator[np.ndarray]:
    """Pieces (corners, 3) of a tube's rings (rings, corners, 3), each as long as the tolerance allows."""
    first, last = 0, len(corners) - 1
    while first < last:
        end, chosen = first + 1, corners[first : first + 2].reshape(-1, 3)
        while end < last:
            group = corners[first : end + 2]
            middle = len(group) // 2
            longer = group[[0, middle, -1]].reshape(-1, 3)
            planes = hull_planes(longer)
            depth = np.max(group.reshape(-1, 3) @ planes[:, :3].T + planes[:, 3], axis=1)
            if np.abs(depth).max() > _BEND:
                break
            chosen, end = longer, end + 1
        yield chosen
        first = end


def _outside(piece: np.ndarray, hollows: list[Stack], body: Stack) -> Iterator[np.ndarray]:
    """Convex parts of a handle's piece that cover it outside the body, and none of them is in a hollow."""
    planes = hull_planes(piece)
    low, high = piece.min(axis=0) - 1e-3, piece.max(axis=0) + 1e-3
    hollow = [_near_surface(stack, low, high)[0] for stack in hollows]
    points = np.concatenate([np.zeros((0, 3)), *hollow])
    points = points[np.max(points @ planes[:, :3].T + planes[:, 3], axis=1) < 1e-3]
    if len(points) == 0:
        if not _in_hollow(piece.mean(axis=0), hollows):
            yield piece
        return
    outside, normals = _near_surface(body, low, high)
    crossed = np.max(outside @ planes[:, :3].T + planes[:, 3], axis=1) < 2e-4
    outside, normals = outside[crossed], normals[crossed]
    if len(outside) == 0:
        return  # all of it is within the body, or in the hollow
    few = np.linspace(0, len(outside) - 1, min(len(outside), 500)).astype(int)
    outside = outside[few] - 1.5e-4 * normals[few]  # parts of handle and body overlap by this
    candidates = normals[few[:: max(len(few) // 120, 1)]]
    offset = np.max(candidates @ points.T, axis=1) + 2e-5
    covers = outside @ candidates.T >= offset
    left = np.ones(len(outside), bool)
    while left.any():
        gain = covers[left].sum(axis=0)
        best = int(np.argmax(gain))
        if gain[best] == 0:
            break
        left &= ~covers[:, best]
        part = _beyond(piece, candidates[best], offset[best])
        if part is not None:
            yield part


def _in_hollow(point: np.ndarray, hollows: list[Stack]) -> bool:
    """Whether a point is inside a hollow, whose outline is convex or nearly."""
    for stack in hollows:
        local = (point - stack.frame[:3, 3]) @ stack.frame[:3, :3]
        if stack.heights[0] < local[2] < stack.heights[-1]:
            ring = stack.at(local[2:])[0]
            ends = np.roll(ring, -1, axis=0) - ring
            away = local[:2] - ring
            if np.all(ends[:, 0] * away[:, 1] - ends[:, 1] * away[:, 0] >= 0):
                return True
    return False


def _near_surface(stack: Stack, low: np.ndarray, high: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Dense points (points, 3) on the side of a stack within a box, and the outward normals there."""
    begin, end = max(low[2], stack.heights[0]), min(high[2], stack.heights[-1])
    if begin >= end:
        return np.zeros((0, 3)), np.zeros((0, 3))
    heights = np.union1d(np.linspace(begin, end, max(int((end - begin) / 4e-4), 2)), [begin, end])
    fine = np.arange(4 * stack.rings.shape[1]) / 4
    flat = on_ring(stack.at(heights), fine)
    points = at_heights(flat, heights)
    around = np.roll(points, -1, axis=1) - np.roll(points, 1, axis=1)
    normals = np.cross(around, np.gradient(points, axis=0))
    normals /= np.maximum(np.linalg.norm(normals, axis=2, keepdims=True), 1e-12)
    inside = np.all((points >= low) & (points <= high), axis=2)
    return points[inside], normals[inside]


def _beyond(piece: np.ndarray, normal: np.ndarray, offset: float) -> np.ndarray | None:
    """The part of a convex piece beyond a plane, or None if it is thinner than what is worth having."""
    height = piece @ normal - offset
    inside, outside = piece[height >= 0], piece[height < 0]
    if len(inside) == 0 or height.max() < _THINNEST:
        return None
    if len(outside) == 0:
        return piece
    up, down = height[height >= 0][:, None, None], height[height < 0][None, :, None]
    share = up / (up - down)
    crossing = inside[:, None] + share * (outside[None] - inside[:, None])
    return _hull_corners(np.concatenate([inside, crossing.reshape(-1, 3)]))


def _shelf(shape: Container) -> list[np.ndarray]:
    """Floor, ceiling, back and both sides of a shelf, as boxes."""
    (outside,), (room,) = shape.solid
    low, high = (points(_corners(outside)) for points in (_lowest, _highest))
    inner_low, inner_high = (points(_corners(room)) for points in (_lowest, _highest))
    boxes = [
        (low, [*high[:2], inner_low[2]]),
        ([*low[:2], inner_high[2]], high),
        ([*low[:2], inner_low[2]], [inner_low[0], high[1], inner_high[2]]),
        ([inner_low[0], low[1], inner_low[2]], [high[0], inner_low[1], inner_high[2]]),
        ([inner_low[0], inner_high[1], inner_low[2]], [*high[:2], inner_high[2]]),
    ]
    choice = np.array(np.meshgrid([0, 1], [0, 1], [0, 1])).reshape(3, -1).T
    return [np.where(choice == 0, np.asarray(box[0]), np.asarray(box[1])) for box in boxes]


def _corners(part: Part) -> np.ndarray:
    return rings(part).reshape(-1, 3)


def _lowest(points: np.ndarray) -> np.ndarray:
    return points.min(axis=0)


def _highest(points: np.ndarray) -> np.ndarray:
    return points.max(axis=0)


def _hull_corners(points: np.ndarray) -> np.ndarray:
    """Those of the points that are corners of their hull; the nearest ones are merged while there are too many."""
    from scipy.spatial import ConvexHull

    grid = 2e-5
    corners = points[np.sort(ConvexHull(points).vertices)]
    while len(corners) > CORNERS:
        _, first = np.unique(np.round(corners / grid), axis=0, return_index=True)
        corners = corners[np.sort(first)]
        grid *= 1.5
    return corners
