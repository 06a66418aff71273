"""The Neural Descriptor Fields occupancy network (`VNNOccNet`, model type "pointnet") in Flax Linen.

A cloud of points becomes a latent of 3-vectors that turns with the cloud (`encode_latent`); the latent, folded into
the decoder's first layer (`condition`), answers points of space with an occupancy and a descriptor (`decode`).

Parameter names are those of the published PyTorch checkpoints, except that a `weight` (out, in) is a `kernel`
(in, out) here. A vector feature is a tuple of its three planes, x, y and z, each (points, channels): on a CPU the scalar
products of the vector ReLU then fuse with their neighbours, 10 times faster than a sum over an axis of one array.

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

Vectors = tuple[Float[Array, "points channels"], Float[Array, "points channels"], Float[Array, "points channels"]]

VECTOR_EPSILON = 1e-6  # added to |d|^2 in the vector leaky ReLU, as in the original
NORM_FLOOR = 1e-12  # least norm a descriptor is divided by, as in the original
NEIGHBOUR_ROWS = 2048  # points whose distances to all others exist at a time


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
        asymmetry: the encoder sees a cloud displaced by this share of the vector from its mean to its farthest point, away from that point; 0 as published. What a rotation leaves
            as it is, an equivariant network shows as a figure of revolution; displaced, a square bowl has a side to begin at.
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


class VectorMap(nn.Module):
    """A linear map of vector channels; no bias, so it commutes with rotations."""

    inputs: int
    outputs: int

    def setup(self):
        # Standard deviation 1/sqrt(inputs) keeps the variance from layer to layer. PyTorch's default is smaller by sqrt(3);
        # through the encoder's depth that starts the latent at rms 1e-4, and the decoder then sees nothing but |p|^2.
        self.kernel = self.param("kernel", nn.initializers.lecun_normal(), (self.inputs, self.outputs))

    def __call__(self, x: Vectors) -> Vectors:
        return _map(lambda plane: plane @ self.kernel, x)


def _dot(a, b):
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def _cross(a, b):
    return (a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0])


def _map(function, *planes):
    return tuple(function(*plane) for plane in zip(*planes))


def _reflection(inner, squared, slope):
    """Coefficient of the direction in a vector leaky ReLU, from <x,d> and |d|^2."""
    return jnp.minimum(inner, 0.0) * ((1.0 - slope) / (squared + VECTOR_EPSILON))


def _reflect(x, direction, slope):
    """Vector leaky ReLU: `x` where <x,d> >= 0, else `x` less (1 - slope) of its part along `d`."""
    coefficient = _reflection(_dot(x, direction), _dot(direction, direction), slope)
    return _map(lambda a, d: a - coefficient * d, x, direction)


class VectorLinear(nn.Module):
    """`VectorMap` under the name the published checkpoints give it."""

    inputs: int
    outputs: int

    def setup(self):
        self.map_to_feat = VectorMap(self.inputs, self.outputs)

    def __call__(self, x):
        return self.map_to_feat(x)


class VectorLeakyReLU(nn.Module):
    """Vector leaky ReLU with a learned direction for every channel."""

    channels: int
    slope: float

    def setup(self):
        self.map_to_dir = VectorMap(self.channels, self.channels)

    def __call__(self, x):
        return _reflect(x, self.map_to_dir(x), self.slope)


class EdgeConvolution(nn.Module):
    """Edge features of the nearest neighbours, a vector linear map, a vector leaky ReLU and the mean over neighbours.

    The edge features of a neighbour are e = neighbour - x, x, and c = neighbour x x = e x x. The (points, neighbours,
    3, channels) activations are never formed: <feature,d> and |d|^2 are linear in the scalar products of (e, x, c),
    of which only four differ from zero (c is normal to e and x), and the mean over neighbours needs only the mean of s and of
    s e, s being the reflection's coefficient: the mean of s x is (mean s) x, that of s c is (mean s e) x x.
    Equal to the plain form to rounding, and without its memory.
    """

    channels: int
    neighbours: int
    slope: float

    def setup(self):
        self.map_to_feat = VectorMap(3, self.channels)
        self.map_to_dir = VectorMap(3, self.channels)

    def __call__(self, points: Float[Array, "points 3"], used: Bool[Array, "points"] | None = None) -> Vectors:
        kernels = self.map_to_feat.kernel, self.map_to_dir.kernel
        # Promoted first: products of float32 kernels would round away what float64 points ask for.
        feature, direction = (kernel.astype(jnp.promote_types(kernel.dtype, points.dtype)) for kernel in kernels)
        own = tuple(points.T)  # planes (points,)
        spread = _map(lambda plane: plane[:, None], own)
        neighbours = points[nearest_neighbours(points, self.neighbours, used)]
        edge = _map(lambda a, x: a - x, tuple(jnp.moveaxis(neighbours, -1, 0)), spread)  # planes (points, neighbours)
        cross = _cross(edge, spread)
        products = _dot(edge, edge), _dot(edge, spread), _dot(spread, spread), _dot(cross, cross)
        # Four terms written out, not a matrix product, which is not fused with what follows: 5 ms for 1500 points instead of 16.
        inner, squared = (
            sum(product[:, :, None] * weight for product, weight in zip(products, _bilinear(kernel, direction)))
            for kernel in (feature, direction)
        )
        reflection = _reflection(inner, squared, self.slope)  # (points, neighbours, channels)

        mean_reflection = jnp.mean(reflection, axis=1)
        mean_reflected_edge = _map(lambda e: jnp.mean(e[:, :, None] * reflection, axis=1), edge)
        mean_edge = _map(lambda e: jnp.mean(e, axis=1), edge)
        features = zip(mean_edge, own, _cross(mean_edge, own))
        linear = tuple(jnp.stack(feature_planes, axis=-1) @ feature for feature_planes in features)
        reflected_cross = _cross(mean_reflected_edge, spread)
        return _map(
            lambda x, e, o, c: x - e * direction[0] - o * mean_reflection * direction[1] - c * direction[2],
            *(linear, mean_reflected_edge, spread, reflected_cross),
        )


def _bilinear(a, b):
    """Weights of (e.e, e.x, x.x, c.c) in <f a, f b>, with f = (e, x, c)."""
    return a[0] * b[0], a[0] * b[1] + a[1] * b[0], a[1] * b[1], a[2] * b[2]


def nearest_neighbours(points: Float[Array, "points 3"], count: int, used: Bool[Array, "points"] | None = None):
    """Indices (points, count) of the nearest points, or of those used, by Euclidean distance, the point itself included."""
    points = jax.lax.stop_gradient(points)

    def nearest(x):
        # Differences, not |a|^2 + |b|^2 - 2ab: in float32 the latter misorders near neighbours of a cloud far from zero.
        squared = sum((points[:, axis] - x[axis]) ** 2 for axis in range(3))
        squared = squared if used is None else jnp.where(used, squared, jnp.inf)
        return jax.lax.top_k(-squared, count)[1]

    # In blocks, for all distances of a dense cloud do not fit: 6 GB at 40,000 points.
    return jax.lax.map(nearest, points, batch_size=NEIGHBOUR_ROWS)


def farthest(points: Float[Array, "points 3"], used: Bool[Array, "points"] | None = None) -> Float[Array, "3"]:
    """The point of a centred cloud, or of those used, that is farthest from its mean."""
    squared = jnp.sum(points**2, axis=1)
    return points[jnp.argmax(squared if used is None else jnp.where(used, squared, -1))]


class VectorResidualBlock(nn.Module):
    """`shortcut(x) + fc_1(act_1(fc_0(act_0(x))))` on vector channels."""

    inputs: int
    outputs: int
    slope: float

    def setup(self):
        self.actvn_0 = VectorLeakyReLU(self.inputs, self.slope)
        self.fc_0 = VectorLinear(self.inputs, self.outputs)
        self.actvn_1 = VectorLeakyReLU(self.outputs, self.slope)
        self.fc_1 = VectorLinear(self.outputs, self.outputs)
        self.shortcut = VectorLinear(self.inputs, self.outputs)

    def __call__(self, x: Vectors, pooled: Vectors | None = None) -> Vectors:
        """Args: x, and `pooled`, one point's channels to append to every point's, or None."""
        # What is linear in the pooled half is computed once, not once for every point: 651,000 multiply-adds
        # a point and axis instead of 847,000.
        direction = _split_map(self.actvn_0.map_to_dir, x, pooled)
        shortcut = _split_map(self.shortcut.map_to_feat, x, pooled)
        if pooled is not None:
            x = _map(lambda a, b: jnp.concatenate([a, jnp.broadcast_to(b, a.shape[:1] + b.shape[1:])], axis=-1), x, pooled)
        hidden = self.fc_1(self.actvn_1(self.fc_0(_reflect(x, direction, self.slope))))
        return _map(jnp.add, shortcut, hidden)


def _split_map(linear, x, pooled):
    """`linear` of [x, pooled] along channels, without forming it."""
    if pooled is None:
        return linear(x)
    width = x[0].shape[-1]
    return _map(lambda a, b: a @ linear.kernel[:width] + b @ linear.kernel[width:], x, pooled)


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
        self, points: Float[Array, "points 3"], used: Bool[Array, "points"] | None = None, tip: Float[Array, "3"] | None = None
    ) -> Float[Array, "latent 3"]:
        if self.config.asymmetry:
            points = points - self.config.asymmetry * (farthest(points, used) if tip is None else tip)
        where = None if used is None else used[:, None]
        x, pooled = self.fc_pos(self.conv_pos(points * self.config.scaling, used)), None
        for index in range(self.config.blocks):
            x = getattr(self, f"block_{index}")(x, pooled)
            pooled = _map(lambda plane: jnp.mean(plane, axis=0, keepdims=True, where=where), x)
        return jnp.concatenate(self.fc_c(self.actvn_c(pooled))).T


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
        # A small second layer starts every block near the identity: five of them then keep the variance of fc_in's output.
        self.fc_1 = Affine(self.width, self.width, gain=0.1)


@functools.partial(
    jax.tree_util.register_dataclass, data_fields=["latent", "invariants", "into", "blocks", "out"], meta_fields=["config"]
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
    invariants: Float[Array, "latent"]
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
        invariants = _dot(planes, self.z_in(planes))
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
        self, points: Float[Array, "points 3"], used: Bool[Array, "points"] | None = None, tip: Float[Array, "3"] | None = None
    ) -> Float[Array, "latent 3"]:
        return self.encoder(points, used, tip)

    def condition(self, latent: Float[Array, "latent 3"]) -> Conditioned:
        return self.decoder(latent)


@full_precision
def encode_latent(
    params,
    config: NetworkConfig,
    points: Float[Array, "points 3"],
    used: Bool[Array, "points"] | None = None,
    tip: Float[Array, "3"] | None = None,
) -> Float[Array, "latent 3"]:
    """The latent z of a cloud.

    Args:
        params: of the network.
        config: its sizes.
        points: centred on their mean, metres.
        used: which of them count; all by default.
        tip: where `config.asymmetry` takes the farthest point to be, relative to the mean; by default the farthest of those that count.
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
        The activations a descriptor is made of, in its order (|p|^2, z p, invariants, fc_in, blocks), each (*batch, width), and
        the occupancy logits (*batch,).
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
