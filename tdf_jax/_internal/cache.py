"""Results on disk under a digest of all that they depend on: an interrupted run computes only what is missing."""

import hashlib
import json
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from tdf_jax._internal.errors import InputError
from tdf_jax._internal.files import replace_file


def digest(*parts: bytes | ArrayLike) -> str:
    """SHA-256 of byte strings and of the bytes of arrays, one after the other, as 64 hexadecimal digits."""
    content = hashlib.sha256()
    for part in parts:
        content.update(part if isinstance(part, bytes) else np.asarray(part).tobytes())
    return content.hexdigest()


def kept(
    function: str,
    folder: Path,
    about: Any,
    compute: Callable[[], Mapping[str, ArrayLike]],
    build: Callable[[dict[str, np.ndarray]], Any] = dict,
) -> Any:
    """A result that is read from a folder, or computed and written there.

    Args:
        function: name that error messages begin with.
        folder: existing folder of .npz files, one for every result.
        about: all that the result depends on, as JSON values; their digest names the file.
        compute: makes the arrays of a result by name; called if the file does not exist.
        build: makes the result of its arrays.

    Returns:
        What `build` returns.

    Raises:
        InputError: the file cannot be written, is damaged, or contains other arrays than `build` needs.
    """
    path = folder / f"{digest(json.dumps(about, sort_keys=True).encode())[:20]}.npz"
    if not path.exists():
        arrays: dict[str, Any] = dict(compute())
        replace_file(function, path, lambda file: np.savez(file, **arrays))
        return build({name: np.asarray(array) for name, array in arrays.items()})
    try:
        with path.open("rb") as opened, np.load(opened) as file:
            return build(dict(file))
    except Exception as error:  # damaged files raise whatever their parser stumbles on
        raise InputError(f"{function}: {path} cannot be read ({error}); delete it, and it is computed again") from None
