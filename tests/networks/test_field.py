"""The descriptor field: what it returns, and how it moves with its object."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import SMALL, TOLERANCE, carried, compilations, enabled, random_cloud, random_poses, relative_error
from scipy.spatial.transform import Rotation

import tdf_jax as tdf
from tdf_jax._internal.errors import InputError
from tdf_jax.geometry.sampling import subsamples
from tdf_jax.networks.encoding import consistent_latents
from tdf_jax.networks.occupancy import encode_latent

# float32 coordinates half a metre away carry 3e-8 m, of offsets of 5 cm; the network's own rounding is 1e-5.
EQUIVARIANCE = {"float32": 2e-4, "float64": 1e-10}
latent_of = jax.jit(encode_latent, static_argnums=1)  # its parts one by one are programs of their own


def near(points, count=16, seed=5):
    """Places around an object."""
    rng = np.random.default_rng(seed)
    return points[rng.integers(len(points), size=count)] + 0.03 * rng.normal(size=(count, 3))


def test_descriptors_have_unit_length_and_occupancies_are_probabilities(field, values):
    x = jnp.asarray(random_cloud(4, 500), jnp.float32)
    descriptors, occupancy = values(field, x)
    assert descriptors.shape == (500, SMALL.channels) and occupancy.shape == (500,)
    np.testing.assert_allclose(np.linalg.norm(descriptors, axis=-1), 1, atol=1e-6)
    assert (occupancy >= 0).all() and (occupancy <= 1).all() and np.ptp(occupancy) > 0.01


def test_batch_axes(field, values):
    x = jnp.asarray(random_cloud(4, 24), jnp.float32)
    descriptors, occupancy = values(field, x)
    d, o = values(field, x.reshape(2, 3, 4, 3))
    assert d.shape == (2, 3, 4, SMALL.channels) and o.shape == (2, 3, 4)
    np.testing.assert_allclose(d.reshape(24, -1), descriptors, atol=1e-6)
    np.testing.assert_allclose(o.reshape(24), occupancy, atol=1e-6)
    d, o = values(field, x[7])
    np.testing.assert_allclose(d, descriptors[7], atol=1e-6)
    assert o.shape == ()


def test_the_origin_is_the_mean_of_the_points(field):
    np.testing.assert_allclose(field.origin, random_cloud(3).mean(axis=0), atol=1e-6)
    assert field.latent.shape == (SMALL.latent, 3)


def test_precision_is_the_inputs(small_model, field, values):
    x = jnp.asarray(random_cloud(4, 24), jnp.float32)
    assert {field.latent.dtype, field.origin.dtype, *(v.dtype for v in values(field, x))} == {jnp.dtype("float32")}
    with jax.enable_x64(True):  # float32 stays so where float64 is allowed, float64 stays float64 on float32 weights
        assert {v.dtype for v in values(field, x)} == {jnp.dtype("float32")}
        double = tdf.encode(small_model, random_cloud(3))
        assert double.latent.dtype == double.origin.dtype == jnp.dtype("float64")
        assert {v.dtype for v in values(double, x.astype(float))} == {jnp.dtype("float64")}
        assert relative_error(field.latent, double.latent) < TOLERANCE["float32"]


@pytest.mark.parametrize("seed", range(4))
def test_a_field_moves_with_its_object(small_model, values, precision, seed):
    """Latent vectors turn with the cloud; descriptors and occupancies are carried along."""
    points, motion = random_cloud(seed), random_poses(seed, 1)[0]
    x = near(points)
    turn = motion * [1, 1, 1, 1, 0, 0, 0]
    with enabled(precision):
        still = tdf.encode(small_model, points.astype(precision))
        moved = tdf.encode(small_model, carried(motion, points).astype(precision))
        assert still.latent.dtype == precision
        assert relative_error(moved.latent, carried(turn, still.latent)) < EQUIVARIANCE[precision]
        assert relative_error(moved.latent, still.latent) > 0.1  # the turn is not a small one
        at_rest, after = values(still, x.astype(precision)), values(moved, carried(motion, x).astype(precision))
        for found, expected in zip(after, at_rest, strict=True):
            assert relative_error(found, expected) < EQUIVARIANCE[precision]


@pytest.mark.parametrize("shift", [(1.0, 0, 0), (0, -20.0, 3.0)])
def test_translation_changes_nothing(small_model, values, shift):
    """Multiples of 2^-14 m stay exact under the shifts, so that only the subtraction of the mean is tested."""
    points = jnp.asarray(np.round(random_cloud(0) * 2**14) / 2**14, jnp.float32)
    x = jnp.asarray(np.round(near(random_cloud(0)) * 2**14) / 2**14, jnp.float32)
    still, moved = tdf.encode(small_model, points), tdf.encode(small_model, points + jnp.asarray(shift))
    tolerance = EQUIVARIANCE["float32"] * max(1, np.abs(shift).max())  # of the mean's rounding
    assert relative_error(moved.latent, still.latent) < tolerance
    for found, expected in zip(values(moved, x + jnp.asarray(shift)), values(still, x), strict=True):
        assert relative_error(found, expected) < tolerance


@pytest.mark.parametrize("seed", range(3))
def test_the_order_of_the_points_changes_nothing(small_model, precision, seed):
    points = random_cloud(seed).astype(precision)
    with enabled(precision):
        shuffled = np.random.default_rng(seed).permutation(points)
        first, second = (tdf.encode(small_model, cloud) for cloud in (points, shuffled))
        assert relative_error(second.latent, first.latent) < EQUIVARIANCE[precision]
        np.testing.assert_allclose(second.origin, first.origin, rtol=1e-6)


def test_gradients_are_finite_everywhere(field):
    """At the origin, at a point of the cloud and far away, where the field is flat."""
    direction = jnp.asarray(np.random.default_rng(0).normal(size=SMALL.channels), jnp.float32)
    gradients = jax.jit(jax.grad(lambda x: (field.descriptors(x) @ direction) + field.occupancy(x)))
    for x in (field.origin, jnp.asarray(random_cloud(3)[0], jnp.float32)):
        gradient = gradients(x)
        assert np.isfinite(gradient).all() and np.linalg.norm(gradient) > 1e-3
    assert np.isfinite(gradients(field.origin + jnp.array([1e6, -1e5, 0.0]))).all()


@pytest.mark.slow
def test_gradients_reach_the_points_of_the_least_cloud_where_some_coincide(small_model):
    """21 points are enough, and duplicates have edges of length zero."""
    points = jnp.asarray(np.tile(random_cloud(0, 7), (3, 1)), jnp.float32)
    norm = jax.jit(jax.value_and_grad(lambda points: jnp.sum(tdf.encode(small_model, points).latent ** 2)))
    value, gradient = norm(points)
    assert np.isfinite(value) and np.isfinite(gradient).all() and np.linalg.norm(gradient) > 1e-3
    with pytest.raises(InputError, match="20 points; expected at least 21"):
        tdf.encode(small_model, random_cloud(0, 20))


@pytest.fixture(scope="module")
def subsampling_model(small_model):
    """A network that knows clouds of 24 points."""
    return dataclasses.replace(small_model, info=dataclasses.replace(small_model.info, cloud_points=24))


def test_a_dense_cloud_is_subsampled_several_times_and_the_latents_averaged(small_model, subsampling_model):
    points = random_cloud(0, 90).astype(np.float32)
    clouds = subsamples(points, 24, 4)
    assert clouds.shape == (4, 24, 3)
    np.testing.assert_array_equal(clouds[0], tdf.thin(points, 24))
    fields = [tdf.encode(small_model, cloud) for cloud in clouds]
    latents = np.stack([field.latent for field in fields])
    assert np.abs(latents - latents[0]).max() > 1e-2 * np.abs(latents).max()
    agreed = np.asarray(consistent_latents(jnp.asarray(latents), np.ones(4, bool)))
    assert agreed.any()
    found = tdf.encode(subsampling_model, points, num_subsamples=4)
    np.testing.assert_allclose(found.latent, latents[agreed].mean(axis=0), atol=1e-6)
    np.testing.assert_allclose(
        found.origin, np.mean([field.origin for field in fields], axis=0, where=agreed[:, None]), atol=1e-7
    )


@pytest.fixture(scope="module")
def displacing_model(subsampling_model):
    """It sees clouds of 24 points, displaced."""
    return dataclasses.replace(
        subsampling_model, config=dataclasses.replace(subsampling_model.config, symmetry_breaking_offset=0.2)
    )


@pytest.mark.slow
def test_a_displaced_cloud_is_seen_away_from_its_farthest_point(small_model, displacing_model):
    """All subsamples alike, by the farthest point of the whole cloud; where the field is, is not displaced."""
    points = random_cloud(0, 90).astype(np.float32)
    anchor = points[np.argmax(np.linalg.norm(points - points.mean(axis=0), axis=1))]
    clouds = subsamples(points, 24, 4)
    latents = []
    for cloud in clouds:
        centred = cloud - cloud.mean(axis=0)
        latents.append(
            np.asarray(latent_of(small_model.params, small_model.config, centred - 0.2 * (anchor - cloud.mean(axis=0))))
        )
    plain = np.stack([tdf.encode(small_model, cloud).latent for cloud in clouds])
    assert np.abs(np.stack(latents) - plain).max() > 1e-2 * np.abs(plain).max()
    agreed = np.asarray(consistent_latents(jnp.asarray(latents), np.ones(4, bool)))
    found = tdf.encode(displacing_model, points, num_subsamples=4)
    np.testing.assert_allclose(found.latent, np.mean(latents, axis=0, where=agreed[:, None, None]), atol=1e-5)
    np.testing.assert_allclose(found.origin, clouds[agreed].mean(axis=(0, 1)), atol=1e-6)
    # Of a sparse cloud, filled up with points that do not count, the same as of the points alone, under jax.jit too.
    few = points[:22]
    centred = few - few.mean(axis=0)
    alone = latent_of(small_model.params, displacing_model.config, centred)
    farthest = centred[np.argmax(np.linalg.norm(centred, axis=1))]
    np.testing.assert_allclose(
        alone, latent_of(small_model.params, small_model.config, centred - 0.2 * farthest), atol=1e-5
    )
    filled, used = np.concatenate([centred, 9 + centred[:5]]), np.arange(27) < 22
    np.testing.assert_allclose(latent_of(small_model.params, displacing_model.config, filled, used), alone, atol=1e-5)
    for field in (tdf.encode(displacing_model, few), jax.jit(lambda points: tdf.encode(displacing_model, points))(few)):
        np.testing.assert_allclose(field.latent, alone, atol=1e-5)
        np.testing.assert_allclose(field.origin, few.mean(axis=0), atol=1e-7)


def test_a_symmetric_object_has_sides_to_a_network_with_an_offset_only(small_model, displacing_model):
    """A cloud that half a turn leaves as it is: without, all of its latent lies along the axis."""
    half = random_cloud(1, 12) - random_cloud(1, 12).mean(axis=0)
    points = np.concatenate([half, half * (-1, -1, 1)])
    points -= points.mean(axis=0)
    shares = []
    for config in (small_model.config, displacing_model.config):
        latent = np.asarray(latent_of(small_model.params, config, points.astype(np.float32)))
        shares.append(np.sum(latent[:, :2] ** 2) / np.sum(latent**2))
    assert shares[0] < 1e-8
    assert shares[1] > 1e-2


def noisy(latent, turns, seed):
    """A latent turned about z by degrees, with noise of a tenth."""
    noise = np.random.default_rng(seed).normal(size=(len(turns), *latent.shape)) * 0.1 * np.std(latent)
    return jnp.asarray(
        latent @ Rotation.from_euler("z", turns[:, None], degrees=True).as_matrix().transpose(0, 2, 1) + noise,
        jnp.float32,
    )


@pytest.mark.parametrize(("turns", "kept"), [
    ([0.0] * 8, "11111111"),
    # of an object without symmetry: they differ by how well its frame is found
    ([0, 3, -4, 2, 5, 0, -3, 1], "11111111"),
    ([0, 180, 180, 0, 180, 180, 0, 180], "01101101"),  # a flat bottle's two sides: those that are more
    ([0, 90, 180, 270, 0, 90, 0, 180], "10001010"),
    ([200, 0], "10"),  # of as many, the first
])  # fmt: skip
def test_only_latents_that_show_one_of_the_poses_of_a_symmetric_object_are_averaged(turns, kept):
    latents = noisy(random_cloud(0, 40), np.array(turns, float), seed=1)
    np.testing.assert_array_equal(consistent_latents(latents, np.ones(len(turns), bool)), [one == "1" for one in kept])
    # What only fills up the room never counts, be it alike.
    filled, used = jnp.concatenate([latents, latents[1:2], latents[1:2]]), np.arange(len(turns) + 2) < len(turns)
    np.testing.assert_array_equal(consistent_latents(filled, used), [one == "1" for one in kept + "00"])


def test_latents_that_are_only_noisy_agree():
    """Noise as large as the latent: no rotation brings two of them much nearer."""
    latents = random_cloud(0, 40) + np.random.default_rng(2).normal(size=(8, 40, 3)) * np.std(random_cloud(0, 40))
    assert np.asarray(consistent_latents(jnp.asarray(latents, jnp.float32), np.ones(8, bool))).all()


@pytest.mark.parametrize("model", ["subsampling_model", "displacing_model"])
def test_the_average_turns_with_the_cloud(model, request):
    model, points = request.getfixturevalue(model), random_cloud(0, 90)
    R = Rotation.random(random_state=0).as_matrix()
    still, moved = (tdf.encode(model, cloud.astype(np.float32)) for cloud in (points, points @ R.T + 0.3))
    np.testing.assert_allclose(moved.latent, still.latent @ R.T, atol=1e-4)
    np.testing.assert_allclose(moved.origin, R @ still.origin + 0.3, atol=1e-6)


def test_points_are_used_as_they_are_where_there_is_nothing_to_subsample(small_model, subsampling_model):
    dense, sparse = random_cloud(0, 90), random_cloud(0, 24)
    plain = tdf.encode(small_model, dense).latent  # a density that is not known
    np.testing.assert_array_equal(tdf.encode(subsampling_model, dense, num_subsamples=0).latent, plain)
    np.testing.assert_allclose(
        tdf.encode(subsampling_model, sparse).latent, tdf.encode(small_model, sparse).latent, atol=1e-6
    )


@pytest.mark.slow
@pytest.mark.parametrize("model", ["small_model", "subsampling_model"])
def test_clouds_of_many_sizes_run_one_program_and_what_fills_them_up_does_not_count(model, request, small_model):
    model = request.getfixturevalue(model)
    sizes = (21, 23, 24)
    clouds = [random_cloud(size, size).astype(np.float32) for size in sizes]
    tdf.encode(model, random_cloud(0, 22).astype(np.float32))
    with compilations() as names:
        fields = [tdf.encode(model, cloud) for cloud in clouds]
    assert names == []
    for cloud, field in zip(clouds, fields):
        plain = latent_of(small_model.params, small_model.config, cloud - cloud.mean(axis=0))
        np.testing.assert_allclose(field.latent, plain, atol=5e-6 * np.abs(plain).max())  # rounding of float32
        np.testing.assert_allclose(field.origin, cloud.mean(axis=0), atol=1e-7)
        traced = jax.jit(lambda points: tdf.encode(model, points))(cloud)
        # The traced cloud is centred in float32.
        np.testing.assert_allclose(traced.latent, field.latent, atol=5e-6 * np.abs(plain).max())


def test_a_first_encoding_compiles_one_program_and_none_of_its_constants(small_model):
    cloud = random_cloud(0, 2300).astype(np.float32)  # of a size that no other test has, so nothing is compiled yet
    with compilations() as names:
        tdf.encode(small_model, cloud, num_subsamples=0)
    asks_for_a_trace = "jit(convert_element_type)"  # once a process
    assert [name for name in names if name != asks_for_a_trace] == ["jit(_encode)"]


@pytest.mark.slow
@pytest.mark.parametrize("model", ["small_model", "subsampling_model"])
def test_the_latent_has_a_gradient_with_respect_to_the_parameters(model, request):
    model, cloud = request.getfixturevalue(model), random_cloud(0, 90).astype(np.float32)

    def size(model):
        return jnp.sum(tdf.encode(model, cloud, num_subsamples=3).latent ** 2)

    kernel = model.params["encoder"]["fc_c"]["map_to_feat"]["kernel"]
    slope = jax.grad(size)(model).params["encoder"]["fc_c"]["map_to_feat"]["kernel"]
    # The latent is linear in its last map, so its square grows by twice its size along it.
    assert float(jnp.sum(slope * kernel)) == pytest.approx(2 * float(size(model)), rel=1e-4)


def test_more_neighbours_than_points_are_refused(small_model):
    model = dataclasses.replace(small_model, config=dataclasses.replace(small_model.config, neighbours=30))
    with pytest.raises(InputError, match="25 points; expected at least the network's 30 neighbours"):
        tdf.encode(model, random_cloud(0, 25))


def test_a_cloud_hardly_denser_gives_one_subsample():
    points = random_cloud(0, 60)
    assert len(subsamples(points, 24, 8)) == 1
    assert len(subsamples(points, 20, 8)) == 8


def test_a_traced_cloud_is_subsampled_as_a_known_one(subsampling_model):
    clouds = np.stack([random_cloud(seed, 90) for seed in (0, 1)]).astype(np.float32)

    @jax.jit
    @jax.vmap
    def batch(points):
        field = tdf.encode(subsampling_model, points)
        return field.latent, field.origin

    latents, origins = batch(clouds)
    for index, cloud in enumerate(clouds):
        field = tdf.encode(subsampling_model, cloud)
        # The traced cloud is centred in float32.
        np.testing.assert_allclose(latents[index], field.latent, atol=1e-5 * np.abs(field.latent).max())
        np.testing.assert_allclose(origins[index], field.origin, atol=1e-7)


def test_a_traced_cloud_that_is_subsampled_has_a_gradient(subsampling_model):
    """The points that are chosen move, and the choice does not."""
    cloud = random_cloud(0, 90).astype(np.float32)
    slope = jax.jit(jax.grad(lambda points: jnp.sum(tdf.encode(subsampling_model, points).origin)))(cloud)
    np.testing.assert_allclose(slope.sum(axis=0), 1, atol=1e-5)
    assert (np.asarray(slope) >= 0).all()


def test_a_known_cloud_is_encoded_while_a_function_is_traced(subsampling_model):
    cloud = random_cloud(0, 90).astype(np.float32)
    cloud[5] = 40.0  # far from all else
    field, kept = tdf.encode(subsampling_model, cloud, return_kept=True)
    inside, kept_inside = jax.jit(lambda: tdf.encode(subsampling_model, cloud, return_kept=True))()
    np.testing.assert_array_equal(inside.latent, field.latent)
    np.testing.assert_array_equal(kept_inside, kept)
    assert not kept[5] and kept.sum() == 89


def test_a_negative_number_of_subsamples_is_refused(subsampling_model):
    with pytest.raises(InputError, match="num_subsamples is -1"):
        tdf.encode(subsampling_model, random_cloud(0, 90), num_subsamples=-1)


def spoiled(value):
    points = random_cloud(0)
    points[7, 1] = value
    return points


@pytest.mark.parametrize(
    ("points", "message"),
    [
        (np.zeros((0, 3)), "0 points"),
        (random_cloud(0)[:, :2], "shape"),
        (random_cloud(0)[None], "shape"),
        (spoiled(np.nan), "1 of the 40 points"),
        (spoiled(np.inf), "1 of the 40 points"),
        (np.ones((40, 3)), "all equal"),
    ],
    ids=["none", "plane", "batch", "nan", "infinite", "equal"],
)
def test_bad_points_are_refused(small_model, points, message):
    with pytest.raises(InputError, match=message):
        tdf.encode(small_model, points)


@pytest.mark.parametrize("shape", [(), (1,), (5, 2), (5, 1), (3, 5)])
@pytest.mark.parametrize("function", ["descriptors", "occupancy"])
def test_places_of_another_shape_are_refused(field, function, shape):
    """(5, 1) would broadcast against the origin."""
    with pytest.raises(InputError, match=rf"DescriptorField.{function}\(\): x has shape .*; expected \(..., 3\)"):
        getattr(field, function)(np.zeros(shape))


def test_a_field_is_a_pytree(field, values):
    leaves, tree = jax.tree.flatten(field)
    assert all(isinstance(leaf, jax.Array) for leaf in leaves)
    shifted = dataclasses.replace(jax.tree.unflatten(tree, leaves), origin=field.origin + 1)
    x = jnp.asarray(random_cloud(4, 24), jnp.float32)
    np.testing.assert_allclose(values(shifted, x + 1)[0], values(field, x)[0], atol=1e-5)
