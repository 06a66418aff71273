"""The descriptor field of one object: an occupancy and a descriptor at every point of space."""

import dataclasses
import functools
from collections.abc import Sequence
from typing import Any, cast

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from tdf_jax._internal import checks
from tdf_jax._internal.boundary import public
from tdf_jax.networks.occupancy import NORM_FLOOR, Conditioned, decode


@functools.partial(jax.tree_util.register_dataclass, data_fields=["conditioned", "origin"], meta_fields=[])
@dataclasses.dataclass(frozen=True)
class DescriptorField:
    """f(x | P) of Neural Descriptor Fields: a conditioned decoder and the position of its object.

    Attributes:
        conditioned: decoder folded onto the object's latent.
        origin: centroid of the encoded points, (3,), metres, world frame. The object frame has its origin there and the
            axes of the world.
    """

    conditioned: Conditioned
    origin: Float[Array, "3"]

    @property
    def latent(self) -> Float[Array, "latent 3"]:
        """The latent z; its vectors rotate with the cloud."""
        return self.conditioned.latent

    @public
    def descriptors(self, x: Float[Array, "*batch 3"]) -> Float[Array, "*batch channels"]:
        """Point descriptors, of unit length.

        Args:
            x: points, (..., 3), metres, world frame.
        """
        activations, _ = self._decode("descriptors", x)
        descriptor = jnp.concatenate(activations, axis=-1)
        # In a trained network |p|^2 and fc_in are never zero at the same point, so the square root is differentiable.
        return descriptor / jnp.maximum(jnp.sqrt(jnp.sum(descriptor**2, axis=-1, keepdims=True)), NORM_FLOOR)

    @public
    def occupancy(self, x: Float[Array, "*batch 3"]) -> Float[Array, "*batch"]:
        """Probability that points lie inside the object, in [0, 1].

        Args:
            x: points, (..., 3), metres, world frame.
        """
        return jax.nn.sigmoid(self._decode("occupancy", x)[1])

    def _decode(self, function, x):
        x = checks.positions(f"DescriptorField.{function}()", "x", x)
        return decode(self.conditioned, x - self.origin)


def with_decoder_of(field: DescriptorField, other: DescriptorField) -> DescriptorField:
    """A field that holds the decoder's weights of another one of the same network, and not its own copy of them."""
    own, shared = field.conditioned, other.conditioned
    into = (shared.into[0], *own.into[1:])
    return DescriptorField(dataclasses.replace(own, into=into, blocks=shared.blocks, out=shared.out), field.origin)


def stacked(fields: Sequence[DescriptorField]) -> DescriptorField:
    """Stack fields of one network along a first axis, but for the decoder's weights, which they share."""
    first = fields[0].conditioned
    parts = [(one.conditioned.latent, one.conditioned.invariants, *one.conditioned.into[1:]) for one in fields]
    latent, invariants, linear, bias = (jnp.stack(part) for part in zip(*parts, strict=True))
    whole = dataclasses.replace(first, latent=latent, invariants=invariants, into=(first.into[0], linear, bias))
    return DescriptorField(whole, jnp.stack([field.origin for field in fields]))


def stacked_axes(field: DescriptorField) -> DescriptorField:
    """The argument `in_axes` of `jax.vmap` for a field that `stacked` made."""
    axes: Any = {"latent": 0, "invariants": 0, "into": (None, 0, 0), "blocks": None, "out": None}
    return DescriptorField(dataclasses.replace(field.conditioned, **axes), cast(Any, 0))
