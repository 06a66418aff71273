"""What a path is like as a motion: how far from another, how smooth, how deep in an object."""

import numpy as np
from jaxtyping import Float

from tdf_jax.evaluation.annotated_meshes import AnnotatedMesh
from tdf_jax.shapes import Mug
from tdf_jax.geometry.trajectory import Trajectory


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
    trajectory: Trajectory, query: Float[np.ndarray, "queries 3"], target: Mug | AnnotatedMesh, T_world_target: Float[np.ndarray, "4 4"]
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
