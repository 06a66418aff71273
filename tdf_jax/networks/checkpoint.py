"""Weights on disk: one safetensors file with parameters, sizes and origin of a network, and a checksum of them."""

import dataclasses
import json
import os
from collections.abc import Mapping
from importlib import metadata, resources
from pathlib import Path
from typing import cast
from urllib.parse import urlparse
from urllib.request import url2pathname

import jax
import numpy as np
import safetensors
import safetensors.numpy
from flax.traverse_util import flatten_dict, unflatten_dict

from tdf_jax._internal import checks
from tdf_jax._internal.boundary import public
from tdf_jax._internal.cache import digest
from tdf_jax._internal.errors import InputError
from tdf_jax._internal.files import replace_file
from tdf_jax.networks.model import NDF_SIZES, Model, ModelInfo, shape_problems, value_problems
from tdf_jax.networks.occupancy import FORMER_FIELDS, NetworkConfig, parameter_shapes

SUFFIX = ".safetensors"
SCHEMA = 3  # rises if an older tdf_jax cannot read the files that are written here
# Files of schema 1 have the names in `FORMER_FIELDS`; files of schemas 1 and 2 do not have the sizes of the training
# objects.
READABLE_SCHEMAS = (1, 2, SCHEMA)
# Smallest and largest diagonal of the training objects of such files, metres, by the beginning of their source.
FORMER_SIZES = {"tdf train": (0.08, 0.5), "converted from": NDF_SIZES}
# All metadata are under one key because safetensors writes several keys in random order, and equal models should give
# equal files.
METADATA_KEY = "tdf_jax"
MOST_INTEGER = 2**53  # integers beyond are no numbers of float64
HEADER_KEYS = {"schema", "config", "info", "sha256"}


def available_models() -> tuple[str, ...]:
    """Names of the weights that are shipped with tdf_jax, for `load_model`."""
    return tuple(_shipped())


@public
def save_model(model: Model, path: str | os.PathLike) -> None:
    """Write a model to a file. The write is atomic, and equal models give equal files.

    Args:
        model: network to write, with float32 parameters.
        path: `.safetensors` file in an existing folder; an existing file is replaced.

    Raises:
        InputError: the path cannot be written, or the parameters do not fit the model's config or are not finite.
    """
    target = checks.path("save_model()", path)
    if target.suffix != SUFFIX:
        raise InputError(f"save_model(): got the path {target}; expected one that ends in {SUFFIX}")
    # safetensors writes memory in its own order, so it would scramble a transposed view.
    tensors = {name: np.ascontiguousarray(x) for name, x in flatten_dict(model.params, sep=".").items()}
    header = {
        "schema": SCHEMA,
        "config": dataclasses.asdict(model.config),
        "info": dataclasses.asdict(model.info),
    }
    try:
        _record(NetworkConfig, header["config"])
        _record(ModelInfo, header["info"])
        _check_shapes({name: tensor.shape for name, tensor in tensors.items()}, model.config)
        _check_types({name: tensor.dtype.name for name, tensor in tensors.items()}, "float32")
        _check_values(tensors)
    except _Refusal as reason:
        raise InputError(f"save_model(): {reason}") from None
    header["sha256"] = _checksum(header, tensors)
    replace_file("save_model()", target, safetensors.numpy.save(tensors, {METADATA_KEY: json.dumps(header)}))


@public
def load_model(name_or_path: str | os.PathLike) -> Model:
    """Read a model by name or from a file, and verify its checksum.

    Args:
        name_or_path: name from `available_models`, or path of a `.safetensors` file that `save_model` wrote.

    Returns:
        The model, with float32 parameters.

    Raises:
        InputError: the name is unknown; the file is missing, damaged or not from tdf_jax; or its weights are of another
            architecture or not finite.
    """
    path = _locate(name_or_path)
    try:
        with safetensors.safe_open(path, framework="numpy") as file:
            header = _header(file.metadata())
            config, info = _record(NetworkConfig, _sizes(header)), _record(ModelInfo, _info(header))
            slices = {name: file.get_slice(name) for name in file.keys()}
            _check_shapes({name: tuple(part.get_shape()) for name, part in slices.items()}, config)
            _check_types({name: part.get_dtype() for name, part in slices.items()}, "F32")
            tensors = {name: file.get_tensor(name) for name in slices}
            if _checksum(header, tensors) != header["sha256"]:
                raise _Refusal("its checksum does not match its content: it was changed or damaged; copy it again")
            _check_values(tensors)
            # The model must not depend on the mapped file. `device_put` compiles nothing, unlike `jnp.array`.
            params = {name: jax.device_put(np.array(tensor)) for name, tensor in tensors.items()}
    except _Refusal as reason:
        raise InputError(f"load_model(): {path}: {reason}") from None
    except safetensors.SafetensorError as error:
        raise InputError(
            f"load_model(): {path} is not a valid safetensors file ({error}): it is truncated, damaged or of another"
            " kind; copy it again, or convert a PyTorch checkpoint with `tdf convert`"
        ) from None
    except OSError as error:
        raise InputError(f"load_model(): cannot read {path} ({error}); check the path and its permissions") from None
    return Model(params=unflatten_dict(params, sep="."), config=config, info=info)


class _Refusal(Exception):
    """Reason why a model is not read or written; the public functions add their name and the file."""


def _shipped() -> dict[str, Path]:
    """Paths of the shipped weights by name.

    They are package data of an installed wheel, or in the folder `weights` of the checkout of an editable install.
    """
    folder = Path(str(resources.files("tdf_jax"))) / "weights"
    if not folder.is_dir() and (checkout := _editable_checkout()) is not None:
        folder = checkout / "weights"
    return {file.stem: file for file in sorted(folder.glob("*" + SUFFIX))}


def _editable_checkout() -> Path | None:
    """Checkout that this package is installed from in editable mode (PEP 610), or None."""
    try:
        record = json.loads(metadata.distribution("tdf_jax").read_text("direct_url.json") or "{}")
    except metadata.PackageNotFoundError:
        return None
    if not record.get("dir_info", {}).get("editable"):
        return None
    return Path(url2pathname(urlparse(record["url"]).path))


def _locate(name_or_path: str | os.PathLike) -> Path:
    path, shipped = checks.path("load_model()", name_or_path, "the name or path"), _shipped()
    names = ", ".join(shipped) or "none"
    is_name = not path.suffix and str(name_or_path) == path.name
    if is_name and path.name not in shipped:
        raise InputError(
            f"load_model(): there are no weights {path.name!r}; expected one of ({names}), "
            f"or the path of a {SUFFIX} file"
        )
    path = shipped[path.name] if is_name else path
    try:
        found = path.is_file()
    except OSError:  # a name that is too long
        found = False
    if not found:
        raise InputError(f"load_model(): there is no file {path}; check the path, or use a shipped model ({names})")
    return path


def _header(entries: Mapping[str, str] | None) -> dict:
    try:
        header = json.loads((entries or {})[METADATA_KEY])
    except (KeyError, ValueError, RecursionError):
        header = None
    if not isinstance(header, dict) or not HEADER_KEYS <= header.keys():
        raise _Refusal(
            "it has no metadata of tdf_jax, or damaged ones; expected a file from save_model or `tdf convert`"
        )
    if header["schema"] not in READABLE_SCHEMAS:
        raise _Refusal(
            f"its schema is {header['schema']}; expected {' or '.join(map(str, READABLE_SCHEMAS))}. "
            "Use the tdf_jax that wrote it, or a newer one"
        )
    return header


def _sizes(header: Mapping) -> Mapping:
    """The header's sizes of the network under today's names."""
    if header["schema"] > 1 or not isinstance(header["config"], Mapping):
        return header["config"]
    return {FORMER_FIELDS.get(name, name): value for name, value in header["config"].items()}


def _info(header: Mapping) -> Mapping:
    """The header's origin of the network, with the sizes of the training objects where they are known."""
    info = header["info"]
    if header["schema"] > 2 or not isinstance(info, Mapping):
        return info
    source = str(info.get("source", ""))
    sizes = next((sizes for start, sizes in FORMER_SIZES.items() if source.startswith(start)), (None, None))
    return {"smallest_diagonal": sizes[0], "largest_diagonal": sizes[1], **info}


def _record(kind: type, values: Mapping):
    """Build a dataclass from JSON values; check the type of each. An integer may stand for a float."""
    try:
        record = kind(**values)
    except TypeError as error:
        raise _Refusal(f"its {kind.__name__} does not have the expected fields ({error})") from None
    except InputError as error:
        raise _Refusal(f"its {error}") from None
    floats = {}
    for field in dataclasses.fields(kind):
        value = getattr(record, field.name)
        kinds = {float: int | float, float | None: int | float | None}.get(field.type, cast(type, field.type))
        if isinstance(value, bool) or not isinstance(value, kinds):
            raise _Refusal(f"its {kind.__name__}.{field.name} is a {type(value).__name__}; expected {field.type}")
        if isinstance(value, int) and field.type in (float, float | None):
            if abs(value) > MOST_INTEGER:
                raise _Refusal(
                    f"its {kind.__name__}.{field.name} has {len(str(value))} digits; expected a number that float64 has"
                )
            floats[field.name] = float(value)  # jax takes integers of at most 32 bits
    return dataclasses.replace(record, **floats)


def _check_shapes(found: Mapping[str, tuple[int, ...]], config: NetworkConfig) -> None:
    # Every block has its own tensors. Without this bound, a damaged number of blocks would take hours to compare.
    if config.blocks > len(found):
        raise _Refusal(f"its {len(found)} tensors cannot be those of {config}")
    problems = shape_problems(found, parameter_shapes(config))
    if problems:
        raise _Refusal(f"the tensors are not those of its network, {config}: {problems}; save the model again")


def _check_types(found: Mapping[str, str], expected: str) -> None:
    others = ", ".join(f"{name} {kind}" for name, kind in found.items() if kind != expected)
    if others:
        raise _Refusal(f"expected {expected} tensors, got {others}; cast them first")


def _check_values(tensors: Mapping[str, np.ndarray]) -> None:
    problems = value_problems(tensors)
    if problems:
        raise _Refusal(f"NaN or infinite values in {problems}; train or convert the weights again")


def _checksum(header: Mapping, tensors: Mapping[str, np.ndarray]) -> str:
    """SHA-256 of the header (without the checksum) and of every tensor's name, shape and bytes."""
    covered = {key: value for key, value in header.items() if key != "sha256"}
    parts = [json.dumps(covered, sort_keys=True).encode()]
    for name in sorted(tensors):
        parts += [f"\n{name} {tensors[name].shape}\n".encode(), tensors[name].astype("<f4", copy=False).tobytes()]
    return digest(*parts)
