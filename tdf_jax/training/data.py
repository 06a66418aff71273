"""Training data: surface points and labelled query points of generated objects, and the batches drawn from them."""

import dataclasses
import math

import numpy as np
from jaxtyping import Bool, Float
from tqdm import tqdm

from tdf_jax import pointcloud
from tdf_jax.shapes import build_mug, sample_mug

UNIFORM_SHARE = 0.5  # of the query points: uniform in the padded bounding box; the rest lie near the surface
BOX_PADDING = 0.10  # of the diagonal, on every side
# Half of the points near the surface lie within a wall's thickness of it (2 mm on a real mug), half further out.
NEAR_SPREADS = (0.012, 0.05)  # standard deviations, of the diagonal
DIAGONALS = (0.12, 0.30)  # metres; every draw rescales its object to a diagonal log-uniform in this range
SPARSE_CLOUDS = (300, 2000)  # points a thinned-out cloud is drawn from, once sparse clouds are mixed in


@dataclasses.dataclass(frozen=True)
class DataSet:
    """Generated objects in their canonical frame (up +z, handle +x), scaled to unit diagonal.

    Attributes:
        surface: (objects, points, 3), uniform by area.
        queries: (objects, queries, 3); the first half uniform in the padded bounding box, the rest near the surface.
        inside: (objects, queries).
        diagonals: (objects,), metres, of the object as generated.
    """

    surface: Float[np.ndarray, "objects points 3"]
    queries: Float[np.ndarray, "objects queries 3"]
    inside: Bool[np.ndarray, "objects queries"]
    diagonals: Float[np.ndarray, " objects"]

    @property
    def uniform(self) -> slice:
        """The queries that are uniform in the padded box."""
        return slice(0, int(self.queries.shape[1] * UNIFORM_SHARE))


def generate(seed: int, objects: int, points: int = 3000, queries: int = 12000, progress: bool = True) -> DataSet:
    """Draw mugs and label query points around them; deterministic in the seed, object by object.

    Args:
        seed: any integer; disjoint seeds give disjoint sets.
        objects: how many mugs.
        points: surface points of each.
        queries: query points of each.
        progress: show a progress bar.
    """
    rows = [
        _object(np.random.default_rng([seed, index]), points, queries)
        for index in tqdm(range(objects), desc="generating mugs", disable=not progress)
    ]
    return DataSet(*(np.stack(column) for column in zip(*rows)))


def _object(rng, points, queries):
    mug = build_mug(sample_mug(rng))
    low, high = mug.mesh.bounds
    diagonal = float(np.linalg.norm(high - low))
    uniform = int(queries * UNIFORM_SHARE)
    pad = BOX_PADDING * diagonal
    box = rng.uniform(low - pad, high + pad, (uniform, 3))
    spreads = np.resize(NEAR_SPREADS, queries - uniform)[:, None] * diagonal
    near = pointcloud.sample_surface(mug.mesh, queries - uniform, rng) + rng.normal(size=(queries - uniform, 3)) * spreads
    x = np.concatenate([box, near])
    surface = pointcloud.sample_surface(mug.mesh, points, rng)
    return (surface / diagonal).astype(np.float32), (x / diagonal).astype(np.float32), mug.contains(x), np.float32(diagonal)


@dataclasses.dataclass(frozen=True)
class Batch:
    """One optimisation step's samples; clouds are centred on their mean, metres."""

    clouds: Float[np.ndarray, "batch points 3"]
    queries: Float[np.ndarray, "batch queries 3"]
    inside: Float[np.ndarray, "batch queries"]


def draw(data: DataSet, rng: np.random.Generator, batch: int, points: int, queries: int, sparse: float) -> Batch:
    """Draw one batch.

    Args:
        data: the objects.
        rng: source of chance; a function of the seed and the step, so that a resumed run draws the same.
        batch: objects in it.
        points: points of every cloud, thinned by farthest points: 256 random ones drown the small asymmetries by which a
            network finds the object's frame.
        queries: labelled points of every object.
        sparse: share of clouds thinned from few points (down to `SPARSE_CLOUDS[0]`) instead of all, for sensors' sake.
    """
    samples = []
    for index in rng.integers(len(data.surface), size=batch):
        size = math.exp(rng.uniform(*np.log(DIAGONALS)))
        sparse_size = int(math.exp(rng.uniform(*np.log(SPARSE_CLOUDS))))
        seen = max(points, sparse_size if rng.uniform() < sparse else SPARSE_CLOUDS[1])
        surface = data.surface[index, rng.choice(data.surface.shape[1], seen, replace=False)]
        chosen = rng.integers(data.queries.shape[1], size=queries)
        cloud = pointcloud.thin(surface, points)
        origin = cloud.mean(axis=0)
        samples.append(((cloud - origin) * size, (data.queries[index, chosen] - origin) * size, data.inside[index, chosen]))
    clouds, x, inside = (np.stack(column).astype(np.float32) for column in zip(*samples))
    return Batch(clouds, x, inside)
