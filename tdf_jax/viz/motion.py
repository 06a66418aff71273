"""The frames of a film or a slider: where the query frame and the object are between the poses of a trajectory."""

import dataclasses

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation, Slerp

STEPS = 6  # frames from one pose to the next


@dataclasses.dataclass(frozen=True)
class Motion:
    """Poses of the query frame and motions of the object, metres, world frame.

    A point x of the object before the grasp is at R x + t in a frame.

    Attributes:
        index: place on the trajectory, 0 at its first pose and 1 at the second, (frames,).
        rotations: R_world_query, (frames, 3, 3).
        translations: origins of the query frame, (frames, 3).
        object_rotations: R of the object's motion, (frames, 3, 3).
        object_translations: t of the object's motion, (frames, 3).
    """

    index: Float[np.ndarray, " frames"]
    rotations: Float[np.ndarray, "frames 3 3"]
    translations: Float[np.ndarray, "frames 3"]
    object_rotations: Float[np.ndarray, "frames 3 3"]
    object_translations: Float[np.ndarray, "frames 3"]


def motion_of(
    wxyz_xyz: Float[np.ndarray, "poses 7"], grasp: int, release: int, index: Float[np.ndarray, " frames"] | None = None
) -> Motion:
    """Frames along a trajectory: rotations follow the SO(3) geodesic between poses, and the object is held in between.

    Args:
        wxyz_xyz: poses T_world_query, (poses, 7), metres.
        grasp: index of the pose at which the object is grasped.
        release: index of the pose at which it is released; negative indices count from the end.
        index: places on the trajectory, (frames,), from 0 to poses - 1; by default `STEPS` for each pose.
    """
    poses = np.asarray(wxyz_xyz, float)
    last = len(poses) - 1
    index = np.linspace(0, last, STEPS * last + 1) if index is None else np.asarray(index, float)
    grasp, release = grasp % len(poses), release % len(poses)
    R, t = _interpolated(poses, index)
    held_R, held_t = _interpolated(poses, np.clip(index, grasp, release))
    start_R, start_t = _interpolated(poses, np.array([float(grasp)]))
    object_R = held_R @ start_R[0].T
    return Motion(index, R, t, object_R, held_t - object_R @ start_t[0])


def _interpolated(poses: np.ndarray, index: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    rotations = Rotation.from_quat(poses[:, :4], scalar_first=True)
    if len(poses) == 1:
        return np.repeat(rotations.as_matrix(), len(index), axis=0), np.repeat(poses[:, 4:], len(index), axis=0)
    places = np.arange(len(poses))
    t = np.stack([np.interp(index, places, poses[:, 4 + axis]) for axis in range(3)], axis=1)
    return Slerp(places, rotations)(index).as_matrix(), t
