"""What an imitation ought to be, where both objects carry semantic frames, and how far a pose is from it."""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from tdf_jax.evaluation.annotated_meshes import AnnotatedMesh
from tdf_jax.geometry import se3
from tdf_jax.geometry.symmetry import equivalent
from tdf_jax.geometry.trajectory import Trajectory
from tdf_jax.geometry.transport import carry_trajectory
from tdf_jax.shapes import Mug

REACH = 0.03  # metres from a place at which its equivalents are compared; half of a query box
FLIP_DEGREES = 170.0  # rotation errors above it are counted apart: the object was taken for its mirror image


def expected_trajectory(
    demonstrated: Trajectory,
    T_world_place_a: Float[np.ndarray, "4 4"],
    T_world_place_b: Float[np.ndarray, "4 4"],
    goal: Float[Array, "7"],
) -> Trajectory:
    """The demonstrated trajectory as it ought to be on another object.

    With A the motion of the semantic place (say, the handle) from object a to object b, the first pose becomes A T_0
    and the last the goal; between them the demonstration is carried as `carry_trajectory` says. It is a definition:
    where object and goal moved differently, no way between them is the only right one.

    Args:
        demonstrated: T_world_query on object a.
        T_world_place_a: frame of the place on object a.
        T_world_place_b: frame of the same place on object b.
        goal: last pose on object b, `wxyz_xyz`.

    Returns:
        T_world_query on object b.
    """
    pick_motion = jnp.asarray(T_world_place_b @ np.linalg.inv(T_world_place_a), demonstrated.wxyz_xyz.dtype)
    pick = se3.compose(se3.pose(pick_motion[:3, :3], pick_motion[:3, 3]), demonstrated.wxyz_xyz[0])
    return carry_trajectory(demonstrated, pick, goal)


def nearest_place(
    T_world_object: Float[np.ndarray, "4 4"],
    T_world_found: Float[np.ndarray, "4 4"],
    T_world_place: Float[np.ndarray, "4 4"],
    fold: int,
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
    distance = jnp.linalg.norm(se3.translation(found) - se3.translation(truth), axis=-1)
    return np.asarray(distance), np.asarray(se3.rotation_distance(se3.rotation(found), se3.rotation(truth)))


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


def frechet_distance(found: Float[np.ndarray, "poses 3"], truth: Float[np.ndarray, "others 3"]) -> float:
    """Discrete Frechet distance of two paths, metres: the longest leash two walkers need, who may wait but not turn back.

    Unlike the mean distance of waypoints of one number, it does not ask that they be spaced alike.

    Args:
        found, truth: places in their order, metres.

    Source:
        Eiter and Mannila, Computing discrete Frechet distance, 1994.
    """
    apart = np.linalg.norm(np.asarray(found, float)[:, None] - np.asarray(truth, float)[None], axis=-1)
    leash = np.full((len(apart) + 1, apart.shape[1] + 1), np.inf)
    leash[0, 0] = 0.0
    for i, row in enumerate(apart):
        for j, distance in enumerate(row):
            leash[i + 1, j + 1] = max(distance, min(leash[i, j], leash[i, j + 1], leash[i + 1, j]))
    return float(leash[-1, -1])


def jerk(path: Float[np.ndarray, "poses 3"]) -> float:
    """Root mean square of the third differences of places, metres; 0 of a path whose steps change evenly, and of one with fewer than four poses.

    Args:
        path: places at even times, metres.
    """
    third = np.diff(np.asarray(path, float), n=3, axis=0)
    return float(np.sqrt(np.mean(np.sum(third**2, axis=1)))) if len(third) else 0.0


def longest_step(path: Float[np.ndarray, "poses 3"]) -> float:
    """Largest distance of neighbouring places over their mean distance: 1 where they are evenly spaced.

    Args:
        path: places in their order, metres.
    """
    steps = np.linalg.norm(np.diff(np.asarray(path, float), axis=0), axis=1)
    return float(steps.max() / steps.mean()) if steps.any() else 1.0


def penetration(
    trajectory: Trajectory,
    query: Float[np.ndarray, "queries 3"],
    target: Mug | AnnotatedMesh,
    T_world_target: Float[np.ndarray, "4 4"],
) -> float | None:
    """Share of the query points, over all poses, that lie in the object's clay. A query about a handle has some there by right: compare with the truth's.

    Args:
        trajectory: T_world_query.
        query: points, metres, query frame.
        target: the object, in its canonical frame.
        T_world_target: how that frame lies in the world, 4x4.

    Returns:
        A number in [0, 1]; None where the object has no inside.
    """
    R, t = np.asarray(trajectory.rotations, float), np.asarray(trajectory.translations, float)
    world = np.einsum("nij,qj->nqi", R, np.asarray(query, float)) + t[:, None]
    inverse = np.linalg.inv(T_world_target)
    inside = target.contains(world.reshape(-1, 3) @ inverse[:3, :3].T + inverse[:3, 3])
    return None if inside is None else float(np.mean(inside))
