"""What training minimises: binary cross-entropy of occupancy, and the frame the latent must carry."""

import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Float

from tdf_jax.network import NetworkConfig, condition, decode, encode_latent

FRAME_WEIGHT = 0.3
# Generated mugs come in a canonical frame: up, and the handle's side.
FRAME_AXES = ((0.0, 0.0, 1.0), (1.0, 0.0, 0.0))


def sample_loss(
    params,
    config: NetworkConfig,
    cloud: Float[Array, "points 3"],
    queries: Float[Array, "queries 3"],
    inside: Float[Array, "queries"],
) -> tuple[Float[Array, ""], dict]:
    """Loss of one object: mean binary cross-entropy plus `FRAME_WEIGHT` times the frame's squared error.

    Two linear read-outs of the latent (`params["frame"]`, used in training only) are asked to equal the object's canonical axes. A
    vector-neuron network has no bias, so it must find the frame in the cloud, and being equivariant it needs no
    rotated copies for it. Without this term, an early
    trial could not match an object with itself after 500 steps; with it, the frame is found within 200.

    Args:
        params: {"network": ..., "frame": (latent, 2)}.
        config: sizes of the network.
        cloud: centred, canonical orientation, metres.
        queries: relative to the cloud's mean, metres.
        inside: 1 inside the object, 0 outside.

    Returns:
        The loss, and its parts by name.
    """
    latent = encode_latent(params["network"], config, cloud)
    _, logits = decode(condition(params["network"], config, latent), queries)
    cross_entropy = jnp.mean(optax.sigmoid_binary_cross_entropy(logits, inside))
    frame = frame_error(params, latent)
    occupied, truth = logits > 0, inside > 0.5
    parts = {
        "bce": cross_entropy,
        "frame": frame,
        "intersection": jnp.sum(occupied & truth).astype(float),
        "union": jnp.sum(occupied | truth).astype(float),
    }
    return cross_entropy + FRAME_WEIGHT * frame, parts


def frame_error(params, latent: Float[Array, "latent 3"]) -> Float[Array, ""]:
    """Squared error of the axes read out of a latent, summed over axes; 2 for a network that predicts nothing."""
    return jnp.sum((params["frame"].T @ latent - jnp.asarray(FRAME_AXES)) ** 2)


def mean_gradient(params, config: NetworkConfig, clouds, queries, inside):
    """Loss parts and gradients averaged over a batch, one object after the other.

    A scan that adds up gradients holds one object's activations at a time, and is faster on a CPU than `vmap`.
    """

    def add(total, sample):
        (loss, parts), gradient = jax.value_and_grad(sample_loss, has_aux=True)(params, config, *sample)
        return jax.tree.map(jnp.add, total, gradient), {"loss": loss, **parts}

    zero = jax.tree.map(jnp.zeros_like, params)
    total, parts = jax.lax.scan(add, zero, (clouds, queries, inside))
    return jax.tree.map(lambda leaf: leaf / len(clouds), total), parts
