"""Motions of a robot along a trajectory: approach, grasp, path, release and retreat, as joints over time."""

import dataclasses
import itertools
from collections.abc import Iterator, Sequence

import numpy as np
from jaxtyping import Float

from tdf_jax._internal import checks
from tdf_jax._internal.boundary import host
from tdf_jax._internal.errors import InputError
from tdf_jax.geometry.trajectory import Trajectory
from tdf_jax.sim.collision import Collisions
from tdf_jax.sim.joint_trajectory import JointTrajectory
from tdf_jax.sim.kinematics import FOLLOWING, Kinematics, kinematics_of
from tdf_jax.sim.posture import HALF_TURN, Postures
from tdf_jax.sim.retiming import retime
from tdf_jax.sim.robot import Robot
from tdf_jax.sim.transit import RESOLUTION, connect
from tdf_jax.sim.workcell import Workcell

APPROACH = 0.10  # metres along the approach before the pick, and back after the release
SPACING, TURN = 0.005, 0.05  # metres and radians between poses for which the joints are computed
MAX_STEP = 0.35  # radians, largest step of a joint between them; a larger one is another posture of the arm
CLOSE_SECONDS, OPEN_SECONDS = 1.0, 0.6  # to close the fingers and to open them
CARRYING = 0.4  # factor on the limits of velocity and acceleration with an object in the hand, which swings and slips
RATE = 125.0  # samples per second
DEPARTURE, ARRIVAL = 0.08, 0.12  # metres of the path that are followed even where the arm cannot follow its middle
# Factors on approach, retreat and arrival that are tried as they are and turned by half a turn, and then the last one,
# with which departures are half as long: near the ends of the arm's reach it can leave straight by 3 cm and not by 5.
SHORTER, SHORTEST = (1.0, 0.5), 0.25
NARROW = 0.008  # radians between tested positions of free motions from ends that are so near
LIFT = 0.04  # metres straight up from the pick, where neither the whole path nor its ends can be followed without
MOST_POSTURES = 4  # postures tried at either end then
# Penetrations that a plan may have, metres. Clouds and fields know surfaces to a millimetre or two.
TOUCHING = 0.002
ITSELF = 0.0  # of the robot with itself, whose shape is known: with an overlap of 1 mm the arm got stuck at its wrist
RESTING = 0.006  # of the object and what it stands on or is placed on, near both ends
ENDS = 0.08  # metres from an end in which the object may touch its support or the target


@dataclasses.dataclass(frozen=True, eq=False)
class Plan:
    """A planned motion.

    Attributes:
        motion: the joints over time.
        pick, release: poses of the gripper's frame at both ends, 4x4, metres, world frame.
        candidate: number of the candidate that is executed.
        poses: poses of the gripper's frame from the pick to the release, (poses, 4, 4).
    """

    motion: JointTrajectory
    pick: Float[np.ndarray, "4 4"]
    release: Float[np.ndarray, "4 4"]
    candidate: int
    poses: Float[np.ndarray, "poses 4 4"]


@dataclasses.dataclass(frozen=True)
class Failure:
    """Why there is no motion.

    Attributes:
        reason: in words, of the candidate that came farthest.
    """

    reason: str


@host
def plan_joints(
    trajectory: Trajectory,
    robot: Robot,
    *,
    opening: float | None = None,
    grip: float = 0.0,
    cell: Workcell | None = None,
    approach: float = APPROACH,
    seed: int = 1,
) -> JointTrajectory:
    """Plan the joints of a robot along a trajectory of its gripper: to the pick, along the path, and back home.

    The robot goes from home to a pose behind the pick, straight to the pick, closes, follows the trajectory (straight
    lines and geodesics between its poses), opens, retreats along the approach and goes home. The first posture of the
    arm for which everything is within the limits and free of collisions is taken. In a cell, where the arm cannot
    follow the whole trajectory, it follows both ends, joined by a free motion with the object in the hand; where that
    fails too, the trajectory begins with a straight lift of `LIFT`.

    Args:
        trajectory: poses of the gripper's frame from the pick to the release: z along the approach, y along the closing
            direction, as of `tdf_jax.gripper_query`.
        robot: the robot; see `load_robot`.
        opening: opening of the fingers before the grasp and after the release, metres; by default the widest.
        grip: opening that is commanded to hold, metres: less than the width of what is held.
        cell: the cell of this robot to stay clear of; nothing by default. Its object is where it starts, and is held
            from the pick on.
        approach: length of the straight motions before the pick and after the release, metres; half or a quarter of
            it if there is no such motion.
        seed: seed of the planner of the free motions, at least 1.

    Returns:
        The motion.

    Raises:
        InputError: the extra "sim" is not installed, there is no such motion (with the reason), or an argument is
            wrong.
    """
    if not isinstance(trajectory, Trajectory) or np.asarray(trajectory.wxyz_xyz).ndim != 2:
        raise InputError("plan_joints(): trajectory is not one trajectory; expected Trajectory of shape (poses, 7)")
    if not isinstance(robot, Robot):
        raise InputError(f"plan_joints(): robot is {type(robot).__name__}; expected load_robot()")
    if cell is not None and not isinstance(cell, Workcell):
        raise InputError(f"plan_joints(): cell is {type(cell).__name__}; expected build_workcell(robot, ...)")
    if cell is not None and (cell.robot is not robot or cell.floating):
        raise InputError(
            "plan_joints(): the cell is not one with this robot's arm; expected build_workcell(robot, ...)"
        )
    checks.positive("plan_joints()", "approach", approach, "metres")
    checks.count("plan_joints()", "seed", seed)
    wide = robot.fingers.widest if opening is None else checks.real("plan_joints()", "opening", opening)
    grip = checks.real("plan_joints()", "grip", grip)
    if not 0 <= grip < wide <= robot.fingers.widest + 1e-6:
        raise InputError(
            f"plan_joints(): opening is {wide} and grip {grip}; expected 0 <= grip < opening <= "
            f"{robot.fingers.widest:.4f} m, the widest opening of {robot.name}"
        )
    poses = np.asarray(trajectory.matrices, float)
    plan = plan_motion([poses], robot, openings=[wide], grip=grip, cell=cell, approach=approach, seed=seed)
    if isinstance(plan, Failure):
        raise InputError(f"plan_joints(): there is no motion: {plan.reason}")
    return plan.motion


def plan_motion(
    candidates: Sequence[Float[np.ndarray, "poses 4 4"]],
    robot: Robot,
    *,
    openings: Sequence[float],
    grip: float,
    cell: Workcell | None = None,
    approach: float = APPROACH,
    seed: int = 1,
) -> Plan | Failure:
    """Plan the first of several trajectories that the robot can follow; see `plan_joints`.

    Args:
        candidates: trajectories of the gripper's frame, the best first, (poses, 4, 4) each. Each is tried as it is and
            turned by half a turn about the approach, which is the same for a parallel gripper.
        robot: the robot.
        openings: opening before the grasp and after the release of each, (candidates,), metres.
        grip: opening that is commanded to hold, metres.
        cell: the cell to stay clear of.
        approach: length of the straight motions before the pick and after the release, metres.
        seed: seed of the planner of the free motions.

    Returns:
        The plan, or why there is none.
    """
    kinematics = kinematics_of(robot)
    collisions = None if cell is None else Collisions(cell)
    postures = Postures(kinematics)
    reasons: list[tuple[int, str]] = []
    for number, (poses, opening) in enumerate(zip(candidates, openings, strict=True)):
        halves = np.eye(4), HALF_TURN
        variants = *itertools.product([0.0], halves, SHORTER), *itertools.product([0.0, LIFT], halves, [SHORTEST])
        for lift, half, share in variants:
            turned = _lifted(np.asarray(poses, float) @ half, lift)
            path = _Path(turned, share * approach)
            ends = min(1.0, 2 * share) * DEPARTURE, share * ARRIVAL
            ways = _ways(postures, collisions, path, opening, ends, seed, reasons)
            for there, carried, away in ways:
                # The fingers may still be around the object.
                step = RESOLUTION if share > SHORTEST else NARROW
                transits = _transits(robot, collisions, path, there[0], away[-1], opening, seed, step)
                if transits is None:
                    reasons.append((3, f"no free motion from home and back (RRT-Connect, seed {seed})"))
                    continue
                motion = _timed(robot, there, carried, away, transits, opening, grip)
                return Plan(motion, turned[0], turned[-1], number, turned)
    if not reasons:
        return Failure("the pick has no posture of the arm within its limits: it is out of reach")
    return Failure(max(reasons)[1])


def _lifted(poses: np.ndarray, lift: float) -> np.ndarray:
    """A path that begins with a straight lift, metres: one that tilts what it picks at once would hit the table."""
    if not lift or len(poses) < 2:
        return poses
    above = poses[0].copy()
    above[2, 3] += lift
    return np.concatenate([poses[:1], above[None], poses[1:]])


class _Path:
    """Dense poses of the gripper's frame, from behind the pick to behind the release."""

    def __init__(self, poses: np.ndarray, approach: float):
        behind = np.eye(4)
        behind[2, 3] = -approach
        corners = np.concatenate([[poses[0] @ behind], poses, [poses[-1] @ behind]])
        rows, at = [corners[:1]], [0]
        for start, end in zip(corners[:-1], corners[1:]):
            rows.append(_between(start, end))
            at.append(at[-1] + len(rows[-1]))
        self.poses = np.concatenate(rows)
        self.pick, self.release = at[1], at[-2]
        steps = np.linalg.norm(np.diff(self.poses[:, :3, 3], axis=0, prepend=self.poses[:1, :3, 3]), axis=1)
        self.lengths = steps.cumsum()

    def near_pick(self, distance: float) -> np.ndarray:
        """Rows from the pick up to a distance along the path, metres."""
        rows = np.arange(self.pick, self.release + 1)
        return rows[self.lengths[rows] - self.lengths[self.pick] <= distance]

    def near_release(self, distance: float) -> np.ndarray:
        """Rows from a distance along the path, metres, up to the release."""
        rows = np.arange(self.pick, self.release + 1)
        return rows[self.lengths[self.release] - self.lengths[rows] <= distance]


def _between(start: np.ndarray, end: np.ndarray) -> np.ndarray:
    """Poses on the straight line and geodesic after one pose up to the next."""
    from scipy.spatial.transform import Rotation, Slerp

    rotations = Rotation.from_matrix(np.stack([start[:3, :3], end[:3, :3]]))
    angle = (rotations[0].inv() * rotations[1]).magnitude()
    distance = np.linalg.norm(end[:3, 3] - start[:3, 3])
    count = max(1, int(np.ceil(max(distance / SPACING, angle / TURN))))
    shares = np.arange(1, count + 1) / count
    poses = np.tile(np.eye(4), (count, 1, 1))
    poses[:, :3, :3] = Slerp([0.0, 1.0], rotations)(shares).as_matrix()
    poses[:, :3, 3] = start[:3, 3] + shares[:, None] * (end[:3, 3] - start[:3, 3])
    return poses


def _ways(
    postures: Postures, collisions, path: _Path, opening: float, ends: tuple[float, float], seed: int, reasons
) -> Iterator[tuple]:
    """Joints to the pick, from there to the release, and away, for one posture of the arm after the other.

    The arm follows the whole path, or else both ends of it, joined by a free motion with the object in the hand.
    """
    kinematics, last = postures.kinematics, len(path.poses) - 1
    leave, arrive = path.near_pick(ends[0])[-1], path.near_release(ends[1])[0]
    picks, releases = [], []
    for posture in postures.at(path.poses[path.pick]):
        start = _followed(kinematics, path, posture, path.pick, 0, leave)
        if start is None:
            reasons.append((1, "the arm cannot follow the path within its limits"))
            continue
        blocked = _blocked(collisions, path, start, range(leave + 1), opening)
        if blocked is not None:
            reasons.append((2, blocked))
            continue
        picks.append(start)
        whole = _followed(kinematics, path, start[leave], leave, leave, last)
        if whole is None:
            reasons.append((1, "the arm cannot follow the path within its limits"))
            continue
        blocked = _blocked(collisions, path, whole, range(leave + 1, last + 1), opening)
        if blocked is None:
            yield (
                start[: path.pick + 1],
                _joined(start[path.pick : leave], whole[leave : path.release + 1]),
                whole[path.release :],
            )
        else:
            reasons.append((2, blocked))
    if not picks or collisions is None or arrive <= leave:
        return
    for posture in postures.at(path.poses[path.release]):
        end = _followed(kinematics, path, posture, path.release, arrive, last)
        if end is not None and _blocked(collisions, path, end, range(arrive, last + 1), opening) is None:
            releases.append(end)
            if len(releases) == MOST_POSTURES:
                break
    robot = kinematics.robot
    T_object = collisions.T_world_object
    T_grip_object = None if T_object is None else np.linalg.inv(path.poses[path.pick]) @ T_object
    free = _free(collisions, opening, kinematics, T_grip_object)
    for start in picks[:MOST_POSTURES]:
        for end in releases:
            middle = connect(start[leave], end[arrive], robot.lower, robot.upper, free, seed)
            if middle is None:
                reasons.append((2, f"no free motion with the object in the hand (RRT-Connect, seed {seed})"))
                continue
            carried = _joined(start[path.pick : leave], middle, end[arrive + 1 : path.release + 1])
            yield start[: path.pick + 1], carried, end[path.release :]


def _joined(*parts: np.ndarray) -> np.ndarray:
    return np.concatenate([part for part in parts if len(part)])


def _followed(
    kinematics: Kinematics, path: _Path, posture: np.ndarray, at: int, first: int, last: int
) -> np.ndarray | None:
    """Joints along a path from `first` to `last`, from a posture at one of its poses; None if the arm cannot follow."""
    joints = np.full((len(path.poses), len(posture)), np.nan)
    joints[at] = posture
    for way in (range(at - 1, first - 1, -1), range(at + 1, last + 1)):
        before = posture
        for row in way:
            solution = kinematics.solve(path.poses[row], before, FOLLOWING)
            if solution is None or np.abs(solution - before).max() > MAX_STEP:
                return None
            joints[row] = before = solution
    return joints


def _blocked(collisions: Collisions | None, path: _Path, joints, rows, opening: float) -> str | None:
    """The first collision at some rows of a path, in words."""
    if collisions is None:
        return None
    T_object = collisions.T_world_object
    T_gripper_object = None if T_object is None else np.linalg.inv(path.poses[path.pick]) @ T_object
    near = {*path.near_pick(ENDS), *path.near_release(ENDS)}
    for row in rows:
        held = path.pick < row <= path.release
        T = T_object
        if T_gripper_object is not None and row > path.pick:
            T = path.poses[min(row, path.release)] @ T_gripper_object
        where = "to the pick" if row <= path.pick else ("along the path" if held else "on the retreat")
        for (a, b), depth in collisions.depths(joints[row], opening, T).items():
            pair = {a, b}
            if pair in ({"hand"}, {"target", "table"}):
                continue
            if "object" in pair and "hand" in pair and held:
                continue
            allowed = ITSELF if pair <= {"arm", "hand"} else TOUCHING
            if pair in ({"object", "table"}, {"object", "target"}):
                allowed = np.inf if not held else (RESTING if row in near else TOUCHING)
            if depth > allowed:
                return f"{a} and {b} collide {where} (by {1e3 * depth:.0f} mm)"
    return None


def _free(collisions: Collisions, opening: float, kinematics: Kinematics | None = None, T_object=None):
    """Whether nothing collides at positions of the joints.

    With kinematics the object is in the hand, at a pose in the gripper's frame; without at a pose in the world.
    """
    meets = (("object", "table"), ("object", "target")) if kinematics is None else (("hand", "object"),)
    passed = (*meets, ("hand", "hand"), ("target", "table"))

    def free(positions) -> bool:
        T = T_object if kinematics is None or T_object is None else kinematics.pose(positions) @ T_object
        depths = collisions.depths(positions, opening, T)
        return all(
            pair in passed or depth <= (ITSELF if set(pair) <= {"arm", "hand"} else TOUCHING)
            for pair, depth in depths.items()
        )

    return free


def _transits(
    robot: Robot, collisions: Collisions | None, path: _Path, first, last, opening: float, seed: int, resolution: float
):
    """Free paths from home to the first pose and from the last pose home."""
    if collisions is None:
        return np.stack([robot.home, first]), np.stack([last, robot.home])
    T_start = collisions.T_world_object
    T_end = None if T_start is None else path.poses[path.release] @ np.linalg.inv(path.poses[path.pick]) @ T_start
    limits = robot.lower, robot.upper
    there = connect(robot.home, first, *limits, _free(collisions, opening, T_object=T_start), seed, resolution)
    if there is None:
        return None
    back = connect(last, robot.home, *limits, _free(collisions, opening, T_object=T_end), seed, resolution)
    return None if back is None else (there, back)


def _timed(robot: Robot, to_pick, carried, away, transits, opening: float, grip: float) -> JointTrajectory:
    """The whole motion: every phase from rest to rest, with time for the fingers."""
    there, back = transits
    phases = (
        ("transit", there, opening),
        ("approach", to_pick, opening),
        ("grasp", to_pick[-1:], grip),
        ("path", carried, grip),
        ("release", away[:1], opening),
        ("retreat", away, opening),
        ("return", back, opening),
    )
    times, positions, gripper, segments = [], [], [], []
    now = 0.0
    for name, waypoints, width in phases:
        if name in ("grasp", "release"):
            seconds = CLOSE_SECONDS if name == "grasp" else OPEN_SECONDS
            t = np.arange(int(seconds * RATE) + 1) / RATE
            q = np.repeat(waypoints, len(t), axis=0)
        else:
            factor = CARRYING if name == "path" else 1.0
            t, q = retime(waypoints, factor * robot.max_velocity, factor * robot.max_acceleration, RATE)
        keep = slice(0, None) if not times else slice(1, None)  # a phase begins where the one before ended
        if not len(t[keep]):  # the path of a release at the pick
            continue
        segments.append((name, sum(len(part) for part in times)))
        times.append(now + t[keep])
        positions.append(q[keep])
        gripper.append(np.full(len(t[keep]), width))
        now += float(t[-1])
    return JointTrajectory(
        times=np.concatenate(times),
        positions=np.concatenate(positions),
        joint_names=robot.joints,
        gripper=np.concatenate(gripper),
        segments=tuple(segments),
    )
