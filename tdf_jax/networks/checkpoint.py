"""Weights on disk: one safetensors file with the network's sizes, its origin and a checksum of all of it."""

import dataclasses
import hashlib
import json
import os
from collections.abc import Mapping
from importlib import metadata, resources
from pathlib import Path
from urllib.parse import urlparse
from urllib.request import url2pathname

import jax.numpy as jnp
import numpy as np
import safetensors
import safetensors.numpy
from flax.traverse_util import flatten_dict, unflatten_dict

from tdf_jax._internal.errors import InputError
from tdf_jax._internal.files import replace_file
from tdf_jax.networks.model import Model, ModelInfo, shape_problems, value_problems
from tdf_jax.networks.occupancy import NetworkConfig, parameter_shapes

SUFFIX = ".safetensors"
SCHEMA = 1  # raised when a file written here could no longer be read by an older tdf_jax
# All metadata under one key: safetensors writes several in random order, and equal models should be equal files.
METADATA_KEY = "tdf_jax"
HEADER_KEYS = {"schema", "config", "info", "sha256"}


def available_models() -> tuple[str, ...]:
    """Names of the weights that come with tdf_jax, for `load_model`."""
    return tuple(_shipped())


def save_model(model: Model, path: str | os.PathLike) -> None:
    """Write a model to a file, replacing it only once the new one is complete. Equal models give equal files.

    Args:
        model: what to write; its parameters are float32.
        path: a `.safetensors` file in an existing directory.

    Raises:
        InputError: the path cannot be written, or the parameters do not fit the model's config or are not finite.
    """
    target = Path(path)
    if target.suffix != SUFFIX:
        raise InputError(f"save_model(): got the path {target}; expected one that ends in {SUFFIX}")
    # safetensors writes the memory as it lies, so a transposed view would be stored scrambled.
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
    replace_file("save_model", target, safetensors.numpy.save(tensors, {METADATA_KEY: json.dumps(header)}))


def load_model(name_or_path: str | os.PathLike) -> Model:
    """Read a model by name or from a file, and check that it is whole.

    Args:
        name_or_path: a name from `available_models`, or the path of a `.safetensors` file that `save_model` wrote.

    Returns:
        The model, with float32 parameters.

    Raises:
        InputError: unknown name; missing, damaged or foreign file; weights of another architecture, or not finite.
    """
    path = _locate(name_or_path)
    try:
        with safetensors.safe_open(path, framework="numpy") as file:
            header = _header(file.metadata())
            config, info = _record(NetworkConfig, header["config"]), _record(ModelInfo, header["info"])
            slices = {name: file.get_slice(name) for name in file.keys()}
            _check_shapes({name: tuple(part.get_shape()) for name, part in slices.items()}, config)
            _check_types({name: part.get_dtype() for name, part in slices.items()}, "F32")
            tensors = {name: file.get_tensor(name) for name in slices}
            if _checksum(header, tensors) != header["sha256"]:
                raise _Refusal("its checksum does not match its content: it was changed or damaged; copy it again")
            _check_values(tensors)
            # jnp.array copies: the model must not depend on the mapped file.
            params = {name: jnp.array(tensor) for name, tensor in tensors.items()}
    except _Refusal as reason:
        raise InputError(f"load_model(): {path}: {reason}") from None
    except safetensors.SafetensorError as error:
        raise InputError(
            f"load_model(): {path} is not a whole safetensors file ({error}): it is truncated, damaged or of another"
            " kind; copy it again, or convert a PyTorch checkpoint with `tdf convert`"
        ) from None
    except OSError as error:
        raise InputError(f"load_model(): cannot read {path} ({error}); check the path and its permissions") from None
    return Model(params=unflatten_dict(params, sep="."), config=config, info=info)


class _Refusal(Exception):
    """Why a model is not read or written; the public functions add who and what."""


def _shipped() -> dict[str, Path]:
    """Weights by name: package data of an installed wheel, or the folder `weights` of the checkout that an editable install points to."""
    folder = Path(str(resources.files("tdf_jax"))) / "weights"
    if not folder.is_dir() and (checkout := _editable_checkout()) is not None:
        folder = checkout / "weights"
    return {file.stem: file for file in sorted(folder.glob("*" + SUFFIX))}


def _editable_checkout() -> Path | None:
    """The checkout that this package is installed from in editable mode (PEP 610), or None."""
    try:
        record = json.loads(metadata.distribution("tdf_jax").read_text("direct_url.json") or "{}")
    except metadata.PackageNotFoundError:
        return None
    if not record.get("dir_info", {}).get("editable"):
        return None
    return Path(url2pathname(urlparse(record["url"]).path))


def _locate(name_or_path: str | os.PathLike) -> Path:
    path, shipped = Path(name_or_path), _shipped()
    names = ", ".join(shipped) or "none"
    is_name = not path.suffix and str(name_or_path) == path.name
    if is_name and path.name not in shipped:
        raise InputError(
            f"load_model(): no weights are called {path.name!r}; expected a name that exists ({names})"
            f" or the path of a {SUFFIX} file"
        )
    path = shipped[path.name] if is_name else path
    if not path.is_file():
        raise InputError(f"load_model(): there is no file {path}; check the path, or use a shipped model ({names})")
    return path


def _header(entries: Mapping[str, str] | None) -> dict:
    try:
        header = json.loads((entries or {})[METADATA_KEY])
    except (KeyError, ValueError, RecursionError):
        header = None
    if not isinstance(header, dict) or not HEADER_KEYS <= header.keys():
        raise _Refusal(
            "it is not a file that tdf_jax wrote (its metadata are absent or damaged); expected one from save_model"
            " or `tdf convert`"
        )
    if header["schema"] != SCHEMA:
        raise _Refusal(
            f"its schema is {header['schema']}, this tdf_jax reads {SCHEMA}; use the tdf_jax that wrote it, or newer"
        )
    return header


def _record(kind: type, values: Mapping):
    """A dataclass from JSON values, each of the field's type; a float may be written as an integer."""
    try:
        record = kind(**values)
    except TypeError as error:
        raise _Refusal(f"its {kind.__name__} does not have the expected fields ({error})") from None
    for field in dataclasses.fields(kind):
        value = getattr(record, field.name)
        if isinstance(value, bool) or not isinstance(value, int | float if field.type is float else field.type):
            raise _Refusal(f"its {kind.__name__}.{field.name} is a {type(value).__name__}; expected {field.type}")
    return record


def _check_shapes(found: Mapping[str, tuple[int, ...]], config: NetworkConfig) -> None:
    sizes = [getattr(config, field.name) for field in dataclasses.fields(config) if field.type is int]
    # Every block has tensors of its own; without the bound a damaged count would keep the comparison busy for hours.
    if min(sizes) < 1 or config.blocks > len(found):
        raise _Refusal(f"its {len(found)} tensors cannot be those of {config}")
    problems = shape_problems(found, parameter_shapes(config))
    if problems:
        raise _Refusal(f"the tensors are not those of its network, {config}: {problems}")


def _check_types(found: Mapping[str, str], expected: str) -> None:
    others = ", ".join(f"{name} {kind}" for name, kind in found.items() if kind != expected)
    if others:
        raise _Refusal(f"expected {expected} tensors, got {others}; cast them first")


def _check_values(tensors: Mapping[str, np.ndarray]) -> None:
    problems = value_problems(tensors)
    if problems:
        raise _Refusal(f"NaN or infinite values in {problems}; train or convert the weights again")


def _checksum(header: Mapping, tensors: Mapping[str, np.ndarray]) -> str:
    """SHA-256 of the header (less the checksum) and of every tensor's name, shape and bytes."""
    covered = {key: value for key, value in header.items() if key != "sha256"}
    digest = hashlib.sha256(json.dumps(covered, sort_keys=True).encode())
    for name in sorted(tensors):
        digest.update(f"\n{name} {tensors[name].shape}\n".encode())
        digest.update(tensors[name].astype("<f4", copy=False).tobytes())
    return digest.hexdigest()
