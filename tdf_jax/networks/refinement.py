"""Refinement of a field's shape: gradient steps on its latent fit its surface to the object's points."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from tdf_jax._internal import checks
from tdf_jax._internal.boundary import public
from tdf_jax._internal.errors import InputError
from tdf_jax.networks.field import DescriptorField
from tdf_jax.networks.model import Model
from tdf_jax.networks.occupancy import condition, decode

POINTS = 1500  # points that are used; clouds of all sizes are resized to it and run one program
# Length of the first step, of the latent's root mean square vector. Twice as much fits the noise of 2 mm, six times as
# much destroys the shape.
RATE = 0.003
DECAYS = 0.9, 0.999  # decay rates of Adam's moments


@public
def refine(model: Model, field: DescriptorField, points: Float[Array, "points 3"], steps: int = 40) -> DescriptorField:
    """Fit the shape of a field to the points of its object.

    The encoder sees a few hundred points of an object at a time, which bounds the accuracy of the encoded surface.
    `refine` lowers the mean of (occupancy - 1/2)^2 over up to 1500 points by gradient steps on the latent; the weights
    of the network do not change. It improves shapes, as for reconstruction and clearance. Poses that are found with a
    refined field hardly differ (docs/results/evaluation.md). It has no reverse-mode derivative.

    Args:
        model: network that encoded the field.
        field: descriptor field of the object.
        points: point cloud of the object, the encoded one or a denser one, (points, 3), metres, world frame; 1500
            random ones of more are used, drawn with a fixed seed.
        steps: number of gradient steps; 0 changes nothing.

    Returns:
        The refined field, with the same origin. It rotates with the points and the field.

    Raises:
        InputError: the points are not valid for `encode`, or traced by `jax.jit`; `steps` is negative; or the field is
            from a network of other sizes.

    Source:
        The steps are VectorAdam's, which normalises vectors and not coordinates and so is rotation-equivariant: Ling,
        Sharp and Jacobson, NeurIPS 2022. Fitting a latent to observations follows DeepSDF: Park et al., CVPR 2019.
    """
    cloud = checks.points("refine()", points)
    if checks.traced(cloud):
        raise InputError(
            "refine(): the points are traced by jax.jit; expected an array. Call refine() outside jax.jit: it compiles "
            "its own loop"
        )
    cloud = np.asarray(cloud)
    steps = checks.count("refine()", "steps", steps, 0)
    if field.conditioned.config != model.config:
        raise InputError("refine(): the field is from a network of other sizes; expected the model that encoded it")
    if len(cloud) > POINTS:
        cloud = cloud[np.random.default_rng(0).permutation(len(cloud))[:POINTS]]
    weights = (np.arange(POINTS) < len(cloud)).astype(cloud.dtype) / len(cloud)
    x = np.resize(cloud, (POINTS, 3)) - field.origin
    conditioned = _refine(model.params, model.config, field.latent, x, weights, steps)
    return DescriptorField(conditioned, field.origin)


@functools.partial(jax.jit, static_argnames="config")
def _refine(params, config, latent, x, weights, steps):
    size = jnp.sqrt(jnp.mean(jnp.sum(latent**2, axis=-1)))

    def surface_error(latent):
        occupancy = jax.nn.sigmoid(decode(condition(params, config, latent), x)[1])
        return jnp.sum(weights * (occupancy - 0.5) ** 2)

    def step(i, state):
        latent, first, second = state
        gradient = jax.grad(surface_error)(latent)
        first = DECAYS[0] * first + (1 - DECAYS[0]) * gradient
        second = DECAYS[1] * second + (1 - DECAYS[1]) * jnp.sum(gradient**2, axis=-1, keepdims=True)
        mean, square = first / (1 - DECAYS[0] ** (i + 1)), second / (1 - DECAYS[1] ** (i + 1))
        rate = RATE * size * 0.5 * (1 + jnp.cos(jnp.pi * i / steps))
        # A vector that the occupancies do not depend on has moments of zero.
        return latent - rate * mean / jnp.maximum(jnp.sqrt(square), 1e-20), first, second

    latent, _, _ = jax.lax.fori_loop(0, steps, step, (latent, jnp.zeros_like(latent), jnp.zeros_like(latent[:, :1])))
    return condition(params, config, latent)
