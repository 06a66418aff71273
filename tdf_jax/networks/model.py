"""A trained network: its parameters, its sizes and where it came from."""

import dataclasses
import functools
import hashlib
import json
from collections.abc import Mapping

import jax
import numpy as np

from tdf_jax.networks.occupancy import NetworkConfig


@dataclasses.dataclass(frozen=True)
class ModelInfo:
    """Where a network came from.

    Attributes:
        name: short name, such as "mug".
        source: what made it: a training run, or the file it was converted from.
        cloud_points: farthest points of the clouds it was trained on; None if unknown.
        description: anything else worth knowing.
    """

    name: str
    source: str
    cloud_points: int | None = None
    description: str = ""


@functools.partial(jax.tree_util.register_dataclass, data_fields=["params"], meta_fields=["config", "info"])
@dataclasses.dataclass(frozen=True, eq=False)
class Model:
    """An occupancy network; a pytree whose leaves are its parameters.

    Attributes:
        params: nested dictionaries of arrays, under the names of `network.parameter_shapes`.
        config: the network's sizes.
        info: where it came from.
    """

    params: dict
    config: NetworkConfig
    info: ModelInfo


def shape_problems(found: Mapping[str, tuple[int, ...]], expected: Mapping[str, tuple[int, ...]]) -> str:
    """Every tensor that is missing, not expected or of another shape, by name; empty if there is none."""
    missing = [f"{name} {shape}" for name, shape in expected.items() if name not in found]
    extra = [f"{name} {shape}" for name, shape in found.items() if name not in expected]
    misshapen = [
        f"{name} is {found[name]}, expected {shape}"
        for name, shape in expected.items()
        if name in found and found[name] != shape
    ]
    groups = {"missing": missing, "not expected": extra, "of another shape": misshapen}
    return "; ".join(f"{len(names)} {what}: {', '.join(names)}" for what, names in groups.items() if names)


def value_problems(tensors: Mapping[str, np.ndarray]) -> str:
    """Every tensor that holds NaN or infinity, by name; empty if there is none."""
    return ", ".join(name for name, tensor in tensors.items() if not np.isfinite(tensor).all())


def fingerprint(model: Model) -> str:
    """A digest of all that a model's results depend on: weights, sizes, and the clouds it was trained on."""
    digest = hashlib.sha256(b"".join(np.asarray(leaf).tobytes() for leaf in jax.tree.leaves(model.params)))
    digest.update(json.dumps([dataclasses.asdict(model.config), model.info.cloud_points]).encode())
    return digest.hexdigest()
