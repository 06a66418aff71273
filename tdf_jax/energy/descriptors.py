"""Descriptors of poses and trajectories: the point descriptors of the query points at each pose (eq. 1)."""

import jax
from jaxtyping import Array, Float

from tdf_jax._internal import checks
from tdf_jax._internal.boundary import public
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
        InputError: query points that are not (queries, 3) and finite.
    """
    checks.query("pose_descriptor()", query)
    return field.descriptors(se3.transform(T_world_query, query))


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
        InputError: query points that are not (queries, 3) and finite.
    """
    return jax.lax.map(lambda T_world_query: pose_descriptor(field, T_world_query, query), trajectory.wxyz_xyz)
