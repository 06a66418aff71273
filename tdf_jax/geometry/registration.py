"""Registration of a region: the rigid motion that brings the points of one cloud near a place onto another cloud."""

import numpy as np
from jaxtyping import Float

ROUNDS = 40
LEAST = 8  # points of either cloud in the region; with fewer there is nothing to register
WIDER = 1.6  # region of the other cloud, a factor on the radius: its points may still move into the region
CONVERGED = 1e-5  # metres and radians, movement of a round at which the registration ends
# What a registration must bring the distance of the clouds in the region to: a factor on what it was, and a factor on
# the half edge. On development pairs these were 0.2 to 0.9 and 0.06 to 0.14 for the pegs of racks; for the rims of mugs
# and the floors of containers, whose sizes differ, 0.6 to 1.5 and mostly 0.13 to 0.33.
FITS_BETTER, FITS = 0.8, 0.12
SHIFTS = (-1.0, -0.5, 0.5, 1.0)  # of further starts along each axis, factors on the half edge
SEARCHED = 20  # starts that are registered, those with the smallest distances
# What a pose from a further start must bring the distance to: a factor on that of the first pose, and a factor on the
# half edge. On 50 development racks these were 0 to 0.5 and 0.07 to 0.16; on 40 mugs and containers, where most such
# poses are wrong, 0.52 and more.
FITS_MUCH_BETTER, FITS_NEARLY = 0.5, 0.16


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


def refine_regions(
    demonstrated: Float[np.ndarray, "points 3"],
    points: Float[np.ndarray, "new_points 3"],
    T_world_regions: Float[np.ndarray, "poses 4 4"],
    radius: float,
) -> Float[np.ndarray, "poses 4 4"]:
    """Refine poses of a region on a new cloud, the most likely first, where its points fit those of the demonstration.

    Each pose is registered from where it is. Where the two regions differ in size, as the rims of two mugs do, closest
    points would tilt a pose and not fit better: then it stays. If the first pose does not fit, and a registration from
    any pose, shifted along its axes, fits far better, that takes its place.

    Args:
        demonstrated: cloud in the frame of the region, (points, 3), metres.
        points: the new cloud, (new_points, 3), metres, world frame.
        T_world_regions: poses of the region on the new cloud, the best first, (poses, 4, 4).
        radius: half edge of the region, a cube about the origin of its frame, metres.

    Returns:
        The poses, (poses, 4, 4).
    """
    given = np.asarray(T_world_regions, float)
    before = np.array([region_distance(demonstrated, points, T, radius) for T in given])
    refined = np.stack([register_region(demonstrated, points, T, radius) for T in given])
    after = np.array([region_distance(demonstrated, points, T, radius) for T in refined])
    fits = after < np.minimum(FITS_BETTER * before, FITS * radius)
    poses = np.where(fits[:, None, None], refined, given)
    if min(before[0], after[0]) < FITS * radius:
        return poses
    steps = radius * np.concatenate([np.zeros((1, 3)), np.kron(np.eye(3), np.array(SHIFTS)[:, None])])
    starts = np.repeat(given, len(steps), axis=0)
    starts[:, :3, 3] += (given[:, None, :3, :3] @ steps[..., None])[..., 0].reshape(-1, 3)
    nearest = np.argsort([region_distance(demonstrated, points, T, radius) for T in starts], kind="stable")[:SEARCHED]
    found = [register_region(demonstrated, points, starts[start], radius) for start in nearest]
    distances = [region_distance(demonstrated, points, T, radius) for T in found]
    if min(distances) < min(FITS_MUCH_BETTER * before[0], FITS_NEARLY * radius):
        poses[0] = found[int(np.argmin(distances))]
    return poses


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
