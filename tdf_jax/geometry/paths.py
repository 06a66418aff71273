"""Demonstrated paths: the line, semicircle and wave of the paper, and three that lift, tilt and turn."""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from numpy.typing import ArrayLike

from tdf_jax._internal import checks
from tdf_jax._internal.deprecation import renamed_keywords
from tdf_jax._internal.errors import InputError
from tdf_jax.geometry import se3
from tdf_jax.geometry.trajectory import Trajectory, resample

UPRIGHT = 0.6  # of the way across, before `tilt_and_pour` tilts


@renamed_keywords(poses="num_poses")
def line(
    num_poses: int = 7,
    start: ArrayLike = (0.0, 0.0, 0.0),
    end: ArrayLike = (0.0, 0.3, 0.0),
    *,
    rotation: ArrayLike | None = None,
    end_rotation: ArrayLike | None = None,
) -> Trajectory:
    """Straight trajectory, evenly spaced.

    Args:
        num_poses: Number of poses, at least 2.
        start: Translation of the first pose, metres.
        end: Translation of the last pose, metres.
        rotation: Orientation, 3x3 or wxyz; default the world's.
        end_rotation: Orientation of the last pose, reached by the shortest even turn; default no turn.

    Returns:
        The trajectory.

    Raises:
        InputError: If an argument has a wrong shape or value, or start and end are the same place.
    """
    return _trajectory("line", num_poses, start, end, rotation, end_rotation, lambda s, chord: (s * chord, 0 * s))


@renamed_keywords(poses="num_poses")
def semicircle(
    num_poses: int = 7,
    start: ArrayLike = (0.0, 0.0, 0.0),
    end: ArrayLike = (0.0, 0.3, 0.0),
    *,
    height: float | None = None,
    bulge: ArrayLike = (1.0, 0.0, 0.0),
    rotation: ArrayLike | None = None,
    end_rotation: ArrayLike | None = None,
) -> Trajectory:
    """Circular arc from start to end, evenly spaced; by default half a circle.

    Args:
        num_poses, start, end, rotation, end_rotation: As for `line`.
        height: Distance of the arc's middle from the chord, metres; default half the chord, a half circle.
        bulge: Direction the arc bows to; its part perpendicular to the chord counts. The default keeps the default
            ends' path in the x-y plane, as in the paper's figure 2; (0, 0, 1) lifts it.

    Returns:
        The trajectory.

    Raises:
        InputError: If an argument has a wrong shape or value, start and end are the same place, or bulge is along
            the chord.
    """

    def arc(s, chord):
        sagitta = chord / 2 if height is None else height
        half_angle = 2 * np.arctan2(2 * sagitta, chord)
        radius = chord / 2 / np.sin(half_angle)
        angle = half_angle * (2 * s - 1)
        return chord / 2 + radius * np.sin(angle), radius * (np.cos(angle) - np.cos(half_angle))

    return _trajectory("semicircle", num_poses, start, end, rotation, end_rotation, arc, height, bulge)


@renamed_keywords(poses="num_poses")
def wave(
    num_poses: int = 7,
    start: ArrayLike = (0.0, 0.0, 0.0),
    end: ArrayLike = (0.0, 0.3, 0.0),
    *,
    height: float | None = None,
    bulge: ArrayLike = (1.0, 0.0, 0.0),
    rotation: ArrayLike | None = None,
    end_rotation: ArrayLike | None = None,
) -> Trajectory:
    """One period of a sine from start to end, first to the side of bulge; poses evenly spaced along the curve.

    Args:
        num_poses, start, end, rotation, end_rotation: As for `line`.
        height: Amplitude, metres; default a quarter of the chord.
        bulge: Direction of the first crest; its part perpendicular to the chord counts. The default keeps the
            default ends' path in the x-y plane, as in the paper's figure 2; (0, 0, 1) lifts it first.

    Returns:
        The trajectory.

    Raises:
        InputError: If an argument has a wrong shape or value, start and end are the same place, or bulge is along
            the chord.
    """

    def sine(s, chord):
        amplitude = chord / 4 if height is None else height
        fine = np.linspace(0, 1, 4001)  # the curve's length is then exact to 1e-6 of it
        along, across = chord * fine, amplitude * np.sin(2 * np.pi * fine)
        length = np.concatenate([[0], np.cumsum(np.hypot(np.diff(along), np.diff(across)))])
        even = np.interp(s * length[-1], length, fine)
        return chord * even, amplitude * np.sin(2 * np.pi * even)

    return _trajectory("wave", num_poses, start, end, rotation, end_rotation, sine, height, bulge)


@renamed_keywords(poses="num_poses")
def lift_over(
    num_poses: int = 7,
    start: ArrayLike = (0.0, 0.0, 0.0),
    end: ArrayLike = (0.0, 0.3, 0.0),
    *,
    height: float = 0.15,
    up: ArrayLike = (0.0, 0.0, 1.0),
    rotation: ArrayLike | None = None,
    end_rotation: ArrayLike | None = None,
) -> Trajectory:
    """Straight up, across and down, over whatever stands between; evenly spaced.

    Args:
        num_poses, start, end, rotation: As for `line`.
        height: Metres above start and end alike.
        up: Direction of the lift.
        end_rotation: Orientation of the last pose, reached on the way across; default no turn.

    Returns:
        The trajectory.

    Raises:
        InputError: If an argument has a wrong shape or value, or start and end are the same place.
    """
    start, end, R_start, R_end = _ends("lift_over", start, end, rotation, end_rotation)
    lift = _positive("lift_over", "height", height) * _direction("lift_over", "up", up)
    return _through("lift_over", num_poses, [start, start + lift, end + lift, end], [R_start, R_start, R_end, R_end])


@renamed_keywords(poses="num_poses")
def tilt_and_pour(
    num_poses: int = 7,
    start: ArrayLike = (0.0, 0.0, 0.0),
    end: ArrayLike = (0.0, 0.3, 0.0),
    *,
    height: float = 0.1,
    tilt: float = np.pi / 2,
    up: ArrayLike = (0.0, 0.0, 1.0),
    rotation: ArrayLike | None = None,
) -> Trajectory:
    """Up, upright most of the way across, then tilted forwards while going down to the end; evenly spaced.

    Args:
        num_poses, start, end, rotation: As for `line`.
        height: Metres above start and end at which it goes across.
        tilt: Radians that it is tilted at the end, less than half a turn, about the horizontal axis across the way.
        up: Direction of the lift.

    Returns:
        The trajectory.

    Raises:
        InputError: If an argument has a wrong shape or value, start and end are the same place, or up is along the way.
    """
    start, end, R_start, _ = _ends("tilt_and_pour", start, end, rotation, None)
    up = _direction("tilt_and_pour", "up", up)
    lift, across = _positive("tilt_and_pour", "height", height) * up, np.cross(up, end - start)
    if not np.linalg.norm(across) > 1e-6 * np.linalg.norm(end - start):
        raise InputError(f"tilt_and_pour(): up {up.tolist()} is along the way from start to end; expected a way aside.")
    if _positive("tilt_and_pour", "tilt", tilt) >= np.pi:  # turns go the shortest way
        raise InputError(f"tilt_and_pour(): tilt is {tilt}; expected radians, less than pi.")
    turn = se3.exp(jnp.asarray(tilt * across / np.linalg.norm(across)))
    upright = start + lift + UPRIGHT * (end - start)
    return _through(
        "tilt_and_pour",
        num_poses,
        [start, start + lift, upright, end],
        [R_start, R_start, R_start, se3.multiply(turn, R_start)],
    )


@renamed_keywords(poses="num_poses")
def hang_on_rack(
    num_poses: int = 7,
    start: ArrayLike = (0.0, 0.0, 0.0),
    end: ArrayLike = (0.0, 0.3, 0.0),
    *,
    approach: ArrayLike = (0.0, 0.1, 0.0),
    rotation: ArrayLike | None = None,
    end_rotation: ArrayLike | None = None,
) -> Trajectory:
    """To the front of a peg, turning on the way, then straight onto it without a turn; evenly spaced.

    Args:
        num_poses, start, end, rotation: As for `line`.
        approach: The last straight part, from the peg's front to the end, metres.
        end_rotation: Orientation on the peg; by default `rotation` after a quarter turn about the approach.

    Returns:
        The trajectory.

    Raises:
        InputError: If an argument has a wrong shape or value, start and end are the same place, or the approach is zero
            or all of the way.
    """
    start, end, R_start, R_end = _ends("hang_on_rack", start, end, rotation, end_rotation)
    approach = checks.vector("hang_on_rack()", "approach", approach)
    front = end - approach
    if not (approach.any() and np.linalg.norm(front - start) > 0):
        raise InputError(
            f"hang_on_rack(): approach is {approach.tolist()}; expected a vector that is not zero and not the whole way from start to end."
        )
    if end_rotation is None:
        quarter = se3.exp(jnp.asarray(np.pi / 2 * approach / np.linalg.norm(approach)))
        R_end = se3.multiply(quarter, R_start)
    return _through("hang_on_rack", num_poses, [start, front, end], [R_start, R_end, R_end])


SHAPES = {"line": line, "semicircle": semicircle, "wave": wave}  # the paper's
PATHS = SHAPES | {"lift_over": lift_over, "tilt_and_pour": tilt_and_pour, "hang_on_rack": hang_on_rack}


def _through(function, num_poses, places, rotations) -> Trajectory:
    """Evenly spaced by length along the straight lines between key poses; turns are even on each."""
    checks.count(f"{function}()", "num_poses", num_poses, least=2)
    return resample(Trajectory(se3.pose(jnp.stack(rotations), jnp.asarray(np.stack(places)))), num_poses)


def _ends(function, start, end, rotation, end_rotation):
    start, end = checks.vector(f"{function}()", "start", start), checks.vector(f"{function}()", "end", end)
    if not np.linalg.norm(end - start) > 0:
        raise InputError(f"{function}(): start and end are both {start.tolist()}; expected two places.")
    R_start = _rotation(function, np.eye(3) if rotation is None else rotation)
    return start, end, R_start, R_start if end_rotation is None else _rotation(function, end_rotation)


def _positive(function, name, value, expected="one number above 0.") -> float:
    if not (np.ndim(value) == 0 and np.isfinite(value) and value > 0):
        raise InputError(f"{function}(): {name} is {value}; expected {expected}")
    return float(value)


def _direction(function, name, value) -> np.ndarray:
    direction = checks.vector(f"{function}()", name, value)
    if not direction.any():
        raise InputError(f"{function}(): {name} is zero; expected a direction.")
    return direction / np.linalg.norm(direction)


def _rotation(function: str, rotation: ArrayLike) -> Float[Array, "3 3"]:
    rotation = np.asarray(rotation, dtype=np.float64)
    if rotation.shape == (4,):
        if not (np.isfinite(rotation).all() and rotation.any()):
            raise InputError(f"{function}(): rotation wxyz is {rotation}; expected a finite quaternion, not zero.")
        return se3.matrix_from_wxyz(jnp.asarray(rotation))
    if rotation.shape != (3, 3):
        raise InputError(f"{function}(): rotation has shape {rotation.shape}; expected (3, 3), or (4,) as wxyz.")
    checks.rotations(f"{function}()", "rotation", rotation)
    return jnp.asarray(rotation)


def _trajectory(function, num_poses, start, end, rotation, end_rotation, curve, height=None, bulge=None) -> Trajectory:
    """Poses along `curve`: fractions in [0, 1] and the chord's length -> distances along the chord and across it."""
    checks.count(f"{function}()", "num_poses", num_poses, least=2)
    start, end, R_start, R_end = _ends(function, start, end, rotation, end_rotation)
    chord = np.linalg.norm(end - start)
    if height is not None:
        _positive(function, "height", height, "metres above 0. Turn bulge for the other side.")
    forward, side = (end - start) / chord, np.zeros(3)
    if bulge is not None:
        bulge = checks.vector(f"{function}()", "bulge", bulge)
        side = bulge - forward * (forward @ bulge)
        if not np.linalg.norm(side) > 1e-6 * np.linalg.norm(bulge):
            raise InputError(f"{function}(): bulge {bulge.tolist()} is zero or along the chord; expected a way aside.")
        side /= np.linalg.norm(side)
    fractions = np.linspace(0, 1, num_poses)
    along, across = curve(fractions, chord)
    translations = start + along[:, None] * forward + across[:, None] * side
    return Trajectory(se3.pose(se3.geodesic(R_start, R_end, fractions), jnp.asarray(translations)))
