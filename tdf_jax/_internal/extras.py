"""Modules of packages that an extra installs."""

import importlib
from typing import Any

from tdf_jax._internal.errors import InputError


def from_extra(function: str, module: str, extra: str, package: str | None = None) -> Any:
    """Import a module that an extra installs.

    Args:
        function: name that the error message begins with, such as "inside()".
        module: name of the module.
        extra: name of the extra.
        package: name of the package that has the module; by default the same.

    Returns:
        The module.

    Raises:
        InputError: it is not installed.
    """
    try:
        return importlib.import_module(module)
    except ImportError:
        raise InputError(
            f"{function}: {package or module} is not installed; expected the extra {extra!r}; run: "
            f"pip install 'tdf_jax[{extra}]'"
        ) from None
