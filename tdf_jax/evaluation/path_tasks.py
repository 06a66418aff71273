"""Tasks of the benchmark: a trajectory demonstrated on one object, a target object, a goal, and the ground truth."""

import dataclasses
import zlib

import jax
import numpy as np
from jaxtyping import Float

from tdf_jax._internal import checks
from tdf_jax.evaluation.cases import QUERIES, QUERY_SIZE, SEED_SPACE, Case, place_demonstration
from tdf_jax.evaluation.metrics import expected_trajectory
from tdf_jax.geometry import se3
from tdf_jax.geometry.demonstration import Demonstration
from tdf_jax.geometry.paths import PATHS
from tdf_jax.geometry.query import box_query
from tdf_jax.geometry.trajectory import Trajectory

# Metres by which the goal is moved from the demonstration's last pose, which moves with the centroid. "opposite" is as
# far behind the pick as that pose lies ahead of it.
DISPLACEMENTS = {"none": 0.0, "10 cm": 0.1, "30 cm": 0.3, "opposite": None}
NUM_POSES = 7
MESHES = 24_000_000  # number of the first task on a real mesh
QUERY_STREAM = 0x9E57  # number that is folded into the key of query points


@dataclasses.dataclass(frozen=True)
class Task:
    """One trajectory to imitate.

    Attributes:
        index: number of the task among those of a seed.
        case: the two objects, with clouds and the semantic place.
        path: name of the demonstrated path, one of `tdf_jax.geometry.paths.PATHS`.
        displacement: name of the goal's displacement, one of `DISPLACEMENTS`.
        demonstration: the demonstration on the first object.
        goal: last pose of the new trajectory, T_world_query, `wxyz_xyz`.
        expected: the ground truth.
    """

    index: int
    case: Case
    path: str
    displacement: str
    demonstration: Demonstration
    goal: Float[np.ndarray, "7"]
    expected: Trajectory

    @property
    def identity(self) -> list:
        """Values that identify the task, as JSON has them."""
        truth = [*self.goal.tolist(), *np.asarray(self.expected.wxyz_xyz[0]).tolist()]
        return [self.index, self.case.instance, self.case.clouds, self.case.scale, self.path, *truth]


def make_task(case: Case, seed: int, index: int) -> Task:
    """Task `index` of a seed: tasks take all paths in turn, and each path takes all displacements in turn.

    The direction of a displacement is uniform, and the goal has the orientation of the demonstration's last pose.

    Args:
        case: the objects.
        seed: seed of the tasks.
        index: number of the task.

    Raises:
        InputError: the index is negative.
    """
    checks.count("make_task()", "index", index, least=0)
    path = list(PATHS)[index % len(PATHS)]
    displacement = list(DISPLACEMENTS)[index // len(PATHS) % len(DISPLACEMENTS)]
    key = jax.random.fold_in(jax.random.key(seed), QUERY_STREAM)
    demonstration = place_demonstration(case, path, NUM_POSES, box_query(key, QUERIES, QUERY_SIZE * case.scale))
    ends = np.asarray(demonstration.trajectory.wxyz_xyz)[[0, -1], 4:]
    way = np.random.default_rng([SEED_SPACE, seed, index, 3]).normal(size=3)
    length = DISPLACEMENTS[displacement]
    moved = 2 * (ends[0] - ends[1]) if length is None else length * case.scale * way / np.linalg.norm(way)
    goal = np.array(demonstration.trajectory.wxyz_xyz[-1])
    goal[4:] += case.points_b.mean(axis=0) - case.points_a.mean(axis=0) + moved
    expected = expected_trajectory(demonstration.trajectory, case.T_world_place_a, case.T_world_place_b, goal)
    return Task(index, case, path, displacement, demonstration, goal, expected)


def mesh_index(name: str, pose: int) -> int:
    """Index of the task on a real mesh in one of its poses.

    It differs from the indices of generated mugs, and does not depend on other meshes. Each mesh begins with another
    goal, so that few poses of each mesh still cover all goals.

    Args:
        name: name of the mesh.
        pose: number of the pose.
    """
    number, paths = zlib.crc32(name.encode()), len(PATHS)
    displacement = (number + pose + pose // paths) % len(DISPLACEMENTS)
    turn = paths * len(DISPLACEMENTS)
    return MESHES + turn * (1000 * (number % 1000) + pose // turn) + paths * displacement + pose % paths


def carried_by(task: Task, T_b_a: Float[np.ndarray, "... 4 4"]) -> Float[np.ndarray, "... 7"]:
    """The demonstrated pick, moved by motions of object a onto object b.

    Args:
        task: the task.
        T_b_a: the motions, (..., 4, 4), metres, world frame.

    Returns:
        Picks `wxyz_xyz`, (..., 7).
    """
    T = np.asarray(T_b_a, float) @ np.asarray(task.demonstration.trajectory.matrices[0], float)
    return np.asarray(se3.pose(T[..., :3, :3].astype(np.float32), T[..., :3, 3].astype(np.float32)))
