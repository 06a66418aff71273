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
# A region such as a peg's may fit as well after turns. They are tried about each axis, and what is around the region
# decides: a cube so many times as large. A turned pose may fit a little worse.
SURROUNDINGS = 3.0
TURNS, AS_GOOD = np.radians(np.arange(30, 360, 30)), 1.4
SMALL_TURNS, AS_GOOD_UNMOVED = np.radians([-20, -10, -5, 5, 10, 20]), 1.15


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
    """Refine poses of a region on a new cloud where its points fit those of the demonstration.

    Each pose is registered from where it is. Where the two regions differ in size, as the rims of two mugs do, closest
    points would tilt a pose and not fit better: then it stays. If the first pose does not fit, registrations from all
    poses, shifted along their axes, are tried; one that fits far better replaces the first pose. Where the region of a
    registered pose fits as well after a turn, as a peg does about its axis, the points around it decide.

    The distance of two clouds of one region is about half of that between neighbouring points. On racks, clouds of less
    than about 1000 points do not come below the limits, and the poses stay.

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
    if min(before[0], after[0]) >= FITS * radius:
        other = _search(demonstrated, points, given, radius, FITS_MUCH_BETTER * before[0])
        if other is not None:
            refined[0], fits[0] = other, True
    return np.stack(
        [
            _turned(demonstrated, points, pose, radius) if fit else start
            for start, pose, fit in zip(given, refined, fits, strict=True)
        ]
    )


def _search(demonstrated, points, given, radius: float, most: float) -> np.ndarray | None:
    """The pose that fits best of those registered from the given ones, shifted; None if none fits well enough."""
    steps = radius * np.concatenate([np.zeros((1, 3)), np.kron(np.eye(3), np.array(SHIFTS)[:, None])])
    starts = np.repeat(given, len(steps), axis=0)
    starts[:, :3, 3] += (given[:, None, :3, :3] @ steps[..., None])[..., 0].reshape(-1, 3)
    nearest = np.argsort([region_distance(demonstrated, points, T, radius) for T in starts], kind="stable")[:SEARCHED]
    found = [register_region(demonstrated, points, starts[start], radius) for start in nearest]
    distances = [region_distance(demonstrated, points, T, radius) for T in found]
    return found[int(np.argmin(distances))] if min(distances) < min(most, FITS_NEARLY * radius) else None


def _turned(demonstrated, points, T: np.ndarray, radius: float) -> np.ndarray:
    """Of a registered pose and those turned about its axes in which the region fits as well, what is around decides."""

    def distance(pose, factor=1.0):
        return region_distance(demonstrated, points, pose, factor * radius)

    registered = [register_region(demonstrated, points, pose, radius) for pose in _turns(T, TURNS)]
    as_good = [pose for pose in registered if distance(pose) <= AS_GOOD * distance(T)]
    T = min([T, *as_good], key=lambda pose: distance(pose, SURROUNDINGS))
    for _ in range(2):
        as_good = [pose for pose in _turns(T, SMALL_TURNS) if distance(pose) <= AS_GOOD_UNMOVED * distance(T)]
        T = min([T, *as_good], key=lambda pose: distance(pose, SURROUNDINGS))
    return register_region(demonstrated, points, T, radius)  # what is around differs more than the region does


def _turns(T: np.ndarray, angles) -> list[np.ndarray]:
    """A pose turned about each of its axes by angles."""
    from scipy.spatial.transform import Rotation

    turned = np.tile(T, (3 * len(angles), 1, 1))
    vectors = np.kron(np.eye(3), np.asarray(angles)[:, None])
    turned[:, :3, :3] = T[:3, :3] @ Rotation.from_rotvec(vectors).as_matrix()
    return list(turned)


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
