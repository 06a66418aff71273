"""Timing of joint paths: limits, the way, rest at the ends, and the same bits again."""

import hashlib
import logging
import subprocess
import sys

import numpy as np
import pytest

from tdf_jax._internal.errors import InputError
from tdf_jax.sim import retiming
from tdf_jax.sim.retiming import retime

pytest.importorskip("toppra", reason="the extra 'sim' is not installed")

VELOCITY = np.array([3.1, 3.1, 3.1, 6.2, 1.0, 6.2])
ACCELERATION = np.array([8.0, 8, 10, 20, 15, 2])
SLACK = 1e-4  # of the limits: extrema of the speed are taken at five places of each part of the grid


def smooth(seed, waypoints, joints=6):
    """A curve of a few harmonics."""
    random = np.random.default_rng(seed)
    t = np.linspace(0, 1, waypoints)[:, None]
    return sum(random.normal(size=joints) / k * np.sin(np.pi * k * t + random.uniform(0, 6, joints)) for k in (1, 2, 3))


def zigzag(seed, waypoints, step=0.05, joints=6):
    """Dense waypoints whose direction changes by any angle after each fourth."""
    random = np.random.default_rng(seed)
    directions = np.repeat(random.normal(size=(waypoints // 4, joints)), 4, axis=0)
    steps = directions / np.linalg.norm(directions, axis=1, keepdims=True) * step
    return np.cumsum(np.concatenate([np.zeros((1, joints)), steps]), axis=0)


PATHS = {
    "smooth": smooth(0, 200),
    "few": smooth(1, 12),
    "zigzag": zigzag(0, 40),
    "corners": np.random.default_rng(2).uniform(-2, 2, (5, 6)),
    "straight": np.array([np.zeros(6), np.arange(6) * 0.2]),
    "there and back": np.array([np.zeros(6), np.full(6, 0.5), np.zeros(6)]),
    "noise": smooth(3, 60) + np.random.default_rng(3).normal(size=(60, 6)) * 1e-4,
    "near": np.array([np.zeros(6), np.full(6, 1e-5), np.ones(6), np.ones(6) + 2e-6, np.arange(6) * 0.3]),
    "short": np.arange(12).reshape(2, 6) * 1e-4,
}


def distance(points, polyline):
    """Distance of each point from the nearest of the lines between waypoints, (points,)."""
    start, step = polyline[:-1], np.diff(polyline, axis=0)
    offset = points[:, None] - start
    squares = (step * step).sum(-1)
    along = np.clip((offset * step).sum(-1) / np.where(squares > 0, squares, 1), 0, 1)
    return np.linalg.norm(offset - along[..., None] * step, axis=-1).min(axis=1)


def shares(times, positions, velocity=VELOCITY, acceleration=ACCELERATION):
    """Largest velocity and acceleration by finite differences, as shares of the limits; at rest outside."""
    rate = 1 / times[1]
    speeds = np.diff(positions, axis=0) * rate
    rest = np.zeros((1, positions.shape[1]))
    changes = np.diff(np.concatenate([rest, speeds, rest]), axis=0) * rate
    return (np.abs(speeds) / velocity).max(), (np.abs(changes) / acceleration).max()


@pytest.mark.parametrize("path", PATHS)
@pytest.mark.parametrize("rate", [125.0, 1000.0])
def test_limits_hold_and_the_way_stays_near_the_lines(path, rate):
    waypoints = PATHS[path]
    times, positions = retime(waypoints, VELOCITY, ACCELERATION, rate)
    assert times[0] == 0 and (times == np.arange(len(times)) / rate).all() and positions.shape == (len(times), 6)
    assert (positions[0] == waypoints[0]).all() and (positions[-1] == waypoints[-1]).all()
    velocity, acceleration = shares(times, positions)
    assert velocity <= 1 + SLACK and acceleration <= 1 + SLACK
    assert distance(positions, waypoints).max() <= 0.001
    # It passes all waypoints, up to the way that the largest acceleration bends between two samples.
    nearest = np.linalg.norm(waypoints[:, None] - positions, axis=2).argmin(axis=1)
    for waypoint, sample in zip(waypoints, nearest, strict=True):
        around = positions[max(sample - 1, 0) : sample + 2]
        assert distance(waypoint[None], around)[0] <= np.linalg.norm(ACCELERATION) / rate**2 / 8 + 1e-9


def test_one_limit_is_always_reached():
    """The timing is the fastest: between the first and the last millisecond one joint is at one of its limits."""
    times, positions = retime(smooth(0, 200), VELOCITY, ACCELERATION, 1000.0)
    speeds = np.diff(positions, axis=0) * 1000
    velocity = np.abs(speeds[1:]) / VELOCITY
    acceleration = np.abs(np.diff(speeds, axis=0)) * 1000 / ACCELERATION
    used = np.maximum(velocity, acceleration).max(axis=1)
    assert np.quantile(used, 0.05) > 0.9 and used.mean() > 0.98


def test_a_straight_line_takes_the_time_of_the_textbook():
    """Trapezoid and triangle of one joint, rounded up to whole samples."""
    for length, velocity, acceleration in ((2.0, 1.0, 4.0), (0.1, 1.0, 4.0), (30.0, 3.0, 0.5), (1e-3, 3.0, 10.0)):
        reach = velocity**2 / acceleration
        seconds = length / velocity + velocity / acceleration if length > reach else 2 * np.sqrt(length / acceleration)
        times, _ = retime([[0.0], [length]], velocity, acceleration, 1000.0)
        assert seconds <= times[-1] <= seconds * (1 + 2e-3) + 1e-3


def test_other_deviations_are_held():
    for deviation in (0.01, 0.0001):
        _, positions = retime(PATHS["corners"], VELOCITY, ACCELERATION, 1000.0, deviation=deviation)
        assert deviation / 10 < distance(positions, PATHS["corners"]).max() <= deviation


def test_repeated_waypoints_change_nothing():
    waypoints = smooth(0, 20)
    expected = retime(waypoints, VELOCITY, ACCELERATION)
    got = retime(np.repeat(waypoints, 3, axis=0), VELOCITY, ACCELERATION)
    assert all((a == b).all() for a, b in zip(expected, got, strict=True))


@pytest.mark.parametrize(
    "waypoints", [np.ones((1, 6)), np.ones((5, 6)), 1 + np.linspace(0, 1e-7, 4)[:, None] * np.ones(6)]
)
def test_a_path_without_motion_takes_no_time(waypoints):
    times, positions = retime(waypoints, VELOCITY, ACCELERATION)
    assert times.tolist() == [0] and (positions == waypoints[:1]).all()


def test_motion_within_noise_of_its_start_takes_no_time():
    """The last waypoint is the first again, and no line of length 0 is left between them."""
    waypoints = np.array([[0.0, 0], [1.2e-6, 0], [0.5e-6, 0]])
    times, positions = retime(waypoints, VELOCITY[:2], ACCELERATION[:2])
    assert times.tolist() == [0] and positions.tolist() == [[0, 0]]


def test_another_process_gives_the_same_bits_and_imports_toppra_only_when_it_is_used():
    check = (
        "import hashlib, sys, numpy as np; import tdf_jax; from tdf_jax.sim.retiming import retime; "
        "print(*{'toppra', 'matplotlib', 'mujoco'} & set(sys.modules)); "
        "w = np.random.default_rng(2).uniform(-2, 2, (5, 6)); t, q = retime(w, 3.0, 10.0); "
        "print(hashlib.sha256(t.tobytes() + q.tobytes()).hexdigest())"
    )
    done = subprocess.run([sys.executable, "-c", check], capture_output=True, text=True, check=True)
    times, positions = retime(PATHS["corners"], 3.0, 10.0)
    assert done.stdout == "\n" + hashlib.sha256(times.tobytes() + positions.tobytes()).hexdigest() + "\n"
    again = retime(PATHS["corners"].tolist(), np.full(6, 3.0), np.full(6, 10.0))
    assert times.tobytes() == again[0].tobytes() and positions.tobytes() == again[1].tobytes()


def test_toppra_is_quiet_and_its_logger_as_before(capfd):
    logger = logging.getLogger("toppra")
    before = logger.level
    handler = logging.StreamHandler()
    logging.getLogger().addHandler(handler)
    try:
        retime(PATHS["corners"], VELOCITY, ACCELERATION)
    finally:
        logging.getLogger().removeHandler(handler)
    assert logger.level == before and capfd.readouterr() == ("", "")


def test_a_failure_of_toppra_is_raised(monkeypatch):
    """No timing of a path that TOPP-RA cannot time; here, because its path begins faster than the limits allow."""
    import toppra.algorithm

    compute = toppra.algorithm.TOPPRA.compute_parameterization
    monkeypatch.setattr(
        toppra.algorithm.TOPPRA, "compute_parameterization", lambda self, start, end: compute(self, 1e6, end)
    )
    with pytest.raises(InputError, match=r"^retime\(\): TOPP-RA found no timing of the path of .* not controllable"):
        retime(PATHS["few"], VELOCITY, ACCELERATION)


def test_a_path_that_cannot_be_smoothed_is_refused(monkeypatch):
    monkeypatch.setattr(retiming, "ROUNDS", 1)
    with pytest.raises(InputError, match="no spline through the 5 waypoints was found within 0.001 rad"):
        retime(PATHS["corners"], VELOCITY, ACCELERATION)


def test_missing_toppra_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "toppra", None)
    with pytest.raises(InputError, match=r"retime\(\): toppra is not installed; .*pip install 'tdf_jax\[sim\]'"):
        retime(PATHS["few"], VELOCITY, ACCELERATION)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"waypoints": np.zeros(6)}, r"waypoints have shape \(6,\); expected \(waypoints, joints\)"),
        ({"waypoints": np.zeros((0, 6))}, r"waypoints have shape \(0, 6\)"),
        ({"waypoints": [["a"] * 6]}, "expected real numbers"),
        ({"waypoints": np.where(np.arange(72).reshape(12, 6) == 20, np.nan, 0)}, "waypoint 3 is .*nan"),
        ({"waypoints": np.array([[0.0] * 6, [1e5] * 6])}, "expected waypoints in radians"),
        ({"waypoints": np.array([[0.0] * 6, [1e300] * 6])}, "expected waypoints in radians"),
        ({"velocity_limits": np.ones(5)}, "velocity_limits is .*expected 6 numbers"),
        ({"velocity_limits": 0.0}, "velocity_limits is 0.0; expected 6 numbers"),
        ({"acceleration_limits": -ACCELERATION}, "acceleration_limits is .*; expected 6 numbers"),
        ({"acceleration_limits": np.where(np.arange(6) == 2, np.nan, 1)}, "acceleration_limits is"),
        ({"rate": 0}, "rate is 0; expected a positive number"),
        ({"rate": 1e300}, "expected at most 10000000 samples. Check the units"),
        ({"deviation": 0.0}, "deviation is 0.0; expected one finite number of 1e-05 or more"),
    ],
)
def test_bad_arguments_are_refused(changes, message):
    arguments = {"waypoints": PATHS["few"], "velocity_limits": VELOCITY, "acceleration_limits": ACCELERATION} | changes
    with pytest.raises(InputError, match=rf"^retime\(\): .*{message}"):
        retime(**arguments)
