"""The demonstration carried to a new object: its pick found by descriptors, the way to the goal turned evenly.

Eq. 3 of the paper holds every waypoint near the demonstration's pose in the world, and its descriptors pull every waypoint along with
the object: where object and goal moved differently the two disagree, waypoint by waypoint. Here descriptors find one motion, that of the pick, and the goal
gives the other; each waypoint is carried by what lies between them (docs/benchmark.md compares).
"""

import dataclasses
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from tdf_jax import poses
from tdf_jax.confidence import confidence, residual
from tdf_jax.demonstration import Reference
from tdf_jax.energy import EnergyWeights
from tdf_jax.errors import InputError
from tdf_jax.field import DescriptorField
from tdf_jax.keys import check_key
from tdf_jax.optimize import Result, check_goal, default_goal
from tdf_jax.solve import SolveConfig, solve
from tdf_jax.trajectory import Trajectory


@dataclasses.dataclass(frozen=True)
class CarryConfig:
    """Settings of `carry`.

    Attributes:
        pick: of the solver that finds the pick; its finalists are the rows of the result. They are polished to their minima, so that they tell how many
            distinct solutions there are: after the solver's usual 4 steps some are still 5 to 90 degrees from theirs.
    """

    pick: SolveConfig = SolveConfig(finalists=5, steps=(6, 10, 6, 4, 6, 24))

    def __post_init__(self):
        if not isinstance(self.pick, SolveConfig):
            raise InputError(f"CarryConfig(): pick is {self.pick!r}; expected a SolveConfig")


def carry_trajectory(demonstrated: Trajectory, pick: Float[Array, "7"], goal: Float[Array, "7"] | None) -> Trajectory:
    """A demonstration carried by the motions of both of its ends.

    With A the motion of the first pose to the pick and G that of the last pose to the goal, waypoint i of n is moved by B_i at
    s = i / (n - 1): its rotation is the geodesic from A's to G's at s, and the waypoint is carried to the point at s on the line between where A and
    where G would carry it. The first pose becomes the pick and the last the goal.

    Args:
        demonstrated: T_world_query, or in any other frame of the demonstration.
        pick: first pose of the new trajectory, T_world_query, `wxyz_xyz`.
        goal: its last pose; None carries all poses rigidly with the pick.

    Returns:
        The trajectory, T_world_query.
    """
    pick_motion = poses.compose(pick, poses.inverse(demonstrated.wxyz_xyz[0]))
    if goal is None:
        return demonstrated.transformed(pick_motion)
    goal_motion = poses.compose(goal, poses.inverse(demonstrated.wxyz_xyz[-1]))
    s = jnp.arange(demonstrated.poses) / max(1, demonstrated.poses - 1)
    turn = poses.geodesic(poses.rotation(pick_motion), poses.rotation(goal_motion), s)
    t = demonstrated.translations
    carried = (1 - s)[:, None] * poses.transform(pick_motion, t) + s[:, None] * poses.transform(goal_motion, t)
    return Trajectory(poses.pose(jnp.matmul(turn, demonstrated.rotations, precision=jax.lax.Precision.HIGHEST), carried))


def carry(
    field: DescriptorField,
    reference: Reference,
    key: PRNGKeyArray,
    *,
    goal: Float[Array, "7"] | None = None,
    fix_last: bool = True,
    config: CarryConfig = CarryConfig(),
    progress: Callable[[int, Float[np.ndarray, "finalists"]], None] | None = None,
    mesh: jax.sharding.Mesh | None = None,
) -> Result:
    """Find the pick by its descriptors (eq. 2 of one waypoint) and carry the demonstration from there to the goal.

    Args:
        field: the new object's.
        reference: the demonstration's.
        key: random key of the starts.
        goal: last pose, T_world_query; by default, if it is kept, the demonstration's, carried by the centroids.
        fix_last: end at the goal; without, and without a goal, the demonstration is carried rigidly with the pick.
        config: settings.
        progress, mesh: see `solve`.

    Returns:
        A result whose rows are the distinct picks that the solver ended with, each with its trajectory; losses and energies are those of the picks' descriptors.

    Raises:
        InputError: as for `solve`.
    """
    check_key("carry()", key)
    if fix_last and reference.trajectory.poses == 1:
        raise InputError("carry(): the trajectory has one pose and fix_last keeps it; expected fix_last=False")
    if goal is None and fix_last:
        goal = default_goal(field, reference)
    if goal is not None:
        check_goal("carry()", goal)
        goal = jnp.asarray(goal)
    picked = Reference(reference.descriptors[:1], Trajectory(reference.trajectory.wxyz_xyz[:1]), reference.query)
    result = solve(field, picked, key, fix_last=False, energy=EnergyWeights(0.0), config=config.pick, progress=progress, mesh=mesh)
    trajectories, starts = (_carried(reference.trajectory, part[:, 0], goal) for part in (result.trajectories, result.starts))
    return dataclasses.replace(result, trajectories=trajectories, starts=starts, confidence=confidence(residual(result, picked)))


@jax.jit
def _carried(demonstrated, picks, goal):
    return jax.vmap(lambda pick: carry_trajectory(demonstrated, pick, goal).wxyz_xyz)(picks)
