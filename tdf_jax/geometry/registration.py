"""Registration of a region: the rigid motion that brings the points of one cloud near a place onto another cloud."""

import numpy as np
from jaxtyping import Float

ROUNDS = 40
LEAST = 8  # points of either cloud in the region; with fewer there is nothing to register
WIDER = 1.6  # region of the other cloud, a factor on the radius: its points may still move into the region
CONVERGED = 1e-5  # metres and radians, movement of a round at which the registration ends


def register_region(
    demonstrated: Float[np.ndarray, "points 3"],
    points: Float[np.ndarray, "new_points 3"],
    T_world_region: Float[np.ndarray, "4 4"],
    radius: float,
) -> Float[np.ndarray, "4 4"]:
    """Refine the pose of a region on a new cloud by iterative closest points, in both directions.

    Every point of the demonstrated region is paired with the nearest new point, and every new point in the region with
    the nearest demonstrated one. No pair is left out as an outlier, because those at an end, such as a peg's tip, say
    where the region is along it.

    Args:
        demonstrated: cloud in the frame of the region, (points, 3), metres.
        points: the new cloud, (new_points, 3), metres, world frame.
        T_world_region: pose of the region on the new cloud, 4x4, to start from.
        radius: half edge of the region, a cube about the origin of its frame, metres.

    Returns:
        The refined pose, 4x4; the given one if too few points of either cloud are in the region.

    References:
        Besl, McKay, "A method for registration of 3-D shapes", IEEE TPAMI 1992.
    """
    from scipy.spatial import KDTree

    demonstrated, points = np.asarray(demonstrated, float), np.asarray(points, float)
    tree = KDTree(demonstrated)
    region = demonstrated[np.abs(demonstrated).max(axis=1) < radius]
    start = T = np.asarray(T_world_region, float)
    for _ in range(ROUNDS):
        local = (points - T[:3, 3]) @ T[:3, :3]
        reach = np.abs(local).max(axis=1)
        near, inner = local[reach < WIDER * radius], local[reach < radius]
        if min(len(region), len(inner)) < LEAST:
            return start
        before = np.concatenate([region, demonstrated[tree.query(inner)[1]]])
        after = np.concatenate([near[KDTree(near).query(region)[1]], inner])
        motion = _motion(before, after)
        T = T @ motion
        if np.abs(motion - np.eye(4)).max() < CONVERGED:
            break
    return T


def region_distance(
    demonstrated: Float[np.ndarray, "points 3"],
    points: Float[np.ndarray, "new_points 3"],
    T_world_region: Float[np.ndarray, "4 4"],
    radius: float,
) -> float:
    """Mean distance between the points of two clouds in a region, of both directions, metres.

    Args:
        demonstrated: cloud in the frame of the region, (points, 3), metres.
        points: the new cloud, (new_points, 3), metres, world frame.
        T_world_region: pose of the region on the new cloud, 4x4.
        radius: half edge of the region, metres.

    Returns:
        The distance; infinite if too few points of either cloud are in the region.
    """
    from scipy.spatial import KDTree

    T, demonstrated = np.asarray(T_world_region, float), np.asarray(demonstrated, float)
    local = (np.asarray(points, float) - T[:3, 3]) @ T[:3, :3]
    regions = [cloud[np.abs(cloud).max(axis=1) < radius] for cloud in (demonstrated, local)]
    if min(map(len, regions)) < LEAST:
        return np.inf
    distances = (KDTree(other).query(region)[0] for region, other in zip(regions, (local, demonstrated), strict=True))
    return float(np.mean([distance.mean() for distance in distances]))


def _motion(before: np.ndarray, after: np.ndarray) -> np.ndarray:
    """The rigid motion, 4x4, that brings points onto others with the least sum of squares."""
    from_, to = before.mean(axis=0), after.mean(axis=0)
    left, _, right = np.linalg.svd((before - from_).T @ (after - to))
    sign = np.diag([1.0, 1.0, np.sign(np.linalg.det(right.T @ left.T))])
    motion = np.eye(4)
    motion[:3, :3] = right.T @ sign @ left.T
    motion[:3, 3] = to - motion[:3, :3] @ from_
    return motion
