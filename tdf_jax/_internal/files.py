"""Atomic writes: a file or a folder appears under its name only once it is complete."""

import contextlib
import os
import shutil
from collections.abc import Callable, Collection, Iterator
from pathlib import Path
from typing import BinaryIO

from tdf_jax._internal.errors import InputError


def replace_file(function: str, path: str | os.PathLike, content: bytes | Callable[[BinaryIO], None]) -> None:
    """Write a file under a temporary name beside it, then rename it into place.

    Args:
        function: name that error messages begin with.
        path: file to write, in an existing folder; an existing file is replaced.
        content: bytes of the file, or a function that writes them to an open file.

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


@contextlib.contextmanager
def replace_folder(function: str, path: str | os.PathLike, mark: str, names: Collection[str]) -> Iterator[Path]:
    """Fill a folder that gets its name only if the block ends without an exception; otherwise it is removed.

    Args:
        function: name that error messages begin with.
        path: folder to write, in an existing one. An existing folder is replaced as a whole if it is empty or an
            earlier result: it holds `mark` and nothing but `names`.
        mark: file that identifies an earlier result.
        names: all files that a result may hold.

    Yields:
        A new, empty folder beside `path`.

    Raises:
        InputError: before the block, the folder cannot be made or must not be replaced; after it, the folder cannot be
            written.
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
