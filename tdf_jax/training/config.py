"""Settings of a training run."""

import dataclasses
import math

from tdf_jax._internal.errors import InputError
from tdf_jax.networks.occupancy import NetworkConfig
from tdf_jax.training.batch import DENSE


@dataclasses.dataclass(frozen=True)
class TrainConfig:
    """Settings of one run.

    Attributes:
        seed: of the initial weights and every draw.
        steps: optimisation steps; the learning rate falls to 2 % over them (cosine).
        batch: objects a step, even: they come in pairs.
        points: points of a cloud.
        queries: labelled points of an object, a step.
        box: query points shown at a place of every object and offered to its partner.
        poses: poses they are offered at, the right one, with its equals of a symmetric object, counted once.
        learning_rate: Muon's, on matrices; vectors, biases and the first layer use Adam at a sixth of it.
        warmup: steps of linear rise.
        corruption: how far clouds come from complete ones (0) to what sensors give (1). From random weights it grows
            from the tenth of the run on, and is all there at six tenths.
        validate_every: steps between validations.
        save_seconds: seconds between checkpoints.
    """

    seed: int = 0
    steps: int = 4500
    batch: int = 8
    points: int = 256
    queries: int = 1024
    box: int = 48
    poses: int = 12
    learning_rate: float = 6e-3
    warmup: int = 30
    corruption: float = 1.0
    validate_every: int = 250
    save_seconds: float = 120.0
    network: NetworkConfig = NetworkConfig()

    def __post_init__(self):
        least = dict.fromkeys(("queries", "box", "validate_every"), 1) | {
            "batch": 2,
            "poses": 2,
            "seed": 0,
            "warmup": 0,
        }
        least |= {"steps": self.warmup + 1, "points": self.network.neighbours + 1}
        for name, low in least.items():
            if getattr(self, name) < low:
                raise InputError(f"TrainConfig(): {name} is {getattr(self, name)}; expected at least {low}")
        if self.batch % 2:
            raise InputError(f"TrainConfig(): batch is {self.batch}; expected an even number, objects come in pairs")
        if self.points > DENSE:
            raise InputError(f"TrainConfig(): points is {self.points}; expected at most {DENSE}")
        if not 0 < self.learning_rate < math.inf:
            raise InputError(f"TrainConfig(): learning_rate is {self.learning_rate}; expected a positive number")
        if not 0 <= self.corruption <= 1:
            raise InputError(f"TrainConfig(): corruption is {self.corruption}; expected 0 to 1")
        if not 0 <= self.network.asymmetry < 1:
            raise InputError(f"TrainConfig(): network.asymmetry is {self.network.asymmetry}; expected 0 to less than 1")
        if not self.save_seconds >= 0:
            raise InputError(f"TrainConfig(): save_seconds is {self.save_seconds}; expected 0 or more")
