"""Convex parts of generated objects, from their construction, as collision shapes of physics engines.

Bodies are cut at levels, and a wall around a hollow into sectors as well. The corners of a part are placed so that the
error of its flat faces is the same on both sides of the true surface, which needs the fewest parts.
"""

from collections.abc import Iterator
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from tdf_jax._internal.errors import InputError
from tdf_jax.shapes.container import Container
from tdf_jax.shapes.shape import Shape
from tdf_jax.shapes.solid import Bar, Part, Tube, rings, tube_rings

_TOLERANCE = 4.5e-4  # intended distance of the parts' surface from the true one, metres, on either side
_BEND = 4.2e-4  # the same for handles
_FINE = 3e-5  # distance by which profiles and outlines are simplified, metres
_OUTER = 8e-5  # the same for the outside of a wall, whose every corner costs time in contact
_CORNERS = 64  # most corners of a part
_STEP = 1.5e-4  # rings closer than this, metres, are the step of a cap; a part between them would be a needle
_THINNEST = 3e-4  # thinnest part worth having, metres
_BETWEEN = 6  # steps between two levels at which errors of a wall are tested
_BUDGETS = np.geomspace(1e-3, 0.3, 120)  # sagittas of a sector to tabulate, shares of the largest radius


class _Stack(NamedTuple):
    """Rings (levels, corners, 2) at rising heights (levels,) along the z axis of a frame (4, 4)."""

    heights: np.ndarray
    rings: np.ndarray
    frame: np.ndarray

    def at(self, heights: np.ndarray) -> np.ndarray:
        """Rings at other heights, with straight sides in between."""
        below = np.clip(np.searchsorted(self.heights, heights, side="right") - 1, 0, len(self.heights) - 2)
        share = (heights - self.heights[below]) / (self.heights[below + 1] - self.heights[below])
        share = np.clip(share, 0, 1)[:, None, None]
        return (1 - share) * self.rings[below] + share * self.rings[below + 1]


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


def _stack(part: Part) -> _Stack:
    if isinstance(part, Bar):
        return _Stack(part.heights, part.scales[:, None, None] * part.outline, part.T_object_bar)
    corners = rings(part)
    return _Stack(corners[:, 0, 2], corners[..., :2], np.eye(4))


def _body(outer: _Stack, hollows: list[_Stack], low: float, high: float) -> Iterator[np.ndarray]:
    """Parts of a body between two heights, around its hollows."""
    ends = np.concatenate([[low, high], *([hollow.heights[[0, -1]]] for hollow in hollows)], axis=None)
    ends = np.unique(np.clip(ends, low, high))
    for below, above in zip(ends[:-1], ends[1:]):
        middle = (below + above) / 2
        around = [hollow for hollow in hollows if hollow.heights[0] < middle < hollow.heights[-1]]
        levels = outer.heights[(outer.heights > below) & (outer.heights < above)]
        levels = np.concatenate([[below], levels, [above]])
        if around:
            found = _shell(outer, around[0], levels)
        else:
            found = _slabs(_Stack(levels, outer.at(levels), outer.frame))
        for corners in found:
            yield corners @ outer.frame[:3, :3].T + outer.frame[:3, 3]


# ---- solid bodies: frusta ----


def _slabs(stack: _Stack) -> Iterator[np.ndarray]:
    """Frusta of a solid body, each as tall as the tolerance allows."""
    sizes = _extremes(stack.rings)
    keep = _simplified(np.column_stack([stack.heights, sizes]), _FINE)
    keep = np.union1d(keep, np.linspace(0, len(sizes) - 1, 12).astype(int))  # outlines differ at equal sizes
    heights, polygons, sizes = stack.heights[keep], stack.rings[keep], sizes[keep]
    slab = _Slab(
        heights, polygons, [_sagittas(p) for p in polygons], _room(heights, sizes, 1.0), _room(heights, sizes, -1.0)
    )
    first, last = 0, len(heights) - 1
    found: list[np.ndarray] = []
    begin = heights[0]
    while first < last:
        end = first + 1
        chosen, error = _frustum(slab, first, end)
        while end < last:
            longer, longer_error = _frustum(slab, first, end + 1)
            if longer_error > _TOLERANCE:
                break
            chosen, error, end = longer, longer_error, end + 1
        if heights[end] - heights[first] < _STEP:  # a step: the next frustum begins, or the last one ends, beyond it
            if end == last and found:
                found[-1][:, 2][found[-1][:, 2] == found[-1][:, 2].max()] = heights[end]
            first = end
            continue
        pieces = [chosen] if error < _TOLERANCE + 2e-5 else _quarters(polygons[[first, end]], heights[[first, end]])
        for piece in pieces:
            piece[piece[:, 2] == heights[first], 2] = begin
        found += pieces
        first, begin = end, heights[end]
    yield from found


class _Slab(NamedTuple):
    """Rings of a solid body, the sagittas of their chords, and the room to move their corners outwards and inwards."""

    heights: np.ndarray
    polygons: np.ndarray
    sagittas: list[np.ndarray]
    outwards: np.ndarray
    inwards: np.ndarray


def _frustum(slab: _Slab, first: int, last: int) -> tuple[np.ndarray, float]:
    """Corners of the frustum between two rings, and the largest distance of the rings in between from its hull."""
    heights, polygons = slab.heights, slab.polygons
    chosen = np.arange(polygons.shape[1])
    if 2 * len(chosen) > _CORNERS:
        chosen = _fewest_corners(np.maximum(slab.sagittas[first], slab.sagittas[last]), _CORNERS // 2)
    corners = np.concatenate(
        [np.column_stack([polygons[ring, chosen], np.full(len(chosen), heights[ring])]) for ring in (first, last)]
    )
    true = _at_heights(polygons[first : last + 1], heights[first : last + 1])
    # Points in the middle between rings see the errors of rings of two different shapes.
    true = np.concatenate([true, (true[:-1] + true[1:]) / 2]).reshape(-1, 3)
    lengths = np.maximum(np.linalg.norm(corners[:, :2], axis=1), 1e-9)
    best, error, shift = corners, np.inf, 0.0
    for _ in range(2):  # the second time, the error is the same on both sides of the surface
        moved = corners.copy()
        room = (slab.outwards if shift > 0 else slab.inwards)[[first, last]] / _TOLERANCE
        moved[:, :2] *= (1 + shift * np.repeat(room, len(chosen)) / lengths)[:, None]
        planes = _planes(moved)
        side = planes[np.abs(planes[:, 2]) < 1 - 1e-9]
        depth = np.max(true @ side[:, :3].T + side[:, 3], axis=1)
        worst = float(np.max(np.abs(depth)))
        if worst < error:
            best, error = moved, worst
        shift = np.clip((depth.max() + depth.min()) / 2, -_TOLERANCE, _TOLERANCE)
    return best, error


def _quarters(polygons: np.ndarray, heights: np.ndarray) -> list[np.ndarray]:
    """Sectors of a frustum that is too wide for its few corners; they have all corners."""
    cuts = np.linspace(0, polygons.shape[1], 5).astype(int)
    closed = np.concatenate([polygons, polygons[:, :1]], axis=1)
    axis = np.zeros((2, 1, 2))
    return [
        _at_heights(np.concatenate([axis, closed[:, start : end + 1]], axis=1), heights).reshape(-1, 3)
        for start, end in zip(cuts[:-1], cuts[1:])
    ]


def _at_heights(flat: np.ndarray, heights: np.ndarray) -> np.ndarray:
    """Points (levels, points, 3) of flat ones (levels, points, 2) at their heights (levels,)."""
    return np.concatenate([flat, np.broadcast_to(heights[:, None, None], (*flat.shape[:2], 1))], axis=2)


def _extremes(polygons: np.ndarray) -> np.ndarray:
    """Largest and smallest radii (levels, 2) of polygons (levels, corners, 2)."""
    radii = np.linalg.norm(polygons, axis=2)
    return np.stack([radii.max(axis=1), radii.min(axis=1)], axis=1)


def _room(heights: np.ndarray, profiles: np.ndarray, sign: float, closed: tuple[bool, bool] = (False, False)):
    """How far every ring can widen, or narrow for a sign of -1, before it is too far from the profiles (levels, 2).

    A profile may be closed by a flat floor and ceiling.
    """
    return np.minimum(*(_profile_room(heights, radii, sign, closed) for radii in profiles.T))


def _profile_room(heights, radii, sign, closed) -> np.ndarray:
    line = np.stack([radii, heights], axis=1)
    begin = line.copy()
    floor, ceiling = ([line[end] * [0, 1]] if flat else [] for end, flat in zip((0, -1), closed))
    line = np.array([*floor, *line[_simplified(line, 1e-6)], *ceiling])
    along = np.diff(line, axis=0)
    squares = np.sum(along**2, axis=1)
    low, high = np.zeros(len(begin)), np.full(len(begin), 10 * _TOLERANCE)
    for _ in range(9):
        middle = (low + high) / 2
        away_x, away_y = np.moveaxis(begin[:, None] - line[:-1], 2, 0)
        away_x = away_x + sign * middle[:, None]
        share = np.clip((away_x * along[:, 0] + away_y * along[:, 1]) / squares, 0, 1)
        distance = (away_x - share * along[:, 0]) ** 2 + (away_y - share * along[:, 1]) ** 2
        near = distance.min(axis=1) <= _TOLERANCE**2
        low, high = np.where(near, middle, low), np.where(near, high, middle)
    return np.maximum(low, _TOLERANCE)


def _sagittas(polygon: np.ndarray) -> np.ndarray:
    """Sagitta (corners, spans) of the chord that spans 1, 2, ... edges of a closed polygon, from every corner."""
    count = len(polygon)
    most = max(count // 3, 1)
    found = np.zeros((count, most))
    start = np.arange(count)[:, None]
    for span in range(2, most + 1):
        ends = polygon[(start[:, 0] + span) % count] - polygon
        normal = np.stack([ends[:, 1], -ends[:, 0]], axis=1)
        normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-12)
        between = polygon[(start + np.arange(1, span)) % count] - polygon[:, None]
        found[:, span - 1] = np.abs(np.einsum("ski,si->sk", between, normal)).max(axis=1)
    return np.maximum.accumulate(found, axis=1)


def _cuts(sags: np.ndarray, budget: float) -> np.ndarray:
    """Fewest corners to cut a closed polygon at, so that every chord's sagitta is within the budget."""
    count = len(sags)
    reach = np.maximum(np.sum(sags <= budget, axis=1), 1).tolist()
    best = None
    for start in range(0, max(count // 8, 1), max(count // 32, 1)):
        at, found = start, []
        while at < start + count:
            found.append(at)
            at += reach[at % count]
        if best is None or len(found) < len(best):
            best = found
    assert best is not None
    return np.sort(np.array(best) % count)


def _fewest_corners(sags: np.ndarray, most: int) -> np.ndarray:
    """At most this many corners of a closed polygon, with the smallest sagittas."""
    low, high = -17.0, -4.0  # powers of two of the budget, metres
    found = _cuts(sags, 2.0**high)
    while high - low > 0.2:
        middle = (low + high) / 2
        cuts = _cuts(sags, 2.0**middle)
        if len(cuts) <= most:
            found, high = cuts, middle
        else:
            low = middle
    return found


# ---- walls around hollows: sectors ----


@lru_cache(maxsize=16)
def _sector_table(outline: bytes, count: int) -> tuple[tuple[float, np.ndarray], ...]:
    """Budgets of sagitta, and the cuts of the outline (count, 2) that hold them; the smallest budget of every count."""
    sags = _sagittas(np.frombuffer(outline).reshape(count, 2))
    table: dict[int, tuple[float, np.ndarray]] = {}
    for budget in _BUDGETS:
        cuts = _cuts(sags, budget)
        if len(cuts) not in table:
            table[len(cuts)] = (float(budget), cuts)
    return tuple(sorted(table.values(), key=lambda row: row[0]))


def _fine_outline(polygon: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Points (points, 2) along a polygon of at most about 256, and their positions in corners (points,)."""
    split = max(256 // len(polygon), 1)
    at = np.arange(len(polygon) * split) / split
    return _on_ring(polygon, at), at


def _on_ring(polygon: np.ndarray, at: np.ndarray) -> np.ndarray:
    """Points (..., at, 2) at positions in corners along closed polygons (..., corners, 2)."""
    count = polygon.shape[-2]
    first = np.floor(at).astype(int)
    share = (at - first)[:, None]
    return (1 - share) * polygon[..., first % count, :] + share * polygon[..., (first + 1) % count, :]


def _shell(outer: _Stack, inner: _Stack, levels: np.ndarray) -> Iterator[np.ndarray]:
    """Sectors of the wall between an outline and a hollow, which has one outline of different sizes."""
    within = inner.heights  # a hollow's frame is that of its body
    levels = np.concatenate([levels, within[(within > levels[0]) & (within < levels[-1])]])
    levels = np.unique(np.round(levels, 9))
    holes, bodies = inner.at(levels), outer.at(levels)
    sizes = np.linalg.norm(holes, axis=2).max(axis=1)
    widest = int(np.argmax(np.linalg.norm(holes[0], axis=1)))
    walls = np.linalg.norm(bodies[:, widest], axis=1)
    keep = _simplified(np.column_stack([levels, sizes, walls]), _FINE)
    levels, holes, bodies, sizes, walls = levels[keep], holes[keep], bodies[keep], sizes[keep], walls[keep]
    dense = np.interp(np.arange(_BETWEEN * (len(levels) - 1) + 1) / _BETWEEN, np.arange(len(levels)), levels)
    at_dense = inner.at(dense), outer.at(dense)
    floor = (within[0] >= levels[0] - 1e-9, within[-1] <= levels[-1] + 1e-9)
    rooms = (_room(dense, _extremes(at_dense[0]), sign, floor) for sign in (1.0, -1.0))
    outer_rooms = (_room(dense, _extremes(at_dense[1]), sign) for sign in (-1.0, 1.0))
    dense_sizes, dense_walls = (np.interp(dense, levels, radii) for radii in (sizes, walls))
    profile = _Profile(dense, dense_sizes, dense_walls, *rooms, *outer_rooms)
    unit, at = _fine_outline(holes[0] / sizes[0])
    table = _sector_table(np.round(unit, 12).tobytes(), len(unit))
    slant = _slant(holes[-1], bodies[-1])

    # The fewest sectors in all, by dynamic programming over the levels to cut at.
    count = len(levels)
    cost, previous, plans = np.full(count, np.inf), np.zeros(count, int), {}
    cost[0] = 0
    for last in range(1, count):
        for first in range(last - 1, -1, -1):
            plan = _plan(
                _Profile(*(values[_BETWEEN * first : _BETWEEN * last + 1] for values in profile)), table, slant
            )
            if plan is None:
                if last - first == 1:
                    raise InputError(
                        f"convex_parts(): a hollow has a radius of {sizes.max():.3g} m; expected less than 0.9 m, for "
                        "parts within 0.5 mm; scale the object to metres"
                    )
                if levels[last] - levels[first] > 0.001:
                    break
                continue
            total = cost[first] + len(plan.cuts)
            if total < cost[last]:
                cost[last], previous[last], plans[last] = total, first, plan
    last = count - 1
    while last > 0:
        first, plan = previous[last], plans[last]
        group = slice(first, last + 1)
        yield from _sectors(plan, levels[group], holes[group], bodies[group], at)
        last = first


def _slant(hole: np.ndarray, body: np.ndarray) -> float:
    """How far an edge of a hollow moves at least, if its corners move by 1 towards those of the outside."""
    edge = np.roll(hole, -1, axis=0) - hole
    normal = np.stack([edge[:, 1], -edge[:, 0]], axis=1) / np.linalg.norm(edge, axis=1, keepdims=True)
    across = (body - hole) / np.maximum(np.linalg.norm(body - hole, axis=1, keepdims=True), 1e-12)
    return float(
        np.clip(np.minimum(np.sum(normal * across, 1), np.sum(normal * np.roll(across, -1, 0), 1)).min(), 0, 1)
    )


class _Profile(NamedTuple):
    """Largest radii of a hollow and of the outside at rising levels, and their room into the material and the air."""

    levels: np.ndarray
    inner: np.ndarray
    outer: np.ndarray
    inner_room: np.ndarray
    inner_air: np.ndarray
    outer_room: np.ndarray
    outer_air: np.ndarray


class _Plan(NamedTuple):
    """How one level of a wall is cut: where along the fine outline, which rings matter, and how far these move."""

    cuts: np.ndarray
    inner: np.ndarray
    inner_shift: np.ndarray
    outer: np.ndarray
    outer_shift: np.ndarray


def _plan(profile: _Profile, table, slant: float) -> _Plan | None:
    """Cuts of a wall between the first and the last level, or None if its profile is bent too much."""
    levels = profile.levels
    rings = levels[::_BETWEEN]
    outer, gap = _envelope(rings, -profile.outer[::_BETWEEN], levels)
    outer_room = profile.outer_room[::_BETWEEN][outer]
    moves = np.interp(levels, rings[outer], outer_room)
    outer_shift, error = _balanced(
        moves / profile.outer_room, gap / profile.outer_room, gap / profile.outer_air, moves / profile.outer_air
    )
    if error > 1 - _OUTER / _TOLERANCE:
        return None
    inner, gap = _envelope(rings, profile.inner[::_BETWEEN], levels)
    inner_room = profile.inner_room[::_BETWEEN][inner]
    moves = np.interp(levels, rings[inner], inner_room)
    most = min(1.0, np.min((profile.inner_room + gap) / moves))
    allowed = np.min((profile.inner_air + most * moves * slant - gap) / profile.inner)
    fitting = [row for row in table if row[0] <= allowed]
    if not fitting:
        return None
    budget, cuts = fitting[-1]
    shift, _ = _balanced(
        moves / profile.inner_room,
        gap / profile.inner_room,
        (gap + budget * profile.inner) / profile.inner_air,
        moves * slant / profile.inner_air,
    )
    return _Plan(cuts, inner, shift * inner_room, outer, outer_shift * outer_room)


def _balanced(into: np.ndarray, least: np.ndarray, most: np.ndarray, out: np.ndarray) -> tuple[float, float]:
    """Share of the moves into the material that makes the errors the same on both sides, and that error.

    Without a move, faces fill between `least` and `most` outside the material; the full move shifts them by `into` and
    `out`. All are shares of the room on that side, (levels,).
    """
    shares = np.linspace(0, 1, 21)[:, None]
    error = np.maximum(np.max(shares * into - least, axis=1), shares[:, 0])
    error = np.maximum(error, np.max(most - shares * out, axis=1))
    best = int(np.argmin(error))
    return float(shares[best, 0]), float(error[best])


def _envelope(rings: np.ndarray, radii: np.ndarray, levels: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Lower convex envelope of a profile at its rings: those on it, and the gap to it at levels."""
    hull = [0]
    x, y = rings.tolist(), radii.tolist()
    for k in range(1, len(x)):
        while len(hull) > 1:
            a, b = hull[-2], hull[-1]
            if (y[b] - y[a]) * (x[k] - x[a]) >= (y[k] - y[a]) * (x[b] - x[a]):
                hull.pop()
            else:
                break
        hull.append(k)
    kept = np.array(hull)
    return kept, np.interp(levels, rings, radii) - np.interp(levels, rings[kept], radii[kept])


def _sectors(plan: _Plan, levels, holes, bodies, at) -> Iterator[np.ndarray]:
    corner_count = holes.shape[1]
    inner, outer = holes[plan.inner], bodies[plan.outer]
    facing = bodies[plan.inner]
    starts = at[plan.cuts]
    for start, end in zip(starts, np.append(starts[1:], starts[0] + corner_count)):
        sides = np.array([start, end])
        near, far = _on_ring(inner, sides), _on_ring(facing, sides)
        wall = np.linalg.norm(far - near, axis=2, keepdims=True)
        share = np.minimum(plan.inner_shift[:, None, None] / np.maximum(wall, 1e-9), 1.0)
        near = near + share * (far - near)
        along = np.concatenate([[start], np.arange(np.floor(start) + 1, np.ceil(end)), [end]])
        largest = _on_ring(outer[np.argmax(np.abs(outer).sum(axis=(1, 2)))], along)
        along = along[_simplified(largest, _OUTER)]
        edge = _on_ring(outer, along)
        length = np.linalg.norm(edge, axis=2, keepdims=True)
        edge = edge * (1 - plan.outer_shift[:, None, None] / length)
        rings_kept = _simplified(np.column_stack([levels[plan.outer], edge[:, 0]]), _OUTER)
        near, edge = (
            _at_heights(near, levels[plan.inner]),
            _at_heights(edge[rings_kept], levels[plan.outer][rings_kept]),
        )
        yield np.concatenate([near.reshape(-1, 3), edge.reshape(-1, 3)])


def _simplified(line: np.ndarray, tolerance: float) -> np.ndarray:
    """Which points (points, dimensions) of an open line are needed to stay within a tolerance (Douglas-Peucker)."""
    keep, open_ = {0, len(line) - 1}, [(0, len(line) - 1)]
    while open_:
        first, last = open_.pop()
        if last - first < 2:
            continue
        step = line[last] - line[first]
        away = line[first + 1 : last] - line[first]
        length = np.linalg.norm(step)
        if length > 0:
            away = away - np.outer(away @ step, step) / length**2
        distance = np.linalg.norm(away, axis=1)
        worst = int(np.argmax(distance))
        if distance[worst] > tolerance:
            middle = first + 1 + worst
            keep.add(middle)
            open_ += [(first, middle), (middle, last)]
    return np.array(sorted(keep))


# ---- handles ----


def _chain(corners: np.ndarray) -> Iterator[np.ndarray]:
    """Pieces (corners, 3) of a tube's rings (rings, corners, 3), each as long as the tolerance allows."""
    first, last = 0, len(corners) - 1
    while first < last:
        end, chosen = first + 1, corners[first : first + 2].reshape(-1, 3)
        while end < last:
            group = corners[first : end + 2]
            middle = len(group) // 2
            longer = group[[0, middle, -1]].reshape(-1, 3)
            planes = _planes(longer)
            depth = np.max(group.reshape(-1, 3) @ planes[:, :3].T + planes[:, 3], axis=1)
            if np.abs(depth).max() > _BEND:
                break
            chosen, end = longer, end + 1
        yield chosen
        first = end


def _outside(piece: np.ndarray, hollows: list[_Stack], body: _Stack) -> Iterator[np.ndarray]:
    """Convex parts of a handle's piece that cover it outside the body, and none of them is in a hollow."""
    planes = _planes(piece)
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


def _in_hollow(point: np.ndarray, hollows: list[_Stack]) -> bool:
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


def _near_surface(stack: _Stack, low: np.ndarray, high: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Dense points (points, 3) on the side of a stack within a box, and the outward normals there."""
    begin, end = max(low[2], stack.heights[0]), min(high[2], stack.heights[-1])
    if begin >= end:
        return np.zeros((0, 3)), np.zeros((0, 3))
    heights = np.union1d(np.linspace(begin, end, max(int((end - begin) / 4e-4), 2)), [begin, end])
    fine = np.arange(4 * stack.rings.shape[1]) / 4
    flat = _on_ring(stack.at(heights), fine)
    points = _at_heights(flat, heights)
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


# ---- shelves and hulls ----


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


def _planes(points: np.ndarray) -> np.ndarray:
    """Outward normals and offsets (faces, 4) of the hull of points; n x + d is positive outside."""
    from scipy.spatial import ConvexHull

    return ConvexHull(points).equations


def _hull_corners(points: np.ndarray) -> np.ndarray:
    """Those of the points that are corners of their hull; the nearest ones are merged while there are too many."""
    from scipy.spatial import ConvexHull

    grid = 2e-5
    corners = points[np.sort(ConvexHull(points).vertices)]
    while len(corners) > _CORNERS:
        _, first = np.unique(np.round(corners / grid), axis=0, return_index=True)
        corners = corners[np.sort(first)]
        grid *= 1.5
    return corners
