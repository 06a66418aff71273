"""Validators of arguments, each with the one message that its kind of mistake gets.

`function` begins the message: "solve()" in the library, "tdf imitate" on the command line. A validator returns the
value, in the type that the caller wants. Shapes are checked of traced values too; what depends on numbers lets traced
ones through, because they are not known yet.
"""

import os
from collections.abc import Collection
from pathlib import Path
from typing import Any

import jax
import jax.core
import jax.numpy as jnp
import numpy as np
from numpy.typing import ArrayLike

from tdf_jax._internal.boundary import is_foreign, plain_array
from tdf_jax._internal.devices import tracing
from tdf_jax._internal.errors import InputError
from tdf_jax._internal.units import MILLIMETRES

SEEDS = 2**32  # jax truncates a larger seed to 32 bits without a warning
# Metres. Up to 256 m float32 numbers are at most 0.008 mm from any coordinate. A pick is the sum of a few of them, and
# its energy is rounded too: with the weights for mugs it moves by up to 0.05 mm, and at twice this distance by 0.1 mm.
FARTHEST = 250.0
SMALLEST_IN_MILLIMETRES = 10.0  # extent of a cloud above which its numbers are probably millimetres
UNIT_NORM = 1e-3  # largest deviation of a quaternion's norm from 1: rounding to three decimals, or to float16
SENTINELS = 8  # values that may stand for missing measurements in one cloud
SENTINEL_SHARE = 0.01  # share of the rows that may have one value, where other values are not as common
MOST = 2**32 - 1  # largest count: array sizes and loop lengths beyond have no memory, and XLA fails without a message
MINIMUM_POINTS = 21  # the encoder's 20 nearest neighbours, the point itself included, and one to choose from


def traced(*values) -> bool:
    """Whether one of the values is traced, so that its numbers are not known yet."""
    return any(isinstance(leaf, jax.core.Tracer) for leaf in jax.tree.leaves(values))


def in_trace(*values) -> bool:
    """Whether one of the values is traced, or a function that `jax.jit` traces is running."""
    return traced(*values) or tracing()


def count(function: str, name: str, value, least: int = 1, most: float = np.inf) -> int:
    """Check that a value is a whole number from `least` to `most`; return it."""
    if not _is_whole(value) or not least <= value <= min(most, MOST):
        bounded = most < np.inf or (_is_whole(value) and value > MOST)
        expected = f"from {least} to {min(most, MOST)}" if bounded else f"of at least {least}"
        raise InputError(f"{function}: {name} is {value!r}; expected a whole number {expected}")
    return int(value)


def counts(function: str, name: str, value, size: int = 3) -> tuple[int, ...]:
    """Check that a value is `size` whole numbers of at least 1; return them."""
    try:
        numbers = tuple(value)
    except TypeError:  # one number, or something else
        numbers = ()
    if len(numbers) != size or not all(_is_whole(n) and 1 <= n <= MOST for n in numbers):
        raise InputError(f"{function}: {name} is {value}; expected {_in_words(size)} whole numbers of at least 1")
    return tuple(int(n) for n in numbers)


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


def real(function: str, name: str, value) -> float:
    """Check that a value is one number, finite or not; return it as a float."""
    if not _is_real(value):
        raise InputError(f"{function}: {name} is {value!r}; expected one number")
    return float(value)


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


def path(function: str, value, name: str = "path") -> Path:
    """Check that a value can be the path of a file or a folder; return it."""
    if not isinstance(value, str | os.PathLike):
        raise InputError(f"{function}: {name} is {value!r}; expected a path, text or a pathlib.Path")
    path = Path(value)
    if "\0" in str(path):
        raise InputError(f"{function}: {name} {str(path)!r} has a zero byte; expected a name that a file can have")
    return path


def existing_file(function: str, value, expected: str = "an existing file; check the path") -> Path:
    """Check that a value is the path of an existing file; return it."""
    file = path(function, value)
    try:
        exists = file.is_file()
    except (OSError, ValueError):  # such as a name that is too long
        exists = False
    if not exists:
        raise InputError(f"{function}: there is no file {file}; expected {expected}")
    return file


def boolean(function: str, name: str, value) -> bool:
    """Check that a value is True or False; return it."""
    if not isinstance(value, bool | np.bool_):
        raise InputError(f"{function}: {name} is {value!r}; expected True or False")
    return bool(value)


def vector(function: str, name: str, value: ArrayLike, size: int = 3, unit: str = "metres") -> np.ndarray | jax.Array:
    """Check that a value is `size` finite numbers; return them, as float64 unless they are traced."""
    vector = jnp.asarray(value) if traced(value) else numbers(function, name, value)
    if vector.shape != (size,) or not (traced(vector) or np.isfinite(vector).all()):
        raise InputError(
            f"{function}: {name} is {value}; expected {_in_words(size)} finite numbers{unit and ', ' + unit}"
        )
    if size == 3 and unit == "metres" and not traced(vector):
        near(function, name, np.asarray(vector)[None])
    return vector


def direction(function: str, name: str, value: ArrayLike) -> np.ndarray | jax.Array:
    """Check that a value is a vector other than zero, (3,); return it, as float64 unless it is traced."""
    direction = vector(function, name, value, unit="")
    if not traced(direction) and not direction.any():
        raise InputError(f"{function}: {name} is zero; expected a direction, three numbers that are not all zero")
    return direction


def lengths(function: str, name: str, value: ArrayLike, size: int = 3) -> np.ndarray | jax.Array:
    """Check that a value is `size` lengths above 0, metres; return them, as float64 unless they are traced."""
    lengths = jnp.asarray(value) if traced(value) else numbers(function, name, value)
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
    array = jnp.asarray(value) if traced(value) else plain_array(function, name, value)
    if array.ndim != 2 or array.shape[1] != 3 or len(array) < least or array.dtype.kind not in "fiu":
        raise InputError(f"{function}: {name} has shape {array.shape}; expected numbers ({rows}, 3), metres")
    if not traced(array) and not np.isfinite(array).all():
        raise InputError(f"{function}: {name} has NaN or infinite coordinates; expected finite metres")
    return array


def pose(function: str, name: str, value: ArrayLike) -> ArrayLike:
    """Check that a value is one finite pose `wxyz_xyz` with a unit quaternion, near the origin; return it."""
    if not isinstance(value, jax.Array):
        value = _native(numbers(function, name, value), value)
    if np.shape(value) != (7,):
        raise InputError(f"{function}: {name} has shape {np.shape(value)}; expected one pose wxyz_xyz, (7,)")
    if not traced(value):
        values = np.asarray(value, np.float64)
        if not np.isfinite(values).all():
            raise InputError(f"{function}: {name} is {values.tolist()}; expected one finite pose wxyz_xyz")
        unit_quaternions(function, name, values[None])
        near(function, name, values[None, 4:], value)
    return value


def unit_quaternions(function: str, name: str, wxyz_xyz: np.ndarray) -> None:
    """Check that the quaternions of poses `wxyz_xyz`, (poses, 7), have norm 1; the message names the likely order."""
    norms = np.linalg.norm(wxyz_xyz[:, :4], axis=1)
    off = np.abs(norms - 1)
    if not (off > UNIT_NORM).any():
        return
    worst = int(off.argmax())
    which = f"pose {worst} of {name}" if len(norms) > 1 else name
    if (np.abs(np.linalg.norm(wxyz_xyz[:, 3:], axis=1) - 1) <= UNIT_NORM).all():
        hint = (
            "The last four numbers have norm 1, so the order is probably x y z qx qy qz qw, as in ROS: take "
            "poses[..., [6, 3, 4, 5, 0, 1, 2]]; for x y z qw qx qy qz take poses[..., [3, 4, 5, 6, 0, 1, 2]]"
        )
    elif norms[worst] <= 1e-6:
        hint = "A quaternion of zeros is no rotation"
    else:
        hint = "Check the order of the numbers, or divide each quaternion by its norm"
    raise InputError(
        f"{function}: {which} has a quaternion of norm {norms[worst]:.4g}; expected wxyz_xyz, qw qx qy qz of norm 1 "
        f"and then x y z in metres. {hint}"
    )


def near(function: str, name: str, coordinates: np.ndarray, given=None) -> None:
    """Check that coordinates, (rows, 3), metres, lie where float32 resolves them; float64 has no limit.

    Args:
        function: begins the message.
        name: what the message calls them.
        coordinates: finite coordinates.
        given: value of the caller, whose type decides whether it is computed with in float64; by default
            `coordinates`.
    """
    kind = np.asarray(coordinates if given is None else given).dtype
    if jax.config.jax_enable_x64 and kind == np.float64:  # pyright: ignore[reportAttributeAccessIssue]
        return
    farthest = np.abs(coordinates).max(initial=0.0)
    if farthest > FARTHEST:
        wide = len(coordinates) < 2 or np.ptp(coordinates, axis=0).max() > SMALLEST_IN_MILLIMETRES
        unit = f" If they are in {MILLIMETRES.name}, multiply them by {MILLIMETRES.metres:g}." if wide else ""
        raise InputError(
            f"{function}: {name} has coordinates of up to {farthest:.6g} m; expected at most {FARTHEST:g} m from the "
            f"origin, because float32 does not resolve 0.1 mm there.{unit} Subtract one offset from all clouds and "
            "poses in float64, such as offset = points.mean(axis=0), and add it to the resulting positions"
        )


def rotations(function: str, name: str, value: ArrayLike) -> ArrayLike:
    """Check that a value is rotation matrices, (..., 3, 3); return it."""
    if np.shape(value)[-2:] != (3, 3):
        raise InputError(f"{function}: {name} has shape {np.shape(value)}; expected rotation matrices, (..., 3, 3)")
    if not traced(value):
        R = numbers(function, name, value)
        if not (np.allclose(R @ np.swapaxes(R, -1, -2), np.eye(3), atol=1e-3) and (np.linalg.det(R) > 0).all()):
            raise InputError(
                f"{function}: {name} is not orthonormal with determinant 1, or not finite; expected rotation matrices. "
                "Divide by a scale, and check the order of rows and columns"
            )
    return value


def orientation(function: str, name: str, value: ArrayLike) -> np.ndarray | jax.Array:
    """Check that a value is a matrix (3, 3) or a quaternion wxyz (4,); return it, as float64 unless it is traced."""
    orientation = jnp.asarray(value) if traced(value) else numbers(function, name, value)
    if orientation.shape not in {(3, 3), (4,)}:
        raise InputError(f"{function}: {name} has shape {orientation.shape}; expected (3, 3), or (4,) as wxyz")
    if orientation.shape == (3, 3):
        rotations(function, name, orientation)
    elif not traced(orientation):
        norm = np.linalg.norm(orientation)
        if not abs(norm - 1) <= UNIT_NORM:  # NaN too
            raise InputError(f"{function}: {name} is {value}, of norm {norm:.4g}; expected a quaternion of norm 1")
    return orientation


def key(function: str, value) -> jax.Array:
    """Check that a value is one key of `jax.random.key` or the older `jax.random.PRNGKey`; return it."""
    shape, dtype = getattr(value, "shape", None), getattr(value, "dtype", np.dtype(object))
    if not (shape == () and jnp.issubdtype(dtype, jax.dtypes.prng_key)) and not (shape == (2,) and dtype == np.uint32):
        got = repr(value) if shape is None or shape == () else f"an array of shape {shape}"
        raise InputError(f"{function}: key is {got}; expected one random key, such as jax.random.key(0)")
    return value


def points(function: str, value: Any, name: str = "points") -> Any:
    """Check that a value is a point cloud that can be encoded, (points, 3), metres; return all of its points.

    Args:
        function: begins the message.
        value: array, numpy or jax.
        name: what the message calls it.

    Returns:
        The same array; a list as a numpy array, integers as float64.

    Raises:
        InputError: the shape is not (points, 3), there are fewer than 21, one is not finite, all are equal, or rows
            are no measurements, see `repeated_rows`.
    """
    if not isinstance(value, jax.Array):
        value = plain_array(function, name, value)
    if value.dtype.kind in "iu":
        value = value.astype(np.float32) if traced(value) else np.asarray(value, np.float64)
    if not jnp.issubdtype(value.dtype, np.floating):
        raise InputError(f"{function}: {name} has dtype {value.dtype}; expected floating point metres")
    if value.ndim != 2 or value.shape[1] != 3:
        raise InputError(f"{function}: {name} has shape {value.shape}; expected (points, 3){_transposed(value.shape)}")
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
            "metres. Remove them with tdf.drop_invalid(points), or --drop-invalid"
        )
    if not np.ptp(values, axis=0).any():
        raise InputError(
            f"{function}: the {len(values)} points of {name} are all equal to {values[0].tolist()}; expected a surface"
        )
    repeated = repeated_rows(values)
    if repeated:
        rows = ", ".join(f"{count} are {list(map(float, row))}" for row, count in repeated)
        raise InputError(
            f"{function}: of the {len(values)} points of {name}, {rows}; expected measurements. Sensors and converters "
            "write one value where they have none: remove such rows with tdf.drop_invalid(points), or --drop-invalid"
        )
    return value


def repeated_rows(values: np.ndarray) -> list[tuple[np.ndarray, int]]:
    """Find the rows of a cloud that stand for missing measurements: a value that is repeated far more than others.

    A value stands for a missing measurement if more than 1 % of the rows have it, the origin if two rows have it. In
    merged and quantised clouds, and among the corners of triangles, many values occur several times, and so may the
    origin. So a value counts only if it is also about twice as common as the ordinary ones, or if it is the origin and
    far from all other points. The eight most common values, or 2 % of all, may stand for missing measurements: a rig of
    several cameras moves the origin of each to another place.

    Args:
        values: finite points, (points, 3).

    Returns:
        Each such value with the number of its rows, the most common first.
    """
    values = np.ascontiguousarray(values) + 0  # 0 and -0 are one number
    _, first, counts = np.unique(_row_hashes(values), return_index=True, return_counts=True)
    most = min(max(SENTINELS, len(counts) // 50), len(counts) - 1)
    usual = 2 * np.sort(counts)[::-1][most] - 1
    distinct = values[first]
    origin = ~distinct.any(axis=1)
    least = np.where(origin, usual, max(SENTINEL_SHARE * len(values), 2, usual))
    if origin.any() and len(distinct) > 1:
        spacing = np.linalg.norm(np.ptp(distinct[~origin], axis=0)) / np.sqrt(len(distinct))
        if np.linalg.norm(distinct[~origin].astype(np.float64), axis=1).min() > 3 * spacing:
            least[origin] = 1
    chosen = np.flatnonzero(counts > least)
    return [(distinct[i], int(counts[i])) for i in chosen[np.argsort(-counts[chosen], kind="stable")]]


def _row_hashes(values: np.ndarray) -> np.ndarray:
    """One 64-bit number for each row; sorting these is far quicker than sorting rows."""
    words = values.astype(np.float64).view(np.uint64)
    hashes = np.zeros(len(values), np.uint64)
    for column in words.T:
        hashes = (hashes ^ column) * np.uint64(0x9E3779B97F4A7C15)
        hashes ^= hashes >> np.uint64(29)
    return hashes


def _transposed(shape: tuple[int, ...]) -> str:
    """The fix for the shapes that other libraries use."""
    if len(shape) == 2 and shape[0] == 3:
        return ". Transpose it: points.T"
    if len(shape) == 3 and shape[-1] == 3:
        return ". Flatten an organised cloud: points.reshape(-1, 3)"
    if len(shape) == 2 and shape[1] > 3:
        return ". Take the coordinates: points[:, :3], if they come first"
    return ""


def query(function: str, value) -> ArrayLike:
    """Check that a value is query points (queries, 3), at least one, finite; return it as an array."""
    if not isinstance(value, jax.Array):
        value = _native(numbers(function, "query", value), value)
    shape = np.shape(value)
    if len(shape) != 2 or shape[1] != 3 or shape[0] < 1:
        raise InputError(
            f"{function}: query points have shape {shape}; expected (queries, 3). Try tdf.box_query(key, count=500)"
        )
    if not traced(value) and not np.isfinite(np.asarray(value)).all():
        raise InputError(f"{function}: some query points are NaN or infinite; expected finite metres")
    return value


def _native(numbers: np.ndarray, given) -> np.ndarray:
    """The array that was given if JAX takes it as it is, otherwise its numbers in float64."""
    takes = (
        isinstance(given, np.ndarray) and given.dtype.isnative and given.dtype.kind in "fV" and not is_foreign(given)
    )
    return given if takes else numbers


def _in_words(size: int) -> str:
    return {3: "three", 4: "four", 7: "seven"}.get(size, str(size))


def _is_whole(value) -> bool:
    return isinstance(value, int | np.integer) and not isinstance(value, bool)


def _is_number(value) -> bool:
    try:
        return _is_real(value) and bool(np.isfinite(value))
    except (TypeError, OverflowError):  # not a number, or an integer of more than 64 bits
        return False


def _is_real(value) -> bool:
    return np.ndim(value) == 0 and np.asarray(value).dtype.kind in "fiu"  # a bool has a kind of its own


def _scalar(function, name, value):
    if np.ndim(value) != 0:
        raise InputError(f"{function}: {name} has shape {np.shape(value)}; expected one number")
    return value


def numbers(function: str, name: str, value) -> np.ndarray:
    """Check that a value is an array of real numbers; return it as float64."""
    try:
        array = plain_array(function, name, value)
        if array.dtype.kind in "cmMSU":  # complex numbers and dates would become other numbers, and so would text
            raise TypeError
        return np.asarray(array, dtype=np.float64)
    except jax.errors.TracerArrayConversionError:  # the boundary says which argument is traced
        raise
    except (TypeError, ValueError, OverflowError):
        raise InputError(f"{function}: {name} is {value!r}; expected real numbers") from None
