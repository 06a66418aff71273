"""A demonstration: one trajectory demonstrated on one object."""

import dataclasses

from jaxtyping import Array, Float

from tdf_jax._internal import checks
from tdf_jax._internal.errors import InputError
from tdf_jax.geometry.trajectory import Trajectory, check_trajectory


@dataclasses.dataclass(frozen=True)
class Demonstration:
    """One trajectory demonstrated on one object.

    Attributes:
        points: object point cloud, (points, 3), metres, world frame.
        trajectory: poses of the query frame, T_world_query, from the pick (index 0) to the place (the last index).
        query: query points, (queries, 3), metres, query frame.

    Raises:
        InputError: the points are not a point cloud, the trajectory fails `check_trajectory`, or the query points are
            not (queries, 3) and finite.
    """

    points: Float[Array, "points 3"]
    trajectory: Trajectory
    query: Float[Array, "queries 3"]

    def __post_init__(self):
        checks.points("Demonstration()", self.points)
        if not isinstance(self.trajectory, Trajectory):
            raise InputError(
                f"Demonstration(): trajectory is a {type(self.trajectory).__name__}; "
                "expected a Trajectory, such as tdf.wave()"
            )
        check_trajectory(self.trajectory)
        checks.query("Demonstration()", self.query)
