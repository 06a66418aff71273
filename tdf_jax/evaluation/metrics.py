"""The expected imitation where both objects have semantic frames, and errors of poses and paths."""

from collections.abc import Sequence

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from tdf_jax._internal.devices import quickly_compiled
from tdf_jax.evaluation.annotated_meshes import AnnotatedMesh
from tdf_jax.geometry import se3
from tdf_jax.geometry.symmetry import equivalent
from tdf_jax.geometry.trajectory import Trajectory
from tdf_jax.geometry.transport import carry_trajectory
from tdf_jax.shapes import Shape

REACH = 0.03  # metres from a place at which equivalent places are compared; half the edge of a query box
FLIP_DEGREES = 170.0  # a larger rotation error is a flip: the method mistook the object for its mirror image


def expected_trajectory(
    demonstrated: Trajectory,
    T_world_place_a: Float[np.ndarray, "4 4"],
    T_world_place_b: Float[np.ndarray, "4 4"],
    goal: Float[Array | np.ndarray, "7"],
) -> Trajectory:
    """The ground truth of an imitation on another object.

    The motion A of the semantic place (such as the handle) from object a to object b moves the first pose T_0 to A T_0.
    The last pose is the goal. Between them, the demonstration is warped as `carry_trajectory` says. This is a
    definition: if object and goal move differently, several paths between them are equally right.

    Args:
        demonstrated: T_world_query on object a.
        T_world_place_a: frame of the place on object a, 4x4.
        T_world_place_b: frame of the same place on object b, 4x4.
        goal: last pose on object b, `wxyz_xyz`.

    Returns:
        T_world_query on object b.
    """
    pick_motion = (T_world_place_b @ np.linalg.inv(T_world_place_a)).astype(demonstrated.wxyz_xyz.dtype)
    return _expected(demonstrated, pick_motion, goal)


@quickly_compiled
def _expected(demonstrated, pick_motion, goal):
    # In one program: operation by operation, the first call of a process would compile thirty.
    pick = se3.compose(se3.pose(pick_motion[:3, :3], pick_motion[:3, 3]), demonstrated.wxyz_xyz[0])
    return carry_trajectory(demonstrated, pick, goal)


def nearest_place(
    T_world_object: Float[np.ndarray, "4 4"],
    T_world_estimate: Float[np.ndarray, "4 4"],
    T_world_place: Float[np.ndarray, "4 4"],
    fold: int,
    others: Sequence[Float[np.ndarray, "4 4"]] = (),
) -> Float[np.ndarray, "4 4"]:
    """Of the places that the symmetry of an object makes equal, and others as right, the one nearest to an estimate.

    Args:
        T_world_object: pose of the object's canonical frame, 4x4.
        T_world_estimate: estimated pose of the place, 4x4.
        T_world_place: one true pose of the place, 4x4.
        fold: symmetry of the object, see `tdf_jax.geometry.symmetry`.
        others: true poses of other places that are as right, such as the second of two unlike pegs, 4x4.

    Returns:
        T_world_place, 4x4.
    """
    if fold == 1 and not others:
        return T_world_place
    to_object = np.linalg.inv(T_world_object)
    estimate = to_object @ np.asarray(T_world_estimate, float)
    nearest = [equivalent(estimate, to_object @ place, fold, REACH) for place in (T_world_place, *others)]
    return T_world_object @ min(nearest, key=lambda place: _gap(estimate, place))


def _gap(T, other) -> float:
    """Root mean square distance of six points on the axes of two frames, `REACH` from the origins, metres."""
    moved, rotated = (np.sum((T - other)[:3, columns] ** 2) for columns in (3, slice(3)))
    return float(np.sqrt(moved + REACH**2 * rotated / 3))


def pose_error(
    estimate: Float[Array | np.ndarray, "... 7"], truth: Float[Array | np.ndarray, "... 7"]
) -> tuple[np.ndarray, np.ndarray]:
    """Position errors, metres, and rotation errors, radians.

    Args:
        estimate: estimated poses `wxyz_xyz`, (..., 7).
        truth: true poses `wxyz_xyz`, (..., 7); batch axes broadcast.
    """
    distance, angle = _distances(estimate, truth)
    return np.asarray(distance), np.asarray(angle)


@quickly_compiled
def _distances(a, b):
    distance = jnp.linalg.norm(se3.translation(a) - se3.translation(b), axis=-1)
    return distance, se3.rotation_distance(se3.rotation(a), se3.rotation(b))


def path_error(estimate: Trajectory, truth: Trajectory) -> float:
    """Mean distance of waypoints, metres."""
    return float(np.mean(pose_error(estimate.wxyz_xyz, truth.wxyz_xyz)[0]))


def shape_error(estimate: Float[np.ndarray, "poses 3"], truth: Float[np.ndarray, "poses 3"]) -> float:
    """Root mean square distance of the waypoints of two paths after the best rigid motion, metres.

    Args:
        estimate: translations of the estimated waypoints, (poses, 3), metres.
        truth: translations of the true waypoints, (poses, 3), metres.
    """
    estimate, truth = (np.asarray(path, float) - np.mean(path, axis=0, dtype=float) for path in (estimate, truth))
    left, values, right = np.linalg.svd(estimate.T @ truth)
    # Reflections are excluded, because a wave is not its mirror image.
    values[-1] *= np.sign(np.linalg.det(left @ right))
    squared = np.sum(estimate**2) + np.sum(truth**2) - 2 * np.sum(values)
    return float(np.sqrt(max(squared, 0.0) / len(estimate)))


def frechet_distance(estimate: Float[np.ndarray, "poses 3"], truth: Float[np.ndarray, "others 3"]) -> float:
    """Discrete Frechet distance of two paths, metres.

    Unlike the mean distance of waypoints, it does not depend on how the waypoints are spaced.

    Args:
        estimate: translations in their order, (poses, 3), metres.
        truth: translations in their order, (others, 3), metres.

    Source:
        Eiter and Mannila, Computing discrete Frechet distance, 1994.
    """
    apart = np.linalg.norm(np.asarray(estimate, float)[:, None] - np.asarray(truth, float)[None], axis=-1)
    leash = np.full((len(apart) + 1, apart.shape[1] + 1), np.inf)
    leash[0, 0] = 0.0
    for i, row in enumerate(apart):
        for j, distance in enumerate(row):
            leash[i + 1, j + 1] = max(distance, min(leash[i, j], leash[i, j + 1], leash[i + 1, j]))
    return float(leash[-1, -1])


def jerk(path: Float[np.ndarray, "poses 3"]) -> float:
    """Root mean square of the third differences of a path, metres; 0 for a path of fewer than four poses.

    Args:
        path: translations at even times, (poses, 3), metres.
    """
    third = np.diff(np.asarray(path, float), n=3, axis=0)
    return float(np.sqrt(np.mean(np.sum(third**2, axis=1)))) if len(third) else 0.0


def longest_step(path: Float[np.ndarray, "poses 3"]) -> float:
    """Largest distance of neighbouring waypoints over their mean distance; 1 for an evenly spaced path.

    Args:
        path: translations in their order, (poses, 3), metres.
    """
    steps = np.linalg.norm(np.diff(np.asarray(path, float), axis=0), axis=1)
    return float(steps.max() / steps.mean()) if steps.any() else 1.0


def penetration(
    trajectory: Trajectory,
    query: Float[np.ndarray, "queries 3"],
    target: Shape | AnnotatedMesh,
    T_world_target: Float[np.ndarray, "4 4"],
) -> float | None:
    """Share of the query points, over all poses, that lie inside the solid of an object.

    Query points about a handle are partly inside it even on the true path, so compare with the share of that path.

    Args:
        trajectory: T_world_query.
        query: query points, (queries, 3), metres, query frame.
        target: the object, in its canonical frame.
        T_world_target: pose of that frame, 4x4.

    Returns:
        A number in [0, 1]; None where the object has no inside.
    """
    R, t = np.asarray(trajectory.rotations, float), np.asarray(trajectory.translations, float)
    world = np.einsum("nij,qj->nqi", R, np.asarray(query, float)) + t[:, None]
    inverse = np.linalg.inv(T_world_target)
    inside = target.contains(world.reshape(-1, 3) @ inverse[:3, :3].T + inverse[:3, 3])
    return None if inside is None else float(np.mean(inside))
