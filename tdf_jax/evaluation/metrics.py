"""What an imitation ought to be, where both objects carry semantic frames, and how far a pose is from it."""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from tdf_jax.geometry import se3 as poses
from tdf_jax.solvers.pick import carry_trajectory
from tdf_jax.geometry.symmetry import equivalent
from tdf_jax.geometry.trajectory import Trajectory

REACH = 0.03  # metres from a place at which its equivalents are compared; half of a query box
FLIP_DEGREES = 170.0  # rotation errors above it are counted apart: the object was taken for its mirror image


def expected_trajectory(
    demonstrated: Trajectory,
    T_world_place_a: Float[np.ndarray, "4 4"],
    T_world_place_b: Float[np.ndarray, "4 4"],
    goal: Float[Array, "7"],
) -> Trajectory:
    """The demonstrated trajectory as it ought to be on another object.

    With A the motion of the semantic place (say, the handle) from object a to object b, the first pose becomes A T_0 and the last the goal; between them
    the demonstration is carried as `carry_trajectory` says. It is a definition: where object and goal moved differently, no way between them is the only right one.

    Args:
        demonstrated: T_world_query on object a.
        T_world_place_a: frame of the place on object a.
        T_world_place_b: frame of the same place on object b.
        goal: last pose on object b, `wxyz_xyz`.

    Returns:
        T_world_query on object b.
    """
    pick_motion = jnp.asarray(T_world_place_b @ np.linalg.inv(T_world_place_a), demonstrated.wxyz_xyz.dtype)
    pick = poses.compose(poses.pose(pick_motion[:3, :3], pick_motion[:3, 3]), demonstrated.wxyz_xyz[0])
    return carry_trajectory(demonstrated, pick, goal)


def nearest_place(
    T_world_object: Float[np.ndarray, "4 4"], T_world_found: Float[np.ndarray, "4 4"], T_world_place: Float[np.ndarray, "4 4"], fold: int
) -> Float[np.ndarray, "4 4"]:
    """Of the places that an object's symmetry makes equal, the one nearest to where one was found.

    Args:
        T_world_object: pose of the object's canonical frame.
        T_world_found: of the place, as found.
        T_world_place: of one true place.
        fold: the object's symmetry, see `tdf_jax.symmetry`.

    Returns:
        T_world_place, 4x4.
    """
    if fold == 1:
        return T_world_place
    to_object = np.linalg.inv(T_world_object)
    found = to_object @ np.asarray(T_world_found, float)
    return T_world_object @ equivalent(found, to_object @ T_world_place, fold, REACH)


def pose_error(found: Float[Array, "... 7"], truth: Float[Array, "... 7"]) -> tuple[np.ndarray, np.ndarray]:
    """Distance of translations, metres, and of rotations, radians.

    Args:
        found, truth: poses `wxyz_xyz`; batch axes broadcast.
    """
    found, truth = jnp.asarray(found), jnp.asarray(truth)
    distance = jnp.linalg.norm(poses.translation(found) - poses.translation(truth), axis=-1)
    return np.asarray(distance), np.asarray(poses.rotation_distance(poses.rotation(found), poses.rotation(truth)))


def path_error(found: Trajectory, truth: Trajectory) -> float:
    """Mean distance of waypoints, metres."""
    return float(np.mean(pose_error(found.wxyz_xyz, truth.wxyz_xyz)[0]))


def shape_error(found: Float[np.ndarray, "poses 3"], truth: Float[np.ndarray, "poses 3"]) -> float:
    """How far a path has another shape: root mean square distance of waypoints after the best rigid motion onto the truth, metres.

    Args:
        found, truth: translations of the waypoints, metres.
    """
    found, truth = (np.asarray(path, float) - np.mean(path, axis=0, dtype=float) for path in (found, truth))
    left, values, right = np.linalg.svd(found.T @ truth)
    # Proper rotations only: a wave is not its mirror image.
    values[-1] *= np.sign(np.linalg.det(left @ right))
    squared = np.sum(found**2) + np.sum(truth**2) - 2 * np.sum(values)
    return float(np.sqrt(max(squared, 0.0) / len(found)))
