"""Conversion of published Neural Descriptor Fields checkpoints (PyTorch `.pth`) to a `Model`, without torch.

Nothing in the file is executed. `tensor_file` lists the tensors in it; this module finds those of the network under
whatever prefix they have, compares them with the network, reads and renames them.
"""

import collections
import dataclasses
import os
import statistics
from collections.abc import Mapping

import jax.numpy as jnp
from flax.traverse_util import unflatten_dict

from tdf_jax._internal import checks
from tdf_jax._internal.boundary import public
from tdf_jax._internal.errors import InputError
from tdf_jax.networks.model import NDF_SIZES, Model, ModelInfo, shape_problems, value_problems
from tdf_jax.networks.occupancy import NetworkConfig, parameter_shapes
from tdf_jax.networks.tensor_file import SAVE, Entry, TensorFile, is_shard, opened
from tdf_jax.networks.torch_pickle import Refusal

NETWORK_PARTS = ("encoder.", "decoder.")
MOST_NAMED = 5  # prefixes and unknown names in a message


@public
def convert_checkpoint(path: str | os.PathLike, name: str | None = None, prefix: str | None = None) -> Model:
    """Convert a PyTorch checkpoint of the published layout (`ndf_robot`'s `VNNOccNet`); the latent size is inferred.

    The network may be anywhere in the file, such as under the key `state_dict` of a training framework, and its names
    may have any prefix, such as `module.`, `model.` and `_orig_mod.` of wrappers. Tensors under other prefixes, such as
    those of an optimiser or of another network, and other content are ignored.

    Args:
        path: `.pth`, `.pt` or `.ckpt` file that `torch.save` wrote (a zip, as since PyTorch 1.6), or a `.safetensors`
            file with PyTorch's names. Half and double precision are cast to float32.
        name: name of the model; by default that of the file.
        prefix: prefix of the network's names, such as "ema.module."; keys of nested dictionaries are a part of it. It
            is needed if the file holds several such networks.

    Returns:
        The model. Its kernels are (in, out), transposed from PyTorch's (out, in).

    Raises:
        InputError: the file is of another kind or damaged, holds no such network or several, or the network is of
            another architecture.
    """
    path = checks.path("convert_checkpoint()", path)
    try:
        with opened(path) as file:
            config, params = _convert(file, prefix)
    except Refusal as reason:
        shard = "; it is one of several files of a checkpoint: load them in PyTorch, and " + SAVE
        raise InputError(
            f"convert_checkpoint(): refused to load {path}: {reason}{shard if is_shard(path) else ''}"
        ) from None
    source = f"converted from the PyTorch checkpoint {path.name}"
    smallest, largest = NDF_SIZES
    info = ModelInfo(path.stem if name is None else name, source, smallest_diagonal=smallest, largest_diagonal=largest)
    return Model(params, config, info)


def _convert(file: TensorFile, prefix: str | None) -> tuple[NetworkConfig, dict]:
    prefix = _prefix(file, prefix)
    state = _network(file.entries, prefix)
    shapes = {name: entry.shape for name, entry in state.items()}
    config = _infer_config(shapes)
    expected = {name.replace(".kernel", ".weight"): shape[::-1] for name, shape in parameter_shapes(config).items()}
    for name, entry in state.items():
        if name in expected and entry.problem:
            raise Refusal(f"its tensor {prefix}{name} {entry.problem}")
    problems = shape_problems(shapes, expected)
    if problems:
        where = f" under the prefix {prefix!r}" if prefix else ""
        extra = "; save the tensors of encoder and decoder alone" if set(shapes) > set(expected) else ""
        raise Refusal(
            f"it is not an NDF occupancy network with latent size {config.latent}{where}: {problems}{extra}"
            f"{_unknown(file)}"
        )

    tensors = {}
    for name, entry in state.items():
        try:
            tensors[name] = entry.read()
        except Refusal as reason:
            raise Refusal(f"its tensor {prefix}{name} {reason}") from None
    problems = value_problems(tensors)
    if problems:
        raise Refusal(f"NaN, infinite or too large for float32: {problems}; train or copy the weights again")
    params = {name.replace(".weight", ".kernel"): jnp.array(tensor.T) for name, tensor in tensors.items()}
    return config, unflatten_dict(params, sep=".")


def _prefix(file: TensorFile, wanted: str | None) -> str:
    """Prefix of the network's names: the one under which all of its tensors are, or else most of them."""
    names = {name.replace(".kernel", ".weight") for name in parameter_shapes(NetworkConfig())}
    found: dict[str, list[str]] = collections.defaultdict(list)
    longest = max(name.count(".") for name in names)
    for entry in file.entries:
        parts = entry.rsplit(".", longest + 1)
        for begin in range(len(parts)):
            inner = ".".join(parts[begin:])
            if inner in names:
                found[entry.removesuffix(inner)].append(inner)
    if not found:
        raise Refusal(_nothing(file))
    if wanted is not None:
        wanted = wanted + "." if wanted and not wanted.endswith(".") else wanted
        if wanted not in found:
            raise Refusal(f"none of the network's tensors has the prefix {wanted!r}; expected one of {_listed(found)}")
        return wanted
    most = max(map(len, found.values()))
    several: dict[tuple, str] = {}
    for prefix, inner in found.items():
        if len(inner) == most:  # one network that is saved under two names counts once
            several.setdefault(tuple(file.entries[prefix + name].source for name in sorted(inner)), prefix)
    if len(several) > 1 and most == len(names):
        raise Refusal(
            f"it holds {len(several)} NDF occupancy networks, under the prefixes {_listed(several.values())}; expected "
            "one. Choose it with prefix=, or --prefix of tdf convert"
        )
    return next(iter(several.values()))


def _network(entries: Mapping[str, Entry], prefix: str) -> dict[str, Entry]:
    """Tensors of encoder and decoder under a prefix, and others beside these in the same dictionary."""
    own = {name.removeprefix(prefix): entry for name, entry in entries.items() if name.startswith(prefix)}
    containers = {entry.container for name, entry in own.items() if name.startswith(NETWORK_PARTS)}
    return {
        name: entry for name, entry in own.items() if name.startswith(NETWORK_PARTS) or entry.container in containers
    }


def _nothing(file: TensorFile) -> str:
    """What a file without any tensor of the network holds, and what to do."""
    if not file.entries:
        holds = ", ".join(file.others[:MOST_NAMED]) or "nothing"
        return f"expected a state_dict of tensors, got {holds}{_unknown(file)}; {SAVE}"
    prefixes = {name[: name.rfind(".") + 1] for name in file.entries}
    tops = sorted({".".join(prefix.split(".")[:2]) for prefix in prefixes})
    return (
        f"none of its {len(file.entries)} tensors is one of an NDF occupancy network, such as "
        f"encoder.conv_pos.map_to_feat.weight under any prefix; it has tensors under {_listed(tops)}{_unknown(file)}; "
        f"{SAVE}"
    )


def _unknown(file: TensorFile) -> str:
    if not file.unknown:
        return ""
    names = ", ".join(file.unknown[:MOST_NAMED]) + (", ..." if len(file.unknown) > MOST_NAMED else "")
    return f"; it references {names}, which no tensor needs and nothing executes"


def _listed(prefixes) -> str:
    names = [repr(prefix) for prefix in prefixes]
    return ", ".join(names[:MOST_NAMED]) + (f" and {len(names) - MOST_NAMED} more" if len(names) > MOST_NAMED else "")


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
