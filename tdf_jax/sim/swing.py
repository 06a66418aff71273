"""Turning a hand so that what it holds, far from its centre of mass, does not swing."""

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
