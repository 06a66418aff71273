"""What `tdf imitate` works on: a demonstration and a target, from the user's files or a pair of generated mugs."""

import dataclasses
from pathlib import Path

import numpy as np
from jaxtyping import Float, PRNGKeyArray

from tdf_jax.demonstration import Demonstration
from tdf_jax.evaluation.cases import Case, random_pose
from tdf_jax.pointcloud import load_points
from tdf_jax.query import box_query
from tdf_jax.trajectory import line, semicircle, wave

SHAPES = {"line": line, "semicircle": semicircle, "wave": wave}
QUERY_SIZE = 0.08  # metres, edge of the box of query points about the handle
PLACE = (0.0, 0.24, 0.18)  # metres from the pick: 0.30 m away, to the handle's side and up
LIFT = (0.0, 0.0, 1.0)  # a semicircle and a wave leave the straight line upwards first


@dataclasses.dataclass(frozen=True)
class Target:
    """The object to imitate on.

    Attributes:
        points: cloud, (points, 3), metres, world frame.
        T_world_object: how the generated mug's frame, or the file's, lies in the world, 4x4.
        T_world_handle: frame of the handle, 4x4, where it is known.
    """

    points: Float[np.ndarray, "points 3"]
    T_world_object: Float[np.ndarray, "4 4"]
    T_world_handle: Float[np.ndarray, "4 4"] | None


def generated_demonstration(case: Case, shape: str, poses: int, queries: int, key: PRNGKeyArray) -> Demonstration:
    """A trajectory from the handle of the pair's first mug to a place beside and above it.

    Args:
        case: the pair.
        shape: a name in `SHAPES`.
        poses: how many.
        queries: query points, in a box about the handle.
        key: of the query points.
    """
    pick = case.T_world_place_a
    start, bow = pick[:3, 3], {} if shape == "line" else {"bulge": LIFT}
    trajectory = SHAPES[shape](poses, start, start + np.array(PLACE), rotation=pick[:3, :3], **bow)
    return Demonstration(case.points_a, trajectory, box_query(key, queries, QUERY_SIZE))


def generated_target(case: Case, pose: str) -> Target:
    """The pair's second mug, in its random pose or, "given", with its own frame at the world's."""
    if pose == "random":
        return Target(case.points_b, case.T_world_b, case.T_world_place_b)
    T_object_world = np.linalg.inv(case.T_world_b)
    return Target(_moved(case.points_b, T_object_world), np.eye(4), T_object_world @ case.T_world_place_b)


def file_target(path: str | Path, scale: float, points: int, pose: str, seed: int) -> Target:
    """An object from a mesh or a cloud; no handle is known.

    Args:
        path: the file; see `load_points`.
        scale: metres per unit of the file.
        points: drawn from a mesh's surface, or from a larger cloud.
        pose: "given", as it lies in its file, or "random".
        seed: of the draw and the pose.
    """
    T_world_object = np.eye(4) if pose == "given" else random_pose(seed, 0)
    return Target(_moved(load_points(path, points, scale, seed), T_world_object), T_world_object, None)


def _moved(points, T):
    return (points @ T[:3, :3].T + T[:3, 3]).astype(np.float32)
