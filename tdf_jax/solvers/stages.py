"""Stages of `solve`: their sizes, what each begins with, and the candidates that it leaves to the next.

The functions compute with `xp`, which is jax.numpy where a call is traced. Otherwise it is numpy, because the poses are
a few hundred, and numpy needs no compilation.
"""

import functools
import math
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from tdf_jax.geometry import se3

STAGES = ("coarse", "prune", "search", "propagate", "refine", "polish")
# Within 10 degrees and these metres two candidates count as one.
COSINE_SAME, SAME_DISTANCE = float(np.cos(np.radians(10))), 0.01


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
        # Half of the starts are given up early, but not fewer go on than the next stage takes.
        kept = max(moving // 2, math.prod(self.shape("prune"))) if stage == "coarse" else moving
        return np.array([moving, evaluated, num_blocks if polish else 1, self.num_steps(stage), kept], np.int32)


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


class Begin(NamedTuple):
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


class State(NamedTuple):
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


def begin(xp, initial, origin, problem, plan) -> Begin:
    """What the stages begin with, of the starts `initial` and the object's `origin`."""
    # The starts and the demonstration share one program, which saves the compilation of a second one.
    n = plan.num_poses
    together = candidates_of(xp, xp.concatenate([initial.reshape(-1, 7), xp.asarray(problem.target)]), problem)
    drawn = Candidates(*(part[:-n].reshape(-1, n, *part.shape[1:]) for part in together[:2]))
    demonstrated = Candidates(*(part[-n:] for part in together[:2]))
    keyframe = (demonstrated.centroid[: plan.free] ** 2).sum(axis=1).argmin()
    return Begin(drawn, demonstrated, xp.asarray(origin), keyframe)


def candidates_of(xp, wxyz_xyz, problem) -> Candidates:
    """Poses T_world_query, (..., 7), as candidates without energies."""
    R, translation = (xp.asarray(part(wxyz_xyz)) for part in (se3.rotation, se3.translation))
    return Candidates(R, _rotated(R, xp.asarray(problem.centre)) + translation)


def poses_of(xp, candidates, problem):
    """Poses T_world_query of candidates, (..., 7)."""
    centre = xp.asarray(problem.centre)
    return xp.asarray(se3.pose(candidates.R, candidates.centroid - _rotated(candidates.R, centre)))


def _rotated(R, x):
    return (R * x[..., None, :]).sum(axis=-1)


def _multiplied(R_a, R_b):
    return (R_a[..., :, :, None] * R_b[..., None, :, :]).sum(axis=-2)


def blank(begin, plan) -> State:
    """The state before the first stage."""
    dtype, (rows, columns) = begin.drawn.R.dtype, plan.shape("search")
    picked, searched = (plan.num_candidates, 1), (rows, columns)
    return State(
        np.zeros((plan.room, 3, 3), dtype),
        np.zeros((plan.room, 3), dtype),
        np.full((plan.room, plan.length), np.inf, dtype),
        np.zeros(plan.room, np.int32),
        Candidates(np.zeros((*picked, 3, 3), dtype), np.zeros((*picked, 3), dtype)),
        Candidates(
            np.zeros((*searched, 3, 3), dtype), np.zeros((*searched, 3), dtype), np.full(searched, np.inf, dtype)
        ),
    )


def enter(xp, stage, plan, state, begin):
    """Poses that a stage begins with, and the waypoints that they match, (room, ...); and the state, updated."""
    drawn, kept, alone = begin.drawn, plan.num_candidates, begin.keyframe
    rows, columns = plan.shape(stage)
    starts, waypoints = xp.arange(rows), xp.arange(columns)
    if stage == "coarse":
        entering, waypoints = Candidates(drawn.R[:rows, alone][:, None], drawn.centroid[:rows, alone][:, None]), alone
    elif stage == "prune":
        entering, chosen = distinct(xp, found_candidates(xp, "coarse", state, plan), rows)
        starts, waypoints = chosen[:, 0], alone
    elif stage == "search":
        state = state._replace(picked=distinct(xp, found_candidates(xp, "prune", state, plan), kept)[0])
        entering = Candidates(drawn.R[:rows, :columns], drawn.centroid[:rows, :columns])
    elif stage == "propagate":
        state = state._replace(searched=found_candidates(xp, "search", state, plan))
        entering = propagated(xp, state.searched, state.picked, alone, begin.demonstrated, begin.origin)
    else:
        found = found_candidates(xp, plan.stages[plan.stages.index(stage) - 1], state, plan)
        if stage == "refine" and columns > 1:
            found = Candidates(*(xp.concatenate(parts) for parts in zip(state.searched, found)))
        entering, chosen = distinct(xp, found, kept)
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


def found_candidates(xp, stage, state, plan):
    """The candidates at the end of a stage."""
    shape = plan.shape(stage)

    def grid(part):
        return part[: math.prod(shape)].reshape(*shape, *part.shape[1:])

    return Candidates(grid(state.R), grid(state.centroid), grid(infinite_unless_finite(xp, state.values[:, -1])))


def infinite_unless_finite(xp, energies):
    """Energies, infinite where they are NaN, so that no candidate without an energy is the best."""
    return xp.where(xp.isfinite(energies), energies, xp.inf)


def propagated(xp, found, picked, keyframe, demonstrated, origin):
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


def distinct(xp, found, kept):
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


def finish(xp, state, stages, initial, problem, plan):
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
        return infinite_unless_finite(xp, energies).reshape(rows, columns, -1)

    def best(stage, *others):
        """Energies (candidates, times) of the best candidates of each waypoint; those of `others` are constant."""
        energies = course(stage)
        rows = [energies, *(xp.broadcast_to(other, (*other.shape[:2], energies.shape[2])) for other in others)]
        ordered = xp.sort(xp.concatenate(rows), axis=0)
        return ordered[np.minimum(np.arange(kept), len(ordered) - 1)].sum(axis=1)

    fixed = infinite_unless_finite(xp, values["polish"][kept * free : kept * free + n - free, -1]).sum()
    curves = [best(stage) for stage in plan.stages[:-1] if free == 1 or stage not in ("coarse", "prune", "propagate")]
    if free > 1:
        curves.insert(1, best("propagate", course("search")[:, :, -1:]))
    last, ended = course("polish"), found_candidates(xp, "polish", state, plan)
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
    trajectories = xp.concatenate([poses_of(xp, ordered, problem), ends], axis=1)
    return tuple(part.astype(initial.dtype) for part in (trajectories, losses, history))
