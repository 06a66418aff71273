"""Pinhole cameras: their matrix, and the pose of one that looks at a point."""

import numpy as np
from jaxtyping import Float

STRAIGHT = 1e-6  # sine of an angle from the vertical, below which a camera looks straight up or down


def camera_matrix(fovy: float, width: int, height: int) -> Float[np.ndarray, "3 3"]:
    """Matrix K as in OpenCV: whole pixel coordinates (column, row) are the centres of pixels.

    Args:
        fovy: vertical field of view, degrees.
        width: width of the image, pixels.
        height: height of the image, pixels.
    """
    focal_length = height / 2 / float(np.tan(np.radians(fovy) / 2))
    return np.array([[focal_length, 0, (width - 1) / 2], [0, focal_length, (height - 1) / 2], [0, 0, 1]])


def looking_at(position: Float[np.ndarray, "3"], target: Float[np.ndarray, "3"]) -> Float[np.ndarray, "4 4"]:
    """Pose of a camera that looks at a point, the world's z axis up in the image.

    Args:
        position: where the camera is, (3,), metres, world frame.
        target: point in the middle of the image, (3,), metres, world frame; another point.

    Returns:
        T_world_camera, (4, 4), metres; x to the right of the image, y down, z forward.
    """
    forward = (target - position) / np.linalg.norm(target - position)
    right = np.cross(forward, (0, 0, 1))
    if np.linalg.norm(right) < STRAIGHT:  # the image's right is then the world's -y
        right = np.array([0, -1.0, 0])
    right /= np.linalg.norm(right)
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = np.column_stack([right, np.cross(forward, right), forward]), position
    return T
