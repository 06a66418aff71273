"""Random keys, checked where a user gives one."""

import jax
import numpy as np
from numpy.typing import ArrayLike

from tdf_jax._internal.errors import InputError


def check_key(function: str, key) -> None:
    """Raise InputError unless it is one random key, of `jax.random.key` or the older `jax.random.PRNGKey`."""
    shape, dtype = getattr(key, "shape", None), getattr(key, "dtype", np.dtype(object))
    if not (shape == () and jax.dtypes.issubdtype(dtype, jax.dtypes.prng_key)) and not (
        shape == (2,) and dtype == np.uint32
    ):
        got = repr(key) if shape is None or shape == () else f"an array of shape {shape}"
        raise InputError(f"{function}: key is {got}; expected one random key, such as jax.random.key(0)")


MINIMUM_POINTS = 21  # the encoder's 20 nearest neighbours, the point itself included, and one to choose from


def check_points(points, name: str = "points"):
    """Check that an array can be encoded as a point cloud; nothing is changed or dropped.

    Under `jax.jit` only the shape is checked: the values are not known yet.

    Args:
        points: Array (points, 3), numpy or jax, metres.
        name: What the message calls it.

    Returns:
        The same array; a list as a numpy array, integers as float32.

    Raises:
        InputError: If the shape is not (points, 3), there are fewer than 21, one is not finite, or all are equal.
    """
    if not isinstance(points, jax.Array):
        try:
            points = np.asarray(points)
        except ValueError as error:
            raise InputError(f"check_points(): {name} is not an array of numbers: {error}") from error
    if points.dtype.kind in "iu":
        points = points.astype(np.float32)
    if not jax.numpy.issubdtype(points.dtype, np.floating):
        raise InputError(f"check_points(): {name} has dtype {points.dtype}; expected floating point metres.")
    if points.ndim != 2 or points.shape[1] != 3:
        raise InputError(f"check_points(): {name} has shape {points.shape}; expected (points, 3).")
    if len(points) < MINIMUM_POINTS:
        raise InputError(
            f"check_points(): {name} has {len(points)} points; expected at least {MINIMUM_POINTS} "
            "(the encoder looks at 20 neighbours). Use a denser cloud."
        )
    if isinstance(points, jax.core.Tracer):
        return points
    values = np.asarray(points)
    bad = np.count_nonzero(~np.isfinite(values).all(axis=1))
    if bad:
        raise InputError(
            f"check_points(): {bad} of the {len(values)} points of {name} are NaN or infinite; expected finite "
            "metres. Remove them: points[np.isfinite(points).all(axis=1)]."
        )
    if not np.ptp(values, axis=0).any():
        raise InputError(
            f"check_points(): the {len(values)} points of {name} are all equal to {values[0].tolist()}; "
            "expected a surface."
        )
    return points


def check_count(function: str, poses: int) -> None:
    """Raise InputError unless there can be so many poses."""
    if not isinstance(poses, int | np.integer) or poses < 2:
        raise InputError(f"{function}(): poses is {poses}; expected a whole number of at least 2, pick and place.")


def check_rotations(function: str, R: ArrayLike) -> None:
    """Raise InputError unless all are rotation matrices."""
    R = np.asarray(R, dtype=np.float64)
    if not (np.allclose(R @ np.swapaxes(R, -1, -2), np.eye(3), atol=1e-3) and (np.linalg.det(R) > 0).all()):
        raise InputError(f"{function}(): a rotation matrix is not orthonormal with determinant 1, or not finite.")


def checked_vector(function: str, name: str, value: ArrayLike) -> np.ndarray:
    """Three finite numbers as float64, or InputError."""
    vector = np.asarray(value, dtype=np.float64)
    if vector.shape != (3,) or not np.isfinite(vector).all():
        raise InputError(f"{function}(): {name} is {value}; expected three finite numbers, metres.")
    return vector


def check_query(function: str, query) -> None:
    """Raise InputError unless query points are (queries, 3), at least one, and finite."""
    shape = np.shape(query)
    if len(shape) != 2 or shape[1] != 3 or shape[0] < 1:
        raise InputError(
            f"{function}: query points have shape {shape}; expected (queries, 3). Try tdf.box_query(key, count=500)"
        )
    if not isinstance(query, jax.core.Tracer) and not np.isfinite(np.asarray(query)).all():
        raise InputError(f"{function}: some query points are NaN or infinite; expected finite metres")
