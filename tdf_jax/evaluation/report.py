"""What `tdf evaluate` tells: a table for people, a file for machines."""

import json
from collections.abc import Mapping, Sequence
from importlib.metadata import version
from pathlib import Path

import jax

from tdf_jax._internal.files import replace_file
from tdf_jax.evaluation.comparison import Outcome
from tdf_jax.evaluation.pick_transfer import OVERLAPS
from tdf_jax.networks.model import Model
from tdf_jax.shapes import FAMILIES

SCHEMA = 2  # raised when a field of the file changes its meaning or goes
THRESHOLDS = {"5mm_5deg": "5 mm, 5 deg", "1cm_10deg": "1 cm, 10 deg", "2cm_20deg": "2 cm, 20 deg"}

Outcomes = Mapping[tuple[str, str], Sequence[Outcome]]  # by objects and condition of the cloud


def label(category: str, real: bool = False) -> str:
    """What objects of a category are called in tables and files."""
    return f"{'real' if real else 'generated'} {category}s"


def is_real(objects: str) -> bool:
    """Whether a `label` is of real objects."""
    return objects.startswith("real ")


def place(objects: str, settings: dict) -> str:
    """The place that is transferred on objects of a `label`."""
    category = objects.split()[1].removesuffix("s")
    return settings["place"] or FAMILIES[category].places[0]


def table(outcomes: Outcomes, settings: dict) -> str:
    """One line for every method under every condition, the objects apart."""
    told = f"best of {settings['inits']} starts by loss"
    lines = []
    for objects in dict.fromkeys(name for name, _ in outcomes):
        rows = [
            (clouds, outcome) for (name, clouds), several in outcomes.items() if name == objects for outcome in several
        ]
        first = rows[0][1].summary
        lines += [
            "",
            f"{objects}: {first['objects']} objects, {first['cases']} transfers of the {place(objects, settings)}; {told}",
        ]
        lines += _aligned([_HEADS, _UNITS, *(_cells(clouds, outcome) for clouds, outcome in rows)])
        apart = [(outcome.method, clouds, *cells) for clouds, outcome in rows for cells in by_symmetry(outcome.summary)]
        if apart:
            lines += ["", *_aligned([("method", "cloud", *SYMMETRY_HEADS), *apart])]
    return "\n".join(lines[1:])


SYMMETRY_HEADS = ["symmetry", "cases", "IoU", "refined", *THRESHOLDS.values(), "axis: 2 cm, 20 deg"]
_HEADS = [
    "method",
    "cloud",
    "IoU",
    "refined",
    "position, cm",
    "position, diagonals",
    "rotation, deg",
    "flips",
    *THRESHOLDS.values(),
]
_UNITS = ["", "", "", "", *["median / p90"] * 3, "", *["success (95 %)"] * 3]


def _cells(clouds: str, outcome: Outcome) -> list[str]:
    row = outcome.summary
    cells = [outcome.method, clouds, *overlap_cells(row)]
    for name, unit, form in (("position", "cm", "5.2f"), ("position", "diagonals", ".3f"), ("rotation", "deg", "5.1f")):
        cells.append(" / ".join(format(row[f"{name}_{kind}_{unit}"], form) for kind in ("median", "p90")))
    return [*cells, str(row["flips"]), *successes(row)]


def by_symmetry(row: dict) -> list[list[str]]:
    """Cells under `SYMMETRY_HEADS` of a summary, a line for each symmetry; none if all objects have the same."""
    parts = row["by_symmetry"]
    if len(parts) < 2:
        return []
    return [
        [
            name,
            str(part["cases"]),
            *overlap_cells(part),
            *(_percent(part[f"success_{threshold}"]) for threshold in (*THRESHOLDS, "axis_2cm_20deg")),
        ]
        for name, part in parts.items()
    ]


def _percent(share: float | None) -> str:
    return "n/a" if share is None else f"{100 * share:.0f} %"


def overlap_cells(row: dict) -> list[str]:
    """IoU of a summary as encoded and refined."""
    return ["n/a" if row[name] is None else f"{row[name]:.3f}" for name in OVERLAPS]


def successes(row: dict) -> list[str]:
    """Success rates of a summary with their intervals, one for each of `THRESHOLDS`."""
    cells = []
    for name in THRESHOLDS:
        interval = row[f"interval_{name}"]
        words = "n/a" if interval is None else "{:.0f} to {:.0f}".format(*(100 * x for x in interval))
        cells.append(f"{100 * row[f'success_{name}']:.0f} % ({words})")
    return cells


def _aligned(rows: list[list[str]]) -> list[str]:
    widths = [max(map(len, column)) for column in zip(*rows)]
    # Words to the left, numbers to the right.
    return [
        "  ".join(cell.ljust(w) if i < 2 else cell.rjust(w) for i, (cell, w) in enumerate(zip(row, widths))).rstrip()
        for row in rows
    ]


def record(outcomes: Outcomes, settings: dict, model: Model) -> dict:
    """Every number, those of each case included, as JSON has them."""
    rows = [
        {"set": objects, "clouds": clouds, "method": outcome.method} | outcome.summary | {"errors": _errors(outcome)}
        for (objects, clouds), several in outcomes.items()
        for outcome in several
    ]
    return {
        "schema": SCHEMA,
        "tdf_jax": version("tdf_jax"),
        "settings": settings,
        "weights": {"name": model.info.name, "source": model.info.source},
        "machine": {"jax": jax.__version__, "backend": jax.default_backend()},
        "rows": rows,
    }


def _errors(outcome: Outcome) -> list[dict]:
    several = zip(
        outcome.cases, outcome.distance, outcome.angle, *(outcome.ious[name] for name in OVERLAPS), strict=True
    )
    return [
        {"object": case.instance, "position_cm": 100 * float(distance), "rotation_deg": float(angle)}
        | dict(zip(OVERLAPS, ious))
        for case, distance, angle, *ious in several
    ]


def write(path: Path, record: dict) -> None:
    """Write a record, whole or not at all.

    Raises:
        InputError: the file cannot be written.
    """
    replace_file("tdf evaluate", path, (json.dumps(record, indent=1, allow_nan=False) + "\n").encode())
