"""Seating on solids whose touch is known."""

from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from tdf_jax.energy.seating import MARGIN, REACH, overlap, touch_distance

RADIUS = 0.04
DOWN = np.array([0.0, 0.0, -1.0])


def solid(depth):
    """A field whose occupancy rises through a half where a depth function is zero."""
    return SimpleNamespace(occupancy=lambda x: jax.nn.sigmoid(2000 * depth(jnp.asarray(x))))


def sphere(count=4000, seed=0):
    points = np.random.default_rng(seed).normal(size=(count, 3))
    return RADIUS * points / np.linalg.norm(points, axis=1, keepdims=True)


def floor(count=4000, seed=1):
    """A floor at z = 0, as a cloud."""
    return np.random.default_rng(seed).uniform(-0.08, 0.08, (count, 3)) * [1, 1, 0]


BALL = solid(lambda x: RADIUS - jnp.linalg.norm(x, axis=-1))
FLOOR = solid(lambda x: -x[..., 2])


def raised(height, motion=(1.0, 0, 0, 0, 0, 0, 0)):
    return np.array(motion) + [0, 0, 0, 0, 0, 0, RADIUS + height]


@pytest.mark.parametrize("height", [0.012, 0.004, 0.0, -0.003, -0.011])
@pytest.mark.parametrize("target", [FLOOR, None], ids=["both fields", "the object's alone"])
def test_a_ball_is_lowered_or_raised_onto_the_floor(height, target):
    found = touch_distance(BALL, target, sphere(), floor(), raised(height), DOWN)
    assert abs(found - height) < 1e-3


def test_the_ball_stays_a_margin_above_the_floor():
    left = [height - touch_distance(BALL, FLOOR, sphere(), floor(), raised(height), DOWN) for height in (0.007, 0.002)]
    assert np.abs(np.array(left) - MARGIN).max() < MARGIN / 2


def test_the_touch_turns_with_the_scene():
    """The object lies turned, and the floor is a wall."""
    quarter = np.array([np.sqrt(0.5), np.sqrt(0.5), 0, 0, 0, 0, 0])  # z becomes -y
    wall = solid(lambda x: x[..., 1])
    motion = quarter + [0, 0, 0, 0, 0, -RADIUS - 0.006, 0]
    found = touch_distance(BALL, wall, sphere(), floor() @ [[1, 0, 0], [0, 0, 1], [0, -1, 0]], motion, [0.0, 1.0, 0.0])
    assert abs(found - 0.006) < 1e-3


@pytest.mark.parametrize("height", [REACH + 0.003, -REACH - 0.003])
def test_what_does_not_touch_within_reach_is_not_seated(height):
    assert np.isnan(touch_distance(BALL, FLOOR, sphere(), floor(), raised(height), DOWN))


def test_what_is_beside_the_target_does_not_touch_it():
    aside = raised(0.004) + [0, 0, 0, 0, 0.3, 0, 0]
    assert np.isnan(touch_distance(BALL, FLOOR, sphere(), floor(), aside, DOWN))


@pytest.mark.parametrize("bias", [0.002, -0.002])
def test_a_field_that_is_too_fat_or_too_thin_is_read_by_its_cloud(bias):
    ball = solid(lambda x: (RADIUS + bias - jnp.linalg.norm(x, axis=-1)) / 4)  # occupancies of 0.73 and 0.27
    for target in (None, FLOOR):
        found = touch_distance(ball, target, sphere(), floor(), raised(0.004), DOWN)
        assert abs(found - 0.004) < 1e-3


def test_a_shadow_in_the_field_of_the_target_is_not_touched():
    shadow = solid(lambda x: jnp.where(x[..., 2] < 0, 1.0, jnp.where(x[..., 2] < 0.006, 2e-4, -1.0)))
    assert np.asarray(shadow.occupancy(jnp.array([0, 0, 0.003]))) == pytest.approx(0.6, abs=0.01)
    assert abs(touch_distance(BALL, shadow, sphere(), floor(), raised(0.004), DOWN) - 0.004) < 1e-3


def test_points_in_the_object_are_counted_where_no_height_frees_it():
    wall = np.stack([np.zeros(50), np.zeros(50), np.linspace(-0.1, 0.1, 50)], axis=1)  # through the ball, all along
    assert overlap(BALL, wall, np.eye(4), DOWN) > 5
    assert overlap(BALL, wall + [2 * RADIUS, 0.0, 0.0], np.eye(4), DOWN) == 0
    below = np.stack([np.zeros(50), np.zeros(50), np.full(50, -RADIUS + 0.004)], axis=1)  # free once it is raised
    assert overlap(BALL, below, np.eye(4), DOWN) == 0


@pytest.mark.parametrize("seed", range(4))
def test_few_points_on_a_peg_tell_where_it_is_touched(seed):
    """The ball rests on the line on top of a peg, from which all points of the cloud are some millimetres away."""
    rng = np.random.default_rng(seed)
    angles = rng.uniform(0.3, 2 * np.pi - 0.3, 28)
    peg = np.stack([0.004 * np.sin(angles), rng.uniform(-0.04, 0.04, 28), 0.004 * np.cos(angles) - 0.004], axis=1)
    found = touch_distance(BALL, None, sphere(), peg, raised(0.003), DOWN)
    assert abs(found - 0.003) < 3e-4
    # Noise hides the peg, and the ball is lowered until the tested points touch, as everywhere else.
    noisy = touch_distance(BALL, None, sphere(), peg + rng.normal(0, 0.001, peg.shape), raised(0.003), DOWN)
    assert 3e-4 < abs(noisy - 0.003) < 0.004
