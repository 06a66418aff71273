"""Walls around hollows as sectors, the fewest that the tolerance allows."""

from collections.abc import Iterator
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from tdf_jax._internal.errors import InputError
from tdf_jax.shapes.stacks import (
    FINE,
    TOLERANCE,
    Stack,
    at_heights,
    cuts_within,
    extremes,
    on_ring,
    room_of,
    sagittas,
    simplified,
)

_OUTER = 8e-5  # distance by which the outside of a wall is simplified, metres: its every corner costs time in contact
_BETWEEN = 6  # steps between two levels at which errors of a wall are tested
_BUDGETS = np.geomspace(1e-3, 0.3, 120)  # sagittas of a sector to tabulate, shares of the largest radius


def sectors_of(
    outer: Stack, inner: Stack, levels: Float[np.ndarray, " levels"]
) -> Iterator[Float[np.ndarray, "corners 3"]]:
    """Split the wall around a hollow into the fewest sectors that `TOLERANCE` allows.

    Args:
        outer: rings of the body.
        inner: rings of the hollow in the same frame: one outline of different sizes.
        levels: heights from the lower to the upper end of the wall, those of the body's rings among them, (levels,),
            metres.

    Yields:
        Corners of a part, (corners, 3), metres, the body's frame.

    Raises:
        InputError: the hollow is too large for parts within the tolerance.
    """
    within = inner.heights  # a hollow's frame is that of its body
    levels = np.concatenate([levels, within[(within > levels[0]) & (within < levels[-1])]])
    levels = np.unique(np.round(levels, 9))
    holes, bodies = inner.at(levels), outer.at(levels)
    sizes = np.linalg.norm(holes, axis=2).max(axis=1)
    widest = int(np.argmax(np.linalg.norm(holes[0], axis=1)))
    walls = np.linalg.norm(bodies[:, widest], axis=1)
    keep = simplified(np.column_stack([levels, sizes, walls]), FINE)
    levels, holes, bodies, sizes, walls = levels[keep], holes[keep], bodies[keep], sizes[keep], walls[keep]
    dense = np.interp(np.arange(_BETWEEN * (len(levels) - 1) + 1) / _BETWEEN, np.arange(len(levels)), levels)
    at_dense = inner.at(dense), outer.at(dense)
    closed = (bool(within[0] >= levels[0] - 1e-9), bool(within[-1] <= levels[-1] + 1e-9))
    rooms = (room_of(dense, extremes(at_dense[0]), sign, closed) for sign in (1.0, -1.0))
    outer_rooms = (room_of(dense, extremes(at_dense[1]), sign) for sign in (-1.0, 1.0))
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


@lru_cache(maxsize=16)
def _sector_table(outline: bytes, count: int) -> tuple[tuple[float, np.ndarray], ...]:
    """Budgets of sagitta, and the cuts of the outline (count, 2) that hold them; the smallest budget of every count."""
    sags = sagittas(np.frombuffer(outline).reshape(count, 2))
    table: dict[int, tuple[float, np.ndarray]] = {}
    for budget in _BUDGETS:
        cuts = cuts_within(sags, budget)
        if len(cuts) not in table:
            table[len(cuts)] = (float(budget), cuts)
    return tuple(sorted(table.values(), key=lambda row: row[0]))


def _fine_outline(polygon: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Points (points, 2) along a polygon of at most about 256, and their positions in corners (points,)."""
    split = max(256 // len(polygon), 1)
    at = np.arange(len(polygon) * split) / split
    return on_ring(polygon, at), at


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
    if error > 1 - _OUTER / TOLERANCE:
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
        near, far = on_ring(inner, sides), on_ring(facing, sides)
        wall = np.linalg.norm(far - near, axis=2, keepdims=True)
        share = np.minimum(plan.inner_shift[:, None, None] / np.maximum(wall, 1e-9), 1.0)
        near = near + share * (far - near)
        along = np.concatenate([[start], np.arange(np.floor(start) + 1, np.ceil(end)), [end]])
        largest = on_ring(outer[np.argmax(np.abs(outer).sum(axis=(1, 2)))], along)
        along = along[simplified(largest, _OUTER)]
        edge = on_ring(outer, along)
        length = np.linalg.norm(edge, axis=2, keepdims=True)
        edge = edge * (1 - plan.outer_shift[:, None, None] / length)
        rings_kept = simplified(np.column_stack([levels[plan.outer], edge[:, 0]]), _OUTER)
        near, edge = (
            at_heights(near, levels[plan.inner]),
            at_heights(edge[rings_kept], levels[plan.outer][rings_kept]),
        )
        yield np.concatenate([near.reshape(-1, 3), edge.reshape(-1, 3)])
