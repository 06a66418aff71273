"""The report of `tdf benchmark --relations`: a page of Markdown, and a record of every number."""

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from tdf_jax._internal.version import __version__
from tdf_jax.evaluation.records import SCHEMA
from tdf_jax.evaluation.relation_scores import LIBRARY, Condition, Networks, Score, success
from tdf_jax.evaluation.relation_success import FREED_BY, TOLERANCES, UPRIGHT, Placed
from tdf_jax.evaluation.statistics import bootstrap_interval
from tdf_jax.evaluation.tables import between, markdown, percent

# R-NDF, success of the place, ten demonstrations, upright and arbitrary poses: tables of Simeonov et al., CoRL 2022.
PUBLISHED = {
    "bowl_on_mug": {"upright": 0.74, "tilt60": 0.70},
    "mug_on_rack": {"upright": 0.84, "tilt60": 0.75},
    "bottle_in_container": {"upright": 0.80, "tilt60": 0.75},
}
MOST_FAILURES = 5  # that are drawn of each task
PUBLISHED_ONE = {"mug_on_rack": {"upright": 0.39, "tilt60": 0.44}}  # with one demonstration
HEADS = (
    "poses", "clouds", "demonstrations", "method", "pairs", "success", "within 5 mm", "gap", "penetration",
    "upright or hung", "supported", "R-NDF", "seconds",
)  # fmt: skip


def row(scores: Sequence[Score]) -> dict[str, Any]:
    """Rates of one method under one condition, with 95 % bootstrap intervals over pairs.

    Args:
        scores: its placements.
    """
    placed, numbers = [one.placed for one in scores], [one.number for one in scores]
    near, far = TOLERANCES
    hits = success(scores, near)
    shown = [one.demonstrated for one in scores]
    each = [float(hits[np.array(shown) == one].mean()) for one in sorted(set(shown))]
    return {
        **scores[0].condition._asdict(),
        "method": scores[0].method,
        "pairs": len(scores),
        "success_2mm": float(hits.mean()),
        "interval_2mm": bootstrap_interval(hits, numbers),
        "success_5mm": float(success(scores, far).mean()),
        "interval_5mm": bootstrap_interval(success(scores, far), numbers),
        "gap_2mm": float(np.mean([one.gap <= near for one in placed])),
        "penetration_2mm": float(np.mean([one.penetration <= near for one in placed])),
        "upright_15deg": float(np.mean([not one.tilt > UPRIGHT for one in placed])),
        "hung": float(np.mean([one.hung for one in placed])),
        "supported": float(np.mean([one.supported for one in placed])),
        "seconds_median": float(np.median([one.seconds for one in scores])),
        "success_of_each_demonstration": each,
    }


def rows(scores: Sequence[Score]) -> list[dict[str, Any]]:
    """Rates of every method under every condition, in the order in which they first appear."""
    groups: dict[tuple[Condition, str], list[Score]] = {}
    for one in scores:
        groups.setdefault((one.condition, one.method), []).append(one)
    return [row(group) for group in groups.values()]


def record(
    scores: Sequence[Score], networks: Mapping[str, Networks], settings: Mapping[str, Any], redrawn: Mapping[str, int]
) -> dict[str, Any]:
    """Every number, those of each pair included, as JSON has them.

    Args:
        scores: all placements.
        networks: networks of every task.
        settings: settings of the command.
        redrawn: number of pairs of each task that were drawn and cannot fit by construction.
    """
    return {
        "schema": SCHEMA,
        "tdf_jax": __version__,
        "settings": dict(settings),
        "weights": {task: [model.info.name for model in pair] for task, pair in networks.items()},
        "redrawn": dict(redrawn),
        "rows": rows(scores),
        "placements": [
            {
                **one.condition._asdict(),
                "method": one.method,
                "number": one.number,
                "demonstrated": one.demonstrated,
                **{name: _plain(value) for name, value in dataclasses.asdict(one.placed).items()},
                "seconds": round(one.seconds, 3),
            }
            for one in scores
        ],
    }


def page(scores: Sequence[Score], settings: Mapping[str, Any], redrawn: Mapping[str, int]) -> str:
    """Render the page.

    Args:
        scores: all placements.
        settings: settings of the command.
        redrawn: number of pairs of each task that were drawn and cannot fit by construction.
    """
    parts = ["# Relations", _setup(settings, redrawn)]
    for task in dict.fromkeys(one.condition.task for one in scores):
        mine = rows([one for one in scores if one.condition.task == task])
        parts += [f"## {task.replace('_', ' ').capitalize()}", markdown(HEADS, [_cells(one) for one in mine])]
        spread = [one for one in mine if one["method"] == LIBRARY and one["demonstrations"] == 1]
        parts += [
            f"Success of each of the {len(one['success_of_each_demonstration'])} demonstrations, {one['poses']}, "
            f"{one['clouds']}: {', '.join(percent(share) for share in one['success_of_each_demonstration'])}."
            for one in spread
        ]
        if failures(scores, task):
            parts.append(f"![The first failures, cut open, above the right placements]({picture(task)})")
    return "\n\n".join(parts) + "\n"


def failures(scores: Sequence[Score], task: str) -> list[Score]:
    """The first failures of the library at a task, at most `MOST_FAILURES`; those that `picture` of the task shows.

    Args:
        scores: all placements.
        task: name of the task.
    """
    mine = [one for one in scores if one.condition.task == task and one.method == LIBRARY]
    return [one for one in mine if not one.placed.holds()][:MOST_FAILURES]


def penetration(placed: Placed) -> str:
    """The penetration of a placement in words, millimetres.

    Args:
        placed: the verdict.
    """
    deepest = 1e3 * FREED_BY[-1]
    return f"{1e3 * placed.penetration:.0f}" if np.isfinite(placed.penetration) else f"more than {deepest:.0f}"


def picture(task: str) -> str:
    """Name of the picture of a task's failures.

    Args:
        task: name of the task.
    """
    return f"failures_{task}.png"


def _setup(settings, redrawn) -> str:
    counts = ", ".join(f"{count} of {task.replace('_', ' ')}" for task, count in redrawn.items())
    return (
        f"`tdf benchmark --relations`, seed {settings['seed']}, {settings['pairs']} pairs a row of unseen generated "
        "objects of natural size. Pairs that cannot fit by construction are drawn again before any method runs: "
        f"{counts}.\n\n"
        "A placement succeeds if, with the target turned upright, the gap of the two surfaces and their penetration "
        f"are at most 2 mm, a bowl or bottle is upright within {UPRIGHT:.0f} degrees, a peg crosses the mug's finger "
        "hole before and after the mug swings freely about the contact, and the centre of mass is supported "
        "([protocol](../guide/evaluation.md#relations)). Intervals are 95 % bootstrap intervals over pairs. The column "
        "R-NDF is the published rate of Relational NDF with ten demonstrations (with one too, where there is one) on "
        'ShapeNet objects in simulation: the same tasks and poses, other objects and another judge. "Upright or hung" '
        "is whether a peg crosses the finger hole for mugs on racks."
    )


def _cells(one: Mapping[str, Any]) -> list[str]:
    return [
        one["poses"],
        one["clouds"],
        str(one["demonstrations"]),
        one["method"],
        str(one["pairs"]),
        percent(one["success_2mm"]) + between(one["interval_2mm"]),
        percent(one["success_5mm"]) + between(one["interval_5mm"]),
        percent(one["gap_2mm"]),
        percent(one["penetration_2mm"]),
        percent(one["hung"] if one["task"] == "mug_on_rack" else one["upright_15deg"]),
        percent(one["supported"]),
        _published(one) if one["method"] == LIBRARY else "",
        f"{one['seconds_median']:.1f}",
    ]


def _published(one: Mapping[str, Any]) -> str:
    ten = PUBLISHED[one["task"]].get(one["poses"])
    alone = PUBLISHED_ONE.get(one["task"], {}).get(one["poses"])
    return "" if ten is None else percent(ten) + ("" if alone is None else f" (one: {percent(alone)})")


def _plain(value):
    """A number as JSON has it; None where it is not finite."""
    if isinstance(value, bool):
        return value
    return round(float(value), 6) if np.isfinite(value) else None
