"""Trajectory optimisation by damped Gauss-Newton steps: the energy that `optimize` minimises, for a small part of its work.

Without eq. 6 the energy is a sum over waypoints of terms of one pose each, six unknowns apart from all others. So a
waypoint may take the best of all candidates, whichever start it came from, and a good pose of one waypoint, carried
rigidly, is a candidate for every other. The waypoint nearest the object, the keyframe, has the steepest field and the
most false minima: a random start came down to the right one in 6 to 19 % of cases. It gets more starts than the others.
The search runs on a few of the query points; only the last stage sees all of them:

1. scout: the keyframe from many random starts, few points;
2. halve: the best quarter of those, few points;
3. search: every waypoint of some random starts, few points;
4. carry: the demonstration as the keyframe's finalists, the best pose of each waypoint, or the centroids alone carry
it, few points;
5. refine: the best distinct candidates of each waypoint, few points;
6. polish: the same, all query points.
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
from tdf_jax._internal.errors import InputError
from tdf_jax.energy.losses import EnergyWeights
from tdf_jax.energy.reference import Reference
from tdf_jax.geometry import se3
from tdf_jax.networks.field import DescriptorField
from tdf_jax.solvers import gauss_newton
from tdf_jax.solvers.initial import STARTS, prepare
from tdf_jax.solvers.result import Result

# Points whose descriptors and 3 tangents exist at a time: 4 MB. With 500 query points a chunk of 512 took twice as long
# a point on a CPU with 2 MB of second-level cache a core.
CHUNK_POINTS = 128
FIRST_DAMPINGS = 1.0, 0.3, 1.0, 0.3, 0.1, 0.03  # of the six stages
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
                raise InputError(
                    f"SolveConfig(): {name} is {getattr(self, name)!r}; expected a whole number of at least 1"
                )
        if (
            not isinstance(self.steps, tuple)
            or len(self.steps) != len(FIRST_DAMPINGS)
            or not all(map(_counts, self.steps))
        ):
            raise InputError(
                f"SolveConfig(): steps is {self.steps!r}; expected a tuple of six whole numbers of at least 1"
            )
        if not 0 < self.start_radius < np.inf:
            raise InputError(f"SolveConfig(): start_radius is {self.start_radius}; expected a positive number")
        if not 0 <= self.tolerance < 1:
            raise InputError(f"SolveConfig(): tolerance is {self.tolerance}; expected 0 or more and less than 1")
        if self.start not in STARTS:
            raise InputError(f"SolveConfig(): start is {self.start!r}; expected one of {', '.join(STARTS)}")


def _counts(value):
    return isinstance(value, int | np.integer) and not isinstance(value, bool) and value >= 1


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
    progress: Callable[[int, Float[np.ndarray, " finalists"]], None] | None = None,
    mesh: jax.sharding.Mesh | None = None,
) -> Result:
    """Minimise `trajectory_energy` by damped Gauss-Newton steps from many starts, in six stages (see the module).

    Args:
        field, reference, key, goal, fix_last, energy: as for `optimize`.
        config: settings.
        starts: use these instead of random ones, all of them as scouts and in the search.
        progress: called after each stage with the steps done and the energies of the best trajectories so far, on the
            query points of the stage and without a fixed last pose (of the first two, those of the keyframe); may raise
            to cancel.
        mesh: devices to share the candidates, of this process or of several that make the same call; see
            docs/guide/scaling.md.

    Returns:
        A result whose rows are trajectories of the best, second best, ... candidates of each waypoint. Its `losses` are
        theirs from the search on, before the last stage on the few query points; its `starts` are where the last stage
        began, `steps[-1]` steps before the end.

    Raises:
        InputError: as for `optimize`, or a weight on eq. 6, which couples the waypoints.
    """
    checks.key("solve()", key)
    most = dataclasses.replace(config, inits=max(config.inits, config.scouts))
    given = starts is not None
    starts, energy = prepare("solve()", field, reference, key, goal, fix_last, energy, most, starts, mesh)
    if energy.compensator != 0:
        raise InputError(
            f"solve(): energy.compensator is {float(energy.compensator):g}; expected 0, for the solver takes waypoints one by one. Use optimize(), or imitate() with config=OptimizeConfig()"
        )
    n = starts.shape[1]
    free = n - 1 if fix_last else n
    if not (starts[:, free:] == starts[:1, free:]).all():
        raise InputError(
            "solve(): the last poses of the starts differ and fix_last keeps them; expected one, or a goal"
        )

    problem = _problem(key, reference, min(config.points, len(reference.query)))
    # Together: a program for each would be 0.15 s more to compile.
    together = _candidates(np.concatenate([starts.reshape(-1, 7), problem.target]), problem)
    drawn = Candidates(*(part[:-n].reshape(len(starts), n, *part.shape[1:]) for part in together[:2]))
    shown = Candidates(*(part[-n:] for part in together[:2]))
    scouts, inits, kept = (
        (len(starts),) * 2 + (config.finalists,) if given else (config.scouts, config.inits, config.finalists)
    )
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
        rows = np.concatenate(
            [found.history, *(np.broadcast_to(other, (len(found.history), *other.shape)) for other in others)], axis=1
        )
        return np.sort(rows, axis=1)[:, np.minimum(np.arange(kept), rows.shape[1] - 1)].sum(axis=2)

    keyframe = int(np.linalg.norm(shown.place[:free], axis=1).argmin())
    alone = [keyframe]
    found, _ = stage(0, Candidates(drawn.R[:scouts, alone], drawn.place[:scouts, alone]), waypoints=alone)
    curves = [curve(found)]
    found, _ = stage(1, _distinct(found, max(kept, scouts // 4)), waypoints=alone)
    curves.append(curve(found))
    if free > 1:
        picked = _distinct(found, kept)
        found, _ = stage(2, Candidates(drawn.R[:inits, :free], drawn.place[:inits, :free]))
        curves = [curve(found)]
        carried, _ = stage(3, _carried(found, picked, keyframe, shown, field.origin))
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
    both = _poses(Candidates(*(np.stack(pair) for pair in zip(rows[:2], begun[:2]))), problem)
    ends = np.broadcast_to(starts[:1, free:], (*both.shape[:2], n - free, 7))
    trajectories, begun = np.concatenate([both, ends], axis=2)
    losses = losses.T.astype(starts.dtype)
    return Result(*map(jnp.asarray, (trajectories, losses[:, :-1], losses[:, -1], begun)))


def _problem(key, reference, size):
    count = len(reference.query)
    # A stream of its own: start m is drawn from fold_in(key, m).
    shuffled = np.random.default_rng(np.asarray(jax.random.key_data(key)).ravel()).permutation(count)
    shape = -(-count // size), size
    # What fills up the last block is any point, and does not count.
    return gauss_newton.in_blocks(
        reference, np.resize(shuffled, shape), (np.arange(np.prod(shape)) < count).reshape(shape)
    )


def _candidates(wxyz_xyz, problem):
    R = np.asarray(se3.rotation(wxyz_xyz))
    return Candidates(R, R @ np.asarray(problem.centre) + np.asarray(se3.translation(wxyz_xyz)))


def _poses(candidates, problem):
    return np.asarray(se3.pose(candidates.R, candidates.place - candidates.R @ np.asarray(problem.centre)))


def _like(order, part):
    return order.reshape(order.shape + (1,) * (part.ndim - 2))


def _carried(found, picked, keyframe, shown, origin):
    """The demonstration as the best pose of each waypoint, the keyframe's finalists and the centroids alone carry it, rigidly."""
    free = found.R.shape[1]
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
        given = devices.placed([part[dealt] for part in given], mesh, devices.sharded(mesh))
        limits = devices.placed(limits, mesh)
    chunk = config.chunk or devices.points_at_a_time(CHUNK_POINTS)
    results = gauss_newton.descend(*given, *limits, *shared, length=max(config.steps) + 1, chunk=chunk, mesh=mesh)
    R, place, values = (
        devices.gathered(part)[np.argsort(dealt)] if mesh is not None else np.asarray(part) for part in results
    )
    history = values.T[: config.steps[stage] + 1]
    history = np.where(np.isfinite(history), history, np.inf)
    ended = [part[: rows * free].reshape(rows, free, *part.shape[1:]) for part in (R, place)]
    energies = history[:, : rows * free].reshape(len(history), rows, free)
    return Candidates(*ended, energies[-1], energies), history[-1, rows * free : count].sum()
