"""A demonstration: one trajectory demonstrated on one object."""

import dataclasses
import warnings

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from tdf_jax._internal import checks
from tdf_jax._internal.boundary import public
from tdf_jax._internal.deprecation import caller_level
from tdf_jax._internal.errors import ForeignPointsWarning, InputError
from tdf_jax.geometry import se3
from tdf_jax.geometry.target import Target, check_contact
from tdf_jax.geometry.trajectory import Trajectory, check_trajectory, resample

# Diagonals of the cloud. Query points far from the object are legitimate, but their descriptors fade with the distance
# (figure 3 of the paper); a wrong unit is a factor of 39 or more.
LARGEST_QUERY, FARTHEST_QUERY = 10.0, 10.0
# A point lies on a cloud's surface if it is as near to the plane through its nearest points as `FLAT` of the cloud's
# own points are to theirs, and within so many spacings of one. Two samples of one surface have four fifths of their
# points on each other; objects on or in their targets at most a fifth, and bowls stacked 1 cm apart up to two thirds.
PLANE_POINTS, FLAT, SPACINGS = 6, 0.8, 2.5
# Share of points above which they show one surface. If the object's points alone lie on the target's, it may be a part
# of the target, but also a plate of 3 mm on its target in noisy clouds.
SAME_SURFACE = 0.7
COMPARED = 2000  # points of each cloud that are compared
SAME_POINT = 1e-5  # metres within which a point of the object is one of the target, and not only close to it


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
        target: object that the first one is placed on or in; None where the goal is given.

    Raises:
        InputError: the points are not a point cloud, the trajectory fails `check_trajectory`, the query points are not
            (queries, 3) and finite, an index is outside of the trajectory, the release is before the grasp, the contact
            points of the target are not at the released object, or object and target share points or a surface.

    Warns:
        ForeignPointsWarning: most of the object's points lie on the target's surface.
    """

    points: Float[Array | np.ndarray, "points 3"]
    trajectory: Trajectory
    query: Float[Array | np.ndarray, "queries 3"]
    grasp: int = 0
    release: int = -1
    target: Target | None = None

    @public
    def __post_init__(self):
        # Stored as the checks return them, so that lists and arrays of other libraries are converted once.
        object.__setattr__(self, "points", checks.points("Demonstration()", self.points))
        if not isinstance(self.trajectory, Trajectory):
            raise InputError(
                f"Demonstration(): trajectory is a {type(self.trajectory).__name__}; "
                "expected a Trajectory, such as tdf.wave()"
            )
        check_trajectory(self.trajectory)
        object.__setattr__(self, "query", checks.query("Demonstration()", self.query))
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
        self._check_query()
        if self.target is not None:
            self._check_target(self.target)

    @property
    @public
    def object_motion(self) -> Float[Array, "7"]:
        """Motion of the object from the grasp to the release, `wxyz_xyz`: its initial point x ends at D x."""
        poses = jnp.asarray(self.transfer.wxyz_xyz)
        return se3.compose(poses[-1], se3.inverse(poses[0]))

    @property
    @public
    def T_object_contact(self) -> Float[Array, "7"]:
        """Pose of the contact frame on the object in its initial pose, before the grasp, world frame, `wxyz_xyz`.

        Raises:
            InputError: there is no target.
        """
        if self.target is None:
            raise InputError("Demonstration.T_object_contact: there is no target; expected Demonstration(target=...)")
        return se3.compose(se3.inverse(self.object_motion), jnp.asarray(self.target.T_world_contact))

    @property
    @public
    def transfer(self) -> Trajectory:
        """Poses from the grasp to the release, between which the object moves with the query frame."""
        return self._part(self._first, self._last + 1)

    @property
    @public
    def approach(self) -> Trajectory:
        """Poses before the grasp; none unless the recording begins earlier."""
        return self._part(0, self._first)

    @property
    @public
    def retreat(self) -> Trajectory:
        """Poses after the release; none unless the recording ends later."""
        return self._part(self._last + 1, self.trajectory.num_poses)

    @public
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
        last = self.release if self.release < 0 else self._first + num_poses - 1
        return dataclasses.replace(self, trajectory=Trajectory(poses), grasp=self._first, release=last)

    def _check_query(self) -> None:
        """Refuse query points of another unit or frame: far from the object, all descriptors are alike."""
        if checks.traced(self.points, self.trajectory, self.query):
            return
        cloud, query = (np.asarray(array, np.float64) for array in (self.points, self.query))
        diagonal, size = (float(np.linalg.norm(np.ptp(array, axis=0))) for array in (cloud, query))
        if size > LARGEST_QUERY * diagonal:
            raise InputError(
                f"Demonstration(): the query points have a diagonal of {size:.3g} m, and the cloud one of "
                f"{diagonal:.3g} m; expected a part of the object. If they are in millimetres, multiply by 0.001"
            )
        grasp = np.asarray(self.trajectory.wxyz_xyz)[self._first]
        carried = np.asarray(se3.transform(grasp, query.astype(grasp.dtype)), np.float64)
        low, high = cloud.min(axis=0), cloud.max(axis=0)
        gap = np.linalg.norm(np.maximum(0, np.maximum(low - carried, carried - high)), axis=1).min()
        if gap > FARTHEST_QUERY * diagonal:
            raise InputError(
                f"Demonstration(): at the grasp, pose {self._first}, the query points are {gap:.3g} m from the object, "
                f"whose diagonal is {diagonal:.3g} m; expected them at the object. Check that cloud, poses and query "
                "points are in metres, that the poses are T_world_query in the frame of the cloud, and grasp"
            )

    @public
    def _repr_html_(self) -> str | None:
        from tdf_jax.viz.cards import demonstration_card  # only a notebook asks, see tests/test_layout.py

        traced = checks.traced(self.points, self.trajectory, self.query)
        return None if traced else demonstration_card(self)

    def _check_target(self, target: Target) -> None:
        if not isinstance(target, Target):
            raise InputError(f"Demonstration(): target is a {type(target).__name__}; expected a tdf.Target")
        if self._first == self._last:
            raise InputError(
                "Demonstration(): there is a target, and grasp and release are one pose; expected the motion between"
            )
        if checks.traced(self.points, self.trajectory, target.points, target.query, target.T_world_contact):
            return
        cloud = np.asarray(self.points, np.float64)
        contact = np.asarray(self.T_object_contact)
        check_contact("Demonstration()", "object, moved to the release", cloud, np.asarray(target.query), contact)
        check_apart("Demonstration()", cloud, target.points)

    @property
    def _first(self) -> int:
        return self.grasp % self.trajectory.num_poses

    @property
    def _last(self) -> int:
        return self.release % self.trajectory.num_poses

    def _part(self, begin: int, end: int) -> Trajectory:
        return Trajectory(self.trajectory.wxyz_xyz[begin:end])


def check_apart(function: str, points, target_points) -> None:
    """Check that the clouds of object and target do not show the same points or the same surface.

    Object and target may touch, stand in each other or be stacked. Where the surfaces only cross, nothing is said: in
    noisy clouds an object on its target does that too.

    Args:
        function: name that the message begins with.
        points: point cloud of the object, (points, 3), metres.
        target_points: point cloud of the target, (points, 3), metres.

    Raises:
        InputError: more than a tenth of the object's points are points of the target, or most of the points of each
            lie on the surface of the other.

    Warns:
        ForeignPointsWarning: most of the points of the object alone lie on the surface of the target.
    """
    if checks.traced(points, target_points):
        return
    cloud = np.asarray(points, np.float64)
    shared = np.isin(_cells(cloud), _cells(np.asarray(target_points, np.float64))).sum()
    if shared > len(cloud) / 10:
        raise InputError(
            f"{function}: {shared} of the {len(cloud)} points of the object are points of the target too; expected two "
            "clouds without common points: cut the object out of the target's cloud"
        )
    one, other = (_sparse(np.asarray(cloud, np.float64)) for cloud in (points, target_points))
    on_target, on_object = _share_on(one, other), _share_on(other, one)
    if min(on_target, on_object) > SAME_SURFACE:
        raise InputError(
            f"{function}: the object's points lie on the target's surface ({on_target:.0%} of them), and the target's "
            f"on the object's ({on_object:.0%}); expected clouds of two objects that do not overlap: check that the "
            "second is not the object's own, and that both are in one frame"
        )
    if on_target > SAME_SURFACE:
        warnings.warn(
            f"{function}: {on_target:.0%} of the object's points lie on the target's surface; check that the object's "
            "cloud is not a part of the target's, and that both are in one frame",
            ForeignPointsWarning,
            stacklevel=caller_level(),
        )


def _sparse(cloud: np.ndarray) -> np.ndarray:
    return cloud[:: -(-len(cloud) // COMPARED)]


def _share_on(cloud: np.ndarray, surface: np.ndarray) -> float:
    """Share of a cloud's points that lie on a surface, which points are of."""
    from scipy.spatial import KDTree

    tree = KDTree(surface)
    own, spacings = _offsets(surface, tree, 1)
    offsets, distances = _offsets(cloud, tree, 0)
    near = distances < SPACINGS * np.median(spacings)
    return float(np.mean(near & (offsets <= np.quantile(own, FLAT))))


def _offsets(cloud: np.ndarray, tree, skipped: int) -> tuple[np.ndarray, np.ndarray]:
    """Distances of points from the planes through their nearest neighbours, but for the first, and from the nearest."""
    distances, nearest = tree.query(cloud, skipped + PLANE_POINTS)
    neighbours = tree.data[nearest[:, skipped:]]
    centres = neighbours.mean(axis=1)
    spread = neighbours - centres[:, None]
    normals = np.linalg.eigh(spread.swapaxes(1, 2) @ spread)[1][:, :, 0]
    return np.abs(((cloud - centres) * normals).sum(axis=1)), distances[:, skipped]


def _cells(cloud: np.ndarray) -> np.ndarray:
    """A number for each point that equal points share."""
    cells = np.round(cloud / SAME_POINT).astype(np.int64)
    return cells[:, 0] + (cells[:, 1] << 21) + (cells[:, 2] << 42)
