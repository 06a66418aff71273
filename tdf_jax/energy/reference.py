"""The reference that an imitation is compared with: the descriptors of one or several demonstrations."""

import dataclasses
import functools
from collections.abc import Iterable, Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from tdf_jax._internal import checks
from tdf_jax._internal.errors import InputError
from tdf_jax.energy.descriptors import trajectory_descriptor
from tdf_jax.geometry.demonstration import Demonstration
from tdf_jax.geometry.trajectory import Trajectory
from tdf_jax.networks.encoding import encode
from tdf_jax.networks.model import Model

COMBINATIONS = ("mean", "median")


def _no_poses() -> Array:
    return jnp.zeros((0, 7))


@functools.partial(
    jax.tree_util.register_dataclass,
    data_fields=["descriptors", "trajectory", "query", "approach", "retreat"],
    meta_fields=[],
)
@dataclasses.dataclass(frozen=True)
class Reference:
    """Descriptors and poses of one or several demonstrations.

    Attributes:
        descriptors: phi of the demonstration, or the mean or median over demonstrations, (poses, queries, channels).
        trajectory: poses T_object_query of the first demonstration from the grasp to the release, metres; the object
            frame has its origin at the centroid of the demonstrated cloud and the axes of the world.
        query: query points, (queries, 3), metres, query frame.
        approach: poses T_object_query before the grasp, (before, 7), `wxyz_xyz`; usually none.
        retreat: poses T_object_query after the release, (after, 7); usually none.
    """

    descriptors: Float[Array, "poses queries channels"]
    trajectory: Trajectory
    query: Float[Array, "queries 3"]
    approach: Float[Array, "before 7"] = dataclasses.field(default_factory=_no_poses)
    retreat: Float[Array, "after 7"] = dataclasses.field(default_factory=_no_poses)


def describe(model: Model, demonstrations: Demonstration | Sequence[Demonstration], combine: str = "mean") -> Reference:
    """Encode one or several demonstrations.

    Args:
        model: network that encodes the demonstrated objects.
        demonstrations: one demonstration, or several with the same query points and number of poses from the grasp to
            the release. The poses before and after are those of the first.
        combine: how the descriptors of several demonstrations are combined, channel by channel: "mean", as in NDF, or
            "median", which minimises the sum of absolute differences of eq. 2 (docs/results/benchmark.md compares
            them).

    Returns:
        The reference.

    Raises:
        InputError: there is no demonstration, an argument is not a `Demonstration`, demonstrations differ in query
            points or number of poses, or `combine` is unknown.
    """
    checks.choice("describe()", "combine", combine, COMBINATIONS)
    demonstrations = list(demonstrations) if isinstance(demonstrations, Iterable) else [demonstrations]
    kinds = sorted({type(demo).__name__ for demo in demonstrations})
    if kinds != ["Demonstration"]:
        raise InputError(f"describe(): got {', '.join(kinds) or 'nothing'}; expected one or more of tdf.Demonstration")
    first = demonstrations[0]
    for other in demonstrations[1:]:
        if other.transfer.num_poses != first.transfer.num_poses or not np.array_equal(other.query, first.query):
            raise InputError(
                "describe(): demonstrations differ in their query points or number of poses from the grasp to the "
                "release; expected the same. Use one set of query points, and demonstration.resampled(num_poses)"
            )
    query = jnp.asarray(first.query)
    fields = [encode(model, demo.points) for demo in demonstrations]
    several = [_describe(field, demo.transfer, query) for field, demo in zip(fields, demonstrations)]
    descriptors = (
        sum(several[1:], several[0]) / len(several) if combine == "mean" else jnp.median(jnp.stack(several), axis=0)
    )
    transfer, approach, retreat = (
        _relative(part.wxyz_xyz, fields[0].origin) for part in (first.transfer, first.approach, first.retreat)
    )
    return Reference(descriptors, Trajectory(transfer), query, approach, retreat)


def _relative(wxyz_xyz, origin) -> Array:
    """Poses relative to an origin; the difference is taken in float64 where the numbers are known."""
    if checks.traced(wxyz_xyz, origin):
        return Trajectory(wxyz_xyz).shifted(-origin).wxyz_xyz
    poses = np.asarray(wxyz_xyz)
    offset = np.concatenate([np.zeros(4), np.asarray(origin, np.float64)])
    return jnp.asarray((poses - offset).astype(jax.dtypes.canonicalize_dtype(poses.dtype)))


_describe = jax.jit(trajectory_descriptor)
