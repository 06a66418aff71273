"""Symmetric objects: equivalent poses, and the one nearest to an estimate.

The symmetry of an object about its z axis is its fold: 1 if only a full turn maps the object to itself (a mug), 2 if a
half turn does (an oval bowl), 4 if a quarter turn does (a square bottle), and `ROUND` (0) if every turn does. A point
cloud does not distinguish equivalent poses, so an error must not depend on which of them was estimated.
"""

import numpy as np
from jaxtyping import Float

ROUND = 0
FOLDS = {ROUND: "round", 1: "none", 2: "two-fold", 4: "four-fold"}


def nearest_turn(estimate: Float[np.ndarray, "points 3"], truth: Float[np.ndarray, "points 3"], fold: int) -> float:
    """Find the rotation about z, among those of a symmetry, that moves true points nearest to estimated ones.

    Args:
        estimate: estimated points, (points, 3), metres, object frame.
        truth: corresponding ground-truth points, (points, 3), metres, object frame.
        fold: symmetry of the object, a key of `FOLDS`.

    Returns:
        Angle of the rotation of least squared distance, radians.
    """
    cosine = np.sum(truth[:, :2] * estimate[:, :2])
    sine = np.sum(truth[:, 0] * estimate[:, 1] - truth[:, 1] * estimate[:, 0])
    angle = float(np.arctan2(sine, cosine))
    # The squared distance is a cosine of the difference from the best angle, so the nearest allowed angle is the best.
    return angle if fold == ROUND else float(np.round(angle * fold / (2 * np.pi)) * (2 * np.pi / fold))


def about_z(angle: float) -> Float[np.ndarray, "4 4"]:
    """Make the homogeneous matrix of a rotation about z.

    Args:
        angle: angle of the rotation, radians.

    Returns:
        Rigid transform, (4, 4).
    """
    T = np.eye(4)
    T[:2, :2] = [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
    return T


def equivalent(
    T_object_estimate: Float[np.ndarray, "4 4"], T_object_truth: Float[np.ndarray, "4 4"], fold: int, size: float
) -> Float[np.ndarray, "4 4"]:
    """Select the equivalent of a true pose that is nearest to an estimated pose.

    Args:
        T_object_estimate: estimated pose of a frame, (4, 4), metres, canonical frame of the object.
        T_object_truth: ground-truth pose of that frame, (4, 4), metres, canonical frame of the object.
        fold: symmetry of the object, a key of `FOLDS`.
        size: distance of six points on the frame's axes from its origin, metres. The distance between poses is that of
            these points, so `size` weighs rotations against translations.

    Returns:
        The equivalent ground-truth pose, (4, 4), metres, canonical frame of the object.
    """
    if fold == 1:
        return T_object_truth
    axis_points = np.concatenate([np.eye(3), -np.eye(3)]) * size
    estimate, truth = (axis_points @ T[:3, :3].T + T[:3, 3] for T in (T_object_estimate, T_object_truth))
    return about_z(nearest_turn(estimate, truth, fold)) @ T_object_truth
