"""Objects that look the same from several sides: which of their equivalent poses is meant.

The symmetry of an object about its axis z is its fold: 1 where only a full turn leaves it as it is (a mug), 2 where
half a turn does (an oval bowl), 4 for quarter turns (a square bottle), and `ROUND`, 0, where any turn does. No cloud
tells equivalent poses apart, so no error may depend on which of them was found.
"""

import numpy as np
from jaxtyping import Float

ROUND = 0
FOLDS = {ROUND: "round", 1: "none", 2: "two-fold", 4: "four-fold"}


def nearest_turn(found: Float[np.ndarray, "points 3"], truth: Float[np.ndarray, "points 3"], fold: int) -> float:
    """The turn about z, of those that a symmetry allows, that brings true points nearest to found ones, in least squares.

    Args:
        found, truth: corresponding points in the object's frame, metres.
        fold: the object's.

    Returns:
        Radians.
    """
    along = np.sum(truth[:, :2] * found[:, :2])
    across = np.sum(truth[:, 0] * found[:, 1] - truth[:, 1] * found[:, 0])
    angle = float(np.arctan2(across, along))
    # The squared distance is a cosine of the turn away from its best one: of few turns the nearest is the best.
    return angle if fold == ROUND else float(np.round(angle * fold / (2 * np.pi)) * (2 * np.pi / fold))


def about_z(angle: float) -> Float[np.ndarray, "4 4"]:
    """A turn about z by radians, 4x4."""
    T = np.eye(4)
    T[:2, :2] = [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
    return T


def equivalent(
    T_object_found: Float[np.ndarray, "4 4"], T_object_truth: Float[np.ndarray, "4 4"], fold: int, size: float
) -> Float[np.ndarray, "4 4"]:
    """Of a true pose's equivalents, the one nearest to a found pose.

    Args:
        T_object_found, T_object_truth: poses of a frame in the object's canonical frame, 4x4, metres.
        fold: the object's.
        size: metres; how far from the frame's origin points are looked at, which weighs rotations against translations.

    Returns:
        T_object_frame, 4x4.
    """
    if fold == 1:
        return T_object_truth
    tips = np.concatenate([np.eye(3), -np.eye(3)]) * size
    points = (tips @ T[:3, :3].T + T[:3, 3] for T in (T_object_found, T_object_truth))
    return about_z(nearest_turn(*points, fold)) @ T_object_truth
