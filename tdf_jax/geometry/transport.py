"""A demonstrated path warped to new ends."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from tdf_jax._internal import checks, devices
from tdf_jax._internal.boundary import public
from tdf_jax.geometry import se3
from tdf_jax.geometry.demonstration import Demonstration
from tdf_jax.geometry.trajectory import Trajectory, check_trajectory

# Metres of the path that repeat the demonstration after the pick and before the goal, where the object is close to what
# it stood on and to the target. The arrival is longer: an object has to move along a peg or into a container.
DEPARTURE, ARRIVAL = 0.05, 0.08
NEAR = 0.05  # metres from the target within which an object repeats its demonstrated arrival
BEYOND = 0.02  # metres that the arrival begins before it comes so near
ASIDE = 0.02  # metres beside an object within which its target stands in its way
SPARSE = 300  # points of the object's cloud by which its distance is measured
STILL = 1e-6  # metres; a shorter path does not move
MAX_ENDS = 0.8  # largest share of the path that both take: the rest blends the two, without a jump between poses


@public
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
    check_trajectory(demonstrated, "demonstrated")
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


def carry_to_target(
    demonstrated: Trajectory,
    pick: Float[Array, "7"],
    goal: Float[Array, "7"],
    target_motion: Float[Array, "7"],
    *,
    departure: float = DEPARTURE,
    arrival: float | Float[Array, ""] = ARRIVAL,
    deeper: float | Float[Array, ""] = 0.0,
    upright: bool = True,
    shares: Float[Array, " poses"] | None = None,
) -> Trajectory:
    """Warp a demonstrated path between a pick and a goal at a target, repeating the demonstrated motion at both ends.

    Near the pick, the gripper repeats its motion relative to the object: pose T_i becomes A T_i, where A takes the
    first pose to the pick; but what was lifted up is lifted up, however the object lies (`upright`). Near the goal,
    the object repeats its motion relative to the target: with the motion D_i = T_i inverse(T_0) of the object, D = D_n
    and the motion B of the target, pose i becomes B D_i inverse(D) inverse(B) times the goal. Between them the two are
    blended by the length of the path, with the SO(3) geodesic and a smooth step.

    Args:
        demonstrated: demonstrated path from the grasp to the release, T_world_query.
        pick: first pose of the new path, T_world_query, `wxyz_xyz`, (7,), metres.
        goal: last pose of the new path.
        target_motion: motion B of the target from the demonstration, `wxyz_xyz`, (7,): a point x of the demonstrated
            target is at B x on the new one. In the frame of `demonstrated`.
        departure: length of the path that repeats the demonstration after the pick, metres.
        arrival: length of the path that repeats the demonstration before the goal, metres. Together the two
            take at most 80 % of the path; otherwise both are shortened in proportion.
        deeper: how much farther than demonstrated the object arrives from, metres: the arrival is stretched along the
            line from its end to its begin, as into a container that is deeper than the demonstrated one.
        upright: turn the demonstrated displacement after the pick by A's rotation about the world's z axis only, so
            that an object that was lifted from its support is lifted from it; False to turn it by all of A's rotation,
            so that the object moves in the same direction of its own.
        shares: weight of the goal's side at every pose, from 0 at the pick to 1 at the goal, (poses,); by default by
            the length of the path, see above.

    Returns:
        The warped path, T_world_query, with as many poses.
    """
    poses = jnp.asarray(demonstrated.wxyz_xyz)
    pick = jnp.asarray(pick)
    pick_motion = se3.compose(pick, se3.inverse(poses[0]))
    leaving = se3.compose(pick_motion, poses)
    if upright:
        displacements = poses[:, 4:] - poses[0, 4:]
        leaving = leaving.at[:, 4:].set(pick[4:] + displacements @ _about_vertical(pick_motion).T)
    relative = se3.compose(poses, se3.inverse(poses[-1]))  # D_i inverse(D)
    at_target = se3.compose(se3.compose(jnp.asarray(target_motion), relative), se3.inverse(jnp.asarray(target_motion)))
    arriving = se3.compose(at_target, jnp.asarray(goal))
    steps = jnp.linalg.norm(jnp.diff(poses[:, 4:], axis=0), axis=1)
    # A path that does not move, such as a rotation in place, has its poses evenly apart.
    steps = jnp.where(jnp.sum(steps) > STILL, steps, (departure + arrival) / max(1, len(poses) - 1))
    length = jnp.concatenate([jnp.zeros(1, steps.dtype), jnp.cumsum(steps)])
    total = jnp.maximum(length[-1], 1e-9)
    share = jnp.minimum(1.0, MAX_ENDS * total / (departure + arrival))
    begin, end = share * departure, total - share * arrival
    left = jnp.clip((total - length) / (total - end), 0.0, 1.0)  # share of the arrival that is left
    outward = arriving[jnp.argmax(length >= end), 4:] - arriving[-1, 4:]
    outward = outward / jnp.maximum(jnp.linalg.norm(outward), 1e-9)
    arriving = arriving.at[:, 4:].add(deeper * left[:, None] * outward)
    s = jnp.clip((length - begin) / (end - begin), 0.0, 1.0)
    s = s * s * (3 - 2 * s) if shares is None else jnp.asarray(shares)
    R = se3.geodesic(se3.rotation(leaving), se3.rotation(arriving), s)
    t = (1 - s)[:, None] * leaving[:, 4:] + s[:, None] * arriving[:, 4:]
    return Trajectory(se3.pose(R, t))


def _about_vertical(motion) -> Array:
    """The part of a rotation that is about the z axis, (3, 3); none if the motion turns z upside down exactly."""
    w, z = motion[0], motion[3]
    size = jnp.hypot(w, z)
    w, z = jnp.where(size > 1e-6, w, 1.0), jnp.where(size > 1e-6, z, 0.0)
    twist = jnp.stack([w, jnp.zeros_like(w), jnp.zeros_like(w), z]) / jnp.hypot(w, z)
    return se3.rotation(jnp.concatenate([twist, jnp.zeros(3, twist.dtype)]))


@dataclasses.dataclass(frozen=True)
class Arrival:
    """How the object of a demonstration arrives at its target.

    Attributes:
        length: length of the path before the release on which the object is near its target, metres.
        outward: unit vector from the object's place at the release to where the arrival begins, world frame, (3,).
        depth: how far the released object has to go back along it until its target is behind it, metres.
    """

    length: float
    outward: Float[np.ndarray, "3"]
    depth: float


def arrival_of(demonstration: Demonstration) -> Arrival:
    """How the object of a demonstration arrives at its target.

    Args:
        demonstration: a demonstration with a target.

    Returns:
        The arrival. Its length is that of the last part of the path on which the clouds of the object and its target
            are at most `NEAR` apart, plus `BEYOND`; at least `ARRIVAL`. If an array is traced, the length is `ARRIVAL`
            and the depth is infinite, so that no target is deeper.
    """
    from scipy.spatial import KDTree

    target = demonstration.target
    path = demonstration.transfer.wxyz_xyz
    if target is None or checks.traced(demonstration.points, target.points, path):
        return Arrival(ARRIVAL, np.array([0.0, 0.0, 1.0]), np.inf)
    poses = jnp.asarray(path)
    cloud = jnp.asarray(demonstration.points)[:: -(-len(demonstration.points) // SPARSE)]
    carried = np.asarray(se3.transform(se3.compose(poses, se3.inverse(poses[0])), cloud), float)
    target_points = np.asarray(target.points, float)
    tree = KDTree(target_points)
    far = np.flatnonzero([tree.query(points)[0].min() > NEAR for points in carried])
    length = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(np.asarray(poses[:, 4:]), axis=0), axis=1))])
    arrival = max(ARRIVAL, float(length[-1] - length[far[-1] if len(far) else 0]) + BEYOND)
    begin = carried[np.argmax(length >= length[-1] - arrival)]
    outward = begin.mean(axis=0) - carried[-1].mean(axis=0)
    outward = outward / max(float(np.linalg.norm(outward)), 1e-9)
    return Arrival(arrival, outward, arrival_depth(carried[-1], target_points, outward))


def arrival_depth(
    points: Float[np.ndarray, "points 3"],
    target_points: Float[np.ndarray, "target_points 3"],
    outward: Float[np.ndarray, "3"],
) -> float:
    """How far a placed object has to go back along a direction until its target is behind it.

    Args:
        points: cloud of the object as it is placed, (points, 3), metres.
        target_points: cloud of the target, (target_points, 3), metres, same frame.
        outward: unit vector along which the object would go back, (3,).

    Returns:
        The distance, metres, at least 0. Points of the target that are more than `ASIDE` beside the object do not
            count.
    """
    if not outward.any():
        return 0.0
    across = np.linalg.svd(outward[None])[2][1:].T
    low, high = (points @ across).min(axis=0) - ASIDE, (points @ across).max(axis=0) + ASIDE
    beside = ((target_points @ across < low) | (target_points @ across > high)).any(axis=1)
    if beside.all():
        return 0.0
    return max(0.0, float((target_points[~beside] @ outward).max() - (points @ outward).min()))


@devices.quickly_compiled
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
