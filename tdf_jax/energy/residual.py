"""The residual of a pick: the part of the demonstration's descriptors that it does not match."""

import numpy as np
from jaxtyping import Array, Float


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
