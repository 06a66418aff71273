"""Stacks of rings along an axis, and what their outlines and profiles allow: where to cut, and how far to move.

Outlines are closed polygons around the axis. A profile gives radii at rising heights.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

TOLERANCE = 4.5e-4  # intended distance of the parts' surface from the true one, metres, on either side
FINE = 3e-5  # distance by which profiles and outlines are simplified, metres
CORNERS = 64  # most corners of a part


class Stack(NamedTuple):
    """Rings at rising heights.

    Attributes:
        heights: heights of the rings along the z axis of the frame, (levels,), metres.
        rings: corners of every ring, (levels, corners, 2), metres.
        frame: pose of the axes in the object's frame, (4, 4).
    """

    heights: Float[np.ndarray, " levels"]
    rings: Float[np.ndarray, "levels corners 2"]
    frame: Float[np.ndarray, "4 4"]

    def at(self, heights: Float[np.ndarray, " heights"]) -> Float[np.ndarray, "heights corners 2"]:
        """Rings at other heights, (heights,), metres, with straight sides in between."""
        below = np.clip(np.searchsorted(self.heights, heights, side="right") - 1, 0, len(self.heights) - 2)
        share = (heights - self.heights[below]) / (self.heights[below + 1] - self.heights[below])
        share = np.clip(share, 0, 1)[:, None, None]
        return (1 - share) * self.rings[below] + share * self.rings[below + 1]


def at_heights(
    flat: Float[np.ndarray, "levels points 2"], heights: Float[np.ndarray, " levels"]
) -> Float[np.ndarray, "levels points 3"]:
    """Points of flat ones, (levels, points, 2), at their heights, (levels,), metres."""
    return np.concatenate([flat, np.broadcast_to(heights[:, None, None], (*flat.shape[:2], 1))], axis=2)


def on_ring(
    polygon: Float[np.ndarray, "*levels corners 2"], at: Float[np.ndarray, " points"]
) -> Float[np.ndarray, "*levels points 2"]:
    """Points along closed polygons.

    Args:
        polygon: corners, (..., corners, 2), metres.
        at: positions along each polygon, (points,), in corners: 1.5 is half-way between the second and the third.
    """
    count = polygon.shape[-2]
    first = np.floor(at).astype(int)
    share = (at - first)[:, None]
    return (1 - share) * polygon[..., first % count, :] + share * polygon[..., (first + 1) % count, :]


def extremes(polygons: Float[np.ndarray, "levels corners 2"]) -> Float[np.ndarray, "levels 2"]:
    """Largest and smallest radius of each polygon, (levels, 2), metres."""
    radii = np.linalg.norm(polygons, axis=2)
    return np.stack([radii.max(axis=1), radii.min(axis=1)], axis=1)


def room_of(
    heights: Float[np.ndarray, " levels"],
    profiles: Float[np.ndarray, "levels profiles"],
    sign: float,
    closed: tuple[bool, bool] = (False, False),
) -> Float[np.ndarray, " levels"]:
    """How far every ring can widen or narrow before it is `TOLERANCE` from the profiles.

    Args:
        heights: heights of the rings, (levels,), metres.
        profiles: radii of the rings, (levels, profiles), metres.
        sign: 1 to widen, -1 to narrow.
        closed: whether a flat floor and a flat ceiling close the profiles.

    Returns:
        The moves, (levels,), metres, at least `TOLERANCE`.
    """
    return np.minimum(*(_profile_room(heights, radii, sign, closed) for radii in profiles.T))


def _profile_room(heights, radii, sign, closed) -> np.ndarray:
    line = np.stack([radii, heights], axis=1)
    begin = line.copy()
    floor, ceiling = ([line[end] * [0, 1]] if flat else [] for end, flat in zip((0, -1), closed))
    line = np.array([*floor, *line[simplified(line, 1e-6)], *ceiling])
    along = np.diff(line, axis=0)
    squares = np.sum(along**2, axis=1)
    low, high = np.zeros(len(begin)), np.full(len(begin), 10 * TOLERANCE)
    for _ in range(9):
        middle = (low + high) / 2
        away_x, away_y = np.moveaxis(begin[:, None] - line[:-1], 2, 0)
        away_x = away_x + sign * middle[:, None]
        share = np.clip((away_x * along[:, 0] + away_y * along[:, 1]) / squares, 0, 1)
        distance = (away_x - share * along[:, 0]) ** 2 + (away_y - share * along[:, 1]) ** 2
        near = distance.min(axis=1) <= TOLERANCE**2
        low, high = np.where(near, middle, low), np.where(near, high, middle)
    return np.maximum(low, TOLERANCE)


def sagittas(polygon: Float[np.ndarray, "corners 2"]) -> Float[np.ndarray, "corners spans"]:
    """Sagittas of the chords that span 1, 2, ... edges of a closed polygon, from every corner.

    Args:
        polygon: corners, (corners, 2), any unit.

    Returns:
        Largest distance of the polygon from each chord, (corners, spans), in the same unit.
    """
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


def cuts_within(sags: Float[np.ndarray, "corners spans"], budget: float) -> Int[np.ndarray, " cuts"]:
    """Fewest corners to cut a closed polygon at, so that every chord's sagitta is within a budget.

    Args:
        sags: sagittas of the polygon, from `sagittas`.
        budget: largest sagitta, in their unit.

    Returns:
        Indices of the corners, rising, (cuts,).
    """
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


def simplified(line: Float[np.ndarray, "points dimensions"], tolerance: float) -> Int[np.ndarray, " kept"]:
    """Which points of an open line are needed to stay within a tolerance of it.

    Args:
        line: points in order, (points, dimensions).
        tolerance: largest distance of a point that is left out, in their unit.

    Returns:
        Indices of the points, rising, (kept,).

    Source:
        Douglas and Peucker, Algorithms for the reduction of the number of points required to represent a digitized
        line, Cartographica 1973.
    """
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


def hull_planes(points: Float[np.ndarray, "points 3"]) -> Float[np.ndarray, "faces 4"]:
    """Outward normals and offsets of the hull of points, (faces, 4); n x + d is positive outside."""
    from scipy.spatial import ConvexHull

    return ConvexHull(points).equations
