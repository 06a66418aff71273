"""Whether an object is of the category that a network and a demonstration are for: a bottle given to a mug network is matched somehow, too."""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from tdf_jax._internal.errors import InputError
from tdf_jax.networks.field import DescriptorField

POINTS = 1500  # of the cloud that are looked at: one size, so that clouds of all sizes run one program
CUT = 3.0  # occupancy logits beyond it count no further: a few stray points must not decide

# Logistic in (-log residual, surface logit), by name of shipped weights: intercept and two slopes, fitted on right and wrong cases of seed 61 by
# `python -m bench.recognition --fit`: 40 of each for mugs, 32 for bowls and for bottles, 48 for all three. Tried on others: docs/certainty.md.
CURVES = {
    "mug": (-2.77, 6.25, 4.76),
    "bowl": (-28.5, 16.9, -2.35),
    "bottle": (-20.1, 16.7, 1.18),
    "multi": (-5.40, 5.28, -0.01),
}


def surface_logit(field: DescriptorField, points: Float[Array, "points 3"]) -> float:
    """Mean logit of the occupancy at an object's own points, each cut to [-3, 3].

    Points of an object that the network knows lie on its surface of occupancy 1/2, logit 0; of others they come to lie outside.

    Args:
        field: the object's.
        points: its cloud, metres, world frame; of more than 1500, as many drawn by a fixed seed are used.
    """
    points = np.asarray(points, np.float32)
    if len(points) > POINTS:
        points = points[np.random.default_rng(0).permutation(len(points))[:POINTS]]
    return float(np.mean(_logits(field, np.resize(points, (POINTS, 3)))[: len(points)]))


@jax.jit
def _logits(field, x):
    occupancy = field.occupancy(x)
    return jnp.clip(jnp.log(occupancy) - jnp.log1p(-occupancy), -CUT, CUT)


def recognition(
    residual: float, surface_logit: float, curve: tuple[float, float, float] = CURVES["mug"]
) -> float | None:
    """Probability that an object is of the category of a demonstration, if both were equally likely before.

    By default it is fitted for the shipped mug weights: mugs against bowls and bottles, demonstrated at the handle with query points in a box of 6 cm, complete, noisy or seen by one camera or more.

    Args:
        residual: what the pick leaves unmatched, see `tdf_jax.confidence`.
        surface_logit: see there.
        curve: intercept of the logistic curve, and its slopes in -log(residual) and in the surface logit.

    Returns:
        A number in [0, 1]; None for evidence that is not finite.

    Raises:
        InputError: the curve is not three finite numbers.
    """
    if np.shape(curve) != (3,) or not np.isfinite(curve).all():
        raise InputError(f"recognition(): curve is {curve!r}; expected three finite numbers, such as those of tdf_jax.uncertainty.category.CURVES")
    if not np.isfinite([residual, surface_logit]).all():
        return None
    exponent = np.dot(curve, (1.0, -np.log(max(residual, 1e-9)), surface_logit))
    return float(1 / (1 + np.exp(-np.clip(exponent, -50, 50))))
