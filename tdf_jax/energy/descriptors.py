"""Descriptors of poses and trajectories: the point descriptors of the query points at each pose (eq. 1)."""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from tdf_jax._internal import checks
from tdf_jax._internal.boundary import public
from tdf_jax._internal.errors import InputError
from tdf_jax.geometry import se3
from tdf_jax.geometry.trajectory import Trajectory
from tdf_jax.networks.field import DescriptorField


@public
def pose_descriptor(
    field: DescriptorField, T_world_query: Float[Array, "7"], query: Float[Array, "queries 3"]
) -> Float[Array, "queries channels"]:
    """F(T | P): descriptors of the query points at one pose.

    Args:
        field: descriptor field of the object.
        T_world_query: pose of the query frame, `wxyz_xyz`, (7,), metres, world frame.
        query: query points, (queries, 3), metres, query frame.

    Returns:
        One descriptor for each query point, (queries, channels).

    Raises:
        InputError: query points that are not (queries, 3) and finite, or a pose that is not seven numbers.
    """
    points = jnp.asarray(checks.query("pose_descriptor()", query))
    pose = jnp.asarray(T_world_query)
    if pose.shape != (7,):
        raise InputError(
            f"pose_descriptor(): T_world_query has shape {pose.shape}; expected (7,), wxyz_xyz. For several use "
            "trajectory_descriptor() or jax.vmap"
        )
    return field.descriptors(se3.transform(pose, points))


@public
def trajectory_descriptor(
    field: DescriptorField, trajectory: Trajectory, query: Float[Array, "queries 3"]
) -> Float[Array, "poses queries channels"]:
    """phi(T | P): pose descriptors of every waypoint (eq. 1 of the TDF paper).

    Args:
        field: descriptor field of the object.
        trajectory: poses of the query frame, T_world_query.
        query: query points, (queries, 3), metres, query frame.

    Returns:
        One descriptor for each waypoint and query point, (poses, queries, channels).

    Raises:
        InputError: query points that are not (queries, 3) and finite, or a trajectory that is not of shape (poses, 7).
    """
    checks.query("trajectory_descriptor()", query)
    check_poses("trajectory_descriptor()", trajectory)
    return jax.lax.map(lambda T_world_query: pose_descriptor(field, T_world_query, query), trajectory.wxyz_xyz)


def check_poses(function: str, trajectory: Trajectory) -> None:
    """Check the type and the shape of a trajectory; norms of quaternions are free, steps of an optimiser change them.

    Args:
        function: begins the message.
        trajectory: trajectory to check.

    Raises:
        InputError: it is no `Trajectory` of an array (poses, 7).
    """
    if not isinstance(trajectory, Trajectory):
        raise InputError(f"{function}: trajectory is a {type(trajectory).__name__}; expected a tdf.Trajectory")
    poses = trajectory.wxyz_xyz
    if not isinstance(poses, jax.Array | np.ndarray) or poses.ndim != 2 or poses.shape[1] != 7:
        got = f"of shape {np.shape(poses)}" if hasattr(poses, "shape") else f"a {type(poses).__name__}"
        raise InputError(
            f"{function}: trajectory.wxyz_xyz is {got}; expected an array (poses, 7). For several use jax.vmap"
        )
