"""`solve`: damped Gauss-Newton steps from many starts, in stages. It minimises the energy of `optimize` with less work.

Without eq. 6 the energy is a sum over waypoints, and each term depends on one pose, six unknowns. So a waypoint may
take the best of all candidates, whichever start it came from, and a good pose of one waypoint, propagated rigidly, is a
candidate for every other. The waypoint nearest the object is the keyframe. It has the steepest field and the most false
minima, so it gets more starts than the others. All stages but the last evaluate a few of the query points:

1. coarse: the keyframe from many random starts;
2. prune: the best quarter of them;
3. search: every waypoint of some random starts;
4. propagate: the demonstration moved rigidly with the best keyframes, with the best pose of each waypoint, and with the
   centroids;
5. refine: the best distinct candidates of each waypoint;
6. polish: the same, with all query points.

From stage to stage the host sorts the candidates, in numpy. A traced call is one program, in which `jax.lax.scan` runs
the stages.
"""

import dataclasses
import functools
import math
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from tdf_jax._internal import checks, devices
from tdf_jax._internal.boundary import public
from tdf_jax._internal.deprecation import renamed_fields, renamed_keywords
from tdf_jax._internal.errors import InputError
from tdf_jax.energy.losses import EnergyWeights
from tdf_jax.energy.reference import Reference
from tdf_jax.networks.field import DescriptorField
from tdf_jax.solvers import gauss_newton, stages
from tdf_jax.solvers.initial import STARTS, prepare
from tdf_jax.solvers.result import Result, with_ends

# Query points whose descriptors and three tangents exist at a time, 4 MB. With 500 query points, a chunk of 512 took
# twice as long a point on a CPU with 2 MB of second-level cache a core.
CHUNK_POINTS = 128
FIRST_DAMPINGS = {"coarse": 1.0, "prune": 0.3, "search": 1.0, "propagate": 0.3, "refine": 0.1, "polish": 0.03}
ORDER = np.uint32(2**32 - 1)  # folded into the key for the order of the query points; no start has this number


@renamed_fields(
    inits="num_trajectory_starts",
    scouts="num_starts",
    points="num_coarse_queries",
    finalists="num_candidates",
    chunk="chunk_queries",
    steps=tuple(f"{stage}_steps" for stage in stages.STAGES),
)
@dataclasses.dataclass(frozen=True, kw_only=True)
class SolveConfig:
    """Settings of `solve`.

    Attributes:
        num_starts: number of random starts of the keyframe. The worse half takes half of the coarse steps only.
        num_trajectory_starts: number of random starts of the whole trajectory, which the search stage takes; they are
            the first of all starts.
        num_candidates: number of distinct candidates of each waypoint that are refined and polished.
        num_coarse_queries: number of query points that all stages but the last evaluate, drawn at random.
        coarse_steps: maximal number of steps of the coarse stage.
        prune_steps: maximal number of steps of the prune stage.
        search_steps: maximal number of steps of the search stage.
        propagate_steps: maximal number of steps of the propagate stage.
        refine_steps: maximal number of steps of the refine stage.
        polish_steps: maximal number of steps of the polish stage.
        tolerance: a stage ends when no pose's next step promises to lower its energy by more than this share of it. A
            pose that promises less than a hundredth of that takes no further step.
        start: distribution of the starts, see `OptimizeConfig`.
        start_radius: radius of the starts, metres, see `OptimizeConfig`.
        chunk_queries: number of query points that are evaluated at a time; None chooses. It changes speed and memory,
            not the result.

    Raises:
        InputError: a setting is out of its range.
    """

    num_starts: int = 64
    num_trajectory_starts: int = 10
    num_candidates: int = 2
    num_coarse_queries: int = 16
    coarse_steps: int = 6
    prune_steps: int = 10
    search_steps: int = 6
    propagate_steps: int = 4
    refine_steps: int = 6
    polish_steps: int = 4
    tolerance: float = 1e-3
    start: str = "carried"
    start_radius: float = 0.1
    chunk_queries: int | None = None

    def __post_init__(self):
        check_stage_settings("SolveConfig()", self)

    @property
    def num_steps(self) -> int:
        """Maximal number of steps of all stages together."""
        return sum(stage_steps(self).values())


def check_stage_settings(function: str, config) -> None:
    """Raise InputError unless every setting of a config with stages is in its range."""
    for field in dataclasses.fields(config):
        value = getattr(config, field.name)
        if field.name.startswith("num_") or field.name.endswith("_steps"):
            checks.count(function, field.name, value)
    if config.chunk_queries is not None:
        checks.count(function, "chunk_queries", config.chunk_queries)
    checks.positive(function, "start_radius", config.start_radius, "metres")
    checks.number(function, "tolerance", config.tolerance, 0, below=1)
    checks.choice(function, "start", config.start, STARTS)


def stage_steps(config: SolveConfig) -> dict[str, int]:
    """Maximal number of steps of each stage, in their order."""
    return {stage: getattr(config, f"{stage}_steps") for stage in stages.STAGES}


@public
@renamed_keywords(mesh="device_mesh")
def solve(
    field: DescriptorField,
    reference: Reference,
    key: PRNGKeyArray,
    *,
    goal: Float[Array | np.ndarray, "7"] | None = None,
    fix_last: bool = True,
    energy: EnergyWeights = EnergyWeights(),
    config: SolveConfig = SolveConfig(),
    starts: Float[Array | np.ndarray, "starts poses 7"] | None = None,
    progress: Callable[[int, Float[np.ndarray, " candidates"]], None] | None = None,
    device_mesh: jax.sharding.Mesh | None = None,
) -> Result:
    """Minimise `trajectory_energy` by damped Gauss-Newton steps from many starts, in stages (see the module).

    Any array may be traced by `jax.jit` and `jax.vmap`; its numbers are then not checked. There is no reverse-mode
    derivative.

    Args:
        field: descriptor field of the new object.
        reference: the demonstration.
        key: random key of the starts and of the coarse query points.
        goal: last pose, T_world_query, see `optimize`.
        fix_last: keep the last pose at the goal, see `optimize`.
        energy: weights of the energy's terms.
        config: settings.
        starts: initial trajectories from the grasp to the release that replace the random ones, (starts, poses, 7),
            T_world_query; both the coarse and the search stage take all of them.
        progress: function that is called after each stage with the number of steps so far and the energies of the best
            candidates, on the query points of the stage and without a fixed last pose (of the keyframe alone in the
            first two stages). It may raise to cancel. None in a traced call.
        device_mesh: devices that share the candidates, of this process or of several that make the same call. None in a
            traced call.

    Returns:
        The result. Candidate k consists of the k-th best pose of each waypoint. `initial_trajectories` holds all
        starts. In a traced call `history` is infinite, not NaN, where a start is not followed.

    Raises:
        InputError: as for `optimize`, or a weight on eq. 6, which couples the waypoints, or a traced one.
    """
    checks.key("solve()", key)
    traced = checks.in_trace(field, reference, key, goal, energy, starts)
    if traced and (progress is not None or device_mesh is not None):
        name = "progress" if progress is not None else "device_mesh"
        raise InputError(
            f"solve(): there is a {name}, and the call is traced by jax.jit or jax.vmap; expected None. Drop it, or "
            "call solve() outside of the function that is traced"
        )
    num_starts, weights = max(config.num_starts, config.num_trajectory_starts), energy
    initial, energy = prepare(
        "solve()", field, reference, key, goal, fix_last, energy, config, starts, device_mesh, num_starts
    )
    if checks.traced(weights.compensator):
        raise InputError(
            "solve(): energy.compensator is traced; expected 0, because waypoints are solved one by one. Make the "
            "weights inside of the function that is traced: EnergyWeights(correlation=...)"
        )
    compensator = float(np.asarray(weights.compensator))
    if compensator != 0:
        raise InputError(
            f"solve(): energy.compensator is {compensator:g}; expected 0, because the solver takes "
            "waypoints one by one. Use optimize(), or imitate() with config=OptimizeConfig()"
        )
    n = initial.shape[1]
    free = n - 1 if fix_last else n
    if isinstance(initial, np.ndarray) and not (initial[:, free:] == initial[:1, free:]).all():
        raise InputError(
            "solve(): the last poses of the starts differ and fix_last keeps them; expected one, or a goal"
        )

    plan = stages.Plan(
        num_poses=n,
        free=free,
        num_keyframes=len(initial) if starts is not None else config.num_starts,
        num_trajectories=len(initial) if starts is not None else config.num_trajectory_starts,
        num_candidates=config.num_candidates,
        num_coarse_queries=min(config.num_coarse_queries, len(reference.query)),
        steps=tuple(stage_steps(config).values()),
        chunk=config.chunk_queries or devices.points_at_a_time(CHUNK_POINTS),
        parts=1 if device_mesh is None else device_mesh.size,
    )
    tolerance = np.asarray(config.tolerance, initial.dtype)
    if traced:
        found = _solved(key, initial, tolerance, field, reference, energy, plan=plan)
    else:
        problem = _problem(key, reference, size=plan.num_coarse_queries)
        begin = stages.begin(np, initial, field.origin, problem, plan)
        state, courses = _stage_by_stage(begin, tolerance, field, problem, energy, plan, progress, device_mesh)
        found = stages.finish(np, state, courses, initial, problem, plan)
    trajectories, losses, history = found
    result = Result(
        trajectories=jnp.asarray(trajectories),
        energies=jnp.asarray(losses[:, -1]),
        candidate_history=jnp.asarray(losses[:, :-1]),
        initial_trajectories=jnp.asarray(initial),
        # It stays in numpy: under `jax_debug_nans` an array of jax must not hold NaN.
        history=history,
    )
    return with_ends(result, reference)


@functools.partial(jax.jit, static_argnames="plan")
def _solved(key, initial, tolerance, field, reference, energy, *, plan):
    """Results of a traced call, see `stages.finish`."""

    def solved(problem, initial, tolerance, field, energy):
        begin = stages.begin(jnp, initial, field.origin, problem, plan)
        state, courses = _all_stages(begin, tolerance, field, problem, energy, plan)
        return stages.finish(jnp, state, courses, initial, problem, plan)

    problem = _problem(key, reference, size=plan.num_coarse_queries)
    return devices.mapped(solved)(problem, initial, tolerance, field, energy)


@functools.partial(devices.quickly_compiled, static_argnames="size")
def _problem(key, reference, *, size):
    """The demonstration in blocks of `size` query points, in random order."""
    count = len(reference.query)
    # Start m is drawn from fold_in(key, m).
    shuffled = jax.random.permutation(jax.random.fold_in(key, ORDER), count)
    shape = -(-count // size), size
    # Any query point pads the last block; it has no weight.
    counts = jnp.arange(math.prod(shape)).reshape(shape) < count
    return gauss_newton.in_blocks(reference, jnp.resize(shuffled, shape), counts)


def _limits(plan, num_blocks, dtype):
    """Arguments `bounds` and `damping` of `gauss_newton.descend`, a row for each stage."""
    bounds = np.stack([plan.bounds(stage, num_blocks) for stage in plan.stages])
    return bounds, np.array([FIRST_DAMPINGS[stage] for stage in plan.stages], dtype)


def _all_stages(begin, tolerance, field, problem, energy, plan):
    """All stages as one traced program, in which the descent occurs once.

    Returns:
        The state at the end; energies (stages, room, length) and starts (stages, room) of every stage.
    """
    branches = [functools.partial(stages.enter, jnp, stage, plan) for stage in plan.stages]

    def run(state, which):
        index, *limits = which
        *given, state = jax.lax.switch(index, branches, state, begin)
        R, centroid, values = gauss_newton.descend(
            *given, *limits, tolerance, field, problem, energy, length=plan.length, chunk=plan.chunk
        )
        return state._replace(R=R, centroid=centroid, values=values), (values, state.starts)

    limits = _limits(plan, len(problem.query), begin.drawn.R.dtype)
    return jax.lax.scan(run, stages.blank(begin, plan), (np.arange(len(plan.stages)), *limits))


def _stage_by_stage(begin, tolerance, field, problem, energy, plan, progress, device_mesh):
    """As `_all_stages`, from the host."""
    bounds, dampings = _limits(plan, len(problem.query), begin.drawn.R.dtype)
    shared, dealt = (field, problem, energy), np.arange(plan.room)
    if device_mesh is not None:
        # The poses are dealt out in turn, so that every device has its share of those that move.
        dealt = dealt.reshape(-1, plan.parts).T.ravel()
        shared = devices.placed(shared, device_mesh)
    state, values, starts = stages.blank(begin, plan), [], []
    for index, stage in enumerate(plan.stages):
        *given, state = stages.enter(np, stage, plan, state, begin)
        limits = bounds[index], dampings[index], tolerance
        if device_mesh is not None:
            given = devices.placed([part[dealt] for part in given], device_mesh, devices.sharded(device_mesh))
            limits = devices.placed(limits, device_mesh)
        ended = gauss_newton.descend(
            *given, *limits, *shared, length=plan.length, chunk=plan.chunk, device_mesh=device_mesh
        )
        ended = [devices.gathered(part)[np.argsort(dealt)] for part in ended]
        state = state._replace(**dict(zip(("R", "centroid", "values"), ended)))
        values.append(state.values)
        starts.append(state.starts)
        if progress is not None:
            energies = np.sort(stages.found_candidates(np, stage, state, plan).energy, axis=0)
            progress(sum(plan.steps[: stages.STAGES.index(stage) + 1]), energies[: plan.num_candidates].mean(axis=1))
    return state, (values, starts)
