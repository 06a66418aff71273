"""A trained network: its parameters, its sizes and its origin."""

import dataclasses
import functools
import json
from collections.abc import Mapping

import jax
import numpy as np

from tdf_jax._internal.cache import digest
from tdf_jax.networks.occupancy import FORMER_FIELDS, NetworkConfig

# Diagonals of the objects that the published networks of Neural Descriptor Fields were trained on, metres: ShapeNet's
# models, whose diagonal is 1, scaled by 0.2 to 0.5.
NDF_SIZES = (0.2, 0.5)


@dataclasses.dataclass(frozen=True)
class ModelInfo:
    """Origin of a network.

    Attributes:
        name: short name, such as "mug".
        source: training run that made it, or file that it was converted from.
        cloud_points: points of the farthest-point subsamples that it was trained on; None if unknown.
        description: further remarks.
        smallest_diagonal: smallest bounding-box diagonal of the objects that it was trained on, metres; None if
            unknown.
        largest_diagonal: largest such diagonal, metres; None if unknown.
    """

    name: str
    source: str
    cloud_points: int | None = None
    description: str = ""
    smallest_diagonal: float | None = None
    largest_diagonal: float | None = None


@functools.partial(jax.tree_util.register_dataclass, data_fields=["params"], meta_fields=["config", "info"])
@dataclasses.dataclass(frozen=True, eq=False)
class Model:
    """An occupancy network; a pytree whose leaves are its parameters.

    Attributes:
        params: parameters, nested dictionaries of arrays under the names of `occupancy.parameter_shapes`.
        config: sizes of the network.
        info: origin of the network.
    """

    params: dict
    config: NetworkConfig
    info: ModelInfo

    def _repr_html_(self) -> str:
        from tdf_jax.viz.cards import model_card  # only a notebook asks, see tests/test_layout.py

        return model_card(self)


def shape_problems(found: Mapping[str, tuple[int, ...]], expected: Mapping[str, tuple[int, ...]]) -> str:
    """Names of the tensors that are missing, unexpected or of another shape; empty if there are none."""
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
    """Names of the tensors that contain NaN or infinity; empty if there are none."""
    return ", ".join(name for name, tensor in tensors.items() if not np.isfinite(tensor).all())


def fingerprint(model: Model) -> str:
    """Digest of all that a model's results depend on: its weights, its sizes and the density of its training clouds."""
    # Digests name results on disk, so they keep the field names of the release before.
    former = {new: old for old, new in FORMER_FIELDS.items()}
    sizes = {former.get(name, name): value for name, value in dataclasses.asdict(model.config).items()}
    return digest(*jax.tree.leaves(model.params), json.dumps([sizes, model.info.cloud_points]).encode())
