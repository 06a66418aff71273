"""Alternatives and certainty: which distinct poses the starts came to, and how sharply the energy determines one of them.

Small motions of a pose are twists: a turn (a rotation vector, radians) about the mean of the query points, and a move
of it (metres), both along the world's axes, six numbers (turn, move). They act as screws: a twist (w, w x (c - a)),
with c the mean, is exactly a turn about the axis w through a, at any angle.
"""

import dataclasses

import numpy as np
from jaxtyping import Array, Float, Int

from tdf_jax._internal.errors import InputError

# Radians and metres within which starts count as one mode. At their minima, starts that came to one pose were within
# 0.4 degrees and 0.1 mm of each other on generated mugs; starts that are still on their way, such as finalists after 4
# polishing steps, lie 5 to 90 degrees from it, and no bound tells them from modes.
SAME_ANGLE, SAME_DISTANCE = np.radians(15), 0.02


@dataclasses.dataclass(frozen=True, eq=False)
class Mode:
    """Starts that came to the same pose.

    Attributes:
        pose: of the start with the least energy, `wxyz_xyz`.
        energy: of that start.
        members: which starts, by rising energy; the first is the one of `pose`.
        share: of the finite starts that are members.
    """

    pose: Float[np.ndarray, "7"]
    energy: float
    members: Int[np.ndarray, " members"]
    share: float


def cluster_poses(
    wxyz_xyz: Float[Array, "candidates 7"],
    energies: Float[Array, " candidates"],
    *,
    angle: float = SAME_ANGLE,
    distance: float = SAME_DISTANCE,
) -> list[Mode]:
    """The distinct poses among those that several starts came to.

    From the least energy upwards, a start joins the first mode whose `pose` is near it in both turn and distance, or
    else begins one. Starts of equal energy are taken in their order.

    The starts have to be at their minima, or they are counted where they happen to be: of six finalists on generated
    mugs `solve` with its 4 polishing steps left 1 to 6 modes, and with 60 one, in 4 of 18 cases two, the other about
    half a turn away. Where the energy leaves a direction free (`pose_covariance`), starts anywhere along it are modes
    of their own, of equal energies.

    Args:
        wxyz_xyz: one pose of each start, such as the picks `result.trajectories[:, 0]`, T_world_query, metres.
        energies: of the starts, such as `result.energies`.
        angle: largest turn between a member and its mode's pose, radians.
        distance: largest distance between their translations, metres.

    Returns:
        The modes by rising energy. Starts whose pose or energy is not finite belong to none; without a finite one the
        list is empty.

    Raises:
        InputError: poses and energies that do not fit together, a quaternion of length zero, or a negative bound.

    Source:
        Leader clustering (Hartigan, "Clustering Algorithms", 1975, ch. 3), with the energies as its order.
    """
    wxyz_xyz, energies = np.asarray(wxyz_xyz), np.asarray(energies)
    if wxyz_xyz.ndim != 2 or wxyz_xyz.shape[1] != 7 or energies.shape != wxyz_xyz.shape[:1]:
        raise InputError(
            f"cluster_poses(): poses have shape {wxyz_xyz.shape} and energies {energies.shape}; expected (candidates, 7) and (candidates,). "
            "Take one waypoint of each start, such as result.trajectories[:, 0]"
        )
    for name, bound in (("angle", angle), ("distance", distance)):
        if not 0 <= bound < np.inf:
            raise InputError(f"cluster_poses(): {name} is {bound}; expected a finite number of 0 or more")
    finite = np.flatnonzero(np.isfinite(energies) & np.isfinite(wxyz_xyz).all(axis=1))
    wxyz, xyz = wxyz_xyz[:, :4].astype(np.float64), wxyz_xyz[:, 4:].astype(np.float64)
    lengths = np.linalg.norm(wxyz[finite], axis=1)
    if not (lengths > 1e-6).all():
        raise InputError(
            f"cluster_poses(): the quaternion of start {finite[np.argmin(lengths)]} has length {lengths.min():.1e}; expected w x y z of a rotation, length 1"
        )
    wxyz[finite] /= lengths[:, None]

    left, modes = finite[np.argsort(energies[finite], kind="stable")], []
    while len(left):
        best = left[0]
        # q and -q are one rotation; the chord between unit quaternions is 2 sin(angle / 4), which is exact for small
        # angles as an arc cosine is not.
        chords = np.minimum(*(np.linalg.norm(wxyz[left] + sign * wxyz[best], axis=1) for sign in (-1, 1)))
        near = (4 * np.arcsin(np.minimum(chords / 2, 1)) <= angle) & (
            np.linalg.norm(xyz[left] - xyz[best], axis=1) <= distance
        )
        members, left = left[near], left[~near]
        modes.append(Mode(wxyz_xyz[best], float(energies[best]), members, len(members) / len(finite)))
    return modes
