"""`carry`: the pick is found by descriptors, and the demonstration is warped from there to the goal.

Eq. 3 of the paper holds every waypoint near the demonstration's pose in the world, while its descriptors pull every
waypoint along with the object. Where object and goal move differently, the two disagree at every waypoint. Here
descriptors determine one motion, that of the pick, and the goal determines the other; the waypoints between follow
both.
"""

import dataclasses
import functools
from collections.abc import Callable, Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from tdf_jax._internal import checks
from tdf_jax._internal.boundary import public
from tdf_jax._internal.deprecation import renamed_fields, renamed_keywords
from tdf_jax._internal.errors import InputError
from tdf_jax.energy.losses import EnergyWeights
from tdf_jax.energy.reference import Reference
from tdf_jax.energy.residual import pick_residual, traced_pick_residual
from tdf_jax.geometry.trajectory import Trajectory
from tdf_jax.geometry.transport import carry_to_picks
from tdf_jax.networks.field import DescriptorField, stacked, stacked_axes
from tdf_jax.solvers.initial import default_goal
from tdf_jax.solvers.multistart import SolveConfig, check_stage_settings, solve
from tdf_jax.solvers.result import Result, with_ends


@renamed_fields(
    scouts="num_starts",
    finalists="num_candidates",
    points="num_coarse_queries",
    chunk="chunk_queries",
    steps=("coarse_steps", "prune_steps", "refine_steps", "polish_steps"),
)
@dataclasses.dataclass(frozen=True, kw_only=True)
class CarryConfig:
    """Settings of `carry`: those of the solver that finds the pick.

    Attributes:
        num_starts: number of random starts of the pick. The worse half takes half of the coarse steps only.
        num_candidates: number of candidates that are refined and polished, the rows of the result. Several may converge
            to one pose, see `cluster_poses`.
        num_coarse_queries: number of query points that all stages but the last evaluate, drawn at random.
        coarse_steps: maximal number of steps from every start.
        prune_steps: maximal number of steps of the best quarter of the starts.
        refine_steps: maximal number of steps of the candidates.
        polish_steps: maximal number of steps of the candidates with all query points. They are many, so that the
            candidates converge and show how many distinct solutions there are: after four steps some are 5 to 90
            degrees from their minima.
        tolerance: see `SolveConfig`.
        start: distribution of the starts, see `OptimizeConfig`.
        start_radius: radius of the starts, metres, see `OptimizeConfig`.
        chunk_queries: see `SolveConfig`.

    Raises:
        InputError: a setting is out of its range.
    """

    num_starts: int = 64
    num_candidates: int = 5
    num_coarse_queries: int = 16
    coarse_steps: int = 6
    prune_steps: int = 10
    refine_steps: int = 6
    polish_steps: int = 24
    tolerance: float = 1e-3
    start: str = "carried"
    start_radius: float = 0.1
    chunk_queries: int | None = None

    def __post_init__(self):
        check_stage_settings("CarryConfig()", self)

    @property
    def num_steps(self) -> int:
        """Maximal number of steps of all stages together."""
        return self.coarse_steps + self.prune_steps + self.refine_steps + self.polish_steps

    @property
    def solver(self) -> SolveConfig:
        """The settings for `solve`, which neither searches nor propagates where there is one waypoint."""
        settings = {field.name: getattr(self, field.name) for field in dataclasses.fields(self)}
        return SolveConfig(num_trajectory_starts=1, search_steps=1, propagate_steps=1, **settings)


@public
@renamed_keywords(mesh="device_mesh")
def carry(
    field: DescriptorField,
    reference: Reference,
    key: PRNGKeyArray,
    *,
    goal: Float[Array | np.ndarray, "7"] | None = None,
    fix_last: bool = True,
    config: CarryConfig = CarryConfig(),
    progress: Callable[[int, Float[np.ndarray, " candidates"]], None] | None = None,
    device_mesh: jax.sharding.Mesh | None = None,
) -> Result:
    """Find the pick by its descriptors (eq. 2 of one waypoint) and warp the demonstration from there to the goal.

    Any array may be traced by `jax.jit` and `jax.vmap`, as in `solve`.

    Args:
        field: descriptor field of the new object.
        reference: the demonstration.
        key: random key of the starts and of the coarse query points.
        goal: pose at the release, (7,), T_world_query; by default the demonstration's, moved by the centroids.
        fix_last: end at the goal; otherwise the demonstration is carried rigidly with the pick.
        config: settings.
        progress: see `solve`.
        device_mesh: see `solve`.

    Returns:
        The result. Each candidate is a pick with its trajectory; its energy is that of the pick's descriptors.

    Raises:
        InputError: as for `solve`, or a goal that fix_last=False would not keep.
    """
    checks.key("carry()", key)
    if not isinstance(config, CarryConfig):
        raise InputError(f"carry(): config is {config!r}; expected a CarryConfig")
    if fix_last and reference.trajectory.num_poses == 1:
        raise InputError("carry(): the trajectory has one pose and fix_last keeps it; expected fix_last=False")
    if goal is not None and not fix_last:
        raise InputError("carry(): there is a goal, and fix_last=False does not keep it; drop one of them")
    if fix_last:
        goal = jnp.asarray(checks.pose("carry()", "goal", default_goal(field, reference) if goal is None else goal))
    pick = pick_of(reference)
    result = solve(
        field,
        pick,
        key,
        fix_last=False,
        energy=EnergyWeights(0.0),
        config=config.solver,
        progress=progress,
        device_mesh=device_mesh,
    )
    # Candidates and starts go through one program. Outside of a trace they are joined and parted on the host: each
    # operation on an array of JAX would be a program to compile.
    xp = jnp if checks.traced(result.trajectories) else np
    found, starts = xp.asarray(result.trajectories), xp.asarray(result.initial_trajectories)
    picks = xp.concatenate([found[:, 0], starts[:, 0]])
    trajectories = xp.asarray(carry_to_picks(reference.trajectory, picks, goal))
    count = len(result.trajectories)
    if checks.traced(result.energies, reference.descriptors):
        residual = traced_pick_residual(jnp.min(result.energies), pick.descriptors[0])
    else:
        residual = pick_residual(float(result.loss), pick.descriptors[0]) if result.finite.any() else np.nan
        residual = np.asarray(residual, result.energies.dtype)
    result = dataclasses.replace(
        result,
        trajectories=jnp.asarray(trajectories[:count]),
        initial_trajectories=jnp.asarray(trajectories[count:]),
        residual=residual,
        origin=field.origin,
        latent=field.latent,
        first_residual=residual,
    )
    return with_ends(result, reference)


def pick_of(reference: Reference) -> Reference:
    """The pick alone, a demonstration of one pose."""
    return Reference(reference.descriptors[:1], Trajectory(reference.trajectory.wxyz_xyz[:1]), reference.query)


# Fields of a result of `carry` that are known in a traced call.
KNOWN = ("trajectories", "energies", "candidate_history", "initial_trajectories", "history", "residual")


def carry_together(
    fields: Sequence[DescriptorField],
    reference: Reference,
    keys: Sequence[PRNGKeyArray],
    goals: Sequence[Float[Array, "7"]] | None,
    room: int,
    config: CarryConfig,
) -> list[Result]:
    """Call `carry` for several objects in one program.

    Args:
        fields: descriptor fields of the objects, by one network.
        reference: the demonstration.
        keys: random key for each object.
        goals: pose at the release for each object, T_world_query, (7,); None for `fix_last=False`.
        room: number of objects that the program has room for; fewer repeat the first one, and compile nothing new.
        config: settings.

    Returns:
        The result of `carry` for each object, up to rounding.
    """
    some = [index if index < len(fields) else 0 for index in range(room)]
    found = _carried(
        stacked([fields[index] for index in some]),
        reference,
        jnp.stack([keys[index] for index in some]),
        None if goals is None else jnp.stack([goals[index] for index in some]),
        config=config,
    )
    found = {name: np.array(part) for name, part in found.items()}
    for name in ("history", "residual"):  # unknown numbers; they stay in numpy, see `solve`
        found[name][np.isinf(found[name])] = np.nan
    results = []
    for index, field in enumerate(fields):
        parts = {name: part[index] for name, part in found.items()}
        known = {name: part if name in ("history", "residual") else jnp.asarray(part) for name, part in parts.items()}
        results.append(
            Result(
                **known,
                origin=field.origin,
                latent=field.latent,
                first_residual=parts["residual"],
                grasp=len(reference.approach),
                release=-1 - len(reference.retreat),
            )
        )
    return results


@functools.partial(jax.jit, static_argnames="config")
def _carried(fields, reference, keys, goals, *, config):
    def one(field, key, goal):
        result = carry(field, reference, key, goal=goal, fix_last=goal is not None, config=config)
        return {name: getattr(result, name) for name in KNOWN}

    return jax.vmap(one, in_axes=(stacked_axes(fields), 0, 0))(fields, keys, goals)
