"""Timing of joint paths: the fastest one that holds limits of velocity and acceleration."""

import contextlib
import logging
from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from tdf_jax._internal import checks
from tdf_jax._internal.boundary import host
from tdf_jax._internal.errors import InputError
from tdf_jax._internal.extras import from_extra

COINCIDENT = 1e-6  # radians (of all joints together) that no encoder resolves; the direction between such is noise
MARGIN = 0.9  # of the deviation that is asked for: it is measured at a few places of each interval
PLACES = np.arange(1, 8) / 8  # of each interval, where the deviation is measured
ROUNDS = 40  # of halving intervals; a corner of 1 mrad between waypoints 10 rad apart needs about 12
GRID_STEP = 0.02  # radians between the places where the limits enter, at most
GRID_POINTS = 100  # of such places, at least
REFINEMENTS = 5  # of the grid, at most
TOLERATED = 1.01  # factor by which limits may be exceeded between places of the grid before it gets more of them there
GRID_TURN = 0.1  # radians that the direction of the path turns between such places, at most
LONGEST = 1e4  # radians of a path; a longer one has a wrong unit
SLOWEST, FASTEST = 1e-6, 1e6  # limits in radians and seconds; others have a wrong unit
MAX_SAMPLES = 10_000_000  # above, the limits or the rate have a wrong unit


@host
def retime(
    waypoints: ArrayLike,
    velocity_limits: ArrayLike,
    acceleration_limits: ArrayLike,
    rate: float = 125.0,
    *,
    deviation: float = 0.001,
) -> tuple[Float[np.ndarray, " samples"], Float[np.ndarray, "samples joints"]]:
    """Time a joint path through waypoints as fast as limits of velocity and acceleration allow.

    The path is a cubic spline through all waypoints that stays near the straight lines between them: where it would
    deviate from them by more, it gets more knots on the lines. It starts and ends at rest. TOPP-RA finds the speed
    along it.

    Args:
        waypoints: joint positions, (waypoints, joints), radians. Those within 1e-6 rad of the one before are dropped,
            but the first and the last.
        velocity_limits: largest speed of each joint, (joints,) or one number for all, radians per second.
        acceleration_limits: largest acceleration of each joint, (joints,) or one number for all, radians per second
            squared.
        rate: samples per second, hertz.
        deviation: largest distance of the path from the straight lines between the waypoints, radians, as the norm
            over all joints, at least 1e-5.

    Returns:
        Times of the samples, (samples,), seconds from 0, evenly spaced, and joint positions, (samples, joints),
        radians, from the first waypoint to the last. One sample at 0 s if the waypoints are within 1e-6 rad.

    Raises:
        InputError: toppra is not installed; an argument has another shape, is not finite, or is not in radians and
            seconds; no path or no timing that holds the limits is found; or it takes more than 10 million samples.

    References:
        Pham and Pham, "A new approach to time-optimal path parameterization based on reachability analysis", IEEE
        Transactions on Robotics, 2018.
    """
    waypoints = checks.numbers("retime()", "waypoints", waypoints)
    if waypoints.ndim != 2 or not waypoints.size:
        raise InputError(f"retime(): waypoints have shape {waypoints.shape}; expected (waypoints, joints), radians")
    if not np.isfinite(waypoints).all():
        row = int(np.argmin(np.isfinite(waypoints).all(axis=1)))
        raise InputError(f"retime(): waypoint {row} is {waypoints[row].tolist()}; expected finite radians")
    length = np.abs(np.diff(waypoints, axis=0)).sum() if np.abs(waypoints).max() < LONGEST else np.inf
    if length > LONGEST:
        raise InputError(
            f"retime(): the joints move by {length:.4g} rad in total; expected waypoints in radians, at most "
            f"{LONGEST:g} rad from 0 and of motion. Convert them with np.radians if they are degrees"
        )
    velocity = _limits("velocity_limits", velocity_limits, waypoints.shape[1], "radians per second")
    acceleration = _limits("acceleration_limits", acceleration_limits, waypoints.shape[1], "radians per second squared")
    checks.positive("retime()", "rate", rate, "hertz")
    checks.number("retime()", "deviation", deviation, 1e-5, unit="radians")
    toppra = _toppra("retime()")

    waypoints = _distinct(waypoints)
    if len(waypoints) < 2:
        return np.zeros(1), waypoints
    path = _path(waypoints, float(deviation))
    grid = _grid(path)
    for _ in range(REFINEMENTS):
        timing = _timing(grid, _speeds(toppra, path, grid, velocity, acceleration))
        excess = _excess(path, timing, velocity, acceleration)
        if excess.max() <= TOLERATED:
            break
        where = np.flatnonzero(excess > TOLERATED)
        grid = np.insert(grid, where + 1, (grid[where] + grid[where + 1]) / 2)
    # Between the places of the grid a limit may be exceeded by a little: all of it gets slower by that much.
    slower = max(1.0, float(excess.max()))
    duration = float(timing.times[-1]) * slower
    count = np.ceil(duration * rate)
    if not count <= MAX_SAMPLES:
        raise InputError(
            f"retime(): the path takes {duration:.4g} s, {count:.4g} samples; expected at most {MAX_SAMPLES} samples. "
            "Check the units of limits and rate: radians, seconds, hertz"
        )
    # The last sample is the last waypoint: the path takes a whole number of periods, never less than it needs.
    index = np.arange(int(count) + 1)
    positions = path(_arc(timing, index / index[-1] * timing.times[-1]))
    positions[[0, -1]] = waypoints[[0, -1]]
    return index / rate, positions


class _Timing(NamedTuple):
    """Motion along a path at constant acceleration between the places of a grid."""

    arcs: Float[np.ndarray, " grid"]  # path length from the start
    times: Float[np.ndarray, " grid"]
    speeds: Float[np.ndarray, " grid"]  # of the path length
    accelerations: Float[np.ndarray, " grid-1"]


def _limits(name: str, value: ArrayLike, joints: int, unit: str) -> Float[np.ndarray, " joints"]:
    limits = checks.numbers("retime()", name, value)
    if limits.ndim == 0:
        limits = np.full(joints, limits)
    if limits.shape != (joints,) or not ((limits >= SLOWEST) & (limits <= FASTEST)).all():
        raise InputError(
            f"retime(): {name} is {value}; expected {joints} numbers from {SLOWEST:g} to {FASTEST:g}, one for each "
            f"joint of the waypoints, or one for all, {unit}"
        )
    return limits


def _toppra(function: str) -> Any:
    for part in ("toppra.algorithm", "toppra.constraint"):  # attributes of the package once they are imported
        from_extra(function, part, "sim", "toppra")
    return from_extra(function, "toppra", "sim")


def _distinct(waypoints: np.ndarray) -> np.ndarray:
    """The waypoints without those that coincide with the one before; the first and the last stay."""
    chosen, last = [0], waypoints[-1]
    for index in range(1, len(waypoints)):
        if np.linalg.norm(waypoints[index] - waypoints[chosen[-1]]) > COINCIDENT:
            chosen.append(index)
    while len(chosen) > 1 and np.linalg.norm(last - waypoints[chosen[-1]]) <= COINCIDENT:
        chosen.pop()
    moves = np.linalg.norm(last - waypoints[chosen[-1]]) > COINCIDENT
    return np.concatenate([waypoints[chosen], last[None]]) if moves else waypoints[chosen]


def _path(waypoints: np.ndarray, deviation: float):
    """A cubic spline of the length of the polyline, in radians, with knots at the waypoints and more where needed."""
    from scipy.interpolate import CubicSpline

    knots = waypoints
    for _ in range(ROUNDS):
        steps = np.diff(knots, axis=0)
        lengths = np.linalg.norm(steps, axis=1)
        arcs = np.concatenate([[0.0], np.cumsum(lengths)])
        path = CubicSpline(arcs, knots, bc_type="natural")
        # Knots are on the polyline, so the line between two neighbours is a part of it.
        offset = path(arcs[:-1, None] + lengths[:, None] * PLACES) - knots[:-1, None]
        along = np.clip(np.einsum("npj,nj->np", offset, steps) / lengths[:, None] ** 2, 0, 1)
        far = np.linalg.norm(offset - along[..., None] * steps[:, None], axis=2).max(axis=1) > MARGIN * deviation
        if not far.any():
            return path
        where = np.flatnonzero(far)
        knots = np.insert(knots, where + 1, (knots[where] + knots[where + 1]) / 2, axis=0)
    raise InputError(
        f"retime(): no spline through the {len(waypoints)} waypoints was found within {deviation:g} rad of the lines "
        "between them; expected waypoints that a robot can follow. Remove waypoints that jump, or raise deviation"
    )


def _grid(path) -> np.ndarray:
    """The knots and more places between them: the limits enter only there, so these follow length and curvature."""
    lengths = np.diff(path.x)
    curvatures = np.linalg.norm(path(path.x, 2), axis=1)
    turns = lengths * np.maximum(curvatures[:-1], curvatures[1:])
    parts = np.ceil(np.maximum(lengths / min(GRID_STEP, path.x[-1] / GRID_POINTS), turns / GRID_TURN)).astype(int)
    starts = [np.linspace(start, end, count, endpoint=False) for start, end, count in zip(path.x, path.x[1:], parts)]
    return np.concatenate([*starts, path.x[-1:]])


def _speeds(toppra, path, grid: np.ndarray, velocity: np.ndarray, acceleration: np.ndarray) -> np.ndarray:
    """The fastest speed at each place of the grid, by TOPP-RA."""
    # Its tolerances are absolute, so it gets a path of length 1 and a time in which accelerations are about 1.
    length = grid[-1]
    second = np.sqrt(length / acceleration.min())
    unit_path = toppra.SplineInterpolator(path.x / length, path(path.x) / length, bc_type="natural")
    velocity, acceleration = velocity * second / length, acceleration * second**2 / length
    limits = [
        toppra.constraint.JointVelocityConstraint(np.stack([-velocity, velocity], axis=1)),
        toppra.constraint.JointAccelerationConstraint(np.stack([-acceleration, acceleration], axis=1)),
    ]
    unit_grid = grid / length
    unit_grid[-1] = unit_path.path_interval[1]
    with _quiet():
        solver = toppra.algorithm.TOPPRA(limits, unit_path, gridpoints=unit_grid, solver_wrapper="seidel")
        speeds = solver.compute_parameterization(0.0, 0.0)[1]
    code = solver.problem_data.return_code
    usable = speeds is not None and np.isfinite(speeds).all() and (speeds[1:] + speeds[:-1] > 0).all()
    if code != toppra.algorithm.ParameterizationReturnCode.Ok or not usable:
        raise InputError(
            f"retime(): TOPP-RA found no timing of the path of {length:.4g} rad ({code.value}); expected waypoints "
            "that a robot can follow within the limits. Remove waypoints that jump or repeat, and check the limits"
        )
    return speeds * length / second


@contextlib.contextmanager
def _quiet() -> Iterator[None]:
    """Without the log of toppra, whose warnings about retries are no news for the caller: a failure is raised."""
    logger = logging.getLogger("toppra")
    level = logger.level
    logger.setLevel(logging.CRITICAL + 1)
    try:
        yield
    finally:
        logger.setLevel(level)


def _timing(arcs: np.ndarray, speeds: np.ndarray) -> _Timing:
    steps = np.diff(arcs)
    times = np.concatenate([[0.0], np.cumsum(2 * steps / (speeds[:-1] + speeds[1:]))])
    return _Timing(arcs, times, speeds, np.diff(speeds**2) / (2 * steps))


def _arc(timing: _Timing, times: np.ndarray) -> np.ndarray:
    """Path length at given times."""
    part = np.clip(np.searchsorted(timing.times, times, side="right") - 1, 0, len(timing.accelerations) - 1)
    elapsed = times - timing.times[part]
    arc = timing.arcs[part] + (timing.speeds[part] + timing.accelerations[part] * elapsed / 2) * elapsed
    return np.clip(arc, timing.arcs[part], timing.arcs[part + 1])


def _excess(path, timing: _Timing, velocity: np.ndarray, acceleration: np.ndarray) -> np.ndarray:
    """For each part of the grid, the factor by which it must be slower to hold both limits everywhere, (grid - 1,)."""
    fractions = np.linspace(0, 1, 5)[:, None]
    arcs = timing.arcs[:-1] + fractions * np.diff(timing.arcs)
    squares = (timing.speeds[:-1] ** 2 + fractions * np.diff(timing.speeds**2))[..., None]
    first, second = path(arcs, 1), path(arcs, 2)
    fast = np.abs(first * np.sqrt(squares) / velocity).max(axis=(0, 2))
    # Parts are within one cubic, where accelerations are a quadratic function of the path length.
    start, _, middle, _, end = (first * timing.accelerations[:, None] + second * squares) / acceleration
    bend, slope = 2 * (start + end - 2 * middle), 4 * middle - 3 * start - end
    inside = np.abs(slope + bend) < np.abs(bend)  # the extremum at -slope / (2 bend) is between 0 and 1
    extremum = np.where(inside, start - slope**2 / np.where(inside, 4 * bend, 1), start)
    steep = np.abs([start, middle, end, extremum]).max(axis=(0, 2))
    return np.maximum(fast, np.sqrt(steep))
