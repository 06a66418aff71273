"""A demonstration: one trajectory demonstrated on one object."""

import dataclasses

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from tdf_jax._internal import checks
from tdf_jax._internal.errors import InputError
from tdf_jax.geometry.trajectory import Trajectory, check_trajectory, resample


@dataclasses.dataclass(frozen=True)
class Demonstration:
    """One trajectory demonstrated on one object.

    The object moves with the query frame from the grasp to the release. A recorded motion may begin before the grasp,
    with the approach, and end after the release, with the retreat.

    Attributes:
        points: object point cloud before the grasp, (points, 3), metres, world frame.
        trajectory: poses of the query frame, T_world_query, in the order of the motion.
        query: query points, (queries, 3), metres, query frame.
        grasp: index of the pose at which the object is grasped, the pick.
        release: index of the pose at which it is released, not before the grasp; negative indices count from the end.

    Raises:
        InputError: the points are not a point cloud, the trajectory fails `check_trajectory`, the query points are not
            (queries, 3) and finite, an index is outside of the trajectory, or the release is before the grasp.
    """

    points: Float[Array | np.ndarray, "points 3"]
    trajectory: Trajectory
    query: Float[Array | np.ndarray, "queries 3"]
    grasp: int = 0
    release: int = -1

    def __post_init__(self):
        checks.points("Demonstration()", self.points)
        if not isinstance(self.trajectory, Trajectory):
            raise InputError(
                f"Demonstration(): trajectory is a {type(self.trajectory).__name__}; "
                "expected a Trajectory, such as tdf.wave()"
            )
        check_trajectory(self.trajectory)
        checks.query("Demonstration()", self.query)
        count = self.trajectory.num_poses
        for name in ("grasp", "release"):
            checks.count("Demonstration()", name, getattr(self, name), -count, count - 1)
        first, last = self.grasp % count, self.release % count
        if first > last:
            raise InputError(
                f"Demonstration(): grasp is pose {first} and release pose {last} of {count}; expected the grasp first"
            )
        for name, array in (("points", self.points), ("trajectory", self.trajectory.wxyz_xyz)):
            if not checks.traced(array):
                coordinates = np.asarray(array)
                checks.near("Demonstration()", name, coordinates[:, -3:], coordinates)

    @property
    def transfer(self) -> Trajectory:
        """Poses from the grasp to the release, between which the object moves with the query frame."""
        return self._part(self._first, self._last + 1)

    @property
    def approach(self) -> Trajectory:
        """Poses before the grasp; none unless the recording begins earlier."""
        return self._part(0, self._first)

    @property
    def retreat(self) -> Trajectory:
        """Poses after the release; none unless the recording ends later."""
        return self._part(self._last + 1, self.trajectory.num_poses)

    def resampled(self, num_poses: int) -> "Demonstration":
        """Resample the poses from the grasp to the release, as `resample` does; approach and retreat are unchanged.

        Args:
            num_poses: new number of poses from the grasp to the release, at least 2.

        Returns:
            The demonstration with the new trajectory and indices.

        Raises:
            InputError: as for `resample`.
        """
        transfer = resample(self.transfer, num_poses)
        parts = (self.approach, transfer, self.retreat)
        poses = jnp.concatenate([jnp.asarray(part.wxyz_xyz) for part in parts])
        last = self._first + num_poses - 1
        return dataclasses.replace(self, trajectory=Trajectory(poses), grasp=self._first, release=last)

    @property
    def _first(self) -> int:
        return self.grasp % self.trajectory.num_poses

    @property
    def _last(self) -> int:
        return self.release % self.trajectory.num_poses

    def _part(self, begin: int, end: int) -> Trajectory:
        return Trajectory(self.trajectory.wxyz_xyz[begin:end])
