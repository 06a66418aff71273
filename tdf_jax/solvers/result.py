"""What a solver returns: the final state of every start."""

import dataclasses
import functools

import jax
import numpy as np
from jaxtyping import Array, Bool, Float

from tdf_jax._internal.errors import InputError
from tdf_jax.geometry.trajectory import Trajectory


@functools.partial(
    jax.tree_util.register_dataclass,
    data_fields=["trajectories", "losses", "energies", "starts", "residual", "confidence", "recognised"],
    meta_fields=[],
)
@dataclasses.dataclass(frozen=True)
class Result:
    """What every start came to.

    Attributes:
        trajectories: (inits, poses, 7), `wxyz_xyz`, T_world_query.
        losses: (inits, iterations), the energy before each step; the first column is the start's.
        energies: (inits,), the energy of `trajectories`, after the last step.
        starts: (inits, poses, 7), where they began.
        residual: of `carry`: what the best pick leaves of the demonstration's descriptors, see `tdf_jax.confidence`;
            None of others.
        confidence: of `imitate` with `CarryConfig`: how likely the pick is right, in [0, 1], see `tdf_jax.confidence`;
            None of others, and with weights that it is not calibrated for.
        recognised: of `imitate` with shipped weights: how likely the object is of the demonstration's category, in [0,
            1], see `tdf_jax.recognition`; None of others.
    """

    trajectories: Float[Array, "inits poses 7"]
    losses: Float[Array, "inits iterations"]
    energies: Float[Array, " inits"]
    starts: Float[Array, "inits poses 7"]
    residual: float | None = None
    confidence: float | None = None
    recognised: float | None = None

    @property
    def finite(self) -> Bool[np.ndarray, " inits"]:
        """Which starts stayed finite."""
        return np.isfinite(self.energies) & np.isfinite(self.trajectories).all(axis=(1, 2))

    @property
    def best(self) -> int:
        """Index of the finite start with the least energy.

        Raises:
            InputError: no start stayed finite.
        """
        if not self.finite.any():
            raise InputError(
                f"Result.best: {self.status}; check the weights and the query points, or, with Adam, lower rotation_rate and translation_rate"
            )
        return int(np.argmin(np.where(self.finite, self.energies, np.inf)))

    @property
    def trajectory(self) -> Trajectory:
        """The best trajectory."""
        return Trajectory(self.trajectories[self.best])

    @property
    def loss(self) -> float:
        """Energy of the best trajectory."""
        return float(self.energies[self.best])

    @property
    def status(self) -> str:
        """How the starts ended, in words."""
        failed = np.flatnonzero(~self.finite)
        if len(failed) == 0:
            return f"all {len(self.energies)} starts finite"
        return f"{len(failed)} of {len(self.energies)} starts became non-finite: {', '.join(map(str, failed))}"
