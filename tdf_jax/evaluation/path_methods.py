"""Methods that imitate a whole trajectory: the library, the paper's energy, and baselines from a copy to an oracle.

Each method returns one trajectory for every start (for every final candidate, in the case of the solvers). All of them
end at the goal, and each has a score by which the method selects the best. Methods that estimate one motion of the
object warp the demonstration as the library does (`tdf_jax.geometry.transport.carry_trajectory`), unless their name
says otherwise.
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
from tdf_jax.evaluation.baselines import every_registration, principal_axes, rigid_motion
from tdf_jax.evaluation.path_tasks import Task, carried_by
from tdf_jax.evaluation.pick_transfer import random_weights
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
NEAR = 0.04  # metres from the pick within which the oracle uses correspondences
MANY = 64  # starts of the baselines that take as many as the library's solver begins with
# The paper leaves the norm of eq. 3 open. All but the plain norm use the library's rotation scale, which helps it.
PAPER = {
    "TDF, k = 0": EnergyWeights(0.0),
    "TDF, k = 0.02": EnergyWeights(0.02),
    "TDF, k = 0.2": EnergyWeights(0.2),
    "TDF, k = 0.02, plain norm": EnergyWeights(0.02, rotation_scale=1.0),
}
# The correlation term compares with the warped demonstration instead of the demonstration in the world.
ABOUT_CARRIED = {
    "TDF about the carried path, k = 0.02": EnergyWeights(0.02),
    "TDF about the carried path, k = 0.2": EnergyWeights(0.2),
}
COMPENSATED = "TDF, l_p"
# The paper gives no weight of eq. 6; this is the weight of the term that eq. 6 was to replace.
COMPENSATOR = EnergyWeights(0.0, compensator=0.02)
STREAM = 0xBE9C4  # number that is folded into the key of starts


@dataclasses.dataclass(frozen=True)
class Attempt:
    """Result of a method on a task.

    Attributes:
        trajectories: T_world_query of every start, (starts, poses, 7).
        scores: score of every start, (starts,); lower is better.
        seconds: time of one imitation, encoding included.
        residual: residual of the pick, see `tdf_jax.confidence`; NaN where the method has none.
    """

    trajectories: Float[np.ndarray, "starts poses 7"]
    scores: Float[np.ndarray, " starts"]
    seconds: float
    residual: float = float("nan")

    @property
    def best(self) -> int:
        """The selected start: the one with the lowest score; the first if none is finite."""
        return int(np.argmin(np.where(self.finite, self.scores, np.inf)))

    @property
    def finite(self) -> Bool[np.ndarray, " starts"]:
        """Which starts stayed finite."""
        return np.isfinite(self.scores) & np.isfinite(self.trajectories).all(axis=(1, 2))


@dataclasses.dataclass(frozen=True)
class _Encoded:
    """A task as a network encodes it, the time of encoding, and the picks of NDF, which several methods share."""

    field: DescriptorField
    reference: Reference
    seconds: float
    picks: dict  # the number of starts is the key


class Attempts:
    """Attempts of methods on one task, which is encoded once, when the first method needs it.

    Args:
        task: the task.
        model: the network.
        key: random key of the benchmark; the starts of a task depend on it and on the task's index alone.
        num_starts: number of random starts.
    """

    def __init__(self, task: Task, model: Model, key: PRNGKeyArray, num_starts: int):
        self.task, self.model, self.num_starts = task, model, num_starts
        self.key = jax.random.fold_in(jax.random.fold_in(key, STREAM), task.index)

    @functools.cached_property
    def _encoded(self) -> _Encoded:
        return _encoded(self.task, self.model)

    def of(self, method: str) -> Attempt | None:
        """The attempt of one of `METHODS`; None if it cannot run, as the oracle without correspondences."""
        encoded = self._encoded if method in NETWORKS else None
        return METHODS[method](self.task, self.model, encoded, self.key, self.num_starts)


def _encoded(task, model) -> _Encoded:
    began = time.perf_counter()
    reference, field = describe(model, task.demonstration), encode(model, jax.device_put(task.case.points_b))
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


def _closest_points(task, model, encoded, key, num_starts) -> Attempt:
    rotations = np.asarray(se3.uniform_rotations(key, num_starts), float)
    began = time.perf_counter()
    motions, costs = every_registration(task.case.points_a, task.case.points_b, rotations)
    return _carried(task, carried_by(task, motions), costs, time.perf_counter() - began)


def _oracle(task, *_) -> Attempt | None:
    """Fit a rigid motion to corresponding points near the pick by least squares."""
    case = task.case
    if not isinstance(case.object_b, Mug):
        return None
    a, b = (one.landmarks() for one in (case.object_a, case.object_b))
    near = np.linalg.norm(a - np.asarray(task.demonstration.trajectory.translations[0]), axis=1) < NEAR * case.scale
    T_b_a = case.T_world_b @ rigid_motion(a[near], b[near])
    return _carried(task, carried_by(task, T_b_a)[None], np.zeros(1), 0.0)


def _descriptor_fields(task, model, encoded, key, num_starts, *, rigidly=False) -> Attempt:
    """Optimise the pick alone by Adam, as NDF does."""
    if num_starts not in encoded.picks:
        picked = Reference(
            encoded.reference.descriptors[:1],
            Trajectory(encoded.reference.trajectory.wxyz_xyz[:1]),
            encoded.reference.query,
        )
        began = time.perf_counter()
        result = optimize(
            encoded.field,
            picked,
            key,
            fix_last=False,
            energy=EnergyWeights(0.0),
            config=OptimizeConfig(num_starts=num_starts),
        )
        jax.block_until_ready(result)
        seconds = time.perf_counter() - began + encoded.seconds
        encoded.picks[num_starts] = np.asarray(result.trajectories[:, 0]), np.asarray(result.energies), seconds
    return _carried(task, *encoded.picks[num_starts], rigidly=rigidly)


def _replay(*arguments) -> Attempt:
    return _descriptor_fields(*arguments, rigidly=True)


def _with_many(method: Callable) -> Callable:
    """Run a method with `MANY` starts."""
    return lambda task, model, encoded, key, num_starts: method(task, model, encoded, key, MANY)


def _untrained(task, model, encoded, key, num_starts) -> Attempt:
    return _descriptor_fields(task, model, _encoded(task, random_weights(model, 0)), key, num_starts)


def _library(task, model, encoded, key, num_starts) -> Attempt:
    return _timed(encoded, lambda: carry(encoded.field, encoded.reference, key, goal=jnp.asarray(task.goal)))


def _paper(energy: EnergyWeights) -> Callable:
    """Minimise eq. 3 over all waypoints by `solve`, which reaches lower energies than Adam from as many starts."""

    def method(task, model, encoded, key, num_starts):
        goal, config = jnp.asarray(task.goal), SolveConfig(num_trajectory_starts=num_starts)
        return _timed(
            encoded, lambda: solve(encoded.field, encoded.reference, key, goal=goal, energy=energy, config=config)
        )

    return method


def _about_carried(energy: EnergyWeights) -> Callable:
    """Minimise eq. 3 with a correlation term that compares with the demonstration as the library warps it.

    The descriptor term still acts on every waypoint.
    """

    def method(task, model, encoded, key, num_starts):
        def run():
            goal, field = jnp.asarray(task.goal), encoded.field
            carried = carry(field, encoded.reference, key, goal=goal).trajectory.shifted(-field.origin)
            reference = dataclasses.replace(encoded.reference, trajectory=carried)
            return solve(
                field, reference, key, goal=goal, energy=energy, config=SolveConfig(num_trajectory_starts=num_starts)
            )

        return _timed(encoded, run)

    return method


def _compensated(task, model, encoded, key, num_starts) -> Attempt:
    """Minimise eq. 6 by Adam, because it couples the waypoints."""
    goal, config = jnp.asarray(task.goal), OptimizeConfig(num_starts=num_starts)
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
# Methods that use the network's descriptors.
NETWORKS = (*(name for name in METHODS if name.startswith("NDF")), *PAPER, COMPENSATED, *ABOUT_CARRIED, LIBRARY)
# Variants run on every fifth task, because on all tasks they would take as long as all other methods together. Every
# fifth task still covers all paths with all goals.
VARIANTS = (
    *(name for name in METHODS if f"{MANY} starts" in name),
    "random weights",
    *(name for name in PAPER if name != "TDF, k = 0.02"),
    COMPENSATED,
    *ABOUT_CARRIED,
)
EVERY = 5


def tried(method: str, index: int) -> bool:
    """Whether a method runs on the task of an index."""
    return method not in VARIANTS or index % EVERY == 0


def _timed(encoded, run: Callable[[], Result]) -> Attempt:
    began = time.perf_counter()
    result = jax.block_until_ready(run())
    seconds = time.perf_counter() - began + encoded.seconds
    residual = float(result.residual)
    return Attempt(np.asarray(result.trajectories), np.asarray(result.energies), seconds, residual)


def _carried(task, picks, scores, seconds, *, rigidly=False) -> Attempt:
    trajectories = np.array(carry_to_picks(task.demonstration.trajectory, picks, None if rigidly else task.goal))
    trajectories[:, -1] = task.goal
    return Attempt(trajectories, scores, seconds)
