"""Samples of one optimisation step: pairs of objects as sensors give them, labelled points and places to recognise."""

import dataclasses
import math
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from tdf_jax.geometry.sampling import thin
from tdf_jax.geometry.symmetry import about_z, nearest_turn
from tdf_jax.training.dataset import DataSet
from tdf_jax.training.labels import BOX_PADDING

DIAGONALS = (0.08, 0.5)  # metres; every draw rescales its pair to a diagonal that is log-uniform in this range
USUAL_DIAGONALS = (0.12, 0.25)  # metres; half of the draws use this range instead, that of real mugs
PAIR_SPREAD = 0.15  # the objects of a pair have about one size: each differs from the pair's by up to this share
VALIDATION_DIAGONAL = 0.18  # diagonal of validation objects, metres
DENSE_POINTS = 2000  # points of a complete cloud before farthest-point sampling

# Corruptions of clouds by a sensor, at full strength. Shares are of the clouds.
PARTIAL_SHARE = 0.6  # clouds that one, two or four cameras see
SPARSE_SHARE = 0.3  # clouds whose density before farthest-point sampling is log-uniform in `SPARSE_POINTS`
SPARSE_POINTS = (300, DENSE_POINTS)
# Clouds with normal noise, whose standard deviation is at most `NOISE` of the diagonal: 2.5 mm on a real mug.
NOISY_SHARE = 0.3
NOISE = 0.015
OUTLIER_SHARE = 0.2  # clouds with some points anywhere in the padded box
OUTLIERS = 0.005  # largest share of such points; farthest-point sampling keeps nearly all: up to 4 % of a subsample

# A box of query points is demonstrated at a place of one object of a pair. Candidates on the other object are the same
# place and wrong poses.
FIRST_SHARE = 0.6  # share of the boxes at the first place of an object, a mug's handle; the other places share the rest
BOX_SIDES = (0.25, 0.55)  # edges of a box, shares of the pair's diagonal
REMOTE_SHARE = 0.35  # share of the boxes that are not at the place but fixed to it at a distance
REMOTE_DISTANCES = (0.1, 1.5)  # distances from the place, shares of the pair's diagonal, log-uniform
# Share of the wrong poses with any rotation and any position about the object; the others are near the right pose.
GLOBAL_SHARE = 0.4
GLOBAL_SPREAD = 0.35  # standard deviation of the position, share of the diagonal
NEAR_ANGLES = (3.0, 90.0)  # rotation errors of wrong poses, degrees, log-uniform
NEAR_DISTANCES = (0.01, 0.3)  # translation errors, shares of the pair's diagonal, log-uniform
# Rotations about the axis that are tried for the equivalent poses of a symmetric object: these are all of them, except
# of a round object, which has any.
QUARTERS = 4
# Least root mean square distance between query points of wrong and right poses, share of the pair's diagonal.
MIN_WRONG = 0.01


@dataclasses.dataclass(frozen=True)
class Batch:
    """Pairs of objects of one optimisation step; every object in its canonical axes, relative to its cloud's mean.

    Attributes:
        clouds: point clouds, (pairs, 2, points, 3), metres.
        queries: labelled query points, (pairs, 2, queries, 3), metres.
        inside: 1 for query points inside the object, 0 outside, (pairs, 2, queries).
        centres: origins of the objects' frames, (pairs, 2, 3), metres.
        fold: symmetry of the objects, (pairs, 2), see `tdf_jax.geometry.symmetry`; it determines which axes of the
            frame exist.
        demonstrated: query points at a place of each object, (pairs, 2, box, 3), metres.
        offered: the same query points on the other object of the pair, (pairs, 2, offers, box, 3), metres: first at the
            `QUARTERS` right poses, which are equivalent by the object's symmetry and may coincide, then at wrong poses.
    """

    clouds: Float[np.ndarray, "pairs 2 points 3"]
    queries: Float[np.ndarray, "pairs 2 queries 3"]
    inside: Float[np.ndarray, "pairs 2 queries"]
    centres: Float[np.ndarray, "pairs 2 3"]
    fold: Float[np.ndarray, "pairs 2"]
    demonstrated: Float[np.ndarray, "pairs 2 box 3"]
    offered: Float[np.ndarray, "pairs 2 offers box 3"]


def draw(
    data: DataSet,
    rng: np.random.Generator,
    pairs: int,
    points: int,
    queries: int,
    corruption: float,
    box: int,
    num_poses: int,
) -> Batch:
    """Draw one batch.

    Args:
        data: objects to draw from.
        rng: random generator, a function of the seed and the step, so that a resumed run draws the same.
        pairs: number of pairs of objects.
        points: points of every cloud. They are a farthest-point subsample: random points drown the small asymmetries by
            which a network finds the object's frame.
        queries: labelled query points of every object.
        corruption: share of what sensors do to clouds, 0 to 1.
        box: query points in the box at a place.
        num_poses: candidate poses of the box; the right pose and its equivalents count once.

    Returns:
        The batch, in float32.
    """
    drawn = []
    for _ in range(pairs):
        diagonal = _log_uniform(rng, USUAL_DIAGONALS if rng.uniform() < 0.5 else DIAGONALS)
        samples = []
        for which in range(2):
            if which == 0:  # every source is as likely, and every kind of a source, whatever their numbers of objects
                kind = _one_of(rng, _one_of(rng, data.sources))
            # A partner is of the same kind: places correspond, and both have the same symmetry.
            index = data.kinds[kind][rng.integers(len(data.kinds[kind]))]
            cloud = thin(_sensed(data, rng, index, corruption, points), points)
            chosen = rng.integers(data.queries.shape[1], size=queries)
            size = diagonal * math.exp(rng.uniform(-PAIR_SPREAD, PAIR_SPREAD))
            samples.append(_sample(data, index, cloud, chosen, size))
        drawn.append(_pair(rng, samples, diagonal, box, num_poses))
    return Batch(*(np.stack(column).astype(np.float32) for column in zip(*drawn)))


def _one_of(rng, choices):
    return choices[rng.integers(len(choices)) if len(choices) > 1 else 0]


def _sensed(data, rng, index, corruption, points):
    """Points of an object as a sensor may give them, at least as many as the cloud needs."""
    surface, count = data.surface[index], DENSE_POINTS
    if rng.uniform() < PARTIAL_SHARE * corruption:
        # Slight corruption uses four cameras, stronger corruption fewer.
        likely = np.array([1.0, corruption, corruption**2])
        used = rng.choice(data.visible.shape[1], rng.choice([4, 2, 1], p=likely / likely.sum()), replace=False)
        seen = surface[data.visible[index, used].any(axis=0)]
        surface = seen if len(seen) >= points else surface
    if rng.uniform() < SPARSE_SHARE * corruption:
        count = int(_log_uniform(rng, SPARSE_POINTS))
    cloud = rng.permutation(surface)[: max(points, count)]
    if rng.uniform() < NOISY_SHARE * corruption:
        cloud = cloud + rng.normal(size=cloud.shape) * rng.uniform(0, NOISE)
    if rng.uniform() < OUTLIER_SHARE * corruption:
        low, high = surface.min(axis=0) - BOX_PADDING, surface.max(axis=0) + BOX_PADDING
        astray = rng.choice(len(cloud), int(len(cloud) * rng.uniform(0, OUTLIERS)), replace=False)
        cloud[astray] = rng.uniform(low, high, (len(astray), 3))
    return cloud


def validation_pairs(data: DataSet, points: int, box: int, num_poses: int, one_view: bool) -> list[Batch]:
    """Pairs of validation objects of one kind, at a diagonal of `VALIDATION_DIAGONAL`, with all uniform queries.

    Args:
        data: validation objects.
        points: points of every cloud.
        box: query points in the box at a place.
        num_poses: candidate poses of the box; the right pose and its equivalents count once.
        one_view: whether clouds are what the first camera sees, instead of complete ones.

    Returns:
        One batch without a pairs axis for every pair, in float32.
    """
    samples = []
    for index in data.pairs().ravel():
        surface, queries = data.surface[index], np.arange(data.queries.shape[1])[data.uniform]
        surface = surface[data.visible[index, 0]] if one_view else surface
        samples.append(_sample(data, index, thin(surface, points), queries, VALIDATION_DIAGONAL))
    rng = np.random.default_rng(0)
    pairs = [
        _pair(rng, pair, VALIDATION_DIAGONAL, box, num_poses) for pair in zip(samples[::2], samples[1::2], strict=True)
    ]
    return [Batch(*(np.asarray(field, np.float32) for field in pair)) for pair in pairs]


class _Sample(NamedTuple):
    """One object of a batch, relative to its cloud's mean, metres."""

    cloud: np.ndarray
    queries: np.ndarray
    inside: np.ndarray
    centre: np.ndarray
    fold: int
    places: np.ndarray


def _sample(data, index, cloud, chosen, size):
    origin = cloud.mean(axis=0)
    places = data.places[index].copy()
    places[:, :3, 3] = (places[:, :3, 3] - origin) * size
    queries, inside = (data.queries[index, chosen] - origin) * size, data.inside[index, chosen]
    return _Sample((cloud - origin) * size, queries, inside, -origin * size, int(data.fold[index]), places)


def _pair(rng, samples, diagonal, box, num_poses):
    """Fill the fields of `Batch` from two samples of one kind: query points at a place of each and on the other one."""
    demonstrated, offered = [], []
    for a, b in (samples, samples[::-1]):
        place = 0 if rng.uniform() < FIRST_SHARE else rng.integers(1, len(a.places))
        x = rng.uniform(-0.5, 0.5, (box, 3)) * rng.uniform(*BOX_SIDES) * diagonal
        T_place_query = np.eye(4)
        T_place_query[:3, :3] = Rotation.random(None, rng).as_matrix()
        if rng.uniform() < REMOTE_SHARE:
            T_place_query[:3, 3] = _direction(rng) * _log_uniform(rng, REMOTE_DISTANCES) * diagonal
        demonstrated.append(_apply(a.places[place] @ T_place_query, x))
        right = b.places[place] @ T_place_query
        wrong = [_unlike(rng, right, diagonal, x, b) for _ in range(num_poses - 1)]
        offered.append([_apply(T, x) for T in (*_equals(right, b), *wrong)])
    fields = (
        np.stack([getattr(sample, name) for sample in samples])
        for name in ("cloud", "queries", "inside", "centre", "fold")
    )
    return *fields, demonstrated, offered


def _equals(right, target):
    """Rotate the right pose about the target's axis by multiples of 90 degrees that the symmetry allows, else by 0."""
    T_mean_object = np.eye(4)
    T_mean_object[:3, 3] = target.centre
    rotated = [
        T_mean_object @ about_z(quarter * np.pi / 2) @ np.linalg.inv(T_mean_object) @ right
        for quarter in range(QUARTERS)
    ]
    return [rotated[quarter if quarter * target.fold % QUARTERS == 0 else 0] for quarter in range(QUARTERS)]


def _unlike(rng, right, diagonal, x, target):
    """Draw a wrong pose that is not equivalent to the right one, as a round bowl's rotation about its axis would be."""
    while True:
        wrong = _wrong(rng, right, diagonal)
        if target.fold == 1:
            return wrong
        there, here = (_apply(T, x) - target.centre for T in (wrong, right))
        nearest = here @ about_z(nearest_turn(there, here, target.fold))[:3, :3].T
        if np.sqrt(np.mean(np.sum((there - nearest) ** 2, axis=1))) > MIN_WRONG * diagonal:
            return wrong


def _wrong(rng, right, diagonal):
    """Draw a pose that differs from the right one by a rotation about the query frame's origin and a translation."""
    wrong = right.copy()
    if rng.uniform() < GLOBAL_SHARE:
        wrong[:3, :3] = Rotation.random(None, rng).as_matrix()
        wrong[:3, 3] = right[:3, 3] * rng.uniform(0, 1) + rng.normal(size=3) * GLOBAL_SPREAD * diagonal
        return wrong
    kind = rng.integers(3)  # rotated, translated, both
    if kind != 1:
        angle = np.radians(_log_uniform(rng, NEAR_ANGLES))
        wrong[:3, :3] = Rotation.from_rotvec(angle * _direction(rng)).as_matrix() @ right[:3, :3]
    if kind != 0:
        wrong[:3, 3] += _direction(rng) * _log_uniform(rng, NEAR_DISTANCES) * diagonal
    return wrong


def _apply(T, x):
    return x @ T[:3, :3].T + T[:3, 3]


def _direction(rng):
    direction = rng.normal(size=3)
    return direction / np.linalg.norm(direction)


def _log_uniform(rng, limits):
    return math.exp(rng.uniform(*np.log(limits)))
