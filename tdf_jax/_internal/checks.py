"""Random keys, checked where a user gives one."""

import jax
import numpy as np

from tdf_jax._internal.errors import InputError


def check_key(function: str, key) -> None:
    """Raise InputError unless it is one random key, of `jax.random.key` or the older `jax.random.PRNGKey`."""
    shape, dtype = getattr(key, "shape", None), getattr(key, "dtype", np.dtype(object))
    if not (shape == () and jax.dtypes.issubdtype(dtype, jax.dtypes.prng_key)) and not (shape == (2,) and dtype == np.uint32):
        got = repr(key) if shape is None or shape == () else f"an array of shape {shape}"
        raise InputError(f"{function}: key is {got}; expected one random key, such as jax.random.key(0)")
