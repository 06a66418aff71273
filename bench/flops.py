"""Floating-point operations of each row, counted in one place.

The count is that of the multiplications and additions of the matrix products in the leanest known form of a task, the
same for all competitors. Further work of a competitor (repeated latents, edge features, unused weight gradients) lowers
its rate. Element-wise operations, neighbour search and sums of differences are not counted, so no rate reaches 100 % of
the matmul peak.
"""

from tdf_jax.networks.occupancy import NetworkConfig

EDGE_PRODUCTS = 4  # (e.e, e.x, x.x, c.c): what <feature, d> and |d|^2 of an edge are linear in


def encoder(points: int, config: NetworkConfig = NetworkConfig()) -> float:
    """One cloud. Every linear map of vectors counts three times, for x, y and z.

    Edges: two products of 4 by `hidden` for each of 20 neighbours, and a linear map of the pooled edges. After the
    first residual block the pooled half of the input is one vector for all points, so maps of it are not counted.
    """
    hidden, width = config.vector_hidden, config.vector_width
    edges = 2 * EDGE_PRODUCTS * config.neighbours * hidden + 3 * 2 * 3 * hidden
    tail = width * hidden + 2 * hidden * hidden  # fc_0, actvn_1, fc_1
    first = width * width + width * hidden + tail
    later = (width - hidden) * (width + hidden) + tail
    return 2.0 * points * (edges + 3 * (hidden * width + first + (config.blocks - 1) * later))


def decoder(points: int, config: NetworkConfig = NetworkConfig()) -> float:
    """Descriptors of points, forward: z p, the folded fc_in, and two square maps of each block."""
    width = config.decoder_width
    return 2.0 * points * (3 * config.latent + 3 * width + 2 * config.blocks * width * width)


def decoder_gradient(points: int, config: NetworkConfig = NetworkConfig()) -> float:
    """Forward, and backward to the points alone: each product once more, transposed."""
    return 2.0 * decoder(points, config)


def training(clouds: int, points: int, queries: int, config: NetworkConfig = NetworkConfig()) -> float:
    """Forward, and backward to inputs and to weights: each product three times."""
    return 3.0 * clouds * (encoder(points, config) + decoder(queries, config))
