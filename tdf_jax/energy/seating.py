"""Seating: how far an object is lowered or raised until it touches its target, by the occupancies of both.

An occupancy of one half lies up to some millimetres off the surface, more at thin parts. The points of a cloud lie on
the surface. So a point touches an object where its occupancy reaches that at the nearest points of the object's cloud.
Few points of a target are on a thin peg, and none where a handle hangs on it. But they lie on a round bar, which tells
where its surface is between them.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from tdf_jax.geometry import se3
from tdf_jax.geometry.bars import Bar, bar_finder, bar_points, in_bar
from tdf_jax.geometry.sampling import subset
from tdf_jax.networks.field import DescriptorField

REACH = 0.015  # metres; an object that touches nothing within it is not moved
STEPS = 15  # tested displacements each way; between them the depth is interpolated
LEVEL_POINTS = 4  # nearest points of a cloud, by which the occupancy at its surface is known
SEEN = 0.012  # metres from the cloud within which its points say where the surface is
UNSEEN_LEVEL = 0.5  # occupancy that counts as touching elsewhere, within the limits below
# Limits of the occupancy that counts as touching. In the target's field, where the object's points are tested, only
# what is clearly inside counts: those of racks have shadows of a half beside their pegs.
OBJECT_LEVELS, TARGET_LEVELS = (0.1, 0.9), (0.7, 0.95)
NEIGHBOURS = 4  # points half way to the nearest neighbours are tested too: few points of a cloud are on a thin peg
BESIDE = 0.01  # metres across the direction within which a point may meet the other object
SIDEWAYS = 2.0  # weight of the distance across the direction when those points are chosen
POINTS = 512  # points of each object that are tested
INSIDE, OVERLAP_STEPS = 0.2, (-0.7, -0.35, 0.0, 0.35, 0.7)  # occupancy that is too near; tested shares of `REACH`
CLOUD = 2000  # points of each cloud that are looked at; more cost time and memory
CLOSEST = 1e-4  # metres; nearer points weigh no more
MARGIN = 6e-4  # metres; the surface between the tested points touches so much earlier in the median
TINY = 1e-4  # occupancies are this far from 0 and 1 at least
PADDING = 2048  # the points are filled up to a multiple of it, so that few programs are compiled


class _Surface(NamedTuple):
    """A cloud of an object in its field.

    Attributes:
        field: field of the object.
        tree: the cloud, (points, 3), metres.
        occupancies: occupancies of the field at the cloud's points, (points,).
    """

    field: DescriptorField
    tree: Any
    occupancies: Float[np.ndarray, " points"]


def touch_distance(
    field: DescriptorField,
    target: DescriptorField | None,
    points: Float[Array | np.ndarray, "points 3"],
    target_points: Float[Array | np.ndarray, "target_points 3"],
    motion: Float[Array | np.ndarray, "7"],
    direction: Float[Array | np.ndarray, "3"],
) -> float:
    """How far along a direction a placed object touches its target.

    The object and the target touch where points of the cloud of one are on the surface of the other.

    Args:
        field: field of the object in its initial pose.
        target: field of the target; None to test the target's points in the object's field only.
        points: cloud of the object in its initial pose, (points, 3), metres, world frame.
        target_points: cloud of the target, (target_points, 3), metres, world frame.
        motion: motion of the object to the target, `wxyz_xyz`, (7,), metres.
        direction: unit vector along which the object is moved, such as down, (3,), world frame.

    Returns:
        The displacement, metres: positive along the direction if there is a gap, negative if the two overlap, `MARGIN`
            short of where the tested points touch, unless they are on a round bar of the target; NaN if they do not
            touch, or overlap still, within `REACH`.
    """
    motions, directions = np.asarray(motion)[None], np.asarray(direction)[None]
    return float(touch_distances(field, target, points, target_points, motions, directions)[0])


def touch_distances(
    field: DescriptorField,
    target: DescriptorField | None,
    points: Float[Array | np.ndarray, "points 3"],
    target_points: Float[Array | np.ndarray, "target_points 3"],
    motions: Float[Array | np.ndarray, "motions 7"],
    directions: Float[Array | np.ndarray, "motions 3"],
) -> Float[np.ndarray, " motions"]:
    """`touch_distance` of several motions; what does not depend on the motion is computed once.

    Args:
        field: as for `touch_distance`.
        target: as for `touch_distance`.
        points: as for `touch_distance`.
        target_points: as for `touch_distance`.
        motions: motions of the object, (motions, 7).
        directions: a direction for each, (motions, 3).

    Returns:
        The displacements, (motions,), metres.
    """
    # In NumPy but for the fields: the number of points differs from call to call, and JAX would compile for each.
    points, target_cloud = np.asarray(points, float), subset(np.asarray(target_points, float), CLOUD)
    denser, find_near_bars = _denser(target_cloud), bar_finder(target_cloud)
    surface = _surface(field, subset(points, CLOUD))
    target_surface = None if target is None else _surface(target, target_cloud)

    def one(motion, direction) -> float:
        R, t = np.asarray(se3.rotation(jnp.asarray(motion)), float), np.asarray(motion, float)[4:]
        direction = np.asarray(direction, float)
        placed = _denser(subset(points @ R.T + t, CLOUD))
        near, target_near = _meeting(placed, denser, direction)
        if not len(near):
            return np.nan
        target_near, bars = _split(target_cloud, denser, target_near, find_near_bars)
        if len(bars):
            # The margin is taken off in the end, but is not needed where points are as dense as on the bars.
            near, target_near = _meeting(placed, np.concatenate([target_near, bars + MARGIN * direction]), direction)
            if not len(near):
                return np.nan
        steps = np.linspace(-REACH, REACH, 2 * STEPS + 1)
        shifts = steps[:, None, None] * direction
        depths = [_depth(surface, (target_near - shifts - t) @ R, OBJECT_LEVELS)]
        if target_surface is not None:
            depths.append(_depth(target_surface, near + shifts, TARGET_LEVELS))
        return _first_touch(steps, np.max(depths, axis=0)) - MARGIN

    return np.array([one(*pair) for pair in zip(np.asarray(motions), np.asarray(directions), strict=True)])


def overlap(
    field: DescriptorField,
    target_points: Float[np.ndarray, "target_points 3"],
    motion: Float[np.ndarray, "4 4"],
    direction: Float[Array | np.ndarray, "3"],
) -> int:
    """How many points of a target are in or close to a placed object, at the best of five heights.

    Args:
        field: field of the object in its initial pose.
        target_points: cloud of the target, (target_points, 3), metres, world frame.
        motion: motion of the object to the target, 4x4, metres.
        direction: unit vector along which the object may be moved, (3,), world frame.

    Returns:
        The least number of points, of at most `CLOUD`, at displacements of up to 0.7 times `REACH` each way.
    """
    x = subset(np.asarray(target_points, float), CLOUD)
    shifts = np.array(OVERLAP_STEPS)[:, None, None] * REACH * np.asarray(direction, float)
    local = (x - shifts - motion[:3, 3]) @ motion[:3, :3]
    return int((_occupancy(field, local.reshape(-1, 3)).reshape(len(shifts), -1) > INSIDE).sum(axis=1).min())


def _denser(points: np.ndarray) -> np.ndarray:
    """A cloud and the points half way between neighbours."""
    from scipy.spatial import KDTree

    nearest = np.asarray(KDTree(points).query(points, min(NEIGHBOURS + 1, len(points)))[1]).reshape(len(points), -1)
    # The first is the point itself. Neighbourhoods are not mutual, and a pair that is counts once.
    pairs = np.stack([np.repeat(nearest[:, 0], nearest.shape[1] - 1), nearest[:, 1:].ravel()], axis=1)
    one, other = np.unique(np.sort(pairs, axis=1), axis=0).T
    return np.concatenate([points, (points[one] + points[other]) / 2])


def _split(
    cloud: Float[np.ndarray, "points 3"],
    denser: Float[np.ndarray, "denser 3"],
    near: Float[np.ndarray, "near 3"],
    find_near_bars: Callable[[Int[np.ndarray, " seeds"]], list[Bar]],
) -> tuple[np.ndarray, np.ndarray]:
    """The denser cloud without its round bars, and points all over these; `near` and none if it has none there.

    Args:
        cloud: cloud of the target.
        denser: its denser cloud.
        near: points of the denser cloud that may meet the object; bars that go through none of them do not count.
        find_near_bars: finds the bars of the cloud, see `bar_finder`.
    """
    from scipy.spatial import KDTree

    bars = find_near_bars(np.flatnonzero(KDTree(near).query(cloud)[0] == 0))
    if not bars:
        return near, np.empty((0, 3))
    replaced = np.any([in_bar(bar, denser) for bar in bars], axis=0)
    return denser[~replaced], np.concatenate([bar_points(bar, cloud) for bar in bars])


def _meeting(points, target_points, direction) -> tuple[np.ndarray, np.ndarray]:
    """Points of either cloud that may meet the other along a direction: at most `POINTS` of each."""
    from scipy.spatial import KDTree

    across = np.linalg.svd(direction[None])[2][1:].T
    pairs = KDTree(points @ across).sparse_distance_matrix(
        KDTree(target_points @ across), BESIDE, output_type="coo_matrix"
    )
    gaps = target_points[pairs.col] @ direction - points[pairs.row] @ direction
    meets = np.abs(gaps) < 2 * REACH
    gaps, beside = gaps[meets], SIDEWAYS * pairs.data[meets]
    chosen = []
    for cloud, index in ((points, pairs.row[meets]), (target_points, pairs.col[meets])):
        # The nearest points touch first. If the two overlap deeply, the deepest ones come free last.
        picked = [_closest(len(cloud), index, measure) for measure in (np.hypot(gaps, beside), gaps + beside)]
        chosen.append(cloud[np.union1d(*picked)])
    return chosen[0], chosen[1]


def _closest(count: int, index: np.ndarray, measures: np.ndarray) -> np.ndarray:
    """Numbers of the points, at most half of `POINTS`, that have the smallest measures in any of their pairs."""
    least = np.full(count, np.inf)
    np.minimum.at(least, index, measures)
    return np.argsort(least, kind="stable")[: min(POINTS // 2, int(np.isfinite(least).sum()))]


def _surface(field: DescriptorField, cloud: Float[np.ndarray, "points 3"]) -> _Surface:
    from scipy.spatial import KDTree

    return _Surface(field, KDTree(cloud), _occupancy(field, cloud))


def _depth(
    surface: _Surface, x: Float[np.ndarray, "steps count 3"], levels: tuple[float, float]
) -> Float[np.ndarray, " steps"]:
    """How far the deepest point is inside an object at every displacement, as a difference of logits.

    Args:
        surface: cloud of the object in its field.
        x: points at all displacements.
        levels: lowest and highest occupancy that counts as touching.
    """
    steps, count, _ = x.shape
    distances, nearest = surface.tree.query(x.reshape(-1, 3), min(LEVEL_POINTS, surface.tree.n))
    distances, nearest = distances.reshape(steps * count, -1), nearest.reshape(steps * count, -1)
    weights = 1 / np.maximum(distances, CLOSEST) ** 2
    own = (weights * surface.occupancies[nearest]).sum(axis=1) / weights.sum(axis=1)
    level = np.clip(np.where(distances[:, 0] < SEEN, own, UNSEEN_LEVEL), *levels)
    depths = _logit(_occupancy(surface.field, x.reshape(-1, 3))) - _logit(level)
    return depths.reshape(steps, count).max(axis=1)


def _occupancy(field: DescriptorField, x: Float[np.ndarray, "points 3"]) -> Float[np.ndarray, " points"]:
    padded = np.zeros((-(-len(x) // PADDING) * PADDING, 3), np.float32)
    padded[: len(x)] = x
    return np.asarray(field.occupancy(jnp.asarray(padded)), float)[: len(x)]


def _logit(occupancy: np.ndarray) -> np.ndarray:
    occupancy = np.clip(occupancy, TINY, 1 - TINY)
    return np.log(occupancy / (1 - occupancy))


def _first_touch(steps: np.ndarray, depths: np.ndarray) -> float:
    """Where the depth crosses zero: on the way down if the middle is free, on the way up if it is not."""
    middle = len(steps) // 2
    touches = depths > 0
    if touches[middle]:
        free = np.flatnonzero(~touches[:middle])
        low = free[-1] if len(free) else None
    else:
        hit = np.flatnonzero(touches[middle:])
        low = middle + hit[0] - 1 if len(hit) else None
    if low is None:
        return np.nan
    share = -depths[low] / (depths[low + 1] - depths[low])
    return float(steps[low] + share * (steps[low + 1] - steps[low]))
