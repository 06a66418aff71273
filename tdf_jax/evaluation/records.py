"""JSON records of evaluations: the header that all of them share."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import jax

from tdf_jax._internal.files import replace_file
from tdf_jax._internal.version import __version__
from tdf_jax.networks.model import Model

# Raised when a key changes its name or its meaning. `tdf evaluate` wrote 2 and `tdf benchmark` 1 before they shared it.
SCHEMA = 3


def header(settings: Mapping[str, Any], model: Model) -> dict[str, Any]:
    """The keys that every record begins with.

    Args:
        settings: settings of the command, as JSON has them.
        model: the network.

    Returns:
        "schema", "tdf_jax" (the version), "settings", "weights" and "machine".
    """
    return {
        "schema": SCHEMA,
        "tdf_jax": __version__,
        "settings": dict(settings),
        "weights": {"name": model.info.name, "source": model.info.source},
        "machine": {"jax": jax.__version__, "backend": jax.default_backend()},
    }


def folder_name(folder: Path | None) -> str | None:
    """Name of a folder without the path to it, which says something of the user's machine and nothing of the result.

    Args:
        folder: the folder; None if there is none.
    """
    return None if folder is None else folder.resolve().name


def write_record(function: str, path: Path, record: Mapping[str, Any], indent: int | None = 1) -> None:
    """Write a record; the file appears only once it is complete.

    Args:
        function: the command that writes, for the message.
        path: the file, in an existing folder.
        record: the header and the results, as JSON has them.
        indent: spaces of each level; None for a single line.

    Raises:
        InputError: the file cannot be written.
    """
    replace_file(function, path, (json.dumps(record, indent=indent, allow_nan=False) + "\n").encode())
