"""Where to look from next: towards the surface that the field expects and no camera has seen."""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from tdf_jax.geometry import se3
from tdf_jax.networks.field import DescriptorField

CELLS = 20  # of the grid, along each side: 8000 occupancies
REACH = 1.3  # half of its side, in distances of the farthest point of the cloud from their mean
UNSEEN = 0.2  # of that distance: expected surface that far from the cloud has not been seen; a cell is 0.14 wide
FEWEST = 5  # cells of it; fewer are the roughness of the grid
SEEN = 20  # points of the cloud near the place of a pick, from which it is seen


def look_from(field: DescriptorField, points: Float[Array | np.ndarray, "points 3"]) -> Float[np.ndarray, "3"]:
    """Direction from an object towards a camera that would see what is expected and not seen yet.

    Args:
        field: field of the object.
        points: its cloud, (points, 3), metres, world frame.

    Returns:
        Unit vector, (3,), world frame; NaN if all that the field expects has been seen.
    """
    from scipy.ndimage import binary_erosion
    from scipy.spatial import KDTree

    cloud = np.asarray(points, float)
    middle = cloud.mean(axis=0)
    size = float(np.linalg.norm(cloud - middle, axis=1).max())
    side = np.linspace(-REACH * size, REACH * size, CELLS)
    grid = np.stack(np.meshgrid(side, side, side, indexing="ij"), axis=-1) + middle
    inside = np.asarray(field.occupancy(jnp.asarray(grid.reshape(-1, 3), jnp.float32))).reshape(grid.shape[:3]) > 0.5
    surface = grid[inside & (binary_erosion(inside) == 0)]
    if not len(surface):
        return np.full(3, np.nan)
    unseen = surface[KDTree(cloud).query(surface)[0] > UNSEEN * size]
    away = unseen.mean(axis=0) - grid[inside].mean(axis=0) if len(unseen) >= FEWEST else np.zeros(3)
    length = float(np.linalg.norm(away))
    return away / length if length > 0 else np.full(3, np.nan)


def points_at(
    points: Float[Array | np.ndarray, "points 3"],
    pick: Float[Array | np.ndarray, "7"],
    query: Float[Array | np.ndarray, "queries 3"],
) -> int:
    """How many points of a cloud are in the box of the query points at a pick.

    Args:
        points: cloud of the object, (points, 3), metres, world frame.
        pick: pose of the query frame, `wxyz_xyz`, (7,).
        query: query points, (queries, 3), metres, query frame.
    """
    R, t = np.asarray(se3.rotation(jnp.asarray(pick)), float), np.asarray(pick, float)[4:]
    local, box = (np.asarray(points, float) - t) @ R, np.asarray(query, float)
    return int(((local >= box.min(axis=0)) & (local <= box.max(axis=0))).all(axis=1).sum())
