"""Episodes: one task from the start to the settled end, executed by the arm or with the object reset to its goal."""

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from tdf_jax.geometry.symmetry import ROUND
from tdf_jax.sim.collision import ARM, HAND_KIND, OBJECT_KIND, TABLE_KIND, TARGET_KIND, geom_kinds
from tdf_jax.sim.configurations import HALF_TURN
from tdf_jax.sim.execution import Payload, execute
from tdf_jax.sim.grasping import MOST_SLIP, MOST_TURN, evaluate_grasp
from tdf_jax.sim.motion import Failure, plan_motion
from tdf_jax.sim.physics import TIMESTEP
from tdf_jax.sim.placement import WATCHED, contact_pairs, judge, judge_reset, settle
from tdf_jax.sim.robot import Robot
from tdf_jax.sim.tasks import TASKS, Episode
from tdf_jax.sim.workcell import FIXTURE, OBJECT, Workcell, build_workcell

MODES = ("execute", "teleport")
LOST = 0.1  # seconds without contact after which the object is not in the hand any more
# Errors of a pick, metres and degrees, from which it is the pick that failed.
WRONG_PICK = (0.03, 30.0)
NOT_DRAWN = "not drawn"  # no start is within reach: there is no episode
NOT_FOUND = "not found"  # there is no pick or no goal to execute
CAUSES = (
    NOT_DRAWN,
    NOT_FOUND,
    "pick wrong",
    "unreachable",
    "slipped",
    "lost in transit",
    "hit the target on approach",
    "collided",
    "fell",
    "stuck",
    "not upright",
    "not on the peg",
    "not settled",
)
# What a placement must be, each a field of `Outcome`.
CRITERIA = ("touches", "off_table", "settled", "upright", "comes_off", "hung", "no_collision")


@dataclasses.dataclass(frozen=True)
class Outcome:
    """What became of an episode.

    Attributes:
        grasp: whether the object was held: in the grasp test, or from the pick to the release.
        place: whether it ended placed on the target, whatever became of the grasp test.
        overall: both.
        strict: as `overall`, and a mug hangs with the peg through its finger hole, which R-NDF does not ask for.
        cause: the first thing that went wrong, of `CAUSES`; empty for a success.
        detail: more about it, in words.
        slip, turn: movement of the object in the hand after closing, metres and degrees; NaN without a grasp.
        touches: whether the object touched the target in the end. This and all that follow are False where nothing
            moved.
        off_table: whether it did not touch the table.
        settled: whether it was slower than `MOVING`.
        upright: whether it was within 15 degrees of upright.
        comes_off: whether it came off the target with gravity reversed; False in "execute", which does not test it.
        hung: whether a peg went through a mug's finger hole; True of other objects.
        no_collision: whether the arm touched nothing; True in "teleport", which has no arm.
    """

    grasp: bool
    place: bool
    overall: bool
    strict: bool
    cause: str
    detail: str
    slip: float
    turn: float
    touches: bool = False
    off_table: bool = False
    settled: bool = False
    upright: bool = False
    comes_off: bool = False
    hung: bool = False
    no_collision: bool = False

    @property
    def drawn(self) -> bool:
        """Whether there was an episode."""
        return self.cause != NOT_DRAWN

    @classmethod
    def failure(cls, cause: str, detail: str) -> "Outcome":
        """The outcome of an episode in which nothing moved.

        Args:
            cause: one of `CAUSES`.
            detail: more about it, in words.
        """
        return cls(False, False, False, False, cause, detail, np.nan, np.nan)


def teleport(
    episode: Episode,
    robot: Robot,
    pick: Float[np.ndarray, "4 4"],
    motion: Float[np.ndarray, "4 4"],
    opening: float | None = None,
    watch: Callable[[Workcell, Any, str], None] | None = None,
) -> Outcome:
    """The protocol of NDF and R-NDF: grasp and place are tested apart, and the object is reset to where it is placed.

    Grasp: a floating gripper at the pick closes, lifts and turns the object, and holds it for 2 s. Place: the object is
    reset to the motion M of its start, and after 2 s it touches the target and not the table; a bowl or a bottle is
    within 15 degrees of upright; and with gravity reversed it comes off the target, so that neither is stuck in the
    other.

    Args:
        episode: the episode.
        robot: the robot, whose gripper floats.
        pick: pose of the gripper's frame at the pick, 4x4, metres, world frame.
        motion: motion M of the object: a point x of it ends at M x, 4x4.
        opening: opening of the fingers before they close, metres; by default that of the true grasp.
        watch: called every few steps with the cell, the state and the phase, first of the grasp test, and then of the
            placement.
    """
    release = motion @ pick
    grasp = evaluate_grasp(
        robot,
        episode.object_body,
        episode.T_world_object,
        pick,
        episode.grip.opening if opening is None else opening,
        rotation=release[:3, :3],
        fixture=episode.fixture,
        watch=watch,
    )
    placed, cause, detail, criteria = judge_reset(episode, motion @ episode.T_world_object, watch)
    if not grasp.held:
        wrong = _pick_error(episode, pick)
        cause = "pick wrong" if wrong else "slipped"
        detail = wrong or f"{1e3 * grasp.slip:.0f} mm and {grasp.turn:.0f} degrees in the hand"
    return _outcome(grasp.held, placed, criteria, cause, detail, grasp.slip, grasp.turn)


def run_episode(
    episode: Episode,
    robot: Robot,
    candidates: Sequence[Float[np.ndarray, "poses 4 4"]],
    openings: Sequence[float] | None = None,
    seed: int = 1,
    watch: Callable[[Workcell, Any, str], None] | None = None,
    planned: Callable[[], None] | None = None,
    noted: Callable[[Workcell, Any, str], None] | None = None,
) -> Outcome:
    """Execute the first trajectory that can be planned, from home to home, and look where the object ended.

    Args:
        episode: the episode.
        robot: the robot.
        candidates: trajectories of the gripper's frame from the pick to the release, the best first.
        openings: opening of the fingers before they close, of each, (candidates,), metres; by default that of the true
            grasp.
        seed: seed of the planner.
        watch: called every few steps with the cell, the state and the phase, such as `Recorder`; until the object has
            settled.
        planned: called when there is a plan, or none: the physics begins.
        noted: called with the cell, the state and a word when something happens: "closed", "collided", "struck" (the
            hand and the target), "lost" (from the hand), and "end".
    """
    cell = start_cell(episode, robot)
    openings = [episode.grip.opening] * len(candidates) if openings is None else openings
    plan = plan_motion(candidates, robot, openings=openings, grip=0.0, cell=cell, seed=seed)
    if planned is not None:
        planned()
    wrong = _pick_error(episode, np.asarray(candidates[0][0]))
    if isinstance(plan, Failure):
        return Outcome.failure("pick wrong" if wrong else "unreachable", wrong or plan.reason)
    data = cell.data()
    observer = _Observer(cell, watch, noted)
    centre = np.linalg.inv(plan.pick) @ episode.T_world_object @ np.append(episode.object_body.centre, 1.0)
    execute(cell, data, plan.motion, observer, Payload(episode.object_body.mass, centre[:3]))
    contacts = settle(cell, data, watch)
    observer.note(data, "end")
    placed, cause, detail, criteria = judge(episode, cell, data, contacts)
    criteria["no_collision"] = not observer.collided
    slip, turn = observer.in_hand_motion()
    if observer.collided:
        placed, cause, detail = False, "collided", observer.collided
    elif cause or not observer.held:
        if not observer.held:
            wrong = _pick_error(episode, plan.pick)
            cause, detail = ("pick wrong", wrong) if wrong else ("lost in transit", observer.lost)
        elif slip > MOST_SLIP or turn > MOST_TURN:
            cause, detail = "slipped", f"{1e3 * slip:.0f} mm and {turn:.0f} degrees in the hand; {detail}"
        elif observer.struck:
            cause, detail = "hit the target on approach", f"{observer.struck}; {detail}"
    return _outcome(observer.held, placed, criteria, cause, detail, slip, turn)


def _outcome(
    held: bool, placed: bool, criteria: dict[str, bool], cause: str, detail: str, slip: float, turn: float
) -> Outcome:
    """The outcome of both protocols; a strict success has no cause of failure."""
    overall = held and placed
    strict = overall and criteria["hung"]
    return Outcome(held, placed, overall, strict, "" if strict else cause, detail, slip, turn, **criteria)


class _Observer:
    """Watches an episode: what the arm touches, and whether the object stays in the hand."""

    def __init__(self, cell: Workcell, watch, noted=None):
        self.cell, self.watch, self.noted = cell, watch, noted
        self.kinds = geom_kinds(cell)
        self.collided, self.struck, self.lost, self.held = "", "", "", True
        self.without = 0
        self.closed: np.ndarray | None = None
        self.last: np.ndarray | None = None

    def __call__(self, data, step: int, phase: str) -> None:
        model = self.cell.model
        if phase == "path" and self.closed is None:
            if any(model.equality(number).name == FIXTURE for number in range(model.neq)):
                data.eq_active[model.equality(FIXTURE).id] = 0
            self.closed = self._in_hand(data)
            self.note(data, "closed")
        if step % WATCHED:
            return
        pairs = contact_pairs(self.kinds, data)
        if not self.collided:
            for a, b, words in (
                (ARM, TABLE_KIND, "the arm touches the table"),
                (HAND_KIND, TABLE_KIND, "the gripper touches the table"),
                (ARM, TARGET_KIND, "the arm touches the target"),
                (ARM, OBJECT_KIND, "the arm touches the object"),
            ):
                if (a, b) in pairs or (b, a) in pairs:
                    self.collided = f"{words} ({phase})"
                    self.note(data, "collided")
        if not self.struck and phase in ("path", "approach") and (HAND_KIND, TARGET_KIND) in pairs:
            self.struck = f"the gripper touches the target ({phase})"
            self.note(data, "struck")
        if phase == "path":
            self.last = self._in_hand(data)
            self.without = 0 if (HAND_KIND, OBJECT_KIND) in pairs else self.without + 1
            if self.held and self.without * WATCHED * TIMESTEP > LOST:
                self.held, self.lost = False, f"out of the hand after {data.time:.1f} s"
                self.note(data, "lost")
        if self.watch is not None:
            self.watch(self.cell, data, phase)

    def note(self, data, word: str) -> None:
        """Say that something happens."""
        if self.noted is not None:
            self.noted(self.cell, data, word)

    def in_hand_motion(self) -> tuple[float, float]:
        """Slip and turn of the object in the hand, closing to release, metres and degrees; NaN if it was not closed."""
        if self.closed is None or self.last is None:
            return np.nan, np.nan
        moved = np.linalg.inv(self.closed) @ self.last
        centre = self.cell.model.body(OBJECT).ipos
        return (
            float(np.linalg.norm((self.last - self.closed)[:3, :3] @ centre + (self.last - self.closed)[:3, 3])),
            float(np.degrees(Rotation.from_matrix(moved[:3, :3]).magnitude())),
        )

    def _in_hand(self, data) -> np.ndarray:
        return np.linalg.inv(self.cell.gripper_pose(data)) @ self.cell.body_pose(data, OBJECT)


def start_cell(episode: Episode, robot: Robot) -> Workcell:
    """The cell of an episode at its start, with the robot.

    Args:
        episode: the episode.
        robot: the robot.
    """
    return build_workcell(
        robot,
        episode.object_body,
        episode.T_world_object,
        episode.target_body,
        episode.T_world_target,
        fixture=episode.fixture,
        fixed_target=TASKS[episode.task].fixed,
    )


def _pick_error(episode: Episode, pick) -> str:
    """What is wrong with a pick, in words; empty near a true one, up to the turn about a round object's axis."""
    local = np.linalg.inv(episode.T_world_object) @ pick
    true = episode.grip.T_object_grip
    round_grasp = ROUND in (episode.object.fold, episode.grip.fold)
    turns = np.linspace(0, 2 * np.pi, 180, endpoint=False) if round_grasp else [0.0]
    if episode.object.fold in (2, 4) and not round_grasp:
        turns = np.arange(episode.object.fold) * 2 * np.pi / episode.object.fold
    best = (np.inf, np.inf)
    for turn in turns:
        T = np.eye(4)
        T[:3, :3] = Rotation.from_euler("z", turn).as_matrix()
        for half in (np.eye(4), HALF_TURN):
            error = np.linalg.inv(T @ true @ half) @ local
            angle = float(np.degrees(Rotation.from_matrix(error[:3, :3]).magnitude()))
            best = min(best, (float(np.linalg.norm(error[:3, 3])) + angle / 1e3, angle))
    distance = best[0] - best[1] / 1e3
    if distance > WRONG_PICK[0] or best[1] > WRONG_PICK[1]:
        return f"{1e2 * distance:.1f} cm and {best[1]:.0f} degrees from a true pick"
    return ""
