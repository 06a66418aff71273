"""The demonstration carried to a new object: its pick found by descriptors, the way to the goal turned evenly.

Eq. 3 of the paper holds every waypoint near the demonstration's pose in the world, and its descriptors pull every
waypoint along with the object: where object and goal moved differently the two disagree, waypoint by waypoint. Here
descriptors find one motion, that of the pick, and the goal gives the other; each waypoint is carried by what lies
between them (docs/results/benchmark.md compares).
"""

import dataclasses
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from tdf_jax._internal import checks
from tdf_jax._internal.errors import InputError
from tdf_jax.energy.losses import EnergyWeights
from tdf_jax.energy.reference import Reference
from tdf_jax.energy.residual import pick_residual
from tdf_jax.geometry.trajectory import Trajectory
from tdf_jax.geometry.transport import carry_to_picks
from tdf_jax.networks.field import DescriptorField
from tdf_jax.solvers.initial import check_goal, default_goal
from tdf_jax.solvers.multistart import SolveConfig, solve
from tdf_jax.solvers.result import Result


@dataclasses.dataclass(frozen=True)
class CarryConfig:
    """Settings of `carry`: those of the solver that finds the pick.

    Attributes:
        scouts: random starts.
        finalists: candidates that are kept to the end, the rows of the result; several may come to one pose, see
            `cluster_poses`.
        points: query points that all stages but the last see, drawn at random from all.
        steps: most steps of the four stages: from all scouts, from the best quarter of them, of the finalists, and of
            these with all query points. The last are many, so that the finalists tell how many distinct solutions there
            are: after four some are 5 to 90 degrees from their minima.
        tolerance, start, start_radius, chunk: see `SolveConfig`.
    """

    scouts: int = 64
    finalists: int = 5
    points: int = 16
    steps: tuple[int, int, int, int] = (6, 10, 6, 24)
    tolerance: float = 1e-3
    start: str = "carried"
    start_radius: float = 0.1
    chunk: int | None = None

    def __post_init__(self):
        if not isinstance(self.steps, tuple) or len(self.steps) != 4:
            raise InputError(
                f"CarryConfig(): steps is {self.steps!r}; expected a tuple of four whole numbers of at least 1"
            )
        try:
            self.solver
        except InputError as error:
            raise InputError(str(error).replace("SolveConfig()", "CarryConfig()").replace("six", "four")) from None

    @property
    def solver(self) -> SolveConfig:
        """The solver's settings: of one waypoint it makes no search of whole trajectories, and carries none."""
        scout, halve, refine, polish = self.steps
        settings = {
            name: getattr(self, name)
            for name in ("scouts", "finalists", "points", "tolerance", "start", "start_radius", "chunk")
        }
        return SolveConfig(inits=1, steps=(scout, halve, 1, 1, refine, polish), **settings)


def carry(
    field: DescriptorField,
    reference: Reference,
    key: PRNGKeyArray,
    *,
    goal: Float[Array, "7"] | None = None,
    fix_last: bool = True,
    config: CarryConfig = CarryConfig(),
    progress: Callable[[int, Float[np.ndarray, " finalists"]], None] | None = None,
    mesh: jax.sharding.Mesh | None = None,
) -> Result:
    """Find the pick by its descriptors (eq. 2 of one waypoint) and carry the demonstration from there to the goal.

    Args:
        field: the new object's.
        reference: the demonstration's.
        key: random key of the starts.
        goal: last pose, T_world_query; by default, if it is kept, the demonstration's, carried by the centroids.
        fix_last: end at the goal; without, the demonstration is carried rigidly with the pick.
        config: settings.
        progress, mesh: see `solve`.

    Returns:
        A result whose rows are the picks that the solver's finalists came to, each with its trajectory; losses and
        energies are those of the picks' descriptors.

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
        goal = default_goal(field, reference) if goal is None else goal
        check_goal("carry()", goal)
        goal = jnp.asarray(goal)
    picked = Reference(reference.descriptors[:1], Trajectory(reference.trajectory.wxyz_xyz[:1]), reference.query)
    result = solve(
        field,
        picked,
        key,
        fix_last=False,
        energy=EnergyWeights(0.0),
        config=config.solver,
        progress=progress,
        mesh=mesh,
    )
    trajectories, starts = (
        carry_to_picks(reference.trajectory, part[:, 0], goal) for part in (result.trajectories, result.starts)
    )
    left = pick_residual(result.loss, picked.descriptors[0]) if result.finite.any() else float("nan")
    return dataclasses.replace(result, trajectories=trajectories, starts=starts, residual=left)
