"""From a point cloud to the field of one object."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from tdf_jax._internal import checks
from tdf_jax._internal.errors import InputError
from tdf_jax._internal.precision import full_precision
from tdf_jax.geometry import sampling
from tdf_jax.networks.field import DescriptorField
from tdf_jax.networks.model import Model
from tdf_jax.networks.occupancy import condition, encode_latent

CENTRED = 1e-7  # of a cloud's extent: a mean this near zero is float32's rounding
ROOM = 250  # clouds that are not thinned are filled up to a multiple, which common sizes are already
THINNINGS = 8  # 16 gain another 0.003 of IoU
# radians; latents of one mug's thinnings are turned against each other by 1 to 2 degrees, those of symmetric objects by
# 60 to 90 on average
SAME_SIDE = np.pi / 6


def encode(model: Model, points: Float[Array, "points 3"], thinnings: int = THINNINGS) -> DescriptorField:
    """Encode an object's point cloud into its descriptor field.

    A network knows clouds of one density (`model.info.cloud_points`): with twice as many points the shipped weights'
    IoU falls from 0.85 to 0.24. A denser cloud is therefore thinned by farthest points, several times, and the latents
    are averaged: each thinning is another sample of the surface, and eight of them raise the IoU by about 0.03 over
    one. Where the density is not known, as of converted weights, and where the cloud is no denser, all points are used
    as they are.

    Args:
        model: the network.
        points: at least 21, metres, world frame.
        thinnings: how many are averaged, see `sampling.thinnings`; 0 uses all points as they are.

    Returns:
        The field, in the world frame. It moves and turns with the points but for ties that rounding decides: in
        thinning, and, of a network with asymmetry, in which point is the farthest from the mean.

    Raises:
        InputError: the points are fewer than 21 or than the network's neighbours, not (points, 3), not finite or all
            equal; thinnings is negative, or the points would be thinned under `jax.jit`.
    """
    points, count = checks.points("encode()", points), model.info.cloud_points
    if not isinstance(thinnings, int | np.integer) or thinnings < 0:
        raise InputError(f"encode(): thinnings is {thinnings}; expected a whole number of 0 or more")
    if len(points) < model.config.neighbours:
        raise InputError(
            f"encode(): there are {len(points)} points; expected at least the network's {model.config.neighbours} neighbours"
        )
    plain = not thinnings or count is None
    dense = not plain and len(points) > count
    traced = isinstance(points, jax.core.Tracer)
    whole = points if traced else np.asarray(points)
    # One for all thinnings, which then take the same side of a symmetric object for its front.
    tip = whole[((whole - whole.mean(axis=0)) ** 2).sum(axis=1).argmax()]
    if traced and dense:
        raise InputError(
            f"encode(): {len(points)} points cannot be thinned to {count} under jax.jit; expected that many. "
            "Thin the cloud outside with tdf.thin, or pass thinnings=0"
        )
    clouds = sampling.thinnings(whole, count, thinnings) if dense else points[None]
    if traced or any(isinstance(leaf, jax.core.Tracer) for leaf in jax.tree.leaves(model.params)):
        return _average(model.params, model.config, clouds, tip)
    several, size = clouds.shape[:2]
    # Filled up with clouds and points that do not count: clouds of many sizes run one program.
    room = (1, -(-size // ROOM) * ROOM) if plain else (thinnings, count)
    return _encode(model.params, model.config, np.resize(clouds, (*room, 3)), np.int32(several), np.int32(size), tip)


@functools.partial(jax.jit, static_argnames="config")
def _encode(params, config, clouds, several, size, tip):
    """The field of the first `several` clouds, averaged, of each of which the first `size` points count; the others are repetitions."""
    used = jnp.arange(clouds.shape[1]) < size

    def fill(index, state):
        return jax.tree.map(
            lambda all, one: all.at[index].set(one), state, _latent(params, config, clouds[index], tip, used)
        )

    def add(index, sums):
        return jax.tree.map(lambda sum, all: sum + jnp.where(agreed[index], all[index], 0), sums, (latents, origins))

    dtype = jnp.result_type(clouds, *jax.tree.leaves(params))
    blank = jnp.zeros((len(clouds), config.latent, 3), dtype), jnp.zeros((len(clouds), 3), clouds.dtype)
    latents, origins = jax.lax.fori_loop(0, several, fill, blank)
    agreed = agreeing(latents, jnp.arange(len(clouds)) < several)
    sums = jax.lax.fori_loop(0, several, add, jax.tree.map(lambda all: jnp.zeros_like(all[0]), blank))
    latent, origin = (part / jnp.sum(agreed) for part in sums)
    return DescriptorField(condition(params, config, latent), origin)


@functools.partial(jax.jit, static_argnames="config")
def _average(params, config, clouds, tip):
    """The same of all points of all clouds, without a loop of unknown length, which has no reverse-mode derivative."""
    latents, origins = jax.lax.map(lambda points: _latent(params, config, points, tip), clouds)
    agreed = agreeing(jax.lax.stop_gradient(latents), jnp.ones(len(clouds), bool))
    latent, origin = (jnp.mean(all, axis=0, where=agreed[:, *[None] * (all.ndim - 1)]) for all in (latents, origins))
    return DescriptorField(condition(params, config, latent), origin)


@full_precision
def agreeing(latents: Float[Array, "thinnings latent 3"], used: Bool[Array, " thinnings"]) -> Bool[Array, " thinnings"]:
    """Which latents of one object show it in the same of several poses that it cannot be told apart in.

    Thinned this way or that, a symmetric object looks a little more like one of the poses its symmetry makes equal or
    like another, and the network decides for one of them: a flat bottle's two sides change places, a round one is
    turned about its axis. The mean of such latents is the latent of none of them: of round bottles it had an IoU of
    0.87, each alone 0.93. Two latents agree if a rotation would bring them no nearer than to half of their squared
    distance, or turns by less than `SAME_SIDE`; those that agree with the one that most others agree with are kept, of
    an object without symmetry all.

    Args:
        latents: of thinnings of one cloud.
        used: those that count.

    Source:
        The best rotation is Kabsch's, Acta Crystallographica A, 1976.
    """
    cross = jnp.einsum("aci,bcj->abij", latents, latents)
    u, values, v = jnp.linalg.svd(cross)
    sign = jnp.linalg.det(u) * jnp.linalg.det(v)
    proper = jnp.stack([jnp.ones_like(sign), jnp.ones_like(sign), sign], axis=-1)
    squares = jnp.sum(latents**2, axis=(1, 2))
    total = squares[:, None] + squares
    apart = total - 2 * jnp.trace(cross, axis1=-2, axis2=-1)
    aligned = total - 2 * jnp.sum(proper * values, axis=-1)
    cosine = (jnp.einsum("abik,abk,abki->ab", u, proper, v) - 1) / 2
    agree = ((apart <= 2 * aligned) | (cosine >= jnp.cos(SAME_SIDE))) & used & used[:, None]
    return agree[jnp.argmax(jnp.sum(agree, axis=1))]


def _latent(params, config, points, tip, used=None):
    """Latent and origin of a cloud with a farthest point `tip`, or of the part of it that is used."""
    origin = jnp.mean(points, axis=0, where=None if used is None else used[:, None])
    # A cloud that was centred in float32 has a mean of about 1e-9 m left. Centring it again in float64 moves the latent
    # by 1e-6 of its length, so it counts as centred: parity with the original, which leaves centring to the caller, is
    # then exact.
    origin = jnp.where(jnp.max(jnp.abs(origin)) <= CENTRED * jnp.max(jnp.ptp(points, axis=0)), 0.0, origin)
    return encode_latent(params, config, points - origin, used, tip - origin), origin
