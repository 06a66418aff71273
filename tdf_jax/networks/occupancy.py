"""The Neural Descriptor Fields occupancy network (`VNNOccNet`, model type "pointnet") in Flax Linen.

A cloud of points becomes a latent of 3-vectors that turns with the cloud (`encode_latent`); the latent, folded into
the decoder's first layer (`condition`), answers points of space with an occupancy and a descriptor (`decode`).

Parameter names are those of the published PyTorch checkpoints, except that a `weight` (out, in) is a `kernel` (in, out)
here. A vector feature is a tuple of its three planes, x, y and z, each (points, channels): on a CPU the scalar products
of the vector ReLU then fuse with their neighbours, 10 times faster than a sum over an axis of one array.

References:
    Simeonov et al., Neural Descriptor Fields, 2021; Deng et al., Vector Neurons, 2021.
"""

import dataclasses
import functools
import math
from collections.abc import Mapping
from types import MappingProxyType

import flax.linen as nn
import jax
import jax.numpy as jnp
from flax.traverse_util import flatten_dict
from jaxtyping import Array, Bool, Float

from tdf_jax._internal.precision import full_precision
from tdf_jax.networks.vector_neurons import (
    EdgeConvolution,
    VectorLeakyReLU,
    VectorLinear,
    VectorResidualBlock,
    farthest,
    map_planes,
    vector_dot,
)

NORM_FLOOR = 1e-12  # least norm a descriptor is divided by, as in the original


@dataclasses.dataclass(frozen=True)
class NetworkConfig:
    """Sizes of the occupancy network; the defaults are the published mug network's (1,757,185 parameters).

    Attributes:
        latent: number of 3-vectors in the latent.
        vector_hidden: encoder channels inside and between the residual blocks.
        vector_width: encoder channels at a residual block's input (after the pooled mean is appended).
        decoder_width: width of the decoder.
        blocks: residual blocks, in the encoder and in the decoder.
        neighbours: nearest neighbours of an edge feature, the point itself included.
        slope: negative slope of the encoder's vector leaky ReLUs and of the decoder's last activation.
        scaling: factor on all coordinates before the network; the network's unit is 0.1 m.
        asymmetry: the encoder sees a cloud displaced by this share of the vector from its mean to its farthest point,
            away from that point; 0 as published. What a rotation leaves as it is, an equivariant network shows as a
            figure of revolution; displaced, a square bowl has a side to begin at.
    """

    latent: int = 256
    vector_hidden: int = 128
    vector_width: int = 256
    decoder_width: int = 256
    blocks: int = 5
    neighbours: int = 20
    slope: float = 0.2
    scaling: float = 10.0
    asymmetry: float = 0.0

    @property
    def channels(self) -> int:
        """Numbers in one point descriptor: 2049 at the default sizes."""
        return 2 * self.latent + 1 + (self.blocks + 1) * self.decoder_width


class Affine(nn.Module):
    """A linear map with bias."""

    inputs: int
    outputs: int
    gain: float = 1.0

    def setup(self):
        initial = nn.initializers.variance_scaling(self.gain, "fan_in", "normal")
        self.kernel = self.param("kernel", initial, (self.inputs, self.outputs))
        self.bias = self.param("bias", nn.initializers.zeros, (self.outputs,))


class ResidualBlock(nn.Module):
    """Weights of `x + fc_1(relu(fc_0(relu(x))))`; `decode` computes it."""

    width: int

    def setup(self):
        self.fc_0 = Affine(self.width, self.width, gain=2.0)
        # A small second layer starts every block near the identity: five of them then keep the variance of fc_in's
        # output.
        self.fc_1 = Affine(self.width, self.width, gain=0.1)


@functools.partial(
    jax.tree_util.register_dataclass,
    data_fields=["latent", "invariants", "into", "blocks", "out"],
    meta_fields=["config"],
)
@dataclasses.dataclass(frozen=True)
class Conditioned:
    """The decoder folded onto one latent: everything that does not depend on the query point is a constant.

    Attributes:
        latent: z, (latent, 3), per 0.1 m.
        invariants: sum over xyz of z * z_in(z), (latent,).
        into: the folded `fc_in`: (square (width,), linear (3, width), bias (width,)) of the scaled query point.
        blocks: per residual block (kernel, bias, kernel, bias).
        out: `fc_out`, (kernel (width,), bias ()).
        config: the network's sizes.
    """

    latent: Float[Array, "latent 3"]
    invariants: Float[Array, " latent"]
    into: tuple
    blocks: tuple
    out: tuple
    config: NetworkConfig


class Decoder(nn.Module):
    """The decoder's weights; `condition` folds them onto a latent and `decode` evaluates the result."""

    config: NetworkConfig

    def setup(self):
        latent, width = self.config.latent, self.config.decoder_width
        self.z_in = VectorLinear(latent, latent)
        self.fc_in = Affine(2 * latent + 1, width)
        for index in range(self.config.blocks):
            setattr(self, f"block{index}", ResidualBlock(width))
        self.fc_out = Affine(width, 1)

    def __call__(self, latent: Float[Array, "latent 3"]) -> Conditioned:
        size = self.config.latent
        planes = tuple(latent.T)
        invariants = vector_dot(planes, self.z_in(planes))
        square, linear, constant = jnp.split(self.fc_in.kernel, [1, 1 + size])
        blocks = [getattr(self, f"block{index}") for index in range(self.config.blocks)]
        return Conditioned(
            latent=latent,
            invariants=invariants,
            into=(square[0], latent.T @ linear, invariants @ constant + self.fc_in.bias),
            blocks=tuple((b.fc_0.kernel, b.fc_0.bias, b.fc_1.kernel, b.fc_1.bias) for b in blocks),
            out=(self.fc_out.kernel[:, 0], self.fc_out.bias[0]),
            config=self.config,
        )


class OccupancyNetwork(nn.Module):
    """Encoder and decoder under the published checkpoints' names."""

    config: NetworkConfig = NetworkConfig()

    def setup(self):
        self.encoder = Encoder(self.config)
        self.decoder = Decoder(self.config)

    def __call__(self, points: Float[Array, "points 3"]) -> Conditioned:
        """Args: points, centred, in metres."""
        return self.decoder(self.encoder(points))

    def encode_latent(
        self,
        points: Float[Array, "points 3"],
        used: Bool[Array, " points"] | None = None,
        tip: Float[Array, "3"] | None = None,
    ) -> Float[Array, "latent 3"]:
        return self.encoder(points, used, tip)

    def condition(self, latent: Float[Array, "latent 3"]) -> Conditioned:
        return self.decoder(latent)


@full_precision
def encode_latent(
    params,
    config: NetworkConfig,
    points: Float[Array, "points 3"],
    used: Bool[Array, " points"] | None = None,
    tip: Float[Array, "3"] | None = None,
) -> Float[Array, "latent 3"]:
    """The latent z of a cloud.

    Args:
        params: of the network.
        config: its sizes.
        points: centred on their mean, metres.
        used: which of them count; all by default.
        tip: where `config.asymmetry` takes the farthest point to be, relative to the mean; by default the farthest of
            those that count.
    """
    return OccupancyNetwork(config).apply({"params": params}, points, used, tip, method="encode_latent")


@full_precision
def condition(params, config: NetworkConfig, latent: Float[Array, "latent 3"]) -> Conditioned:
    """The decoder folded onto a latent."""
    return OccupancyNetwork(config).apply({"params": params}, latent, method="condition")


@full_precision
def decode(conditioned: Conditioned, x: Float[Array, "*batch 3"]) -> tuple[list, Float[Array, "*batch"]]:
    """Evaluate a conditioned decoder.

    Args:
        conditioned: from `condition`.
        x: query points relative to the cloud's mean, metres.

    Returns:
        The activations a descriptor is made of, in its order (|p|^2, z p, invariants, fc_in, blocks), each (*batch,
        width), and the occupancy logits (*batch,).
    """
    p = x * conditioned.config.scaling
    square = jnp.sum(p * p, axis=-1, keepdims=True)
    invariants = jnp.broadcast_to(conditioned.invariants, p.shape[:-1] + conditioned.invariants.shape)
    into_square, into_linear, into_bias = conditioned.into
    h = square * into_square + p @ into_linear + into_bias
    activations = [square, p @ conditioned.latent.T, invariants, h]
    for kernel_0, bias_0, kernel_1, bias_1 in conditioned.blocks:
        h = h + nn.relu(nn.relu(h) @ kernel_0 + bias_0) @ kernel_1 + bias_1
        activations.append(h)
    kernel, bias = conditioned.out
    return activations, nn.leaky_relu(h, conditioned.config.slope) @ kernel + bias


def initialise(key, config: NetworkConfig = NetworkConfig()) -> dict:
    """Random parameters, as nested dictionaries under the published names."""
    return OccupancyNetwork(config).init(key, jnp.zeros((config.neighbours + 1, 3)))["params"]


@functools.cache  # a tenth of a second, and every load asks for it
def parameter_shapes(config: NetworkConfig) -> Mapping[str, tuple[int, ...]]:
    """Shape of every parameter, by dotted name."""
    shapes = jax.eval_shape(lambda: initialise(jax.random.key(0), config))
    return MappingProxyType({name: leaf.shape for name, leaf in flatten_dict(shapes, sep=".").items()})


def parameter_count(config: NetworkConfig) -> int:
    return sum(math.prod(shape) for shape in parameter_shapes(config).values())


class Encoder(nn.Module):
    """The vector-neuron PointNet: a centred cloud -> a latent that turns with it, exactly."""

    config: NetworkConfig

    def setup(self):
        config = self.config
        hidden, width = config.vector_hidden, config.vector_width
        self.conv_pos = EdgeConvolution(hidden, config.neighbours, config.slope)
        self.fc_pos = VectorLinear(hidden, width)
        for index in range(config.blocks):
            setattr(self, f"block_{index}", VectorResidualBlock(width, hidden, config.slope))
        self.actvn_c = VectorLeakyReLU(hidden, config.slope)
        self.fc_c = VectorLinear(hidden, config.latent)

    def __call__(
        self,
        points: Float[Array, "points 3"],
        used: Bool[Array, " points"] | None = None,
        tip: Float[Array, "3"] | None = None,
    ) -> Float[Array, "latent 3"]:
        if self.config.asymmetry:
            points = points - self.config.asymmetry * (farthest(points, used) if tip is None else tip)
        where = None if used is None else used[:, None]
        x, pooled = self.fc_pos(self.conv_pos(points * self.config.scaling, used)), None
        for index in range(self.config.blocks):
            x = getattr(self, f"block_{index}")(x, pooled)
            pooled = map_planes(lambda plane: jnp.mean(plane, axis=0, keepdims=True, where=where), x)
        return jnp.concatenate(self.fc_c(self.actvn_c(pooled))).T
