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
from tdf_jax._internal.boundary import public
from tdf_jax._internal.errors import InputError

FARTHEST_MEETING = 0.25  # largest distance of two clouds that meet, share of the larger diagonal


@public
def box_query(
    key: PRNGKeyArray,
    count: int = 500,
    size: float | Sequence[float] | Float[Array, "..."] = 0.08,
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
    edges = checks.lengths("box_query()", "size", [size] * 3 if np.ndim(size) == 0 else size)  # pyright: ignore[reportArgumentType]
    middle = jnp.asarray(checks.vector("box_query()", "centre", centre))
    return middle + edges * jax.random.uniform(key, (count, 3), minval=-0.5, maxval=0.5)


@public
def gaussian_query(
    key: PRNGKeyArray, count: int = 500, sigma: float | Float[Array, ""] = 0.025, centre: ArrayLike = (0.0, 0.0, 0.0)
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


@public
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


@public
def contact_query(
    points_a: Float[Array | np.ndarray, "points_a 3"],
    points_b: Float[Array | np.ndarray, "points_b 3"],
    key: PRNGKeyArray,
    count: int = 128,
    *,
    spread: float = 0.02,
) -> Float[Array, "queries 3"]:
    """Sample query points around the region where two clouds meet, for `Target`.

    The region is where the clouds are closest: each point of one cloud is paired with its nearest point of the other.
    Query points are normally distributed about the middles of pairs, which are drawn with weights that fall by a factor
    e where the distance exceeds the smallest one by `spread`, or by the spacing of the clouds if that is larger.

    Args:
        points_a: point cloud of the object at the release, (points, 3), metres, world frame.
        points_b: point cloud of the target, (points, 3), metres, world frame.
        key: random key.
        count: number of query points, at least 1.
        spread: standard deviation of the query points about a middle, metres.

    Returns:
        Query points, (count, 3), metres, world frame, the contact points for a target whose contact frame is the world.

    Raises:
        InputError: a cloud is not a point cloud, the clouds are farther apart than a quarter of the larger one's
            diagonal, count is below 1, or spread is not above 0.
    """
    from scipy.spatial import KDTree

    a, b = (
        np.asarray(checks.points("contact_query()", points, name), np.float64)
        for points, name in ((points_a, "points_a"), (points_b, "points_b"))
    )
    checks.key("contact_query()", key)
    checks.count("contact_query()", "count", count)
    checks.positive("contact_query()", "spread", spread, "metres")
    trees = KDTree(a), KDTree(b)
    to_b, in_b = (np.asarray(part) for part in trees[1].query(a))
    to_a, in_a = (np.asarray(part) for part in trees[0].query(b))
    distance = np.concatenate([to_b, to_a])
    extent = max(np.linalg.norm(np.ptp(a, axis=0)), np.linalg.norm(np.ptp(b, axis=0)))
    if distance.min() > FARTHEST_MEETING * extent:
        raise InputError(
            f"contact_query(): the clouds are {distance.min():.3g} m apart; expected them to meet. Move the object's "
            "cloud by its motion from the grasp to the release"
        )
    spacing = max(np.median(np.asarray(tree.query(tree.data, k=2)[0])[:, 1]) for tree in trees)
    middles = np.concatenate([a + b[in_b], b + a[in_a]]) / 2
    logits = (distance.min() - distance) / max(spread, spacing)
    key_pair, key_point = jax.random.split(key)
    pair = jax.random.categorical(key_pair, jnp.asarray(logits), shape=(count,))
    return jnp.asarray(middles)[pair] + spread * jax.random.normal(key_point, (count, 3))


@public
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


@public
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
