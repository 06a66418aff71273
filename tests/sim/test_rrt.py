"""Free motions of two joints in a plane with obstacles, in which it is plain what is free."""

import numpy as np
import pytest

from tdf_jax.sim import rrt
from tdf_jax.sim.rrt import connect

pytest.importorskip("ompl", reason="the extra 'sim' is not installed")

START, GOAL = np.array([-1.0, 0.0]), np.array([1.0, 0.0])
LIMITS = np.full(2, -3.0), np.full(2, 3.0)


def beside_a_wall(joints):
    """A wall at 0 with a way around it above 1."""
    return abs(joints[0]) > 0.3 or joints[1] > 1.0


def dense(path, spacing=0.005):
    steps = [np.linspace(a, b, 2 + int(np.linalg.norm(b - a) / spacing)) for a, b in zip(path, path[1:])]
    return np.concatenate(steps)


def test_a_straight_way_is_taken():
    path = connect(START, GOAL, *LIMITS, lambda joints: True, 1)
    np.testing.assert_array_equal(path, [START, GOAL])


def test_a_wall_is_gone_around():
    path = connect(START, GOAL, *LIMITS, beside_a_wall, 1)
    np.testing.assert_allclose(path[[0, -1]], [START, GOAL])
    points = dense(path)
    assert points[:, 1].max() > 1.0
    # Tested every 0.03 rad: corners may be cut by half of that.
    assert min(max(abs(x) - 0.3, y - 1.0) for x, y in points) > -0.03
    finer = dense(connect(START, GOAL, *LIMITS, beside_a_wall, 1, resolution=0.005))
    assert min(max(abs(x) - 0.3, y - 1.0) for x, y in finer) > -0.005
    length = np.linalg.norm(np.diff(path, axis=0), axis=1).sum()
    assert 2.7 < length < 5  # at least around both corners: 2 * hypot(0.7, 1) + 0.6


def test_the_same_seed_gives_the_same_path_and_another_one_another():
    first = connect(START, GOAL, *LIMITS, beside_a_wall, 3)
    np.testing.assert_array_equal(connect(START, GOAL, *LIMITS, beside_a_wall, 3), first)
    other = connect(START, GOAL, *LIMITS, beside_a_wall, 4)
    assert other.shape != first.shape or (other != first).any()


def test_limits_are_held():
    low = np.array([-3.0, -3.0]), np.array([3.0, 1.2])
    path = connect(START, GOAL, *low, beside_a_wall, 1)
    assert path[:, 1].max() <= 1.2


def test_no_way_is_none(monkeypatch):
    monkeypatch.setattr(rrt, "MAX_ITERATIONS", 200)
    assert connect(START, GOAL, *LIMITS, lambda joints: abs(joints[0]) > 0.3, 1) is None


def test_an_end_that_is_not_free_is_none():
    calls = []

    def free(joints):
        calls.append(joints)
        return joints[0] < 0

    assert connect(START, GOAL, *LIMITS, free, 1) is None
    assert len(calls) == 2  # nothing is searched
