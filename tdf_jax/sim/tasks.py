"""Tasks of simulated episodes: what is picked, where it goes, and where objects start, drawn before any method runs."""

import dataclasses
import functools
from collections.abc import Callable
from typing import NamedTuple, cast

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from tdf_jax._internal import checks
from tdf_jax._internal.errors import InputError
from tdf_jax.evaluation.cases import SEED_SPACE
from tdf_jax.evaluation.relation_tasks import CONTACT_QUERIES, CONTACT_SIZE, RELATIONS, TILT, draw_pair
from tdf_jax.evaluation.tabletop import moved
from tdf_jax.geometry import se3
from tdf_jax.geometry.demonstration import Demonstration
from tdf_jax.geometry.paths import hang_on_rack, lift_over
from tdf_jax.geometry.query import box_query, gripper_query
from tdf_jax.geometry.sampling import sample_surface
from tdf_jax.geometry.symmetry import ROUND
from tdf_jax.geometry.target import Target
from tdf_jax.geometry.trajectory import Trajectory
from tdf_jax.shapes import FAMILIES, Mug, Rack, Shape
from tdf_jax.sim.board import Board
from tdf_jax.sim.bodies import Body, body_of
from tdf_jax.sim.collision import Collisions
from tdf_jax.sim.configurations import HALF_TURN
from tdf_jax.sim.grasps import Grip, grip_of
from tdf_jax.sim.kinematics import kinematics_of
from tdf_jax.sim.robot import Robot
from tdf_jax.sim.scans import Scan
from tdf_jax.sim.swing import level_rotations
from tdf_jax.sim.workcell import build_workcell

POSES = ("upright", "tilt60", "uniform")
OBJECTS = ((0.38, 0.56), (0.10, 0.32))  # metres, x and y on the table where objects start
TARGETS = ((0.54, 0.70), (-0.32, -0.10))  # and targets
ABOVE = 0.12  # metres above the table of the lowest point of an object that a fixture holds
NUM_POSES = 24
APPROACH = 0.10  # metres along a peg, or down, at the end of a demonstrated path
RAISED = 0.008  # metres above the peg of that motion, at most half of what the finger hole leaves
CLEARANCE = 0.06  # metres, height of a lift over the target's top
GRIPPER_POINTS = 256
STARTS, MOST_PAIRS = 25, 20  # starts that are drawn of a pair, and pairs that are drawn of an episode
OTHER_PAIRS = 10_000_000  # between the numbers of the pairs of an episode
BEHIND = 0.10  # metres behind the pick and the release, along the approach, which must be within reach too
SAME_CONFIGURATION = 1.5  # radians, largest movement of a joint on the way there
# Sine of the tilt from which a held object swings, and angles, radians, between the closing direction and the plane in
# which it would not swing that are tried.
UPRIGHT, OFF_PLANE = 0.02, tuple(np.radians([0.0, 5.0, -5.0]))
SEARCHES = 12  # starts of the search for a configuration of the arm at the true pick and at the true release


class Task(NamedTuple):
    """A task.

    Attributes:
        object: category of the object.
        target: category of the target; "board" for a board, which is always known.
        fixed: whether the target is fixed to the world; otherwise it stands by its weight.
    """

    object: str
    target: str
    fixed: bool


TASKS = {
    "mug_on_rack": Task("mug", "rack", True),
    "bowl_on_shelf": Task("bowl", "board", True),
    "bottle_on_shelf": Task("bottle", "board", True),
    "bowl_on_mug": Task("bowl", "mug", False),
    "bottle_in_container": Task("bottle", "container", False),
}


class NotDrawn(InputError):
    """Raised if an episode cannot be drawn.

    Attributes:
        rejected, redrawn: numbers of starts and pairs that were drawn; see `Episode`.
    """

    def __init__(self, message: str, rejected: int = 0, redrawn: int = 0):
        super().__init__(message)
        self.rejected, self.redrawn = rejected, redrawn

    def __reduce__(self):
        return NotDrawn, (str(self), self.rejected, self.redrawn)


@dataclasses.dataclass(frozen=True, eq=False)
class Episode:
    """What is drawn of an episode.

    Attributes:
        task: name in `TASKS`.
        number: number of the episode.
        poses: how the object starts, one of `POSES`.
        object: the object, in its canonical frame: generated, or of a user's mesh.
        target: the target, in its canonical frame; it stands upright.
        T_world_object: pose of the object at the start, 4x4, metres, world frame.
        T_world_target: pose of the target, 4x4.
        T_target_object: a true seated pose of the object on the target, 4x4.
        T_target_contact: frame of the region where the two meet, 4x4.
        grip: the demonstrated grasp of this object.
        rejected: number of starts drawn before that the robot cannot reach.
        redrawn: number of pairs drawn before that cannot fit, or of which no start is within reach.
    """

    task: str
    number: int
    poses: str
    object: Shape | Scan
    target: Shape | Board
    T_world_object: Float[np.ndarray, "4 4"]
    T_world_target: Float[np.ndarray, "4 4"]
    T_target_object: Float[np.ndarray, "4 4"]
    T_target_contact: Float[np.ndarray, "4 4"]
    grip: Grip
    rejected: int
    redrawn: int

    @functools.cached_property
    def object_body(self) -> Body:
        """The object's body for the physics."""
        return _body(self.object)

    @functools.cached_property
    def target_body(self) -> Body:
        """The target's body."""
        return body_of(self.target)

    @property
    def fixture(self) -> bool:
        """Whether a fixture holds the object until the fingers have closed: it does not stand by itself."""
        return self.poses != "upright"

    @property
    def pick(self) -> Float[np.ndarray, "4 4"]:
        """The true pick: pose of the gripper's frame, 4x4, world frame."""
        return self.T_world_object @ self.grip.T_object_grip

    @property
    def release(self) -> Float[np.ndarray, "4 4"]:
        """The true release: pose of the gripper's frame, 4x4, world frame."""
        return self.T_world_target @ self.T_target_object @ self.grip.T_object_grip


def draw_episode(
    task: str,
    robot: Robot,
    seed: int,
    number: int,
    poses: str = "upright",
    known: Episode | None = None,
    scan: Scan | None = None,
    reachable: Callable[[Episode, Robot, Collisions], bool] | None = None,
) -> Episode:
    """Draw an episode: the pair, and a start from which the true pick and the true release are within reach.

    Args:
        task: one of `TASKS`.
        robot: the robot.
        seed: seed of the episodes.
        number: number of the episode.
        poses: "upright" on the table with any yaw; "tilt60" with roll and pitch within 60 degrees too, or "uniform",
            both held by a fixture above the table.
        known: the demonstrated episode, if its target is to stand where it stood; otherwise another target is drawn.
        scan: the object, of the task's category, if it is not to be generated.
        reachable: what says of an episode, the robot and the collisions of a cell with its bodies, the target free,
            whether both are within reach; `within_reach` by default.

    Raises:
        NotDrawn: nothing within reach is drawn, or the object of `scan` fits neither the fingers nor a target.
        InputError: there is no such task or poses.
    """
    checks.choice("draw_episode()", "task", task, TASKS)
    checks.choice("draw_episode()", "poses", poses, POSES)
    rejected = redrawn = 0
    unfit_for = None  # why the last pair did not fit the fingers or the target, if none was looked at for reach
    what = task if scan is None else f"{task} with {scan.name}"
    for other in range(MOST_PAIRS):
        try:
            drawn = _pair(task, seed, number + other * OTHER_PAIRS, None if known is None else known.target, scan)
            if drawn is None:
                redrawn += 1
                if scan is not None:  # neither the object nor the target changes
                    raise InputError("the known target does not fit the object")
                continue
            one, target, T_target_object, T_target_contact, unfit = drawn
            redrawn += unfit
            grip = grip_of(cast(Shape, one), robot.fingers)
        except InputError as error:  # nothing of it fits between the fingers, or no target fits it
            if scan is not None:
                raise NotDrawn(
                    f"draw_episode(): there is no {what} (episode {number}, seed {seed}): {error}; expected an object "
                    "that fits the gripper and the target",
                    rejected,
                    redrawn,
                ) from None
            redrawn, unfit_for = redrawn + 1, str(error)
            continue
        rng = np.random.default_rng([SEED_SPACE, seed, number + other * OTHER_PAIRS, 7])
        bodies = {"object_body": _body(one), "target_body": body_of(target)}
        # One cell, in which the bodies are moved from start to start.
        cell = build_workcell(robot, bodies["object_body"], None, bodies["target_body"], None, fixed_target=False)
        collisions = Collisions(cell)
        for _ in range(STARTS):
            made = Episode(
                task=task,
                number=number,
                poses=poses,
                object=one,
                target=target,
                T_world_object=_start(one, poses, rng),
                T_world_target=_standing(target.mesh, TARGETS, rng) if known is None else known.T_world_target,
                T_target_object=T_target_object,
                T_target_contact=T_target_contact,
                grip=grip,
                rejected=rejected,
                redrawn=redrawn,
            )
            for turned in _turned(grip, made.T_world_object):
                tried = dataclasses.replace(made, grip=turned)
                tried.__dict__.update(bodies)
                if (reachable or within_reach)(tried, robot, collisions):
                    return tried
            rejected += 1
        redrawn += 1
    if not rejected and unfit_for:
        raise NotDrawn(
            f"draw_episode(): no {what} of episode {number} (seed {seed}) fits {robot.name} in {MOST_PAIRS} pairs: "
            f"{unfit_for}; expected a gripper that spans the object",
            rejected,
            redrawn,
        )
    raise NotDrawn(
        f"draw_episode(): no {what} of episode {number} (seed {seed}) is within reach of {robot.name} in {MOST_PAIRS} "
        f"pairs of {STARTS} starts each; expected a robot that reaches the table",
        rejected,
        redrawn,
    )


def _body(one: Shape | Scan) -> Body:
    return one.body if isinstance(one, Scan) else body_of(one)


def within_reach(episode: Episode, robot: Robot, collisions: Collisions) -> bool:
    """Whether the arm has free configurations at the true pick and the true release, and behind them.

    Args:
        episode: the episode.
        robot: the robot.
        collisions: of a cell with the episode's bodies, the target free.
    """
    kinematics, rng = kinematics_of(robot), np.random.default_rng(0)
    behind = np.eye(4)
    behind[2, 3] = -BEHIND
    placed = episode.T_world_target @ episode.T_target_object

    def free(joints, T_object, meet) -> bool:
        depths = collisions.depths(joints, episode.grip.opening, T_object, episode.T_world_target)
        return all(set(pair) in (meet, {"target", "table"}, {"hand"}) for pair in depths)

    for T, T_object, meet in (
        (episode.pick, episode.T_world_object, {"object", "table"}),
        (episode.release, placed, {"object", "target"}),
    ):
        starts = [robot.home] + [robot.home + rng.uniform(-2.5, 2.5, robot.num_joints) for _ in range(SEARCHES)]
        for start, pose in ((start, pose) for start in starts for pose in (T, T @ HALF_TURN)):
            joints = kinematics.solve(pose, np.clip(start, robot.lower, robot.upper))
            if joints is None or not free(joints, T_object, meet):
                continue
            away = kinematics.solve(pose @ behind, joints)
            if away is not None and np.abs(away - joints).max() < SAME_CONFIGURATION and free(away, T_object, meet):
                break
        else:
            return False
    return True


def true_path(episode: Episode) -> Trajectory:
    """Poses of the gripper's frame from the true pick to the true release, as a demonstration shows them.

    Args:
        episode: the episode.
    """
    pick, release = episode.pick, episode.release
    ends = {"rotation": pick[:3, :3], "end_rotation": release[:3, :3]}
    if episode.task == "mug_on_rack":
        T_world_contact = episode.T_world_target @ episode.T_target_contact
        # Along the peg a little above it, then down onto it: an arm is a millimetre or two too low with a mug in hand.
        mug, rack = cast(Mug, episode.object), cast(Rack, episode.target)
        hole, peg = mug.finger_hole, rack.parameters.peg_thickness
        free = float(np.ptp(hole[:, 0])) - mug.parameters.handle_thickness - peg
        raised = release[:3, 3] + min(RAISED, 0.5 * max(free, 0.0)) * T_world_contact[:3, 2]
        along = -APPROACH * T_world_contact[:3, 0]
        onto = np.asarray(hang_on_rack(NUM_POSES - 2, pick[:3, 3], raised, approach=along, **ends).wxyz_xyz)
        down = onto[-1:].repeat(2, axis=0)
        down[:, 4:] = np.stack([(raised + release[:3, 3]) / 2, release[:3, 3]])
        return Trajectory(jnp.asarray(np.concatenate([onto, down])))
    height = float(episode.target.mesh.extents[2]) + CLEARANCE
    return _level(lift_over(NUM_POSES, pick[:3, 3], release[:3, 3], height=height, **ends))


def demonstrate_episode(episode: Episode, seed: int, points: int = 1500) -> Demonstration:
    """The demonstration that an episode's true pick and release are.

    Args:
        episode: an episode whose object stands upright.
        seed: seed of the clouds. Query points are the same for all, so that demonstrations combine.
        points: number of points of each cloud.
    """
    rng = np.random.default_rng([SEED_SPACE, seed, episode.number, 8])
    T_world_contact = episode.T_world_target @ episode.T_target_contact
    key = jax.random.key(0)
    return Demonstration(
        points=moved(sample_surface(episode.object.mesh, points, rng), episode.T_world_object).astype(np.float32),
        trajectory=true_path(episode),
        query=gripper_query(key, GRIPPER_POINTS, opening=episode.grip.opening),
        target=Target(
            points=moved(sample_surface(episode.target.mesh, points, rng), episode.T_world_target).astype(np.float32),
            query=box_query(jax.random.fold_in(key, 1), CONTACT_QUERIES, CONTACT_SIZE),
            T_world_contact=np.asarray(se3.pose(T_world_contact[:3, :3], T_world_contact[:3, 3])),
        ),
    )


def _level(path: Trajectory) -> Trajectory:
    """The same path with orientations between which what is held does not swing; see `level_rotations`."""
    poses = np.asarray(path.matrices, float)
    angles = Rotation.from_matrix(poses[0, :3, :3].T @ poses[:, :3, :3]).magnitude()
    if angles[-1] < 1e-6:
        return path
    poses[:, :3, :3] = level_rotations(poses[0, :3, :3], poses[-1, :3, :3], angles / angles[-1])
    return Trajectory.from_matrices(jnp.asarray(poses))


def _pair(task: str, seed: int, number: int, target: Shape | Board | None, scan: Scan | None):
    """An object, a target, the seated pose, the contact frame, and how many pairs did not fit; None if these do not."""
    given = cast(Shape | None, scan)  # it has what is asked of a shape here
    if task in RELATIONS and target is None:
        pair = draw_pair(task, seed, number, given)
        return pair.object, pair.target, pair.T_target_object, pair.T_target_contact, pair.redrawn
    if given is None:
        family = FAMILIES[TASKS[task].object]
        given = cast(Shape, family.build(family.sample(np.random.default_rng([SEED_SPACE, seed, number, 3]))))
    if task in RELATIONS:
        assert isinstance(target, Shape)
        seated = RELATIONS[task].seat(given, target)
        return None if seated is None else (given, target, *seated, 0)
    board = Board()
    top = np.eye(4)
    top[2, 3] = board.mesh.bounds[1, 2]
    standing = top.copy()
    standing[2, 3] -= given.mesh.bounds[0, 2]
    return given, board, standing, top, 0


def _start(one: Shape | Scan, poses: str, rng) -> np.ndarray:
    if poses == "upright":
        return _standing(one.mesh, OBJECTS, rng)
    T = np.eye(4)
    yaw, roll, pitch = rng.uniform(-np.pi, np.pi), rng.uniform(-TILT, TILT), rng.uniform(-TILT, TILT)
    anywhere = Rotation.random(rng=rng)
    T[:3, :3] = (Rotation.from_euler("ZYX", (yaw, pitch, roll)) if poses == "tilt60" else anywhere).as_matrix()
    T[:2, 3] = [rng.uniform(*side) for side in OBJECTS]
    T[2, 3] = ABOVE - (one.mesh.vertices @ T[:3, :3].T)[:, 2].min()
    return T


def _turned(grip: Grip, T_world_object) -> list[Grip]:
    """A grasp, turned about the axis of a round object to where the object swings least in the hand, the best first.

    That is where the closing direction is in the vertical plane of a tilted object's axis.
    """
    up = T_world_object[2, :3]
    if grip.fold != ROUND or np.hypot(up[0], up[1]) < UPRIGHT:
        return [grip]
    closing = grip.T_object_grip[:2, 1]
    plane = np.arctan2(up[1], up[0]) - np.arctan2(closing[1], closing[0])
    turned = []
    for turn in plane + np.array(OFF_PLANE):
        T = np.eye(4)
        T[:3, :3] = Rotation.from_euler("z", turn).as_matrix()
        turned.append(grip._replace(T_object_grip=T @ grip.T_object_grip))
    return turned


def _standing(mesh, area, rng) -> np.ndarray:
    yaw, T = rng.uniform(-np.pi, np.pi), np.eye(4)
    T[:3, :3] = Rotation.from_euler("z", yaw).as_matrix()
    T[:3, 3] = [rng.uniform(*area[0]), rng.uniform(*area[1]), -mesh.bounds[0, 2]]
    return T
