"""Distances of a moving body from obstacles, at the poses of a trajectory and between them."""

import functools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int
from numpy.typing import ArrayLike

from tdf_jax._internal import checks
from tdf_jax._internal.boundary import host
from tdf_jax._internal.deprecation import warn
from tdf_jax._internal.errors import InputError
from tdf_jax.geometry import se3
from tdf_jax.geometry.trajectory import Trajectory, check_trajectory

# No point of the body moves farther than this between two samples, metres. A wall between two samples is missed only if
# it is thinner than that.
STEP = 0.005
MAX_BETWEEN = 255  # samples between two poses
ROUNDING = 1e-5  # rounding error of a distance, metres


class Obstacle(Protocol):
    """An obstacle of `tdf_jax.geometry.distance_fields`, or any registered dataclass of arrays with this method."""

    def distance(self, x: Float[Array, "*batch 3"]) -> Float[Array, "*batch"]:
        """Compute signed distances.

        Args:
            x: points, (..., 3), metres, world frame.

        Returns:
            Signed distances, (...), metres, negative inside.
        """
        ...


@dataclass(frozen=True)
class Clearance:
    """Smallest signed distances between a body and obstacles along a trajectory, metres, negative inside.

    Attributes:
        waypoints: distance at each pose from each obstacle, (poses, obstacles), metres.
        segments: smallest distance from pose i to pose i + 1, both included, from each obstacle,
            (poses - 1, obstacles), metres.
        between: number of sampled poses between two poses of the trajectory.
    """

    waypoints: Float[np.ndarray, "poses obstacles"]
    segments: Float[np.ndarray, "segments obstacles"]
    between: int

    @property
    def min(self) -> float:
        """Smallest distance of all, metres."""
        return float(np.minimum(self.waypoints.min(), self.segments.min(initial=np.inf)))

    @property
    def least(self) -> float:
        """Former name of `min`."""
        warn("Clearance.least", "Clearance.min")
        return self.min


@host
def clearance(
    trajectory: Trajectory, body: Float[Array, "points 3"], obstacles: Sequence[Obstacle], *, between: int | None = None
) -> Clearance:
    """Compute the smallest signed distances between a moving body and obstacles, at the poses and between them.

    Between two poses the translation is interpolated linearly, and the rotation follows the SO(3) geodesic.

    Args:
        trajectory: poses of the query frame, T_world_query, at least one.
        body: points of the moving body, (points, 3), metres, query frame. The space between the points is not checked:
            an obstacle that is thinner than their distance can pass through.
        obstacles: obstacles, at least one.
        between: number of samples between two poses, 0 to 255; by default so many that no point moves more than 5 mm
            between two samples.

    Returns:
        The distances.

    Raises:
        InputError: the trajectory fails `check_trajectory`, the body is not finite points, there is no obstacle or one
            of another kind, or `between` is not a whole number from 0 to 255.
    """
    wxyz_xyz, points, groups, order = prepare("clearance()", trajectory, body, obstacles)
    if between is None:
        between = motion_samples(wxyz_xyz, points, STEP) - 1
    return measure(wxyz_xyz, points, groups, order, checks.count("clearance()", "between", between, 0, MAX_BETWEEN))[0]


def prepare(
    function: str, trajectory: Trajectory, body: ArrayLike, obstacles: Sequence[Obstacle]
) -> tuple[np.ndarray, np.ndarray, list[Any], Int[np.ndarray, " obstacles"]]:
    """Check the arguments of `clearance` and `push_clear`, and group obstacles of one kind.

    Args:
        function: name that error messages begin with.
        trajectory: poses of the query frame, T_world_query.
        body: points of the moving body, (points, 3), metres, query frame.
        obstacles: obstacles, at least one.

    Returns:
        The poses `wxyz_xyz`, (poses, 7); the body, (points, 3), of the same type; the obstacles of each kind, stacked;
        the index in `obstacles` of each obstacle in the order of the groups.

    Raises:
        InputError: as for `clearance`.
    """
    wxyz_xyz = np.asarray(check_trajectory(trajectory).wxyz_xyz)
    points = np.asarray(checks.coordinates(function, "body", body)).astype(wxyz_xyz.dtype)
    if not isinstance(obstacles, list | tuple) or not obstacles:
        raise InputError(
            f"{function}: obstacles are {obstacles!r}; expected a list of at least one, such as [tdf.box_obstacle(...)]"
        )
    kinds: dict[Any, list[int]] = {}
    arrays = []
    for i, obstacle in enumerate(obstacles):
        leaves, tree = jax.tree.flatten(obstacle)
        if (
            not callable(getattr(obstacle, "distance", None))
            or not leaves
            or not all(isinstance(leaf, jax.Array | np.ndarray) for leaf in leaves)
        ):
            raise InputError(
                f"{function}: obstacles[{i}] is a {type(obstacle).__name__}; expected an obstacle such as "
                "tdf.box_obstacle(...), or a registered dataclass of arrays with a method distance"
            )
        arrays.append(
            [np.asarray(leaf, wxyz_xyz.dtype if jnp.issubdtype(leaf.dtype, jnp.floating) else None) for leaf in leaves]
        )
        kinds.setdefault((tree, *((leaf.shape, leaf.dtype) for leaf in leaves)), []).append(i)
    groups = [
        jax.tree.unflatten(kind[0], [np.stack(parts) for parts in zip(*(arrays[i] for i in members))])
        for kind, members in kinds.items()
    ]
    return wxyz_xyz, points, groups, np.concatenate([np.array(members) for members in kinds.values()])


def body_centroids(wxyz_xyz: np.ndarray, body: np.ndarray) -> Float[np.ndarray, "poses 3"]:
    """Compute the centroid of the body at each pose, in numpy: op by op, JAX would compile each operation.

    Args:
        wxyz_xyz: poses of the query frame, (poses, 7), metres, world frame.
        body: points of the body, (points, 3), metres, query frame.

    Returns:
        Centroids, (poses, 3), metres, world frame.
    """
    w, v, centroid = wxyz_xyz[:, :1].astype(float), wxyz_xyz[:, 1:4].astype(float), body.mean(axis=0, dtype=float)
    return (
        centroid
        + 2 * np.cross(v, np.cross(v, centroid) + w * centroid) / (w**2 + np.sum(v**2, axis=1, keepdims=True))
        + wxyz_xyz[:, 4:]
    )


def _rotation_angles(wxyz_xyz):
    """Angles between the rotations of neighbouring poses, radians."""
    unit = wxyz_xyz[:, :4] / np.linalg.norm(wxyz_xyz[:, :4].astype(float), axis=1, keepdims=True)
    return 2 * np.arccos(np.minimum(np.abs(np.sum(unit[:-1] * unit[1:], axis=1)), 1))


def motion_samples(wxyz_xyz: np.ndarray, body: np.ndarray, step: float) -> int:
    """Choose the number of samples in a segment, a power of 2 so that few programs are compiled.

    Args:
        wxyz_xyz: poses of the query frame, (poses, 7), metres, world frame.
        body: points of the body, (points, 3), metres, query frame.
        step: distance that no point of the body exceeds between two samples, metres.

    Returns:
        Number of samples from one pose to the next, at most `MAX_BETWEEN` + 1.
    """
    translation = np.linalg.norm(np.diff(wxyz_xyz[:, 4:], axis=0), axis=1)
    longest = np.max(translation + _rotation_angles(wxyz_xyz) * np.linalg.norm(body, axis=1).max(), initial=0.0)
    return int(min(2 ** np.ceil(np.log2(max(longest / step, 1))), MAX_BETWEEN + 1))


def path_lengths(wxyz_xyz: np.ndarray, body: np.ndarray, rotation_scale: float) -> Float[np.ndarray, " poses"]:
    """Compute the length of the path of the body's centroid up to each pose, rotations included.

    Args:
        wxyz_xyz: poses of the query frame, (poses, 7), metres, world frame.
        body: points of the body, (points, 3), metres, query frame.
        rotation_scale: length that a rotation counts as, metres per radian.

    Returns:
        Lengths, (poses,), metres.
    """
    translation = np.linalg.norm(np.diff(body_centroids(wxyz_xyz, body), axis=0), axis=1)
    return np.concatenate([[0.0], np.cumsum(translation + rotation_scale * _rotation_angles(wxyz_xyz))])


def measure(
    wxyz_xyz: np.ndarray, body: np.ndarray, groups: list[Any], order: np.ndarray, between: int
) -> tuple[Clearance, np.ndarray, np.ndarray]:
    """Compute `Clearance`, with the distances at all samples.

    Args:
        wxyz_xyz: poses of the query frame, (poses, 7), metres, world frame.
        body: points of the body, (points, 3), metres, query frame.
        groups: obstacles of each kind, as `prepare` returns them.
        order: index of each obstacle, as `prepare` returns them.
        between: number of samples between two poses.

    Returns:
        The clearance; the smallest distance at each sample, (samples, obstacles), metres; the index of the body's point
        at that distance. Obstacles are in the order of the groups.
    """
    distances, nearest = map(np.asarray, _sampled_distances(groups, wxyz_xyz, body, samples=between + 1))
    distances = distances.astype(float)
    listed = np.empty_like(distances)
    listed[:, order] = distances
    windows = [listed[i : len(listed) - between - 1 + i : between + 1] for i in range(between + 2)]
    return Clearance(listed[:: between + 1], np.min(windows, axis=0), between), distances, nearest


def distances_and_normals(
    groups: list[Any], x: Float[Array, "*batch 3"]
) -> tuple[Float[Array, " obstacles *batch"], Float[Array, " obstacles *batch 3"]]:
    """Compute signed distances of points from obstacles and their gradients.

    Args:
        groups: obstacles of each kind, as `prepare` returns them.
        x: points, (..., 3), metres, world frame.

    Returns:
        Signed distances, (obstacles, ...), metres, and their gradients, (obstacles, ..., 3). Obstacles are in the order
        of the groups.
    """

    def one(obstacle):
        distance, pullback = jax.vjp(obstacle.distance, x)
        return distance, pullback(jnp.ones_like(distance))[0]

    distances, normals = zip(*(jax.vmap(one)(group) for group in groups))
    return jnp.concatenate(distances), jnp.concatenate(normals)


@functools.partial(jax.jit, static_argnames="samples")
def _sampled_distances(groups, wxyz_xyz, body, *, samples):
    R, t = se3.rotation(wxyz_xyz), se3.translation(wxyz_xyz)
    fraction = jnp.arange(samples, dtype=t.dtype) / samples
    rotations = se3.geodesic(R[:-1, None], R[1:, None], fraction).reshape(-1, 3, 3)
    translations = (t[:-1, None] + fraction[:, None] * (t[1:] - t[:-1])[:, None]).reshape(-1, 3)

    def nearest(pose):
        x = se3.rotate(pose[0], body) + pose[1]
        distances = jnp.concatenate([jax.vmap(lambda one: one.distance(x))(group) for group in groups])
        return distances.min(axis=1), distances.argmin(axis=1)

    all_R, all_t = jnp.concatenate([rotations, R[-1:]]), jnp.concatenate([translations, t[-1:]])
    return jax.lax.map(nearest, (all_R, all_t))
