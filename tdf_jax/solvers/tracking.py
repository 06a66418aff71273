"""`track`: the pick on an object that moved, from the last pick.

The latent of a cloud rotates with it, so two latents give the rotation of an object between two clouds, and their
centroids its translation: the last pick, moved as they say, is near the new minimum of the energy, which `carry` finds
from many random starts. Where an object is symmetric, latents rotate to any of the equivalent poses, and the field with
them, so the pick jumps as that of `carry` would. Clouds of different sides of an object have latents that are less
alike, for which there are more starts:

1. starts: the last pick; and moved with the object, as it is and rotated a little in many directions;
2. refine: the best of them on a few query points, by Gauss-Newton steps;
3. polish: the best one, on all query points.

Another minimum has a higher energy, and so has an object of another shape or a cloud of something else. An energy far
above that of the pick of `carry` therefore says that the pick is lost.
"""

import dataclasses
import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from tdf_jax._internal import checks, devices
from tdf_jax._internal.boundary import public
from tdf_jax._internal.errors import InputError
from tdf_jax._internal.precision import full_precision
from tdf_jax.energy.losses import EnergyWeights
from tdf_jax.energy.reference import Reference
from tdf_jax.energy.residual import traced_pick_residual
from tdf_jax.geometry import se3
from tdf_jax.geometry.transport import carry_to_picks
from tdf_jax.networks.field import DescriptorField
from tdf_jax.solvers import gauss_newton
from tdf_jax.solvers.initial import check_channels, default_goal
from tdf_jax.solvers.pick import pick_of
from tdf_jax.solvers.result import Result, with_ends
from tdf_jax.solvers.stages import infinite_unless_finite

GOLDEN = (np.sqrt(5) - 1) / 2
DAMPINGS = 0.3, 0.03  # of the first step of refine and of polish


@dataclasses.dataclass(frozen=True, kw_only=True)
class TrackConfig:
    """Settings of `track`.

    Attributes:
        num_rotations: number of starts that are rotated from where the latents say.
        rotation: largest angle by which they are, radians.
        num_candidates: number of starts that are refined.
        num_coarse_queries: number of query points on which they are.
        refine_steps: maximal number of steps of the candidates.
        polish_steps: maximal number of steps of the best candidate, with all query points.
        tolerance: see `SolveConfig`.
        largest_energy: energy over that of the pick of `carry` above which the pick is lost.

    Raises:
        InputError: a setting is out of its range.
    """

    num_rotations: int = 16
    rotation: float = 0.3
    num_candidates: int = 2
    num_coarse_queries: int = 16
    refine_steps: int = 5
    polish_steps: int = 12
    tolerance: float = 1e-3
    largest_energy: float = 1.25

    def __post_init__(self):
        for field in dataclasses.fields(self):
            if field.type is int:
                checks.count("TrackConfig()", field.name, getattr(self, field.name))
        checks.number("TrackConfig()", "rotation", self.rotation, 0, below=np.pi, unit="radians")
        checks.number("TrackConfig()", "tolerance", self.tolerance, 0, below=1)
        checks.number("TrackConfig()", "largest_energy", self.largest_energy, 1)
        if self.num_candidates > self.num_rotations + 2:
            raise InputError(
                f"TrackConfig(): num_candidates is {self.num_candidates}; expected at most the number of starts, "
                f"{self.num_rotations + 2}, which is num_rotations + 2"
            )


@public
def track(
    field: DescriptorField,
    reference: Reference,
    result: Result,
    *,
    goal: Float[Array | np.ndarray, "7"] | None = None,
    fix_last: bool = True,
    config: TrackConfig = TrackConfig(),
) -> Result:
    """Find the pick again on an object that moved, from the last result, in a fraction of the time of `carry`.

    Where the energy is too high the pick is lost: `Result.lost` and `.status` say so, and `.best`, `.trajectory` and
    what else takes the best candidate raise. Call `carry` then. docs/results/performance.md#tracking compares both.

    The path is the demonstrated one between pick and goal, as that of `carry`: after a result of `imitate` with a
    target it does not repeat the demonstrated arrival there, and has as many poses as the demonstration.

    Any array may be traced by `jax.jit` and `jax.vmap`, as in `carry`. Inside of a trace nothing can be raised: look at
    `.lost`.

    Args:
        field: descriptor field of the moved object, from a new `encode`.
        reference: the demonstration, the same that the result is of.
        result: last result of `carry`, `imitate` or `track`.
        goal: pose at the release, (7,), T_world_query; by default the demonstration's, moved by the centroids, as in
            `carry`. Pass `result.goal` to keep the last one.
        fix_last: see `carry`.
        config: settings.

    Returns:
        The result, whose one candidate is the pick with its trajectory. Its energy is that of the pick's descriptors;
        `initial_trajectories` holds all starts, and `history` follows those that are refined.

    Raises:
        InputError: the last result is lost, is of another demonstration or of a solver that finds no pick by its
            descriptors, the demonstration has a target and there is no goal, or as for `carry`.
    """
    if not isinstance(config, TrackConfig):
        raise InputError(f"track(): config is {config!r}; expected a TrackConfig")
    if not isinstance(result, Result):
        raise InputError(f"track(): result is a {type(result).__name__}; expected the Result of carry() or track()")
    check_channels("track()", field, reference)
    before, after = len(reference.approach), len(reference.retreat)
    num_poses = before + reference.trajectory.num_poses + after
    shape = np.shape(result.trajectories)
    # A path to a target is denser than the demonstration; of every result the pick alone is used.
    denser = len(result.target_trajectories) > 0
    if np.ndim(result.energies) != 1 or (shape[-2] != num_poses and not denser):
        raise InputError(
            f"track(): the trajectories of the result have shape {shape}; expected (candidates, {num_poses}, 7), as of "
            "one result of this demonstration. For a batch use jax.vmap"
        )
    if (result.grasp, result.release) != (before, -1 - after):
        raise InputError(
            f"track(): the result has its grasp at pose {result.grasp} and its release at {result.release}; expected "
            f"{before} and {-1 - after}, as of a result of this demonstration"
        )
    if np.shape(result.latent) != field.latent.shape:
        raise InputError(
            f"track(): the latent of the result has shape {np.shape(result.latent)} and the field's "
            f"{field.latent.shape}; expected a result of carry(), imitate() or track() with the same model. Find the "
            "pick by carry()"
        )
    if fix_last and reference.trajectory.num_poses == 1:
        raise InputError("track(): the trajectory has one pose and fix_last keeps it; expected fix_last=False")
    if goal is not None and not fix_last:
        raise InputError("track(): there is a goal, and fix_last=False does not keep it; drop one of them")
    if goal is None and fix_last and reference.contact is not None:
        raise InputError(
            "track(): the demonstration has a target, which gives the goal; expected a goal. Pass goal=result.goal if "
            "the target has not moved, and call imitate() if it has"
        )
    first, lost = result.first_residual, result.lost
    if not checks.traced(first, lost):
        if np.asarray(lost).any():
            raise InputError("track(): the last result is lost; expected one that is not. Find the pick by carry()")
        if not np.isfinite(np.asarray(first)):
            raise InputError(
                "track(): the last result has no residual; expected a result of carry(), imitate() or track() on at "
                "least two query points. Find the pick by carry()"
            )
    if fix_last:
        goal = jnp.asarray(checks.pose("track()", "goal", default_goal(field, reference) if goal is None else goal))
    sizes = _Sizes(
        config.num_rotations,
        config.num_candidates,
        min(config.num_coarse_queries, len(reference.query)),
        config.refine_steps,
        config.polish_steps,
    )
    dtype = jnp.result_type(reference.query, reference.descriptors, field.latent)
    numbers = [
        jnp.asarray(value, dtype)
        for value in (result.pick, result.origin, result.latent, config.rotation, config.tolerance)
    ]
    found = _tracked(*numbers, field, pick_of(reference), sizes=sizes)
    trajectories = carry_to_picks(reference.trajectory, found.picks, goal)
    history, residual = found.history, found.residual
    if not checks.traced(history):
        # It stays in numpy: under `jax_debug_nans` an array of jax must not hold NaN.
        history, residual = np.array(history), np.asarray(residual)
        history[np.isinf(history)] = np.nan
    result = Result(
        trajectories=trajectories[:1],
        energies=found.energy,
        candidate_history=found.course,
        initial_trajectories=trajectories[1:],
        history=history,
        residual=residual,
        origin=field.origin,
        latent=field.latent,
        first_residual=first,
        lost=~(residual <= config.largest_energy * first) | lost,
    )
    return with_ends(result, reference)


class _Sizes(NamedTuple):
    """Static settings, see `TrackConfig`."""

    rotations: int
    candidates: int
    coarse_queries: int
    refine_steps: int
    polish_steps: int


class _Found(NamedTuple):
    """What `_tracked` finds.

    Attributes:
        picks: the pick, and then all starts, `wxyz_xyz`, (1 + starts, 7), T_world_query.
        energy: energy of the pick, (1,).
        course: energy of the best candidate before each step, (1, steps).
        history: energy of every start before each step, (starts, steps), infinite where it is not followed.
        residual: residual of the pick.
    """

    picks: Float[Array, "picks 7"]
    energy: Float[Array, "1"]
    course: Float[Array, "1 steps"]
    history: Float[Array, "starts steps"]
    residual: Float[Array, ""]


@functools.partial(jax.jit, static_argnames="sizes")
def _tracked(last, origin, latent, rotation, tolerance, field, pick, *, sizes) -> _Found:
    return devices.mapped(functools.partial(_track, sizes=sizes))(
        last, origin, latent, rotation, tolerance, field, pick
    )


@full_precision
def _track(last, origin, latent, rotation, tolerance, field, pick, *, sizes):
    problem = gauss_newton.in_blocks(pick, *_evenly(len(pick.query), sizes.coarse_queries))
    R, centroid = _starts(last, origin, latent, rotation, field, problem, sizes.rotations)
    values = infinite_unless_finite(jnp, _energies(R, centroid, field, problem))
    chosen = jnp.argsort(values)[: sizes.candidates]
    # Both stages run one program: polish moves the first candidate only, but has room for as many.
    steps = np.array([sizes.refine_steps, sizes.polish_steps], np.int32)
    moving, blocks = np.array([sizes.candidates, 1], np.int32), np.array([1, len(problem.query)], np.int32)
    bounds = np.stack([moving, moving, blocks, steps, moving], axis=1)
    energy = jax.tree.map(lambda weight: jnp.asarray(weight, R.dtype), EnergyWeights(0.0))

    def stage(state, limits):
        bounds, damping = limits
        *ended, course = gauss_newton.descend(
            *state, jnp.zeros(sizes.candidates, jnp.int32), bounds, damping, tolerance, field, problem, energy,
            length=int(steps.max()) + 1, chunk=devices.points_at_a_time(sizes.coarse_queries),
        )  # fmt: skip
        course = jnp.where(
            (jnp.arange(sizes.candidates) < bounds[0])[:, None], infinite_unless_finite(jnp, course), jnp.inf
        )
        order = jnp.argsort(course[:, -1])
        return [part[order] for part in ended], (course, order)

    limits = bounds, np.array(DAMPINGS, R.dtype)
    (R_found, c_found), (courses, orders) = jax.lax.scan(stage, [R[chosen], centroid[chosen]], limits)

    best = orders[0, 0]
    refined, polished = courses[0, :, : sizes.refine_steps], courses[1, 0, : sizes.polish_steps]
    history = jnp.full((len(R), sizes.refine_steps + sizes.polish_steps), jnp.inf, R.dtype)
    history = history.at[:, 0].set(values).at[chosen, : sizes.refine_steps].set(refined)
    history = history.at[chosen[best], sizes.refine_steps :].set(polished)
    R, centroid = jnp.concatenate([R_found[:1], R]), jnp.concatenate([c_found[:1], centroid])
    picks = se3.pose(R, centroid - se3.rotate(R, problem.centre[None])[:, 0])
    ended = courses[1, :1, -1]
    return _Found(
        picks, ended, history[chosen[best]][None], history, traced_pick_residual(ended[0], pick.descriptors[0])
    )


def _evenly(count: int, size: int) -> tuple[np.ndarray, np.ndarray]:
    """Arguments of `gauss_newton.in_blocks`: every block has query points from all over their order."""
    blocks = -(-count // size)
    order = np.arange(size * blocks).reshape(size, blocks).T
    return order % count, order < count


def _starts(last, origin, latent, rotation, field, problem, number):
    """The last pick; and moved with the object, and rotated about its new origin in `number` ways.

    Returns:
        Rotations (2 + number, 3, 3) and centroids of the query points (2 + number, 3), world frame.
    """
    # A spiral through the ball of rotation vectors, which fills it evenly.
    k = np.arange(number)
    z = 2 * ((k + 0.5) * GOLDEN % 1) - 1
    across, longitude = np.sqrt(1 - z**2), np.pi * (3 - np.sqrt(5)) * k
    radius = ((k + 1) / number) ** (1 / 3)
    vectors = radius[:, None] * np.stack([across * np.cos(longitude), across * np.sin(longitude), z], axis=1)
    nearby = se3.exp(rotation * jnp.asarray(np.concatenate([np.zeros((1, 3)), vectors]), last.dtype))
    rotations = se3.multiply(nearby, _rotation_between(latent, field.latent)[None])
    R, centroid = se3.rotation(last), se3.transform(last, problem.centre[None])[0]
    moved = field.origin + se3.rotate(rotations, (centroid - origin)[None])[:, 0]
    return jnp.concatenate([R[None], se3.multiply(rotations, R[None])]), jnp.concatenate([centroid[None], moved])


def _rotation_between(old, new):
    """The rotation that takes the vectors of one latent nearest to those of another (Kabsch, 1976)."""
    u, _, v = jnp.linalg.svd(new.T @ old)
    proper = jnp.ones(3, u.dtype).at[2].set(jnp.sign(jnp.linalg.det(u) * jnp.linalg.det(v)))
    return (u * proper) @ v


def _energies(R, centroid, field, problem):
    """Energies of poses on the first block of query points."""
    x = se3.rotate(R, problem.query[0]) + centroid[:, None]
    share = problem.weights[0] / jnp.sum(problem.weights[0])
    return jnp.mean(jnp.abs(field.descriptors(x) - problem.descriptors[0, 0]), axis=-1) @ share
