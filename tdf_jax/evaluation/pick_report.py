"""The report of `tdf evaluate`: a table for the terminal, a model card in Markdown, and a record of every number."""

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from tdf_jax.evaluation.pick_transfer import ADAM, CARRY, OVERLAPS, Outcome
from tdf_jax.evaluation.records import header
from tdf_jax.evaluation.statistics import THRESHOLDS
from tdf_jax.evaluation.tables import aligned, between, markdown, percent
from tdf_jax.evaluation.tabletop import CLEAN, STANDS
from tdf_jax.networks.model import Model
from tdf_jax.networks.occupancy import parameter_count
from tdf_jax.shapes import FAMILIES

# Thresholds that the tables show; the record has all of them. A coarser one would not tell networks apart.
SHOWN = {name: THRESHOLDS[name].label() for name in ("5mm_5deg", "1cm_10deg", "2cm_20deg")}
SYMMETRY_HEADS = ["symmetry", "cases", "IoU", "refined", *SHOWN.values(), "axis: 2 cm, 20 deg"]
SIGHT_HEADS = ["place", "cases", *SHOWN.values(), "confidence < 0.5"]
MEANINGS = {
    "full": "complete, 1500 points",
    "views4": "seen by four depth cameras",
    "views3": "seen by three",
    "views2": "seen by two",
    "views1": "seen by one",
    "camera1": "one depth image, on a table",
    "camera2": "two depth images",
    "camera3": "three depth images",
    "table": "strip of the table",
    "neighbour-same": "another of its category at 3 cm",
    "neighbour-other": "an object of another category at 3 cm",
    "touching-same": "another of its category that touches it",
    "touching-other": "an object of another category that touches it",
    "outliers": "outliers",
    "tilt60": "tilted within 60 degrees",
    "points300": "300 points",
    "points1000": "1000 points",
    "points3000": "3000 points",
    "noise": "300 points, 2 mm noise",
    "half": "half as large",
    "double": "twice as large",
}

Outcomes = Mapping[tuple[str, str], Sequence[Outcome]]  # outcomes by objects and `condition` of the cloud


def condition(clouds: str, clutter: str = CLEAN, stand: str = STANDS[0]) -> str:
    """The name of a condition of the cloud in tables, such as "camera1, outliers, tilt60".

    Args:
        clouds: condition, one of `tdf_jax.evaluation.cases.CLOUDS`.
        clutter: what else the cloud shows, one of `tdf_jax.evaluation.tabletop.CLUTTER`.
        stand: how the object stands on a table, one of `tdf_jax.evaluation.tabletop.STANDS`.
    """
    return ", ".join([clouds, *([] if clutter == CLEAN else [clutter]), *([] if stand == STANDS[0] else [stand])])


def meaning(name: str) -> str:
    """The words for the name of a `condition`, for readers who do not know the names."""
    return "; ".join(MEANINGS[part] for part in name.split(", "))


def label(category: str, real: bool = False) -> str:
    """The name of a category's objects in tables and files."""
    return f"{'real' if real else 'generated'} {category}s"


def is_real(objects: str) -> bool:
    """Whether a `label` is of real objects."""
    return objects.startswith("real ")


def place(objects: str, settings: Mapping[str, Any]) -> str:
    """The place that is transferred on objects of a `label`."""
    category = objects.split()[1].removesuffix("s")
    return settings["place"] or FAMILIES[category].places[0]


def table(outcomes: Outcomes, settings: Mapping[str, Any]) -> str:
    """Tables for the terminal: a table for each kind of objects, a line for each method and condition of the cloud.

    Args:
        outcomes: outcomes of all methods.
        settings: settings of the command.
    """
    heads = ["method", "cloud", "IoU", "refined", "position, cm", "position, diagonals", "rotation, deg", "flips"]
    units = ["", "", "", "", *["median / p90"] * 3, "", *["success (95 %)"] * len(SHOWN)]
    blocks = []
    for objects, first, rows in _by_objects(outcomes):
        title = (
            f"{objects}: {first['objects']} objects, {first['cases']} transfers of the {place(objects, settings)}; "
            f"{_picks(settings)}"
        )
        lines = [[*heads, *SHOWN.values()], units, *(_table_cells(clouds, outcome) for clouds, outcome in rows)]
        blocks.append(f"{title}\n{aligned(lines)}")
        parts = [
            [outcome.method, clouds, *cells] for clouds, outcome in rows for cells in _by_symmetry(outcome.summary)
        ]
        if parts:
            blocks.append(aligned([["method", "cloud", *SYMMETRY_HEADS], *parts]))
        parts = [[outcome.method, clouds, *cells] for clouds, outcome in rows for cells in _by_sight(outcome.summary)]
        if parts:
            blocks.append(aligned([["method", "cloud", *SIGHT_HEADS], *parts], words=3))
    return "\n\n".join(blocks)


def card(model: Model, outcomes: Outcomes, settings: Mapping[str, Any]) -> str:
    """A model card in Markdown: the network, its input and its accuracy beside baselines.

    Args:
        model: the network.
        outcomes: outcomes of all methods.
        settings: settings of the command.
    """
    sizes = f"latent {model.config.latent}, {parameter_count(model.config):,} parameters, float32"
    facts = {
        "network": f"Neural Descriptor Fields occupancy network, {sizes}",
        "trained by": model.info.source,
        "input": "a cloud of any density, in any pose; `encode` averages the latents of several subsamples of "
        f"{model.info.cloud_points} farthest points",
    }
    if model.info.description:
        facts["notes"] = model.info.description
    heads = ["cloud", "method", "IoU", "refined", "position, median / 90 %", "rotation, median / 90 %", "flips"]
    blocks = [f"# {model.info.name}", markdown(["what", "value"], facts.items())]
    blocks += ["## Transfer of one pose", _method(settings)]
    for objects, first, rows in _by_objects(outcomes):
        kind = "at their own size, none seen in training" if is_real(objects) else "that no training run saw"
        blocks.append(
            f"{objects.capitalize()}: {first['objects']} {kind}, {first['cases']} transfers of the "
            f"{place(objects, settings)}."
        )
        blocks.append(markdown([*heads, *SHOWN.values()], [_card_cells(clouds, outcome) for clouds, outcome in rows]))
        parts = [
            [meaning(clouds), outcome.method, *cells]
            for clouds, outcome in rows
            for cells in _by_symmetry(outcome.summary)
        ]
        if parts:
            blocks += ["The same by symmetry:", markdown(["cloud", "method", *SYMMETRY_HEADS], parts)]
        parts = [
            [meaning(clouds), outcome.method, *cells]
            for clouds, outcome in rows
            for cells in _by_sight(outcome.summary)
        ]
        if parts:
            blocks += [
                "The same by whether the place is seen:",
                markdown(["cloud", "method", *SIGHT_HEADS], parts),
            ]
    return "\n\n".join(blocks) + "\n"


def record(outcomes: Outcomes, settings: Mapping[str, Any], model: Model) -> dict[str, Any]:
    """Every number, those of each case included, as JSON has them.

    Args:
        outcomes: outcomes of all methods.
        settings: settings of the command.
        model: the network.
    """
    rows = [
        {"set": objects}
        | {name: getattr(outcome.cases[0], name) for name in ("clouds", "clutter", "stand")}
        | {"method": outcome.method}
        | outcome.summary
        | {"errors": _errors(outcome)}
        for (objects, _), several in outcomes.items()
        for outcome in several
    ]
    return header(settings, model) | {"rows": rows}


def _by_objects(outcomes: Outcomes) -> Iterator[tuple[str, dict, list[tuple[str, Outcome]]]]:
    """For each kind of objects its label, the first summary, and (condition, outcome) of every row."""
    for objects in dict.fromkeys(name for name, _ in outcomes):
        rows = [
            (clouds, outcome) for (name, clouds), several in outcomes.items() if name == objects for outcome in several
        ]
        yield objects, rows[0][1].summary, rows


def _method(settings: Mapping[str, Any]) -> str:
    options = {name: settings[name] for name in ("seed", "pairs", "num_starts", "iterations")}
    if settings["meshes"] is not None:
        options |= {
            "meshes": "DIR --recursive" if settings.get("recursive") else "DIR",
            "num_poses": settings["num_poses"],
        }
    options |= {name: settings[name] for name in ("category", "clouds")}
    plain = {"clutter": (CLEAN,), "stand": STANDS[:1], "solver": ADAM}
    options |= {name: settings[name] for name, usual in plain.items() if settings.get(name, usual) != usual}
    words = " ".join(
        f"--{name.replace('_', '-')} {' '.join(value) if isinstance(value, list | tuple) else value}"
        for name, value in options.items()
    )
    return (
        "One pose at a place, demonstrated on a generated object of the same size and symmetry; the target is in a "
        f"uniform random pose, or stands on a table where there is one; {_picks(settings)} (`tdf evaluate {words}`). "
        "Errors are "
        "from the nearest of the poses that the symmetry of the target makes equal. Success: position and rotation "
        "error are both within the bounds; in brackets the 95 % bootstrap interval over objects."
    )


def _table_cells(clouds: str, outcome: Outcome) -> list[str]:
    row = outcome.summary
    cells = [outcome.method, clouds, *_overlaps(row)]
    for name, unit, form in (("position", "cm", "5.2f"), ("position", "diagonals", ".3f"), ("rotation", "deg", "5.1f")):
        cells.append(" / ".join(format(row[f"{name}_{kind}_{unit}"], form) for kind in ("median", "p90")))
    return [*cells, str(row["flips"]), *_successes(row)]


def _card_cells(clouds: str, outcome: Outcome) -> list[str]:
    row = outcome.summary
    return [
        meaning(clouds),
        outcome.method,
        *_overlaps(row),
        f"{row['position_median_cm']:.2f} / {row['position_p90_cm']:.2f} cm",
        f"{row['rotation_median_deg']:.1f} / {row['rotation_p90_deg']:.1f}°",
        str(row["flips"]),
        *_successes(row),
    ]


def _by_symmetry(row: dict) -> list[list[str]]:
    """Cells under `SYMMETRY_HEADS`, a line for each symmetry; none if all objects have the same symmetry."""
    parts = row["by_symmetry"]
    if len(parts) < 2:
        return []
    return [
        [
            name,
            str(part["cases"]),
            *_overlaps(part),
            *(percent(part[f"success_{threshold}"]) for threshold in (*SHOWN, "axis_2cm_20deg")),
        ]
        for name, part in parts.items()
    ]


def _by_sight(row: dict) -> list[list[str]]:
    """Cells under `SIGHT_HEADS`, a line for the cases with the place seen, and one with it hidden."""
    return [
        [name, str(part["cases"]), *_successes(part), percent(part["doubted"])]
        for name, part in row["by_sight"].items()
    ]


def _picks(settings: Mapping[str, Any]) -> str:
    """How picks are found, in words."""
    if settings.get("solver") == CARRY:
        return "picks of tdf.imitate"
    return f"best of {settings['num_starts']} starts by loss"


def _overlaps(row: dict) -> list[str]:
    """IoU of a summary as encoded and refined."""
    return ["n/a" if row[name] is None else f"{row[name]:.3f}" for name in OVERLAPS]


def _successes(row: dict) -> list[str]:
    """Success rates of a summary with their intervals, one for each threshold that is shown."""
    return [percent(row[f"success_{name}"]) + between(row[f"interval_{name}"], missing=" (n/a)") for name in SHOWN]


def _errors(outcome: Outcome) -> list[dict]:
    return [
        {
            "object": case.instance,
            "position_cm": 100 * float(outcome.distance[index]),
            "rotation_deg": float(outcome.angle[index]),
            **{name: outcome.ious[name][index] for name in OVERLAPS},
            "confidence": None if np.isnan(outcome.confidence[index]) else float(outcome.confidence[index]),
            "place_points": case.seen,
            "foreign": None if case.own is None else len(case.points_b) - case.own,
            "removed": None if outcome.removed is None else int(outcome.removed[index]),
        }
        for index, case in enumerate(outcome.cases)
    ]
