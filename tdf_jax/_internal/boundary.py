"""The boundary of the library: what the caller's settings of JAX, traced values and foreign arrays become there."""

import contextlib
import dataclasses
import functools
import inspect
import itertools
import threading
from collections.abc import Callable, Iterable, Iterator
from typing import Any, TypeVar, cast

import jax
import jax.core
import jax.numpy as jnp
import numpy as np

from tdf_jax._internal.devices import platform_problem
from tdf_jax._internal.errors import InputError

F = TypeVar("F", bound=Callable)

# Settings with which callers find mistakes in their own code: values that leave the library alone, and the context that
# sets the first of them. `jax_debug_nans` is not among them: no computation of the library produces a NaN. NaN in a
# result is written from the host and means unknown.
_OWN_SETTINGS = {
    "jax_numpy_rank_promotion": (("allow",), jax.numpy_rank_promotion),
    "jax_numpy_dtype_promotion": (("standard",), jax.numpy_dtype_promotion),
    "jax_transfer_guard_host_to_device": (("allow", None), jax.transfer_guard_host_to_device),
    "jax_transfer_guard_device_to_device": (("allow", None), jax.transfer_guard_device_to_device),
    "jax_transfer_guard_device_to_host": (("allow", None), jax.transfer_guard_device_to_host),
    "jax_debug_infs": ((False,), jax.debug_infs),
}
_UNKNOWN_NUMBERS = (
    jax.errors.ConcretizationTypeError,
    jax.errors.TracerArrayConversionError,
    jax.errors.TracerIntegerConversionError,
    jax.errors.NonConcreteBooleanIndexError,
)
_calls = threading.local()  # whether a call of this thread has crossed the boundary


def public(function: F) -> F:
    """Decorator of a public function or method.

    The caller's `jax_numpy_rank_promotion`, `jax_numpy_dtype_promotion`, `jax_transfer_guard` and `jax_debug_infs` do
    not apply inside. Arguments that are arrays of other libraries become numpy arrays, see `plain_array`. An
    `InputError` names the function if it needs numbers that are traced, or if JAX has no device to run on.
    """
    return _guarded(function, host=False)


def host(function: F) -> F:
    """Decorator of a public function that cannot be a part of a traced one, because it runs programs of its own.

    As `public`, but a call inside of `jax.jit`, or with traced numbers, is refused before anything is computed.
    """
    return _guarded(function, host=True)


def _guarded(function: F, host: bool) -> F:
    name = function.__qualname__.removesuffix(".__post_init__") + "()"

    @functools.wraps(function)
    def guarded(*arguments, **keywords):
        if getattr(_calls, "inside", False):
            return function(*arguments, **keywords)
        _calls.inside = True
        try:
            with own_settings():
                arguments, keywords = _plain(function, name, arguments, keywords)
                if host and any(
                    isinstance(one, jax.core.Tracer) for one in _leaves([arguments, keywords, jnp.zeros(())])
                ):
                    raise InputError(f"{name}: {_traced(function, arguments, keywords)}")
                return function(*arguments, **keywords)
        except InputError:
            raise
        except _UNKNOWN_NUMBERS:
            raise InputError(f"{name}: {_traced(function, arguments, keywords)}") from None
        except Exception:
            problem = platform_problem()
            if problem is None:
                raise
            raise InputError(f"{name}: {problem}") from None
        finally:
            _calls.inside = False

    return cast(F, guarded)


@contextlib.contextmanager
def own_settings():
    """Compute under the library's settings of JAX; those that the caller has not changed cost nothing."""
    with contextlib.ExitStack() as stack:
        for name, (neutral, context) in _OWN_SETTINGS.items():
            if getattr(jax.config, name) not in neutral:
                stack.enter_context(context(neutral[0]))
        yield


def plain_array(function: str, name: str, value) -> np.ndarray:
    """Convert an array of another library, such as a torch tensor, a pandas table or a masked array.

    A tensor that requires a gradient is detached, and one on another device is copied. The columns of a table that are
    called x, y and z are taken in this order.

    Args:
        function: begins the message.
        name: what the message calls the value.
        value: the array.

    Returns:
        The numbers as a numpy array.

    Raises:
        InputError: a number is masked, or the value cannot be converted.
    """
    if isinstance(value, np.ma.MaskedArray):
        masked = np.count_nonzero(np.ma.getmaskarray(value))
        if masked:
            fix = f"Remove their rows: np.asarray(np.ma.compress_rows({name}))" if value.ndim == 2 else "Fill them"
            raise InputError(
                f"{function}: {masked} of the {value.size} numbers of {name} are masked; expected known numbers. {fix}"
            )
        return np.asarray(value)
    try:
        for step in ("detach", "cpu"):
            value = getattr(value, step)() if callable(getattr(value, step, None)) else value
        named = [column for column in getattr(value, "columns", ()) if str(column).lower() in ("x", "y", "z")]
        if len(named) == 3 == len(value.columns):
            value = value[sorted(named, key=lambda column: str(column).lower())]
        return np.asarray(value)
    except _UNKNOWN_NUMBERS:
        raise
    except Exception as error:  # every library raises its own
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise InputError(
            f"{function}: {name} is a {type(value).__name__} that cannot be read as an array ({reason}); expected "
            "numbers. Convert it to a numpy array of numbers"
        ) from None


def is_foreign(value) -> bool:
    """Whether a value is an array of another library, or one whose numbers may be masked."""
    if isinstance(value, np.ma.MaskedArray):
        return True
    return hasattr(type(value), "__array__") and not isinstance(value, np.ndarray | np.generic | jax.Array)


def _plain(function, name: str, arguments: tuple, keywords: dict) -> tuple[tuple, dict]:
    """The arguments, foreign arrays among them and in their lists converted."""
    if not any(map(_holds_foreign, (*arguments, *keywords.values()))):
        return arguments, keywords
    names = itertools.chain(inspect.signature(function).parameters, itertools.repeat("an argument"))

    def plain(argument, value):
        if type(value) in (list, tuple):
            return type(value)(plain(argument, one) for one in value)
        return plain_array(name, argument, value) if is_foreign(value) else value

    return tuple(map(plain, names, arguments)), {
        argument: plain(argument, value) for argument, value in keywords.items()
    }


def _holds_foreign(value) -> bool:
    return any(map(is_foreign, value)) if type(value) in (list, tuple) else is_foreign(value)


def _traced(function, arguments: tuple, keywords: dict) -> str:
    """What to do about numbers that are not known because a transformation of JAX traces them."""
    bound = inspect.signature(function).bind_partial(*arguments, **keywords).arguments
    names = [name for name, value in bound.items() if any(isinstance(one, jax.core.Tracer) for one in _leaves(value))]
    why = "expected known numbers"
    if names:
        got = f"{', '.join(names)} {'is' if len(names) == 1 else 'are'} traced by jax.jit, jax.vmap or jax.grad"
        return f"{got}; {why}. Call it outside of the function that is traced"
    return f"it is called inside a function that jax.jit traces; {why}. Call it outside of it, and pass its result in"


def _leaves(value) -> Iterable[Any]:
    """Arrays of a value; dataclasses that are no pytrees, such as `Demonstration`, are searched too."""
    for leaf in jax.tree.leaves(value, is_leaf=lambda part: isinstance(part, Iterator)):
        if dataclasses.is_dataclass(leaf) and not isinstance(leaf, type):
            for field in dataclasses.fields(leaf):
                yield from _leaves(getattr(leaf, field.name))
        else:
            yield leaf
