"""Vector neurons: rotation-equivariant layers on channels of 3-vectors (Deng et al., Vector Neurons, 2021)."""

import flax.linen as nn
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

Vectors = tuple[Float[Array, "... _channels"], Float[Array, "... _channels"], Float[Array, "... _channels"]]

VECTOR_EPSILON = 1e-6  # added to |d|^2 in the vector leaky ReLU, as in the original
NEIGHBOUR_ROWS = 2048  # points whose distances to all others are in memory at a time


class VectorMap(nn.Module):
    """A linear map of vector channels. It has no bias, so it commutes with rotations."""

    inputs: int
    outputs: int

    def setup(self):
        """Make the parameters."""
        # A standard deviation of 1/sqrt(inputs) keeps the variance from layer to layer. PyTorch's default is smaller by
        # sqrt(3): through the depth of the encoder the latent then starts at an rms of 1e-4, and the decoder sees
        # nothing but |p|^2.
        self.kernel = self.param("kernel", nn.initializers.lecun_normal(), (self.inputs, self.outputs))

    def __call__(self, x: Vectors) -> Vectors:
        """The mapped channels."""
        return map_planes(lambda plane: plane @ self.kernel, x)


def vector_dot(a, b):
    """Scalar products of vectors given as planes."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def _cross(a, b):
    return (a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0])


def map_planes(function, *planes) -> Vectors:
    """The planes x, y and z that a function makes of those of its arguments."""
    x, y, z = (function(*plane) for plane in zip(*planes))
    return x, y, z


def _reflection(inner, squared, slope):
    """Coefficient of the direction in a vector leaky ReLU, from <x,d> and |d|^2."""
    return jnp.minimum(inner, 0.0) * ((1.0 - slope) / (squared + VECTOR_EPSILON))


def _reflect(x, direction, slope):
    """Vector leaky ReLU: `x` where <x,d> >= 0, otherwise `x` minus (1 - slope) times its part along `d`."""
    coefficient = _reflection(vector_dot(x, direction), vector_dot(direction, direction), slope)
    return map_planes(lambda a, d: a - coefficient * d, x, direction)


class VectorLinear(nn.Module):
    """`VectorMap` under the name that the published checkpoints give it."""

    inputs: int
    outputs: int

    def setup(self):
        """Make the map."""
        self.map_to_feat = VectorMap(self.inputs, self.outputs)

    def __call__(self, x: Vectors) -> Vectors:
        """The mapped channels."""
        return self.map_to_feat(x)


class VectorLeakyReLU(nn.Module):
    """Vector leaky ReLU with a learned direction for every channel."""

    channels: int
    slope: float

    def setup(self):
        """Make the map to directions."""
        self.map_to_dir = VectorMap(self.channels, self.channels)

    def __call__(self, x: Vectors) -> Vectors:
        """The activations."""
        return _reflect(x, self.map_to_dir(x), self.slope)


class EdgeConvolution(nn.Module):
    """Edge features of the nearest neighbours, a vector linear map, a vector leaky ReLU and the mean over neighbours.

    The edge features of a neighbour are e = neighbour - x, x, and c = neighbour x x = e x x. This layer never forms the
    (points, neighbours, 3, channels) activations. <feature,d> and |d|^2 are linear in the scalar products of (e, x, c),
    of which only four differ from zero, because c is normal to e and x. With s the reflection's coefficient, the mean
    over neighbours needs only the means of s and of s e: the mean of s x is (mean s) x, and that of s c is
    (mean s e) x x. The result equals that of the plain form to rounding.
    """

    channels: int
    neighbours: int
    slope: float

    def setup(self):
        """Make both maps."""
        self.map_to_feat = VectorMap(3, self.channels)
        self.map_to_dir = VectorMap(3, self.channels)

    def __call__(self, points: Float[Array, "points 3"], used: Bool[Array, " points"] | None = None) -> Vectors:
        """The mean activations of every point.

        Args:
            points: point cloud, (points, 3), scaled.
            used: mask of the points that can be neighbours, (points,); all of them by default.

        Returns:
            Planes (points, channels).
        """
        kernels = self.map_to_feat.kernel, self.map_to_dir.kernel
        # The kernels are promoted before they are multiplied: products in float32 would spoil those of float64 points.
        feature, direction = (kernel.astype(jnp.promote_types(kernel.dtype, points.dtype)) for kernel in kernels)
        own = tuple(points.T)  # planes (points,)
        spread = map_planes(lambda plane: plane[:, None], own)
        neighbours = points[nearest_neighbours(points, self.neighbours, used)]
        # planes (points, neighbours)
        edge = map_planes(lambda a, x: a - x, tuple(jnp.moveaxis(neighbours, -1, 0)), spread)
        cross = _cross(edge, spread)
        products = (
            vector_dot(edge, edge),
            vector_dot(edge, spread),
            vector_dot(spread, spread),
            vector_dot(cross, cross),
        )
        # The four terms are written out because a matrix product would not be fused with the operations that follow.
        inner, squared = (
            sum(product[:, :, None] * weight for product, weight in zip(products, _bilinear(kernel, direction)))
            for kernel in (feature, direction)
        )
        reflection = _reflection(inner, squared, self.slope)  # (points, neighbours, channels)

        mean_reflection = jnp.mean(reflection, axis=1)
        mean_reflected_edge = map_planes(lambda e: jnp.mean(e[:, :, None] * reflection, axis=1), edge)
        mean_edge = map_planes(lambda e: jnp.mean(e, axis=1), edge)
        features = zip(mean_edge, own, _cross(mean_edge, own))
        linear = tuple(jnp.stack(feature_planes, axis=-1) @ feature for feature_planes in features)
        reflected_cross = _cross(mean_reflected_edge, spread)
        return map_planes(
            lambda x, e, o, c: x - e * direction[0] - o * mean_reflection * direction[1] - c * direction[2],
            *(linear, mean_reflected_edge, spread, reflected_cross),
        )


def _bilinear(a, b):
    """Weights of (e.e, e.x, x.x, c.c) in <f a, f b>, with f = (e, x, c)."""
    return a[0] * b[0], a[0] * b[1] + a[1] * b[0], a[1] * b[1], a[2] * b[2]


def nearest_neighbours(points: Float[Array, "points 3"], count: int, used: Bool[Array, " points"] | None = None):
    """Indices of the nearest points by Euclidean distance.

    Args:
        points: point cloud, (points, 3).
        count: neighbours of a point, itself included.
        used: mask of the points that can be neighbours, (points,); all of them by default.

    Returns:
        Indices, (points, count), nearest first.
    """
    points = jax.lax.stop_gradient(points)

    def nearest(x):
        # In float32, |a|^2 + |b|^2 - 2ab instead of differences would misorder near neighbours of a cloud that is far
        # from zero.
        squared = sum((points[:, axis] - x[axis]) ** 2 for axis in range(3))
        squared = squared if used is None else jnp.where(used, squared, jnp.inf)
        return jax.lax.top_k(-squared, count)[1]

    # Blocks bound the memory, which is quadratic in the number of points if all distances exist at once.
    return jax.lax.map(nearest, points, batch_size=NEIGHBOUR_ROWS)


class VectorResidualBlock(nn.Module):
    """`shortcut(x) + fc_1(act_1(fc_0(act_0(x))))` on vector channels."""

    inputs: int
    outputs: int
    slope: float

    def setup(self):
        """Make the layers, under the published names."""
        self.actvn_0 = VectorLeakyReLU(self.inputs, self.slope)
        self.fc_0 = VectorLinear(self.inputs, self.outputs)
        self.actvn_1 = VectorLeakyReLU(self.outputs, self.slope)
        self.fc_1 = VectorLinear(self.outputs, self.outputs)
        self.shortcut = VectorLinear(self.inputs, self.outputs)

    def __call__(self, x: Vectors, pooled: Vectors | None = None) -> Vectors:
        """The output channels.

        Args:
            x: planes (points, channels).
            pooled: planes (1, channels) that are appended to the channels of every point; none by default.
        """
        # The part that is linear in the pooled half is computed once instead of once for every point: 651,000
        # multiply-adds a point and axis instead of 847,000.
        direction = _split_map(self.actvn_0.map_to_dir, x, pooled)
        shortcut = _split_map(self.shortcut.map_to_feat, x, pooled)
        if pooled is not None:
            x = map_planes(
                lambda a, b: jnp.concatenate([a, jnp.broadcast_to(b, a.shape[:1] + b.shape[1:])], axis=-1), x, pooled
            )
        hidden = self.fc_1(self.actvn_1(self.fc_0(_reflect(x, direction, self.slope))))
        return map_planes(jnp.add, shortcut, hidden)


def _split_map(linear, x, pooled):
    """`linear` of [x, pooled], joined along channels, without forming that array."""
    if pooled is None:
        return linear(x)
    width = x[0].shape[-1]
    return map_planes(lambda a, b: a @ linear.kernel[:width] + b @ linear.kernel[width:], x, pooled)
