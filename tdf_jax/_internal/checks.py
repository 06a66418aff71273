"""Validators of arguments, each with the one message that its kind of mistake gets.

`function` begins the message: "solve()" in the library, "tdf imitate" on the command line. A validator returns the
value, in the type that the caller wants. Shapes are checked of traced values too; what depends on numbers lets traced
ones through, because they are not known yet.
"""

from collections.abc import Collection

import jax
import jax.core
import jax.numpy as jnp
import numpy as np
from numpy.typing import ArrayLike

from tdf_jax._internal.errors import InputError

SEEDS = 2**32  # jax truncates a larger seed to 32 bits without a warning
MINIMUM_POINTS = 21  # the encoder's 20 nearest neighbours, the point itself included, and one to choose from


def traced(*values) -> bool:
    """Whether one of the values is traced, so that its numbers are not known yet."""
    return any(isinstance(leaf, jax.core.Tracer) for leaf in jax.tree.leaves(values))


def count(function: str, name: str, value, least: int = 1, most: float = np.inf) -> int:
    """Check that a value is a whole number from `least` to `most`; return it."""
    if not _is_whole(value) or not least <= value <= most:
        expected = f"of at least {least}" if most == np.inf else f"from {least} to {most}"
        raise InputError(f"{function}: {name} is {value!r}; expected a whole number {expected}")
    return int(value)


def counts(function: str, name: str, value, size: int = 3) -> tuple[int, ...]:
    """Check that a value is `size` whole numbers of at least 1; return them."""
    if np.shape(value) != (size,) or not all(_is_whole(n) and n >= 1 for n in value):
        raise InputError(f"{function}: {name} is {value}; expected {_in_words(size)} whole numbers of at least 1")
    return tuple(int(n) for n in value)


def seed(function: str, value, name: str = "seed") -> int:
    """Check that a value is a whole number that jax takes as a seed; return it."""
    return count(function, name, value, 0, SEEDS - 1)


def number(
    function: str,
    name: str,
    value,
    least: float = -np.inf,
    most: float = np.inf,
    unit: str = "",
    *,
    below: float = np.inf,
):
    """Check that a value is one finite number from `least` to `most` and less than `below`; return it."""
    if traced(value):
        return _scalar(function, name, value)
    if not _is_number(value) or not least <= value <= most or not value < below:
        above = f" of {least:g} or more" if np.isfinite(least) else ""
        expected = f" from {least:g} to {most:g}" if np.isfinite(most) else above
        expected += f", less than {below:g}" if np.isfinite(below) else ""
        raise InputError(f"{function}: {name} is {value!r}; expected one finite number{expected}{unit and ', ' + unit}")
    return value


def positive(function: str, name: str, value, unit: str = ""):
    """Check that a value is one finite number above 0; return it."""
    if traced(value):
        return _scalar(function, name, value)
    if not _is_number(value) or not value > 0:
        raise InputError(f"{function}: {name} is {value!r}; expected a positive number{unit and ', ' + unit}")
    return value


def choice(function: str, name: str, value, choices: Collection[str] | Collection[int]):
    """Check that a value is one of the choices, which are words or whole numbers; return it."""
    if not (isinstance(value, str) or _is_whole(value)) or value not in choices:
        raise InputError(f"{function}: {name} is {value!r}; expected one of {', '.join(map(str, choices))}")
    return value


def vector(function: str, name: str, value: ArrayLike, size: int = 3, unit: str = "metres") -> np.ndarray | jax.Array:
    """Check that a value is `size` finite numbers; return them, as float64 unless they are traced."""
    vector = jnp.asarray(value) if traced(value) else _array(function, name, value)
    if vector.shape != (size,) or not (traced(vector) or np.isfinite(vector).all()):
        raise InputError(
            f"{function}: {name} is {value}; expected {_in_words(size)} finite numbers{unit and ', ' + unit}"
        )
    return vector


def direction(function: str, name: str, value: ArrayLike) -> np.ndarray | jax.Array:
    """Check that a value is a vector other than zero, (3,); return it, as float64 unless it is traced."""
    direction = vector(function, name, value, unit="")
    if not traced(direction) and not direction.any():
        raise InputError(f"{function}: {name} is zero; expected a direction, three numbers that are not all zero")
    return direction


def lengths(function: str, name: str, value: ArrayLike, size: int = 3) -> np.ndarray | jax.Array:
    """Check that a value is `size` lengths above 0, metres; return them, as float64 unless they are traced."""
    lengths = jnp.asarray(value) if traced(value) else _array(function, name, value)
    if lengths.shape != (size,) or not (traced(lengths) or (np.isfinite(lengths) & (lengths > 0)).all()):
        raise InputError(f"{function}: {name} is {value}; expected {_in_words(size)} lengths above 0, metres")
    return lengths


def positions(function: str, name: str, value: ArrayLike) -> jax.Array:
    """Check that a value has the shape of points, (..., 3); return it as an array. Coordinates are not checked."""
    array = jnp.asarray(value)
    if array.shape[-1:] != (3,):
        raise InputError(f"{function}: {name} has shape {array.shape}; expected (..., 3), metres")
    return array


def coordinates(
    function: str, name: str, value: ArrayLike, rows: str = "points", least: int = 1
) -> np.ndarray | jax.Array:
    """Check that a value is finite points, (rows, 3), at least `least`; return an array of the caller's type."""
    array = jnp.asarray(value) if traced(value) else np.asarray(value)
    if array.ndim != 2 or array.shape[1] != 3 or len(array) < least or array.dtype.kind not in "fiu":
        raise InputError(f"{function}: {name} has shape {array.shape}; expected numbers ({rows}, 3), metres")
    if not traced(array) and not np.isfinite(array).all():
        raise InputError(f"{function}: {name} has NaN or infinite coordinates; expected finite metres")
    return array


def pose(function: str, name: str, value: ArrayLike) -> ArrayLike:
    """Check that a value is one finite pose `wxyz_xyz` whose quaternion is not zero; return it."""
    if np.shape(value) != (7,):
        raise InputError(f"{function}: {name} has shape {np.shape(value)}; expected one pose wxyz_xyz, (7,)")
    if not traced(value):
        values = _array(function, name, value)
        if not np.isfinite(values).all() or not np.linalg.norm(values[:4]) > 1e-6:
            raise InputError(
                f"{function}: {name} is {values.tolist()}; expected one finite pose wxyz_xyz, its quaternion not zero"
            )
    return value


def rotations(function: str, name: str, value: ArrayLike) -> ArrayLike:
    """Check that a value is rotation matrices, (..., 3, 3); return it."""
    if np.shape(value)[-2:] != (3, 3):
        raise InputError(f"{function}: {name} has shape {np.shape(value)}; expected rotation matrices, (..., 3, 3)")
    if not traced(value):
        R = _array(function, name, value)
        if not (np.allclose(R @ np.swapaxes(R, -1, -2), np.eye(3), atol=1e-3) and (np.linalg.det(R) > 0).all()):
            raise InputError(f"{function}: {name} is not orthonormal with determinant 1, or not finite")
    return value


def orientation(function: str, name: str, value: ArrayLike) -> np.ndarray | jax.Array:
    """Check that a value is a matrix (3, 3) or a quaternion wxyz (4,); return it, as float64 unless it is traced."""
    orientation = jnp.asarray(value) if traced(value) else _array(function, name, value)
    if orientation.shape not in {(3, 3), (4,)}:
        raise InputError(f"{function}: {name} has shape {orientation.shape}; expected (3, 3), or (4,) as wxyz")
    if orientation.shape == (3, 3):
        rotations(function, name, orientation)
    elif not traced(orientation) and not (np.isfinite(orientation).all() and orientation.any()):
        raise InputError(f"{function}: {name} wxyz is {value}; expected a finite quaternion that is not zero")
    return orientation


def key(function: str, value) -> jax.Array:
    """Check that a value is one key of `jax.random.key` or the older `jax.random.PRNGKey`; return it."""
    shape, dtype = getattr(value, "shape", None), getattr(value, "dtype", np.dtype(object))
    if not (shape == () and jnp.issubdtype(dtype, jax.dtypes.prng_key)) and not (shape == (2,) and dtype == np.uint32):
        got = repr(value) if shape is None or shape == () else f"an array of shape {shape}"
        raise InputError(f"{function}: key is {got}; expected one random key, such as jax.random.key(0)")
    return value


def points(function: str, value, name: str = "points"):
    """Check that a value is a point cloud that can be encoded, (points, 3), metres; return all of its points.

    Args:
        function: begins the message.
        value: array, numpy or jax.
        name: what the message calls it.

    Returns:
        The same array; a list as a numpy array, integers as float32.

    Raises:
        InputError: the shape is not (points, 3), there are fewer than 21, one is not finite, or all are equal.
    """
    if not isinstance(value, jax.Array):
        try:
            value = np.asarray(value)
        except ValueError as error:
            raise InputError(f"{function}: {name} is not an array of numbers: {error}") from error
    if value.dtype.kind in "iu":
        value = value.astype(np.float32)
    if not jnp.issubdtype(value.dtype, np.floating):
        raise InputError(f"{function}: {name} has dtype {value.dtype}; expected floating point metres")
    if value.ndim != 2 or value.shape[1] != 3:
        raise InputError(f"{function}: {name} has shape {value.shape}; expected (points, 3)")
    if len(value) < MINIMUM_POINTS:
        raise InputError(
            f"{function}: {name} has {len(value)} points; expected at least {MINIMUM_POINTS} "
            "(the encoder looks at 20 neighbours). Use a denser cloud"
        )
    if traced(value):
        return value
    values = np.asarray(value)
    bad = np.count_nonzero(~np.isfinite(values).all(axis=1))
    if bad:
        raise InputError(
            f"{function}: {bad} of the {len(values)} points of {name} are NaN or infinite; expected finite "
            "metres. Remove them: points[np.isfinite(points).all(axis=1)]"
        )
    if not np.ptp(values, axis=0).any():
        raise InputError(
            f"{function}: the {len(values)} points of {name} are all equal to {values[0].tolist()}; expected a surface"
        )
    return value


def query(function: str, value) -> ArrayLike:
    """Check that a value is query points (queries, 3), at least one, finite; return it."""
    shape = np.shape(value)
    if len(shape) != 2 or shape[1] != 3 or shape[0] < 1:
        raise InputError(
            f"{function}: query points have shape {shape}; expected (queries, 3). Try tdf.box_query(key, count=500)"
        )
    if not traced(value) and not np.isfinite(np.asarray(value)).all():
        raise InputError(f"{function}: some query points are NaN or infinite; expected finite metres")
    return value


def _in_words(size: int) -> str:
    return {3: "three", 4: "four", 7: "seven"}.get(size, str(size))


def _is_whole(value) -> bool:
    return isinstance(value, int | np.integer) and not isinstance(value, bool)


def _is_number(value) -> bool:
    if isinstance(value, bool | np.bool_) or np.ndim(value) != 0:
        return False
    try:
        return bool(np.isfinite(value))
    except TypeError:
        return False


def _scalar(function, name, value):
    if np.ndim(value) != 0:
        raise InputError(f"{function}: {name} has shape {np.shape(value)}; expected one number")
    return value


def _array(function, name, value) -> np.ndarray:
    try:
        return np.asarray(value, dtype=np.float64)
    except (TypeError, ValueError):
        raise InputError(f"{function}: {name} is {value!r}; expected numbers") from None
