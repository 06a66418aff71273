"""Trajectory optimisation by damped Gauss-Newton steps: the energy that `optimize` minimises, for a small part of its work.

Without eq. 6 the energy is a sum over waypoints of terms of one pose each, six unknowns apart from all others. So a waypoint may take the best
of all candidates, whichever start it came from, and a good pose of one waypoint, carried rigidly, is a candidate for every other. The waypoint nearest the object,
the keyframe, has the steepest field and the most false minima: a random start came down to the right one in 6 to 19 % of cases. It gets more starts than the others. The search
runs on a few of the query points; only the last stage sees all of them:

1. scout: the keyframe from many random starts, few points;
2. halve: the best quarter of those, few points;
3. search: every waypoint of some random starts, few points;
4. carry: the demonstration as the keyframe's finalists, the best pose of each waypoint, or the centroids alone carry it, few points;
5. refine: the best distinct candidates of each waypoint, few points;
6. polish: the same, all query points.

A step solves (H + damping diag(H)) delta = -gradient for each pose. The gradient is the energy's own; H is that of the absolute values
replaced by r^2 / (2 max(|r|, s)), with s the mean |r| of the query point: iteratively reweighted least squares, made less steep near zero.
"""

import dataclasses
import functools
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, PRNGKeyArray

from tdf_jax import devices, poses
from tdf_jax.demonstration import Reference
from tdf_jax.energy import EnergyWeights, pose_difference
from tdf_jax.errors import InputError
from tdf_jax.field import DescriptorField
from tdf_jax.keys import check_key
from tdf_jax.optimize import STARTS, Result, prepare

# Points whose descriptors and 3 tangents exist at a time: 4 MB. With 500 query points a chunk of 512 took twice as long a point on a CPU with 2 MB of second-level cache a core.
CHUNK_POINTS = 128
LARGEST_TURN, LARGEST_MOVE = 0.7, 0.05  # radians and metres of one step
DAMPINGS = 1e-3, 1e3  # least and greatest
ACCEPTED, REJECTED = 0.3, 4.0  # factors on the damping
FIRST_DAMPINGS = 1.0, 0.3, 1.0, 0.3, 0.1, 0.03  # of the six stages
LEAST_DIFFERENCE = 1e-4  # metres; the curvature of eq. 3's norm grows without bound towards zero: that of no smaller difference is taken
SAME_ANGLE, SAME_DISTANCE = np.radians(10), 0.01  # radians and metres within which two candidates count as one


@dataclasses.dataclass(frozen=True)
class SolveConfig:
    """Settings of the solver.

    Attributes:
        inits: random starts of the whole trajectory, in the search.
        scouts: random starts of the keyframe; the first of them are those of the search.
        points: query points that all stages but the last see, drawn at random from all.
        steps: most steps of each of the six stages.
        finalists: distinct candidates of each waypoint that are refined and polished.
        tolerance: a stage ends when no pose's next step promises to lower its energy by more than this share of it.
        start, start_radius: as for `OptimizeConfig`.
        chunk: query points evaluated at a time; None chooses. Changes speed and memory, not the result.
    """

    inits: int = 10
    scouts: int = 64
    points: int = 16
    steps: tuple[int, int, int, int, int, int] = (6, 10, 6, 4, 6, 4)
    finalists: int = 2
    tolerance: float = 1e-3
    start: str = "carried"
    start_radius: float = 0.1
    chunk: int | None = None

    def __post_init__(self):
        for name in ("inits", "scouts", "points", "finalists", "chunk"):
            if not _counts(getattr(self, name)) and (name, getattr(self, name)) != ("chunk", None):
                raise InputError(f"SolveConfig(): {name} is {getattr(self, name)!r}; expected a whole number of at least 1")
        if not isinstance(self.steps, tuple) or len(self.steps) != len(FIRST_DAMPINGS) or not all(map(_counts, self.steps)):
            raise InputError(f"SolveConfig(): steps is {self.steps!r}; expected a tuple of six whole numbers of at least 1")
        if not 0 < self.start_radius < np.inf:
            raise InputError(f"SolveConfig(): start_radius is {self.start_radius}; expected a positive number")
        if not 0 <= self.tolerance < 1:
            raise InputError(f"SolveConfig(): tolerance is {self.tolerance}; expected 0 or more and less than 1")
        if self.start not in STARTS:
            raise InputError(f"SolveConfig(): start is {self.start!r}; expected one of {', '.join(STARTS)}")


def _counts(value):
    return isinstance(value, int | np.integer) and not isinstance(value, bool) and value >= 1


class Problem(NamedTuple):
    """What poses are to match, with the query points in blocks: a stage sees the first, or all.

    Attributes:
        query: relative to their mean, (blocks, size, 3), metres.
        weights: 1, or 0 for what fills up the last block, (blocks, size).
        descriptors: the demonstration's.
        target: waypoints of the reference, `wxyz_xyz`, relative to the object's origin.
        centre: mean of the query points, in the query frame.
    """

    query: Float[Array, "blocks size 3"]
    weights: Float[Array, "blocks size"]
    descriptors: Float[Array, "waypoints blocks size channels"]
    target: Float[Array, "waypoints 7"]
    centre: Float[Array, "3"]


class Candidates(NamedTuple):
    """Poses to choose from, on the host: there are a few hundred, and sorting them there needs no compiling.

    Attributes:
        R: rotations of the query frame in the world.
        place: of the query points' mean in the world, metres.
        energy: infinite where a pose was not evaluated, or is not finite.
        history: energies at the start of the stage and after each step.
    """

    R: Float[np.ndarray, "rows free 3 3"]
    place: Float[np.ndarray, "rows free 3"]
    energy: Float[np.ndarray, "rows free"] | None = None
    history: Float[np.ndarray, "times rows free"] | None = None


def solve(
    field: DescriptorField,
    reference: Reference,
    key: PRNGKeyArray,
    *,
    goal: Float[Array, "7"] | None = None,
    fix_last: bool = True,
    energy: EnergyWeights = EnergyWeights(),
    config: SolveConfig = SolveConfig(),
    starts: Float[Array, "inits poses 7"] | None = None,
    progress: Callable[[int, Float[np.ndarray, "finalists"]], None] | None = None,
    mesh: jax.sharding.Mesh | None = None,
) -> Result:
    """Minimise `trajectory_energy` by damped Gauss-Newton steps from many starts, in six stages (see the module).

    Args:
        field, reference, key, goal, fix_last, energy: as for `optimize`.
        config: settings.
        starts: use these instead of random ones, all of them as scouts and in the search.
        progress: called after each stage with the steps done and the energies of the best trajectories so far, on the query points of
            the stage and without a fixed last pose (of the first two, those of the keyframe); may raise to cancel.
        mesh: devices to share the candidates, of this process or of several that make the same call; see docs/scaling.md.

    Returns:
        A result whose rows are trajectories of the best, second best, ... candidates of each waypoint. Its `losses` are theirs from the search on,
        before the last stage on the few query points; its `starts` are where the last stage began, `steps[-1]` steps before the end.

    Raises:
        InputError: as for `optimize`, or a weight on eq. 6, which couples the waypoints.
    """
    check_key("solve()", key)
    if np.any(np.asarray(energy.compensator) != 0):
        raise InputError(
            f"solve(): energy.compensator is {energy.compensator}; expected 0, for the solver takes waypoints one by one. Use optimize(), or imitate() with config=OptimizeConfig()"
        )
    most = dataclasses.replace(config, inits=max(config.inits, config.scouts))
    given = starts is not None
    starts, energy = prepare("solve()", field, reference, key, goal, fix_last, energy, most, starts)
    n = starts.shape[1]
    free = n - 1 if fix_last else n
    if free == 0:
        raise InputError("solve(): the trajectory has one pose and fix_last keeps it; expected fix_last=False")
    ends = np.asarray(starts[:, free:])
    if not (ends == ends[:1]).all():
        raise InputError("solve(): the last poses of the starts differ and fix_last keeps them; expected one, or a goal")

    problem = _problem(key, reference, min(config.points, len(reference.query)))
    drawn = _candidates(starts, problem)
    scouts, inits, kept = (len(starts),) * 2 + (config.finalists,) if given else (config.scouts, config.inits, config.finalists)
    room = max(scouts, max(inits, free + kept + 1) * free + 1)
    shared, parts = (field, problem, energy), 1
    if mesh is not None:
        shared, parts = devices.placed(shared, mesh), mesh.size
    run = functools.partial(_run, shared=shared, config=config, room=-(-room // parts) * parts, mesh=mesh)

    def stage(index, candidates, **which):
        found, fixed = run(index, candidates, **which)
        if progress is not None:
            progress(sum(config.steps[: index + 1]), np.sort(found.energy, axis=0)[:kept].mean(axis=1))
        return found, fixed

    def curve(found, *others):
        """Energies of the best candidates of each waypoint during a stage, among them others that stand still, (times, kept)."""
        rows = np.concatenate([found.history, *(np.broadcast_to(other, (len(found.history), *other.shape)) for other in others)], axis=1)
        return np.sort(rows, axis=1)[:, np.minimum(np.arange(kept), rows.shape[1] - 1)].sum(axis=2)

    keyframe = int(np.linalg.norm(_candidates(problem.target, problem).place[:free], axis=1).argmin())
    alone = [keyframe]
    found, _ = stage(0, Candidates(drawn.R[:scouts, alone], drawn.place[:scouts, alone]), waypoints=alone)
    curves = [curve(found)]
    found, _ = stage(1, _distinct(found, max(kept, scouts // 4)), waypoints=alone)
    curves.append(curve(found))
    if free > 1:
        picked = _distinct(found, kept)
        found, _ = stage(2, Candidates(drawn.R[:inits, :free], drawn.place[:inits, :free]))
        curves = [curve(found)]
        carried, _ = stage(3, _carried(found, picked, keyframe, problem, field.origin))
        curves.append(curve(carried, found.energy))
        found = Candidates(*(np.concatenate(pair) for pair in zip(found[:3], carried[:3])))
    found, _ = stage(4, _distinct(found, kept))
    curves.append(curve(found))
    begun = _distinct(found, kept)
    found, fixed = stage(5, begun, fixed=(drawn.R[0, free:], drawn.place[0, free:]))

    order = np.argsort(found.energy, axis=0)
    rows = Candidates(*(np.take_along_axis(part, _like(order, part), axis=0) for part in (found.R, found.place)))
    begun = Candidates(*(np.take_along_axis(part, _like(order, part), axis=0) for part in begun[:2]))
    curves.append(np.take_along_axis(found.history, order[None], axis=1).sum(axis=2))
    losses = (np.concatenate([*(stage[:-1] for stage in curves[:-1]), curves[-1]]) + fixed) / n
    trajectories, begun = (
        jnp.concatenate([_poses(part, problem), jnp.broadcast_to(starts[:1, free:], (len(order), n - free, 7))], axis=1)
        for part in (rows, begun)
    )
    losses = jnp.asarray(losses.T, starts.dtype)
    return Result(trajectories, losses[:, :-1], losses[:, -1], begun)


def _problem(key, reference, size):
    count = len(reference.query)
    blocks = -(-count // size)
    # A stream of its own: start m is drawn from fold_in(key, m).
    seed = np.asarray(jax.random.key_data(key)).ravel()
    # What fills up the last block is any point, with weight 0.
    order = np.resize(np.random.default_rng(seed).permutation(count), blocks * size)
    query, descriptors = reference.query, reference.descriptors
    centre = jnp.mean(query, axis=0)
    return Problem(
        query=(query - centre)[order].reshape(blocks, size, 3),
        weights=jnp.asarray((np.arange(blocks * size) < count).reshape(blocks, size), query.dtype),
        descriptors=descriptors[:, order].reshape(len(descriptors), blocks, size, -1),
        target=reference.trajectory.wxyz_xyz,
        centre=centre,
    )


def _candidates(wxyz_xyz, problem):
    R = np.asarray(poses.rotation(wxyz_xyz))
    return Candidates(R, R @ np.asarray(problem.centre) + np.asarray(poses.translation(wxyz_xyz)))


def _poses(candidates, problem):
    return poses.pose(jnp.asarray(candidates.R), jnp.asarray(candidates.place - candidates.R @ np.asarray(problem.centre)))


def _like(order, part):
    return order.reshape(order.shape + (1,) * (part.ndim - 2))


def _carried(found, picked, keyframe, problem, origin):
    """The demonstration as the best pose of each waypoint, the keyframe's finalists and the centroids alone carry it, rigidly."""
    free = found.R.shape[1]
    shown = _candidates(problem.target, problem)
    R_shown, place_shown = shown.R[:free], shown.place[:free] + np.asarray(origin)
    best = found.energy.argmin(axis=0), np.arange(free)
    # Where which waypoint comes to; the centroids leave it where it is.
    waypoint = np.concatenate([np.arange(free), np.full(len(picked.R), keyframe), [0]])
    R = np.concatenate([found.R[best], picked.R[:, 0], R_shown[:1]])
    place = np.concatenate([found.place[best], picked.place[:, 0], place_shown[:1]])
    turn = R @ R_shown[waypoint].swapaxes(1, 2)
    arms = place_shown[None] - place_shown[waypoint][:, None]
    return Candidates(turn[:, None] @ R_shown[None], np.einsum("rij,rwj->rwi", turn, arms) + place[:, None])


def _distinct(found, kept):
    """The best distinct candidates of each waypoint, best first; where they are too few, the others follow."""
    columns = []
    for R, place, energy in zip(found.R.swapaxes(0, 1), found.place.swapaxes(0, 1), found.energy.T):
        order, left = [], energy.copy()
        for _ in range(kept):
            best = int(left.argmin())
            cosine = (np.einsum("rij,ij->r", R, R[best]) - 1) / 2
            with np.errstate(over="ignore"):  # a start may be anywhere
                near = (cosine > np.cos(SAME_ANGLE)) & (np.linalg.norm(place - place[best], axis=1) < SAME_DISTANCE)
            left[near] += 1e3
            left[best] = np.inf
            order.append(best)
        columns.append((R[order], place[order]))
    return Candidates(*(np.stack(part, axis=1) for part in zip(*columns)))


def _run(stage, candidates, fixed=None, waypoints=None, *, shared, config, room, mesh):
    """One stage: where the candidates came to, and the energy of a fixed last pose if there is one, else 0.

    The columns of the candidates are all free waypoints, unless others are named.
    """
    rows, free = candidates.R.shape[:2]
    R, place = candidates.R.reshape(-1, 3, 3), candidates.place.reshape(-1, 3)
    waypoint = np.tile(np.arange(free) if waypoints is None else waypoints, rows)
    if fixed is not None:
        R, place = np.concatenate([R, fixed[0]]), np.concatenate([place, fixed[1]])
        waypoint = np.concatenate([waypoint, np.arange(free, free + len(fixed[0]))])
    count = len(R)
    # Every stage runs the same program: arrays of one size, and counts that are traced.
    R, place, waypoint = (np.resize(part, (room, *part.shape[1:])) for part in (R, place, waypoint))
    blocks = len(shared[1].query) if stage == len(FIRST_DAMPINGS) - 1 else 1
    bounds = np.array([rows * free, count, blocks, config.steps[stage]], np.int32)
    given, limits = (R, place, waypoint), (bounds, R.dtype.type(FIRST_DAMPINGS[stage]), R.dtype.type(config.tolerance))
    dealt = slice(None)
    if mesh is not None:
        # Dealt out in turns, so that every device has its share of those that move.
        dealt = np.arange(room).reshape(-1, mesh.size).T.ravel()
        given = devices.placed([part[dealt] for part in given], mesh, devices.split(mesh))
        limits = devices.placed(limits, mesh)
    chunk = config.chunk or devices.points_at_a_time(CHUNK_POINTS)
    results = _descend(*given, *limits, *shared, length=max(config.steps) + 1, chunk=chunk, mesh=mesh)
    R, place, values = (devices.gathered(part)[np.argsort(dealt)] if mesh is not None else np.asarray(part) for part in results)
    history = values.T[: config.steps[stage] + 1]
    history = np.where(np.isfinite(history), history, np.inf)
    ended = [part[: rows * free].reshape(rows, free, *part.shape[1:]) for part in (R, place)]
    energies = history[:, : rows * free].reshape(len(history), rows, free)
    return Candidates(*ended, energies[-1], energies), history[-1, rows * free : count].sum()


class _State(NamedTuple):
    """Poses, each apart from the others, with its energy and the quadratic model of it.

    `gradient` and `hessian` are with respect to a turn about the query points' mean (on the left) and a move.
    """

    R: Float[Array, "poses 3 3"]
    place: Float[Array, "poses 3"]
    energy: Float[Array, "poses"]
    gradient: Float[Array, "poses 6"]
    hessian: Float[Array, "poses 6 6"]


@functools.partial(jax.jit, static_argnames=("length", "chunk", "mesh"))
def _descend(R, place, waypoint, bounds, damping, tolerance, field, problem, energy, *, length, chunk, mesh=None):
    """Damped Gauss-Newton steps, until none promises to gain by the tolerance.

    Args:
        R, place: poses, see `Candidates`.
        waypoint: of each pose, what it is to match.
        bounds: how many of the poses move, how many are evaluated, blocks of query points, most steps.
        damping: of the first step.
        tolerance: see `SolveConfig`.
        field, problem, energy: what is minimised.
        length: times a history has room for.
        chunk: query points evaluated at a time.
        mesh: devices that the poses are dealt out to in turns.

    Returns:
        R, place, and energies at the start and after each step, (poses, length); those of steps that were not taken are the latest.
    """
    work = functools.partial(_steps, length=length, chunk=chunk, axes=mesh.axis_names if mesh is not None else ())
    if mesh is not None:
        split = devices.split(mesh)
        work = jax.shard_map(work, mesh=mesh, in_specs=(*[split] * 3, *[devices.WHOLE] * 6), out_specs=split, check_vma=False)
    return work(R, place, waypoint, bounds, damping, tolerance, field, problem, energy)


def _steps(R, place, waypoint, bounds, damping, tolerance, field, problem, energy, *, length, chunk, axes):
    """`_descend` on one device; `axes` are the mesh's."""
    if axes:
        parts, part = jax.lax.axis_size(axes), jax.lax.axis_index(axes)
        bounds = bounds.at[:2].set((bounds[:2] - part + parts - 1) // parts)  # of the poses dealt out, those of this device
    moving, _, _, steps = bounds
    moves = jnp.arange(len(R)) < moving

    def body(carry):
        i, state, damping, step, _, history = carry
        R, place = poses.exp(step[:, :3]) @ state.R, state.place + step[:, 3:]
        trial = _State(R, place, *_evaluate(R, place, waypoint, bounds, field, problem, energy, chunk))
        # The first time nothing has moved and the state's energies are infinite: it takes what is finite.
        better = trial.energy < state.energy
        state = jax.tree.map(lambda a, b: jnp.where(better.reshape(-1, *[1] * (a.ndim - 1)), a, b), trial, state)
        factor = jnp.where(i == 0, 1.0, jnp.where(better, ACCEPTED, REJECTED))
        damping = jnp.clip(damping * factor, *DAMPINGS)
        step, promise = _step(state, damping)
        hopeful = jnp.any(moves & (promise > tolerance * state.energy))
        hopeful = jax.lax.pmax(hopeful.astype(jnp.int32), axes) > 0 if axes else hopeful
        history = jnp.where(jnp.arange(length) >= i, state.energy[:, None], history)
        return i + 1, state, damping, jnp.where(moves[:, None], step, 0.0), hopeful, history

    count, dtype = len(R), R.dtype
    values = jnp.full(count, jnp.inf, dtype), jnp.zeros((count, 6), dtype), jnp.broadcast_to(jnp.eye(6, dtype=dtype), (count, 6, 6))
    begin = _State(R, place, *values), jnp.full(count, damping, dtype), jnp.zeros((count, 6), dtype)
    carry = (jnp.int32(0), *begin, jnp.bool_(True), jnp.zeros((count, length), dtype))
    _, state, _, _, _, history = jax.lax.while_loop(lambda carry: (carry[0] <= steps) & carry[4], body, carry)
    return state.R, state.place, history


def _step(state, damping):
    """The next step of every pose, (poses, 6), and by how much its quadratic model falls."""
    diagonal = jnp.diagonal(state.hessian, axis1=1, axis2=2)
    # Far from the object a field is flat: the floor keeps the system solvable.
    damped = state.hessian + (damping[:, None] * diagonal + 1e-9)[:, :, None] * jnp.eye(6, dtype=diagonal.dtype)
    step = -_solved(damped, state.gradient)
    turn, move = (jnp.linalg.norm(part, axis=-1) for part in (step[:, :3], step[:, 3:]))
    longest = jnp.maximum(jnp.maximum(turn / LARGEST_TURN, move / LARGEST_MOVE), 1.0)
    step = step / longest[:, None]
    curved = jnp.sum(step * jnp.sum(state.hessian * step[:, None], axis=-1), axis=-1)
    return step, -jnp.sum(state.gradient * step, axis=-1) - curved / 2


def _solved(matrix, right):
    """Solutions of positive definite systems (poses, 6, 6), by elimination; no pivots are needed."""

    def eliminate(k, system):
        row = system[:, k] / system[:, k, k][:, None]
        return (system - system[:, :, k, None] * row[:, None]).at[:, k].set(row)

    return jax.lax.fori_loop(0, 6, eliminate, jnp.concatenate([matrix, right[..., None]], axis=-1))[..., -1]


def _evaluate(R, place, waypoint, bounds, field, problem, energy, chunk):
    """Energies of the poses within the bounds and their quadratic models: (poses,), (poses, 6), (poses, 6, 6)."""
    _, last, blocks, _ = bounds
    count = min(max(1, chunk // problem.query.shape[1]), len(R))
    used = jnp.sum(jnp.where(jnp.arange(len(problem.weights)) < blocks, jnp.sum(problem.weights, axis=1), 0.0))

    def some(j, values):
        # The last chunk begins early rather than run over the end.
        begin = jnp.minimum(j * count, len(R) - count)
        R_, place_, waypoint_ = (jax.lax.dynamic_slice_in_dim(part, begin, count) for part in (R, place, waypoint))

        def block(b, total):
            terms = _match(R_, place_, field, problem.query[b], problem.weights[b] / used, problem.descriptors[waypoint_, b])
            return jax.tree.map(jnp.add, total, terms)

        total = jax.lax.fori_loop(0, blocks, block, tuple(jnp.zeros_like(part[:count]) for part in values))
        return jax.tree.map(lambda whole, part: jax.lax.dynamic_update_slice_in_dim(whole, part, begin, 0), values, total)

    values = tuple(jnp.zeros((len(R), *shape), R.dtype) for shape in ((), (6,), (6, 6)))
    values = jax.lax.fori_loop(0, (last + count - 1) // count, some, values)
    prior = jax.vmap(lambda R, place, target: _prior(R, place, target, field.origin, problem.centre, energy))
    return jax.tree.map(jnp.add, values, prior(R, place, problem.target[waypoint]))


def _match(R, place, field, query, weights, shown):
    """Weighted sums over query points of the mean absolute difference of descriptors, its gradient and its model's curvature."""
    arm = poses.rotate(R, query)
    x = (arm + place[:, None]).reshape(-1, 3)

    def along(axis):
        return jax.jvp(field.descriptors, (x,), (jnp.broadcast_to(axis, x.shape),))

    found, tangents = jax.vmap(along, out_axes=(None, 1))(jnp.eye(3, dtype=x.dtype))  # (points, channels), (points, 3, channels)
    residual = found - shown.reshape(found.shape)
    size = jnp.abs(residual)
    mean = jnp.mean(size, axis=-1)
    weights = jnp.tile(weights, len(R))
    share = (weights / size.shape[-1])[:, None]
    slope = jnp.einsum("pic,pc->pi", tangents, jnp.sign(residual) * share)
    weighted = tangents * (share / jnp.maximum(jnp.maximum(size, mean[:, None]), 1e-9))[:, None]
    curvature = jnp.einsum("pic,pjc->pij", tangents, weighted)

    slope, curvature = slope.reshape(*arm.shape[:2], 3), curvature.reshape(*arm.shape[:2], 3, 3)
    # A turn w moves a point by w x arm, a move v by v: rows of the jacobian (poses, size, 6, 3).
    identity = jnp.broadcast_to(jnp.eye(3, dtype=x.dtype), curvature.shape)
    jacobian = jnp.concatenate([jnp.cross(identity, arm[..., None, :]), identity], axis=-2)
    gradient = jnp.einsum("pqai,pqi->pa", jacobian, slope)
    hessian = jnp.einsum("pqai,pqbi->pab", jacobian, jacobian @ curvature)
    return jnp.sum((weights * mean).reshape(arm.shape[:2]), axis=1), gradient, hessian


def _prior(R, place, target, origin, centre, energy):
    """One pose's weighted part of eq. 3, its gradient and its model's curvature."""

    def difference(R, place):
        return pose_difference(R, place - R @ centre, origin, target, energy.lever, energy.pose_norm)

    # Along a turn about each axis, which changes R by axis x R, and a move along each.
    identity, zeros = jnp.eye(3, dtype=R.dtype), jnp.zeros((3, 3), R.dtype)
    turns = jnp.cross(identity[:, None], R.T[None]).swapaxes(1, 2)
    along = jnp.concatenate([turns, jnp.zeros_like(turns)]), jnp.concatenate([zeros, identity])
    value, rows = jax.vmap(lambda *step: jax.jvp(difference, (R, place), step), out_axes=(None, 0))(*along)
    if energy.pose_norm == "mean_absolute":
        length, share = jnp.abs(value), energy.correlation / len(value)
        loss = share * jnp.sum(length)
    else:
        length, share = jnp.sqrt(jnp.sum(value * value)), energy.correlation
        loss = share * length
    weighted = rows * (share / jnp.maximum(length, LEAST_DIFFERENCE))
    return loss, weighted @ value, weighted @ rows.T
