"""Writing whole: a file or a folder appears under its name only once it is complete; what took long to compute is kept."""

import contextlib
import hashlib
import json
import os
import shutil
from collections.abc import Callable, Collection, Iterator, Mapping
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import ArrayLike

from tdf_jax._internal.errors import InputError


def replace_file(function: str, path: str | os.PathLike, content: bytes | Callable[[BinaryIO], None]) -> None:
    """Write a file under a temporary name beside it, then rename it into place.

    Args:
        function: who writes, for the message.
        path: the file, in an existing folder; replaced if it exists.
        content: its bytes, or a function that writes them to an open file.

    Raises:
        InputError: the file cannot be written.
    """
    target = Path(path)
    temporary = _beside(target)
    try:
        with temporary.open("wb") as file:
            if isinstance(content, bytes):
                file.write(content)
            else:
                content(file)
        os.replace(temporary, target)
    except OSError as error:
        raise InputError(
            f"{function}(): cannot write {target} ({error}); expected a writable file in an existing folder"
        ) from None
    finally:
        with contextlib.suppress(OSError):
            temporary.unlink()


def kept(
    function: str,
    folder: Path,
    about: Any,
    compute: Callable[[], Mapping[str, ArrayLike]],
    build: Callable[[dict[str, np.ndarray]], Any] = dict,
) -> Any:
    """What is made of arrays from a folder of such, or computed and put there.

    Args:
        function: who asks, for the message.
        folder: receives one .npz; it exists.
        about: all that the arrays depend on, as JSON has it; the file's name is its digest.
        compute: makes them where they are missing.
        build: of the arrays by name, what is returned.

    Raises:
        InputError: the file cannot be written, is damaged, or holds something else.
    """
    digest = hashlib.sha256(json.dumps(about, sort_keys=True).encode()).hexdigest()
    path = folder / f"{digest[:20]}.npz"
    if not path.exists():
        arrays = dict(compute())
        replace_file(function, path, lambda file: np.savez(file, **arrays))
        return build({name: np.asarray(array) for name, array in arrays.items()})
    try:
        with path.open("rb") as opened, np.load(opened) as file:
            return build(dict(file))
    except Exception as error:  # damaged files raise whatever their parser stumbles on
        raise InputError(f"{function}: {path} cannot be read ({error}); delete it: it is computed again") from None


@contextlib.contextmanager
def replace_folder(function: str, path: str | os.PathLike, mark: str, names: Collection[str]) -> Iterator[Path]:
    """A folder to fill, which gets its name only if the block ends without an exception; else nothing is left.

    Args:
        function: who writes, for the message.
        path: the folder, in an existing one. One that exists is replaced as a whole, if it is empty or was written
            before: it holds `mark` and nothing but `names`.
        mark: the file by which an earlier folder is known.
        names: all files that may be in one.

    Yields:
        A new, empty folder beside `path`.

    Raises:
        InputError: the folder cannot be made or must not be replaced (before the block), or not be written (after it).
    """
    target = Path(path).resolve()
    _check_replaceable(function, target, mark, names)
    temporary = _beside(target)
    try:
        temporary.mkdir()
        yield temporary
        _rename_folder(temporary, target)
    except OSError as error:
        raise InputError(
            f"{function}: cannot write {target} ({error}); expected a place in an existing, writable folder"
        ) from None
    finally:
        shutil.rmtree(temporary, ignore_errors=True)


def _beside(target: Path, ending: str = "") -> Path:
    return target.with_name(f".{target.name}.{os.getpid()}{ending}")


def _rename_folder(folder: Path, target: Path) -> None:
    if not target.exists():
        os.rename(folder, target)
        return
    old = _beside(target, ".old")  # a folder with files in it cannot be renamed onto
    os.rename(target, old)
    try:
        os.rename(folder, target)
    except OSError:
        os.rename(old, target)
        raise
    shutil.rmtree(old, ignore_errors=True)


def _check_replaceable(function: str, target: Path, mark: str, names: Collection[str]) -> None:
    if not target.is_dir():
        if target.exists():
            raise InputError(f"{function}: {target} is a file; expected a folder, or a new name for one")
        return
    if target == Path.cwd() or target.is_mount():
        raise InputError(
            f"{function}: {target} is the current folder or a mount point, which cannot be replaced as a whole; "
            "expected a folder inside it"
        )
    found = {entry.name for entry in target.iterdir()}
    if found and not (mark in found and found <= set(names)):
        others = ", ".join(sorted(found - set(names))[:3]) or f"no {mark}"
        raise InputError(
            f"{function}: {target} is not empty and holds more than an earlier result ({others}); "
            "expected a new folder: nothing of yours is overwritten"
        )
