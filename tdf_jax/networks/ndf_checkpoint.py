"""Conversion of published Neural Descriptor Fields checkpoints (PyTorch `.pth`) to a `Model`, without torch.

Nothing in the file is executed. `torch_pickle` interprets the descriptions of its tensors; this module compares them
with the network, reads their bytes and renames them.
"""

import contextlib
import dataclasses
import os
import statistics
import struct
import zipfile
from collections.abc import Mapping
from pathlib import Path

import jax.numpy as jnp
import numpy as np
from flax.traverse_util import unflatten_dict

from tdf_jax._internal.boundary import public
from tdf_jax._internal.errors import InputError
from tdf_jax.networks.model import NDF_SIZES, Model, ModelInfo, shape_problems, value_problems
from tdf_jax.networks.occupancy import NetworkConfig, parameter_shapes
from tdf_jax.networks.torch_pickle import STORAGE_LIMIT, Refusal, Tensor, interpret

PICKLE_LIMIT = 2**20  # bytes; that of the published network has 10 kB
WRAPPERS = ("state_dict", "model_state_dict", "model")  # keys under which training scripts save the network
RESAVE = 'if you trust it, re-save it with PyTorch: torch.save(torch.load(p, map_location="cpu"), new)'


@public
def convert_checkpoint(path: str | os.PathLike, name: str | None = None) -> Model:
    """Convert a PyTorch checkpoint of the published layout (`ndf_robot`'s `VNNOccNet`); the latent size is inferred.

    Args:
        path: `.pth` file that `torch.save` wrote (a zip, as since PyTorch 1.6). It holds a state_dict, bare or under
            one of the keys state_dict, model_state_dict or model, with or without a `module.` prefix on every name.
            Half and double precision are cast to float32.
        name: name of the model; by default that of the file.

    Returns:
        The model. Its kernels are (in, out), transposed from PyTorch's (out, in).

    Raises:
        InputError: the file is of another kind or damaged, its pickle names anything but tensors, or it is of another
            architecture.
    """
    path = Path(path)
    try:
        with _open(path) as archive:
            config, params = _convert(archive)
    except Refusal as reason:
        raise InputError(f"convert_checkpoint(): refused to load {path}: {reason}") from None
    source = f"converted from the PyTorch checkpoint {path.name}"
    smallest, largest = NDF_SIZES
    info = ModelInfo(path.stem if name is None else name, source, smallest_diagonal=smallest, largest_diagonal=largest)
    return Model(params, config, info)


def _convert(archive: zipfile.ZipFile) -> tuple[NetworkConfig, dict]:
    pickles = [member for member in archive.namelist() if member.count("/") == 1 and member.endswith("/data.pkl")]
    if len(pickles) != 1:
        raise Refusal(f"expected one data.pkl in its zip archive, found {len(pickles)}: not a file from torch.save")
    root = pickles[0].removesuffix("data.pkl")
    state = _state_dict(interpret(_member(archive, pickles[0], PICKLE_LIMIT)))
    shapes = {name: tensor.shape for name, tensor in state.items()}
    config = _infer_config(shapes)
    expected = {name.replace(".kernel", ".weight"): shape[::-1] for name, shape in parameter_shapes(config).items()}
    problems = shape_problems(shapes, expected)
    if problems:
        raise Refusal(f"it is not an NDF occupancy network with latent size {config.latent}: {problems}")

    order = _byte_order(archive, root)
    tensors = {name: _read(archive, root, name, tensor, order) for name, tensor in state.items()}
    problems = value_problems(tensors)
    if problems:
        raise Refusal(f"NaN, infinite or too large for float32: {problems}")
    params = {name.replace(".weight", ".kernel"): jnp.array(tensor.T) for name, tensor in tensors.items()}
    return config, unflatten_dict(params, sep=".")


def _state_dict(tree: object) -> dict[str, Tensor]:
    inner = [tree[key] for key in WRAPPERS if isinstance(tree, dict) and isinstance(tree.get(key), dict)]
    state = inner[0] if inner else tree
    if not isinstance(state, dict) or not state:
        raise Refusal(f"it holds a {type(state).__name__}, expected a state_dict; save model.state_dict() instead")
    strangers = [
        f"{name} ({type(value).__name__})"
        for name, value in state.items()
        if not (isinstance(name, str) and isinstance(value, Tensor))
    ]
    if strangers:
        raise Refusal(f"expected a state_dict of tensors, got {', '.join(strangers)}; save model.state_dict() instead")
    if all(name.startswith("module.") for name in state):
        state = {name.removeprefix("module."): tensor for name, tensor in state.items()}
    return state


def _infer_config(shapes: Mapping[str, tuple[int, ...]]) -> NetworkConfig:
    """Latent size and decoder width by majority, so that a single wrong tensor is reported and not all others."""
    default = NetworkConfig()
    latents = [
        shapes[name][0]
        for name in ("encoder.fc_c.map_to_feat.weight", "decoder.z_in.map_to_feat.weight")
        if shapes.get(name)
    ]
    if len(shapes.get("decoder.fc_in.weight", ())) == 2:
        latents.append((shapes["decoder.fc_in.weight"][1] - 1) // 2)
    widths = [
        shape[0]
        for name, shape in shapes.items()
        if name.startswith("decoder.") and name.endswith(".bias") and len(shape) == 1
    ]
    latent = max(statistics.mode(latents or [default.latent]), 1)
    return dataclasses.replace(default, latent=latent, decoder_width=statistics.mode(widths or [default.decoder_width]))


@contextlib.contextmanager
def _zip_errors():
    try:
        yield
    except (zipfile.BadZipFile, EOFError, RuntimeError, ValueError, OverflowError, struct.error) as error:
        raise Refusal(f"its zip archive is truncated or damaged ({error}); copy or download it again") from None
    except OSError as error:
        raise Refusal(f"cannot read it ({error}); check the path and its permissions") from None


def _open(path: Path) -> zipfile.ZipFile:
    if not path.is_file():
        raise Refusal("there is no such file; check the path")
    with _zip_errors():
        with path.open("rb") as file:
            start = file.read(512)
        if start.startswith(b"PK\x03\x04"):
            return zipfile.ZipFile(path)
    # Files from before PyTorch 1.6 are consecutive pickles, which begin with the byte of their protocol; older ones are
    # tar archives.
    if start.startswith(b"\x80") or start[257:262] == b"ustar":
        raise Refusal(f"it is a pickle or PyTorch's old format, not a zip archive; {RESAVE}")
    raise Refusal("it is not a PyTorch checkpoint: it does not begin as a zip archive; expected a file from torch.save")


def _member(archive: zipfile.ZipFile, name: str, limit: int) -> bytes:
    with _zip_errors():
        try:
            info = archive.getinfo(name)
        except KeyError:
            raise Refusal(f"{name} is missing from its zip archive; copy or download it again") from None
        # torch.save never compresses. A stored member cannot be larger than the file, which excludes zip bombs.
        if info.compress_type != zipfile.ZIP_STORED or info.compress_size != info.file_size:
            raise Refusal(f"{name} is compressed, which torch.save never does; {RESAVE}")
        if info.file_size > limit:
            raise Refusal(f"{name} has {info.file_size} bytes; expected at most {limit}")
        return archive.read(info)


def _byte_order(archive: zipfile.ZipFile, root: str) -> str:
    """Numpy's sign for the byte order of the storages; older files do not state it and are little-endian."""
    if root + "byteorder" not in archive.namelist():
        return "<"
    order = _member(archive, root + "byteorder", limit=16)
    if order not in (b"little", b"big"):
        raise Refusal(f"its byte order is {order!r}; expected little or big")
    return "<" if order == b"little" else ">"


def _read(archive: zipfile.ZipFile, root: str, name: str, tensor: Tensor, order: str) -> np.ndarray:
    """Values of a tensor in float32."""
    storage = tensor.storage
    dtype = jnp.dtype(storage.dtype)
    if not jnp.issubdtype(dtype, jnp.floating):
        raise Refusal(f"{name} holds {dtype} numbers; expected floating point")
    raw = _member(archive, f"{root}data/{storage.key}", STORAGE_LIMIT)
    if len(raw) != storage.count * dtype.itemsize:
        raise Refusal(f"{name} has {len(raw)} bytes; expected {storage.count} {dtype} numbers; copy the file again")
    # The bytes are read as unsigned integers because numpy cannot swap those of bfloat16.
    words = np.frombuffer(raw, f"{order}u{dtype.itemsize}")
    numbers = words.astype(f"=u{dtype.itemsize}").view(dtype)[tensor.offset :]
    strides = [stride * dtype.itemsize for stride in tensor.strides]
    view = np.lib.stride_tricks.as_strided(numbers, tensor.shape, strides)
    with np.errstate(over="ignore"):  # the caller reports float64 values that become infinite
        return view.astype(np.float32)
