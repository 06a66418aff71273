"""Round bars in a cloud, such as the pegs of a rack: a cylinder through few exact points is known where no point is."""

import functools
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

BALL = 0.02  # metres around a point, within which its bar is looked for
LONGER = (0.02, 0.03, 0.04, 0.06)  # half lengths of the bar by which the fit grows, metres
RADII = (0.0015, 0.008)  # thinner ones are not seen, and thicker ones have enough points
ELONGATED = 0.35  # largest ratio of the second variance in the ball to the first
TOLERANCE = 3e-4  # metres; points that are farther off a bar's surface are not on it, and noisy clouds have no bars
COARSE = 1e-3  # metres, the tolerance of the first fit
LEAST_POINTS, LEAST_LENGTH = 12, 0.015  # points and metres of a bar; five numbers are fitted
GAP = 0.015  # metres along the bar without a point, at which it ends
OUTSIDE, SHARE = 0.002, 0.7  # of the points in a bar or this close to it, so many are on its surface
LARGEST_ANGLE = np.pi  # without a point around the bar; the rounding of an edge is no bar
COVERED = np.pi / 3  # around the bar from a point on it, within which its surface is known
FITS = 12  # Gauss-Newton steps of a fit
STEP, AROUND = 0.0015, 16  # distance of the rings of points on a bar, metres, and points of a ring


class Bar(NamedTuple):
    """A round bar.

    Attributes:
        centre: a point on its axis, (3,), metres.
        axis: unit vector along it, (3,).
        radius: its radius, metres.
        span: its ends, along the axis from the centre, metres.
        members: numbers of the points of the cloud on it.
    """

    centre: Float[np.ndarray, "3"]
    axis: Float[np.ndarray, "3"]
    radius: float
    span: tuple[float, float]
    members: Int[np.ndarray, " members"]


def find_bars(points: Float[np.ndarray, "points 3"], seeds: Int[np.ndarray, " seeds"]) -> list[Bar]:
    """Round bars of a cloud, of radii within `RADII`, on which points lie to `TOLERANCE`.

    Args:
        points: cloud, (points, 3), metres.
        seeds: numbers of the points around which bars are looked for.

    Returns:
        The bars; none where the cloud is noisier than `TOLERANCE`, or where nothing is round and slender.
    """
    return bar_finder(points)(seeds)


def bar_finder(points: Float[np.ndarray, "points 3"]) -> Callable[[Int[np.ndarray, " seeds"]], list[Bar]]:
    """`find_bars` of one cloud for several sets of seeds; the bar through a point is fitted once.

    Args:
        points: cloud, (points, 3), metres.

    Returns:
        A function from numbers of points to the bars around them.
    """
    from scipy.spatial import KDTree

    tree = KDTree(points)

    @functools.cache
    def grown(seed: int) -> Bar | None:
        return _grown(points, points[tree.query_ball_point(points[seed], BALL)])

    def find(seeds: Int[np.ndarray, " seeds"]) -> list[Bar]:
        known = np.zeros(len(points), bool)
        bars = []
        for seed in seeds:
            bar = None if known[seed] else grown(int(seed))
            if bar is not None and known[bar.members].mean() < 0.5:
                bars.append(bar)
            if bar is not None:
                known[bar.members] = True
        return bars

    return find


def bar_points(bar: Bar, points: Float[np.ndarray, "points 3"]) -> Float[np.ndarray, "samples 3"]:
    """Points all over the surface of a bar, but not where the cloud has no point around it.

    Args:
        bar: the bar.
        points: the cloud in which it was found, (points, 3), metres.

    Returns:
        Rings of points, (samples, 3), metres.
    """
    across = _across(bar.axis)
    taken = _angles(points[bar.members] - bar.centre, across)
    angles = np.linspace(0, 2 * np.pi, AROUND, endpoint=False)
    far = np.abs((angles[:, None] - taken + np.pi) % (2 * np.pi) - np.pi).min(axis=1)
    angles = angles[far < COVERED]
    ring = bar.radius * np.stack([np.cos(angles), np.sin(angles)], axis=1) @ across
    heights = np.linspace(*bar.span, int(np.ceil((bar.span[1] - bar.span[0]) / STEP)) + 1)
    return (bar.centre + heights[:, None, None] * bar.axis + ring).reshape(-1, 3)


def in_bar(bar: Bar, points: Float[np.ndarray, "points 3"]) -> Bool[np.ndarray, " points"]:
    """Whether points are inside a bar or on its surface, to `TOLERANCE`, and between its ends.

    Args:
        bar: the bar.
        points: points, (points, 3), metres.
    """
    off, heights = _off(points, bar[:3])
    return (off < TOLERANCE) & (heights >= bar.span[0]) & (heights <= bar.span[1])


def _grown(points, ball) -> Bar | None:
    """The bar through the points of a ball, and as far beyond as the cloud follows it; None if there is none."""
    if len(ball) < LEAST_POINTS // 2:
        return None
    centre = ball.mean(axis=0)
    variances, directions = np.linalg.eigh(np.cov((ball - centre).T))
    if variances[1] > ELONGATED * variances[2]:
        return None
    axis = directions[:, 2]
    radius = min(np.linalg.norm(np.cross(ball - centre, axis), axis=1).mean(), RADII[1])
    fit = _fit(ball, (centre, axis, radius), COARSE)
    for reach in LONGER:
        off, heights = _off(points, fit)
        near = points[(np.abs(heights) < reach) & (np.abs(off) < 2 * TOLERANCE)]
        if not RADII[0] < fit[2] < RADII[1] or len(near) < LEAST_POINTS // 2:
            return None
        fit = _fit(near, fit, TOLERANCE / 2)
    centre, axis, radius = fit
    off, heights = _off(points, fit)
    members = np.flatnonzero(np.abs(off) < TOLERANCE)
    if len(members) < LEAST_POINTS or not RADII[0] < radius < RADII[1]:
        return None
    members = _unbroken(members[np.argsort(heights[members])], heights)
    span = float(heights[members[0]]), float(heights[members[-1]])
    if len(members) < LEAST_POINTS or span[1] - span[0] < LEAST_LENGTH:
        return None
    beside = (heights > span[0]) & (heights < span[1]) & (off < OUTSIDE)
    angles = np.sort(_angles(points[members] - centre, _across(axis)))
    largest = np.diff(np.append(angles, angles[0] + 2 * np.pi)).max()
    if (np.abs(off[beside]) < TOLERANCE).mean() < SHARE or largest > LARGEST_ANGLE:
        return None
    return Bar(centre, axis, float(radius), span, members)


def _unbroken(members, heights) -> np.ndarray:
    """The points, which are sorted along the bar, around its middle, until a gap on either side."""
    breaks = np.flatnonzero(np.diff(heights[members]) > GAP) + 1
    pieces = np.split(members, breaks)
    return min(pieces, key=lambda piece: np.abs(heights[piece]).min())


def _fit(points, cylinder, scale):
    """The cylinder (a point on the axis, the axis, the radius) by least squares, in which far points count little."""
    centre, axis, radius = cylinder
    for _ in range(FITS):
        across = _across(axis)
        out = (points - centre) @ across.T
        heights, far = (points - centre) @ axis, np.maximum(np.linalg.norm(out, axis=1), 1e-9)
        off, out = far - radius, out / far[:, None]
        weights = 1 / (1 + (off / scale) ** 2)
        jacobian = np.concatenate([-out, -heights[:, None] * out, -np.ones((len(points), 1))], axis=1)
        normal = jacobian.T @ (weights[:, None] * jacobian) + 1e-12 * len(points) * np.eye(5)
        step = -np.linalg.solve(normal, jacobian.T @ (weights * off))
        step[2:4] = np.clip(step[2:4], -0.3, 0.3)
        centre, axis, radius = centre + step[:2] @ across, axis + step[2:4] @ across, radius + step[4]
        axis = axis / np.linalg.norm(axis)
        if np.abs(step).max() < 1e-7:
            break
    return centre + axis * np.median((points - centre) @ axis), axis, radius


def _off(points, cylinder):
    """Distance of points from a cylinder's surface, positive outside, and their heights along its axis."""
    centre, axis, radius = cylinder
    return np.linalg.norm((points - centre) @ _across(axis).T, axis=1) - radius, (points - centre) @ axis


def _across(axis) -> np.ndarray:
    """Two unit vectors across an axis, (2, 3)."""
    return np.linalg.svd(axis[None])[2][1:]


def _angles(offsets, across) -> np.ndarray:
    return np.arctan2(offsets @ across[1], offsets @ across[0])
