"""Derivatives of a pick: motions of cloud and query points that are known exactly, and picks that are found again."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import CARRY, cast, random_cloud, random_poses
from scipy.spatial.transform import Rotation

import tdf_jax as tdf
from tdf_jax._internal.errors import InputError
from tdf_jax.solvers import sensitivity

KEY = jax.random.key(0)
CLOUD = jnp.asarray(random_cloud(3), jnp.float32)


@pytest.fixture(scope="module")
def pick(field, reference):
    return tdf.carry(field, reference, KEY, config=CARRY).pick


@pytest.fixture
def exact(monkeypatch):
    """The small network has soft directions, without which a motion is not exact; float32 does not resolve them."""
    monkeypatch.setattr(sensitivity, "FREE", -1.0)
    jax.clear_caches()
    with jax.enable_x64(True):
        yield
    jax.clear_caches()


def rotation_of(wxyz):
    return Rotation.from_quat(np.array(wxyz, float), scalar_first=True)


def test_the_value_is_the_pick(field, reference, pick):
    found = tdf.differentiable_pick(field, reference, pick)
    np.testing.assert_array_equal(found.pose, pick)
    assert 0 <= int(found.num_free) < 6 and found.curvatures[5] == 1
    assert (np.diff(found.curvatures) >= 0).all()
    assert f"{int(found.num_free)} direction" in found.status or "all six" in found.status


def test_the_pick_moves_with_the_cloud(small_model, reference, pick, exact):
    """A translation and a rotation of the cloud move the pick by exactly as much, by finite rotations of scipy."""
    model = dataclasses.replace(small_model, params=cast(small_model.params, float))
    reference, pick, cloud = cast(reference, float), cast(pick, float), random_cloud(3)
    step = np.array([0.1, -0.3, 0.2, 0.5, 0.4, -0.6])

    def moved(amount):
        turn = jnp.eye(3) + amount * jnp.cross(jnp.eye(3), -step[:3])
        return tdf.differentiable_pick(tdf.encode(model, cloud @ turn + amount * step[3:]), reference, pick).pose

    value, derivative = jax.jvp(moved, (0.0,), (1.0,))
    small = 1e-6
    turn = Rotation.from_rotvec(small * step[:3])
    expected = (turn.apply(np.array(pick[4:])) - pick[4:]) / small + step[3:]
    np.testing.assert_allclose(derivative[4:], expected, atol=1e-5)
    turned = rotation_of(pick[:4] + small * derivative[:4])
    found = (turned * rotation_of(pick[:4]).inv()).as_rotvec() / small
    np.testing.assert_allclose(found, step[:3], atol=1e-5)
    np.testing.assert_array_equal(value, pick)


def test_query_points_that_move_are_moved_back(field, reference, pick, exact):
    """Shifted query points with the same descriptors: the pick is shifted the other way, in its own frame."""
    field, reference, pick = cast((field, reference, pick), float)
    shift = np.array([0.3, -0.2, 0.5])

    def moved(amount):
        shifted = dataclasses.replace(reference, query=reference.query + amount * shift)
        return tdf.differentiable_pick(field, shifted, pick).pose

    _, derivative = jax.jvp(moved, (0.0,), (1.0,))
    np.testing.assert_allclose(derivative[:4], 0, atol=1e-6)
    np.testing.assert_allclose(derivative[4:], -rotation_of(pick[:4]).apply(shift), atol=1e-6)


def test_both_modes_agree_in_a_batch(small_model, reference, pick):
    """Reverse mode, under jit and vmap, against forward mode."""
    directions = jnp.asarray(random_cloud(5), jnp.float32) - jnp.mean(CLOUD)

    def pose(points):
        return tdf.differentiable_pick(tdf.encode(small_model, points), reference, pick).pose

    rows = jax.jit(jax.vmap(lambda weights: jax.grad(lambda points: pose(points) @ weights)(CLOUD)))(jnp.eye(7))
    _, forward = jax.jvp(pose, (CLOUD,), (directions,))
    np.testing.assert_allclose(jnp.sum(rows * directions, axis=(1, 2)), forward, rtol=2e-3, atol=1e-4)
    assert np.abs(rows).max() > 1e-4


def test_free_directions_have_no_part_in_it(field, reference, pick, monkeypatch):
    monkeypatch.setattr(sensitivity, "FREE", 2.0)  # above every curvature
    jax.clear_caches()
    try:

        def shifted(query):
            found = tdf.differentiable_pick(field, dataclasses.replace(reference, query=query), pick)
            return found.pose, found

        _, derivative, found = jax.jvp(shifted, (reference.query,), (jnp.ones_like(reference.query),), has_aux=True)
    finally:
        jax.clear_caches()
    assert int(found.num_free) == 6 and "6 directions are not determined" in found.status
    np.testing.assert_array_equal(derivative, 0)


def test_the_found_pick_is_differentiated_under_jit(small_model, reference):
    """As in the guide: the search has no tangents, and the rule gives the pick its own."""

    def height(points, query):
        field = tdf.encode(small_model, points)
        given = dataclasses.replace(reference, query=query)
        found = tdf.carry(*jax.lax.stop_gradient((field, given)), KEY, config=CARRY).pick
        return tdf.differentiable_pick(field, given, found).pose[6]

    towards = jnp.array([0.0, 0.0, 1.0])
    value, (of_points, of_query) = jax.jit(jax.value_and_grad(height, argnums=(0, 1)))(CLOUD, reference.query)
    assert np.isfinite(value) and np.abs(of_query).max() > 0
    assert np.abs(of_points @ towards).max() > 1e-4


def test_a_pick_off_the_minimum_is_said_to_be(field, reference, pick):
    far = pick.at[4:].add(0.03)
    assert "mm from the minimum" in tdf.differentiable_pick(field, reference, far).status
    batch = jax.vmap(lambda one: tdf.differentiable_pick(field, reference, one))(jnp.stack([pick, far]))
    assert batch.offset[1] > batch.offset[0]
    with pytest.raises(InputError, match="num_free and offset"):
        _ = batch.status


def test_what_is_no_pick_is_refused(field, reference, pick):
    with pytest.raises(InputError, match="shape"):
        tdf.differentiable_pick(field, reference, random_poses(0, 2))
    other = dataclasses.replace(reference, descriptors=reference.descriptors[..., :5])
    with pytest.raises(InputError, match="channels"):
        tdf.differentiable_pick(field, other, pick)
