"""What the network has to beat: rigid alignment of the two clouds, which needs no training.

A baseline finds T_b_a, the motion of object a in its canonical frame onto object b's cloud in the world, and carries
the place's pose by it. Both objects are mugs of one height, but not the same mug: even the best motion leaves an error.
"""

from collections.abc import Sequence
from typing import TYPE_CHECKING

import jax
import numpy as np
from jaxtyping import Float
from tqdm import tqdm

from tdf_jax._internal.errors import InputError
from tdf_jax.evaluation.cases import Case
from tdf_jax.geometry import se3

if TYPE_CHECKING:
    from scipy.spatial import cKDTree

METHODS = ("PCA", "ICP")
STEPS = 100  # of ICP, at most
SETTLED = 1e-4  # of ICP's cost, a mean squared distance: a step that lowers it by no more is the last
SIGNS = np.array([(x, y, x * y) for x in (1, -1) for y in (1, -1)])  # of principal axes, without reflections


def principal_axes(
    points_a: Float[np.ndarray, "points 3"], points_b: Float[np.ndarray, "seen 3"]
) -> Float[np.ndarray, "4 4"]:
    """Alignment of centroids and principal axes; of the four choices of signs, the one of least chamfer distance.

    Args:
        points_a, points_b: clouds, metres.

    Returns:
        The motion of cloud a onto cloud b, 4x4.
    """
    from scipy.spatial import cKDTree

    axes_a, axes_b = _axes(points_a), _axes(points_b)
    tree_b = cKDTree(points_b)
    motions = [_motion((axes_b * signs) @ axes_a.T, points_a.mean(axis=0), points_b.mean(axis=0)) for signs in SIGNS]
    distances = [chamfer_distance(_moved(T, points_a), points_b, tree_b) for T in motions]
    return motions[int(np.argmin(distances))]


def iterative_closest_points(
    points_a: Float[np.ndarray, "points 3"],
    points_b: Float[np.ndarray, "seen 3"],
    rotations: Float[np.ndarray, "starts 3 3"],
) -> Float[np.ndarray, "4 4"]:
    """Point-to-point ICP from several starts; the one of least mean squared distance.

    Every point of cloud b, which may be a part, is matched with its nearest in cloud a, which is complete.

    Args:
        points_a, points_b: clouds, metres.
        rotations: of cloud a about its centroid, laid on cloud b's; where the starts begin.

    Returns:
        The motion of cloud a onto cloud b, 4x4.

    Source:
        Besl and McKay, A method for registration of 3-D shapes, PAMI 1992.
    """
    motions, costs = settled_points(points_a, points_b, rotations)
    return motions[int(np.argmin(costs))]


def settled_points(
    points_a: Float[np.ndarray, "points 3"],
    points_b: Float[np.ndarray, "seen 3"],
    rotations: Float[np.ndarray, "starts 3 3"],
) -> tuple[Float[np.ndarray, "starts 4 4"], Float[np.ndarray, " starts"]]:
    """Where point-to-point ICP settles from every start, see `iterative_closest_points`.

    Returns:
        Motions of cloud a onto cloud b, 4x4, and their mean squared distances, square metres.
    """
    from scipy.spatial import cKDTree

    points_a, points_b = np.asarray(points_a, float), np.asarray(points_b, float)
    tree_a = cKDTree(points_a)
    starts = [_motion(R, points_a.mean(axis=0), points_b.mean(axis=0)) for R in rotations]
    motions, costs = zip(*(_icp(np.linalg.inv(T), points_a, points_b, tree_a) for T in starts))
    return np.linalg.inv(motions), np.array(costs)


def rigid_motion(
    points_a: Float[np.ndarray, "points 3"], points_b: Float[np.ndarray, "points 3"]
) -> Float[np.ndarray, "4 4"]:
    """The motion of least squares of points onto those they correspond to, 4x4, without reflection or scale."""
    from trimesh.registration import procrustes

    return procrustes(points_a, points_b, reflection=False, scale=False)[0]


def chamfer_distance(
    points_a: Float[np.ndarray, "points 3"], points_b: Float[np.ndarray, "seen 3"], tree_b: "cKDTree | None" = None
) -> float:
    """Mean distance of points to their nearest in the other cloud, metres, averaged over both directions.

    Args:
        points_a, points_b: clouds.
        tree_b: of `points_b`, if there is one already.
    """
    from scipy.spatial import cKDTree

    tree_b = cKDTree(points_b) if tree_b is None else tree_b
    return float(tree_b.query(points_a)[0].mean() + cKDTree(points_a).query(points_b)[0].mean()) / 2


def aligned(
    method: str, cases: Sequence[Case], *, seed: int = 0, inits: int = 10, progress: bool = True
) -> Float[np.ndarray, "cases 7"]:
    """The place's pose carried by a baseline, in every case.

    Args:
        method: "PCA" or "ICP".
        cases: what to transfer.
        seed: of ICP's starts.
        inits: ICP's starts, uniform rotations.
        progress: show a progress bar.

    Returns:
        Poses `wxyz_xyz` of the place, as found on object b, world frame.

    Raises:
        InputError: there is no such method.
    """
    if method not in METHODS:
        raise InputError(f"aligned(): method is {method!r}; expected one of {', '.join(METHODS)}")
    _, start_key = jax.random.split(jax.random.key(seed))
    found = []
    for index, case in enumerate(tqdm(cases, desc=method, disable=not progress)):
        if method == "PCA":
            T_b_a = principal_axes(case.points_a, case.points_b)
        else:
            rotations = np.asarray(se3.uniform_rotations(jax.random.fold_in(start_key, index), inits), float)
            T_b_a = iterative_closest_points(case.points_a, case.points_b, rotations)
        found.append(T_b_a @ case.T_world_place_a)
    found = np.stack(found).astype(np.float32)
    return np.asarray(se3.pose(found[:, :3, :3], found[:, :3, 3]))


def _icp(T_a_b, points_a, points_b, tree_a):
    """The motion that settles, and its cost."""
    cost = np.inf
    for _ in range(STEPS):
        distances, nearest = tree_a.query(_moved(T_a_b, points_b))
        before, cost = cost, float(np.mean(distances**2))
        if cost >= (1 - SETTLED) * before:
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


def _moved(T, points):
    return points @ T[:3, :3].T + T[:3, 3]
