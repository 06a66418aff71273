"""Seating: how far an object is lowered or raised until it touches its target, by the occupancies of both."""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from tdf_jax.geometry import se3
from tdf_jax.networks.field import DescriptorField

REACH = 0.015  # metres; an object that touches nothing within it is not moved
STEPS = 15  # tested displacements each way; between them the occupancy is interpolated
OCCUPIED = 0.5  # occupancy that counts as touching
RANK = 2  # the touch is that of the second point, so that one wrong value does not decide
NEIGHBOURS = 4  # points half way to the nearest neighbours are tested too: few points of a cloud are on a thin peg
BESIDE = 0.01  # metres across the direction within which a point may meet the other object
SIDEWAYS = 2.0  # weight of the distance across the direction when those points are chosen
POINTS = 512  # points of each object that are tested
CLOUD = 2000  # points of each cloud that are looked at; more cost time and memory
PADDING = 128  # the points are filled up to a multiple of it, so that few programs are compiled


def touch_distance(
    field: DescriptorField,
    target: DescriptorField | None,
    points: Float[Array | np.ndarray, "points 3"],
    target_points: Float[Array | np.ndarray, "target_points 3"],
    motion: Float[Array | np.ndarray, "7"],
    direction: Float[Array | np.ndarray, "3"],
) -> float:
    """How far along a direction a placed object touches its target.

    The object and the target touch where points of the cloud of one have an occupancy of a half in the field of the
    other.

    Args:
        field: field of the object in its initial pose.
        target: field of the target; None to test the target's points in the object's field only.
        points: cloud of the object in its initial pose, (points, 3), metres, world frame.
        target_points: cloud of the target, (target_points, 3), metres, world frame.
        motion: motion of the object to the target, `wxyz_xyz`, (7,), metres.
        direction: unit vector along which the object is moved, such as down, (3,), world frame.

    Returns:
        The displacement, metres: positive along the direction if there is a gap, negative if the two overlap; NaN if
            they do not touch, or overlap still, within `REACH`.
    """
    # In NumPy but for the fields: the number of points differs from call to call, and JAX would compile for each.
    R, t = np.asarray(se3.rotation(jnp.asarray(motion)), float), np.asarray(motion, float)[4:]
    direction, target_points = np.asarray(direction, float), np.asarray(target_points, float)
    placed = np.asarray(points, float) @ R.T + t
    near, target_near = _meeting(_denser(_thinned(placed)), _denser(_thinned(target_points)), direction)
    if not len(near):
        return np.nan
    steps = np.linspace(-REACH, REACH, 2 * STEPS + 1)
    shifts = steps[:, None, None] * direction
    occupied = [_ranked_occupancy(field, (target_near - shifts - t) @ R)]
    if target is not None:
        occupied.append(_ranked_occupancy(target, near + shifts))
    return _first_touch(steps, np.max(occupied, axis=0))


def _thinned(points: np.ndarray) -> np.ndarray:
    """At most `CLOUD` points, the same for the same cloud."""
    if len(points) <= CLOUD:
        return points
    return points[np.sort(np.random.default_rng(0).choice(len(points), CLOUD, replace=False))]


def _denser(points: np.ndarray) -> np.ndarray:
    """A cloud and the points half way between neighbours."""
    from scipy.spatial import KDTree

    nearest = np.asarray(KDTree(points).query(points, min(NEIGHBOURS + 1, len(points)))[1]).reshape(len(points), -1)
    # The first is the point itself. Neighbourhoods are not mutual, and a pair that is counts once.
    pairs = np.stack([np.repeat(nearest[:, 0], nearest.shape[1] - 1), nearest[:, 1:].ravel()], axis=1)
    one, other = np.unique(np.sort(pairs, axis=1), axis=0).T
    return np.concatenate([points, (points[one] + points[other]) / 2])


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


def _ranked_occupancy(field: DescriptorField, x: Float[np.ndarray, "steps count 3"]) -> Float[np.ndarray, " steps"]:
    """The occupancy of the `RANK`-th point at every displacement."""
    steps, count, _ = x.shape
    padded = np.zeros((steps, -(-count // PADDING) * PADDING, 3), np.float32)
    padded[:, :count] = x
    occupancy = np.asarray(field.occupancy(jnp.asarray(padded.reshape(-1, 3)))).reshape(steps, -1)[:, :count]
    return np.sort(occupancy, axis=1)[:, -min(RANK, count)]


def _first_touch(steps: np.ndarray, occupied: np.ndarray) -> float:
    """Where the occupancy crosses a half: on the way down if the middle is free, on the way up if it is not."""
    middle = len(steps) // 2
    touches = occupied > OCCUPIED
    if touches[middle]:
        free = np.flatnonzero(~touches[:middle])
        low = free[-1] if len(free) else None
    else:
        hit = np.flatnonzero(touches[middle:])
        low = middle + hit[0] - 1 if len(hit) else None
    if low is None:
        return np.nan
    share = (OCCUPIED - occupied[low]) / (occupied[low + 1] - occupied[low])
    return float(steps[low] + share * (steps[low + 1] - steps[low]))
