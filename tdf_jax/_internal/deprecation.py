"""Names of the release before: accepted for one release, with a DeprecationWarning."""

import dataclasses
import functools
import warnings

from tdf_jax._internal.errors import InputError


def warn(old: str, new: str, stacklevel: int = 3) -> None:
    """Warn that a name goes; `stacklevel` as for `warnings.warn`, counted from the function that calls this one."""
    warnings.warn(f"{old} is deprecated; use {new}", DeprecationWarning, stacklevel=stacklevel)


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
