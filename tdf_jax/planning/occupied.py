"""An obstacle made of a descriptor field: the object itself, as its network predicts it."""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from tdf_jax._internal import checks
from tdf_jax._internal.boundary import host
from tdf_jax._internal.errors import InputError
from tdf_jax.geometry.distance_fields import DistanceGrid, grid_nodes, tabulated
from tdf_jax.networks.field import DescriptorField

# Number of points evaluated in one call; one size, so that objects of all sizes run one program.
FIELD_BLOCK = 8192
# Occupancies are evaluated within this distance of the cloud's bounding box, metres. Farther away the network was not
# trained, and it predicts solid blobs in the air. Pieces of surface farther than this from all points are ignored too.
FIELD_REACH = 0.015


@host
def field_obstacle(
    field: DescriptorField, points: Float[Array, "points 3"], pitch: float = 0.003, pad: float = 0.03
) -> DistanceGrid:
    """Make an obstacle of the object itself: the surface where the occupancy of its field is a half.

    The field includes hidden sides, which the cloud does not. Refine the field before (`refine`).
    docs/results/clearance.md lists the accuracy of the distances.

    Args:
        field: descriptor field of the object.
        points: object point cloud, (points, 3), metres, world frame; only surface within `FIELD_REACH` of its bounding
            box is used.
        pitch: distance between neighbouring nodes of the grid, metres; at most half of a wall's thickness, or the wall
            is lost in places.
        pad: distance by which the grid extends beyond the points, metres; more than the margin to keep.

    Returns:
        The obstacle.

    Raises:
        InputError: the points are not a point cloud, pitch or pad is not above 0, the grid has too many nodes, or the
            field has no surface within `FIELD_REACH` of the points.
    """
    from scipy.ndimage import label
    from scipy.spatial import KDTree

    cloud = np.asarray(checks.points("field_obstacle()", points), float)
    checks.positive("field_obstacle()", "pitch", pitch, "metres")
    checks.positive("field_obstacle()", "pad", pad, "metres")
    x = grid_nodes("field_obstacle()", cloud, pitch, FIELD_REACH + pitch)
    flat = np.asarray(x.reshape(-1, 3), field.origin.dtype)
    blocks = [flat[i : i + FIELD_BLOCK] for i in range(0, len(flat), FIELD_BLOCK)]
    blocks = [_log_odds(field, np.resize(block, (FIELD_BLOCK, 3)))[: len(block)] for block in blocks]
    log_odds = np.concatenate(blocks).reshape(x.shape[:3]).astype(float)
    # A solid that touches the border of the evaluated nodes is closed there.
    border = np.ones(log_odds.shape, bool)
    border[1:-1, 1:-1, 1:-1] = False
    log_odds[border] = np.minimum(log_odds[border], -1e-3)
    labelled: tuple[np.ndarray, int] = label(log_odds > 0, np.ones((3, 3, 3)))  # pyright: ignore[reportAssignmentType]
    pieces, count = labelled
    near = np.asarray(KDTree(cloud).query(x[pieces > 0])[0]) < FIELD_REACH
    selected = np.isin(pieces, np.unique(pieces[pieces > 0][near]))
    if not selected.any():
        raise InputError(
            f"field_obstacle(): of {count} solid pieces none is within {FIELD_REACH} m of the points; "
            "expected the object's surface there; pass the cloud that was encoded, or refine the field"
        )
    log_odds = np.where((pieces > 0) & ~selected, -1e-3, log_odds)
    tree = KDTree(_zero_crossings(log_odds, x))

    def signed(nodes):
        distance = np.asarray(tree.query(nodes)[0])
        index = np.round((nodes - x[0, 0, 0]) / pitch).astype(int)
        evaluated = ((index >= 0) & (index < log_odds.shape)).all(axis=-1)
        inside = evaluated & (log_odds[tuple(np.where(evaluated[:, None], index, 0).T)] > 0)
        return np.where(inside, -distance, distance)

    # The grid has the evaluated nodes, whose signs are those of the occupancies, and further nodes around them.
    margin = pitch * max(int(np.ceil((pad - FIELD_REACH - pitch) / pitch)), 0)
    return tabulated("field_obstacle()", x[[0, -1], [0, -1], [0, -1]], pitch, max(margin, 1e-9), signed)


def _zero_crossings(values: np.ndarray, x: np.ndarray) -> np.ndarray:
    """Points where the values change sign between neighbouring nodes, by linear interpolation."""
    crossings = []
    for axis in range(3):
        along, nodes = np.moveaxis(values, axis, 0), np.moveaxis(x, axis, 0)
        crosses = (along[1:] > 0) != (along[:-1] > 0)
        fraction = (along[:-1] / np.where(crosses, along[:-1] - along[1:], 1))[crosses][:, None]
        crossings.append(nodes[:-1][crosses] * (1 - fraction) + nodes[1:][crosses] * fraction)
    return np.concatenate(crossings)


@jax.jit
def _log_odds(field, x):
    """Log odds of the occupancy, which are closer to linear across the surface than the occupancy itself."""
    occupancy = jnp.clip(field.occupancy(x), 1e-6, 1 - 1e-6)
    return jnp.log(occupancy / (1 - occupancy))
