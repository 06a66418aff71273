"""How likely a pick is right, from how much of the demonstration's descriptors it leaves unmatched."""

import numpy as np

from tdf_jax.demonstration import Reference
from tdf_jax.optimize import Result

# Logistic in log(residual), fitted on 288 picks whose truth is known, 9 of them wrong: 72 pairs of mugs of 0.12 m, each complete, seen by one and by two cameras, and of 300
# points with 2 mm noise. Right picks had residuals of 0.08 to 0.53 (all but 5 % on either side, by condition), wrong ones 0.44 to 0.83. docs/benchmark.md has the reliability on others.
INTERCEPT, SLOPE = -3.39, 6.55


def residual(result: Result, reference: Reference) -> float:
    """Energy of the best pick over what it would be if all query points had the demonstration's mean descriptor.

    A number without a unit, 0 for a perfect match: networks and query points differ in how far their descriptors are apart, less in this ratio.

    Args:
        result: of descriptors alone (k = 0), of one pose.
        reference: what was to be matched, of one pose.

    Returns:
        The ratio; NaN if there is one query point.
    """
    descriptors = np.asarray(reference.descriptors[0])
    spread = float(np.mean(np.abs(descriptors - descriptors.mean(axis=0))))
    return result.loss / spread if spread > 0 else float("nan")


def confidence(residual: float) -> float | None:
    """Probability that a pick with a residual is within 2 cm and 20 degrees of the truth.

    It is calibrated for the shipped mug weights, demonstrations at the handle with query points in a box of 6 cm, and mugs of 0.12 m, complete, noisy or seen by
    one camera or more. Elsewhere it still falls as the match gets worse, but is no probability.

    Args:
        residual: see there.

    Returns:
        A number in [0, 1]; None for a residual that is not finite.
    """
    if not np.isfinite(residual):
        return None
    return float(1 / (1 + np.exp(SLOPE * np.log(max(residual, 1e-9)) - INTERCEPT)))
