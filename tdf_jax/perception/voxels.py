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


def distinct_rows(
    cells: Int[np.ndarray, "points columns"],
) -> tuple[Int[np.ndarray, " distinct"], Int[np.ndarray, " points"], Int[np.ndarray, " distinct"]]:
    """Find the distinct rows of whole numbers, as `np.unique` of an axis does, but several times faster.

    Args:
        cells: rows of numbers, (points, columns).

    Returns:
        Index of the first of each distinct row, in the order of the rows; the distinct row of every point; and the
        number of points of each.
    """
    low, extent = cells.min(axis=0), np.ptp(cells, axis=0) + 1
    if np.prod(extent.astype(float)) < 2**62:
        keys = np.zeros(len(cells), np.int64)
        for column, start, size in zip(cells.T, low, extent):
            keys = keys * size + (column - start)
        _, first, index, counts = np.unique(keys, return_index=True, return_inverse=True, return_counts=True)
    else:
        _, first, index, counts = np.unique(cells, axis=0, return_index=True, return_inverse=True, return_counts=True)
    return first, index.reshape(-1), counts


def voxels_of(points: Float[np.ndarray, "points 3"], edge: float) -> Voxels:
    """Find the occupied cells of a grid.

    Args:
        points: points, (points, 3), metres, in their canonical order.
        edge: edge of a cell, metres.
    """
    every = np.floor(points / edge).astype(np.int64)
    first, index, counts = distinct_rows(every)
    cells = every[first]
    sums = np.stack([np.bincount(index, column, len(cells)) for column in points.T], axis=1)
    return Voxels(cells, index, sums / counts[:, None], counts)
