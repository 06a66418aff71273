"""Registration of a region: the rigid motion that brings the points of one cloud near a place onto another cloud."""

import itertools

import numpy as np
from jaxtyping import Float

ROUNDS = 40
LEAST = 8  # points of either cloud in the region; with fewer there is nothing to register
WIDER = 1.6  # region of the other cloud, a factor on the radius: its points may still move into the region
CONVERGED = 1e-5  # metres and radians, movement of a round at which the registration ends
# Weight of the given orientation, in mean square distances of one half edge. Along a peg the points weigh ten times as
# much, about it a fifth: a peg looks the same from all sides, and descriptors know how it is turned.
PRIOR = 0.02
SHIFTS = (-1.3, -0.65, 0.0, 0.65, 1.3)  # of the starts along each axis, factors on the half edge
SEARCHED = 20  # starts that are registered, those with the smallest distances
MOST_TURN = np.radians(35)  # from the given orientation
# What a registration must bring the distance of the clouds in the region to: a factor on what it was, and a factor on
# the half edge, where it moved by at most a factor on the half edge. On 90 development racks the first factor was 0.1
# to 0.6 wherever the given pose was off its peg; on 40 rims of mugs and floors of containers, whose sizes differ, 0.63
# to 1 but for one that had moved by 65 mm. A short way needs less: it makes poses on a peg exact, and was at most 2 mm
# on rims.
FITS_BETTER, FITS, NEAR = 0.6, 0.22, 1.6
FITS_A_LITTLE_BETTER, FITS_WELL, NEARBY = 0.75, 0.12, 0.65
FITS_FAR_BETTER, FITS_ROUGHLY = 0.4, 0.3  # a short peg, whose post is in the region, fits no better than roughly
# Factors on the least distance: up to the first, the nearest place is taken; up to the second, others beside it are
# returned too, these shares of the half edge away.
AS_GOOD, NEARLY_AS_GOOD = 1.1, 1.6
STEPS = (0.15, 0.3, 0.5, 0.7)
SURROUNDINGS = 1.35  # region that says how well a pose fitted, a factor, where there is nothing in the region itself


def register_region(
    demonstrated: Float[np.ndarray, "points 3"],
    points: Float[np.ndarray, "new_points 3"],
    T_world_region: Float[np.ndarray, "4 4"],
    radius: float,
) -> Float[np.ndarray, "4 4"]:
    """Refine the pose of a region on a new cloud by iterative closest points, in both directions.

    Every point of the demonstrated region is paired with the nearest new point, and every new point in the region with
    the nearest demonstrated one. No pair is left out as an outlier, because those at an end, such as a peg's tip, say
    where the region is along it. The orientation from which it starts has a small weight, which decides how a region
    such as a peg is turned about its axis.

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
        motion = _motion(before, after, PRIOR * radius**2 * start[:3, :3].T @ T[:3, :3])
        T = T @ motion
        if np.abs(motion - np.eye(4)).max() < CONVERGED:
            break
    return T


def refine_region(
    demonstrated: Float[np.ndarray, "points 3"],
    points: Float[np.ndarray, "new_points 3"],
    T_world_region: Float[np.ndarray, "4 4"],
    radius: float,
) -> Float[np.ndarray, "poses 4 4"]:
    """Refine the pose of a region on a new cloud where its points fit those of the demonstration.

    It is registered from where it is and from places around it, in its orientation, and what fits best is taken if it
    fits far better than the given pose. Where two regions differ in size, as the rims of two mugs do, nothing fits far
    better: then the pose stays. Along a peg, other poses fit nearly as well, and they are returned too.

    The distance of two clouds of one region is about half of that between neighbouring points, and the limits are for
    racks of 1500 points. In far sparser clouds nothing fits, and the pose stays. Shifts are along the axes of the
    region's frame: one of them should be along a peg.

    Args:
        demonstrated: cloud in the frame of the region, (points, 3), metres.
        points: the new cloud, (new_points, 3), metres, world frame.
        T_world_region: pose of the region on the new cloud, 4x4.
        radius: half edge of the region, a cube about the origin of its frame, metres.

    Returns:
        Poses that fit, (poses, 4, 4): first the refined one, then those beside it along its axes that fit nearly as
            well, the nearest first; the given one alone if none fits.
    """
    given = np.asarray(T_world_region, float)
    starts = np.repeat(given[None], len(SHIFTS) ** 3, axis=0)
    starts[:, :3, 3] += radius * np.array(list(itertools.product(SHIFTS, repeat=3))) @ given[:3, :3].T
    distances = np.array([region_distance(demonstrated, points, start, radius) for start in starts])
    nearest = [start for start in np.argsort(distances, kind="stable")[:SEARCHED] if np.isfinite(distances[start])]
    found = [register_region(demonstrated, points, starts[start], radius) for start in nearest]
    found = [pose for pose in found if _angle(given, pose) < MOST_TURN]
    if not found:
        return given[None]
    after = np.array([region_distance(demonstrated, points, pose, radius) for pose in found])
    moved = np.array([np.linalg.norm(pose[:3, 3] - given[:3, 3]) for pose in found]) / radius
    before = region_distance(demonstrated, points, given, radius)
    little = np.isfinite(before) & (after < min(FITS_A_LITTLE_BETTER * before, FITS_WELL * radius)) & (moved < NEARBY)
    if not np.isfinite(before):
        before = region_distance(demonstrated, points, given, SURROUNDINGS * radius)
    # With nothing around it, the given pose is beside the object, and any place may be the right one.
    near = (moved < NEAR) | (not np.isfinite(before))
    limits = min(FITS_BETTER * before, FITS * radius), min(FITS_FAR_BETTER * before, FITS_ROUGHLY * radius)
    fits = little | (near & (after < max(limits)))
    if not fits.any():
        return given[None]
    best = after[fits].min()
    nearest = np.where(fits & (after <= AS_GOOD * best), moved, np.inf).argmin()
    return _with_shifts(demonstrated, points, found[nearest], radius)


def _with_shifts(demonstrated, points, pose: np.ndarray, radius: float) -> np.ndarray:
    """A pose and those beside it along its axes that fit nearly as well, the nearest first."""
    limit = NEARLY_AS_GOOD * region_distance(demonstrated, points, pose, radius)
    poses = [pose]
    for length, axis, sign in itertools.product(STEPS, range(3), (1, -1)):
        beside = pose.copy()
        beside[:3, 3] += sign * length * radius * pose[:3, axis]
        if region_distance(demonstrated, points, beside, radius) <= limit:
            poses.append(beside)
    return np.stack(poses)


def _angle(one: np.ndarray, other: np.ndarray) -> float:
    return float(np.arccos(np.clip((np.trace(one[:3, :3].T @ other[:3, :3]) - 1) / 2, -1, 1)))


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


def _motion(before: np.ndarray, after: np.ndarray, prior: np.ndarray) -> np.ndarray:
    """The rigid motion, 4x4, that brings points onto others with the least mean square.

    Args:
        before: points, (points, 3).
        after: where they are brought, (points, 3).
        prior: inverse of a rotation that it should be near, 3x3, times its weight.
    """
    from_, to = before.mean(axis=0), after.mean(axis=0)
    left, _, right = np.linalg.svd((before - from_).T @ (after - to) / len(before) + prior)
    sign = np.diag([1.0, 1.0, np.sign(np.linalg.det(right.T @ left.T))])
    motion = np.eye(4)
    motion[:3, :3] = right.T @ sign @ left.T
    motion[:3, 3] = to - motion[:3, :3] @ from_
    return motion
