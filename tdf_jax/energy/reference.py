"""A demonstration, and the reference that an imitation is compared with."""

import dataclasses
import functools
from collections.abc import Iterable, Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from tdf_jax._internal.errors import InputError
from tdf_jax.energy.descriptors import trajectory_descriptor
from tdf_jax.geometry.demonstration import Demonstration
from tdf_jax.geometry.trajectory import Trajectory
from tdf_jax.networks.encoding import encode
from tdf_jax.networks.model import Model

COMBINATIONS = ("mean", "median")


@functools.partial(jax.tree_util.register_dataclass, data_fields=["descriptors", "trajectory", "query"], meta_fields=[])
@dataclasses.dataclass(frozen=True)
class Reference:
    """What one or several demonstrations ask for, on any object of the category.

    Attributes:
        descriptors: phi of the demonstration, (poses, queries, channels); of several, their mean or median.
        trajectory: T_object_query, relative to the demonstration's centroid with world axes; of several, the first's.
        query: query points in the query frame, metres.
    """

    descriptors: Float[Array, "poses queries channels"]
    trajectory: Trajectory
    query: Float[Array, "queries 3"]


def describe(model: Model, demonstrations: Demonstration | Sequence[Demonstration], combine: str = "mean") -> Reference:
    """Encode one or several demonstrations.

    Args:
        model: the network.
        demonstrations: one, or several with the same query points and number of poses.
        combine: what is taken of several descriptors of a query point, channel by channel: their "mean", as in NDF, or
            their "median", which has the least sum of the absolute differences that eq. 2 counts
            (docs/results/benchmark.md compares).

    Returns:
        The reference.

    Raises:
        InputError: no demonstration, something else, demonstrations that differ in query points or number of poses, or
            an unknown combination.
    """
    if combine not in COMBINATIONS:
        raise InputError(f"describe(): combine is {combine!r}; expected one of {', '.join(COMBINATIONS)}")
    demonstrations = list(demonstrations) if isinstance(demonstrations, Iterable) else [demonstrations]
    kinds = sorted({type(demo).__name__ for demo in demonstrations})
    if kinds != ["Demonstration"]:
        raise InputError(f"describe(): got {', '.join(kinds) or 'nothing'}; expected one or more of tdf.Demonstration")
    first = demonstrations[0]
    for other in demonstrations[1:]:
        if other.trajectory.num_poses != first.trajectory.num_poses or not np.array_equal(other.query, first.query):
            raise InputError(
                "describe(): demonstrations differ in their query points or number of poses; expected the same. "
                "Use one query set and resample() the trajectories"
            )
    query = jnp.asarray(first.query)
    fields = [encode(model, demo.points) for demo in demonstrations]
    several = [_describe(field, demo.trajectory, query) for field, demo in zip(fields, demonstrations)]
    descriptors = sum(several) / len(several) if combine == "mean" else jnp.median(jnp.stack(several), axis=0)
    return Reference(descriptors, first.trajectory.shifted(-fields[0].origin), query)


_describe = jax.jit(trajectory_descriptor)
