"""Refinement of a field's shape: the latent is moved so that the object's points come nearer to the surface of occupancy 0.5."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from tdf_jax._internal import checks
from tdf_jax._internal.errors import InputError
from tdf_jax.networks.field import DescriptorField
from tdf_jax.networks.model import Model
from tdf_jax.networks.occupancy import condition, decode

POINTS = 1500  # of the cloud that are used: one size, so that clouds of all sizes run one program
# length of the first step, of the latent's root mean square vector; twice as much fits the noise of 2 mm, six times
# destroys the shape
RATE = 0.003
DECAYS = 0.9, 0.999  # of the moments, Adam's


def refine(model: Model, field: DescriptorField, points: Float[Array, "points 3"], steps: int = 40) -> DescriptorField:
    """Move a field's latent so that the points of its object come to its surface.

    The encoder sees a few hundred of an object's points at a time and knows its surface from them to a few millimetres.
    The mean of (occupancy - 1/2)^2 over up to 1500 points, lowered by gradient steps on the latent with the network as
    it is, adds what the others say. It is for shapes: reconstruction, clearance. Poses found with a refined field are
    hardly other ones (docs/results/evaluation.md). It has no reverse-mode derivative.

    Args:
        model: the network that encoded the field.
        field: the object's.
        points: its cloud, the same or a denser one, metres, world frame; of more than 1500, as many drawn by a fixed
            seed are used.
        steps: gradient steps; 0 changes nothing.

    Returns:
        The field, its origin unchanged; it turns with the points as the field that came in does.

    Raises:
        InputError: the points are not as for `encode`, or traced by `jax.jit`; steps is negative; the field is that of
            a network of other sizes.

    Source:
        Steps are VectorAdam's, of one length for the three numbers of a vector, so that they turn with the cloud: Ling,
        Sharp and Jacobson, NeurIPS 2022. Fitting a latent to observations is as in DeepSDF: Park et al., CVPR 2019.
    """
    points = checks.points("refine()", points)
    if isinstance(points, jax.core.Tracer):
        raise InputError(
            "refine(): the points are traced by jax.jit; expected an array. Call refine() outside: it is compiled already"
        )
    points = np.asarray(points)
    if not isinstance(steps, int | np.integer) or isinstance(steps, bool) or steps < 0:
        raise InputError(f"refine(): steps is {steps!r}; expected a whole number of 0 or more")
    if field.conditioned.config != model.config:
        raise InputError("refine(): the field is that of a network of other sizes; expected the model that encoded it")
    if len(points) > POINTS:
        points = points[np.random.default_rng(0).permutation(len(points))[:POINTS]]
    weights = (np.arange(POINTS) < len(points)).astype(points.dtype) / len(points)
    conditioned = _refine(
        model.params, model.config, field.latent, np.resize(points, (POINTS, 3)) - field.origin, weights, steps
    )
    return DescriptorField(conditioned, field.origin)


@functools.partial(jax.jit, static_argnames="config")
def _refine(params, config, latent, x, weights, steps):
    size = jnp.sqrt(jnp.mean(jnp.sum(latent**2, axis=-1)))

    def miss(latent):
        occupancy = jax.nn.sigmoid(decode(condition(params, config, latent), x)[1])
        return jnp.sum(weights * (occupancy - 0.5) ** 2)

    def step(i, state):
        latent, first, second = state
        gradient = jax.grad(miss)(latent)
        first = DECAYS[0] * first + (1 - DECAYS[0]) * gradient
        second = DECAYS[1] * second + (1 - DECAYS[1]) * jnp.sum(gradient**2, axis=-1, keepdims=True)
        mean, square = first / (1 - DECAYS[0] ** (i + 1)), second / (1 - DECAYS[1] ** (i + 1))
        rate = RATE * size * 0.5 * (1 + jnp.cos(jnp.pi * i / steps))
        # A vector that the occupancies do not depend on has moments of zero.
        return latent - rate * mean / jnp.maximum(jnp.sqrt(square), 1e-20), first, second

    latent, _, _ = jax.lax.fori_loop(0, steps, step, (latent, jnp.zeros_like(latent), jnp.zeros_like(latent[:, :1])))
    return condition(params, config, latent)
