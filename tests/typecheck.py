"""The checker of annotations for `make test-types`: beartype and jaxtyping, with the habits of NumPy's users."""

import re
from typing import Any

import jax
import jaxtyping
import numpy as np
import pytest
from beartype import BeartypeConf, FrozenDict, beartype
from numpy.typing import ArrayLike

# What is ArrayLike is anything that NumPy makes an array of, and beartype would refuse a tuple of numbers.
TAKEN = FrozenDict({ArrayLike: Any, ArrayLike | None: Any})
# A whole number is a float, as for Python.
checked = beartype(conf=BeartypeConf(is_pep484_tower=True, hint_overrides=TAKEN))

# Functions take NumPy's arrays where they take JAX's; shapes and kinds of numbers are what is checked.
jaxtyping.Array = jax.Array | np.ndarray


def raises(expected, *args, match: str | re.Pattern | None = None, raises=pytest.raises, **kwargs):
    """`pytest.raises`, for which the checker may refuse an input of a wrong type or shape before the library does."""
    from tdf_jax._internal.errors import InputError  # not before the modules that are to be checked

    if expected is not InputError:
        return raises(expected, *args, match=match, **kwargs)

    def refused(error: Exception) -> bool:
        # Of an argument, not of a result; also where the library repeats the message in its own.
        refused_by_type = "Type-check error whilst checking the parameters" in str(error)
        return refused_by_type or match is None or re.search(match, str(error)) is not None

    return raises((InputError, jaxtyping.TypeCheckError), *args, check=refused, **kwargs)
