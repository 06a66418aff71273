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
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, PRNGKeyArray

from tdf_jax._internal import checks, devices
from tdf_jax._internal.boundary import public
from tdf_jax._internal.deprecation import renamed_fields, renamed_keywords
from tdf_jax._internal.errors import InputError
from tdf_jax.energy.losses import EnergyWeights
from tdf_jax.energy.reference import Reference
from tdf_jax.geometry import se3
from tdf_jax.networks.field import DescriptorField
from tdf_jax.solvers import gauss_newton
from tdf_jax.solvers.initial import STARTS, prepare
from tdf_jax.solvers.result import Result, with_ends

# Query points whose descriptors and three tangents exist at a time, 4 MB. With 500 query points, a chunk of 512 took
# twice as long a point on a CPU with 2 MB of second-level cache a core.
CHUNK_POINTS = 128
STAGES = ("coarse", "prune", "search", "propagate", "refine", "polish")
FIRST_DAMPINGS = {"coarse": 1.0, "prune": 0.3, "search": 1.0, "propagate": 0.3, "refine": 0.1, "polish": 0.03}
ORDER = np.uint32(2**32 - 1)  # folded into the key for the order of the query points; no start has this number
# Within 10 degrees and these metres two candidates count as one.
COSINE_SAME, SAME_DISTANCE = float(np.cos(np.radians(10))), 0.01


@renamed_fields(
    inits="num_trajectory_starts",
    scouts="num_starts",
    points="num_coarse_queries",
    finalists="num_candidates",
    chunk="chunk_queries",
    steps=tuple(f"{stage}_steps" for stage in STAGES),
)
@dataclasses.dataclass(frozen=True, kw_only=True)
class SolveConfig:
    """Settings of `solve`.

    Attributes:
        num_starts: number of random starts of the keyframe.
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
        tolerance: a stage ends when no pose's next step promises to lower its energy by more than this share of it.
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
    return {stage: getattr(config, f"{stage}_steps") for stage in STAGES}


class Plan(NamedTuple):
    """Sizes of one call, which are static.

    Attributes:
        num_poses: number of waypoints.
        free: number of waypoints that move, the first of all.
        num_keyframes: number of starts of the keyframe.
        num_trajectories: number of starts of the whole trajectory.
        num_candidates: see `SolveConfig`.
        num_coarse_queries: number of query points in a block, of which all stages but the last evaluate one.
        steps: maximal number of steps of each of `STAGES`.
        chunk: number of query points that are evaluated at a time.
        parts: number of devices that share the poses.
    """

    num_poses: int
    free: int
    num_keyframes: int
    num_trajectories: int
    num_candidates: int
    num_coarse_queries: int
    steps: tuple[int, ...]
    chunk: int
    parts: int = 1

    @property
    def stages(self) -> tuple[str, ...]:
        """Stages in their order; one waypoint alone is neither searched nor propagated."""
        return STAGES if self.free > 1 else ("coarse", "prune", "refine", "polish")

    def shape(self, stage: str) -> tuple[int, int]:
        """Candidates and waypoints of a stage."""
        kept = self.num_candidates
        return {
            "coarse": (self.num_keyframes, 1),
            "prune": (max(kept, self.num_keyframes // 4), 1),
            "search": (self.num_trajectories, self.free),
            "propagate": (self.free + kept + 1, self.free),
            "refine": (kept, self.free),
            "polish": (kept, self.free),
        }[stage]

    @property
    def room(self) -> int:
        """Number of poses that every stage's arrays have room for, so that all run the same program."""
        most = max(rows * columns for rows, columns in map(self.shape, self.stages)) + self.num_poses - self.free
        return -(-most // self.parts) * self.parts

    @property
    def length(self) -> int:
        """Number of entries of a history."""
        return max(self.steps) + 1

    def num_steps(self, stage: str) -> int:
        """Maximal number of steps of a stage."""
        return self.steps[STAGES.index(stage)]

    def bounds(self, stage: str, num_blocks: int) -> np.ndarray:
        """The argument `bounds` of `gauss_newton.descend`."""
        moving, polish = math.prod(self.shape(stage)), stage == "polish"
        evaluated = moving + (self.num_poses - self.free if polish else 0)
        return np.array([moving, evaluated, num_blocks if polish else 1, self.num_steps(stage)], np.int32)


class Candidates(NamedTuple):
    """Poses to choose from, in numpy unless a call is traced.

    Attributes:
        R: rotations of the query frame in the world, (rows, free, 3, 3).
        centroid: positions of the query points' centroid, (rows, free, 3), metres, world frame.
        energy: energy of each pose, (rows, free), infinite where it is not finite; empty before a stage.
    """

    R: Float[Array | np.ndarray, "rows free 3 3"]
    centroid: Float[Array | np.ndarray, "rows free 3"]
    energy: Float[Array | np.ndarray, "rows free"] = np.empty((0, 0))


class _Begin(NamedTuple):
    """What the stages begin with.

    Attributes:
        drawn: the starts.
        demonstrated: the demonstration, relative to the object's origin, (free, ...).
        origin: the new object's origin, (3,), metres, world frame.
        keyframe: index of the keyframe.
    """

    drawn: Candidates
    demonstrated: Candidates
    origin: Float[Array | np.ndarray, "3"]
    keyframe: Int[Array | np.ndarray, ""]


class _State(NamedTuple):
    """What passes from stage to stage.

    Attributes:
        R: rotations at the end of the last stage, (room, 3, 3).
        centroid: centroids at its end, (room, 3), metres, world frame.
        values: energies at its start and after each step, (room, length).
        starts: index of the start of each candidate, (room,).
        picked: the best distinct keyframes, one column.
        searched: the candidates at the end of the search.
    """

    R: Float[Array | np.ndarray, "room 3 3"]
    centroid: Float[Array | np.ndarray, "room 3"]
    values: Float[Array | np.ndarray, "room length"]
    starts: Int[Array | np.ndarray, " room"]
    picked: Candidates
    searched: Candidates


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

    plan = Plan(
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
        begin = _begin(np, initial, field.origin, problem, plan)
        state, stages = _stage_by_stage(begin, tolerance, field, problem, energy, plan, progress, device_mesh)
        found = _finish(np, state, stages, initial, problem, plan)
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
    """Results of a traced call, see `_finish`."""

    def solved(problem, initial, tolerance, field, energy):
        begin = _begin(jnp, initial, field.origin, problem, plan)
        state, stages = _all_stages(begin, tolerance, field, problem, energy, plan)
        return _finish(jnp, state, stages, initial, problem, plan)

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


# What follows computes with `xp`, which is jax.numpy where a call is traced. Otherwise it is numpy, because the poses
# are a few hundred, and numpy needs no compilation.


def _begin(xp, initial, origin, problem, plan):
    # The starts and the demonstration share one program, which saves the compilation of a second one.
    n = plan.num_poses
    together = _candidates(xp, xp.concatenate([initial.reshape(-1, 7), xp.asarray(problem.target)]), problem)
    drawn = Candidates(*(part[:-n].reshape(-1, n, *part.shape[1:]) for part in together[:2]))
    demonstrated = Candidates(*(part[-n:] for part in together[:2]))
    keyframe = (demonstrated.centroid[: plan.free] ** 2).sum(axis=1).argmin()
    return _Begin(drawn, demonstrated, xp.asarray(origin), keyframe)


def _candidates(xp, wxyz_xyz, problem):
    R, translation = (xp.asarray(part(wxyz_xyz)) for part in (se3.rotation, se3.translation))
    return Candidates(R, _rotated(R, xp.asarray(problem.centre)) + translation)


def _poses(xp, candidates, problem):
    centre = xp.asarray(problem.centre)
    return xp.asarray(se3.pose(candidates.R, candidates.centroid - _rotated(candidates.R, centre)))


def _rotated(R, x):
    return (R * x[..., None, :]).sum(axis=-1)


def _multiplied(R_a, R_b):
    return (R_a[..., :, :, None] * R_b[..., None, :, :]).sum(axis=-2)


def _blank(begin, plan):
    """The state before the first stage."""
    dtype, (rows, columns) = begin.drawn.R.dtype, plan.shape("search")
    picked, searched = (plan.num_candidates, 1), (rows, columns)
    return _State(
        np.zeros((plan.room, 3, 3), dtype),
        np.zeros((plan.room, 3), dtype),
        np.full((plan.room, plan.length), np.inf, dtype),
        np.zeros(plan.room, np.int32),
        Candidates(np.zeros((*picked, 3, 3), dtype), np.zeros((*picked, 3), dtype)),
        Candidates(
            np.zeros((*searched, 3, 3), dtype), np.zeros((*searched, 3), dtype), np.full(searched, np.inf, dtype)
        ),
    )


def _enter(xp, stage, plan, state, begin):
    """Poses that a stage begins with, and the waypoints that they match, (room, ...); and the state, updated."""
    drawn, kept, alone = begin.drawn, plan.num_candidates, begin.keyframe
    rows, columns = plan.shape(stage)
    starts, waypoints = xp.arange(rows), xp.arange(columns)
    if stage == "coarse":
        entering, waypoints = Candidates(drawn.R[:rows, alone][:, None], drawn.centroid[:rows, alone][:, None]), alone
    elif stage == "prune":
        entering, chosen = _distinct(xp, _found(xp, "coarse", state, plan), rows)
        starts, waypoints = chosen[:, 0], alone
    elif stage == "search":
        state = state._replace(picked=_distinct(xp, _found(xp, "prune", state, plan), kept)[0])
        entering = Candidates(drawn.R[:rows, :columns], drawn.centroid[:rows, :columns])
    elif stage == "propagate":
        state = state._replace(searched=_found(xp, "search", state, plan))
        entering = _propagated(xp, state.searched, state.picked, alone, begin.demonstrated, begin.origin)
    else:
        found = _found(xp, plan.stages[plan.stages.index(stage) - 1], state, plan)
        if stage == "refine" and columns > 1:
            found = Candidates(*(xp.concatenate(parts) for parts in zip(state.searched, found)))
        entering, chosen = _distinct(xp, found, kept)
        if plan.free == 1:
            starts = state.starts[chosen[:, 0]]
    waypoint = xp.broadcast_to(waypoints, (rows, columns)).ravel()
    R, centroid = entering.R.reshape(-1, 3, 3), entering.centroid.reshape(-1, 3)
    if stage == "polish":  # the fixed last pose, whose energy counts
        R = xp.concatenate([R, drawn.R[0, columns:]])
        centroid = xp.concatenate([centroid, drawn.centroid[0, columns:]])
        waypoint = xp.concatenate([waypoint, xp.arange(columns, plan.num_poses)])
    # What is beyond does not count.
    R, centroid, waypoint = (xp.resize(part, (plan.room, *part.shape[1:])) for part in (R, centroid, waypoint))
    starts = xp.resize(starts, plan.room).astype(np.int32)
    return R, centroid, waypoint.astype(np.int32), state._replace(starts=starts)


def _found(xp, stage, state, plan):
    """The candidates at the end of a stage."""
    shape = plan.shape(stage)

    def grid(part):
        return part[: math.prod(shape)].reshape(*shape, *part.shape[1:])

    return Candidates(grid(state.R), grid(state.centroid), grid(_finite(xp, state.values[:, -1])))


def _finite(xp, energies):
    return xp.where(xp.isfinite(energies), energies, xp.inf)


def _propagated(xp, found, picked, keyframe, demonstrated, origin):
    """The demonstration, moved rigidly with the best pose of each waypoint, the best keyframes, and the centroids."""
    free = found.R.shape[1]
    R_demonstrated, c_demonstrated = demonstrated.R[:free], demonstrated.centroid[:free] + origin
    best = found.energy.argmin(axis=0), xp.arange(free)
    # The waypoint that each motion is given by. The motion of the centroids alone leaves waypoint 0 where it is.
    waypoint = xp.concatenate([xp.arange(free), xp.broadcast_to(keyframe, len(picked.R)), xp.zeros(1, int)])
    R = xp.concatenate([found.R[best], picked.R[:, 0], R_demonstrated[:1]])
    centroid = xp.concatenate([found.centroid[best], picked.centroid[:, 0], c_demonstrated[:1]])
    rotation = _multiplied(R, R_demonstrated[waypoint].swapaxes(1, 2))[:, None]
    arms = c_demonstrated[None] - c_demonstrated[waypoint][:, None]
    return Candidates(_multiplied(rotation, R_demonstrated[None]), _rotated(rotation, arms) + centroid[:, None])


def _distinct(xp, found, kept):
    """The best distinct candidates of each waypoint, best first, and their rows (candidates, free waypoints).

    Where there are too few distinct ones, the next best follow.
    """
    rows, columns = found.energy.shape
    every, column = xp.arange(rows)[:, None], xp.arange(columns)

    def choose(k, carry):
        chosen, remaining = carry
        best = remaining.argmin(axis=0)
        cosine = ((found.R * found.R[best, column]).sum(axis=(2, 3)) - 1) / 2
        with np.errstate(over="ignore"):  # a start may lie anywhere
            distance = xp.linalg.norm(found.centroid - found.centroid[best, column], axis=2)
        same = (cosine > COSINE_SAME) & (distance < SAME_DISTANCE)
        remaining = xp.where(every == best, xp.inf, xp.where(same, remaining + 1e3, remaining))
        return xp.where(xp.arange(kept)[:, None] == k, best, chosen), remaining

    carry = xp.zeros((kept, columns), int), found.energy
    if xp is jnp:
        chosen, _ = jax.lax.fori_loop(0, kept, choose, carry)
    else:
        chosen, _ = functools.reduce(lambda carry, k: choose(k, carry), range(kept), carry)
    return Candidates(found.R[chosen, column], found.centroid[chosen, column]), chosen


def _limits(plan, num_blocks, dtype):
    """Arguments `bounds` and `damping` of `gauss_newton.descend`, a row for each stage."""
    bounds = np.stack([plan.bounds(stage, num_blocks) for stage in plan.stages])
    return bounds, np.array([FIRST_DAMPINGS[stage] for stage in plan.stages], dtype)


def _all_stages(begin, tolerance, field, problem, energy, plan):
    """All stages as one traced program, in which the descent occurs once.

    Returns:
        The state at the end; energies (stages, room, length) and starts (stages, room) of every stage.
    """
    branches = [functools.partial(_enter, jnp, stage, plan) for stage in plan.stages]

    def run(state, which):
        index, *limits = which
        *given, state = jax.lax.switch(index, branches, state, begin)
        R, centroid, values = gauss_newton.descend(
            *given, *limits, tolerance, field, problem, energy, length=plan.length, chunk=plan.chunk
        )
        return state._replace(R=R, centroid=centroid, values=values), (values, state.starts)

    limits = _limits(plan, len(problem.query), begin.drawn.R.dtype)
    return jax.lax.scan(run, _blank(begin, plan), (np.arange(len(plan.stages)), *limits))


def _stage_by_stage(begin, tolerance, field, problem, energy, plan, progress, device_mesh):
    """As `_all_stages`, from the host."""
    bounds, dampings = _limits(plan, len(problem.query), begin.drawn.R.dtype)
    shared, dealt = (field, problem, energy), np.arange(plan.room)
    if device_mesh is not None:
        # The poses are dealt out in turn, so that every device has its share of those that move.
        dealt = dealt.reshape(-1, plan.parts).T.ravel()
        shared = devices.placed(shared, device_mesh)
    state, values, starts = _blank(begin, plan), [], []
    for index, stage in enumerate(plan.stages):
        *given, state = _enter(np, stage, plan, state, begin)
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
            energies = np.sort(_found(np, stage, state, plan).energy, axis=0)
            progress(sum(plan.steps[: STAGES.index(stage) + 1]), energies[: plan.num_candidates].mean(axis=1))
    return state, (values, starts)


def _finish(xp, state, stages, initial, problem, plan):
    """The result of all stages.

    Returns:
        Trajectories, (candidates, poses, 7); their energies before each step and after the last, (candidates, steps +
        1); energies of every start before each step, (starts, steps), NaN, or infinite if traced, where they are not
        known.
    """
    values, starts = (dict(zip(plan.stages, part)) for part in stages)
    n, free, kept = plan.num_poses, plan.free, plan.num_candidates

    def course(stage):
        """Energies (rows, columns, times) during a stage."""
        rows, columns = plan.shape(stage)
        energies = values[stage][: rows * columns, : plan.num_steps(stage) + 1]
        return _finite(xp, energies).reshape(rows, columns, -1)

    def best(stage, *others):
        """Energies (candidates, times) of the best candidates of each waypoint; those of `others` are constant."""
        energies = course(stage)
        rows = [energies, *(xp.broadcast_to(other, (*other.shape[:2], energies.shape[2])) for other in others)]
        ordered = xp.sort(xp.concatenate(rows), axis=0)
        return ordered[np.minimum(np.arange(kept), len(ordered) - 1)].sum(axis=1)

    fixed = _finite(xp, values["polish"][kept * free : kept * free + n - free, -1]).sum()
    curves = [best(stage) for stage in plan.stages[:-1] if free == 1 or stage not in ("coarse", "prune", "propagate")]
    if free > 1:
        curves.insert(1, best("propagate", course("search")[:, :, -1:]))
    last, ended = course("polish"), _found(xp, "polish", state, plan)
    order = xp.argsort(ended.energy, axis=0)
    curves = [*(curve[:, :-1] for curve in curves), xp.take_along_axis(last, order[:, :, None], axis=0).sum(axis=1)]
    losses = (xp.concatenate(curves, axis=1) + fixed) / n

    history = []
    for stage in plan.stages if free == 1 else ("search",):
        energies = (course(stage)[:, :, :-1].sum(axis=1) + fixed) / n
        follows = starts[stage][: len(energies), None] == np.arange(len(initial))
        unknown = xp.inf if xp is jnp else np.nan
        history.append(xp.where(follows.any(axis=0)[:, None], energies[follows.argmax(axis=0)], unknown))
    # Several waypoints are followed as trajectories in the search only.
    rest = losses.shape[1] - 1 - sum(part.shape[1] for part in history)
    history = xp.pad(xp.concatenate(history, axis=1), ((0, 0), (0, rest)), constant_values=unknown)

    ordered = Candidates(
        xp.take_along_axis(ended.R, order[:, :, None, None], axis=0),
        xp.take_along_axis(ended.centroid, order[:, :, None], axis=0),
    )
    ends = xp.broadcast_to(initial[:1, free:], (kept, n - free, 7))
    trajectories = xp.concatenate([_poses(xp, ordered, problem), ends], axis=1)
    return tuple(part.astype(initial.dtype) for part in (trajectories, losses, history))
