"""Points in the cells of a grid that is fixed in the world, so that no point decides where another one's cell is."""

import dataclasses

import numpy as np
from jaxtyping import Float, Int

MIXERS = np.array([0x9E3779B97F4A7C15, 0xC2B2AE3D27D4EB4F, 0x165667B19E3779F9], np.uint64)  # of a cell's three numbers


@dataclasses.dataclass(frozen=True, eq=False)
class Voxels:
    """Occupied cells of a grid.

    Attributes:
        cells: whole coordinates of each cell, (voxels, 3), in the order of their numbers.
        index: row of `cells` of every point, (points,).
        means: mean of the points in each cell, (voxels, 3), metres.
        counts: number of points in each cell, (voxels,).
    """

    cells: Int[np.ndarray, "voxels 3"]
    index: Int[np.ndarray, " points"]
    means: Float[np.ndarray, "voxels 3"]
    counts: Int[np.ndarray, " voxels"]

    def spread(self, count: int) -> Int[np.ndarray, " chosen"]:
        """Choose cells as if at random, by a hash of their coordinates: another cell changes at most one of them."""
        mixed = (self.cells.astype(np.int64).view(np.uint64) * MIXERS).sum(axis=1, dtype=np.uint64)
        mixed ^= mixed >> np.uint64(31)
        mixed *= MIXERS[0]
        return np.sort(np.argsort(mixed, kind="stable")[:count])


def canonical_order(points: Float[np.ndarray, "points 3"]) -> Int[np.ndarray, " points"]:
    """Order of points that depends on their coordinates alone: sums in this order do not depend on the given one."""
    return np.lexsort(points.T)


def voxels_of(points: Float[np.ndarray, "points 3"], edge: float) -> Voxels:
    """Find the occupied cells of a grid.

    Args:
        points: points, (points, 3), metres, in their canonical order.
        edge: edge of a cell, metres.
    """
    cells, index, counts = np.unique(
        np.floor(points / edge).astype(np.int64), axis=0, return_inverse=True, return_counts=True
    )
    index = index.reshape(-1)
    sums = np.stack([np.bincount(index, column, len(cells)) for column in points.T], axis=1)
    return Voxels(cells, index, sums / counts[:, None], counts)
