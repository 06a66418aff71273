"""Refinement: the object's points come to lie on its surface, in any pose, with one program for clouds of all sizes."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import compilations, enabled, random_cloud, random_poses

import tdf_jax as tdf
from tdf_jax._internal.errors import InputError
from tdf_jax.geometry import se3
from tdf_jax.networks import refinement


def miss(field, points):
    return float(jnp.mean((field.occupancy(points) - 0.5) ** 2))


@pytest.fixture(scope="module")
def mug():
    """The shipped network's field of an unseen mug, and its cloud."""
    model = tdf.load_model("mug")
    made = tdf.build_mug(tdf.sample_mug(np.random.default_rng(77)))
    points = np.asarray(tdf.sample_surface(made.mesh, 600, 0), np.float32)
    return model, tdf.encode(model, points), points


@pytest.mark.slow
def test_the_points_come_to_lie_on_the_surface(mug):
    model, field, points = mug
    misses = [miss(tdf.refine(model, field, points, steps), points) for steps in (0, 10, 40)]
    assert misses[0] == pytest.approx(miss(field, points), rel=1e-5)
    assert misses[1] < 0.8 * misses[0] and misses[2] < 0.5 * misses[0]


@pytest.mark.slow
def test_a_refined_field_moves_and_turns_with_the_points(mug):
    model, field, points = mug
    R, shift = np.asarray(se3.rotation(random_poses(3, 1)[0]), np.float32), np.array([0.3, -0.1, 0.2], np.float32)
    latent, turned = (
        field.latent,
        tdf.DescriptorField(
            refinement.condition(model.params, model.config, field.latent @ R.T), R @ field.origin + shift
        ),
    )
    here, there = tdf.refine(model, field, points, 5), tdf.refine(model, turned, points @ R.T + shift, 5)
    change = np.abs(here.latent - latent).max()
    assert change > 1e-3
    np.testing.assert_allclose(there.latent, here.latent @ R.T, atol=1e-2 * change)
    np.testing.assert_array_equal(there.origin, turned.origin)


def test_points_are_counted_once_however_few_there_are(small_model, monkeypatch):
    """The gradient is that of the plain mean over the points, without those that fill up the array."""
    points = random_cloud(2, 40)
    field = tdf.encode(small_model, points)

    def mean(latent):
        shape = tdf.DescriptorField(refinement.condition(small_model.params, small_model.config, latent), field.origin)
        return jnp.mean((shape.occupancy(points) - 0.5) ** 2)

    gradient = np.asarray(jax.jit(jax.grad(mean))(field.latent))
    # The first step of every vector that moves is as long as the rate says, against its gradient.
    size = np.sqrt(np.mean(np.sum(np.asarray(field.latent) ** 2, axis=-1)))
    expected = field.latent - refinement.RATE * size * gradient / np.linalg.norm(gradient, axis=-1, keepdims=True)
    np.testing.assert_allclose(
        tdf.refine(small_model, field, points, 1).latent, expected, atol=1e-3 * refinement.RATE * size
    )
    monkeypatch.setattr(refinement, "POINTS", 40)
    np.testing.assert_allclose(
        tdf.refine(small_model, field, points, 1).latent, expected, atol=1e-3 * refinement.RATE * size
    )


def test_clouds_of_all_sizes_and_steps_run_one_program(small_model):
    clouds = [random_cloud(count, count) for count in (40, 60, 1600)]
    fields = [tdf.encode(small_model, cloud) for cloud in clouds]
    tdf.refine(small_model, fields[0], clouds[0], 1)
    with compilations() as names:
        for field, cloud in zip(fields[1:], clouds[1:]):
            assert np.isfinite(tdf.refine(small_model, field, cloud, 2).latent).all()
    assert "jit(_refine)" not in names


@pytest.mark.parametrize("dtype", [pytest.param(np.float32, marks=pytest.mark.slow), np.float64])
def test_numbers_keep_their_precision_where_64_bits_are_enabled(small_model, dtype):
    with enabled("float64"):
        points = random_cloud(2, 40).astype(dtype)
        field = tdf.encode(small_model, points)
        assert tdf.refine(small_model, field, points, 2).latent.dtype == field.latent.dtype == dtype


def test_bad_input_is_refused(small_model):
    points = random_cloud(2, 40)
    field = tdf.encode(small_model, points)
    for steps in (-1, 1.5, True):
        with pytest.raises(InputError, match=r"refine\(\): steps is"):
            tdf.refine(small_model, field, points, steps)
    with pytest.raises(InputError, match="expected at least 21"):
        tdf.refine(small_model, field, points[:20])
    with pytest.raises(InputError, match="a network of other sizes"):
        tdf.refine(tdf.load_model("mug"), field, points)
    with pytest.raises(InputError, match="traced by jax.jit"):
        jax.jit(lambda points: tdf.refine(small_model, field, points))(points)
