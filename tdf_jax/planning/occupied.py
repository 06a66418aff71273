"""An obstacle from a field: the object as its network knows it."""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from tdf_jax._internal import checks
from tdf_jax._internal.errors import InputError
from tdf_jax.geometry.distance_fields import DistanceGrid, check_lengths, grid_nodes, tabulated
from tdf_jax.networks.field import DescriptorField

FIELD_BLOCK = 8192  # points of a field evaluated in one call: one size, so that objects of all sizes run one program


# Occupancies are asked within this of the cloud's bounding box, metres: farther away the network knows no shapes, and
# of four mugs sampled to 0.2 m about them all had solid blobs in the air. Pieces of surface farther than this from all
# points are left out as well.
FIELD_REACH = 0.015


def field_obstacle(
    field: DescriptorField, points: Float[Array, "points 3"], pitch: float = 0.003, pad: float = 0.03
) -> DistanceGrid:
    """The object itself to keep clear of, as its field knows it: the surface is where the occupancy is a half.

    The field tells hidden sides too, which the cloud does not. Refine it first (`refine`): this is what that is for.
    How far from true the distances are, docs/results/clearance.md tells.

    Args:
        field: The object's.
        points: Its cloud, metres, world frame; it tells where to look for surface: up to 15 mm away from its bounding
            box.
        pitch: Of the grid, metres; half of a wall's thickness or less, or the wall is lost in places.
        pad: How far the grid reaches beyond the points, metres; more than the margin that is kept.

    Returns:
        The obstacle.

    Raises:
        InputError: The points are not a cloud, pitch or pad is not above 0, the grid has more than 4 million nodes, or
            the field has no surface within 15 mm of the points.
    """
    from scipy.ndimage import label
    from scipy.spatial import cKDTree

    points = np.asarray(checks.points("field_obstacle()", points), float)
    check_lengths("field_obstacle", pitch, pad)
    x = grid_nodes("field_obstacle", points, pitch, FIELD_REACH + pitch)
    flat = np.asarray(x.reshape(-1, 3), field.origin.dtype)
    blocks = [flat[i : i + FIELD_BLOCK] for i in range(0, len(flat), FIELD_BLOCK)]
    blocks = [_excess(field, np.resize(block, (FIELD_BLOCK, 3)))[: len(block)] for block in blocks]
    excess = np.concatenate(blocks).reshape(x.shape[:3]).astype(float)
    # Solid at the border of what was asked would be cut open there.
    border = np.ones(excess.shape, bool)
    border[1:-1, 1:-1, 1:-1] = False
    excess[border] = np.minimum(excess[border], -1e-3)
    pieces, count = label(excess > 0, np.ones((3, 3, 3)))
    near = cKDTree(points).query(x[pieces > 0])[0] < FIELD_REACH
    kept = np.isin(pieces, np.unique(pieces[pieces > 0][near]))
    if not kept.any():
        raise InputError(
            f"field_obstacle(): of {count} solid pieces none lies within {FIELD_REACH} m of the points; expected the object's surface there; "
            "give the cloud that was encoded, or refine the field"
        )
    excess = np.where((pieces > 0) & ~kept, -1e-3, excess)
    surface = []
    for axis in range(3):
        values, places = np.moveaxis(excess, axis, 0), np.moveaxis(x, axis, 0)
        crosses = (values[1:] > 0) != (values[:-1] > 0)
        part = (values[:-1] / np.where(crosses, values[:-1] - values[1:], 1))[crosses][:, None]
        surface.append(places[:-1][crosses] * (1 - part) + places[1:][crosses] * part)
    tree = cKDTree(np.concatenate(surface))

    def signed(nodes):
        away = tree.query(nodes)[0]
        place = np.round((nodes - x[0, 0, 0]) / pitch).astype(int)
        known = ((place >= 0) & (place < excess.shape)).all(axis=-1)
        inside = known & (excess[tuple(np.where(known[:, None], place, 0).T)] > 0)
        return np.where(inside, -away, away)

    # The same nodes and some around them: their signs are those of the occupancies.
    around = pitch * max(int(np.ceil((pad - FIELD_REACH - pitch) / pitch)), 0)
    return tabulated("field_obstacle", x[[0, -1], [0, -1], [0, -1]], pitch, max(around, 1e-9), signed)


@jax.jit
def _excess(field, x):
    """Log odds of the occupancy: nearer to linear across the surface than the occupancy is."""
    occupancy = jnp.clip(field.occupancy(x), 1e-6, 1 - 1e-6)
    return jnp.log(occupancy / (1 - occupancy))
