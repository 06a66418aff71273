"""One optimisation step's samples: pairs of objects as sensors give them, with labelled points and places to recognise."""

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

DIAGONALS = (0.08, 0.5)  # metres; every draw rescales its pair to a diagonal log-uniform in this range
USUAL_DIAGONALS = (0.12, 0.25)  # or, half of the time, in this one, a real mug's
PAIR_SPREAD = 0.15  # objects come in pairs of about one size: each is off the pair's by up to this share
VALIDATION_DIAGONAL = 0.18  # metres
DENSE = 2000  # points a complete cloud is thinned from

# What a sensor does to clouds, at full corruption.
PARTIAL_SHARE = 0.6  # of the clouds: seen by one, two or four cameras
SPARSE_SHARE = 0.3  # of the clouds: of `SPARSE_CLOUDS` points before thinning, log-uniform
SPARSE_CLOUDS = (300, DENSE)
# of the clouds: normal noise with a standard deviation of up to `NOISE` of the diagonal, 2.5 mm on a real mug
NOISY_SHARE = 0.3
NOISE = 0.015
OUTLIER_SHARE = 0.2  # of the clouds: some points anywhere in the padded box
OUTLIERS = 0.005  # of the points, at most; thinning by farthest points keeps nearly all: up to 4 % of a thinned cloud

# Boxes of query points, shown at a place of one object of a pair and offered to the other at the same place and at
# wrong poses.
FIRST_SHARE = 0.6  # of the boxes at the first place of an object, a mug's handle; the others share the rest
BOX_SIDES = (0.25, 0.55)  # of the pair's diagonal
REMOTE_SHARE = 0.35  # of the boxes: not at the place itself but carried along with it
REMOTE_DISTANCES = (0.1, 1.5)  # of the pair's diagonal, log-uniform
GLOBAL_SHARE = 0.4  # of the wrong poses: any rotation, any position about the object; the others are near the right one
GLOBAL_SPREAD = 0.35  # standard deviation of the position, of the diagonal
NEAR_ANGLES = (3.0, 90.0)  # degrees, log-uniform
NEAR_DISTANCES = (0.01, 0.3)  # of the pair's diagonal, log-uniform
# turns about the axis that are tried for a symmetric object's equal poses: all there are, but for round ones, which
# have any
QUARTERS = 4
# of the pair's diagonal: root mean square distance of query points from where a symmetric object's right poses have
# them
LEAST_WRONG = 0.01


@dataclasses.dataclass(frozen=True)
class Batch:
    """One optimisation step's pairs of objects; every cloud is centred on its mean, metres, axes canonical.

    Attributes:
        clouds: one of each object.
        queries, inside: labelled points, relative to the cloud's mean.
        centres: origins of the objects' frames, relative to the cloud's mean.
        fold: symmetry of the objects, see `tdf_jax.symmetry`: it tells which of the frame's axes there are.
        shown: query points at a place of each object, relative to its mean.
        offered: the same query points on the pair's other object, relative to that one's mean: first where the place
            has them there, at `QUARTERS` poses that the object's symmetry makes equal, some of them the same, then at
            wrong poses.
    """

    clouds: Float[np.ndarray, "pairs 2 points 3"]
    queries: Float[np.ndarray, "pairs 2 queries 3"]
    inside: Float[np.ndarray, "pairs 2 queries"]
    centres: Float[np.ndarray, "pairs 2 3"]
    fold: Float[np.ndarray, "pairs 2"]
    shown: Float[np.ndarray, "pairs 2 box 3"]
    offered: Float[np.ndarray, "pairs 2 offers box 3"]


def draw(
    data: DataSet,
    rng: np.random.Generator,
    pairs: int,
    points: int,
    queries: int,
    corruption: float,
    box: int,
    poses: int,
) -> Batch:
    """Draw one batch.

    Args:
        data: the objects.
        rng: source of chance; a function of the seed and the step, so that a resumed run draws the same.
        pairs: pairs of objects in it.
        points: points of every cloud, thinned by farthest points: 256 random ones drown the small asymmetries by which
            a network finds the object's frame.
        queries: labelled points of every object.
        corruption: how far clouds have come from complete ones (0) to what sensors give (1).
        box: query points of a place.
        poses: poses they are offered at, the right one, with its equals, counted once.
    """
    drawn = []
    for _ in range(pairs):
        diagonal = _log_uniform(rng, USUAL_DIAGONALS if rng.uniform() < 0.5 else DIAGONALS)
        samples = []
        for which in range(2):
            if which == 0:  # all sources alike, and all kinds of one, however many objects they have
                kind = _one_of(rng, _one_of(rng, data.sources))
            # A partner is of the same kind: places mean the same on both, and what leaves one as it is leaves the
            # other.
            index = data.kinds[kind][rng.integers(len(data.kinds[kind]))]
            cloud = thin(_sensed(data, rng, index, corruption, points), points)
            chosen = rng.integers(data.queries.shape[1], size=queries)
            size = diagonal * math.exp(rng.uniform(-PAIR_SPREAD, PAIR_SPREAD))
            samples.append(_sample(data, index, cloud, chosen, size))
        drawn.append(_pair(rng, samples, diagonal, box, poses))
    return Batch(*(np.stack(column).astype(np.float32) for column in zip(*drawn)))


def _one_of(rng, choices):
    return choices[rng.integers(len(choices)) if len(choices) > 1 else 0]


def _sensed(data, rng, index, corruption, points):
    """Points of an object as a sensor may give them, at least as many as the cloud needs."""
    surface, count = data.surface[index], DENSE
    if rng.uniform() < PARTIAL_SHARE * corruption:
        # Four cameras first; fewer as the corruption grows.
        likely = np.array([1.0, corruption, corruption**2])
        used = rng.choice(data.visible.shape[1], rng.choice([4, 2, 1], p=likely / likely.sum()), replace=False)
        seen = surface[data.visible[index, used].any(axis=0)]
        surface = seen if len(seen) >= points else surface
    if rng.uniform() < SPARSE_SHARE * corruption:
        count = int(_log_uniform(rng, SPARSE_CLOUDS))
    cloud = rng.permutation(surface)[: max(points, count)]
    if rng.uniform() < NOISY_SHARE * corruption:
        cloud = cloud + rng.normal(size=cloud.shape) * rng.uniform(0, NOISE)
    if rng.uniform() < OUTLIER_SHARE * corruption:
        low, high = surface.min(axis=0) - BOX_PADDING, surface.max(axis=0) + BOX_PADDING
        astray = rng.choice(len(cloud), int(len(cloud) * rng.uniform(0, OUTLIERS)), replace=False)
        cloud[astray] = rng.uniform(low, high, (len(astray), 3))
    return cloud


def validation_pairs(data: DataSet, points: int, box: int, poses: int, one_view: bool) -> list[Batch]:
    """Objects in pairs of a kind, for measuring: a diagonal of `VALIDATION_DIAGONAL`, all uniform queries.

    Args:
        data: the objects.
        points, box, poses: as in `draw`.
        one_view: clouds of what the first camera sees, not complete ones.
    """
    samples = []
    for index in data.pairs().ravel():
        surface, queries = data.surface[index], np.arange(data.queries.shape[1])[data.uniform]
        surface = surface[data.visible[index, 0]] if one_view else surface
        samples.append(_sample(data, index, thin(surface, points), queries, VALIDATION_DIAGONAL))
    rng = np.random.default_rng(0)
    pairs = [
        _pair(rng, pair, VALIDATION_DIAGONAL, box, poses) for pair in zip(samples[::2], samples[1::2], strict=True)
    ]
    return [Batch(*(np.asarray(field, np.float32) for field in pair)) for pair in pairs]


class _Sample(NamedTuple):
    """One object of a batch, centred on its cloud's mean, metres."""

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


def _pair(rng, samples, diagonal, box, poses):
    """The fields of `Batch`: two samples of a kind, and query points shown at a place of each and offered to the other."""
    shown, offered = [], []
    for a, b in (samples, samples[::-1]):
        place = 0 if rng.uniform() < FIRST_SHARE else rng.integers(1, len(a.places))
        x = rng.uniform(-0.5, 0.5, (box, 3)) * rng.uniform(*BOX_SIDES) * diagonal
        T_place_query = np.eye(4)
        T_place_query[:3, :3] = Rotation.random(random_state=rng).as_matrix()
        if rng.uniform() < REMOTE_SHARE:
            T_place_query[:3, 3] = _direction(rng) * _log_uniform(rng, REMOTE_DISTANCES) * diagonal
        shown.append(_apply(a.places[place] @ T_place_query, x))
        right = b.places[place] @ T_place_query
        wrong = [_unlike(rng, right, diagonal, x, b) for _ in range(poses - 1)]
        offered.append([_apply(T, x) for T in (*_equals(right, b), *wrong)])
    fields = (
        np.stack([getattr(sample, name) for sample in samples])
        for name in ("cloud", "queries", "inside", "centre", "fold")
    )
    return *fields, shown, offered


def _equals(right, target):
    """The right pose after each quarter turn about the target's axis; turns that its symmetry does not allow are replaced by none."""
    T_mean_object = np.eye(4)
    T_mean_object[:3, 3] = target.centre
    turned = [
        T_mean_object @ about_z(quarter * np.pi / 2) @ np.linalg.inv(T_mean_object) @ right
        for quarter in range(QUARTERS)
    ]
    return [turned[quarter if quarter * target.fold % QUARTERS == 0 else 0] for quarter in range(QUARTERS)]


def _unlike(rng, right, diagonal, x, target):
    """A pose that no symmetry of the target makes a right one: turned about its axis, a round bowl looks the same."""
    while True:
        wrong = _wrong(rng, right, diagonal)
        if target.fold == 1:
            return wrong
        there, here = (_apply(T, x) - target.centre for T in (wrong, right))
        nearest = here @ about_z(nearest_turn(there, here, target.fold))[:3, :3].T
        if np.sqrt(np.mean(np.sum((there - nearest) ** 2, axis=1))) > LEAST_WRONG * diagonal:
            return wrong


def _wrong(rng, right, diagonal):
    """A pose away from the right one: turned about the query frame's own origin, and shifted."""
    wrong = right.copy()
    if rng.uniform() < GLOBAL_SHARE:
        wrong[:3, :3] = Rotation.random(random_state=rng).as_matrix()
        wrong[:3, 3] = right[:3, 3] * rng.uniform(0, 1) + rng.normal(size=3) * GLOBAL_SPREAD * diagonal
        return wrong
    kind = rng.integers(3)  # turned, shifted, both
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
