"""The network against the original's outputs, stage by stage, and against plain forms of its parts."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import SMALL, TOLERANCE, enabled, random_cloud, relative_error
from flax.traverse_util import flatten_dict, unflatten_dict
from scipy.spatial import cKDTree

import tdf_jax as tdf
from tdf_jax._internal.errors import InputError
from tdf_jax.networks import occupancy, vector_neurons
from tdf_jax.networks.occupancy import condition, decode
from tdf_jax.networks.vector_neurons import EdgeConvolution, nearest_neighbours

ENCODER_STAGES = {"conv_pos": "conv_pos_pooled", "fc_pos": "fc_pos", "actvn_c": "actvn_c", "fc_c": "fc_c"}
ENCODER_STAGES |= {f"block_{index}": f"block_{index}" for index in range(5)}
DECODER_STAGES = ["fc_in", "block0", "block1", "block2", "block3", "block4", "fc_out"]
STAGES = [f"encoder.{name}" for name in ENCODER_STAGES.values()] + [f"decoder.{name}" for name in DECODER_STAGES]


@pytest.fixture(scope="module")
def stages(golden, golden_encoded, precision):
    """Every stage's output for the two golden objects, in the golden arrays' layouts."""
    with enabled(precision):
        outputs = []
        for (field, layers), x in zip(golden_encoded, golden.arrays["coords"]):
            planes = {stage: layers[name]["__call__"][0] for name, stage in ENCODER_STAGES.items()}
            # Planes x, y, z of (points, channels) -> (channels, 3, points); a latent has one point.
            found = {f"encoder.{name}": np.stack(xyz).transpose(2, 0, 1)[..., :8] for name, xyz in planes.items()}
            found |= {name: found[name][..., 0] for name in ("encoder.actvn_c", "encoder.fc_c")}
            activations, logits = jax.jit(decode)(field.conditioned, jnp.asarray(x, precision))
            hidden = [*activations[3:], logits[:, None]]
            found |= {f"decoder.{name}": np.asarray(value) for name, value in zip(DECODER_STAGES, hidden, strict=True)}
            outputs.append(found)
        return {name: np.stack([found[name] for found in outputs]) for name in STAGES}


@pytest.mark.parametrize("stage", STAGES)
def test_every_stage_is_the_originals(golden, stages, precision, stage):
    assert stages[stage].dtype == precision
    assert relative_error(stages[stage], golden.arrays[f"stage.{stage}"]) < TOLERANCE[precision]


def test_latents_descriptors_and_occupancies_are_the_originals(golden, golden_fields, precision):
    with enabled(precision):
        coords = jnp.asarray(golden.arrays["coords"], precision)
        found = {
            "latent": [field.latent for field in golden_fields],
            "features": [field.descriptors(x) for field, x in zip(golden_fields, coords)],
            "occupancy": [field.occupancy(x) for field, x in zip(golden_fields, coords)],
        }
        for name, arrays in found.items():
            assert arrays[0].dtype == precision
            assert relative_error(np.stack(arrays), golden.arrays[name]) < TOLERANCE[precision], name


def test_encode_gives_the_originals_latents(golden, precision):
    """The public way, from single-precision weights in either precision of the points."""
    with enabled(precision):
        latents = [tdf.encode(golden.model, cloud.astype(precision)).latent for cloud in golden.arrays["point_cloud"]]
        assert relative_error(np.stack(latents), golden.arrays["latent"]) < TOLERANCE[precision]


MUTATIONS = {"removed": np.zeros_like, "permuted": lambda tensor: np.roll(tensor, 1, axis=0)}


@pytest.mark.slow
@pytest.mark.parametrize(
    ("golden", "mutation"),
    [(32, "removed"), (32, "permuted"), (256, "removed")],  # that the order counts does not depend on the size
    indirect=["golden"],
)
def test_parity_fails_without_any_one_tensor(golden, mutation):
    """Parity would prove little if a tensor did not matter: each, changed alone, must show in what parity compares."""
    coords = jnp.asarray(golden.arrays["coords"][0], jnp.float32)
    cloud = jnp.asarray(golden.arrays["point_cloud"][0], jnp.float32)
    tensors = flatten_dict(golden.model.params, sep=".")
    assert len(tensors) == 55

    @jax.jit
    def outputs(field):
        x = coords + field.origin
        return {"latent": field.latent, "features": field.descriptors(x), "occupancy": field.occupancy(x)}

    def error(changed):
        field = tdf.encode(dataclasses.replace(golden.model, params=unflatten_dict(changed, sep=".")), cloud)
        return max(relative_error(value, golden.arrays[name][0]) for name, value in outputs(field).items())

    assert error(tensors) < TOLERANCE["float32"]
    errors = {
        name: error(tensors | {name: jnp.asarray(MUTATIONS[mutation](np.asarray(tensor)))})
        for name, tensor in tensors.items()
        if mutation == "removed" or len(tensor) > 1  # one number has no order
    }
    assert len(errors) >= 54
    survivors = {name: value for name, value in errors.items() if value < 20 * TOLERANCE["float32"]}
    assert not survivors


def plain_edge_convolution(params, points, neighbours, slope):
    """Edge features, vector linear map, vector leaky ReLU, mean over neighbours: (points, 3, channels)."""
    x = points[:, None]
    distances = jnp.sum((x - points) ** 2, axis=-1)
    near = points[jnp.argsort(distances, axis=1)[:, :neighbours]]
    own = jnp.broadcast_to(x, near.shape)
    edges = jnp.stack([near - x, own, jnp.cross(near, own)], axis=-1)  # (points, neighbours, 3, features)
    feature, direction = edges @ params["map_to_feat"]["kernel"], edges @ params["map_to_dir"]["kernel"]
    inner = jnp.sum(feature * direction, axis=2, keepdims=True)
    squared = jnp.sum(direction**2, axis=2, keepdims=True)
    reflected = feature - (1 - slope) * inner / (squared + 1e-6) * direction
    return jnp.mean(jnp.where(inner >= 0, feature, reflected), axis=1)


def test_the_edge_convolution_and_its_gradient_are_those_of_the_plain_form(quick_compilation):
    with jax.enable_x64(True):
        points = jnp.asarray(10 * random_cloud(0))
        module = EdgeConvolution(channels=6, neighbours=5, slope=0.2)
        rng = np.random.default_rng(0)
        params = {name: {"kernel": jnp.asarray(rng.normal(size=(3, 6)))} for name in ("map_to_feat", "map_to_dir")}
        weights = jnp.asarray(rng.normal(size=(len(points), 3, 6)))  # no two outputs count the same

        def fast(params, points):
            y = jnp.stack(module.apply({"params": params}, points), axis=1)
            return jnp.sum(weights * y), y

        def plain(params, points):
            y = plain_edge_convolution(params, points, 5, 0.2)
            return jnp.sum(weights * y), y

        gradients = (jax.jit(jax.value_and_grad(form, argnums=(0, 1), has_aux=True)) for form in (fast, plain))
        values = [gradient(params, points) for gradient in gradients]
        ((_, found), gradient), ((_, expected), expected_gradient) = values
        assert relative_error(found, expected) < 1e-12
        for a, b in zip(jax.tree.leaves(gradient), jax.tree.leaves(expected_gradient), strict=True):
            assert relative_error(a, b) < 1e-10


@pytest.mark.parametrize("count", [21, vector_neurons.NEIGHBOUR_ROWS + 7])  # within a block of rows, and over its edge
def test_nearest_neighbours(count):
    points = np.random.default_rng(0).normal(size=(count, 3)).astype(np.float32)
    found = np.sort(nearest_neighbours(jnp.asarray(points), 20), axis=1)
    np.testing.assert_array_equal(found, np.sort(cKDTree(points).query(points, 20)[1], axis=1))


def test_nearest_neighbours_far_from_the_origin():
    """128 m away float32 has 8 micrometres: the expansion |a|^2 + |b|^2 - 2ab would be off by whole centimetres."""
    points = np.round(random_cloud(0, 100) * 2**14) / 2**14  # exact after the shift
    near, far = (np.asarray(nearest_neighbours(jnp.asarray(points + shift, jnp.float32), 8)) for shift in (0, 128))
    np.testing.assert_array_equal(near[:, 0], np.arange(100))  # itself
    np.testing.assert_array_equal(np.sort(near), np.sort(far))


def test_published_sizes():
    assert tdf.NetworkConfig().channels == 2049
    assert occupancy.parameter_count(tdf.NetworkConfig()) == 1_757_185


def test_a_decoder_is_one_function_of_the_point(small_model):
    """Points are decoded on their own, whatever the batch axes."""
    rng = np.random.default_rng(0)
    latent, x = jnp.asarray(rng.normal(size=(SMALL.latent, 3))), jnp.asarray(0.1 * rng.normal(size=(2, 3, 5, 3)))
    conditioned = jax.jit(condition, static_argnums=1)(small_model.params, SMALL, latent)
    activations, logits = jax.jit(decode)(conditioned, x)
    assert logits.shape == (2, 3, 5)
    assert [part.shape[-1] for part in activations] == [1, 4, 4, 8, 8, 8]
    one, logit = jax.jit(decode)(conditioned, x[1, 2, 3])
    np.testing.assert_allclose(logit, logits[1, 2, 3], rtol=1e-5)
    for part, single in zip(activations, one, strict=True):
        np.testing.assert_allclose(part[1, 2, 3], single, rtol=1e-5, atol=1e-6)


def test_a_width_that_the_second_block_cannot_take_is_refused():
    with pytest.raises(InputError, match="vector_width is 128 and vector_hidden 128; expected twice as wide"):
        tdf.NetworkConfig(vector_width=128)
    assert tdf.NetworkConfig(vector_width=128, blocks=1).blocks == 1
