"""The page of `tdf benchmark --simulation`: rows of many campaigns beside published ones, and their record."""

import os
import shlex
from collections.abc import Mapping, Sequence
from importlib.metadata import version
from typing import Any

import numpy as np
from jaxtyping import Float

from tdf_jax._internal import checks
from tdf_jax._internal.errors import InputError
from tdf_jax.evaluation.statistics import bootstrap_interval
from tdf_jax.evaluation.tables import between, markdown, percent
from tdf_jax.sim import report
from tdf_jax.sim.campaign import Run
from tdf_jax.sim.condition import DEMONSTRATIONS, GENERATED, LIBRARY, MESHES, SEGMENTED, TRUTH, Condition, Settings
from tdf_jax.sim.episode import CRITERIA
from tdf_jax.sim.physics import LIGHT_MASS
from tdf_jax.sim.published import PAPERS, Published, peers_of
from tdf_jax.sim.tasks import TASKS

SCHEMA = 1  # raised when a key changes its name or its meaning
# Targets of each task as the published protocols have them: NDF's stay where they were shown, R-NDF's are found.
TARGETS = {
    "mug_on_rack": ("known", "found"),
    "bowl_on_shelf": ("known",),
    "bottle_on_shelf": ("known",),
    "bowl_on_mug": ("found",),
    "bottle_in_container": ("found",),
}
FEW = 30  # episodes, below which a row shows little
# What the reading compares: a field of the condition, and the values before and after the change, in words.
CHANGES = (
    ("mode", "teleport", "execute", "Executed instead of teleported"),
    ("poses", "upright", "tilt60", "Starts tilted by up to 60 degrees instead of upright"),
    ("poses", "upright", "uniform", "Starts in any orientation instead of upright"),
    ("target", "known", "found", "A target that is found instead of a known one"),
    ("clouds", "full", "views3", "Clouds of three cameras instead of complete ones"),
    ("clouds", "full", "views1", "Clouds of one camera instead of complete ones"),
    ("mask", "simulator", "segmented", "Our own segmentation instead of the simulator's mask"),
    ("demonstrations", 1, 10, "Ten demonstrations instead of one"),
)
SAME_EPISODES = ("mode", "clouds", "mask", "demonstrations")  # fields that change neither objects nor starts
CONDITIONS = ("target", "poses", "clouds", "shown", "method")  # columns that say what a row is measured under


class Row:
    """A campaign that has run.

    Attributes:
        settings: what its episodes share.
        runs: the episodes that were drawn.
        condition: what they are measured under.
        not_drawn: what could not be drawn, and why, in words.
    """

    def __init__(self, settings: Settings, runs: Sequence[Run]):
        """Keep both.

        Args:
            settings: what the episodes share.
            runs: the episodes, at least one.
        """
        self.settings, self.condition = settings, settings.condition
        self.all, self.runs = list(runs), [one for one in runs if one.outcome.drawn]
        self.not_drawn = report.not_drawn(runs)
        self.rates = report.rates(self.runs)
        self.causes = report.causes(self.runs)

    def values(self, rate: str) -> dict[int, tuple[float, tuple[str, str | int]]]:
        """What each episode has in a rate, 0 or 1, and its object, by the number of the episode."""
        task = self.condition.task
        return {one.number: (float(getattr(one.outcome, rate)), (task, one.object)) for one in self.runs}

    def likely(self, rate: str) -> tuple[float, float]:
        """Interval of a rate; where all episodes are alike the bootstrap has no width, and the rule of three counts."""
        share, interval = self.rates[rate]
        if share is None:
            return 0.0, 1.0
        low, high = interval or (share, share)
        if low == high:
            reach = 3 / len(
                {one.object for one in self.runs}
            )  # of n successes, a rate below 1 - 3 / n is unlikely (5 %)
            low, high = max(low - reach, 0.0), min(high + reach, 1.0)
        return low, high

    def moved(self) -> tuple[float, float] | None:
        """Median movement in the hand after closing, metres and degrees; None if nothing was held."""
        moved = np.array([(one.outcome.slip, one.outcome.turn) for one in self.runs], float).reshape(-1, 2)
        moved = moved[np.isfinite(moved).all(axis=1)]
        if not len(moved):
            return None
        slip, turn = np.median(moved, axis=0)
        return float(slip), float(turn)

    def drawn(self) -> tuple[int, int]:
        """Numbers of starts out of reach and of pairs that do not fit, drawn before the episodes."""
        return sum(one.rejected for one in self.all), sum(one.redrawn for one in self.all)

    def seconds(self) -> Float[np.ndarray, "episodes 3"]:
        """Wall times of `tdf_jax.sim.report.PARTS`, (episodes, 3), seconds; NaN where one is not known."""
        return report.seconds(self.runs)


def planned_rows(
    tasks: Sequence[str],
    modes: Sequence[str],
    targets: Sequence[str] | None,
    poses: Sequence[str],
    clouds: Sequence[str],
    methods: Sequence[str],
    demonstrations: Sequence[int],
    light: bool,
    objects: Sequence[str] = (GENERATED,),
    masks: Sequence[str] = (SEGMENTED,),
) -> list[Condition]:
    """All combinations that can be measured.

    A shelf is always known, and ten demonstrations are the library's, of targets that are found.

    Args:
        tasks: names of `tdf_jax.sim.tasks.TASKS`.
        modes: "execute" and "teleport".
        targets: "known" and "found"; None for those of the published protocols, `TARGETS`.
        poses: how objects start.
        clouds: "full", or what three cameras or one see.
        methods: names of `tdf_jax.sim.condition.METHODS`.
        demonstrations: numbers of demonstrations, 1 and 10.
        light: whether teleported objects have the mass of those in NDF and R-NDF; executed ones never do.
        objects: names of `tdf_jax.sim.condition.OBJECTS`.
        masks: names of `tdf_jax.sim.condition.MASKS`, for clouds of cameras.

    Raises:
        InputError: an argument is empty, or one of its values is in no combination.
    """
    function = "tdf benchmark --simulation"
    given = {
        "tasks": tasks, "modes": modes, "pose": poses, "clouds": clouds, "methods": methods,
        "demonstrations": demonstrations,
    }  # fmt: skip
    for flag, values in given.items():
        if not values:
            raise InputError(f"{function}: --{flag} is empty; expected at least one")
    if targets is not None and not targets:
        raise InputError(f"{function}: --targets is empty; expected at least one")
    for count in demonstrations:
        checks.choice(function, "--demonstrations", count, (1, DEMONSTRATIONS))
    rows = [
        Condition(
            task,
            target,
            start,
            mode,
            cloud,
            count,
            method,
            LIGHT_MASS if light and mode == "teleport" else 0.0,
            kind,
            mask,
        )
        for task in dict.fromkeys(tasks)
        for mode in dict.fromkeys(modes)
        for kind in dict.fromkeys(objects)
        for target in dict.fromkeys(targets or TARGETS[task])
        for cloud in dict.fromkeys(clouds)
        for mask in (dict.fromkeys(masks) if cloud != "full" else (SEGMENTED,))
        for start in dict.fromkeys(poses)
        for count in dict.fromkeys(demonstrations)
        for method in dict.fromkeys(methods)
        if not (target == "found" and TASKS[task].target == "board")
        and not (count > 1 and (target == "known" or method != LIBRARY))
    ]
    for flag, field, values in (
        ("demonstrations", "demonstrations", demonstrations),
        ("targets", "target", targets or ()),
        ("methods", "method", methods),
        ("tasks", "task", tasks),
        ("masks", "mask", masks),
    ):
        for value in values:
            if value not in {getattr(row, field) for row in rows}:
                raise InputError(
                    f"{function}: --{flag} has {value!r}, for which there is no row with the other options; expected "
                    "--targets known for shelves, --demonstrations 10 for tdf_jax with --targets found only, and "
                    "--masks with --clouds of cameras"
                )
    return rows


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
        moved, (rejected, redrawn) = row.moved(), row.drawn()
        one["number_of_episodes"] = len(row.runs)
        one["rejected"], one["redrawn"] = rejected, redrawn
        one["moved_in_hand_median"] = None if moved is None else {"metres": moved[0], "degrees": moved[1]}
        one["published"] = [other._asdict() for other in peers_of(row.condition)]
        made.append(one)
    return {
        "schema": SCHEMA,
        "tdf_jax": version("tdf_jax"),
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


def reading(rows: Sequence[Row]) -> list[str]:
    """What the rows show together, in sentences that are computed from them.

    Args:
        rows: all campaigns.
    """
    ours = [row for row in rows if row.condition.method == LIBRARY]
    lines = [*_against_published(ours)]
    for field, before, after, words in CHANGES:
        pairs = _pairs(ours, field, before, after)
        if pairs:
            masses = {(one.condition.mass, other.condition.mass) for one, other in pairs}
            also = ", and objects of their natural mass" if any(a and not b for a, b in masses) else ""
            lines.append(f"- {words}{also}: overall success {_difference(pairs, field in SAME_EPISODES)}.")
    methods = dict.fromkeys(row.condition.method for row in rows if row.condition.method != LIBRARY)
    for method in methods:
        pairs = _pairs(rows, "method", method, LIBRARY)
        if pairs and method == TRUTH:
            lines.append(
                f"- The library instead of the true pick and release: overall success {_difference(pairs)}. What the "
                "truth misses too is lost by the robot, its planner and the physics, not by the imitation."
            )
        elif pairs:
            lines.append(f"- The library instead of {method}: overall success {_difference(pairs)}.")
    for mode, words in (("teleport", "teleported"), ("execute", "executed")):
        mine = [row for row in ours if row.condition.mode == mode]
        failed = {}
        for row in mine:
            for cause, count in row.causes.items():
                failed[cause] = failed.get(cause, 0) + count
        if failed:
            most = sorted(failed.items(), key=lambda one: (-one[1], one[0]))
            listed = ", ".join(f"{cause} {count}" for cause, count in most)
            total = sum(len(row.runs) for row in mine)
            lines.append(f"- Causes of failure in {total} {words} episodes of the library: {listed}.")
    lines += [f"- Not drawn, and not counted: {words}." for row in rows for words in row.not_drawn]
    few = min(len(row.runs) for row in rows)
    if few < FEW:
        lines.append(f"- Rows of {few} episodes show that the command works, and little else.")
    general = (
        "Teleport tests the grasp and the placement apart, and nothing moves between them. An executed episode also "
        "needs a posture of the arm at both ends, a way without collision, and an object that does not move in the "
        "hand. Every drawn episode counts, also one for which no motion is found."
    )
    return [general, "\n".join(lines)] if lines else [general]


def _against_published(ours: Sequence[Row]) -> list[str]:
    """How many rows of the library have their published peers below, in or above their intervals."""
    lines = []
    for system in PAPERS:
        counts = {"below": 0, "in": 0, "above": 0}
        for row in ours:
            if row.condition.objects != GENERATED or not row.runs:
                continue
            name = "place" if system == "R-NDF" else "overall"
            peers = [one for one in peers_of(row.condition) if one.system == system]
            theirs = getattr(max(peers, key=lambda one: one.demonstrations), name) if peers else None
            if theirs is not None:
                low, high = row.likely(name)
                counts["below" if theirs < low else "above" if theirs > high else "in"] += 1
        total = sum(counts.values())
        if total:
            what = "place" if system == "R-NDF" else "overall"
            lines.append(
                f"- {system}, {what}: the published rate is below our interval in {counts['below']}, in it in "
                f"{counts['in']} and above it in {counts['above']} of {total} rows. Same protocol, other objects."
            )
    return lines


def _pairs(rows: Sequence[Row], field: str, before: Any, after: Any) -> list[tuple[Row, Row]]:
    """Pairs of rows that differ in one field; executed objects are never light, so masses may differ with the mode."""

    def key(row):
        other = row.condition._asdict()
        other.pop(field)
        if field == "mode":
            other.pop("mass")
        return tuple(other.items())

    first = {key(row): row for row in rows if getattr(row.condition, field) == before}
    pairs = [(first[key(row)], row) for row in rows if getattr(row.condition, field) == after and key(row) in first]
    return [
        (one, other) for one, other in pairs if {run.number for run in one.runs} & {run.number for run in other.runs}
    ]


def _difference(pairs: Sequence[tuple[Row, Row]], same: bool = True) -> str:
    """The change of the overall rate from the first to the second of each pair, in points, paired by numbers.

    Args:
        pairs: rows before and after.
        same: whether episodes of one number have the same objects and starts in both.
    """
    changes, objects = [], []
    for before, after in pairs:
        first, second = before.values("overall"), after.values("overall")
        for number, (value, one) in first.items():
            if number in second:
                changes.append(second[number][0] - value)
                objects.append(one)
    mean, interval = float(np.mean(changes)), bootstrap_interval(np.array(changes), objects)
    points = f"{abs(100 * mean):.0f}"
    words = (
        f"is {'higher' if mean > 0 else 'lower'} by {points} point{'s' * (points != '1')}" if mean else "is the same"
    )
    span = "" if interval is None else f", 95 % interval {100 * interval[0]:+.0f} to {100 * interval[1]:+.0f}"
    count = len(pairs)
    return f"{words}{span} ({count} pair{'s' * (count > 1)} of rows{', the same episodes' * same})"


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
        moved, (rejected, redrawn) = row.moved(), row.drawn()
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
        "episodes with a grasp. Starts out of reach and pairs that do not fit were drawn again before any method "
        "ran.\n\n" + markdown(heads, cells)
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
    spent = np.nansum(np.concatenate([row.seconds() for row in rows]), axis=0)
    if spent.sum() > 0:
        parts = ", ".join(f"{name} {percent(float(one / spent.sum()))}" for name, one in zip(report.PARTS, spent))
        shares = f" Of all the time known here: {parts}."
    heads = ["task", "mode", *CONDITIONS, *report.PARTS, "all episodes, minutes"]
    return (
        "Median seconds of an episode in its process, compilation included where an episode compiles: imitation "
        "(clouds, pick, goal), planning of the arm's motion, which teleport does not need, and physics. The last "
        "column is the sum over all episodes, which several processes share. "
        f"{about['cores']} cores, {versions}, "
        f"{'a process for each core' if processes is None else f'processes: {processes}'}; times of earlier runs in "
        f"the same folder are theirs.{shares}\n\n" + markdown(heads, cells)
    )


def _number(value: float) -> str:
    return f"{value:.1f}" if np.isfinite(value) else "unknown"


def _words(task: str) -> str:
    return task.replace("_", " ")
