"""A network and baselines on the same cases."""

import dataclasses
from collections.abc import Mapping, Sequence

import jax
import numpy as np
from jaxtyping import Float

from tdf_jax._internal.errors import InputError
from tdf_jax.evaluation.baselines import METHODS, aligned
from tdf_jax.evaluation.cases import Case
from tdf_jax.evaluation.pick_transfer import no_overlaps, overlaps, place_errors, tilts, transferred
from tdf_jax.evaluation.statistics import summary
from tdf_jax.networks.model import Model
from tdf_jax.networks.occupancy import initialise
from tdf_jax.solvers.adam import OptimizeConfig

UNTRAINED = "random weights"
BASELINES = (UNTRAINED, *METHODS)


@dataclasses.dataclass(frozen=True)
class Outcome:
    """What one method came to on some cases.

    Attributes:
        method: its name.
        cases: what it was tried on.
        found: poses `wxyz_xyz` of the place, world frame, (cases, 7).
        distance: position errors, metres, (cases,).
        angle: rotation errors, degrees, (cases,).
        ious: see `tdf_jax.evaluation.pick_transfer.overlaps`.
        summary: see `tdf_jax.evaluation.summary`.
    """

    method: str
    cases: Sequence[Case]
    found: Float[np.ndarray, "cases 7"]
    distance: Float[np.ndarray, " cases"]
    angle: Float[np.ndarray, " cases"]
    ious: Mapping[str, Sequence[float | None]]
    summary: dict


def compare(
    cases: Sequence[Case],
    model: Model,
    baselines: Sequence[str] = (),
    *,
    seed: int = 0,
    config: OptimizeConfig = OptimizeConfig(),
    progress: bool = True,
) -> list[Outcome]:
    """Run a network and baselines on cases, each with `config.inits` starts.

    Args:
        cases: what to transfer.
        model: the network.
        baselines: of `BASELINES`; their reconstructions, if any, are not measured.
        seed: of query points, starts and the bootstrap.
        config: settings of the optimiser.
        progress: show progress bars.

    Raises:
        InputError: there is no such baseline.
    """
    for method in baselines:
        if method not in BASELINES:
            raise InputError(f"compare(): baselines has {method!r}; expected some of {', '.join(BASELINES)}")
    found = transferred(model, cases, seed=seed, config=config, progress=progress)
    outcomes = [_outcome(model.info.name, cases, found, overlaps(model, cases), seed)]
    for method in baselines:
        if method == UNTRAINED:
            found = transferred(random_weights(model, seed), cases, seed=seed, config=config, progress=progress)
        else:
            found = aligned(method, cases, seed=seed, inits=config.inits, progress=progress)
        outcomes.append(_outcome(method, cases, found, no_overlaps(cases), seed))
    return outcomes


def random_weights(model: Model, seed: int) -> Model:
    """A network of the same sizes that learnt nothing."""
    return dataclasses.replace(model, params=initialise(jax.random.key(seed), model.config))


def _outcome(method, cases, found, ious, seed) -> Outcome:
    distance, angle = place_errors(found, cases)
    return Outcome(
        method, cases, found, distance, angle, ious, summary(distance, angle, ious, cases, seed, tilts(found, cases))
    )
