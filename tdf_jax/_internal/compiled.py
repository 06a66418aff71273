"""Compiled programs that are kept on disk, so that the next process does not compile them again."""

import contextlib
import hashlib
import os
import platform
from collections.abc import Iterator
from importlib.metadata import version
from pathlib import Path

import jax

FOLDER = "JAX_COMPILATION_CACHE_DIR"
# Settings of JAX by their environment variables, which started processes inherit. Most programs of a command compile in
# less than a second, the least that JAX keeps by default.
SETTINGS = {FOLDER: "", "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0.05"}
LARGEST = 1 << 30  # bytes; beyond it the programs that were not used for the longest time are removed


def user_cache(name: str) -> Path:
    """A folder of the library in the user's cache, `$XDG_CACHE_HOME` or `~/.cache`; it may not exist.

    Args:
        name: name of the folder.
    """
    cache = os.environ.get("XDG_CACHE_HOME") or os.path.join(os.path.expanduser("~"), ".cache")
    return Path(cache) / "tdf_jax" / name


@contextlib.contextmanager
def kept_compiled() -> Iterator[None]:
    """Keep compiled programs of this process and of those that it starts in the user's cache.

    A user who has chosen a folder for JAX keeps it. Where the cache cannot be written, nothing is kept: JAX compiles.
    """
    chosen = FOLDER in os.environ or getattr(jax.config, FOLDER.lower())
    folder = None if chosen else _folder()
    if folder is None:
        yield
        return
    values = SETTINGS | {FOLDER: str(folder)}
    before = {name: os.environ.get(name) for name in values}
    of_process = {name.lower(): getattr(jax.config, name.lower()) for name in values}
    os.environ.update(values)
    try:
        for name, value in values.items():
            jax.config.update(name.lower(), value if name == FOLDER else float(value))
        yield
    finally:
        for name, value in before.items():
            if value is None:
                os.environ.pop(name, None)
            else:
                os.environ[name] = value
        for name, value in of_process.items():
            jax.config.update(name, value)


def _folder() -> Path | None:
    """The folder of this version of XLA and of this kind of processor, whose programs no other may run."""
    kind = hashlib.sha256(_processor().encode()).hexdigest()[:12]
    folder = user_cache("compiled") / f"jaxlib-{version('jaxlib')}-{kind}"
    try:
        folder.mkdir(parents=True, exist_ok=True)
        if not os.access(folder, os.W_OK | os.X_OK):
            return None
        _prune(folder)
    except OSError:
        return None
    return folder


def _processor() -> str:
    """What the processor is and can do, in words of the system."""
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        lines = []
    said = sorted({line for line in lines if line.startswith(("flags", "Features", "model name", "CPU part"))})
    return "\n".join([platform.system(), platform.machine(), platform.processor(), *said])


def _prune(folder: Path) -> None:
    """Remove the programs that were not used for the longest time, if all together are larger than `LARGEST`."""
    files = [(one.stat(), one) for one in folder.iterdir() if one.is_file()]
    total = sum(about.st_size for about, _ in files)
    for about, one in sorted(files, key=lambda file: max(file[0].st_atime, file[0].st_mtime)):
        if total <= LARGEST:
            break
        one.unlink(missing_ok=True)  # another process may have removed it
        total -= about.st_size
