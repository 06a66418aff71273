"""What training minimises: occupancy, the frame the latent must carry, and descriptors that agree at an object's places."""

import functools

import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Float

from tdf_jax._internal.devices import one_at_a_time
from tdf_jax.networks.field import DescriptorField
from tdf_jax.networks.occupancy import NetworkConfig, condition, decode, encode_latent
from tdf_jax.training.batch import QUARTERS

FRAME_WEIGHT = 0.3
PLACE_WEIGHT = 0.1
# Objects come in a canonical frame: up, and the front, the side of the handle or a longer one.
UP, FRONT = (0.0, 0.0, 1.0), (1.0, 0.0, 0.0)
# The places' loss is the negative log of the right pose's share, each pose weighing energy^-SHARPNESS.
SHARPNESS = 8.0


def pair_loss(
    params,
    config: NetworkConfig,
    clouds: Float[Array, "2 points 3"],
    queries: Float[Array, "2 queries 3"],
    inside: Float[Array, "2 queries"],
    centres: Float[Array, "2 3"],
    fold: Float[Array, "2"],
    shown: Float[Array, "2 box 3"],
    offered: Float[Array, "2 offers box 3"],
) -> tuple[Float[Array, ""], dict]:
    """Loss of a pair of objects: occupancy, `FRAME_WEIGHT` times the frame's error, `PLACE_WEIGHT` times the places'.

    Args:
        params: {"network": ..., "frame": (latent, 3)}.
        config: sizes of the network.
        clouds: centred, canonical orientation, metres.
        queries: relative to the cloud's mean, metres.
        inside: 1 inside the object, 0 outside.
        centres: origins of the objects' frames, relative to the cloud's mean.
        fold: symmetry of the objects, see `tdf_jax.symmetry`.
        shown, offered: query points at a place; see `tdf_jax.training.batch.Batch`.

    Returns:
        The loss, and its parts by name, one of each object.
    """
    fields, losses, parts = _each(
        functools.partial(_object_loss, params, config), clouds, queries, inside, centres, fold
    )
    others = jax.tree.map(lambda leaf: leaf[::-1], fields)
    place = _each(place_error, fields, others, shown, offered)
    return jnp.mean(losses) + PLACE_WEIGHT * jnp.mean(place), parts | {"place": place}


def _each(function, *samples):
    """`function` of the samples of every object."""
    return jax.lax.map(lambda sample: function(*sample), samples) if one_at_a_time() else jax.vmap(function)(*samples)


def _object_loss(params, config, cloud, queries, inside, centre, fold):
    """The field, and binary cross-entropy plus the frame's error with the parts they are reported by."""
    latent = encode_latent(params["network"], config, cloud)
    conditioned = condition(params["network"], config, latent)
    _, logits = decode(conditioned, queries)
    cross_entropy = jnp.mean(optax.sigmoid_binary_cross_entropy(logits, inside))
    frame = frame_error(params, latent, centre * config.scaling, fold)
    occupied, truth = logits > 0, inside > 0.5
    parts = {
        "bce": cross_entropy,
        "frame": frame,
        "intersection": jnp.sum(occupied & truth).astype(float),
        "union": jnp.sum(occupied | truth).astype(float),
    }
    return DescriptorField(conditioned, jnp.zeros(3)), cross_entropy + FRAME_WEIGHT * frame, parts


def frame_error(
    params, latent: Float[Array, "latent 3"], centre: Float[Array, "3"], fold: Float[Array, ""]
) -> Float[Array, ""]:
    """Squared error of the object's frame read out of a latent: up, the front as far as there is one, and the frame's origin.

    Three linear read-outs (`params["frame"]`, (latent, 3), used in training only) of a latent whose vectors turn with
    the object: a vector-neuron network has no bias, so it must find the frame in the cloud, and being equivariant it
    needs no rotated copies for it. Without this term, an early trial could not match an object with itself after 500
    steps; with it, the frame is found within 200. A cloud seen from one side has its mean off the object's middle: the
    origin tells by how much.

    A symmetric object has several fronts that are as good: the nearest counts. Asked for none, the network laid all
    vectors of a bowl's latent along its axis, and no shape but one of revolution could be told from them (IoU of oval
    and square ones 0.3); asked for any, and shown clouds displaced (`NetworkConfig.asymmetry`), it tells their sides.

    Args:
        params: see `pair_loss`.
        latent: of a cloud in its canonical orientation.
        centre: origin of the object's frame relative to the cloud's mean, in the network's unit.
        fold: symmetry of the object; a round one is asked for no front.
    """
    up, front, origin = params["frame"].T @ latent
    turns = jnp.arange(QUARTERS)
    fronts = jnp.round(jnp.stack([jnp.cos(turns * jnp.pi / 2), jnp.sin(turns * jnp.pi / 2), 0 * turns], axis=1))
    misses = jnp.where(turns * fold % QUARTERS == 0, jnp.sum((front - fronts) ** 2, axis=1), jnp.inf)
    return (
        jnp.sum((up - jnp.asarray(UP)) ** 2) + jnp.where(fold > 0, jnp.min(misses), 0) + jnp.sum((origin - centre) ** 2)
    )


def place_error(
    shown_on: DescriptorField,
    offered_to: DescriptorField,
    shown: Float[Array, "box 3"],
    offered: Float[Array, "offers box 3"],
) -> Float[Array, ""]:
    """How badly the descriptors shown at a place of one object choose the same place of another among wrong poses.

    With E_k the descriptor loss (eq. 2) of pose k, the right one first: -log(E_0^-s / sum_k E_k^-s), s = `SHARPNESS`.
    It asks of the energy what imitation asks of it, that its minimum lie at the right pose, and does not depend on the
    energy's unit. A symmetric object has several right poses, and its network takes one of its fronts for the front:
    the best of them counts.
    """
    reference = shown_on.descriptors(shown)
    energy = jnp.mean(jnp.abs(offered_to.descriptors(offered) - reference), axis=(1, 2))
    energy = jnp.concatenate([jnp.min(energy[:QUARTERS], keepdims=True), energy[QUARTERS:]])
    return optax.softmax_cross_entropy_with_integer_labels(-SHARPNESS * jnp.log(energy), jnp.int32(0))


def mean_gradient(params, config: NetworkConfig, *samples):
    """Gradients averaged over a batch of pairs of objects, and the loss and its parts of each.

    On a CPU one pair after the other: a scan that adds up gradients holds one pair's activations at a time, and is
    faster there than `vmap`. Products are of the device's default precision, rounded to 10 bits on some accelerators,
    as the shipped weights of bowls, of bottles and of all three were trained.
    """
    with jax.default_matmul_precision(jax.config.jax_default_matmul_precision or "default"):
        return _mean_gradient(params, config, samples)


def _mean_gradient(params, config, samples):
    def add(total, sample):
        (loss, parts), gradient = jax.value_and_grad(pair_loss, has_aux=True)(params, config, *sample)
        return jax.tree.map(jnp.add, total, gradient), {"loss": loss, **parts}

    if one_at_a_time():
        total, parts = jax.lax.scan(add, jax.tree.map(jnp.zeros_like, params), samples)
        return jax.tree.map(lambda leaf: leaf / len(samples[0]), total), parts

    def mean_loss(params):
        losses, parts = jax.vmap(lambda *sample: pair_loss(params, config, *sample))(*samples)
        return jnp.mean(losses), {"loss": losses, **parts}

    return jax.grad(mean_loss, has_aux=True)(params)
