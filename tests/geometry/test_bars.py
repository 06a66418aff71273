"""Round bars in clouds whose radius and axis are known."""

import numpy as np
import pytest

from tdf_jax.geometry.bars import RADII, TOLERANCE, bar_points, find_bars, in_bar

AXIS = np.array([0.6, 0.0, 0.8])
ACROSS = np.array([[0.0, 1.0, 0.0], [-0.8, 0.0, 0.6]])


def peg(radius=0.004, count=28, seed=0, low=-np.pi, high=np.pi):
    """Points on a peg of 8 cm, between two angles around it."""
    rng = np.random.default_rng(seed)
    angles = rng.uniform(low, high, count)
    return rng.uniform(-0.04, 0.04, (count, 1)) * AXIS + radius * np.stack([np.cos(angles), np.sin(angles)], 1) @ ACROSS


def post(count=400, seed=1):
    """Points on a square post of 3 cm beside the lower end of the peg."""
    points = np.random.default_rng(seed).uniform(-0.015, 0.015, (count, 3)) * [1, 1, 8]
    points[: count // 2, 0], points[count // 2 :, 1] = 0.015, 0.015
    return points - 0.055 * AXIS


def distance(points):
    return np.linalg.norm(np.cross(points, AXIS), axis=1)


@pytest.mark.parametrize("radius", [0.003, 0.006])
def test_a_peg_is_found_beside_a_post(radius):
    cloud = np.concatenate([peg(radius), post()])
    (bar,) = find_bars(cloud, np.arange(28))
    assert abs(bar.radius - radius) < 1e-5
    assert abs(bar.axis @ AXIS) > 1 - 1e-6
    assert set(range(28)) <= set(bar.members.tolist())
    assert np.abs(distance(bar_points(bar, cloud)) - radius).max() < 1e-4
    assert in_bar(bar, cloud[bar.members]).all()
    assert in_bar(bar, np.array([[0, 0, 0], 0.95 * radius * ACROSS[0], 0.01 * AXIS])).all()
    assert not in_bar(bar, np.array([1.2 * radius * ACROSS[0], 0.2 * AXIS, -0.2 * AXIS])).any()


def test_the_points_of_a_bar_are_dense_and_end_with_the_cloud():
    from scipy.spatial import KDTree

    cloud = peg()
    (bar,) = find_bars(cloud, np.arange(28))
    dense, truth = bar_points(bar, cloud), peg(count=2000, seed=3)
    heights = cloud @ AXIS
    covered = (truth @ AXIS > heights.min()) & (truth @ AXIS < heights.max())
    assert KDTree(dense).query(truth[covered])[0].max() < 0.0015
    assert (dense @ AXIS).min() > heights.min() - 1e-4
    assert (dense @ AXIS).max() < heights.max() + 1e-4


def test_a_side_of_a_peg_that_no_point_is_on_is_not_made_up():
    cloud = peg(low=-2.0, high=2.0)
    (bar,) = find_bars(cloud, np.arange(28))
    dense = bar_points(bar, cloud)
    assert (dense @ ACROSS[0]).min() > -0.004
    assert (np.abs(np.arctan2(dense @ ACROSS[1], dense @ ACROSS[0])) < 2.0 + np.pi / 3).all()
    assert len(dense) > 100


@pytest.mark.parametrize(
    "cloud",
    [
        peg() + np.random.default_rng(5).normal(0, 3 * TOLERANCE, (28, 3)),
        peg(radius=3 * RADII[1], count=200),
        peg(low=-0.7, high=0.7),  # the rounding of an edge
        peg(count=9),
        post(),
    ],
    ids=["noise", "too thick", "an edge", "too few points", "no bar"],
)
def test_what_is_no_clear_bar_is_left_alone(cloud):
    assert find_bars(cloud, np.arange(len(cloud))[:40]) == []
