"""Descriptors of poses and trajectories: the point descriptors of the query points they carry."""

import jax
import numpy as np
from jaxtyping import Array, Float

from tdf_jax.geometry import se3 as poses
from tdf_jax._internal.errors import InputError
from tdf_jax.networks.field import DescriptorField
from tdf_jax.geometry.trajectory import Trajectory


def pose_descriptor(
    field: DescriptorField, T_world_query: Float[Array, "7"], query: Float[Array, "queries 3"]
) -> Float[Array, "queries channels"]:
    """F(T | P): descriptors of the query points at one pose.

    Args:
        field: the object's.
        T_world_query: pose of the query frame, `wxyz_xyz`.
        query: points in the query frame, metres.

    Raises:
        InputError: query points that are not (queries, 3) and finite.
    """
    check_query("pose_descriptor()", query)
    return field.descriptors(poses.transform(T_world_query, query))


def trajectory_descriptor(
    field: DescriptorField, trajectory: Trajectory, query: Float[Array, "queries 3"]
) -> Float[Array, "poses queries channels"]:
    """phi(T | P): pose descriptors of every waypoint (eq. 1 of the TDF paper).

    Args:
        field: the object's.
        trajectory: poses of the query frame.
        query: points in the query frame, metres.
    """
    return jax.lax.map(lambda T_world_query: pose_descriptor(field, T_world_query, query), trajectory.wxyz_xyz)


def check_query(function: str, query) -> None:
    """Raise InputError unless query points are (queries, 3), at least one, and finite."""
    shape = np.shape(query)
    if len(shape) != 2 or shape[1] != 3 or shape[0] < 1:
        raise InputError(f"{function}: query points have shape {shape}; expected (queries, 3). Try tdf.box_query(key, count=500)")
    if not isinstance(query, jax.core.Tracer) and not np.isfinite(np.asarray(query)).all():
        raise InputError(f"{function}: some query points are NaN or infinite; expected finite metres")
