"""Settings of a training run."""

import dataclasses
import math

from tdf_jax._internal import checks
from tdf_jax._internal.deprecation import renamed_fields
from tdf_jax._internal.errors import InputError
from tdf_jax.networks.occupancy import NetworkConfig
from tdf_jax.training.batch import DENSE_POINTS

# Fields of `TrainConfig` by their names in the release before, in which run folders may have them.
FORMER_FIELDS = {"poses": "num_poses"}


@renamed_fields(**FORMER_FIELDS)
@dataclasses.dataclass(frozen=True)
class TrainConfig:
    """Settings of one run.

    Attributes:
        seed: seed of the initial weights and of every draw.
        steps: optimisation steps; the learning rate falls to 2 % over them (cosine).
        batch: objects in a step; even, because they come in pairs.
        points: points of a cloud.
        queries: labelled query points of an object in a step.
        box: query points in a box at a place of every object, to recognise the place on its partner.
        num_poses: candidate poses of the box on the partner; the right pose and its equivalents on a symmetric object
            count once.
        learning_rate: Muon's learning rate, for matrices; vectors, biases and the first layer use Adam at a sixth of
            it.
        warmup: steps over which the learning rate rises linearly.
        corruption: share of what sensors do to clouds, from 0 (complete clouds) to 1. From random weights it grows from
            a tenth of the run on and is reached at six tenths.
        validate_every: steps between validations.
        save_seconds: seconds between checkpoints.
        network: sizes of the network.
    """

    seed: int = 0
    steps: int = 4500
    batch: int = 8
    points: int = 256
    queries: int = 1024
    box: int = 48
    num_poses: int = 12
    learning_rate: float = 6e-3
    warmup: int = 30
    corruption: float = 1.0
    validate_every: int = 250
    save_seconds: float = 120.0
    network: NetworkConfig = NetworkConfig()

    def __post_init__(self):
        lowest = {"queries": 1, "box": 1, "validate_every": 1, "batch": 2, "num_poses": 2, "seed": 0, "warmup": 0}
        for name, low in lowest.items():
            checks.count("TrainConfig()", name, getattr(self, name), low)
        checks.count("TrainConfig()", "steps", self.steps, self.warmup + 1)
        checks.count("TrainConfig()", "points", self.points, self.network.neighbours + 1, DENSE_POINTS)
        if self.batch % 2:
            raise InputError(f"TrainConfig(): batch is {self.batch}; expected an even number, objects come in pairs")
        checks.positive("TrainConfig()", "learning_rate", self.learning_rate)
        checks.number("TrainConfig()", "corruption", self.corruption, 0, 1)
        if self.save_seconds != math.inf:  # which never saves before the end
            checks.number("TrainConfig()", "save_seconds", self.save_seconds, 0)
