"""Query points: points where descriptors are evaluated, fixed in the frame of the gripper or the placing region.

All functions return points (queries, 3), metres, query frame.
"""

from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray
from numpy.typing import ArrayLike

from tdf_jax._internal import checks


def box_query(
    key: PRNGKeyArray,
    count: int = 500,
    size: float | Sequence[float] = 0.08,
    centre: ArrayLike = (0.0, 0.0, 0.0),
) -> Float[Array, "queries 3"]:
    """Sample query points uniformly in a box whose edges are along the axes of the query frame.

    Args:
        key: random key.
        count: number of points, at least 1.
        size: edge length of a cube, or the three edge lengths, (3,), metres.
        centre: centre of the box, (3,), metres, query frame.

    Returns:
        Query points, (count, 3), metres, query frame.

    Raises:
        InputError: count is below 1, an edge is not above 0, or a shape is wrong.
    """
    checks.key("box_query()", key)
    checks.count("box_query()", "count", count)
    edges = checks.lengths("box_query()", "size", [size] * 3 if np.ndim(size) == 0 else size)
    middle = jnp.asarray(checks.vector("box_query()", "centre", centre))
    return middle + edges * jax.random.uniform(key, (count, 3), minval=-0.5, maxval=0.5)


def gaussian_query(
    key: PRNGKeyArray, count: int = 500, sigma: float = 0.025, centre: ArrayLike = (0.0, 0.0, 0.0)
) -> Float[Array, "queries 3"]:
    """Sample query points from a normal distribution; the default sigma is that of NDF's demonstrations.

    Args:
        key: random key.
        count: number of points, at least 1.
        sigma: standard deviation along each axis, metres.
        centre: mean, (3,), metres, query frame.

    Returns:
        Query points, (count, 3), metres, query frame.

    Raises:
        InputError: count is below 1, sigma is not above 0, or a shape is wrong.
    """
    checks.key("gaussian_query()", key)
    checks.count("gaussian_query()", "count", count)
    checks.positive("gaussian_query()", "sigma", sigma, "metres")
    return jnp.asarray(checks.vector("gaussian_query()", "centre", centre)) + sigma * jax.random.normal(key, (count, 3))


def gripper_query(
    key: PRNGKeyArray,
    count: int = 500,
    *,
    opening: float = 0.08,
    finger: Sequence[float] = (0.02, 0.01, 0.045),
    palm: float = 0.03,
) -> Float[Array, "queries 3"]:
    """Sample query points uniformly in the volume of a parallel gripper: two fingers and the palm that joins them.

    The query frame is that of the gripper: the origin is midway between the fingertips, +z is the approach direction
    (the fingers point along it and the palm is behind them), y is the closing direction and x is along the width of the
    fingers.

    Args:
        key: random key.
        count: number of points, at least 1.
        opening: gap between the fingers, metres.
        finger: width (x), thickness (y) and length (z) of a finger, (3,), metres.
        palm: depth (z) of the palm behind the fingers, metres; the palm spans both fingers in x and y.

    Returns:
        Query points, (count, 3), metres, query frame.

    Raises:
        InputError: count is below 1, a length is not above 0, or a shape is wrong.
    """
    checks.key("gripper_query()", key)
    checks.count("gripper_query()", "count", count)
    for name, length in (("opening", opening), ("palm", palm)):
        checks.positive("gripper_query()", name, length, "metres")
    width, thickness, length = checks.lengths("gripper_query()", "finger", finger)
    offset = (opening + thickness) / 2
    centres = np.array([(0, -offset, -length / 2), (0, offset, -length / 2), (0, 0, -length - palm / 2)])
    sizes = np.array([(width, thickness, length)] * 2 + [(width, opening + 2 * thickness, palm)])
    key_box, key_point = jax.random.split(key)
    box = jax.random.categorical(key_box, jnp.log(jnp.asarray(sizes.prod(axis=1))), shape=(count,))
    point = jax.random.uniform(key_point, (count, 3), minval=-0.5, maxval=0.5)
    return jnp.asarray(centres)[box] + jnp.asarray(sizes)[box] * point


def lattice_query(
    shape: Sequence[int] = (6, 6, 7), pitch: float = 0.012, centre: ArrayLike = (0.0, 0.0, 0.0)
) -> Float[Array, "queries 3"]:
    """Place query points on a regular lattice, the last axis fastest; the points are the same in every call.

    Args:
        shape: number of points along x, y and z; their product is the number of query points.
        pitch: distance between neighbouring points, metres.
        centre: centre of the lattice, (3,), metres, query frame.

    Returns:
        Query points, (queries, 3), metres, query frame.

    Raises:
        InputError: shape is not three whole numbers of at least 1, or pitch is not above 0.
    """
    numbers = checks.counts("lattice_query()", "shape", shape)
    checks.positive("lattice_query()", "pitch", pitch, "metres")
    steps = [pitch * (np.arange(n) - (n - 1) / 2) for n in numbers]
    points = np.stack(np.meshgrid(*steps, indexing="ij"), axis=-1).reshape(-1, 3)
    return jnp.asarray(checks.vector("lattice_query()", "centre", centre)) + jnp.asarray(points)


def snapped_query(
    query: Float[Array, "queries 3"], pitch: float, centre: ArrayLike = (0.0, 0.0, 0.0)
) -> Float[Array, "queries 3"]:
    """Move query points to the nearest nodes of a lattice.

    An energy landscape whose steps are one pitch then shares evaluations between query points. Each point moves by at
    most half a pitch along each axis. Points may coincide; each still counts once in the energy.
    `tdf_jax.landscape.energy_grid.query_change` measures the effect on the energies.

    Args:
        query: query points, (queries, 3), metres, query frame.
        pitch: distance between neighbouring nodes, metres.
        centre: position of a node, (3,), metres, query frame.

    Returns:
        As many query points, (queries, 3), metres, query frame.

    Raises:
        InputError: pitch is not above 0, a shape is wrong, or a query point is not finite.
    """
    checks.positive("snapped_query()", "pitch", pitch, "metres")
    node = jnp.asarray(checks.vector("snapped_query()", "centre", centre))
    points = jnp.asarray(checks.query("snapped_query()", query))
    return node + pitch * jnp.round((points - node) / pitch)
