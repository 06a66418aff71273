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
"""

import dataclasses
import functools
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from tdf_jax._internal import checks, devices
from tdf_jax._internal.boundary import host
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
SAME_ANGLE, SAME_DISTANCE = np.radians(10), 0.01  # radians and metres within which two candidates count as one


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


class Candidates(NamedTuple):
    """Poses to choose from, on the host: there are a few hundred, and sorting them there needs no compilation.

    Attributes:
        R: rotations of the query frame in the world, (rows, free, 3, 3).
        centroid: positions of the query points' centroid, (rows, free, 3), metres, world frame.
        energy: energy of each pose, (rows, free), infinite where it is not finite; empty before a stage.
        history: energies at the start of the stage and after each step, (times, rows, free); empty before a stage.
    """

    R: Float[np.ndarray, "rows free 3 3"]
    centroid: Float[np.ndarray, "rows free 3"]
    energy: Float[np.ndarray, "rows free"] = np.empty((0, 0))
    history: Float[np.ndarray, "times rows free"] = np.empty((0, 0, 0))


@host
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
            first two stages). It may raise to cancel.
        device_mesh: devices that share the candidates, of this process or of several that make the same call.

    Returns:
        The result. Candidate k consists of the k-th best pose of each waypoint. `initial_trajectories` holds all
        starts.

    Raises:
        InputError: as for `optimize`, or a weight on eq. 6, which couples the waypoints.
    """
    checks.key("solve()", key)
    num_starts = max(config.num_starts, config.num_trajectory_starts)
    initial, energy = prepare(
        "solve()", field, reference, key, goal, fix_last, energy, config, starts, device_mesh, num_starts
    )
    if energy.compensator != 0:
        raise InputError(
            f"solve(): energy.compensator is {float(energy.compensator):g}; expected 0, because the solver takes "
            "waypoints one by one. Use optimize(), or imitate() with config=OptimizeConfig()"
        )
    n = initial.shape[1]
    free = n - 1 if fix_last else n
    if not (initial[:, free:] == initial[:1, free:]).all():
        raise InputError(
            "solve(): the last poses of the starts differ and fix_last keeps them; expected one, or a goal"
        )

    problem = _problem(key, reference, min(config.num_coarse_queries, len(reference.query)))
    # The starts and the demonstration share one program, which saves the compilation of a second one.
    together = _candidates(np.concatenate([initial.reshape(-1, 7), problem.target]), problem)
    drawn = Candidates(*(part[:-n].reshape(len(initial), n, *part.shape[1:]) for part in together[:2]))
    demonstrated = Candidates(*(part[-n:] for part in together[:2]))
    num_keyframes = len(initial) if starts is not None else config.num_starts
    num_trajectories = len(initial) if starts is not None else config.num_trajectory_starts
    kept = config.num_candidates
    room = max(num_keyframes, max(num_trajectories, free + kept + 1) * free + 1)
    shared, parts = (field, problem, energy), 1
    if device_mesh is not None:
        shared, parts = devices.placed(shared, device_mesh), device_mesh.size
    steps = stage_steps(config)
    run = functools.partial(_run, shared=shared, config=config, room=-(-room // parts) * parts, device_mesh=device_mesh)

    def stage(name, candidates, **which):
        found, fixed = run(name, candidates, **which)
        if progress is not None:
            done = sum(steps[earlier] for earlier in STAGES[: STAGES.index(name) + 1])
            progress(done, np.sort(found.energy, axis=0)[:kept].mean(axis=1))
        return found, fixed

    def curve(found, *others):
        """Energies (steps, candidates) of the best candidates of each waypoint during a stage.

        The energies of `others` are constant.
        """
        rows = [found.history, *(np.broadcast_to(other, (len(found.history), *other.shape)) for other in others)]
        ordered = np.sort(np.concatenate(rows, axis=1), axis=1)
        return ordered[:, np.minimum(np.arange(kept), ordered.shape[1] - 1)].sum(axis=2)

    keyframe = int(np.linalg.norm(demonstrated.centroid[:free], axis=1).argmin())
    alone = [keyframe]
    found, _ = stage(
        "coarse", Candidates(drawn.R[:num_keyframes, alone], drawn.centroid[:num_keyframes, alone]), waypoints=alone
    )
    curves = [curve(found)]
    followed = [(np.arange(num_keyframes), found.history)]  # start index and energies of each row, by stage
    pruned, rows = _distinct(found, max(kept, num_keyframes // 4))
    lineage = rows[:, 0]
    found, _ = stage("prune", pruned, waypoints=alone)
    curves.append(curve(found))
    followed.append((lineage, found.history))
    if free > 1:
        picked, _ = _distinct(found, kept)
        found, _ = stage(
            "search", Candidates(drawn.R[:num_trajectories, :free], drawn.centroid[:num_trajectories, :free])
        )
        curves = [curve(found)]
        followed = [(np.arange(num_trajectories), found.history)]
        propagated, _ = stage("propagate", _propagated(found, picked, keyframe, demonstrated, field.origin))
        curves.append(curve(propagated, found.energy))
        found = Candidates(*(np.concatenate(pair) for pair in zip(found[:3], propagated[:3])))
    refined, rows = _distinct(found, kept)
    found, _ = stage("refine", refined)
    curves.append(curve(found))
    if free == 1:
        lineage = lineage[rows[:, 0]]
        followed.append((lineage, found.history))
    polished, rows = _distinct(found, kept)
    found, fixed = stage("polish", polished, fixed=(drawn.R[0, free:], drawn.centroid[0, free:]))
    if free == 1:
        followed.append((lineage[rows[:, 0]], found.history))

    order = np.argsort(found.energy, axis=0)
    ordered = Candidates(*(np.take_along_axis(part, _like(order, part), axis=0) for part in found[:2]))
    curves.append(np.take_along_axis(found.history, order[None], axis=1).sum(axis=2))
    losses = (np.concatenate([*(part[:-1] for part in curves[:-1]), curves[-1]]) + fixed) / n
    losses = losses.T.astype(initial.dtype)
    free_poses = _poses(ordered, problem)
    ends = np.broadcast_to(initial[:1, free:], (len(free_poses), n - free, 7))
    result = Result(
        trajectories=jnp.asarray(np.concatenate([free_poses, ends], axis=1)),
        energies=jnp.asarray(losses[:, -1]),
        candidate_history=jnp.asarray(losses[:, :-1]),
        initial_trajectories=jnp.asarray(initial),
        # It stays in numpy: under `jax_debug_nans` an array of jax must not hold NaN.
        history=_history(followed, len(initial), losses.shape[1] - 1, fixed, n).astype(initial.dtype),
    )
    return with_ends(result, reference)


def _history(followed, num_starts, length, fixed, n):
    """Energies (starts, length) of every start before each step; NaN where no stage follows it."""
    history = np.full((num_starts, length), np.nan)
    begin = 0
    for starts, energies in followed:
        count = len(energies) - 1
        history[starts, begin : begin + count] = (energies[:-1].sum(axis=2).T + fixed) / n
        begin += count
    return history


def _problem(key, reference, size):
    count = len(reference.query)
    # numpy's stream differs from that of the starts: start m is drawn from fold_in(key, m).
    shuffled = np.random.default_rng(np.asarray(jax.random.key_data(key)).ravel()).permutation(count)
    shape = -(-count // size), size
    # Any query point pads the last block; it has no weight.
    return gauss_newton.in_blocks(
        reference, np.resize(shuffled, shape), (np.arange(np.prod(shape)) < count).reshape(shape)
    )


def _candidates(wxyz_xyz, problem):
    R = np.asarray(se3.rotation(wxyz_xyz))
    return Candidates(R, R @ np.asarray(problem.centre) + np.asarray(se3.translation(wxyz_xyz)))


def _poses(candidates, problem):
    return np.asarray(se3.pose(candidates.R, candidates.centroid - candidates.R @ np.asarray(problem.centre)))


def _like(order, part):
    return order.reshape(order.shape + (1,) * (part.ndim - 2))


def _propagated(found, picked, keyframe, demonstrated, origin):
    """The demonstration, moved rigidly with the best pose of each waypoint, the best keyframes, and the centroids."""
    free = found.R.shape[1]
    R_demonstrated, c_demonstrated = demonstrated.R[:free], demonstrated.centroid[:free] + np.asarray(origin)
    best = found.energy.argmin(axis=0), np.arange(free)
    # The waypoint that each motion is given by. The motion of the centroids alone leaves waypoint 0 where it is.
    waypoint = np.concatenate([np.arange(free), np.full(len(picked.R), keyframe), [0]])
    R = np.concatenate([found.R[best], picked.R[:, 0], R_demonstrated[:1]])
    centroid = np.concatenate([found.centroid[best], picked.centroid[:, 0], c_demonstrated[:1]])
    rotation = R @ R_demonstrated[waypoint].swapaxes(1, 2)
    arms = c_demonstrated[None] - c_demonstrated[waypoint][:, None]
    return Candidates(
        rotation[:, None] @ R_demonstrated[None], np.einsum("rij,rwj->rwi", rotation, arms) + centroid[:, None]
    )


def _distinct(found, kept):
    """The best distinct candidates of each waypoint, best first, and their rows (candidates, free waypoints).

    Where there are too few distinct ones, the next best follow.
    """
    columns = []
    for R, centroid, energy in zip(found.R.swapaxes(0, 1), found.centroid.swapaxes(0, 1), found.energy.T):
        order, remaining = [], energy.copy()
        for _ in range(kept):
            best = int(remaining.argmin())
            cosine = (np.einsum("rij,ij->r", R, R[best]) - 1) / 2
            with np.errstate(over="ignore"):  # a start may lie anywhere
                distance = np.linalg.norm(centroid - centroid[best], axis=1)
            remaining[(cosine > np.cos(SAME_ANGLE)) & (distance < SAME_DISTANCE)] += 1e3
            remaining[best] = np.inf
            order.append(best)
        columns.append((R[order], centroid[order], np.array(order)))
    R, centroid, rows = (np.stack(part, axis=1) for part in zip(*columns))
    return Candidates(R, centroid), rows


def _run(stage, candidates, fixed=None, waypoints=None, *, shared, config, room, device_mesh):
    """Run one stage.

    Args:
        stage: name of the stage.
        candidates: where it begins; its columns are all free waypoints, unless `waypoints` names others.
        fixed: rotations and centroids of a last pose that is evaluated and does not move.
        waypoints: indices of the waypoints of the columns.
        shared: field, problem and weights.
        config: settings.
        room: number of poses that the program has room for.
        device_mesh: devices that share the poses.

    Returns:
        The candidates at the end of the stage, and the energy of the fixed last pose, 0 if there is none.
    """
    rows, free = candidates.R.shape[:2]
    R, centroid = candidates.R.reshape(-1, 3, 3), candidates.centroid.reshape(-1, 3)
    waypoint = np.tile(np.arange(free) if waypoints is None else waypoints, rows)
    if fixed is not None:
        R, centroid = np.concatenate([R, fixed[0]]), np.concatenate([centroid, fixed[1]])
        waypoint = np.concatenate([waypoint, np.arange(free, free + len(fixed[0]))])
    count, steps = len(R), stage_steps(config)
    # Every stage runs the same program: arrays of one size, and counts that are traced.
    R, centroid, waypoint = (np.resize(part, (room, *part.shape[1:])) for part in (R, centroid, waypoint))
    blocks = len(shared[1].query) if stage == "polish" else 1
    bounds = np.array([rows * free, count, blocks, steps[stage]], np.int32)
    given = (R, centroid, waypoint)
    limits = (bounds, R.dtype.type(FIRST_DAMPINGS[stage]), R.dtype.type(config.tolerance))
    dealt = np.arange(room)
    if device_mesh is not None:
        # The poses are dealt out in turn, so that every device has its share of those that move.
        dealt = np.arange(room).reshape(-1, device_mesh.size).T.ravel()
        given = devices.placed([part[dealt] for part in given], device_mesh, devices.sharded(device_mesh))
        limits = devices.placed(limits, device_mesh)
    chunk = config.chunk_queries or devices.points_at_a_time(CHUNK_POINTS)
    length = max(steps.values()) + 1
    results = gauss_newton.descend(*given, *limits, *shared, length=length, chunk=chunk, device_mesh=device_mesh)
    R, centroid, values = (
        devices.gathered(part)[np.argsort(dealt)] if device_mesh is not None else np.asarray(part) for part in results
    )
    history = values.T[: steps[stage] + 1]
    history = np.where(np.isfinite(history), history, np.inf)
    ended = [part[: rows * free].reshape(rows, free, *part.shape[1:]) for part in (R, centroid)]
    energies = history[:, : rows * free].reshape(len(history), rows, free)
    return Candidates(ended[0], ended[1], energies[-1], energies), history[-1, rows * free : count].sum()
