"""A demonstrated path warped to new ends."""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from tdf_jax._internal.errors import InputError
from tdf_jax.geometry import se3
from tdf_jax.geometry.trajectory import Trajectory


def carry_trajectory(demonstrated: Trajectory, pick: Float[Array, "7"], goal: Float[Array, "7"] | None) -> Trajectory:
    """A demonstration carried by the motions of both of its ends.

    With A the motion of the first pose to the pick and G that of the last pose to the goal, waypoint i of n is moved by
    B_i at s = i / (n - 1): its rotation is the geodesic from A's to G's at s, and the waypoint is carried to the point
    at s on the line between where A and where G would carry it. The first pose becomes the pick and the last the goal.

    Args:
        demonstrated: T_world_query, or in any other frame of the demonstration.
        pick: first pose of the new trajectory, T_world_query, `wxyz_xyz`.
        goal: its last pose; None carries all poses rigidly with the pick.

    Returns:
        The trajectory, T_world_query.

    Raises:
        InputError: the pick or the goal is not one pose.
    """
    for name, pose in (("pick", pick), ("goal", goal)):
        if pose is not None and np.shape(pose) != (7,):
            raise InputError(f"carry_trajectory(): {name} has shape {np.shape(pose)}; expected one pose wxyz_xyz, (7,)")
    pick, goal = jnp.asarray(pick), None if goal is None else jnp.asarray(goal)
    pick_motion = se3.compose(pick, se3.inverse(demonstrated.wxyz_xyz[0]))
    if goal is None:
        return demonstrated.transformed(pick_motion)
    goal_motion = se3.compose(goal, se3.inverse(demonstrated.wxyz_xyz[-1]))
    s = jnp.arange(demonstrated.num_poses) / max(1, demonstrated.num_poses - 1)
    turn = se3.geodesic(se3.rotation(pick_motion), se3.rotation(goal_motion), s)
    t = demonstrated.translations
    carried = (1 - s)[:, None] * se3.transform(pick_motion, t) + s[:, None] * se3.transform(goal_motion, t)
    return Trajectory(se3.pose(se3.multiply(turn, demonstrated.rotations), carried))


@jax.jit
def carry_to_picks(
    demonstrated: Trajectory, picks: Float[Array, "starts 7"], goal: Float[Array, "7"] | None
) -> Float[Array, "starts poses 7"]:
    """`carry_trajectory` from several picks."""
    return jax.vmap(lambda pick: carry_trajectory(demonstrated, pick, goal).wxyz_xyz)(picks)
