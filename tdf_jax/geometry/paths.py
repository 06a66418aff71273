"""Demonstrated paths: the line, semicircle and wave of the paper, and three that lift, tilt and hang.

Every function takes ends in metres, world frame, and orientations as 3x3 matrices or quaternions wxyz.
"""

from collections.abc import Callable

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from numpy.typing import ArrayLike

from tdf_jax._internal import checks
from tdf_jax._internal.boundary import public
from tdf_jax._internal.deprecation import renamed_keywords
from tdf_jax._internal.errors import InputError
from tdf_jax.geometry import se3
from tdf_jax.geometry.trajectory import Trajectory, resample

UPRIGHT = 0.6  # fraction of the way from start to end after which `tilt_and_pour` begins to tilt


@public
@renamed_keywords(poses="num_poses")
def line(
    num_poses: int = 7,
    start: ArrayLike = (0.0, 0.0, 0.0),
    end: ArrayLike = (0.0, 0.3, 0.0),
    *,
    rotation: ArrayLike | None = None,
    end_rotation: ArrayLike | None = None,
) -> Trajectory:
    """Straight line from start to end with evenly spaced poses.

    Args:
        num_poses: number of poses, at least 2.
        start: translation of the first pose, (3,), metres, world frame.
        end: translation of the last pose, (3,), metres, world frame.
        rotation: orientation of the first pose, (3, 3) or (4,) as wxyz, world frame; by default the identity.
        end_rotation: orientation of the last pose, (3, 3) or (4,) as wxyz, world frame; rotations follow the SO(3)
            geodesic to it. By default all poses have the same orientation.

    Returns:
        The trajectory, T_world_query.

    Raises:
        InputError: an argument has a wrong shape or value, or start and end coincide.
    """
    return _along_curve("line()", num_poses, start, end, rotation, end_rotation, lambda s, chord: (s * chord, 0 * s))


@public
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
    """Circular arc from start to end with evenly spaced poses; by default half a circle.

    Args:
        num_poses: number of poses, at least 2.
        start: translation of the first pose, (3,), metres, world frame.
        end: translation of the last pose, (3,), metres, world frame.
        height: distance of the arc's middle from the chord, metres; by default half the chord, which is half a circle.
        bulge: direction to which the arc bows, (3,), world frame; only its component perpendicular to the chord counts.
            The default keeps the path between the default ends in the x-y plane, as in the paper's figure 2;
            (0, 0, 1) lifts the path.
        rotation: orientation of the first pose, as for `line`.
        end_rotation: orientation of the last pose, as for `line`.

    Returns:
        The trajectory, T_world_query.

    Raises:
        InputError: an argument has a wrong shape or value, start and end coincide, or bulge is along the chord.
    """

    def arc(s, chord):
        sagitta = chord / 2 if height is None else height
        half_angle = 2 * np.arctan2(2 * sagitta, chord)
        radius = chord / 2 / np.sin(half_angle)
        angle = half_angle * (2 * s - 1)
        return chord / 2 + radius * np.sin(angle), radius * (np.cos(angle) - np.cos(half_angle))

    return _along_curve("semicircle()", num_poses, start, end, rotation, end_rotation, arc, height, bulge)


@public
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
    """One period of a sine from start to end; the poses are evenly spaced along the curve.

    Args:
        num_poses: number of poses, at least 2.
        start: translation of the first pose, (3,), metres, world frame.
        end: translation of the last pose, (3,), metres, world frame.
        height: amplitude of the sine, metres; by default a quarter of the chord.
        bulge: direction of the first crest, (3,), world frame; only its component perpendicular to the chord counts.
            The default keeps the path between the default ends in the x-y plane, as in the paper's figure 2;
            (0, 0, 1) lifts the first crest.
        rotation: orientation of the first pose, as for `line`.
        end_rotation: orientation of the last pose, as for `line`.

    Returns:
        The trajectory, T_world_query.

    Raises:
        InputError: an argument has a wrong shape or value, start and end coincide, or bulge is along the chord.
    """

    def sine(s, chord):
        amplitude = chord / 4 if height is None else height
        fine = np.linspace(0, 1, 4001)  # the relative error of the curve's length is then 1e-6
        along, across = chord * fine, amplitude * np.sin(2 * np.pi * fine)
        length = np.concatenate([[0], np.cumsum(np.hypot(np.diff(along), np.diff(across)))])
        even = np.interp(s * length[-1], length, fine)
        return chord * even, amplitude * np.sin(2 * np.pi * even)

    return _along_curve("wave()", num_poses, start, end, rotation, end_rotation, sine, height, bulge)


@public
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
    """Path that goes straight up, across and down, over whatever stands between; the poses are evenly spaced.

    Args:
        num_poses: number of poses, at least 2.
        start: translation of the first pose, (3,), metres, world frame.
        end: translation of the last pose, (3,), metres, world frame.
        height: height of the lift above start and end, metres.
        up: direction of the lift, (3,), world frame, of any length.
        rotation: orientation of the first pose, as for `line`.
        end_rotation: orientation of the last pose, as for `line`; it is reached at the end of the part across.

    Returns:
        The trajectory, T_world_query.

    Raises:
        InputError: an argument has a wrong shape or value, or start and end coincide.
    """
    start, end, R_start, R_end = _ends("lift_over()", start, end, rotation, end_rotation)
    lift = checks.positive("lift_over()", "height", height, "metres") * _unit("lift_over()", "up", up)
    return _along_polyline(
        "lift_over()", num_poses, [start, start + lift, end + lift, end], [R_start, R_start, R_end, R_end]
    )


@public
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
    """Path that goes up, travels upright most of the way across, then tilts forwards while it goes down to the end.

    The poses are evenly spaced.

    Args:
        num_poses: number of poses, at least 2.
        start: translation of the first pose, (3,), metres, world frame.
        end: translation of the last pose, (3,), metres, world frame.
        height: height of the lift above start and end, metres.
        tilt: angle of the tilt at the end, radians, below pi, about the horizontal axis perpendicular to the path.
        up: direction of the lift, (3,), world frame, of any length.
        rotation: orientation of the first pose, as for `line`.

    Returns:
        The trajectory, T_world_query.

    Raises:
        InputError: an argument has a wrong shape or value, start and end coincide, or up is along the path.
    """
    start, end, R_start, _ = _ends("tilt_and_pour()", start, end, rotation, None)
    up = _unit("tilt_and_pour()", "up", up)
    lift, axis = checks.positive("tilt_and_pour()", "height", height, "metres") * up, np.cross(up, end - start)
    if not np.linalg.norm(axis) > 1e-6 * np.linalg.norm(end - start):
        raise InputError(
            f"tilt_and_pour(): up {up.tolist()} is along the line from start to end; expected another direction"
        )
    # a geodesic takes the shorter of two rotations, so it cannot tilt by half a turn or more
    if checks.positive("tilt_and_pour()", "tilt", tilt, "radians") >= np.pi:
        raise InputError(f"tilt_and_pour(): tilt is {tilt}; expected radians, less than pi")
    R_tilt = se3.exp(jnp.asarray(tilt * axis / np.linalg.norm(axis)))
    upright = start + lift + UPRIGHT * (end - start)
    return _along_polyline(
        "tilt_and_pour()",
        num_poses,
        [start, start + lift, upright, end],
        [R_start, R_start, R_start, se3.multiply(R_tilt, R_start)],
    )


@public
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
    """Path that goes to the front of a peg while it rotates, then straight onto the peg without a rotation.

    The poses are evenly spaced.

    Args:
        num_poses: number of poses, at least 2.
        start: translation of the first pose, (3,), metres, world frame.
        end: translation of the last pose, on the peg, (3,), metres, world frame.
        approach: vector from the front of the peg to the end, (3,), metres, world frame.
        rotation: orientation of the first pose, as for `line`.
        end_rotation: orientation on the peg, as for `line`; by default `rotation` after a quarter turn about the
            approach.

    Returns:
        The trajectory, T_world_query.

    Raises:
        InputError: an argument has a wrong shape or value, start and end coincide, or the approach is zero or the whole
            vector from start to end.
    """
    start, end, R_start, R_end = _ends("hang_on_rack()", start, end, rotation, end_rotation)
    approach = checks.vector("hang_on_rack()", "approach", approach)
    front = end - approach
    if not (approach.any() and np.linalg.norm(front - start) > 0):
        raise InputError(
            f"hang_on_rack(): approach is {approach.tolist()}; expected a vector that is not zero "
            "and not the whole vector from start to end"
        )
    if end_rotation is None:
        R_quarter = se3.exp(jnp.asarray(np.pi / 2 * approach / np.linalg.norm(approach)))
        R_end = se3.multiply(R_quarter, R_start)
    return _along_polyline("hang_on_rack()", num_poses, [start, front, end], [R_start, R_end, R_end])


SHAPES = {"line": line, "semicircle": semicircle, "wave": wave}  # paths of the paper
PATHS = SHAPES | {"lift_over": lift_over, "tilt_and_pour": tilt_and_pour, "hang_on_rack": hang_on_rack}


def _along_polyline(function: str, num_poses: int, translations: list, rotations: list) -> Trajectory:
    """Poses evenly spaced by length along the polyline of key poses; rotations follow the geodesic on each piece."""
    checks.count(function, "num_poses", num_poses, least=2)
    checks.near(function, "path", np.stack(translations))
    return resample(Trajectory(se3.pose(jnp.stack(rotations), jnp.asarray(np.stack(translations)))), num_poses)


def _along_curve(
    function: str,
    num_poses: int,
    start: ArrayLike,
    end: ArrayLike,
    rotation: ArrayLike | None,
    end_rotation: ArrayLike | None,
    curve: Callable,
    height: float | None = None,
    bulge: ArrayLike | None = None,
) -> Trajectory:
    """Poses along a plane curve: (fractions in [0, 1], length of the chord) -> distances along the chord and across."""
    checks.count(function, "num_poses", num_poses, least=2)
    start, end, R_start, R_end = _ends(function, start, end, rotation, end_rotation)
    chord = np.linalg.norm(end - start)
    if height is not None:
        checks.positive(function, "height", height, "metres; reverse bulge for the other side")
    forward, side = (end - start) / chord, np.zeros(3)
    if bulge is not None:
        bulge = checks.vector(function, "bulge", bulge)
        side = bulge - forward * (forward @ bulge)
        if not np.linalg.norm(side) > 1e-6 * np.linalg.norm(bulge):
            raise InputError(
                f"{function}: bulge {bulge.tolist()} is zero or along the chord; expected another direction"
            )
        side /= np.linalg.norm(side)
    fractions = np.linspace(0, 1, num_poses)
    along, across = curve(fractions, chord)
    translations = start + along[:, None] * forward + across[:, None] * side
    checks.near(function, "path", translations)
    return Trajectory(se3.pose(se3.geodesic(R_start, R_end, fractions), jnp.asarray(translations)))


def _ends(function: str, start: ArrayLike, end: ArrayLike, rotation: ArrayLike | None, end_rotation: ArrayLike | None):
    """Both translations and both rotation matrices."""
    start, end = checks.vector(function, "start", start), checks.vector(function, "end", end)
    checks.near(function, "start", np.asarray(start)[None])
    checks.near(function, "end", np.asarray(end)[None])
    if not np.linalg.norm(end - start) > 0:
        raise InputError(f"{function}: start and end are both {start.tolist()}; expected two different points")
    R_start = _matrix(function, "rotation", np.eye(3) if rotation is None else rotation)
    return start, end, R_start, R_start if end_rotation is None else _matrix(function, "end_rotation", end_rotation)


def _unit(function: str, name: str, value: ArrayLike) -> np.ndarray:
    direction = np.asarray(checks.direction(function, name, value))
    return direction / np.linalg.norm(direction)


def _matrix(function: str, name: str, value: ArrayLike) -> Float[Array, "3 3"]:
    orientation = jnp.asarray(checks.orientation(function, name, value))
    return se3.matrix_from_wxyz(orientation) if orientation.shape == (4,) else orientation
