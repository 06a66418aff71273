"""The report of `tdf benchmark`: a page of Markdown, and a record of every number."""

import dataclasses
import shlex
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import jax
import numpy as np

from tdf_jax.evaluation.demonstration_count import CountErrors
from tdf_jax.evaluation.path_failures import failures, page_name
from tdf_jax.evaluation.path_methods import EVERY, LIBRARY, MANY, NEAR
from tdf_jax.evaluation.path_scores import Score, by_method, summary
from tdf_jax.evaluation.path_tasks import DISPLACEMENTS, NUM_POSES
from tdf_jax.evaluation.records import header
from tdf_jax.evaluation.statistics import SUCCESS, THRESHOLDS, bootstrap_interval
from tdf_jax.evaluation.tables import between, markdown, percent
from tdf_jax.geometry.paths import PATHS
from tdf_jax.networks.model import Model
from tdf_jax.uncertainty.calibration import FITTED_ON, bins, calibration_error, ranking

PICTURES = {
    "truth": "truth.png",
    "errors": "errors.png",
    "reliability": "reliability.png",
    "demonstrations": "demonstrations.png",
}
# Thresholds that the tables show; the record has all of them. Baselines reach no finer one.
SHOWN = {name: THRESHOLDS[name] for name in ("1cm_10deg", "2cm_20deg", "5cm_30deg")}
HEADS = [threshold.label("°") for threshold in SHOWN.values()]
LISTED = 12  # number of failures that the page lists
FAILURES = "runs/failures"  # folder of their pages, beside the page


def page(scores: Sequence[Score], model: Model, settings: Mapping[str, Any], extras: Mapping[str, Any]) -> str:
    """Render the page.

    Args:
        scores: scores of all methods on all tasks.
        model: the network.
        settings: settings of the command.
        extras: further sections, see `sections`.
    """
    conditions: dict[str, list[Score]] = {}
    for one in scores:
        conditions.setdefault(one.clouds, []).append(one)
    parts = ["# Benchmark", _setup(scores, model, settings), f"![True trajectories of six tasks]({PICTURES['truth']})"]
    for number, (clouds, several) in enumerate(conditions.items()):
        groups = by_method(several)
        parts += [
            f"## Clouds: {clouds}",
            _picks(groups),
            _paths(groups),
            _split(groups, "displacement", DISPLACEMENTS),
        ]
        if number == 0:
            parts += [_split(groups, "path", PATHS), f"![Errors of picks and paths]({PICTURES['errors']})"]
    parts += [_failures(scores, settings["page"])]
    if "reliability" in extras:
        parts += [_reliability(extras["reliability"])]
    if "demonstrations" in extras:
        parts += [_demonstrations(extras["demonstrations"])]
    return "\n\n".join(part for part in parts if part) + "\n"


def record(
    scores: Sequence[Score], model: Model, settings: Mapping[str, Any], extras: Mapping[str, Any]
) -> dict[str, Any]:
    """Every number, those of each task included, as JSON has them.

    Args:
        scores: scores of all methods on all tasks.
        model: the network.
        settings: settings of the command.
        extras: further sections, see `sections`.
    """
    rows = [
        {"clouds": clouds, "method": method, **summary(several)}
        for clouds in dict.fromkeys(one.clouds for one in scores)
        for method, several in by_method([one for one in scores if one.clouds == clouds]).items()
    ]
    tasks = [_rounded(dataclasses.asdict(one)) for one in scores]
    return header(settings, model) | {"rows": rows, **extras, "tasks": tasks}


def sections(scores: Sequence[Score], picks: Sequence[CountErrors]) -> dict[str, Any]:
    """The data of the page's optional sections, as JSON has it.

    Args:
        scores: scores of all methods on all tasks; those with a confidence make the section "reliability".
        picks: errors against the number of demonstrations; they make the section "demonstrations".
    """
    extras: dict[str, Any] = {}
    confident = [(one.confidence, one.succeeds(SUCCESS)) for one in scores if one.confidence is not None]
    if confident:
        predicted, right = np.array(confident, float).T
        rows = bins(predicted, right)
        extras["reliability"] = {
            "picks": len(confident),
            "bins": rows,
            "calibration_error": calibration_error(rows),
            "ranking": ranking(predicted, right),
        }
    if picks:
        extras["demonstrations"] = [dataclasses.asdict(one) for one in picks]
    return extras


def _rounded(value):
    """Numbers to a micrometre and a millionth of a degree."""
    if isinstance(value, dict):
        return {name: _rounded(one) for name, one in value.items()}
    if isinstance(value, list | tuple):
        return [_rounded(one) for one in value]
    return round(value, 6) if isinstance(value, float) else value


def _setup(scores, model, settings) -> str:
    objects = len({one.instance for one in scores})
    return (
        f"`{_command(settings)}`: {objects} objects, weights `{model.info.name}`, {settings['num_starts']} starts of "
        "ICP and of Adam (NDF, random weights, l_p). `tdf_jax` and the solver of *TDF* begin with 64 starts and 16 "
        f"query points; the variants of ICP and NDF with {MANY} starts take more time. A task is a trajectory of "
        f"{NUM_POSES} poses, demonstrated at the handle of one mug, to be imitated on another mug in a uniform random "
        "pose, with a goal. Tasks take six paths in turn, and each path takes four goals in turn: the last pose of the "
        "demonstration, moved with the centroid; the same, moved by 10 or 30 cm in a random direction; or a pose as "
        "far behind the demonstrated pick as that pose lies ahead of it. The ground truth picks the same place on the "
        "other mug; from there to the goal, the demonstration is warped by an even interpolation of the motions of "
        "both ends. "
        "The warp is a definition: methods that estimate one motion of the object (PCA, ICP, random weights, the "
        "oracle, *carried*, `tdf_jax`) use the same formula, so their path errors follow from their pick errors. "
        f"Variants run on every {EVERY}th task.\n\n"
        "Success is that of the pick of the start that the method itself selects; *best* is that of the start, or of "
        "the solver's candidate, that is nearest to the ground truth, which no method knows. Intervals are 95 % "
        "bootstrap intervals over objects. "
        f"Seconds are medians of one imitation on {jax.default_backend()}, encoding included; other processes may have "
        "run at the same time."
    )


def _command(settings) -> str:
    """The command line that has these settings."""
    words = ["tdf", "benchmark"]
    for name, value in settings.items():
        if value is False or value in (None, (), ("all",)) or (name == "num_poses" and not settings["meshes"]):
            continue
        values = () if value is True else value if isinstance(value, tuple) else (value,)
        words += [f"--{name.replace('_', '-')}", *map(str, values)]
    return shlex.join(words)


def _picks(groups: Mapping[str, list[Score]]) -> str:
    heads = ["method", "tasks", "pick, cm: median / 90 %", "degrees: median / 90 %", "flips", *HEADS]
    rows = []
    for method, several in groups.items():
        row = summary(several)
        rows.append(
            [
                _name(method),
                str(row["tasks"]),
                f"{row['pick_median_cm']:.2f} / {row['pick_p90_cm']:.2f}",
                f"{row['pick_median_deg']:.1f} / {row['pick_p90_deg']:.1f}",
                str(row["flips"]),
                *(percent(row[f"success_{name}"]) + between(row[f"interval_{name}"]) for name in SHOWN),
                f"{percent(row['oracle_1cm_10deg'])} of {several[0].starts}",
                f"{row['seconds_median']:.2g}",
            ]
        )
    return "Picks:\n\n" + markdown([*heads, "best, 1 cm, 10°", "seconds"], rows)


def _paths(groups: Mapping[str, list[Score]]) -> str:
    heads = ["method", "path, cm: median / 90 %", "best", "waypoints, cm: median / 90 %", "degrees: median / 90 %"]
    heads += ["Fréchet, cm", "jerk / true", "longest step / mean", "penetration"]
    rows = []
    for method, several in groups.items():
        row = summary(several)
        interval = between(row["interval_path_median_cm"], 1, 2)
        rows.append(
            [
                _name(method),
                f"{row['path_median_cm']:.2f}{interval} / {row['path_p90_cm']:.2f}",
                f"{row['oracle_path_median_cm']:.2f}",
                f"{row['waypoint_median_cm']:.2f} / {row['waypoint_p90_cm']:.2f}",
                f"{row['waypoint_median_deg']:.1f} / {row['waypoint_p90_deg']:.1f}",
                f"{row['frechet_median_cm']:.2f}",
                f"{row['jerk_median']:.2f}",
                f"{row['longest_step_median']:.2f}",
                "n/a" if row["penetration_mean"] is None else f"{100 * row['penetration_mean']:+.1f} %",
            ]
        )
    step = summary(next(iter(groups.values())))["expected_step_median"]
    words = (
        "Paths, without the goal, which is given. Path: mean distance of a task's waypoints from the true ones. Jerk: "
        "that of the path over that of the true path (at least 0.1 mm). The longest step of a true path is "
        f"{step:.2f} times its mean step. Penetration: share of the query points inside the solid, minus that of the "
        "true path."
    )
    return words + "\n\n" + markdown(heads, rows)


def _split(groups: Mapping[str, list[Score]], by: str, values: Iterable[str]) -> str:
    """Median path errors, separately for the values of an attribute of tasks."""
    rows = []
    for method, several in groups.items():
        cells = []
        for value in values:
            chosen = [one for one in several if getattr(one, by) == value]
            errors = 100 * np.array([one.path_error for one in chosen])
            if not chosen:
                cells.append("n/a")
                continue
            interval = bootstrap_interval(errors, [one.instance for one in chosen], "median")
            cells.append(f"{np.median(errors):.2f}{between(interval, 1, 2)}")
        rows.append([_name(method), *cells])
    heads = ["method", *(value.replace("_", " ") for value in values)]
    return f"Path error, cm, median, by {by}:\n\n" + markdown(heads, rows)


def _failures(scores: Sequence[Score], pages: bool) -> str:
    ours, failed = [one for one in scores if one.method == LIBRARY], failures(scores)
    words = f"## Failures\n\nOf {len(ours)} picks of `{LIBRARY}`, {len(failed)} are off by more than 2 cm or 20°"
    if not failed:
        return words + "."
    within = sum(one.best_succeeds(SUCCESS) for one in failed)
    heads = ["object", "cloud", "path", "pick, cm", "degrees", "best, cm", "degrees", *["page"] * pages]
    rows = [
        [
            one.instance,
            one.clouds,
            one.path.replace("_", " "),
            f"{100 * one.distances[0]:.1f}",
            f"{one.angles[0]:.0f}",
            f"{100 * one.best_pick[0]:.1f}",
            f"{one.best_pick[1]:.0f}",
            *[f"[task {one.task}]({FAILURES}/{page_name(one)})"] * pages,
        ]
        for one in failed[:LISTED]
    ]
    counted = f" The {LISTED} with the largest rotation errors:" if len(failed) > LISTED else ""
    return f"{words}; for {within} of them, another candidate is within both bounds.{counted}\n\n" + markdown(
        heads, rows
    )


def _reliability(reliability: Mapping[str, Any]) -> str:
    heads = ["confidence, mean of a bin", "picks", "within 2 cm and 20°", "95 % interval"]
    rows = [
        [
            f"{one['predicted']:.3f}",
            str(one["picks"]),
            f"{one['right']:.3f}",
            "{:.2f} to {:.2f}".format(*one["interval"]),
        ]
        for one in reliability["bins"]
    ]
    order = (
        ""
        if reliability["ranking"] is None
        else f" In {percent(reliability['ranking'])} of all pairs of a right and a wrong pick, the right one has the "
        "higher confidence."
    )
    words = (
        f"`result.confidence` of the {reliability['picks']} picks of `{LIBRARY}`, all clouds, in bins. "
        f"The curve was fitted on picks of seed {FITTED_ON}. The mean difference of the confidence and the share of "
        f"right picks is {reliability['calibration_error']:.3f}.{order}"
    )
    picture = f"![Reliability]({PICTURES['reliability']})"
    return "\n\n".join(["## Confidence", words, picture, markdown(heads, rows)])


def _demonstrations(counts: Sequence[Mapping[str, Any]]) -> str:
    heads = ["clouds", "demonstrations", "by", "picks", "cm: median / 90 %", "degrees: median / 90 %", *HEADS]
    rows = []
    for one in counts:
        distance, angle = np.array(one["distances"]), np.array(one["angles"])
        rows.append(
            [
                one["clouds"],
                str(one["count"]),
                one["way"],
                str(len(distance)),
                f"{100 * np.median(distance):.2f} / {100 * np.percentile(distance, 90):.2f}",
                f"{np.median(angle):.1f} / {np.percentile(angle, 90):.1f}",
                *(percent(float(threshold.holds(distance, angle).mean())) for threshold in SHOWN.values()),
            ]
        )
    return (
        "## Several demonstrations\n\nPicks on the targets of every fifth task, from demonstrations at the handles of "
        f"several other mugs.\n\n![Success against the number of demonstrations]({PICTURES['demonstrations']})\n\n"
        + markdown(heads, rows)
    )


def _name(method: str) -> str:
    if method == LIBRARY:
        return f"**{method}**"
    return f"{method} (within {100 * NEAR:.0f} cm)" if method.startswith("oracle") else method
