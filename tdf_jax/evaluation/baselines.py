"""Baselines without training: rigid alignment of the two clouds.

A baseline estimates T_b_a, the motion of object a in its canonical frame onto the cloud of object b in the world, and
moves the pose of the place by it. The objects have one size but not one shape, so even the best motion has an error.
"""

from collections.abc import Sequence
from typing import TYPE_CHECKING

import jax
import numpy as np
from jaxtyping import Float
from tqdm.auto import tqdm

from tdf_jax._internal import checks
from tdf_jax.evaluation.cases import Case
from tdf_jax.evaluation.tabletop import moved
from tdf_jax.geometry import se3

if TYPE_CHECKING:
    from scipy.spatial import KDTree

METHODS = ("PCA", "ICP")
MAX_STEPS = 100  # maximal number of steps of ICP
TOLERANCE = 1e-4  # ICP stops at a step that lowers its mean squared distance by no more than this share
SIGNS = np.array([(x, y, x * y) for x in (1, -1) for y in (1, -1)])  # signs of principal axes without reflections


def principal_axes(
    points_a: Float[np.ndarray, "points 3"], points_b: Float[np.ndarray, "seen 3"]
) -> Float[np.ndarray, "4 4"]:
    """Align centroids and principal axes, with the signs that give the smallest chamfer distance.

    Args:
        points_a: cloud of object a, (points, 3), metres.
        points_b: cloud of object b, (seen, 3), metres.

    Returns:
        The motion of cloud a onto cloud b, 4x4.
    """
    from scipy.spatial import KDTree

    axes_a, axes_b = _axes(points_a), _axes(points_b)
    tree_b = KDTree(points_b)
    motions = [_motion((axes_b * signs) @ axes_a.T, points_a.mean(axis=0), points_b.mean(axis=0)) for signs in SIGNS]
    distances = [chamfer_distance(moved(points_a, T), points_b, tree_b) for T in motions]
    return motions[int(np.argmin(distances))]


def iterative_closest_points(
    points_a: Float[np.ndarray, "points 3"],
    points_b: Float[np.ndarray, "seen 3"],
    rotations: Float[np.ndarray, "starts 3 3"],
) -> Float[np.ndarray, "4 4"]:
    """Point-to-point ICP from several starts; take the start with the smallest mean squared distance.

    Every point of cloud b, which may be partial, is matched with its nearest point of cloud a, which is complete.

    Args:
        points_a: cloud of object a, (points, 3), metres.
        points_b: cloud of object b, (seen, 3), metres.
        rotations: initial rotations of cloud a about its centroid, (starts, 3, 3); the centroids coincide.

    Returns:
        The motion of cloud a onto cloud b, 4x4.

    Source:
        Besl and McKay, A method for registration of 3-D shapes, PAMI 1992.
    """
    motions, costs = every_registration(points_a, points_b, rotations)
    return motions[int(np.argmin(costs))]


def every_registration(
    points_a: Float[np.ndarray, "points 3"],
    points_b: Float[np.ndarray, "seen 3"],
    rotations: Float[np.ndarray, "starts 3 3"],
) -> tuple[Float[np.ndarray, "starts 4 4"], Float[np.ndarray, " starts"]]:
    """The result of point-to-point ICP from every start.

    Args:
        points_a: cloud of object a, (points, 3), metres.
        points_b: cloud of object b, (seen, 3), metres.
        rotations: initial rotations of cloud a about its centroid, (starts, 3, 3); the centroids coincide.

    Returns:
        Motions of cloud a onto cloud b, (starts, 4, 4), and their mean squared distances, (starts,), square metres.
    """
    from scipy.spatial import KDTree

    points_a, points_b = np.asarray(points_a, float), np.asarray(points_b, float)
    tree_a = KDTree(points_a)
    starts = [_motion(R, points_a.mean(axis=0), points_b.mean(axis=0)) for R in rotations]
    motions, costs = zip(*(_icp(np.linalg.inv(T), points_a, points_b, tree_a) for T in starts))
    return np.linalg.inv(motions), np.array(costs)


def rigid_motion(
    points_a: Float[np.ndarray, "points 3"], points_b: Float[np.ndarray, "points 3"]
) -> Float[np.ndarray, "4 4"]:
    """The least-squares motion of points onto corresponding points, without reflection or scale.

    Args:
        points_a: points that move, (points, 3), metres.
        points_b: corresponding points, (points, 3), metres.

    Returns:
        The motion, 4x4.
    """
    from trimesh.registration import procrustes

    return procrustes(points_a, points_b, reflection=False, scale=False)[0]


def chamfer_distance(
    points_a: Float[np.ndarray, "points 3"], points_b: Float[np.ndarray, "seen 3"], tree_b: "KDTree | None" = None
) -> float:
    """Mean distance of points to their nearest neighbours in the other cloud, metres, averaged over both directions.

    Args:
        points_a: one cloud, (points, 3), metres.
        points_b: the other cloud, (seen, 3), metres.
        tree_b: search tree of `points_b`, if there is one already.
    """
    from scipy.spatial import KDTree

    tree_b = KDTree(points_b) if tree_b is None else tree_b
    return float(tree_b.query(points_a)[0].mean() + KDTree(points_a).query(points_b)[0].mean()) / 2


def aligned(
    method: str, cases: Sequence[Case], *, seed: int = 0, num_starts: int = 10, progress: bool = True
) -> Float[np.ndarray, "cases 7"]:
    """Transfer the pose at the place by a baseline, in every case.

    Args:
        method: "PCA" or "ICP".
        cases: the transfers.
        seed: seed of ICP's starts.
        num_starts: number of ICP's starts, uniform rotations.
        progress: show a progress bar.

    Returns:
        Estimated poses `wxyz_xyz` of the place on object b, (cases, 7), metres, world frame.

    Raises:
        InputError: there is no such method.
    """
    checks.choice("aligned()", "method", method, METHODS)
    _, start_key = jax.random.split(jax.random.key(seed))
    estimates = []
    for index, case in enumerate(tqdm(cases, desc=method, disable=not progress)):
        if method == "PCA":
            T_b_a = principal_axes(case.points_a, case.points_b)
        else:
            rotations = np.asarray(se3.uniform_rotations(jax.random.fold_in(start_key, index), num_starts), float)
            T_b_a = iterative_closest_points(case.points_a, case.points_b, rotations)
        estimates.append(T_b_a @ case.T_world_place_a)
    T_world_place = np.stack(estimates).astype(np.float32)
    return np.asarray(se3.pose(T_world_place[:, :3, :3], T_world_place[:, :3, 3]))


def _icp(T_a_b, points_a, points_b, tree_a):
    """The motion at convergence, and its mean squared distance."""
    cost = np.inf
    for _ in range(MAX_STEPS):
        distances, nearest = tree_a.query(moved(points_b, T_a_b))
        before, cost = cost, float(np.mean(distances**2))
        if cost >= (1 - TOLERANCE) * before:
            break
        T_a_b = rigid_motion(points_b, points_a[nearest])
    return T_a_b, cost


def _axes(points):
    """Principal axes, longest first, as the columns of a rotation."""
    _, axes = np.linalg.eigh(np.cov(np.asarray(points, float).T))
    axes = axes[:, ::-1]
    return axes * [1, 1, np.linalg.det(axes)]


def _motion(R, centre_a, centre_b):
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = R, centre_b - R @ centre_a
    return T
