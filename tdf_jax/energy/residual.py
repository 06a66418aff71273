"""Evidence of a match: the part of the descriptors that a pick does not match, and how a field fits its own cloud."""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from tdf_jax.networks.field import DescriptorField

MAX_POINTS = 1500  # points of a cloud; the fixed number lets clouds of all sizes run one program
MAX_LOGIT = 3.0  # larger occupancy logits are clipped, so that a few stray points do not dominate their mean


def pick_residual(energy: float, descriptors: Float[Array, "queries channels"]) -> float:
    """Energy of a pick, divided by the energy of a match in which all query points have the mean descriptor.

    The ratio has no unit and is 0 for a perfect match. The spread of descriptors differs between networks and between
    sets of query points; the ratio depends on it less than the energy does.

    Args:
        energy: energy of the descriptors alone (eq. 2 of one waypoint).
        descriptors: descriptors of the demonstration at the pick, (queries, channels).

    Returns:
        The ratio; NaN if there is one query point.
    """
    values = np.asarray(descriptors)
    spread = float(np.mean(np.abs(values - values.mean(axis=0))))
    return float(energy) / spread if spread > 0 else float("nan")


def traced_pick_residual(energy: Float[Array, ""], descriptors: Float[Array, "queries channels"]) -> Float[Array, ""]:
    """Compute `pick_residual` of traced numbers; it is infinite, not NaN, if there is one query point."""
    spread = jnp.mean(jnp.abs(descriptors - jnp.mean(descriptors, axis=0)))
    return jnp.where(spread > 0, energy / jnp.where(spread > 0, spread, 1.0), jnp.inf)


def surface_logits(field: DescriptorField, points: Float[Array | np.ndarray, "points 3"]) -> Float[np.ndarray, " used"]:
    """Logits of the occupancy at an object's own points, each clipped to [-3, 3].

    Args:
        field: descriptor field of the object.
        points: object point cloud, (points, 3), metres, world frame; 1500 points, drawn with a fixed seed, are used of
            a larger one.

    Returns:
        The logits of the points that are used, (used,).
    """
    cloud = np.asarray(points, np.float32)
    if len(cloud) > MAX_POINTS:
        cloud = cloud[np.random.default_rng(0).permutation(len(cloud))[:MAX_POINTS]]
    return np.asarray(_logits(field, np.resize(cloud, (MAX_POINTS, 3))))[: len(cloud)]


@jax.jit
def _logits(field, x):
    occupancy = field.occupancy(x)
    return jnp.clip(jnp.log(occupancy) - jnp.log1p(-occupancy), -MAX_LOGIT, MAX_LOGIT)
