"""Distances of a moving body from obstacles, between its poses as well as at them."""

import functools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from tdf_jax._internal.errors import InputError
from tdf_jax.geometry import se3
from tdf_jax.geometry.trajectory import Trajectory, check_trajectory

# metres: no point of the body moves farther between two looks, so that a wall seen by none of them is thinner than what
# it sees in 5 mm
STEP = 0.005
MOST_BETWEEN = 255  # looks between two poses
ROUNDING = 1e-5  # metres


class Obstacle(Protocol):
    """What `tdf_jax.obstacles` makes, or any registered dataclass of arrays with this method."""

    def distance(self, x: Float[Array, "*batch 3"]) -> Float[Array, "*batch"]:
        """Signed distances of points of the world, metres, negative inside."""


@dataclass(frozen=True)
class Clearance:
    """Least signed distances between a body and obstacles along a trajectory, metres, negative inside.

    Attributes:
        waypoints: at each pose, from each obstacle.
        segments: on the way from pose i to pose i + 1, both included.
        between: poses looked at between two.
    """

    waypoints: Float[np.ndarray, "poses obstacles"]
    segments: Float[np.ndarray, "segments obstacles"]
    between: int

    @property
    def least(self) -> float:
        """The least of all, metres."""
        return float(min(self.waypoints.min(), self.segments.min(initial=np.inf)))


def clearance(
    trajectory: Trajectory, body: Float[Array, "points 3"], obstacles: Sequence[Obstacle], *, between: int | None = None
) -> Clearance:
    """Least signed distances between a body that is moved along a trajectory and obstacles, on the way too.

    Args:
        trajectory: T_world_query, at least one pose.
        body: points of what moves, metres, query frame. What is between them is not seen: an obstacle thinner than
            their distance can pass.
        obstacles: at least one.
        between: poses to look at between two; by default so many that no point moves more than 5 mm (up to 255).

    Returns:
        The distances.

    Raises:
        InputError: the trajectory fails `check_trajectory`, the body is not finite points, there is no obstacle or one
            of another kind, or between is not a whole number of 0 to 255.
    """
    wxyz_xyz, body, groups, order = prepare("clearance", trajectory, body, obstacles)
    if between is None:
        between = motion_samples(wxyz_xyz, body, STEP) - 1
    elif not isinstance(between, int | np.integer) or isinstance(between, bool) or not 0 <= between <= MOST_BETWEEN:
        raise InputError(
            f"clearance(): between is {between!r}; expected a whole number of 0 to {MOST_BETWEEN}, or None"
        )
    return measure(wxyz_xyz, body, groups, order, int(between))[0]


def prepare(function, trajectory, body, obstacles):
    """Checked arrays of the trajectory's type; obstacles of a kind stacked, and where each of these was in the list."""
    wxyz_xyz = np.asarray(check_trajectory(trajectory).wxyz_xyz)
    body = np.asarray(body)
    if (
        body.ndim != 2
        or body.shape[1] != 3
        or not len(body)
        or body.dtype.kind not in "fiu"
        or not np.isfinite(body).all()
    ):
        raise InputError(
            f"{function}(): body has shape {body.shape}; expected points (points, 3) of finite metres in the query frame"
        )
    if not isinstance(obstacles, list | tuple) or not obstacles:
        raise InputError(
            f"{function}(): obstacles are {obstacles!r}; expected a list of at least one, such as [box_obstacle(...)]"
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
                f"{function}(): obstacles[{i}] is a {type(obstacle).__name__}; expected an obstacle of tdf_jax.obstacles, "
                "or a registered dataclass of arrays with a method distance"
            )
        arrays.append(
            [np.asarray(leaf, wxyz_xyz.dtype if jnp.issubdtype(leaf.dtype, jnp.floating) else None) for leaf in leaves]
        )
        kinds.setdefault((tree, *((leaf.shape, leaf.dtype) for leaf in leaves)), []).append(i)
    groups = [
        jax.tree.unflatten(kind[0], [np.stack(parts) for parts in zip(*(arrays[i] for i in which))])
        for kind, which in kinds.items()
    ]
    return wxyz_xyz, body.astype(wxyz_xyz.dtype), groups, np.concatenate([np.array(which) for which in kinds.values()])


def body_centres(wxyz_xyz, body):
    """The middle of the body at each pose, in numpy: op by op, jax would compile each."""
    w, v, middle = wxyz_xyz[:, :1].astype(float), wxyz_xyz[:, 1:4].astype(float), body.mean(axis=0, dtype=float)
    return (
        middle
        + 2 * np.cross(v, np.cross(v, middle) + w * middle) / (w**2 + np.sum(v**2, axis=1, keepdims=True))
        + wxyz_xyz[:, 4:]
    )


def _turns(wxyz_xyz):
    """Angles between neighbouring poses."""
    unit = wxyz_xyz[:, :4] / np.linalg.norm(wxyz_xyz[:, :4].astype(float), axis=1, keepdims=True)
    return 2 * np.arccos(np.minimum(np.abs(np.sum(unit[:-1] * unit[1:], axis=1)), 1))


def motion_samples(wxyz_xyz, body, step):
    """Looks a segment so that no point of the body moves farther than step from one to the next: a power of 2, to compile few programs."""
    shift = np.linalg.norm(np.diff(wxyz_xyz[:, 4:], axis=0), axis=1)
    farthest = np.max(shift + _turns(wxyz_xyz) * np.linalg.norm(body, axis=1).max(), initial=0.0)
    return int(min(2 ** np.ceil(np.log2(max(farthest / step, 1))), MOST_BETWEEN + 1))


def path_lengths(wxyz_xyz, body, lever):
    """Length of the way to each pose, metres, turns counted by the lever."""
    shift = np.linalg.norm(np.diff(body_centres(wxyz_xyz, body), axis=0), axis=1)
    return np.concatenate([[0.0], np.cumsum(shift + lever * _turns(wxyz_xyz))])


def measure(wxyz_xyz, body, groups, order, between):
    """`Clearance`, and the distances at all looks and which point of the body is nearest, in the order of the groups."""
    rows, nearest = map(np.asarray, _distances(groups, wxyz_xyz, body, looks=between + 1))
    rows = rows.astype(float)
    listed = np.empty_like(rows)
    listed[:, order] = rows
    windows = [listed[i : len(listed) - between - 1 + i : between + 1] for i in range(between + 2)]
    return Clearance(listed[:: between + 1], np.min(windows, axis=0), between), rows, nearest


def distances_and_normals(groups, x):
    """Signed distances (obstacles, ...) of points and their gradients, the obstacles in the order of the groups."""

    def one(obstacle):
        apart, pull = jax.vjp(obstacle.distance, x)
        return apart, pull(jnp.ones_like(apart))[0]

    found = [jax.vmap(one)(group) for group in groups]
    return tuple(jnp.concatenate(parts) for parts in zip(*found))


@functools.partial(jax.jit, static_argnames="looks")
def _distances(groups, wxyz_xyz, body, *, looks):
    R, t = se3.rotation(wxyz_xyz), se3.translation(wxyz_xyz)
    fraction = jnp.arange(looks, dtype=t.dtype) / looks
    turned = se3.geodesic(R[:-1, None], R[1:, None], fraction).reshape(-1, 3, 3)
    shifted = (t[:-1, None] + fraction[:, None] * (t[1:] - t[:-1])[:, None]).reshape(-1, 3)

    def least(pose):
        x = se3.rotate(pose[0], body) + pose[1]
        apart = jnp.concatenate([jax.vmap(lambda one: one.distance(x))(group) for group in groups])
        return apart.min(axis=1), apart.argmin(axis=1)

    all_R, all_t = jnp.concatenate([turned, R[-1:]]), jnp.concatenate([shifted, t[-1:]])
    return jax.lax.map(least, (all_R, all_t))
