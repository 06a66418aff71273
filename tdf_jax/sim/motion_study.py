"""How many reachable tasks the planner solves, and in what time, with the true pick and the true release.

A task is reachable if the arm has configurations without collision at the pick and at the release, by a search of its
own: mink from random starts, where the planner has its own damped least squares. Starts that are not reachable are
drawn again, and every task that is drawn counts. A run that was interrupted computes what is missing.

python -m tdf_jax.sim.motion_study --episodes 20
"""

import dataclasses
import itertools
import sys
import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from tdf_jax._internal.cache import digest, kept
from tdf_jax._internal.errors import InputError
from tdf_jax.evaluation.study_command import study_parser
from tdf_jax.evaluation.tables import markdown, success_rate
from tdf_jax.sim.collision import Collisions
from tdf_jax.sim.configurations import HALF_TURN
from tdf_jax.sim.episode import start_cell
from tdf_jax.sim.kinematics import kinematics_of
from tdf_jax.sim.motion import Failure, plan_motion
from tdf_jax.sim.robot import Robot, load_robot
from tdf_jax.sim.tasks import POSES, TASKS, Episode, draw_episode, true_path

FORMAT = 1  # format number; raise it when what is drawn or planned changes
SEARCHES, ITERATIONS = 120, 40  # random starts at each end, and steps from each


@dataclasses.dataclass(frozen=True)
class Row:
    """A task, and what the planner made of it.

    Attributes:
        task: name of the task.
        poses: how the object starts.
        number: number of the episode.
        rejected: number of starts drawn before that are not reachable.
        solved: whether there is a motion.
        reason: why there is none; empty otherwise.
        seconds: processor time of the planner, seconds.
    """

    task: str
    poses: str
    number: int
    rejected: int
    solved: bool
    reason: str
    seconds: float


def reachable(episode: Episode, robot: Robot, collisions: Collisions) -> bool:
    """Whether the arm has configurations without collision at the true pick and the true release, by random restarts.

    Args:
        episode: the episode.
        robot: the robot.
        collisions: of a cell with the episode's bodies, the target free.
    """
    placed = episode.T_world_target @ episode.T_target_object
    kinematics, rng = kinematics_of(robot), np.random.default_rng(episode.number)
    for T, T_object, meet in (
        (episode.pick, episode.T_world_object, {"object", "table"}),
        (episode.release, placed, {"object", "target"}),
    ):
        for number in range(SEARCHES):
            start = rng.uniform(np.maximum(robot.lower, -np.pi), np.minimum(robot.upper, np.pi))
            joints = kinematics.solve(T @ HALF_TURN if number % 2 else T, start, ITERATIONS)
            if joints is None:
                continue
            depths = collisions.depths(joints, episode.grip.opening, T_object, episode.T_world_target)
            if all(set(pair) in (meet, {"target", "table"}, {"hand"}) for pair in depths):
                break
        else:
            return False
    return True


def plan_task(robot: Robot, task: str, poses: str, seed: int, number: int) -> Row:
    """Draw a task, and plan its true trajectory.

    Args:
        robot: the robot.
        task: name of the task.
        poses: how the object starts.
        seed: seed of the tasks.
        number: number of the task.
    """
    episode = draw_episode(task, robot, seed, number, poses, reachable=reachable)
    path = np.asarray(true_path(episode).matrices, float)
    cell = start_cell(episode, robot)
    begun = time.process_time()
    plan = plan_motion([path], robot, openings=[episode.grip.opening], grip=0.0, cell=cell)
    seconds = time.process_time() - begun
    failed = isinstance(plan, Failure)
    return Row(
        task, poses, number, episode.rejected, not failed, plan.reason if isinstance(plan, Failure) else "", seconds
    )


def table_of(rows: Sequence[Row]) -> str:
    """A table of the share solved with intervals, and of the times, by task and start.

    Args:
        rows: the tasks.
    """
    lines = []
    keys = list(dict.fromkeys((row.task, row.poses) for row in rows))
    for key in [*keys, ("all", "")]:
        of = [row for row in rows if key in ((row.task, row.poses), ("all", ""))]
        seconds = np.array([row.seconds for row in of])
        lines.append(
            [
                " ".join(key).strip().replace("_", " "),
                str(len(of)),
                success_rate([row.solved for row in of]),
                f"{np.median(seconds):.2f} s",
                f"{np.percentile(seconds, 90):.2f} s",
            ]
        )
    return markdown(["task", "tasks", "solved", "planner, median", "90 % are below"], lines)


def main(arguments: Sequence[str] | None = None) -> None:
    """Plan all tasks, and print the share solved, the times and the reasons of failures.

    Args:
        arguments: words of the command line; by default those of the process.
    """
    parser = study_parser(
        "tdf_jax.sim.motion_study", __doc__, "episodes", 10, "number of tasks of each kind and start", "the tasks"
    )
    parser.add_argument("--tasks", nargs="*", default=list(TASKS), choices=TASKS, help="tasks (default: all)")
    parser.add_argument("--poses", nargs="*", default=["upright", "tilt60"], choices=POSES, help="how objects start")
    parser.add_argument("--robot", type=Path, help="MJCF of another arm with a parallel gripper")
    parser.add_argument("--site", help="site of that file that is the gripper's frame")
    parser.add_argument(
        "--out",
        type=Path,
        default=Path("runs/motions"),
        help="folder that keeps what is measured (default: runs/motions)",
    )
    settings = parser.parse_args(arguments)
    rows = []
    try:
        robot = load_robot(settings.robot, settings.site)
        settings.out.mkdir(parents=True, exist_ok=True)
        file = None if settings.robot is None else [digest(settings.robot.read_bytes()), settings.site]
        for task, poses in itertools.product(settings.tasks, settings.poses):
            for number in range(settings.episodes):
                about = task, poses, settings.seed, number
                row = kept(
                    "motion_study",
                    settings.out,
                    ["motion", FORMAT, file, *about],
                    lambda about=about: dataclasses.asdict(plan_task(robot, *about)),
                    lambda arrays: Row(**{name: array.item() for name, array in arrays.items()}),
                )
                rows.append(row)
                if not row.solved:
                    print(f"{task} {poses} {number}: {row.reason}", flush=True)
            print(f"{task} {poses}: {settings.episodes} tasks", file=sys.stderr, flush=True)
    except (InputError, OSError) as error:
        parser.error(str(error))
    print(table_of(rows))


if __name__ == "__main__":
    main()
