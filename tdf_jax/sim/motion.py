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
from tdf_jax.sim.collision import Collisions, first_collision, free_positions
from tdf_jax.sim.configurations import HALF_TURN, Configurations
from tdf_jax.sim.gripper_path import GripperPath, lifted
from tdf_jax.sim.joint_trajectory import JointTrajectory
from tdf_jax.sim.kinematics import kinematics_of
from tdf_jax.sim.retiming import retime
from tdf_jax.sim.robot import Robot
from tdf_jax.sim.rrt import RESOLUTION, connect
from tdf_jax.sim.workcell import Workcell

APPROACH = 0.10  # metres along the approach before the pick, and back after the release
CLOSE_SECONDS, OPEN_SECONDS = 1.0, 0.6  # to close the fingers and to open them
CARRYING = 0.4  # factor on the limits of velocity and acceleration with an object in the hand, which swings and slips
RATE = 125.0  # samples per second
DEPARTURE, ARRIVAL = 0.08, 0.12  # metres of the path that are followed even where the arm cannot follow its middle
# Factors on approach, retreat and arrival that are tried as they are and turned by half a turn, and then the last one,
# with which departures are half as long: near the ends of the arm's reach it can leave straight by 3 cm and not by 5.
SHORTER, SHORTEST = (1.0, 0.5), 0.25
NARROW = 0.008  # radians between tested positions of free motions from ends that are so near
LIFT = 0.04  # metres straight up from the pick, where neither the whole path nor its ends can be followed without
MOST_CONFIGURATIONS = 4  # configurations tried at either end then


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
    lines and geodesics between its poses), opens, retreats along the approach and goes home. The first configuration
    of the arm for which everything is within the limits and free of collisions is taken. In a cell, where the arm
    cannot follow the whole trajectory, it follows both ends, joined by a free motion with the object in the hand; where
    that fails too, the trajectory begins with a straight lift of `LIFT`.

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
    configurations = Configurations(kinematics)
    reasons: list[tuple[int, str]] = []
    for number, (poses, opening) in enumerate(zip(candidates, openings, strict=True)):
        halves = np.eye(4), HALF_TURN
        variants = *itertools.product([0.0], halves, SHORTER), *itertools.product([0.0, LIFT], halves, [SHORTEST])
        for lift, half, share in variants:
            turned = lifted(np.asarray(poses, float) @ half, lift)
            path = GripperPath(turned, share * approach)
            ends = min(1.0, 2 * share) * DEPARTURE, share * ARRIVAL
            ways = _ways(configurations, collisions, path, opening, ends, seed, reasons)
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
        return Failure("the pick has no configuration of the arm within its limits: it is out of reach")
    releases = (np.asarray(poses, float)[-1] @ half for poses in candidates for half in (np.eye(4), HALF_TURN))
    if max(reasons)[0] == 1 and all(next(configurations.at(T), None) is None for T in releases):
        return Failure("the release has no configuration of the arm within its limits: it is out of reach")
    return Failure(max(reasons)[1])


def _ways(
    configurations: Configurations,
    collisions: Collisions | None,
    path: GripperPath,
    opening: float,
    ends: tuple[float, float],
    seed: int,
    reasons: list[tuple[int, str]],
) -> Iterator[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Joints to the pick, from there to the release, and away, for one configuration of the arm after the other.

    The arm follows the whole path, or else both ends of it, joined by a free motion with the object in the hand. What
    it cannot follow is added to the reasons, the farther it came the higher its number.
    """
    kinematics, last = configurations.kinematics, len(path.poses) - 1
    leave, arrive = path.near_pick(ends[0])[-1], path.near_release(ends[1])[0]
    picks, releases = [], []
    for configuration in configurations.at(path.poses[path.pick]):
        start = path.followed(kinematics, configuration, path.pick, 0, leave)
        if start is None:
            reasons.append((1, "the arm cannot follow the path within its limits"))
            continue
        blocked = first_collision(collisions, path, start, range(leave + 1), opening)
        if blocked is not None:
            reasons.append((2, blocked))
            continue
        picks.append(start)
        whole = path.followed(kinematics, start[leave], leave, leave, last)
        if whole is None:
            reasons.append((1, "the arm cannot follow the path within its limits"))
            continue
        blocked = first_collision(collisions, path, whole, range(leave + 1, last + 1), opening)
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
    for configuration in configurations.at(path.poses[path.release]):
        end = path.followed(kinematics, configuration, path.release, arrive, last)
        if end is not None and first_collision(collisions, path, end, range(arrive, last + 1), opening) is None:
            releases.append(end)
            if len(releases) == MOST_CONFIGURATIONS:
                break
    robot = kinematics.robot
    free = free_positions(collisions, opening, kinematics, path.in_hand(collisions.T_world_object))
    for start in picks[:MOST_CONFIGURATIONS]:
        for end in releases:
            middle = connect(start[leave], end[arrive], robot.lower, robot.upper, free, seed)
            if middle is None:
                reasons.append((2, f"no free motion with the object in the hand (RRT-Connect, seed {seed})"))
                continue
            carried = _joined(start[path.pick : leave], middle, end[arrive + 1 : path.release + 1])
            yield start[: path.pick + 1], carried, end[path.release :]


def _joined(*parts: np.ndarray) -> np.ndarray:
    return np.concatenate([part for part in parts if len(part)])


def _transits(
    robot: Robot,
    collisions: Collisions | None,
    path: GripperPath,
    first: np.ndarray,
    last: np.ndarray,
    opening: float,
    seed: int,
    resolution: float,
) -> tuple[np.ndarray, np.ndarray] | None:
    """Free paths from home to the first pose and from the last pose home."""
    if collisions is None:
        return np.stack([robot.home, first]), np.stack([last, robot.home])
    T_start = collisions.T_world_object
    T_end = None if T_start is None else path.poses[path.release] @ np.linalg.inv(path.poses[path.pick]) @ T_start
    limits = robot.lower, robot.upper
    there = connect(robot.home, first, *limits, free_positions(collisions, opening, T_object=T_start), seed, resolution)
    if there is None:
        return None
    back = connect(last, robot.home, *limits, free_positions(collisions, opening, T_object=T_end), seed, resolution)
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
