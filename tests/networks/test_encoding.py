"""Clouds far from the origin, and clouds of a wrong unit."""

import dataclasses
import warnings

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import FIXTURES, random_cloud

import tdf_jax as tdf
from tdf_jax._internal.errors import InputError
from tdf_jax.evaluation.cases import generated_case, place_demonstration

CLOUD = random_cloud(3)


@pytest.fixture(scope="module")
def sized_model(small_model):
    """A network whose training objects were as large as the clouds here."""
    info = dataclasses.replace(small_model.info, smallest_diagonal=0.2, largest_diagonal=0.5)
    return dataclasses.replace(small_model, info=info)


def test_a_cloud_is_centred_before_it_is_rounded(small_model):
    """Rounding at 200 m moves a point by 0.008 mm; the shape in float32 keeps 1e-8 m."""
    near, far = CLOUD - CLOUD.mean(axis=0), CLOUD - CLOUD.mean(axis=0) + np.array([200.0, -150.0, 100.0])
    latents = [tdf.encode(small_model, cloud).latent for cloud in (near, far, far.astype(np.float32))]
    scale = np.abs(latents[0]).max()
    np.testing.assert_allclose(latents[1], latents[0], atol=1e-6 * scale)
    assert np.abs(latents[2] - latents[0]).max() > 1e-5 * scale  # what was rounded before it came cannot be restored


@pytest.mark.slow
def test_a_pick_far_from_the_origin_is_exact_to_a_tenth_of_a_millimetre():
    """Nearly as far as is allowed, in every coordinate."""
    shift, config = (240.0, 200.0, -240.0), tdf.CarryConfig(num_starts=16, num_candidates=2)
    case = generated_case("mug", 3, 0)
    demonstration = place_demonstration(case, "wave", 3, tdf.box_query(jax.random.key(1), 32, 0.06))
    model, key, offset = tdf.load_model("mug"), jax.random.key(0), np.array([0, 0, 0, 0, *shift])
    far = dataclasses.replace(
        demonstration,
        points=np.asarray(demonstration.points, np.float64) + shift,
        trajectory=tdf.Trajectory(np.asarray(demonstration.trajectory.wxyz_xyz, np.float64) + offset),
    )
    expected = tdf.imitate(model, demonstration, case.points_b, key=key, config=config).trajectory.wxyz_xyz
    points = np.asarray(case.points_b, np.float64) + np.array(shift)
    found = np.asarray(tdf.imitate(model, far, points, key=key, config=config).trajectory.wxyz_xyz, np.float64) - offset
    np.testing.assert_allclose(found[:, 4:], expected[:, 4:], atol=1e-4)
    np.testing.assert_allclose(found[:, :4], expected[:, :4], atol=1e-3)


@pytest.mark.parametrize("dtype", [np.float64, np.float32, np.int64])
def test_coordinates_that_float32_does_not_resolve_are_refused(small_model, demonstration, dtype):
    shift = np.array([412345.0, 5412345.0, 120.0])
    points = (40 * CLOUD if dtype is np.int64 else CLOUD) + shift
    message = r"coordinates of up to 5\.4123.e\+06 m; expected at most 250 m .*offset = points.mean\(axis=0\)"
    for call in (
        lambda: tdf.encode(small_model, points.astype(dtype)),
        lambda: tdf.imitate(small_model, demonstration, points.astype(dtype), key=jax.random.key(0)),
        lambda: tdf.imitate(small_model, demonstration, CLOUD, key=jax.random.key(0), goal=[1, 0, 0, 0, *shift]),
        lambda: dataclasses.replace(demonstration, points=points.astype(dtype)),
        lambda: dataclasses.replace(demonstration, trajectory=tdf.Trajectory(np.array([[1, 0, 0, 0, *shift]]))),
    ):
        with pytest.raises(InputError, match=message):
            call()


def test_double_precision_has_no_limit(small_model):
    shift = np.array([412345.0, 5412345.0, 120.0])
    with jax.enable_x64(True):
        params = jax.tree.map(lambda leaf: jnp.asarray(leaf, jnp.float64), small_model.params)
        model = dataclasses.replace(small_model, params=params)
        near, far = tdf.encode(model, CLOUD), tdf.encode(model, CLOUD + shift)
    np.testing.assert_allclose(far.latent, near.latent, atol=1e-6 * np.abs(near.latent).max())
    np.testing.assert_allclose(np.asarray(far.origin) - shift, near.origin, atol=1e-8)


@pytest.mark.parametrize(
    ("factor", "advice"),
    [
        (1000, "millimetres: multiply it by 0.001"),
        (100, "centimetres: multiply it by 0.01"),
        (39.37, "inches: multiply it by 0.0254"),
        (0.01, "check its unit"),
    ],
)
def test_a_wrong_unit_is_warned_of_with_the_likely_one(sized_model, factor, advice):
    with pytest.warns(tdf.SizeWarning, match=rf"encode\(\): .*trained on objects of 0.2 to 0.5 m.*{advice}"):
        tdf.encode(sized_model, factor * (CLOUD - CLOUD.mean(axis=0)))


def test_a_mesh_in_millimetres_far_from_the_origin_is_refused_with_both_fixes(small_model):
    with pytest.raises(
        tdf.InputError, match=r"If they are in millimetres, multiply them by 0\.001\. Subtract one offset"
    ):
        tdf.encode(small_model, 1000 * (CLOUD + 0.3))


def test_half_and_double_size_and_unknown_sizes_are_not_warned_of(sized_model, small_model):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for factor in (0.5, 1, 2):
            tdf.encode(sized_model, factor * CLOUD)
        tdf.encode(small_model, 1000 * (CLOUD - CLOUD.mean(axis=0)))


def test_shipped_and_converted_weights_know_the_sizes_of_their_training_objects(tmp_path):
    for name in tdf.available_models():
        info = tdf.load_model(name).info
        assert (info.smallest_diagonal, info.largest_diagonal) == (0.08, 0.5)
    model = tdf.convert_checkpoint(FIXTURES / "ndf_latent32.pth")
    assert (model.info.smallest_diagonal, model.info.largest_diagonal) == (0.2, 0.5)
    tdf.save_model(model, tmp_path / "ndf.safetensors")
    assert tdf.load_model(tmp_path / "ndf.safetensors").info == model.info


def test_integers_are_points_too(small_model):
    millimetres = np.round(1000 * (CLOUD - CLOUD.mean(axis=0))).astype(np.int32)
    found = tdf.encode(small_model, millimetres)
    np.testing.assert_array_equal(found.latent, tdf.encode(small_model, millimetres.astype(np.float64)).latent)
