"""Tensors of PyTorch zip files and safetensors files, by name.

The module refuses files of other kinds and names the kind.
"""

import contextlib
import dataclasses
import json
import re
import struct
import tarfile
import zipfile
from collections.abc import Callable, Iterator
from pathlib import Path

import jax.numpy as jnp
import numpy as np

from tdf_jax.io.content import foreign_kind
from tdf_jax.networks.torch_pickle import STORAGE_LIMIT, Refusal, Tensor, Unknown, Unusable, interpret

PICKLE_LIMIT = 2**20  # bytes; that of the published network has 10 kB
DEPTH = 32  # dictionaries in dictionaries; hostile files have more, and names of unbounded length
# Attributes of a PyTorch module that hold its parts; its state_dict does not name them.
MODULE_ATTRIBUTES = ("_modules", "_parameters", "_buffers")
RESAVE = (
    'if you trust it, re-save it with PyTorch: torch.save(torch.load(p, map_location="cpu"), new); if it has other '
    "content than tensors, torch.load needs weights_only=False"
)
SAVE = 'save the network\'s tensors alone with PyTorch: torch.save(model.state_dict(), "new.pth")'
# As the table of `io/content.py`, of files that are foreign only here: its readers take JSON and NumPy arrays.
OTHER_KINDS = {
    b"<": ("is XML, such as the message of a failed download", "download it again"),
    b"{": ("is JSON, such as the index of a checkpoint in several files", f"load them in PyTorch, and {SAVE}"),
    b"\x93NUMPY": ("is a NumPy array", None),
}
FIXES = {"is an HDF5 file": f"load it where it was saved, such as in Keras, and {SAVE}"}
FLOATS = {"F64": "<f8", "F32": "<f4", "F16": "<f2", "BF16": "bfloat16"}  # by their names in safetensors


@dataclasses.dataclass(frozen=True)
class Entry:
    """A tensor in a file.

    Attributes:
        shape: its shape; empty if it cannot be read.
        source: what it is read from: equal sources have equal values.
        container: number of the dictionary that holds it.
        read: function that returns its values, float32.
        problem: why it cannot be read; empty if it can.
    """

    shape: tuple[int, ...]
    source: object
    container: int
    read: Callable[[], np.ndarray]
    problem: str = ""


@dataclasses.dataclass(frozen=True)
class TensorFile:
    """Tensors of a file.

    Attributes:
        entries: tensors by name: keys of nested dictionaries are joined by points.
        unknown: names in the file that are not PyTorch's, such as classes of a training framework.
        others: keys of the file that hold no tensors, with the types of their values.
    """

    entries: dict[str, Entry]
    unknown: tuple[str, ...] = ()
    others: tuple[str, ...] = ()


@contextlib.contextmanager
def opened(path: Path) -> Iterator[TensorFile]:
    """Open a file and list its tensors; the values are read later, while it is open.

    Args:
        path: PyTorch file (a zip, as since PyTorch 1.6), or safetensors file.

    Yields:
        The tensors.

    Raises:
        Refusal: the file is of another kind or damaged.
    """
    kind = _kind(path)
    if kind == "safetensors":
        yield TensorFile(_safetensors(path))
        return
    with _file_errors():
        archive = zipfile.ZipFile(path)
    with archive:
        yield _torch_file(archive)


def _kind(path: Path) -> str:
    """Find out what kind of file it is, and refuse those that cannot be read with what to do about them."""
    with _file_errors():  # of a name that is too long
        if path.is_dir():
            raise Refusal(_folder(path))
        if not path.is_file():
            raise Refusal("there is no such file; check the path")
    with _file_errors(), path.open("rb") as file:
        start = file.read(512)
    if start.startswith(b"PK\x03\x04"):
        return "zip"
    if len(start) > 8 and start[8:9] == b"{" and struct.unpack("<Q", start[:8])[0] < path.stat().st_size:
        return "safetensors"
    # Files from before PyTorch 1.6 are consecutive pickles, which begin with the byte of their protocol; older ones are
    # tar archives.
    tar = start[257:262] == b"ustar"
    names = _tar_members(path) if tar else []
    if names and "storages" not in names:
        raise Refusal(f"it is a tar archive with {names[0]} in it; unpack it")
    if start.startswith(b"\x80") or tar:
        raise Refusal(f"it is a pickle or PyTorch's old format, not a zip archive; {RESAVE}")
    others = (kind for beginning, kind in OTHER_KINDS.items() if start.lstrip().startswith(beginning))
    what, fix = foreign_kind(start) or next(others, ("does not begin as a zip archive", None))
    fix = fix or FIXES.get(what, "name the PyTorch checkpoint")
    raise Refusal(f"it is not a PyTorch checkpoint: it {what}; expected a file from torch.save: {fix}")


def _tar_members(path: Path) -> list[str]:
    try:
        with tarfile.open(path) as archive:
            return archive.getnames()
    except (tarfile.TarError, OSError, EOFError):
        return []


def _folder(path: Path) -> str:
    if any(path.glob("*.distcp")):
        return (
            "it is a folder of torch.distributed.checkpoint; join it: python -m "
            f"torch.distributed.checkpoint.format_utils dcp_to_torch {path} new.pth"
        )
    files = sorted(file.name for file in path.iterdir() if file.suffix in (".pth", ".pt", ".ckpt", ".bin"))
    found = f"one of those in it: {', '.join(files[:3])}" if files else "a file from torch.save"
    return f"it is a folder, so there is no such file; expected {found}"


@contextlib.contextmanager
def _file_errors():
    try:
        yield
    except (zipfile.BadZipFile, EOFError, RuntimeError, ValueError, OverflowError, struct.error) as error:
        raise Refusal(f"its zip archive is truncated or damaged ({error}); copy or download it again") from None
    except OSError as error:
        raise Refusal(f"cannot read it ({error}); check the path and its permissions") from None


def _torch_file(archive: zipfile.ZipFile) -> TensorFile:
    members = archive.namelist()
    pickles = [member for member in members if member.count("/") == 1 and member.endswith("/data.pkl")]
    if len(pickles) != 1:
        raise Refusal(_other_zip(members, len(pickles)))
    root = pickles[0].removesuffix("data.pkl")
    content = interpret(_member(archive, pickles[0], PICKLE_LIMIT))
    order = _byte_order(archive, root)

    def entry(container: int, tensor: Tensor | Unusable) -> Entry:
        if isinstance(tensor, Unusable):
            return Entry((), tensor, container, lambda: np.zeros(0, np.float32), tensor.reason)
        return Entry(tensor.shape, tensor, container, lambda: _values(archive, root, tensor, order))

    found, others = _tensors(content.tree)
    return TensorFile({name: entry(*one) for name, one in found.items()}, content.unknown, tuple(others))


def _other_zip(members: list[str], count: int) -> str:
    if any(member.endswith(("archive_format", "serialized_exported_program.json")) for member in members):
        return f"it is an exported program, from torch.export; {SAVE}"
    inner = [member for member in members if member.endswith((".pth", ".pt", ".ckpt")) and "__MACOSX" not in member]
    if inner:
        return f"it is a zip archive with {inner[0]} in it; unpack it"
    if members and all(member.endswith(".npy") for member in members):
        return f"it is a NumPy archive, .npz, and not a PyTorch checkpoint; name the checkpoint, or {SAVE}"
    return f"expected one data.pkl in its zip archive, found {count}: not a file from torch.save"


def _tensors(tree: object) -> tuple[dict[str, tuple[int, Tensor | Unusable]], list[str]]:
    """Tensors by name, each with the number of the dictionary that holds it; and what is no tensor, in words."""
    found: dict[str, tuple[int, Tensor | Unusable]] = {}
    others, seen = [], {id(tree)}
    if not isinstance(tree, dict | list | tuple):
        return found, [_kind_of(tree)]
    waiting: list[tuple[tuple[str, ...], dict | list | tuple]] = [((), tree)]
    while waiting:
        keys, container = waiting.pop()
        items = list(container.items()) if isinstance(container, dict) else list(enumerate(container))
        inner = []
        for key, value in items:
            path = keys if isinstance(container, Unknown) and key in MODULE_ATTRIBUTES else (*keys, str(key))
            if isinstance(value, Tensor | Unusable):
                found.setdefault(".".join(path), (id(container), value))
            elif isinstance(value, dict | list | tuple) and (value or keys):
                if id(value) not in seen and len(path) < DEPTH:
                    seen.add(id(value))
                    inner.append((path, value))
            elif not keys:
                others.append(f"{key} ({_kind_of(value)})")
        waiting += reversed(inner)
    return found, others


def _kind_of(value: object) -> str:
    return value.name if isinstance(value, Unknown) else type(value).__name__


def _member(archive: zipfile.ZipFile, name: str, limit: int) -> bytes:
    with _file_errors():
        try:
            info = archive.getinfo(name)
        except KeyError:
            raise Refusal(f"{name} is missing from its zip archive; copy or download it again") from None
        # torch.save never compresses. A stored member cannot be larger than the file, which excludes zip bombs.
        if info.compress_type != zipfile.ZIP_STORED or info.compress_size != info.file_size:
            raise Refusal(f"{name} is compressed, which torch.save never does; {RESAVE}")
        if info.file_size > limit:
            raise Refusal(f"{name} has {info.file_size} bytes; expected at most {limit}; {SAVE}")
        return archive.read(info)


def _byte_order(archive: zipfile.ZipFile, root: str) -> str:
    """Numpy's sign for the byte order of the storages; older files do not state it and are little-endian."""
    if root + "byteorder" not in archive.namelist():
        return "<"
    order = _member(archive, root + "byteorder", limit=16)
    if order not in (b"little", b"big"):
        raise Refusal(f"its byte order is {order!r}; expected little or big")
    return "<" if order == b"little" else ">"


def _values(archive: zipfile.ZipFile, root: str, tensor: Tensor, order: str) -> np.ndarray:
    """Values of a tensor in float32."""
    storage = tensor.storage
    dtype = jnp.dtype(storage.dtype)
    if not jnp.issubdtype(dtype, jnp.floating):
        raise Refusal(f"holds {dtype} numbers; expected floating point")
    raw = _member(archive, f"{root}data/{storage.key}", STORAGE_LIMIT)
    if len(raw) != storage.count * dtype.itemsize:
        raise Refusal(f"has {len(raw)} bytes; expected {storage.count} {dtype} numbers; copy the file again")
    # The bytes are read as unsigned integers because numpy cannot swap those of bfloat16.
    words = np.frombuffer(raw, f"{order}u{dtype.itemsize}")
    numbers = words.astype(f"=u{dtype.itemsize}").view(dtype)[tensor.offset :]
    strides = [stride * dtype.itemsize for stride in tensor.strides]
    view = np.lib.stride_tricks.as_strided(numbers, tensor.shape, strides)
    with np.errstate(over="ignore"):  # the caller reports float64 values that become infinite
        return view.astype(np.float32)


def _safetensors(path: Path) -> dict[str, Entry]:
    import safetensors

    with _file_errors():
        content = path.read_bytes()
    try:
        tensors = safetensors.deserialize(content)
        header = json.loads(content[8 : 8 + struct.unpack("<Q", content[:8])[0]])
    except Exception as error:
        raise Refusal(f"its safetensors are truncated or damaged ({error}); copy or download it again") from None
    if "tdf_jax" in header.get("__metadata__", {}):
        raise Refusal("it holds weights of tdf_jax already; use it as it is, in load_model() or --weights")

    def read(tensor) -> np.ndarray:
        if tensor["dtype"] not in FLOATS:
            raise Refusal(f"holds {tensor['dtype']} numbers; expected floating point")
        numbers = np.frombuffer(tensor["data"], jnp.dtype(FLOATS[tensor["dtype"]])).reshape(tensor["shape"])
        with np.errstate(over="ignore"):
            return numbers.astype(np.float32)

    return {name: Entry(tuple(one["shape"]), name, 0, lambda one=one: read(one)) for name, one in tensors}


def is_shard(path: Path) -> bool:
    """Whether a file's name says that it is one of several parts of a checkpoint."""
    return re.search(r"-\d+-of-\d+$", path.stem) is not None
