"""What imitates a task: the library, the paper's energy, and baselines from copying to an oracle.

A method's rows are its starts (of the solver: the candidates it ends with), each a whole trajectory that ends at the
goal, with a score that its best is chosen by. Methods that find one motion of the object carry the demonstration as the
library does (`tdf_jax.geometry.transport.carry_trajectory`), unless their name says otherwise.
"""

import dataclasses
import functools
import time
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, PRNGKeyArray

from tdf_jax.energy.losses import EnergyWeights
from tdf_jax.energy.reference import Reference, describe
from tdf_jax.evaluation.baselines import principal_axes, rigid_motion, settled_points
from tdf_jax.evaluation.comparison import random_weights
from tdf_jax.evaluation.path_tasks import Task, carried_by
from tdf_jax.geometry import se3
from tdf_jax.geometry.trajectory import Trajectory
from tdf_jax.geometry.transport import carry_to_picks
from tdf_jax.networks.encoding import encode
from tdf_jax.networks.field import DescriptorField
from tdf_jax.networks.model import Model
from tdf_jax.shapes import Mug
from tdf_jax.solvers.adam import OptimizeConfig, optimize
from tdf_jax.solvers.multistart import SolveConfig, solve
from tdf_jax.solvers.pick import carry
from tdf_jax.solvers.result import Result

LIBRARY = "tdf_jax"
NEAR = 0.04  # metres from the pick within which the oracle's correspondences count
MANY = 64  # starts of the baselines that are tried with as many as the library's solver scouts from
# eq. 3; the paper leaves the norm open, and all but the plain one are with the library's lever, which helps it
PAPER = {
    "TDF, k = 0": EnergyWeights(0.0),
    "TDF, k = 0.02": EnergyWeights(0.02),
    "TDF, k = 0.2": EnergyWeights(0.2),
    "TDF, k = 0.02, plain norm": EnergyWeights(0.02, lever=1.0),
}
ABOUT_CARRIED = {  # the same about the carried demonstration instead of the one in the world
    "TDF about the carried path, k = 0.02": EnergyWeights(0.02),
    "TDF about the carried path, k = 0.2": EnergyWeights(0.2),
}
COMPENSATED = "TDF, l_p"
COMPENSATOR = EnergyWeights(0.0, compensator=0.02)  # the paper gives no weight: that of the term it was to replace
STREAM = 0xBE9C4  # folded into the key of starts


@dataclasses.dataclass(frozen=True)
class Attempt:
    """What a method came to on a task.

    Attributes:
        trajectories: of every start, T_world_query, (starts, poses, 7).
        scores: the lower the better, (starts,).
        seconds: of one imitation, encoding included.
        residual: see `tdf_jax.confidence`, NaN where the method has none.
    """

    trajectories: Float[np.ndarray, "starts poses 7"]
    scores: Float[np.ndarray, " starts"]
    seconds: float
    residual: float = float("nan")

    @property
    def best(self) -> int:
        """The start that is chosen; where none is finite, the first."""
        return int(np.argmin(np.where(self.finite, self.scores, np.inf)))

    @property
    def finite(self) -> Bool[np.ndarray, " starts"]:
        """Which starts stayed finite."""
        return np.isfinite(self.scores) & np.isfinite(self.trajectories).all(axis=(1, 2))


@dataclasses.dataclass(frozen=True)
class _Encoded:
    """A task as a network sees it, the seconds that this took, and NDF's picks, which several methods share."""

    field: DescriptorField
    reference: Reference
    seconds: float
    picks: dict  # by number of starts


class Attempts:
    """What methods come to on one task, which is encoded once, when the first of them asks.

    Args:
        task: what to imitate.
        model: the network.
        key: random key of the benchmark; the starts of a task are a function of it and the task's index.
        inits: random starts.
    """

    def __init__(self, task: Task, model: Model, key: PRNGKeyArray, inits: int):
        self.task, self.model, self.inits = task, model, inits
        self.key = jax.random.fold_in(jax.random.fold_in(key, STREAM), task.index)

    @functools.cached_property
    def _encoded(self) -> _Encoded:
        return _encoded(self.task, self.model)

    def of(self, method: str) -> Attempt | None:
        """The attempt of one of `METHODS`; None where it cannot be tried, such as the oracle on a mesh without correspondences."""
        encoded = self._encoded if method in NETWORKS else None
        return METHODS[method](self.task, self.model, encoded, self.key, self.inits)


def _encoded(task, model) -> _Encoded:
    began = time.perf_counter()
    reference, field = describe(model, task.demonstration), encode(model, task.case.points_b)
    jax.block_until_ready((reference, field))
    return _Encoded(field, reference, time.perf_counter() - began, {})


def _copy(task, *_) -> Attempt:
    return _motionless(task, np.zeros(3, np.float32))


def _centroids(task, *_) -> Attempt:
    return _motionless(task, task.case.points_b.mean(axis=0) - task.case.points_a.mean(axis=0))


def _motionless(task, shift) -> Attempt:
    trajectory = np.array(task.demonstration.trajectory.shifted(shift).wxyz_xyz)
    trajectory[-1] = task.goal
    return Attempt(trajectory[None], np.zeros(1), 0.0)


def _principal_axes(task, *_) -> Attempt:
    began = time.perf_counter()
    T_b_a = principal_axes(task.case.points_a, task.case.points_b)
    return _carried(task, carried_by(task, T_b_a)[None], np.zeros(1), time.perf_counter() - began)


def _closest_points(task, model, encoded, key, inits) -> Attempt:
    rotations = np.asarray(se3.uniform_rotations(key, inits), float)
    began = time.perf_counter()
    motions, costs = settled_points(task.case.points_a, task.case.points_b, rotations)
    return _carried(task, carried_by(task, motions), costs, time.perf_counter() - began)


def _oracle(task, *_) -> Attempt | None:
    """The rigid motion of least squares between points that are known to correspond, near the pick."""
    case = task.case
    if not isinstance(case.object_b, Mug):
        return None
    a, b = (one.landmarks() for one in (case.object_a, case.object_b))
    near = np.linalg.norm(a - np.asarray(task.demonstration.trajectory.translations[0]), axis=1) < NEAR * case.scale
    T_b_a = case.T_world_b @ rigid_motion(a[near], b[near])
    return _carried(task, carried_by(task, T_b_a)[None], np.zeros(1), 0.0)


def _descriptor_fields(task, model, encoded, key, inits, *, rigidly=False) -> Attempt:
    """NDF: one pose by Adam at the pick."""
    if inits not in encoded.picks:
        picked = Reference(
            encoded.reference.descriptors[:1],
            Trajectory(encoded.reference.trajectory.wxyz_xyz[:1]),
            encoded.reference.query,
        )
        began = time.perf_counter()
        result = optimize(
            encoded.field, picked, key, fix_last=False, energy=EnergyWeights(0.0), config=OptimizeConfig(inits=inits)
        )
        jax.block_until_ready(result)
        seconds = time.perf_counter() - began + encoded.seconds
        encoded.picks[inits] = np.asarray(result.trajectories[:, 0]), np.asarray(result.energies), seconds
    return _carried(task, *encoded.picks[inits], rigidly=rigidly)


def _replay(*arguments) -> Attempt:
    return _descriptor_fields(*arguments, rigidly=True)


def _with_many(method: Callable) -> Callable:
    """A method with `MANY` starts."""
    return lambda task, model, encoded, key, inits: method(task, model, encoded, key, MANY)


def _untrained(task, model, encoded, key, inits) -> Attempt:
    return _descriptor_fields(task, model, _encoded(task, random_weights(model, 0)), key, inits)


def _library(task, model, encoded, key, inits) -> Attempt:
    return _timed(encoded, lambda: carry(encoded.field, encoded.reference, key, goal=jnp.asarray(task.goal)))


def _paper(energy: EnergyWeights) -> Callable:
    """Eq. 3 over all waypoints. Its solver takes more starts of one waypoint and finds lower energies than Adam from as many starts."""

    def method(task, model, encoded, key, inits):
        goal, config = jnp.asarray(task.goal), SolveConfig(inits=inits)
        return _timed(
            encoded, lambda: solve(encoded.field, encoded.reference, key, goal=goal, energy=energy, config=config)
        )

    return method


def _about_carried(energy: EnergyWeights) -> Callable:
    """Eq. 3 whose correlation term is to the demonstration as the library carries it; descriptors still pull every waypoint."""

    def method(task, model, encoded, key, inits):
        def run():
            goal, field = jnp.asarray(task.goal), encoded.field
            carried = carry(field, encoded.reference, key, goal=goal).trajectory.shifted(-field.origin)
            reference = dataclasses.replace(encoded.reference, trajectory=carried)
            return solve(field, reference, key, goal=goal, energy=energy, config=SolveConfig(inits=inits))

        return _timed(encoded, run)

    return method


def _compensated(task, model, encoded, key, inits) -> Attempt:
    """Eq. 6 couples the waypoints: Adam."""
    goal, config = jnp.asarray(task.goal), OptimizeConfig(inits=inits)
    return _timed(
        encoded, lambda: optimize(encoded.field, encoded.reference, key, goal=goal, energy=COMPENSATOR, config=config)
    )


METHODS: dict[str, Callable] = {
    "copy": _copy,
    "centroids": _centroids,
    "PCA": _principal_axes,
    "ICP": _closest_points,
    f"ICP, {MANY} starts": _with_many(_closest_points),
    "random weights": _untrained,
    "NDF pick, rigid replay": _replay,
    "NDF pick, carried": _descriptor_fields,
    f"NDF pick, {MANY} starts, carried": _with_many(_descriptor_fields),
    **{name: _paper(energy) for name, energy in PAPER.items()},
    COMPENSATED: _compensated,
    **{name: _about_carried(energy) for name, energy in ABOUT_CARRIED.items()},
    LIBRARY: _library,
    "oracle correspondences": _oracle,
}
# those that use the network's descriptors
NETWORKS = (*(name for name in METHODS if name.startswith("NDF")), *PAPER, COMPENSATED, *ABOUT_CARRIED, LIBRARY)
# Variants are tried on every fifth task, which are of all paths with all goals too: all of them would take as long as
# the rest together.
VARIANTS = (
    *(name for name in METHODS if f"{MANY} starts" in name),
    "random weights",
    *(name for name in PAPER if name != "TDF, k = 0.02"),
    COMPENSATED,
    *ABOUT_CARRIED,
)
EVERY = 5


def tried(method: str, index: int) -> bool:
    """Whether a method is tried on a task."""
    return method not in VARIANTS or index % EVERY == 0


def _timed(encoded, run: Callable[[], Result]) -> Attempt:
    began = time.perf_counter()
    result = jax.block_until_ready(run())
    seconds = time.perf_counter() - began + encoded.seconds
    left = float("nan") if result.residual is None else result.residual
    return Attempt(np.asarray(result.trajectories), np.asarray(result.energies), seconds, left)


def _carried(task, picks, scores, seconds, *, rigidly=False) -> Attempt:
    trajectories = np.array(carry_to_picks(task.demonstration.trajectory, picks, None if rigidly else task.goal))
    trajectories[:, -1] = task.goal
    return Attempt(trajectories, scores, seconds)
