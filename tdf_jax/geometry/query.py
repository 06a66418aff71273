"""Query points: where descriptors are taken, fixed in the query frame (the gripper, or the region of placing).

All functions return points (queries, 3) in metres in the query frame.
"""

from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from tdf_jax._internal import checks
from tdf_jax._internal.errors import InputError


def box_query(
    key: PRNGKeyArray,
    count: int = 500,
    size: float | Sequence[float] = 0.08,
    centre: Sequence[float] = (0.0, 0.0, 0.0),
) -> Float[Array, "queries 3"]:
    """Points uniform in a box along the axes of the query frame.

    Args:
        key: Random key.
        count: How many points, at least 1.
        size: Edge length, or the three of them, metres.
        centre: Centre of the box, metres.

    Returns:
        Query points.

    Raises:
        InputError: If count is below 1, an edge is not above 0, or a shape is wrong.
    """
    checks.key("box_query()", key)
    _check_count("box_query", count)
    size = _lengths("box_query", "size", [size] * 3 if np.ndim(size) == 0 else size, 3)
    return _centre("box_query", centre) + size * jax.random.uniform(key, (count, 3), minval=-0.5, maxval=0.5)


def gaussian_query(
    key: PRNGKeyArray, count: int = 500, sigma: float = 0.025, centre: Sequence[float] = (0.0, 0.0, 0.0)
) -> Float[Array, "queries 3"]:
    """Points normally distributed about a centre; the default spread is that of NDF's demonstrations.

    Args:
        key: Random key.
        count: How many points, at least 1.
        sigma: Standard deviation along each axis, metres.
        centre: Centre, metres.

    Returns:
        Query points.

    Raises:
        InputError: If count is below 1, sigma is not above 0, or a shape is wrong.
    """
    checks.key("gaussian_query()", key)
    _check_count("gaussian_query", count)
    sigma = _lengths("gaussian_query", "sigma", sigma)
    return _centre("gaussian_query", centre) + sigma * jax.random.normal(key, (count, 3))


def gripper_query(
    key: PRNGKeyArray,
    count: int = 500,
    *,
    opening: float = 0.08,
    finger: Sequence[float] = (0.02, 0.01, 0.045),
    palm: float = 0.03,
) -> Float[Array, "queries 3"]:
    """Points uniform in the volume of a parallel gripper: two fingers and the palm that joins them.

    The query frame is the gripper's: the origin midway between the fingertips, +z the approach (the fingers point
    that way, the palm lies behind), y the way they close, x along the fingers' width.

    Args:
        key: Random key.
        count: How many points, at least 1.
        opening: Gap between the fingers, metres.
        finger: Width (x), thickness (y) and length (z) of a finger, metres.
        palm: Depth (z) of the palm behind the fingers, metres; it spans both fingers in x and y.

    Returns:
        Query points.

    Raises:
        InputError: If count is below 1, a length is not above 0, or a shape is wrong.
    """
    checks.key("gripper_query()", key)
    _check_count("gripper_query", count)
    opening, palm = _lengths("gripper_query", "opening", opening), _lengths("gripper_query", "palm", palm)
    width, thickness, length = _lengths("gripper_query", "finger", finger, 3)
    aside = (opening + thickness) / 2
    centres = np.array([(0, -aside, -length / 2), (0, aside, -length / 2), (0, 0, -length - palm / 2)])
    sizes = np.array([(width, thickness, length)] * 2 + [(width, opening + 2 * thickness, palm)])
    key_box, key_place = jax.random.split(key)
    box = jax.random.categorical(key_box, jnp.log(jnp.asarray(sizes.prod(axis=1))), shape=(count,))
    place = jax.random.uniform(key_place, (count, 3), minval=-0.5, maxval=0.5)
    return jnp.asarray(centres)[box] + jnp.asarray(sizes)[box] * place


def lattice_query(
    shape: Sequence[int] = (6, 6, 7), pitch: float = 0.012, centre: Sequence[float] = (0.0, 0.0, 0.0)
) -> Float[Array, "queries 3"]:
    """Points on a regular lattice, the last axis fastest: no draw, the same points every time.

    Args:
        shape: Points along x, y and z; their product is the number of queries.
        pitch: Distance between neighbours, metres.
        centre: Centre of the lattice, metres.

    Returns:
        Query points.

    Raises:
        InputError: If shape is not three whole numbers of at least 1, or pitch is not above 0.
    """
    if np.shape(shape) != (3,) or not all(isinstance(n, int | np.integer) and n >= 1 for n in shape):
        raise InputError(f"lattice_query(): shape is {shape}; expected three whole numbers of at least 1.")
    pitch = _lengths("lattice_query", "pitch", pitch)
    steps = [pitch * (np.arange(n) - (n - 1) / 2) for n in shape]
    points = np.stack(np.meshgrid(*steps, indexing="ij"), axis=-1).reshape(-1, 3)
    return _centre("lattice_query", centre) + jnp.asarray(points)


def snapped_query(
    query: Float[Array, "queries 3"], pitch: float, centre: Sequence[float] = (0.0, 0.0, 0.0)
) -> Float[Array, "queries 3"]:
    """Query points moved to the nearest nodes of a lattice, so that an energy landscape with steps of one pitch shares its evaluations.

    Each moves by at most half a pitch along each axis; some may coincide, and count as often. What it does to the
    energies, `tdf_jax.landscape.energy_grid.query_change` tells.

    Args:
        query: points in the query frame, metres.
        pitch: Distance between neighbouring nodes, metres.
        centre: A node, metres.

    Returns:
        As many query points.

    Raises:
        InputError: If pitch is not above 0 or a shape is wrong.
    """
    pitch, centre = _lengths("snapped_query", "pitch", pitch), _centre("snapped_query", centre)
    if np.ndim(query) != 2 or np.shape(query)[1] != 3:
        raise InputError(f"snapped_query(): query points have shape {np.shape(query)}; expected (queries, 3), metres.")
    return centre + pitch * jnp.round((query - centre) / pitch)


def _check_count(function: str, count: int) -> None:
    if not isinstance(count, int | np.integer) or count < 1:
        raise InputError(f"{function}(): count is {count}; expected a whole number of at least 1.")


def _lengths(function: str, name: str, value: float | Sequence[float], count: int | None = None) -> np.ndarray:
    lengths = np.asarray(value, dtype=float)
    if lengths.shape != (() if count is None else (count,)) or not (np.isfinite(lengths) & (lengths > 0)).all():
        expected = "a length" if count is None else f"{count} lengths"
        raise InputError(f"{function}(): {name} is {value}; expected {expected} above 0, metres.")
    return lengths


def _centre(function: str, centre: Sequence[float]) -> Float[Array, "3"]:
    centre = np.asarray(centre, dtype=float)
    if centre.shape != (3,) or not np.isfinite(centre).all():
        raise InputError(f"{function}(): centre is {centre.tolist()}; expected three finite numbers, metres.")
    return jnp.asarray(centre)
