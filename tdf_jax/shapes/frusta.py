"""Solid bodies as frusta, each as tall as the tolerance allows."""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from tdf_jax.shapes.stacks import (
    CORNERS,
    FINE,
    TOLERANCE,
    Stack,
    at_heights,
    cuts_within,
    extremes,
    hull_planes,
    room_of,
    sagittas,
    simplified,
)

_STEP = 1.5e-4  # rings closer than this, metres, are the step of a cap; a part between them would be a needle


def frusta_of(stack: Stack) -> Iterator[Float[np.ndarray, "corners 3"]]:
    """Split a solid body into frusta, each as tall as `TOLERANCE` allows.

    Args:
        stack: the body's rings.

    Yields:
        Corners of a part, (corners, 3), metres, the stack's frame.
    """
    sizes = extremes(stack.rings)
    keep = simplified(np.column_stack([stack.heights, sizes]), FINE)
    keep = np.union1d(keep, np.linspace(0, len(sizes) - 1, 12).astype(int))  # outlines differ at equal sizes
    heights, polygons, sizes = stack.heights[keep], stack.rings[keep], sizes[keep]
    slab = _Slab(
        heights, polygons, [sagittas(p) for p in polygons], room_of(heights, sizes, 1.0), room_of(heights, sizes, -1.0)
    )
    first, last = 0, len(heights) - 1
    found: list[np.ndarray] = []
    begin = heights[0]
    while first < last:
        end = first + 1
        chosen, error = _frustum(slab, first, end)
        while end < last:
            longer, longer_error = _frustum(slab, first, end + 1)
            if longer_error > TOLERANCE:
                break
            chosen, error, end = longer, longer_error, end + 1
        if heights[end] - heights[first] < _STEP:  # a step: the next frustum begins, or the last one ends, beyond it
            if end == last and found:
                found[-1][:, 2][found[-1][:, 2] == found[-1][:, 2].max()] = heights[end]
            first = end
            continue
        pieces = [chosen] if error < TOLERANCE + 2e-5 else _quarters(polygons[[first, end]], heights[[first, end]])
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
    if 2 * len(chosen) > CORNERS:
        chosen = _fewest_corners(np.maximum(slab.sagittas[first], slab.sagittas[last]), CORNERS // 2)
    corners = np.concatenate(
        [np.column_stack([polygons[ring, chosen], np.full(len(chosen), heights[ring])]) for ring in (first, last)]
    )
    true = at_heights(polygons[first : last + 1], heights[first : last + 1])
    # Points in the middle between rings see the errors of rings of two different shapes.
    true = np.concatenate([true, (true[:-1] + true[1:]) / 2]).reshape(-1, 3)
    lengths = np.maximum(np.linalg.norm(corners[:, :2], axis=1), 1e-9)
    best, error, shift = corners, np.inf, 0.0
    for _ in range(2):  # the second time, the error is the same on both sides of the surface
        moved = corners.copy()
        moves = (slab.outwards if shift > 0 else slab.inwards)[[first, last]] / TOLERANCE
        moved[:, :2] *= (1 + shift * np.repeat(moves, len(chosen)) / lengths)[:, None]
        planes = hull_planes(moved)
        side = planes[np.abs(planes[:, 2]) < 1 - 1e-9]
        depth = np.max(true @ side[:, :3].T + side[:, 3], axis=1)
        worst = float(np.max(np.abs(depth)))
        if worst < error:
            best, error = moved, worst
        shift = np.clip((depth.max() + depth.min()) / 2, -TOLERANCE, TOLERANCE)
    return best, error


def _quarters(polygons: np.ndarray, heights: np.ndarray) -> list[np.ndarray]:
    """Sectors of a frustum that is too wide for its few corners; they have all corners."""
    cuts = np.linspace(0, polygons.shape[1], 5).astype(int)
    closed = np.concatenate([polygons, polygons[:, :1]], axis=1)
    axis = np.zeros((2, 1, 2))
    return [
        at_heights(np.concatenate([axis, closed[:, start : end + 1]], axis=1), heights).reshape(-1, 3)
        for start, end in zip(cuts[:-1], cuts[1:])
    ]


def _fewest_corners(sags: np.ndarray, most: int) -> np.ndarray:
    """At most this many corners of a closed polygon, with the smallest sagittas."""
    low, high = -17.0, -4.0  # powers of two of the budget, metres
    found = cuts_within(sags, 2.0**high)
    while high - low > 0.2:
        middle = (low + high) / 2
        cuts = cuts_within(sags, 2.0**middle)
        if len(cuts) <= most:
            found, high = cuts, middle
        else:
            low = middle
    return found
