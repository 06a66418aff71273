"""How likely a pick is right, from how much of the demonstration's descriptors it leaves unmatched."""

import numpy as np
from jaxtyping import Array, Float

# Logistic in log(residual), fitted on 288 picks whose truth is known, 9 of them wrong: `tdf benchmark --seed 61 --pairs 72 --methods tdf_jax --clouds full views1 views2 noise`, mugs of
# 0.12 m. Right picks had residuals of 0.08 to 0.53 (all but 5 % on either side, by condition), wrong ones 0.44 to 0.83. docs/certainty.md has the reliability on others.
INTERCEPT, SLOPE = -3.39, 6.55
FITTED_ON = 61  # seed
CALIBRATED = ("mug",)  # shipped weights that it was fitted for
MOST = 0.99  # none of the 250 surest was wrong, and no more than that can be known from so many


def residual(energy: float, descriptors: Float[Array, "queries channels"]) -> float:
    """Energy of a pick over what it would be if all query points had the demonstration's mean descriptor.

    A number without a unit, 0 for a perfect match: networks and query points differ in how far their descriptors are apart, less in this ratio.

    Args:
        energy: of descriptors alone (eq. 2 of one waypoint).
        descriptors: the demonstration's at the pick.

    Returns:
        The ratio; NaN if there is one query point.
    """
    descriptors = np.asarray(descriptors)
    spread = float(np.mean(np.abs(descriptors - descriptors.mean(axis=0))))
    return float(energy) / spread if spread > 0 else float("nan")


def confidence(residual: float, intercept: float = INTERCEPT, slope: float = SLOPE) -> float | None:
    """Probability that a pick with a residual is within 2 cm and 20 degrees of the truth.

    By default it is calibrated for the shipped mug weights, demonstrations at the handle with query points in a box of 6 cm, and mugs of 0.12 m, complete, noisy or seen by
    one camera or more. Elsewhere it still falls as the match gets worse, but is no probability; `tdf_jax.uncertainty.reliability.fit` fits the two numbers anew.

    Args:
        residual: of the pick, such as `result.residual`.
        intercept, slope: of the logistic curve in -log(residual).

    Returns:
        A number in [0, 0.99]; None for a residual that is not finite.
    """
    if not np.isfinite(residual):
        return None
    return min(MOST, float(1 / (1 + np.exp(slope * np.log(max(residual, 1e-9)) - intercept))))
