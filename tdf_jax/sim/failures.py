"""Pictures of failed episodes: what was done, and what became of it, in two views beside each other."""

import textwrap
from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
from jaxtyping import Float, UInt8

from tdf_jax.sim.campaign import Run, found_in, process_pool
from tdf_jax.sim.condition import Settings
from tdf_jax.sim.episode import NOT_FOUND, run_episode
from tdf_jax.sim.grasping import CLOSE, LIFT, LIFTED, FloatingHand
from tdf_jax.sim.imitator import Found
from tdf_jax.sim.placement import reset_cell, settle
from tdf_jax.sim.recording import Recorder, gl_context
from tdf_jax.sim.robot import Robot
from tdf_jax.sim.tasks import TASKS, Episode
from tdf_jax.sim.workcell import FIXTURE, TARGET, Workcell, build_workcell

WIDTH, HEIGHT = 320, 240  # pixels of a view
LINE, MARGIN, TEXT = 15, 4, 12  # pixels of the words above: a line, around them, and their size
COLUMNS = 2  # of a sheet
COLOURS = 96  # of a sheet, so that its file is small
CLOSE_BY, AROUND = 0.75, 0.95  # metres from the camera to what it looks at
# What a view of an executed episode shows, by the cause: the moment; otherwise the end.
MOMENTS = {"collided": "collided", "hit the target on approach": "struck", "lost in transit": "lost"}
WORDS = {
    "closed": "fingers closed", "collided": "it touches", "struck": "the hand meets the target",
    "lost": "out of the hand", "end": "the end",
}  # fmt: skip


def first_failures(rows: Iterable[tuple[Settings, Sequence[Run]]]) -> list[tuple[Settings, Run]]:
    """The first failed episode of each cause that something can be drawn of.

    Args:
        rows: campaigns, and their episodes.
    """
    found: dict[str, tuple[Settings, Run]] = {}
    for settings, runs in rows:
        for one in runs:
            if one.outcome.cause and one.outcome.drawn and one.outcome.cause != NOT_FOUND:
                found.setdefault(one.outcome.cause, (settings, one))
    return list(found.values())


def check_renderer() -> None:
    """Raise InputError unless something renders off screen here."""
    gl_context(64, 64).free()


def picture_failures(failed: Sequence[tuple[Settings, Run]]) -> list[UInt8[np.ndarray, "_ _ 3"]]:
    """A picture of each failed episode, which runs again; the imitation is kept.

    Args:
        failed: campaigns, and an episode of each.

    Returns:
        Pictures of one width, (height, width, 3) each, 0 to 255.

    Raises:
        InputError: nothing renders off screen here.
    """
    # In a process as those of the campaign: in this one, sums of products may have another order.
    with process_pool(1) as pool:
        return [pool.submit(picture_one, settings, run).result() for settings, run in failed]


def picture_one(settings: Settings, run: Run) -> UInt8[np.ndarray, "_ _ 3"]:
    """As `picture_failures`, one in this process."""
    episode, robot, found = found_in(settings, run.number)
    paths, motion, opening = found.paths, found.motion, float(found.openings[0])
    condition, outcome = settings.condition, run.outcome
    if condition.mode == "teleport":
        views = _of_grasp(episode, robot, paths[0][0], opening) if not outcome.grasp else _of_place(episode, motion)
    else:
        views = _of_execution(episode, robot, found, MOMENTS.get(outcome.cause, "end"))
        if not views:
            views = _of_plan(episode, robot, paths[0], motion, opening)
    what = f"{run.instance or 'object'} of episode {run.number}"
    return _captioned(
        [view for _, view in views],
        f"{condition.task}, {condition.mode}, {condition.poses}, {condition.method}, {what}: {outcome.cause}",
        f"{outcome.detail} [left: {views[0][0]}; right: {views[-1][0]}]",
    )


def failure_sheet(pictures: Sequence[UInt8[np.ndarray, "_ _ 3"]]) -> bytes:
    """Pictures of one width under and beside each other, as a PNG of few colours.

    Args:
        pictures: the pictures, (height, width, 3) each, at least one.
    """
    import io

    from PIL import Image

    rows = [pictures[first : first + COLUMNS] for first in range(0, len(pictures), COLUMNS)]
    width = pictures[0].shape[1] * min(COLUMNS, len(pictures))
    heights = [max(len(one) for one in row) for row in rows]
    sheet = np.full((sum(heights), width, 3), 255, np.uint8)
    top = 0
    for row, height in zip(rows, heights):
        for column, one in enumerate(row):
            sheet[top : top + len(one), column * one.shape[1] : (column + 1) * one.shape[1]] = one
        top += height
    content = io.BytesIO()
    small = Image.fromarray(sheet).quantize(COLOURS, method=Image.Quantize.MEDIANCUT, dither=Image.Dither.NONE)
    small.save(content, "PNG", optimize=True)
    return content.getvalue()


def _of_execution(episode: Episode, robot: Robot, found: Found, moment: str) -> list[tuple[str, np.ndarray]]:
    """The fingers closed, and a moment of what follows; none if no motion was planned."""
    seen: dict[str, np.ndarray] = {}

    def noted(cell: Workcell, data: Any, word: str) -> None:
        if word in ("closed", moment):
            place = cell.gripper_pose(data) if word != "end" else cell.body_pose(data, TARGET)
            seen[word] = _view(cell, data, place[:3, 3], CLOSE_BY if word == "closed" else AROUND)

    run_episode(episode, robot, list(found.paths), found.openings.tolist(), noted=noted)
    return [(WORDS[word], seen[word]) for word in ("closed", moment) if word in seen]


def _of_plan(episode: Episode, robot: Robot, path, motion, opening: float) -> list[tuple[str, np.ndarray]]:
    """The hand alone at a pick, and at its release with the object where it goes."""
    views = []
    for words, grip, T_object in (
        ("the pick", path[0], episode.T_world_object),
        ("the release", path[-1], motion @ episode.T_world_object),
    ):
        cell, hand = _floating(episode, robot, grip, T_object, opening)
        views.append((words, _view(cell, hand.data, T_object[:3, 3], CLOSE_BY)))
    return views


def _of_grasp(episode: Episode, robot: Robot, pick, opening: float) -> list[tuple[str, np.ndarray]]:
    """The hand alone at the pick, and after it has closed and lifted the object."""
    cell, hand = _floating(episode, robot, pick, episode.T_world_object, opening)
    before = _view(cell, hand.data, pick[:3, 3], CLOSE_BY)
    hand.close(0.0, CLOSE)
    if episode.fixture:
        hand.data.eq_active[cell.model.equality(FIXTURE).id] = 0
    lifted = np.array(pick, float)
    lifted[2, 3] += LIFTED
    hand.move(lifted, LIFT)
    return [("at the pick", before), ("lifted", _view(cell, hand.data, lifted[:3, 3], CLOSE_BY))]


def _of_place(episode: Episode, motion) -> list[tuple[str, np.ndarray]]:
    """The object reset, and 2 s later."""
    cell = reset_cell(episode, motion @ episode.T_world_object)
    data = cell.data()
    middle = episode.T_world_target[:3, 3]
    before = _view(cell, data, middle, AROUND)
    settle(cell, data)
    return [("reset", before), ("2 s later", _view(cell, data, middle, AROUND))]


def _floating(episode: Episode, robot: Robot, grip, T_object, opening: float) -> tuple[Workcell, FloatingHand]:
    cell = build_workcell(
        robot,
        episode.object_body,
        T_object,
        episode.target_body,
        episode.T_world_target,
        floating=True,
        fixture=episode.fixture,
        fixed_target=TASKS[episode.task].fixed,
    )
    return cell, FloatingHand(cell, np.asarray(grip, float), opening)


def _view(cell: Workcell, data: Any, centre: Float[np.ndarray, "3"], distance: float) -> np.ndarray:
    with Recorder(cell.model, width=WIDTH, height=HEIGHT, centre=centre, distance=distance) as recorder:
        return recorder.picture(data)


def _captioned(views: Sequence[np.ndarray], *sentences: str) -> np.ndarray:
    """Views beside each other, below sentences."""
    from PIL import Image, ImageDraw, ImageFont

    beside = np.concatenate([*views, *[np.full_like(views[0], 255)] * (2 - len(views))], axis=1)
    lines = [line for one in sentences for line in textwrap.wrap(one, beside.shape[1] // (TEXT // 2))[:2]]
    lines += [""] * (2 * len(sentences) - len(lines))  # all pictures of one height
    strip = Image.new("RGB", (beside.shape[1], LINE * len(lines) + 2 * MARGIN), "white")
    draw, font = ImageDraw.Draw(strip), ImageFont.load_default(TEXT)
    for number, line in enumerate(lines):
        draw.text((MARGIN, MARGIN + LINE * number), line, "black", font)
    return np.concatenate([np.asarray(strip), beside])
