"""The Neural Descriptor Fields occupancy network (`VNNOccNet`, model type "pointnet") in Flax Linen.

The encoder turns a point cloud into a latent of 3-vectors that rotates with the cloud (`encode_latent`). `condition`
folds the latent into the decoder's first layer, and `decode` evaluates occupancy and descriptor activations at points.

Parameter names are those of the published PyTorch checkpoints, except that a `weight` (out, in) is a `kernel` (in, out)
here. A vector feature is a tuple of its three planes, x, y and z, each (points, channels): on a CPU the scalar products
of the vector ReLU then fuse with their neighbours, which a sum over an axis of one array does not do.

References:
    Simeonov et al., Neural Descriptor Fields, 2021; Deng et al., Vector Neurons, 2021.
"""

import dataclasses
import functools
import math
from collections.abc import Mapping
from types import MappingProxyType
from typing import Any, cast

import flax.linen as nn
import jax
import jax.numpy as jnp
from flax.traverse_util import flatten_dict
from jaxtyping import Array, Bool, Float

from tdf_jax._internal import checks
from tdf_jax._internal.deprecation import renamed_fields
from tdf_jax._internal.errors import InputError
from tdf_jax._internal.precision import full_precision
from tdf_jax.networks.vector_neurons import (
    EdgeConvolution,
    VectorLeakyReLU,
    VectorLinear,
    VectorResidualBlock,
    Vectors,
    map_planes,
    vector_dot,
)

NORM_FLOOR = 1e-12  # least norm a descriptor is divided by, as in the original
# Fields of `NetworkConfig` by their names in the release before, in which files and run folders may have them.
FORMER_FIELDS = {"asymmetry": "symmetry_breaking_offset"}


@renamed_fields(**FORMER_FIELDS)
@dataclasses.dataclass(frozen=True)
class NetworkConfig:
    """Sizes of the occupancy network; the defaults are those of the published mug network.

    Attributes:
        latent: number of 3-vectors in the latent.
        vector_hidden: encoder channels inside and between the residual blocks.
        vector_width: encoder channels at a residual block's input, after the pooled mean is appended: twice
            `vector_hidden`, unless there is one block only.
        decoder_width: width of the decoder.
        blocks: residual blocks, in the encoder and in the decoder.
        neighbours: nearest neighbours of an edge feature, the point itself included.
        slope: negative slope of the encoder's vector leaky ReLUs and of the decoder's last activation.
        scaling: factor on all coordinates before the network; the network's unit is 0.1 m.
        symmetry_breaking_offset: displacement of the cloud before the encoder, a share of the vector from the centroid
            to the farthest point, away from that point; 0 as published. An equivariant network cannot tell apart
            directions that a rotation of the object exchanges, and shows such an object as a figure of revolution.
            Displaced, a square bowl has one side that differs from the others.
    """

    latent: int = 256
    vector_hidden: int = 128
    vector_width: int = 256
    decoder_width: int = 256
    blocks: int = 5
    neighbours: int = 20
    slope: float = 0.2
    scaling: float = 10.0
    symmetry_breaking_offset: float = 0.0

    def __post_init__(self):
        for field in dataclasses.fields(self):
            if field.type is int:
                checks.count("NetworkConfig()", field.name, getattr(self, field.name))
        if self.blocks > 1 and self.vector_width != 2 * self.vector_hidden:
            raise InputError(
                f"NetworkConfig(): vector_width is {self.vector_width} and vector_hidden {self.vector_hidden}; "
                "expected twice as wide: hidden channels are joined with their mean from the second block on"
            )
        checks.number("NetworkConfig()", "slope", self.slope)
        checks.positive("NetworkConfig()", "scaling", self.scaling)
        offset = self.symmetry_breaking_offset
        checks.number("NetworkConfig()", "symmetry_breaking_offset", offset, 0, below=1)

    @property
    def channels(self) -> int:
        """Channels of a point descriptor."""
        return 2 * self.latent + 1 + (self.blocks + 1) * self.decoder_width


class Encoder(nn.Module):
    """The vector-neuron PointNet: it maps a centred cloud to a latent that rotates with the cloud, exactly."""

    config: NetworkConfig

    def setup(self):
        """Make the layers, under the published names."""
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
        anchor: Float[Array, "3"] | None = None,
    ) -> Float[Array, "latent 3"]:
        """The latent of a cloud; arguments as those of `encode_latent`."""
        if self.config.symmetry_breaking_offset:
            anchor = farthest_point(points, used) if anchor is None else anchor
            points = points - self.config.symmetry_breaking_offset * anchor
        where = None if used is None else used[:, None]
        x = self.fc_pos(self.conv_pos(points * self.config.scaling, used))
        pooled: Vectors | None = None
        for index in range(self.config.blocks):
            x = getattr(self, f"block_{index}")(x, pooled)
            pooled = map_planes(lambda plane: jnp.mean(plane, axis=0, keepdims=True, where=where), x)
        assert pooled is not None  # a network has at least one block
        return jnp.concatenate(self.fc_c(self.actvn_c(pooled))).T


def farthest_point(points: Float[Array, "points 3"], used: Bool[Array, " points"] | None = None) -> Float[Array, "3"]:
    """The point of a centred cloud, or of its used points, that is farthest from the centroid."""
    squared = jnp.sum(points**2, axis=1)
    return points[jnp.argmax(squared if used is None else jnp.where(used, squared, -1))]


class Affine(nn.Module):
    """A linear map with bias."""

    inputs: int
    outputs: int
    gain: float = 1.0

    def setup(self):
        """Make the parameters."""
        initial = nn.initializers.variance_scaling(self.gain, "fan_in", "normal")
        self.kernel = self.param("kernel", initial, (self.inputs, self.outputs))
        self.bias = self.param("bias", nn.initializers.zeros, (self.outputs,))


class ResidualBlock(nn.Module):
    """Weights of `x + fc_1(relu(fc_0(relu(x))))`, which `decode` evaluates."""

    width: int

    def setup(self):
        """Make the layers, under the published names."""
        self.fc_0 = Affine(self.width, self.width, gain=2.0)
        # A small second layer starts every block near the identity, so that five of them keep the variance of fc_in's
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
        latent: latent z, (latent, 3), in the network's unit (0.1 m).
        invariants: sum over xyz of z * z_in(z), (latent,).
        into: folded `fc_in` of the scaled query point: (square (width,), linear (3, width), bias (width,)).
        blocks: one (kernel, bias, kernel, bias) for every residual block.
        out: `fc_out`, (kernel (width,), bias ()).
        config: sizes of the network.
    """

    latent: Float[Array, "latent 3"]
    invariants: Float[Array, " latent"]
    into: tuple
    blocks: tuple
    out: tuple
    config: NetworkConfig


class Decoder(nn.Module):
    """Weights of the decoder. `condition` folds them onto a latent, and `decode` evaluates the result."""

    config: NetworkConfig

    def setup(self):
        """Make the layers, under the published names."""
        latent, width = self.config.latent, self.config.decoder_width
        self.z_in = VectorLinear(latent, latent)
        self.fc_in = Affine(2 * latent + 1, width)
        for index in range(self.config.blocks):
            setattr(self, f"block{index}", ResidualBlock(width))
        self.fc_out = Affine(width, 1)

    def __call__(self, latent: Float[Array, "latent 3"]) -> Conditioned:
        """The decoder folded onto a latent."""
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
        """Make both parts."""
        self.encoder = Encoder(self.config)
        self.decoder = Decoder(self.config)

    def __call__(self, points: Float[Array, "points 3"]) -> Conditioned:
        """The decoder folded onto the latent of a cloud that is centred on its mean, metres."""
        return self.decoder(self.encoder(points))

    def encode_latent(
        self,
        points: Float[Array, "points 3"],
        used: Bool[Array, " points"] | None = None,
        anchor: Float[Array, "3"] | None = None,
    ) -> Float[Array, "latent 3"]:
        """The latent of a cloud; arguments as those of the function `encode_latent`."""
        return self.encoder(points, used, anchor)

    def condition(self, latent: Float[Array, "latent 3"]) -> Conditioned:
        """The decoder folded onto a latent."""
        return self.decoder(latent)


@full_precision
def encode_latent(
    params,
    config: NetworkConfig,
    points: Float[Array, "points 3"],
    used: Bool[Array, " points"] | None = None,
    anchor: Float[Array, "3"] | None = None,
) -> Float[Array, "latent 3"]:
    """The latent z of a cloud.

    Args:
        params: parameters of the network.
        config: sizes of the network.
        points: point cloud, (points, 3), metres, relative to its mean.
        used: mask of the points that count, (points,); all of them by default.
        anchor: point that `config.symmetry_breaking_offset` displaces the cloud away from, (3,), metres, relative to
            the mean; by default the farthest of the points that count.

    Returns:
        The latent, (latent, 3), in the network's unit; its vectors rotate with the cloud.
    """
    return _applied(params, config, points, used, anchor, method="encode_latent")


@full_precision
def condition(params, config: NetworkConfig, latent: Float[Array, "latent 3"]) -> Conditioned:
    """The decoder of a network folded onto a latent, (latent, 3), from `encode_latent`."""
    return _applied(params, config, latent, method="condition")


def _applied(params, config: NetworkConfig, *arguments, method: str) -> Any:
    return OccupancyNetwork(config).apply({"params": params}, *arguments, method=method)


@full_precision
def decode(conditioned: Conditioned, x: Float[Array, "*batch 3"]) -> tuple[list, Float[Array, "*batch"]]:
    """Evaluate a conditioned decoder.

    Args:
        conditioned: decoder from `condition`.
        x: query points, (..., 3), metres, relative to the cloud's mean.

    Returns:
        The activations that form a descriptor, in its order (|p|^2, z p, invariants, fc_in, blocks), each (..., width),
        and the occupancy logits, (...).
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
    variables = OccupancyNetwork(config).init(key, jnp.zeros((config.neighbours + 1, 3)))
    return cast(dict, variables["params"])


@functools.cache  # it takes a tenth of a second, and every load calls it
def parameter_shapes(config: NetworkConfig) -> Mapping[str, tuple[int, ...]]:
    """Shape of every parameter, by dotted name."""
    shapes = jax.eval_shape(lambda: initialise(jax.random.key(0), config))
    flat = cast(dict[str, jax.ShapeDtypeStruct], flatten_dict(shapes, sep="."))
    return MappingProxyType({name: leaf.shape for name, leaf in flat.items()})


def parameter_count(config: NetworkConfig) -> int:
    """Number of parameters of a network."""
    return sum(math.prod(shape) for shape in parameter_shapes(config).values())
