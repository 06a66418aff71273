"""Atomic writes: a file or a folder appears under its name only once it is complete.

Unfinished ones have names such as `.result.json.5f0c92ab11d04e7f.unfinished` beside their targets. Their writers lock
them, so that the next writer of a target knows, and removes, what a killed one left.
"""

import contextlib
import errno
import hashlib
import os
import re
import secrets
import shutil
import stat
import sys
from collections.abc import Callable, Collection, Iterator
from pathlib import Path
from typing import BinaryIO

from tdf_jax._internal.errors import InputError

NEW, OLD = "unfinished", "replaced"  # endings of hidden names: what is written, and what it is about to replace
LONGEST = 180  # bytes of a name that a hidden name repeats; file systems allow 255
ATTEMPTS = 100  # times that a writer gives way to others of the same target
NO_SYNC = {errno.EINVAL, errno.ENOSYS, errno.ENOTSUP}  # errors of file systems that cannot be told to write at once


def replace_file(function: str, path: str | os.PathLike, content: bytes | Callable[[BinaryIO], None]) -> None:
    """Write a file under a temporary name beside it, then rename it into place.

    Args:
        function: name that error messages begin with.
        path: file to write, in an existing folder; an existing file is replaced, and a link's file instead of the link.
            A device or a pipe, such as /dev/stdout, is written to.
        content: bytes of the file, or a function that writes them to an open file.

    Raises:
        InputError: the file cannot be written.
    """
    write = (lambda file: file.write(content)) if isinstance(content, bytes) else content
    try:
        if os.path.exists(path) and not os.path.isfile(path):
            with open(path, "wb") as file:  # of a folder, this says what is wrong
                write(file)
            return
        target = Path(os.path.realpath(path))
        _remove_leftovers(target, ())
        with _temporary(target, NEW, _make_file) as temporary:
            with temporary.open("wb") as file:
                write(file)
                _sync(file)
            os.replace(temporary, target)
    except OSError as error:
        raise InputError(
            f"{function}: cannot write {path} ({error.strerror or error}); expected a writable file in an existing "
            "folder"
        ) from None


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
        InputError: before the block, the folder cannot be made or must not be replaced; after it, the folder cannot get
            its name, and the message says which name it has instead.
    """
    target = _resolved(function, path)
    try:
        _remove_leftovers(target, names)
        _check_replaceable(function, target, mark, names)
        with _temporary(target, NEW, Path.mkdir) as temporary:
            yield temporary
            _name_folder(function, temporary, target, mark, names)
    except OSError as error:
        raise InputError(
            f"{function}: cannot write {target} ({error.strerror or error}); expected a place in an existing, writable "
            "folder"
        ) from None


@contextlib.contextmanager
def temporary_folder(path: str | os.PathLike, names: Collection[str]) -> Iterator[Path]:
    """A folder that only this user can read, and that is gone after the block.

    Args:
        path: name that the folder's name is like. What killed processes left under this name is removed.
        names: all files that the folder may hold.

    Yields:
        The new, empty folder.
    """
    target = Path(path).resolve()
    _remove_leftovers(target, names)
    with _temporary(target, NEW, lambda folder: folder.mkdir(0o700)) as folder:
        yield folder


def _hidden(target: Path, ending: str) -> Path:
    """A new hidden name beside a target."""
    return target.with_name(f"{_start(target)}{secrets.token_hex(8)}.{ending}")


def _start(target: Path) -> str:
    name = os.fsencode(target.name)
    return f".{target.name if len(name) <= LONGEST else hashlib.sha256(name).hexdigest()}."


def _make_file(path: Path) -> None:
    os.close(os.open(path, os.O_CREAT | os.O_EXCL | os.O_WRONLY, 0o666))  # the mode that `open` gives, unlike mkstemp


def _sync(file: BinaryIO) -> None:
    """Bring a file to the disk, because some file systems report only then that it is full."""
    file.flush()
    try:
        os.fsync(file.fileno())
    except OSError as error:
        if error.errno not in NO_SYNC:
            raise


@contextlib.contextmanager
def _temporary(target: Path, ending: str, make: Callable[[Path], None]) -> Iterator[Path]:
    """A new file or folder beside a target, locked during the block and gone after it."""
    with contextlib.ExitStack() as stack:
        for _ in range(ATTEMPTS):
            temporary = _hidden(target, ending)
            stack.callback(_remove, temporary)  # before it is made, because an interruption may come at once
            make(temporary)
            with contextlib.suppress(BlockingIOError):
                stack.enter_context(_locked(temporary))
                if temporary.exists():
                    break
            # Until it was locked, another writer could take it for a leftover.
        else:
            raise OSError(errno.EBUSY, os.strerror(errno.EBUSY))
        yield temporary


@contextlib.contextmanager
def _locked(path: Path) -> Iterator[int | None]:
    """Hold the lock of a file or a folder.

    Yields:
        The open file; None if the file system has no locks.

    Raises:
        BlockingIOError: somebody holds the lock.
    """
    if sys.platform == "win32":
        yield None
        return
    import fcntl

    try:
        number = os.open(path, os.O_RDONLY if path.is_dir() else os.O_RDWR)
    except OSError:
        yield None
        return
    try:
        try:
            fcntl.flock(number, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise
        except OSError:
            held = None
        else:
            held = number
        yield held
    finally:
        os.close(number)


def _remove(path: Path) -> None:
    """Remove a temporary file or folder, if it is still there."""
    if path.is_dir():
        shutil.rmtree(path, ignore_errors=True)
    else:
        with contextlib.suppress(OSError):
            path.unlink()


def _remove_leftovers(target: Path, names: Collection[str]) -> None:
    """Remove what killed writers of a target left, and put back a folder that one was about to replace.

    Only what can be locked is removed: a living writer holds the lock.

    Args:
        target: the file or the folder.
        names: all files that the folder may hold; a leftover with others stays.
    """
    leftover = re.compile(re.escape(_start(target)) + rf"[0-9a-f]{{16}}\.({NEW}|{OLD})")
    with contextlib.suppress(OSError):  # a leftover is no reason to fail; the writer will say what is wrong
        found = [match for match in map(leftover.fullmatch, os.listdir(target.parent)) if match]
        for match in found:
            path = target.with_name(match[0])
            with contextlib.suppress(OSError), _locked(path) as lock:
                # Its writer may have renamed it just before.
                if lock is not None and os.path.samestat(os.fstat(lock), path.lstat()):
                    _remove_leftover(path, target, match[1], names)


def _remove_leftover(path: Path, target: Path, ending: str, names: Collection[str]) -> None:
    """Remove one leftover, or put it back if it is the only result; one that cannot be removed stays."""
    with contextlib.suppress(OSError):
        if ending == OLD and not target.exists():
            os.rename(path, target)
        elif path.is_dir():
            _remove_result(path, names)
        else:
            path.unlink()


def _remove_result(folder: Path, names: Collection[str]) -> None:
    """Remove a folder if it holds nothing but files of a result, finished or not."""
    starts = tuple(_start(folder / name) for name in names)
    entries = list(os.scandir(folder))
    if all((entry.name in names or entry.name.startswith(starts)) and entry.is_file() for entry in entries):
        for entry in entries:
            os.unlink(entry.path)
        folder.rmdir()


def _name_folder(function: str, folder: Path, target: Path, mark: str, names: Collection[str]) -> None:
    """Give a finished folder its name, or a free one like it, because its contents may have taken hours."""
    try:
        _check_replaceable(function, target, mark, names)  # again, because files may have come since
        _rename_folder(folder, target, names)
    except (OSError, InputError) as error:
        other = target.with_name(f"{target.name}-{secrets.token_hex(4)}")
        os.rename(folder, other)
        reason = error.strerror if isinstance(error, OSError) else str(error).removeprefix(f"{function}: ")
        raise InputError(f"{function}: cannot write {target} ({reason}); the finished result is in {other}") from None


def _rename_folder(folder: Path, target: Path, names: Collection[str]) -> None:
    """Rename a folder, and remove an earlier result in its place, which is put back if that fails."""
    with contextlib.ExitStack() as stack:
        for _ in range(ATTEMPTS):  # another writer of the same target may come between two steps
            try:
                os.rename(folder, target)
                return
            except OSError as error:
                if error.errno not in (errno.ENOTEMPTY, errno.EEXIST):
                    raise
            with contextlib.suppress(BlockingIOError):
                stack.enter_context(_locked(target))
            old = _hidden(target, OLD)
            stack.callback(_remove_leftover, old, target, OLD, names)
            with contextlib.suppress(FileNotFoundError):
                os.rename(target, old)
        raise OSError(errno.EBUSY, os.strerror(errno.EBUSY))


def _check_replaceable(function: str, target: Path, mark: str, names: Collection[str]) -> None:
    try:
        found = target.stat()
    except FileNotFoundError:
        return
    if not stat.S_ISDIR(found.st_mode):
        raise InputError(f"{function}: {target} is a file; expected a folder, or a new name for one")
    if target == Path.cwd() or os.path.ismount(target):
        raise InputError(
            f"{function}: {target} is the current folder or a mount point, which cannot be replaced as a whole; "
            "expected a folder inside it"
        )
    with contextlib.suppress(FileNotFoundError):
        entries = {entry.name: entry.is_file() for entry in os.scandir(target)}
        others = [name for name, is_file in entries.items() if not (is_file and name in names)]
        if not others and (mark in entries or not entries):
            return
        if os.path.samestat(found, target.stat()):
            listed = ", ".join(sorted(others)[:3]) or f"no {mark}"
            raise InputError(
                f"{function}: {target} is not empty and holds more than an earlier result ({listed}); "
                "expected a new folder: nothing of yours is overwritten"
            )
    _check_replaceable(function, target, mark, names)  # another writer has replaced it meanwhile


def _resolved(function: str, path: str | os.PathLike) -> Path:
    try:
        return Path(path).resolve()
    except (OSError, RuntimeError, ValueError) as error:  # a loop of links, or a zero byte
        raise InputError(
            f"{function}: cannot write {path!r} ({error}); expected a name that a folder can have"
        ) from None
