"""The page of `tdf benchmark --simulation`: rows of many campaigns beside published ones, and their record."""

import os
import shlex
from collections.abc import Mapping, Sequence
from importlib.metadata import version
from typing import Any

import numpy as np

from tdf_jax._internal.version import __version__
from tdf_jax.evaluation.tables import between, markdown, percent
from tdf_jax.sim import report
from tdf_jax.sim.condition import GENERATED, LIBRARY, MESHES, SEGMENTED
from tdf_jax.sim.episode import CRITERIA
from tdf_jax.sim.physics import LIGHT_MASS
from tdf_jax.sim.published import PAPERS, Published, peers_of
from tdf_jax.sim.rows import Row
from tdf_jax.sim.sentences import reading

SCHEMA = 1  # raised when a key changes its name or its meaning
CONDITIONS = ("target", "poses", "clouds", "shown", "method")  # columns that say what a row is measured under


def record(rows: Sequence[Row], settings: Mapping[str, Any]) -> dict[str, Any]:
    """Every number, those of each episode included, as JSON has them; "machine" and "seconds" differ on a rerun.

    Args:
        rows: all campaigns.
        settings: settings of the command.
    """
    made, seconds = [], []
    for row in rows:
        one = report.record(row.settings, row.all)
        seconds.append(one.pop("seconds"))
        for name in ("schema", "tdf_jax", "seed"):  # of the whole record
            one.pop(name)
        moved, (rejected, redrawn) = row.in_hand_motion(), row.rejections()
        one["number_of_episodes"] = len(row.runs)
        one["rejected"], one["redrawn"] = rejected, redrawn
        one["moved_in_hand_median"] = None if moved is None else {"metres": moved[0], "degrees": moved[1]}
        one["published"] = [other._asdict() for other in peers_of(row.condition)]
        made.append(one)
    return {
        "schema": SCHEMA,
        "tdf_jax": __version__,
        "settings": dict(settings),
        "rows": made,
        "machine": machine(),
        "seconds": seconds,
    }


def machine() -> dict[str, Any]:
    """The number of cores and the versions that times depend on."""
    versions = {name: version(name) for name in ("jax", "mujoco", "mink")}
    return {"cores": os.cpu_count(), **versions}


def page(rows: Sequence[Row], settings: Mapping[str, Any], sheet: str | None = None) -> str:
    """Render the page.

    Args:
        rows: all campaigns.
        settings: settings of the command.
        sheet: path of a picture of failures from the page; None if there is none.
    """
    parts = ["# Simulation", _setup(rows, settings), "## Reading", *reading(rows)]
    for task in dict.fromkeys(row.condition.task for row in rows):
        parts.append(f"## {_words(task).capitalize()}")
        for mode, title in (("teleport", "Teleported"), ("execute", "Executed")):
            mine = [row for row in rows if row.condition.task == task and row.condition.mode == mode]
            if mine:
                parts += [f"### {title}: {_words(task)}", _rates(mine)]
    parts += ["## Criteria of the place", _criteria(rows), "## Failures and draws", _failures(rows)]
    if sheet is not None:
        parts.append(f"![The first failed episode of each cause]({sheet})")
    parts += ["## Times", _times(rows, settings)]
    return "\n\n".join(parts) + "\n"


def _setup(rows: Sequence[Row], settings: Mapping[str, Any]) -> str:
    episodes = sorted({len(row.runs) for row in rows if row.condition.objects == GENERATED})
    meshes = [row for row in rows if row.condition.objects == MESHES]
    names = sorted({one.instance for row in meshes for one in row.all})
    unseen = f"{' or '.join(map(str, episodes))} episodes a row, each with an unseen generated object" * bool(episodes)
    real = f"rows of meshes have episodes of {', '.join(names)} in turn, their intervals over meshes" * bool(names)
    light = any(row.condition.mass for row in rows)
    masses = (
        f"Teleported objects weigh {LIGHT_MASS:g} kg, as the published ones; executed ones have masses by their volume."
        if light
        else "Masses are by volume; the published objects weigh " + f"{LIGHT_MASS:g} kg."
    )
    return (
        "This page records how many simulated episodes succeed, executed by an arm or by the teleporting protocol of "
        "NDF and R-NDF. [The guide](../guide/simulation.md) says what is simulated and what a success is, and "
        "[development measurements](simulation_notes.md) what was tried on the way.\n\n"
        f"`{_command(settings)}` made this page and [the record of every episode](simulation/simulation.json): "
        f"{'; '.join(one for one in (unseen, real) if one)}. {masses} "
        "Intervals in brackets are 95 % bootstrap intervals over objects; where all episodes of a row are alike they "
        "have no width, and a rate that differs by less than 3 over the number of episodes remains likely. Starts were "
        "drawn before any method ran, and those out of reach were rejected.\n\n"
        f"The columns of other systems are the published rates of {', '.join(PAPERS.values())}: same protocol, other "
        "objects. Theirs are of ShapeNet, seen by depth cameras, with ten demonstrations where no other number is "
        "given. NDF and L-NDF reset the object to the predicted pose and test the grasp apart, with a target that "
        "stays where it was demonstrated. R-NDF finds the target and has no grasp, so its number is the **place**. "
        "None of them executes a trajectory by friction alone: nothing stands beside executed rows. *Shown* is the "
        "number of demonstrations; with one, each of ten is imitated in a tenth of the episodes. "
        "L-NDF's rates of bottles are approximate."
    )


def _command(settings: Mapping[str, Any]) -> str:
    """The command line that has these settings; those on which outcomes do not depend are left out."""
    words = ["tdf", "benchmark", "--simulation"]
    for name, value in settings.items():
        flag = "--" + name.replace("_", "-")
        if (name == "num_poses" and settings.get("meshes") is None) or (name == "masks" and list(value) == [SEGMENTED]):
            continue
        if value is True:
            words.append(flag)
        elif isinstance(value, tuple | list):
            words += [flag, *map(str, value)] if value else []
        elif value is not None and value is not False and name != "processes":
            words += [flag, str(value)]
    return shlex.join(words)


def _conditions(row: Row) -> list[str]:
    condition = row.condition
    method = "**tdf_jax**" if condition.method == LIBRARY else condition.method
    poses = condition.poses + ", meshes" * (condition.objects == MESHES)
    return [condition.target, poses, condition.inputs, str(condition.demonstrations), method]


def _rates(rows: Sequence[Row]) -> str:
    """The table of one task and mode."""
    hung = rows[0].condition.task == "mug_on_rack"
    systems = [
        name for name in PAPERS if any(one.system == name for row in rows for one in peers_of(row.condition))
    ]  # fmt: skip
    heads = [*CONDITIONS, "episodes", "grasp", "place", "overall"]
    heads += ["overall, hung by the handle"] * hung + [_theirs(name) for name in systems]
    names = ("grasp", "place", "overall", "strict") if hung else ("grasp", "place", "overall")
    cells = []
    for row in rows:
        peers = peers_of(row.condition) if row.condition.method == LIBRARY else []
        cells.append(
            [
                *_conditions(row),
                str(len(row.runs)),
                *(percent(row.rates[name][0]) + between(row.rates[name][1]) for name in names),
                *(_peer([one for one in peers if one.system == name]) for name in systems),
            ]
        )
    return markdown(heads, cells)


def _theirs(system: str) -> str:
    return f"{system}: {'grasp / place / overall' if system == 'NDF' else 'place' if system == 'R-NDF' else 'overall'}"


def _peer(rows: Sequence[Published]) -> str:
    """Published rates in a cell: those with ten demonstrations, then those with one."""
    cells = []
    for row in rows:
        shares = [one for one in (row.grasp, row.place, row.overall) if one is not None]
        rates = " / ".join(f"{100 * one:g}" for one in shares) + " %"
        cells.append(rates if row.demonstrations > 1 else f"(one: {'overall ' * (row.system == 'NDF')}{rates})")
    return " ".join(cells)


def _criteria(rows: Sequence[Row]) -> str:
    cells = []
    for row in rows:
        found = report.criteria(row.all)
        shares = [percent(found[name][0]) + between(found[name][1]) if name in found else "" for name in CRITERIA]
        cells.append([_words(row.condition.task), row.condition.mode, *_conditions(row), *shares])
    heads = ["task", "mode", *CONDITIONS, *(report.WORDS[name] for name in CRITERIA)]
    return (
        "How often each criterion of the place holds by itself, whatever the others say; an episode in which nothing "
        "moved fulfils none. An empty cell is a criterion that the mode or the object does not have.\n\n"
        + markdown(heads, cells)
    )


def _failures(rows: Sequence[Row]) -> str:
    cells = []
    for row in rows:
        moved, (rejected, redrawn) = row.in_hand_motion(), row.rejections()
        causes = ", ".join(f"{cause} {count}" for cause, count in row.causes.items())
        cells.append(
            [
                _words(row.condition.task),
                row.condition.mode,
                *_conditions(row),
                f"{sum(row.causes.values())} of {len(row.runs)}",
                causes,
                "" if moved is None else f"{1e3 * moved[0]:.1f} mm, {moved[1]:.1f}°",
                str(rejected),
                str(redrawn),
            ]
        )
    heads = ["task", "mode", *CONDITIONS, "failed", "causes", "moved in the hand", "starts rejected", "pairs rejected"]
    return (
        "Each failed episode has one cause ([what they mean](../guide/simulation.md#causes-of-failure)); a mug that "
        "hangs, but not by its handle, is among them. The movement in the hand after closing is a median over all "
        "episodes with a grasp. Starts out of reach were drawn again before any method ran, and so were pairs that do "
        "not fit or of which no start is within reach: objects that the arm reaches from few starts are rarer here "
        "than they are.\n\n" + markdown(heads, cells)
    )


def _times(rows: Sequence[Row], settings: Mapping[str, Any]) -> str:
    cells = []
    for row in rows:
        seconds = row.seconds()
        total = float(seconds.sum())
        cells.append(
            [
                _words(row.condition.task),
                row.condition.mode,
                *_conditions(row),
                *(_number(float(np.median(part)) if len(part) else np.nan) for part in seconds.T),
                _number(total / 60),
            ]
        )
    about = machine()
    versions = ", ".join(f"{name} {about[name]}" for name in ("jax", "mujoco", "mink"))
    processes = settings.get("processes")
    shares = ""
    # Both modes share what is imitated.
    shared = {row.condition._replace(mode="", mass=0.0): row.seconds()[:, 0] for row in rows}
    spent = np.concatenate([row.seconds() for row in rows]).sum(axis=0)
    spent[0] = np.concatenate([*shared.values()]).sum()
    if spent.sum() > 0:
        parts = ", ".join(f"{name} {percent(float(one / spent.sum()))}" for name, one in zip(report.PARTS, spent))
        shares = f" Of all the time known here, with each imitation counted once: {parts}."
    heads = ["task", "mode", *CONDITIONS, *report.PARTS, "all episodes, minutes"]
    return (
        "Median seconds of an episode in its process, compilation included where an episode compiles: imitation "
        "(clouds, pick, goal), which both modes of an episode share, planning of the arm's motion, which teleport does "
        "not need, and physics. The last column is the sum over all episodes, which several processes share. "
        f"{about['cores']} cores, {versions}, "
        f"{'a process for each core' if processes is None else f'processes: {processes}'}; times of earlier runs in "
        f"the same folder are theirs.{shares}\n\n" + markdown(heads, cells)
    )


def _number(value: float) -> str:
    return f"{value:.1f}" if np.isfinite(value) else "unknown"


def _words(task: str) -> str:
    return task.replace("_", " ")
