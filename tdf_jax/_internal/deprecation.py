"""Names of the release before: accepted for one release, with a DeprecationWarning."""

import dataclasses
import functools
import os
import sys
import warnings
from pathlib import Path

from tdf_jax._internal.errors import InputError

# Frames of these files are not the caller's: the package itself, and what calls constructors on a caller's behalf.
_LIBRARY = (f"{Path(__file__).parents[1]}{os.sep}", dataclasses.__file__)


def caller_level() -> int:
    """`stacklevel` for a `warnings.warn` of the calling function that points to the first frame outside the library.

    Python shows a DeprecationWarning by default only where it points to a user's own code.
    """
    level, frame = 1, sys._getframe(1)
    while frame.f_back is not None and _is_ours(frame.f_code):
        level, frame = level + 1, frame.f_back
    return level


def _is_ours(code) -> bool:
    generated = code.co_filename == "<string>" and code.co_name == "__init__"  # by `dataclasses.dataclass`
    return generated or code.co_filename.startswith(_LIBRARY)


def warn(old: str, new: str) -> None:
    """Warn that a name is deprecated, at the line of the user's code that has it."""
    warnings.warn(f"{old} is deprecated; use {new}", DeprecationWarning, stacklevel=caller_level())


def renamed_keywords(**new_names: str):
    """Decorator of a function whose keywords were renamed: `renamed_keywords(poses="num_poses")`."""

    def decorate(function):
        @functools.wraps(function)
        def accepting(*arguments, **keywords):
            for old, new in new_names.items():
                if old in keywords:
                    if new in keywords:
                        raise InputError(f"{function.__name__}(): got {new} and {old}, its former name; expected {new}")
                    warn(f"{function.__name__}({old}=...)", f"{new}=")
                    keywords[new] = keywords.pop(old)
            return function(*arguments, **keywords)

        return accepting

    return decorate


def renamed_fields(**new_names: str | tuple[str, ...]):
    """Decorator of a dataclass whose fields were renamed: old keywords and attributes still work.

    An old keyword takes precedence over the new one, because `dataclasses.replace(config, old=...)` passes both.

    A field that was a tuple by position may have become several fields: `renamed_fields(steps=("first_steps",
    "last_steps"))`.
    """

    def decorate(cls):
        original = cls.__init__

        @functools.wraps(original)
        def accepting(self, *arguments, **keywords):
            for old, new in new_names.items():
                if old not in keywords:
                    continue
                value, several = keywords.pop(old), isinstance(new, tuple)
                names = new if isinstance(new, tuple) else (new,)
                values = tuple(value) if several and isinstance(value, tuple | list) else (value,)
                if len(values) != len(names):
                    raise InputError(f"{cls.__name__}(): {old} is {value!r}; expected {', '.join(names)}")
                warn(f"{cls.__name__}({old}=...)", ", ".join(f"{name}=" for name in names))
                keywords.update(zip(names, values))
            original(self, *arguments, **keywords)

        cls.__init__ = accepting
        fields = {field.name for field in dataclasses.fields(cls)}
        for old, new in new_names.items():
            if old not in fields:
                setattr(cls, old, _renamed_attribute(cls.__name__, old, new))
        return cls

    return decorate


def _renamed_attribute(name: str, old: str, new: str | tuple[str, ...]) -> property:
    def get(self):
        warn(f"{name}.{old}", f"{name}.{new}" if isinstance(new, str) else ", ".join(new))
        return getattr(self, new) if isinstance(new, str) else tuple(getattr(self, one) for one in new)

    return property(get, doc=f"Former name of `{new}`.")
