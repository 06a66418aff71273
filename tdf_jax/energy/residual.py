"""How much of the demonstration's descriptors a pick leaves unmatched."""

import numpy as np
from jaxtyping import Array, Float


def pick_residual(energy: float, descriptors: Float[Array, "queries channels"]) -> float:
    """Energy of a pick over what it would be if all query points had the demonstration's mean descriptor.

    A number without a unit, 0 for a perfect match: networks and query points differ in how far their descriptors are
    apart, less in this ratio.

    Args:
        energy: of descriptors alone (eq. 2 of one waypoint).
        descriptors: the demonstration's at the pick.

    Returns:
        The ratio; NaN if there is one query point.
    """
    descriptors = np.asarray(descriptors)
    spread = float(np.mean(np.abs(descriptors - descriptors.mean(axis=0))))
    return float(energy) / spread if spread > 0 else float("nan")
