"""Tasks of the benchmark: a trajectory shown on one object, to be imitated on another, with a goal and the truth."""

import dataclasses
import zlib

import jax
import numpy as np
from jaxtyping import Float

from tdf_jax._internal.errors import InputError
from tdf_jax.evaluation.cases import SEED_SPACE, Case
from tdf_jax.evaluation.metrics import expected_trajectory
from tdf_jax.evaluation.pick_transfer import QUERIES, QUERY_SIZE
from tdf_jax.evaluation.scene import place_demonstration
from tdf_jax.geometry import se3
from tdf_jax.geometry.demonstration import Demonstration
from tdf_jax.geometry.paths import PATHS
from tdf_jax.geometry.query import box_query
from tdf_jax.geometry.trajectory import Trajectory

# How far the goal is moved from the demonstration's last pose carried by the centroids; "opposite" is as far behind the
# carried pick as that lies ahead of it.
DISPLACEMENTS = {"none": 0.0, "10 cm": 0.1, "30 cm": 0.3, "opposite": None}
POSES = 7
MESHES = 24_000_000  # tasks on real meshes are numbered from here
QUERY_STREAM = 0x9E57  # folded into the key of query points


@dataclasses.dataclass(frozen=True)
class Task:
    """One trajectory to imitate.

    Attributes:
        index: of the task among those of a seed.
        case: the two objects, with clouds and the semantic place.
        path: the demonstration's, one of `tdf_jax.geometry.paths.PATHS`.
        displacement: the goal's, one of `DISPLACEMENTS`.
        demonstration: on the case's first object.
        goal: last pose of the new trajectory, T_world_query, `wxyz_xyz`.
        expected: the true trajectory.
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
        """What sets it apart from all other tasks, as JSON has it."""
        truth = [*self.goal.tolist(), *np.asarray(self.expected.wxyz_xyz[0]).tolist()]
        return [self.index, self.case.instance, self.case.clouds, self.case.scale, self.path, *truth]


def make_task(case: Case, seed: int, index: int) -> Task:
    """Task `index` of a seed: paths take turns, and for each the displacements.

    A displacement's direction is uniform, and the goal keeps the demonstration's orientation in the world.

    Args:
        case: the objects.
        seed, index: which task.

    Raises:
        InputError: the index is negative.
    """
    if index < 0:
        raise InputError(f"make_task(): index is {index}; expected 0 or more")
    path = list(PATHS)[index % len(PATHS)]
    displacement = list(DISPLACEMENTS)[index // len(PATHS) % len(DISPLACEMENTS)]
    key = jax.random.fold_in(jax.random.key(seed), QUERY_STREAM)
    shown = place_demonstration(case, path, POSES, box_query(key, QUERIES, QUERY_SIZE * case.scale))
    ends = np.asarray(shown.trajectory.wxyz_xyz)[[0, -1], 4:]
    way = np.random.default_rng([SEED_SPACE, seed, index, 3]).normal(size=3)
    length = DISPLACEMENTS[displacement]
    moved = 2 * (ends[0] - ends[1]) if length is None else length * case.scale * way / np.linalg.norm(way)
    goal = np.array(shown.trajectory.wxyz_xyz[-1])
    goal[4:] += case.points_b.mean(axis=0) - case.points_a.mean(axis=0) + moved
    expected = expected_trajectory(shown.trajectory, case.T_world_place_a, case.T_world_place_b, goal)
    return Task(index, case, path, displacement, shown, goal, expected)


def mesh_index(name: str, pose: int) -> int:
    """Index of the task on a real mesh in one of its poses: apart from those of generated mugs, and the same whatever other meshes there are.

    Meshes begin the turns of goals at different places, so that few poses of each still are of all goals.
    """
    number, paths = zlib.crc32(name.encode()), len(PATHS)
    displacement = (number + pose + pose // paths) % len(DISPLACEMENTS)
    turn = paths * len(DISPLACEMENTS)
    return MESHES + turn * (1000 * (number % 1000) + pose // turn) + paths * displacement + pose % paths


def carried_by(task: Task, T_b_a: Float[np.ndarray, "... 4 4"]) -> Float[np.ndarray, "... 7"]:
    """The demonstrated pick as motions of object a onto object b carry it, `wxyz_xyz`."""
    T = np.asarray(T_b_a, float) @ np.asarray(task.demonstration.trajectory.matrices[0], float)
    return np.asarray(se3.pose(T[..., :3, :3].astype(np.float32), T[..., :3, 3].astype(np.float32)))
