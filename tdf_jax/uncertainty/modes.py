"""Modes of a pick: the distinct poses to which several candidates converged."""

import dataclasses

import numpy as np
from jaxtyping import Array, Float, Int

from tdf_jax._internal import checks
from tdf_jax._internal.boundary import public
from tdf_jax._internal.errors import InputError

# Radians and metres within which candidates count as one mode. On generated mugs, converged candidates of one pose were
# within 0.4 degrees and 0.1 mm of each other. Candidates that have not converged, such as those of `solve` after 4
# polishing steps, are 5 to 90 degrees from it, and no bound separates them from modes.
SAME_ANGLE, SAME_DISTANCE = np.radians(15), 0.02


@dataclasses.dataclass(frozen=True, eq=False)
class Mode:
    """Candidates that converged to the same pose.

    Attributes:
        pose: pose T_world_query of the member with the lowest energy, `wxyz_xyz`, (7,), metres.
        energy: energy of that member.
        members: indices of the candidates in this mode, by rising energy, (members,); the first one has `pose`.
        share: number of members divided by the number of finite candidates.
    """

    pose: Float[np.ndarray, "7"]
    energy: float
    members: Int[np.ndarray, " members"]
    share: float


@public
def cluster_poses(
    wxyz_xyz: Float[Array, "candidates 7"],
    energies: Float[Array, " candidates"],
    *,
    angle: float = SAME_ANGLE,
    distance: float = SAME_DISTANCE,
) -> list[Mode]:
    """Group the poses of several candidates into distinct modes.

    Candidates are visited by rising energy. A candidate joins the first mode whose `pose` is within both bounds, or
    else begins a mode of its own. Candidates of equal energy are visited in the order of the rows.

    The candidates have to be converged; otherwise one minimum counts as several modes
    (docs/results/code_notes.md#uncertaintymodes). If the energy does not determine a direction (`pose_covariance`),
    candidates along that direction are modes of their own, with equal energies.

    Args:
        wxyz_xyz: poses T_world_query, such as `result.picks`, (candidates, 7), metres.
        energies: energies of the candidates, such as `result.energies`, (candidates,).
        angle: largest rotation between a member and the pose of its mode, radians.
        distance: largest distance between a member and the pose of its mode, metres.

    Returns:
        The modes by rising energy. Candidates whose pose or energy is not finite belong to no mode; the list is empty
        if no candidate is finite.

    Raises:
        InputError: poses and energies do not have matching shapes, a quaternion has length zero, or a bound is negative
            or not finite.

    Source:
        Leader clustering (Hartigan, "Clustering Algorithms", 1975, ch. 3), in the order of the energies.
    """
    for name, value in (("wxyz_xyz", wxyz_xyz), ("energies", energies)):
        checks.numbers("cluster_poses()", name, value)
    poses, values = np.asarray(wxyz_xyz), np.asarray(energies)
    if {poses.dtype.kind, values.dtype.kind} & set("OSU"):  # objects such as None, and text
        raise InputError(
            f"cluster_poses(): poses have type {poses.dtype} and energies {values.dtype}; expected numbers"
        )
    if poses.ndim != 2 or poses.shape[1] != 7 or values.shape != poses.shape[:1]:
        raise InputError(
            f"cluster_poses(): poses have shape {poses.shape} and energies {values.shape}; expected (candidates, 7) "
            "and (candidates,). Take one pose of each candidate, such as result.picks"
        )
    checks.number("cluster_poses()", "angle", angle, least=0, unit="radians")
    checks.number("cluster_poses()", "distance", distance, least=0, unit="metres")
    finite = np.flatnonzero(np.isfinite(values) & np.isfinite(poses).all(axis=1))
    wxyz, xyz = poses[:, :4].astype(np.float64), poses[:, 4:].astype(np.float64)
    lengths = np.linalg.norm(wxyz[finite], axis=1)
    if not (lengths > 1e-6).all():
        raise InputError(
            f"cluster_poses(): the quaternion of candidate {finite[np.argmin(lengths)]} has length "
            f"{lengths.min():.1e}; expected a unit quaternion wxyz"
        )
    wxyz[finite] /= lengths[:, None]

    remaining, modes = finite[np.argsort(values[finite], kind="stable")], []
    while len(remaining):
        best = remaining[0]
        # q and -q are one rotation. The chord between unit quaternions is 2 sin(angle / 4), which is accurate for small
        # angles; an arc cosine is not.
        chords = np.minimum(*(np.linalg.norm(wxyz[remaining] + sign * wxyz[best], axis=1) for sign in (-1, 1)))
        near = (4 * np.arcsin(np.minimum(chords / 2, 1)) <= angle) & (
            np.linalg.norm(xyz[remaining] - xyz[best], axis=1) <= distance
        )
        members, remaining = remaining[near], remaining[~near]
        modes.append(Mode(poses[best], float(values[best]), members, len(members) / len(finite)))
    return modes
