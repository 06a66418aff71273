"""Where to look from next, of a ball whose field is known, and the points near a pick."""

import types

import jax.numpy as jnp
import numpy as np
import pytest

from tdf_jax.uncertainty.advice import look_from, points_at

BALL = types.SimpleNamespace(
    occupancy=lambda x: (jnp.linalg.norm(x - jnp.asarray([0.3, 0.1, 0.2]), axis=-1) < 0.05).astype(jnp.float32)
)


def sphere(count=3000):
    x = np.random.default_rng(0).normal(size=(count, 3))
    return 0.05 * x / np.linalg.norm(x, axis=1, keepdims=True)


@pytest.mark.parametrize("camera", [(1, 0, 0), (-0.6, 0, 0.8), (0, 0.28, -0.96)])
def test_the_other_side_is_looked_at(camera):
    x = sphere()
    seen = x[x @ np.array(camera) > 0] + (0.3, 0.1, 0.2)
    direction = look_from(BALL, seen)
    assert np.linalg.norm(direction) == pytest.approx(1)
    assert np.degrees(np.arccos(-direction @ np.array(camera))) < 10


def test_nothing_is_unseen_of_a_complete_cloud_or_where_nothing_is_expected():
    assert np.isnan(look_from(BALL, sphere() + (0.3, 0.1, 0.2))).all()
    nothing = types.SimpleNamespace(occupancy=lambda x: jnp.zeros(len(x)))
    assert np.isnan(look_from(nothing, sphere())).all()


def test_points_at_a_pick_are_those_in_the_box_of_the_query():
    query = np.array([[-0.01, -0.02, -0.03], [0.01, 0.02, 0.03]])
    points = np.array([[1.0, 0, 0], [1.015, 0, 0], [1, 0.005, 0.02], [1, 0.015, 0], [1.0, 0, 0.04]])
    upright = np.array([1.0, 0, 0, 0, 1, 0, 0])
    assert points_at(points, upright, query) == 3
    turned = np.array([np.sqrt(0.5), 0, 0, np.sqrt(0.5), 1, 0, 0])  # by 90 degrees about z: x of the box along y
    assert points_at(points, turned, query) == 3
    assert points_at(points[:1], turned, query) == 1 and points_at(points[3:4], turned, query) == 0
