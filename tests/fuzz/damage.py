"""Damage to bytes, arrays and paths. Each gives a description and the damaged thing."""

import contextlib
import os
import resource
import signal
from pathlib import Path

import numpy as np

# Bytes


def truncated(rng, data):
    """Cut the end off; always at least one byte."""
    size = (
        int(rng.integers(0, len(data))) if rng.random() < 0.8 else len(data) - int(rng.integers(1, min(9, len(data))))
    )
    return f"cut to {size} of {len(data)} bytes", data[:size]


def flipped(rng, data):
    """Change a few bytes."""
    out = bytearray(data)
    for place in rng.integers(0, len(out), int(rng.choice([1, 1, 2, 8, 64]))):
        out[place] ^= int(rng.integers(1, 256))
    return "bytes flipped", bytes(out)


def head_flipped(rng, data):
    """Change bytes near the start, where formats say what follows."""
    out = bytearray(data)
    for place in rng.integers(0, min(len(out), 200), int(rng.choice([1, 1, 2]))):
        out[place] ^= 1 << int(rng.integers(8))
    return "bits of the start flipped", bytes(out)


def tail_flipped(rng, data):
    """Change bytes near the end, where zip files have their names."""
    out = bytearray(data)
    for place in rng.integers(max(0, len(out) - 800), len(out), int(rng.choice([1, 1, 2]))):
        out[place] ^= 1 << int(rng.integers(8))
    return "bits of the end flipped", bytes(out)


def removed(rng, data):
    """Take a block out of the middle."""
    start = int(rng.integers(0, max(1, len(data) - 1)))
    size = int(rng.integers(1, 65))
    return f"bytes {start} to {start + size} removed", data[:start] + data[start + size :]


def doubled(rng, data):
    """Repeat a block."""
    start = int(rng.integers(0, len(data)))
    stop = start + int(rng.integers(1, 129))
    return f"bytes {start} to {stop} twice", data[:stop] + data[start:stop] + data[stop:]


def zeroed(rng, data):
    """Set a block to zero, as a crashed file system does."""
    start = int(rng.integers(0, len(data)))
    stop = min(len(data), start + int(rng.choice([8, 64, 4096])))
    return f"bytes {start} to {stop} zero", data[:start] + bytes(stop - start) + data[stop:]


def noise(rng, data):
    """Random bytes of the same length."""
    return "random bytes", rng.bytes(len(data))


def empty(rng, data):
    """No bytes."""
    return "no bytes", b""


def lengthened(rng, data):
    """Something behind the end."""
    tail = [b"\0" * 64, b"\n\n", data, rng.bytes(50)][int(rng.integers(4))]
    return f"{len(tail)} bytes behind the end", data + tail


def foreign(rng, data):
    """Something else: a web page, a program, an archive, a pointer of Git LFS."""
    others = [
        b"<!DOCTYPE html><html><body>404</body></html>\n", b"\x7fELF" + bytes(60), b"PK\x03\x04" + bytes(40),
        b"\x1f\x8b\x08" + bytes(40), b"version https://git-lfs.github.com/spec/v1\noid sha256:00\nsize 12\n",
        b"\x89PNG\r\n\x1a\n" + bytes(40), b"%PDF-1.4\n", b"\n" * 100, b"\0" * 1000, b"null", b"{}", b"[]", b"nan " * 99,
        b"(" * 5000, b"[" * 100000, "ä漢字".encode() * 30, b"1e999 " * 60, b"-" * 300, b"\xff\xfe\x00\x00",
    ]  # fmt: skip
    other = others[int(rng.integers(len(others)))]
    return f"the content is {other[:20]!r}", other


BYTES = (truncated, flipped, head_flipped, tail_flipped, removed, doubled, zeroed, noise, empty, lengthened, foreign)

# Paths. Each puts the bytes where a reader is pointed to, and says whether it can be read.


def plain(rng, folder, name, data):
    """The file itself."""
    (folder / name).write_bytes(data)
    return "as it is", folder / name, True


def text_path(rng, folder, name, data):
    """A path as str."""
    return "a path of type str", str(plain(rng, folder, name, data)[1]), True


def link(rng, folder, name, data):
    """A chain of symbolic links."""
    (folder / "real").write_bytes(data)
    (folder / "middle").symlink_to("real")
    (folder / name).symlink_to(folder / "middle")
    return "a link to a link", folder / name, True


def hard_link(rng, folder, name, data):
    """A hard link."""
    (folder / "real").write_bytes(data)
    os.link(folder / "real", folder / name)
    return "a hard link", folder / name, True


def loop(rng, folder, name, data):
    """Links in a circle."""
    (folder / name).symlink_to("other")
    (folder / "other").symlink_to(name)
    return "a link to itself", folder / name, False


def dangling(rng, folder, name, data):
    """A link to nothing."""
    (folder / name).symlink_to("nothing")
    return "a link to nothing", folder / name, False


def missing(rng, folder, name, data):
    """No file."""
    return "no file", folder / name, False


def directory(rng, folder, name, data):
    """A folder in place of the file, with the file in it."""
    (folder / name).mkdir()
    (folder / name / name).write_bytes(data)
    return "a folder", folder / name, False


def inside_a_file(rng, folder, name, data):
    """A path through a file."""
    (folder / "file").write_bytes(data)
    return "a path through a file", folder / "file" / name, False


def fifo(rng, folder, name, data):
    """A pipe that nobody writes to, which blocks who opens it."""
    os.mkfifo(folder / name)
    return "a pipe", folder / name, False


def long_name(rng, folder, name, data):
    """A name that no file system takes."""
    return "a name of 400 characters", folder / ("a" * 400 + name), False


def null_name(rng, folder, name, data):
    """A name with a zero byte."""
    return "a name with a zero byte", folder / f"a\0{name}", False


def unicode_name(rng, folder, name, data):
    """Names of other languages, with blanks, quotes and newlines."""
    strange = ["ä ö", "漢字", "🙂", "a\nb", 'it\'s "so"', " leading", "%s {0}", "e\u0301", "-dash", "a;b&c"]
    path = folder / (strange[int(rng.integers(len(strange)))] + name)
    path.write_bytes(data)
    return f"the name {path.name!r}", path, True


def undecodable_name(rng, folder, name, data):
    """A name in Latin-1 on a system of UTF-8."""
    path = folder / os.fsdecode(b"caf\xe9" + name.encode())
    path.write_bytes(data)
    return "a name in Latin-1", path, True


def nested(rng, folder, name, data):
    """A deep path with dots in it."""
    deep = folder / "a.npz" / "b.d" / ".hidden"
    deep.mkdir(parents=True)
    (deep / name).write_bytes(data)
    return "a deep path", deep / ".." / ".hidden" / name, True


def upper_case(rng, folder, name, data):
    """The suffix in another case; whether it is known is for the reader to say."""
    stem, dot, suffix = name.rpartition(".")
    path = folder / f"{stem}.{suffix.upper() if rng.random() < 0.5 else suffix.capitalize()}"
    path.write_bytes(data)
    return f"the suffix {path.suffix}", path, None


def other_type(rng, folder, name, data):
    """No path at all."""
    values = [None, 3, 3.5, b"cloud", [], {}, np.zeros(3), "", ".", "/", object(), True]
    value = values[int(rng.integers(len(values)))]
    return f"the path {value!r:.40}", value, False


PATHS = (
    plain, text_path, link, hard_link, loop, dangling, missing, directory, inside_a_file, fifo, long_name, null_name,
    unicode_name, undecodable_name, nested, upper_case, other_type,
)  # fmt: skip

# Arrays


def same_numbers(rng, array):
    """The same numbers in another type of array, which must not matter."""
    array = np.asarray(array)
    variants = {
        "a list": array.tolist(),
        "Fortran order": np.asfortranarray(array),
        "a strided view": np.repeat(array, 2, axis=0)[::2] if array.ndim else array,
        "reversed twice": array[::-1].copy()[::-1] if array.ndim else array,
        "big endian": array.astype(array.dtype.newbyteorder(">")),
        "float64": array.astype(np.float64) if array.dtype.kind == "f" else array,
        "read-only": _read_only(array),
        "a tuple of arrays": tuple(array) if array.ndim else array,
        "a subclass": array.view(_Subclass),
    }
    name = list(variants)[int(rng.integers(len(variants)))]
    return name, variants[name]


class _Subclass(np.ndarray):
    pass


def _read_only(array):
    array = array.copy()
    array.flags.writeable = False
    return array


def no_numbers(rng, array):
    """What cannot be meant, and must be refused."""
    array = np.array(array, float)
    spoilt = array.copy()
    spoilt.flat[int(rng.integers(array.size))] = [np.nan, np.inf, -np.inf][int(rng.integers(3))]
    variants = {
        "a number that is not finite": spoilt,
        "all NaN": np.full_like(array, np.nan),
        "strings": array.astype(str),
        "objects": np.full(array.shape, None, object),
        "complex": array + 1j,
        "dates": array.astype(np.int64).astype("datetime64[s]"),
        "structures": np.zeros(array.shape[:1] or 1, [("x", "f4"), ("y", "f4")]),
        "a ragged list": [[1.0, 2.0], [3.0]],
        "a word": "cloud",
        "a dictionary": {"points": array},
        "a set": {1.0, 2.0},
        "bytes": b"cloud",
        "an object": object(),
        "a function": len,
        "one more axis": array[None],
        "two more axes": array[None, None],
        "no rows": array[:0],
        "a column less": array[..., :-1],
        "a column more": np.concatenate([array, array[..., :1]], axis=-1),
    }
    name = list(variants)[int(rng.integers(len(variants)))]
    return name, variants[name]


@contextlib.contextmanager
def full_disk(size: int):
    """Let no file become larger than this, as on a full disk: writing more is an OSError."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    before = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
        signal.signal(signal.SIGXFSZ, before)


def bad_target(rng, folder: Path, name: str):
    """Places where a file cannot be written."""
    choice = int(rng.integers(7))
    if choice == 0:
        (folder / name).mkdir()
        (folder / name / "mine").write_text("mine")
        return "a folder with a file in it", folder / name
    if choice == 1:
        return "in a folder that does not exist", folder / "none" / name
    if choice == 2:
        (folder / "file").write_text("mine")
        return "in a file", folder / "file" / name
    if choice == 3:
        return "on a system folder", Path("/proc") / name
    if choice == 4:
        return "a long name", folder / ("a" * 400 + name)
    if choice == 5:
        return "a name with a zero byte", folder / f"a\0{name}"
    return "another suffix", folder / (name + ".txt")
