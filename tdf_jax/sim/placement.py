"""Whether an object is placed: what settles on a target, by the criteria of NDF and R-NDF."""

from collections.abc import Callable
from typing import Any, NamedTuple, cast

import numpy as np
from jaxtyping import Float

from tdf_jax.evaluation.relation_success import UPRIGHT, hole_is_crossed
from tdf_jax.shapes import Mug, Rack
from tdf_jax.sim.collision import OBJECT_KIND, TABLE_KIND, TARGET_KIND, geom_kinds
from tdf_jax.sim.physics import TIMESTEP, extra
from tdf_jax.sim.tasks import TASKS, Episode
from tdf_jax.sim.workcell import OBJECT, TARGET, Workcell, build_workcell

SETTLE = 2.0  # seconds after the release, as in NDF and R-NDF
LAST = 0.1  # seconds at the end of them in which a contact counts: a mug that swings leaves its peg for moments
MOVING = 0.25  # m/s, faster than a mug that swings on its peg, which nothing damps but friction
UPSIDE_DOWN = 1.0  # seconds with gravity reversed
FALLS = 0.03  # metres that an object moves from its target then, unless it is stuck in it
WATCHED = 5  # steps of the physics between looks


class Verdict(NamedTuple):
    """Whether an object is placed.

    Attributes:
        placed: whether it is, whatever a mug hangs by.
        cause: what is wrong, of `tdf_jax.sim.episode.CAUSES`; empty if it is placed, and a mug hangs by its handle.
        detail: more about it, in words.
        criteria: whether each of `tdf_jax.sim.episode.CRITERIA` holds.
    """

    placed: bool
    cause: str
    detail: str
    criteria: dict[str, bool]


def judge_reset(
    episode: Episode,
    T_world_object: Float[np.ndarray, "4 4"],
    watch: Callable[[Workcell, Any, str], None] | None = None,
) -> Verdict:
    """Reset the object to a pose, let 2 s pass, and judge; then whether it comes off the target.

    Args:
        episode: the episode.
        T_world_object: pose of the object, 4x4, metres, world frame.
        watch: called every few steps with the cell, the state and the phase.
    """
    cell = reset_cell(episode, T_world_object)
    data = cell.data()
    verdict = judge(episode, cell, data, settle(cell, data, watch))
    comes_off = _comes_off(episode, cell.body_pose(data, OBJECT), cell.body_pose(data, TARGET))
    verdict.criteria["comes_off"] = comes_off
    if verdict.placed and not comes_off:
        return verdict._replace(
            placed=False, cause="stuck", detail="with gravity reversed the object stays on the target"
        )
    return verdict


def reset_cell(episode: Episode, T_world_object: Float[np.ndarray, "4 4"]) -> Workcell:
    """The cell of an episode without a robot, the object reset to a pose.

    Args:
        episode: the episode.
        T_world_object: pose of the object, 4x4, metres, world frame.
    """
    return build_workcell(
        None,
        episode.object_body,
        T_world_object,
        episode.target_body,
        episode.T_world_target,
        fixed_target=TASKS[episode.task].fixed,
    )


def settle(
    cell: Workcell, data: Any, watch: Callable[[Workcell, Any, str], None] | None = None
) -> set[tuple[int, int]]:
    """Let 2 s pass.

    Args:
        cell: the cell.
        data: its state, which changes.
        watch: called every few steps with the cell, the state and the phase.

    Returns:
        Pairs of kinds of geoms (see `tdf_jax.sim.collision`), the smaller number first, that met in the last 0.1 s.
    """
    mujoco = extra("run_episode()", "mujoco")
    kinds, steps, contacts = geom_kinds(cell), round(SETTLE / TIMESTEP), set()
    for step in range(steps):
        mujoco.mj_step(cell.model, data)
        if step >= steps - round(LAST / TIMESTEP):
            contacts |= contact_pairs(kinds, data)
        if watch is not None and (step % WATCHED == 0 or step == steps - 1):
            watch(cell, data, "settling")
    return contacts


def contact_pairs(kinds: np.ndarray, data: Any) -> set[tuple[int, int]]:
    """Pairs of kinds of geoms that are in contact, the smaller number first.

    Args:
        kinds: kind of every geom, see `tdf_jax.sim.collision.geom_kinds`, (geoms,).
        data: the state, after a step.
    """
    return {(a, b) for a, b in np.sort(kinds[data.contact.geom[: data.ncon]], axis=1).tolist()}


def judge(episode: Episode, cell: Workcell, data: Any, contacts: set[tuple[int, int]]) -> Verdict:
    """Whether the object is placed, by each criterion that the end shows.

    Args:
        episode: the episode.
        cell: the cell.
        data: its state after `settle`.
        contacts: what `settle` returned.
    """
    T_target_object = np.linalg.inv(cell.body_pose(data, TARGET)) @ cell.body_pose(data, OBJECT)
    is_mug = episode.object.category == "mug"
    hung = True
    if is_mug:
        mug, rack = cast(Mug, episode.object), cast(Rack, episode.target)
        hung = any(hole_is_crossed(mug, line, T_target_object) for line in rack.peg_lines)
    tilt = float(np.degrees(np.arccos(np.clip(cell.body_pose(data, OBJECT)[2, 2], -1, 1))))
    criteria = {
        "touches": (OBJECT_KIND, TARGET_KIND) in contacts,
        "off_table": (OBJECT_KIND, TABLE_KIND) not in contacts,
        "settled": bool(np.linalg.norm(data.joint(OBJECT).qvel[:3]) <= MOVING),
        "upright": tilt <= UPRIGHT,
        "comes_off": False,
        "hung": hung,
        "no_collision": True,
    }
    for name, cause, detail in (
        ("touches", "fell", "the object does not touch the target"),
        ("off_table", "fell", "the object touches the table"),
        ("settled", "not settled", f"the object still moves after {SETTLE:g} s"),
        ("upright", "not upright", f"{tilt:.0f} degrees from upright"),
    ):
        if not criteria[name] and not (name == "upright" and is_mug):
            return Verdict(False, cause, detail, criteria)
    if not hung:
        return Verdict(True, "not on the peg", "no peg goes through the finger hole", criteria)
    return Verdict(True, "", "", criteria)


def _comes_off(episode: Episode, T_object, T_target) -> bool:
    """Whether an object comes off with gravity reversed, where the target stays and there is no table."""
    mujoco = extra("teleport()", "mujoco")
    turned = build_workcell(None, episode.object_body, T_object, episode.target_body, T_target, table=False)
    turned.model.opt.gravity[2] *= -1
    data = turned.data()
    for _ in range(int(UPSIDE_DOWN / TIMESTEP)):
        mujoco.mj_step(turned.model, data)
    return bool(np.linalg.norm(turned.body_pose(data, OBJECT)[:3, 3] - T_object[:3, 3]) >= FALLS)
