"""The training loss: of occupancy, of the object's frame in the latent, and of descriptors at corresponding places."""

import functools

import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Float

from tdf_jax._internal.devices import one_at_a_time
from tdf_jax._internal.precision import chosen_precision
from tdf_jax.networks.field import DescriptorField
from tdf_jax.networks.occupancy import NetworkConfig, condition, decode, encode_latent
from tdf_jax.training.batch import QUARTERS

FRAME_WEIGHT = 0.3
PLACE_WEIGHT = 0.1
# Objects are in their canonical frame: up, and the front, which is the side of the handle or a longer side.
UP, FRONT = (0.0, 0.0, 1.0), (1.0, 0.0, 0.0)
# The places' loss is the negative log of the right pose's share, with weights energy^-SHARPNESS.
SHARPNESS = 8.0


def pair_loss(
    params,
    config: NetworkConfig,
    clouds: Float[Array, "2 points 3"],
    queries: Float[Array, "2 queries 3"],
    inside: Float[Array, "2 queries"],
    centres: Float[Array, "2 3"],
    fold: Float[Array, "2"],
    demonstrated: Float[Array, "2 box 3"],
    offered: Float[Array, "2 offers box 3"],
) -> tuple[Float[Array, ""], dict]:
    """Loss of a pair of objects: occupancy, `FRAME_WEIGHT` times the frame error, `PLACE_WEIGHT` times the place error.

    Args:
        params: parameters of the network and the read-outs of the frame, {"network": ..., "frame": (latent, 3)}.
        config: sizes of the network.
        clouds: point clouds, (2, points, 3), metres, canonical axes, relative to their means.
        queries: query points, (2, queries, 3), metres, relative to the clouds' means.
        inside: 1 inside the object, 0 outside, (2, queries).
        centres: origins of the objects' frames, (2, 3), metres, relative to the clouds' means.
        fold: symmetry of the objects, (2,), see `tdf_jax.geometry.symmetry`.
        demonstrated: query points at a place of each object, (2, box, 3); see `tdf_jax.training.batch.Batch`.
        offered: the same query points on the other object, (2, offers, box, 3).

    Returns:
        The loss, and its parts by name, one value for each object.
    """
    fields, losses, parts = _each(
        functools.partial(_object_loss, params, config), clouds, queries, inside, centres, fold
    )
    others = jax.tree.map(lambda leaf: leaf[::-1], fields)
    place = _each(place_error, fields, others, demonstrated, offered)
    return jnp.mean(losses) + PLACE_WEIGHT * jnp.mean(place), parts | {"place": place}


def _each(function, *samples):
    """Map a function over the samples of the objects."""
    return jax.lax.map(lambda sample: function(*sample), samples) if one_at_a_time() else jax.vmap(function)(*samples)


def _object_loss(params, config, cloud, queries, inside, centre, fold):
    """The field of an object, its loss of occupancy and frame, and the parts to report."""
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
    """Squared error of the object's frame that linear read-outs take from a latent: up, front and the frame's origin.

    The three read-outs (`params["frame"]`, (latent, 3)) are used in training only. A vector-neuron network has no bias,
    so it must find the frame in the cloud, and being equivariant it needs no rotated copies for it. Training without
    this term does not find the frame in reasonable time. The mean of a cloud that is seen from one side is not at the
    object's centre, and the origin represents the difference.

    A symmetric object has several equivalent fronts, and the nearest one counts. Without a term for the front, the
    network aligns all vectors of a symmetric object's latent with its axis and represents nothing but shapes of
    revolution. With this term and displaced clouds (`NetworkConfig.symmetry_breaking_offset`), it distinguishes the
    sides. docs/results/training.md has the measurements.

    Args:
        params: parameters, see `pair_loss`.
        latent: latent of a cloud in its canonical axes, (latent, 3).
        centre: origin of the object's frame, (3,), in the network's unit, relative to the cloud's mean.
        fold: symmetry of the object; a round one has no front.
    """
    up, front, origin = params["frame"].T @ latent
    turns = jnp.arange(QUARTERS)
    fronts = jnp.round(jnp.stack([jnp.cos(turns * jnp.pi / 2), jnp.sin(turns * jnp.pi / 2), 0 * turns], axis=1))
    front_errors = jnp.where(turns * fold % QUARTERS == 0, jnp.sum((front - fronts) ** 2, axis=1), jnp.inf)
    front_error = jnp.where(fold > 0, jnp.min(front_errors), 0)
    return jnp.sum((up - jnp.asarray(UP)) ** 2) + front_error + jnp.sum((origin - centre) ** 2)


def place_error(
    demonstrated_on: DescriptorField,
    offered_to: DescriptorField,
    demonstrated: Float[Array, "box 3"],
    offered: Float[Array, "offers box 3"],
) -> Float[Array, ""]:
    """Negative log probability of the right pose of another object's place, by the energies of candidate poses.

    With E_k the descriptor loss (eq. 2) of pose k, the right one first: -log(E_0^-s / sum_k E_k^-s), s = `SHARPNESS`.
    Imitation needs an energy with its minimum at the right pose, which is what this error rewards, and the error does
    not depend on the unit of the energy. A symmetric object has several right poses, and its network takes one of its
    fronts for the front; the right pose of the least energy counts.
    """
    reference = demonstrated_on.descriptors(demonstrated)
    energy = jnp.mean(jnp.abs(offered_to.descriptors(offered) - reference), axis=(1, 2))
    energy = jnp.concatenate([jnp.min(energy[:QUARTERS], keepdims=True), energy[QUARTERS:]])
    return optax.softmax_cross_entropy_with_integer_labels(-SHARPNESS * jnp.log(energy), jnp.int32(0))


def mean_gradient(params, config: NetworkConfig, *samples):
    """Gradients averaged over a batch of pairs of objects, and the loss of every pair and its parts.

    A CPU takes one pair after the other: a scan that accumulates gradients holds the activations of one pair at a time,
    and is faster there than `vmap`. Products have the default precision of the device, which is less than float32 on
    some accelerators; the shipped weights of bowls, of bottles and of all three categories were trained so.
    """
    with jax.default_matmul_precision(chosen_precision() or "default"):
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
