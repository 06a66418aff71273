"""Meshes in a folder and, if asked for, in its subfolders, as ShapeNet nests them."""

import contextlib
import itertools
import os
import warnings
from collections.abc import Iterator
from pathlib import Path

from tdf_jax._internal.deprecation import caller_level
from tdf_jax._internal.errors import InputError, TdfWarning
from tdf_jax.io.meshes import MESH_SUFFIXES

MOST_FOLDERS = 10_000  # folders that are searched for a hint; a user may name the root of a disk


def file_names(function: str, folder: Path, recursive: bool) -> list[str]:
    """Names of the files in a folder, sorted.

    Args:
        function: name that error messages begin with.
        folder: existing folder.
        recursive: whether to include those in subfolders, except hidden ones. Links to folders are followed. Each
            folder is visited once, so links may form loops.

    Returns:
        Paths relative to the folder, with slashes.

    Raises:
        InputError: a folder cannot be read.
    """
    folders = _folders(function, folder)
    return sorted(itertools.chain.from_iterable(folders if recursive else itertools.islice(folders, 1)))


def is_mesh(name: str) -> bool:
    """Whether the name of a file is that of a mesh.

    Args:
        name: name or path of the file.

    Returns:
        True for the suffix of a mesh format, unless the name begins with `._`: macOS keeps data of its own there.
    """
    last = Path(name).name
    return Path(last).suffix.lower() in MESH_SUFFIXES and not last.startswith("._")


def subfolder_hint(function: str, folder: Path) -> str:
    """What to do about meshes in subfolders.

    Args:
        function: name that error messages begin with.
        folder: existing folder.

    Returns:
        The hint, as the end of a message about the folder; empty if there are no meshes in subfolders.
    """
    count, complete = 0, True
    with contextlib.suppress(InputError):  # a hint needs no folder that cannot be read
        for number, files in enumerate(_folders(function, folder)):
            if number > MOST_FOLDERS:
                complete = False
                break
            count += sum(map(is_mesh, files)) if number else 0
    if not count:
        return ""
    number = f"{'' if complete else 'at least '}{count}"
    meshes = "mesh in subfolders, which is" if count == 1 else "meshes in subfolders, which are"
    return f"has {number} {meshes} not used; add --recursive, or recursive=True"


def warn_of_subfolders(function: str, folder: Path) -> None:
    """Warn that meshes in subfolders are not used.

    Args:
        function: name that the warning begins with.
        folder: existing folder.
    """
    hint = subfolder_hint(function, folder)
    if hint:
        warnings.warn(f"{function}: {folder} {hint}", TdfWarning, stacklevel=caller_level())


def _folders(function: str, folder: Path) -> Iterator[list[str]]:
    """Yield the relative paths of the files in the folder and then in each subfolder."""
    waiting, visited = [""], set()
    while waiting:
        inner = waiting.pop()
        try:
            status = (folder / inner).stat()
            if (status.st_dev, status.st_ino) in visited:
                continue
            visited.add((status.st_dev, status.st_ino))
            entries = {entry.name: _is_folder(entry) for entry in os.scandir(folder / inner)}
        except OSError as error:
            raise InputError(
                f"{function}: cannot read the folder {folder / inner} ({error.strerror}); expected a readable one; "
                "check its permissions"
            ) from None
        start = f"{inner}/" if inner else ""
        yield [start + name for name, is_folder in entries.items() if not is_folder]
        inside = sorted((name for name, is_folder in entries.items() if is_folder), reverse=True)
        waiting += [start + name for name in inside if not name.startswith((".", "__MACOSX"))]


def _is_folder(entry: os.DirEntry) -> bool:
    try:
        return entry.is_dir()
    except OSError:  # a link to itself
        return False
