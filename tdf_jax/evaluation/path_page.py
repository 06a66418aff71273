"""The benchmark told: one page of Markdown, and every number for machines."""

import dataclasses
import shlex
from collections.abc import Iterable, Mapping, Sequence
from importlib.metadata import version
from typing import Any

import jax
import numpy as np

from tdf_jax.evaluation import path_tasks as tasks
from tdf_jax.evaluation.demonstration_count import Learnt
from tdf_jax.evaluation.methods import EVERY, LIBRARY, NEAR
from tdf_jax.evaluation.path_scores import MISSED, THRESHOLDS, Score, by_method, interval, summarised
from tdf_jax.networks.model import Model
from tdf_jax.uncertainty.calibration import FITTED_ON, bins, calibration_error, ranking

PICTURES = {
    "truth": "truth.png",
    "errors": "errors.png",
    "reliability": "reliability.png",
    "demonstrations": "demonstrations.png",
}
SCHEMA = 1  # raised when a field of the file changes its meaning or goes
WORDS = {"1cm_10deg": "1 cm, 10°", "2cm_20deg": "2 cm, 20°", "5cm_30deg": "5 cm, 30°"}
LISTED = 12  # failures that are told one by one


def page(scores: Sequence[Score], model: Model, settings: Mapping[str, Any], extras: Mapping[str, Any]) -> str:
    """The page.

    Args:
        scores: of all methods on all tasks.
        model: the network.
        settings: of the command.
        extras: of `sections`.
    """
    conditions = {
        clouds: [one for one in scores if one.clouds == clouds]
        for clouds in dict.fromkeys(one.clouds for one in scores)
    }
    parts = ["# Benchmark", _told(scores, model, settings), f"![True trajectories of six tasks]({PICTURES['truth']})"]
    for number, (clouds, several) in enumerate(conditions.items()):
        groups = by_method(several)
        parts += [
            f"## Clouds: {clouds}",
            _picks(groups),
            _paths(groups),
            _split(groups, "displacement", tasks.DISPLACEMENTS),
        ]
        if number == 0:
            parts += [_split(groups, "path", tasks.PATHS), f"![Errors of picks and paths]({PICTURES['errors']})"]
    parts += [_failures(scores)]
    if "reliability" in extras:
        parts += [_reliability(extras["reliability"])]
    if "demonstrations" in extras:
        parts += [_demonstrations(extras["demonstrations"])]
    return "\n\n".join(part for part in parts if part) + "\n"


def record(scores: Sequence[Score], model: Model, settings: Mapping[str, Any], extras: Mapping[str, Any]) -> dict:
    """Every number, those of each task included, as JSON has them."""
    rows = [
        {"clouds": clouds, "method": method, **summarised(several)}
        for clouds in dict.fromkeys(one.clouds for one in scores)
        for method, several in by_method([one for one in scores if one.clouds == clouds]).items()
    ]
    return {
        "schema": SCHEMA,
        "tdf_jax": version("tdf_jax"),
        "settings": dict(settings),
        "weights": {"name": model.info.name, "source": model.info.source},
        "machine": {"jax": jax.__version__, "backend": jax.default_backend()},
        "rows": rows,
        **extras,
        "tasks": [_rounded(dataclasses.asdict(one)) for one in scores],
    }


def _rounded(value):
    """Numbers to a micrometre and a millionth of a degree."""
    if isinstance(value, dict):
        return {name: _rounded(one) for name, one in value.items()}
    if isinstance(value, list | tuple):
        return [_rounded(one) for one in value]
    return round(value, 6) if isinstance(value, float) else value


def sections(scores: Sequence[Score], picks: Sequence[Learnt]) -> dict[str, Any]:
    """What the page tells beside the methods' tables, as JSON has it: confidences, where a method has them, and several demonstrations, where there were any."""
    extras: dict[str, Any] = {}
    sure = [one for one in scores if one.confidence is not None]
    if sure:
        predicted = np.array([one.confidence for one in sure])
        right = np.array([one.succeeds(*MISSED) for one in sure], float)
        rows = bins(predicted, right)
        extras["reliability"] = {
            "picks": len(sure),
            "bins": rows,
            "calibration_error": calibration_error(rows),
            "ranking": ranking(predicted, right),
        }
    if picks:
        extras["demonstrations"] = [dataclasses.asdict(one) for one in picks]
    return extras


def markdown(heads: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """A table."""
    lines = [heads, ["---"] * len(heads), *rows]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def _told(scores, model, settings) -> str:
    objects = len({one.instance for one in scores})
    options = {
        name: value
        for name, value in settings.items()
        if value not in (None, (), ("all",)) and (name != "poses" or settings["meshes"])
    }
    words = [
        word
        for name, value in options.items()
        for word in (f"--{name}", *(value if isinstance(value, tuple) else (value,)))
    ]
    command = shlex.join(["tdf", "benchmark", *map(str, words)])
    return (
        f"`{command}`: {objects} objects, weights `{model.info.name}`, {settings['inits']} starts of ICP and of Adam (NDF, random weights, l_p). `tdf_jax` and the solver of *TDF* scout from 64 starts with 16 query points; variants of ICP and NDF take "
        f"as many, in more time. A task is a trajectory of {tasks.POSES} poses shown at the handle of one mug and asked for on another in a uniform random pose, with a goal. Six paths take turns and, "
        "with each, four goals: the demonstration's last pose carried by the centroids, moved by 10 or 30 cm in a random direction, or put as far behind the demonstrated pick as it "
        "lay ahead. The truth has the same place on the other mug as its pick; from there to the goal the demonstration turns evenly with what lies between both motions. That part is a "
        "definition: methods that find one motion of the object (PCA, ICP, random weights, the oracle, *carried*, `tdf_jax`) carry by the same formula, and their path errors are their pick's, handed on. "
        f"Variants are tried on every {EVERY}th task.\n\n"
        "Success is of the pick of the start that the method itself chose; *best* is that of its start, or of the solver's candidate, nearest to the truth, which no method knows. Intervals are 95 % bootstrap intervals over objects. "
        f"Seconds are medians of one imitation on {jax.default_backend()}, encoding included; other work may have run beside it."
    )


def _picks(groups: Mapping[str, list[Score]]) -> str:
    heads = [
        "method",
        "tasks",
        "pick, cm: median / 90 %",
        "degrees: median / 90 %",
        "flips",
        *WORDS.values(),
        "best, 1 cm, 10°",
        "seconds",
    ]
    rows = []
    for method, several in groups.items():
        row = summarised(several)
        cells = [
            _name(method),
            str(row["tasks"]),
            f"{row['pick_median_cm']:.2f} / {row['pick_p90_cm']:.2f}",
            f"{row['pick_median_deg']:.1f} / {row['pick_p90_deg']:.1f}",
            str(row["flips"]),
        ]
        cells += [f"{100 * row[f'success_{name}']:.0f} %{_between(row[f'interval_{name}'], 100)}" for name in WORDS]
        rows.append(
            [*cells, f"{100 * row['oracle_1cm_10deg']:.0f} % of {several[0].starts}", f"{row['seconds_median']:.2g}"]
        )
    return "Picks:\n\n" + markdown(heads, rows)


def _paths(groups: Mapping[str, list[Score]]) -> str:
    heads = [
        "method", "path, cm: median / 90 %", "best", "waypoints, cm: median / 90 %", "degrees: median / 90 %", "Fréchet, cm", "jerk / true", "longest step / mean", "penetration",
    ]  # fmt: skip
    rows = []
    for method, several in groups.items():
        row = summarised(several)
        cells = [
            _name(method),
            f"{row['path_median_cm']:.2f}{_between(row['interval_path_median_cm'], 1, 2)} / {row['path_p90_cm']:.2f}",
            f"{row['oracle_path_median_cm']:.2f}",
        ]
        cells += [
            f"{row['waypoint_median_cm']:.2f} / {row['waypoint_p90_cm']:.2f}",
            f"{row['waypoint_median_deg']:.1f} / {row['waypoint_p90_deg']:.1f}",
        ]
        cells += [f"{row['frechet_median_cm']:.2f}", f"{row['jerk_median']:.2f}", f"{row['longest_step_median']:.2f}"]
        rows.append([*cells, "n/a" if row["penetration_mean"] is None else f"{100 * row['penetration_mean']:+.1f} %"])
    step = summarised(next(iter(groups.values())))["expected_step_median"]
    told = (
        "Paths, without the goal, which is given. Path: mean distance of a task's waypoints from the true ones. Jerk: over the true path's (at least 0.1 mm). "
        f"The longest step of a true path is {step:.2f} times its mean step. Penetration: share of query points in the clay beyond that of the true path."
    )
    return told + "\n\n" + markdown(heads, rows)


def _split(groups: Mapping[str, list[Score]], by: str, values: Iterable[str]) -> str:
    """Median path errors apart by what tasks differ in."""
    rows = []
    for method, several in groups.items():
        cells = []
        for value in values:
            chosen = [one for one in several if getattr(one, by) == value]
            errors = 100 * np.array([one.path_error for one in chosen])
            cells.append(
                f"{np.median(errors):.2f}{_between(interval(chosen, errors, np.median, 0), 1, 2)}" if chosen else "n/a"
            )
        rows.append([_name(method), *cells])
    return f"Path error, cm, median, by {by}:\n\n" + markdown(
        ["method", *(str(value).replace("_", " ") for value in values)], rows
    )


def _failures(scores: Sequence[Score]) -> str:
    ours = [one for one in scores if one.method == LIBRARY]
    failed = sorted((one for one in ours if not one.succeeds(*MISSED)), key=lambda one: -one.angles[0])
    told = f"## When it fails\n\nOf {len(ours)} picks of `{LIBRARY}`, {len(failed)} are off by more than 2 cm or 20°"
    if not failed:
        return told + "."
    known = sum(one.best_pick[0] <= MISSED[0] and one.best_pick[1] <= MISSED[1] for one in failed)
    heads = ["object", "cloud", "path", "pick, cm", "degrees", "best, cm", "degrees"]
    rows = [
        [
            one.instance,
            one.clouds,
            one.path.replace("_", " "),
            f"{100 * one.distances[0]:.1f}",
            f"{one.angles[0]:.0f}",
            f"{100 * one.best_pick[0]:.1f}",
            f"{one.best_pick[1]:.0f}",
        ]
        for one in failed[:LISTED]
    ]
    counted = f" The {LISTED} with the largest turns:" if len(failed) > LISTED else ""
    return f"{told}; in {known} of those another candidate was within.{counted}\n\n" + markdown(heads, rows)


def _reliability(found: Mapping[str, Any]) -> str:
    heads = ["confidence, mean of a bin", "picks", "within 2 cm and 20°", "95 % interval"]
    rows = [
        [
            f"{one['predicted']:.3f}",
            str(one["picks"]),
            f"{one['right']:.3f}",
            "{:.2f} to {:.2f}".format(*one["interval"]),
        ]
        for one in found["bins"]
    ]
    order = (
        ""
        if found["ranking"] is None
        else f" Of a right and a wrong pick the right one has the higher confidence in {100 * found['ranking']:.0f} % of pairs."
    )
    return (
        f"## Confidence\n\n`result.confidence` of the {found['picks']} picks of `{LIBRARY}`, all clouds, in bins. It was fitted on picks of seed {FITTED_ON}. "
        f"Mean difference of confidence and share: {found['calibration_error']:.3f}.{order}\n\n![Reliability]({PICTURES['reliability']})\n\n"
        + markdown(heads, rows)
    )


def _demonstrations(found: Sequence[Mapping[str, Any]]) -> str:
    heads = ["clouds", "demonstrations", "by", "picks", "cm: median / 90 %", "degrees: median / 90 %", *WORDS.values()]
    rows = []
    for one in found:
        cells = [one["clouds"], str(one["count"]), one["way"], str(len(one["distances"]))]
        distance, angle = 100 * np.array(one["distances"]), np.array(one["angles"])
        cells += [
            f"{np.median(values):.{d}f} / {np.percentile(values, 90):.{d}f}"
            for values, d in ((distance, 2), (angle, 1))
        ]
        rows.append(
            [
                *cells,
                *(
                    f"{100 * np.mean((distance <= 100 * metres) & (angle <= degrees)):.0f} %"
                    for metres, degrees in THRESHOLDS.values()
                ),
            ]
        )
    told = "## Several demonstrations\n\nPicks on the targets of every fifth task, learnt from the handles of several other mugs."
    return f"{told}\n\n![Success against the number of demonstrations]({PICTURES['demonstrations']})\n\n" + markdown(
        heads, rows
    )


def _name(method: str) -> str:
    if method == LIBRARY:
        return f"**{method}**"
    return f"{method} (within {100 * NEAR:.0f} cm)" if method.startswith("oracle") else method


def _between(limits, factor: float, digits: int = 0) -> str:
    return "" if limits is None else " ({:.{d}f} to {:.{d}f})".format(*(factor * x for x in limits), d=digits)
