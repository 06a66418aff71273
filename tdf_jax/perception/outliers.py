"""Outliers of a cloud: points far from all others."""

import numpy as np
from jaxtyping import Bool, Float

from tdf_jax._internal import checks
from tdf_jax._internal.boundary import host

NEIGHBOURS = 16  # points whose mean distance is measured: clumps of fewer outliers are found
DEVIATIONS = 4.0
# No point is an outlier below this multiple of the median distance: on surfaces that a camera sees at a grazing angle,
# points are farther apart.
LEAST_RATIO = 3.0
NORMAL = 1.4826  # standard deviation of normal numbers over their median absolute deviation
DIGITS = 0.05  # of the threshold's logarithm: rounded, so that one more point does not move it


@host
def remove_outliers(
    points: Float[np.ndarray, "points 3"], neighbours: int = NEIGHBOURS, deviations: float = DEVIATIONS
) -> Float[np.ndarray, "kept 3"]:
    """Remove the points that are far from all others.

    The measure of a point is its mean distance to its nearest neighbours. An outlier's is larger than the median by a
    number of standard deviations, of logarithms and estimated from their median absolute deviation, and by a factor of
    three. Unlike mean and standard deviation, medians do not move with the outliers themselves.

    Args:
        points: point cloud, (points, 3), metres; at least 21 points.
        neighbours: number of neighbours of a point.
        deviations: number of standard deviations.

    Returns:
        The other points, (kept, 3), in their order and type.

    Raises:
        InputError: the points are no cloud, or a number is out of range.
    """
    function = "remove_outliers()"
    cloud = np.asarray(checks.points(function, points))
    checks.count(function, "neighbours", neighbours, 1, len(cloud) - 1)
    checks.positive(function, "deviations", deviations)
    return cloud[~outliers_of(cloud, neighbours, deviations)]


def outliers_of(
    points: Float[np.ndarray, "points 3"], neighbours: int = NEIGHBOURS, deviations: float = DEVIATIONS
) -> Bool[np.ndarray, " points"]:
    """Find the points that `remove_outliers` removes.

    Args:
        points: point cloud, (points, 3), metres.
        neighbours: number of neighbours of a point.
        deviations: number of standard deviations.
    """
    from scipy.spatial import KDTree

    exact = points.astype(np.float64)
    distances = KDTree(exact).query(exact, k=neighbours + 1)[0][:, 1:].mean(axis=1)
    positive = distances[distances > 0]
    if not len(positive):
        return np.zeros(len(points), bool)
    logarithms = np.log(positive)
    median = np.median(logarithms)
    deviation = NORMAL * np.median(np.abs(logarithms - median))
    threshold = median + max(np.log(LEAST_RATIO), deviations * deviation)
    return distances > np.exp(DIGITS * np.ceil(threshold / DIGITS))
