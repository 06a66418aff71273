"""Dense poses of a gripper from approach to retreat, and the joints with which an arm follows them."""

import numpy as np
from jaxtyping import Float

from tdf_jax.sim.kinematics import FOLLOWING, Kinematics

SPACING, TURN = 0.005, 0.05  # metres and radians between poses for which the joints are computed
MAX_STEP = 0.35  # radians, largest step of a joint between them; a larger one is another configuration of the arm


class GripperPath:
    """Dense poses of the gripper's frame, from behind the pick to behind the release.

    Attributes:
        poses: the poses, (rows, 4, 4), metres, world frame.
        pick, release: rows of the pick and of the release.
        lengths: length of the path up to each row, (rows,), metres.
    """

    def __init__(self, poses: Float[np.ndarray, "poses 4 4"], approach: float):
        """Interpolate along straight lines and geodesics.

        Args:
            poses: poses from the pick to the release, (poses, 4, 4), metres, world frame.
            approach: length of the straight motions before and after them, along the approach, metres.
        """
        behind = np.eye(4)
        behind[2, 3] = -approach
        corners = np.concatenate([[poses[0] @ behind], poses, [poses[-1] @ behind]])
        rows, at = [corners[:1]], [0]
        for start, end in zip(corners[:-1], corners[1:]):
            rows.append(_between(start, end))
            at.append(at[-1] + len(rows[-1]))
        self.poses = np.concatenate(rows)
        self.pick, self.release = at[1], at[-2]
        steps = np.linalg.norm(np.diff(self.poses[:, :3, 3], axis=0, prepend=self.poses[:1, :3, 3]), axis=1)
        self.lengths = steps.cumsum()

    def near_pick(self, distance: float) -> np.ndarray:
        """Rows from the pick up to a distance along the path, metres."""
        rows = np.arange(self.pick, self.release + 1)
        return rows[self.lengths[rows] - self.lengths[self.pick] <= distance]

    def near_release(self, distance: float) -> np.ndarray:
        """Rows from a distance along the path, metres, up to the release."""
        rows = np.arange(self.pick, self.release + 1)
        return rows[self.lengths[self.release] - self.lengths[rows] <= distance]

    def in_hand(self, T_world_object: Float[np.ndarray, "4 4"] | None) -> Float[np.ndarray, "4 4"] | None:
        """Pose in the gripper's frame, 4x4, of an object that is picked where it is; None if there is none."""
        return None if T_world_object is None else np.linalg.inv(self.poses[self.pick]) @ T_world_object

    def followed(
        self, kinematics: Kinematics, configuration: Float[np.ndarray, " joints"], at: int, first: int, last: int
    ) -> Float[np.ndarray, "rows joints"] | None:
        """Joints along a part of the path, from a configuration of the arm at one of its poses.

        Args:
            kinematics: of the arm.
            configuration: positions of the joints at row `at`, (joints,), radians.
            at: row of that pose.
            first: first row of the part, at most `at`.
            last: last row of the part, at least `at`.

        Returns:
            The joints, (rows, joints), radians, NaN outside of the part; None if the arm cannot follow.
        """
        joints = np.full((len(self.poses), len(configuration)), np.nan)
        joints[at] = configuration
        for way in (range(at - 1, first - 1, -1), range(at + 1, last + 1)):
            before = configuration
            for row in way:
                solution = kinematics.solve(self.poses[row], before, FOLLOWING)
                if solution is None or np.abs(solution - before).max() > MAX_STEP:
                    return None
                joints[row] = before = solution
        return joints


def lifted(poses: Float[np.ndarray, "poses 4 4"], lift: float) -> Float[np.ndarray, "_ 4 4"]:
    """A path that begins with a straight lift: one that tilts what it picks at once would hit the table.

    Args:
        poses: poses from the pick to the release, (poses, 4, 4), metres, world frame.
        lift: height of the lift, metres; 0 for none.
    """
    if not lift or len(poses) < 2:
        return poses
    above = poses[0].copy()
    above[2, 3] += lift
    return np.concatenate([poses[:1], above[None], poses[1:]])


def _between(start: np.ndarray, end: np.ndarray) -> np.ndarray:
    """Poses on the straight line and geodesic after one pose up to the next."""
    from scipy.spatial.transform import Rotation, Slerp

    rotations = Rotation.from_matrix(np.stack([start[:3, :3], end[:3, :3]]))
    angle = (rotations[0].inv() * rotations[1]).magnitude()
    distance = np.linalg.norm(end[:3, 3] - start[:3, 3])
    count = max(1, int(np.ceil(max(distance / SPACING, angle / TURN))))
    shares = np.arange(1, count + 1) / count
    poses = np.tile(np.eye(4), (count, 1, 1))
    poses[:, :3, :3] = Slerp([0.0, 1.0], rotations)(shares).as_matrix()
    poses[:, :3, 3] = start[:3, 3] + shares[:, None] * (end[:3, 3] - start[:3, 3])
    return poses
