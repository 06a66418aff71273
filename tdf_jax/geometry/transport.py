"""A demonstrated path warped to new ends."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from tdf_jax._internal import checks
from tdf_jax.geometry import se3
from tdf_jax.geometry.trajectory import Trajectory


def carry_trajectory(demonstrated: Trajectory, pick: Float[Array, "7"], goal: Float[Array, "7"] | None) -> Trajectory:
    """Warp a demonstrated path to start at a pick and to end at a goal.

    Let A be the rigid transform of the first pose to the pick, and G that of the last pose to the goal. Waypoint i of n
    has s = i / (n - 1). Its rotation is multiplied by the rotation at s on the SO(3) geodesic from A's to G's. Its
    translation is the point at s on the line from its image under A to its image under G. The first pose becomes the
    pick and the last pose the goal.

    Args:
        demonstrated: demonstrated path, T_world_query, or in any other frame of the demonstration.
        pick: first pose of the new path, T_world_query, `wxyz_xyz`, (7,), metres.
        goal: last pose of the new path, as the pick; None transforms all poses rigidly by A.

    Returns:
        The warped path, T_world_query.

    Raises:
        InputError: the pick or the goal is not one finite pose.
    """
    pick = jnp.asarray(checks.pose("carry_trajectory()", "pick", pick))
    if goal is not None:
        goal = jnp.asarray(checks.pose("carry_trajectory()", "goal", goal))
    pick_motion = se3.compose(pick, se3.inverse(demonstrated.wxyz_xyz[0]))
    if goal is None:
        return demonstrated.transformed(pick_motion)
    goal_motion = se3.compose(goal, se3.inverse(demonstrated.wxyz_xyz[-1]))
    s = jnp.arange(demonstrated.num_poses) / max(1, demonstrated.num_poses - 1)
    R = se3.geodesic(se3.rotation(pick_motion), se3.rotation(goal_motion), s)
    t = demonstrated.translations
    translations = (1 - s)[:, None] * se3.transform(pick_motion, t) + s[:, None] * se3.transform(goal_motion, t)
    return Trajectory(se3.pose(se3.multiply(R, demonstrated.rotations), translations))


@jax.jit
def carry_to_picks(
    demonstrated: Trajectory, picks: Float[Array, "starts 7"], goal: Float[Array, "7"] | None
) -> Float[Array, "starts poses 7"]:
    """Warp a demonstrated path from each of several picks, as `carry_trajectory` does.

    Args:
        demonstrated: demonstrated path, T_world_query.
        picks: first poses of the new paths, T_world_query, `wxyz_xyz`, (starts, 7), metres.
        goal: last pose of all new paths, (7,); None transforms all poses rigidly.

    Returns:
        Poses of the warped paths, `wxyz_xyz`, (starts, poses, 7).
    """
    return jax.vmap(lambda pick: carry_trajectory(demonstrated, pick, goal).wxyz_xyz)(picks)
