"""How an object swings in a hand that holds it far from its centre of mass, and turning a hand so that it does not."""

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation


def level_rotations(
    start: Float[np.ndarray, "3 3"], end: Float[np.ndarray, "3 3"], shares: Float[np.ndarray, " shares"]
) -> Float[np.ndarray, "shares 3 3"]:
    """Orientations between two, such that the vertical takes the shortest way as seen from what is turned.

    They are a tilt about a horizontal axis and a turn about the vertical, both even. Where a hand and what hangs from
    it begin in one vertical plane and end upright, gravity stays in that plane of the hand; along the geodesic it
    leaves the plane if there is a turn about the vertical too.

    Args:
        start: first orientation, 3x3, world frame with z up.
        end: last orientation, 3x3.
        shares: shares of the way, 0 to 1.

    Returns:
        The orientations, (shares, 3, 3).
    """
    whole = Rotation.from_matrix(end @ start.T)
    about_z = whole.as_quat() * [0, 0, 1, 1]
    # Turned over, the turn about the vertical is any: none is taken.
    turn = Rotation.from_quat(about_z) if np.linalg.norm(about_z) > 1e-6 else Rotation.identity()
    tilt = turn.inv() * whole
    shares = np.asarray(shares, float)[:, None]
    between = Rotation.from_rotvec(shares * turn.as_rotvec()) * Rotation.from_rotvec(shares * tilt.as_rotvec())
    return between.as_matrix() @ start


def swing_arm(poses: Float[np.ndarray, "poses 4 4"], centre: Float[np.ndarray, "3"]) -> float:
    """The largest arm with which weight turns a held object about the closing axis of the hand.

    Two pads hold least against this turn. Of equally good grasps, that with the smallest arm holds best. The middle of
    a cloud does for the centre of mass.

    Args:
        poses: poses of the gripper's frame from the pick to the release, (poses, 4, 4), metres, world frame with z up.
        centre: centre of mass of the object at the pick, (3,), metres, world frame.

    Returns:
        The arm, metres.
    """
    rotations = poses[:, :3, :3]
    held = rotations[0].T @ (np.asarray(centre, float) - poses[0, :3, 3])
    up = rotations[:, 2, :]  # in the gripper's frame
    return float(np.abs(held[2] * up[:, 0] - held[0] * up[:, 2]).max())
