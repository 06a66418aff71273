"""The model card of `tdf evaluate --card`: what weights are, what they were measured to do, what they do not know."""

from pathlib import Path

from tdf_jax._internal.files import replace_file
from tdf_jax.evaluation.report import (
    SYMMETRY_HEADS,
    THRESHOLDS,
    Outcomes,
    by_symmetry,
    is_real,
    overlap_cells,
    place,
    successes,
)
from tdf_jax.networks.model import Model
from tdf_jax.networks.occupancy import parameter_count

MEANINGS = {
    "full": "complete, 1500 points",
    "views4": "seen by four depth cameras",
    "views2": "seen by two",
    "views1": "seen by one",
    "points300": "300 points",
    "points1000": "1000 points",
    "points3000": "3000 points",
    "noise": "300 points, 2 mm noise",
    "half": "half as large",
    "double": "twice as large",
}


def card(model: Model, outcomes: Outcomes, settings: dict) -> str:
    """A model card in Markdown.

    Args:
        model: the network.
        outcomes: of it and of baselines, by objects and condition of the cloud.
        settings: of the evaluation.
    """
    sizes = f"latent {model.config.latent}, {parameter_count(model.config):,} parameters, float32"
    facts = {
        "network": f"Neural Descriptor Fields occupancy network, {sizes}",
        "trained by": model.info.source,
        "input": f"a cloud of any density, thinned to {model.info.cloud_points} farthest points several times, latents averaged (`encode` does it), any pose",
    }
    if model.info.description:
        facts["notes"] = model.info.description
    lines = [
        f"# {model.info.name}",
        "",
        "| what | value |",
        "|---|---|",
        *(f"| {what} | {value} |" for what, value in facts.items()),
        "",
    ]
    lines += ["## Transfer of one pose", "", _told(settings), ""]
    for objects in dict.fromkeys(name for name, _ in outcomes):
        rows = [
            (clouds, outcome) for (name, clouds), several in outcomes.items() if name == objects for outcome in several
        ]
        first = rows[0][1].summary
        kind = "at their own size, none seen in training" if is_real(objects) else "that no training run saw"
        lines += [
            f"{objects.capitalize()}: {first['objects']} {kind}, {first['cases']} transfers of the {place(objects, settings)}.",
            "",
        ]
        heads = [
            "cloud",
            "method",
            "IoU",
            "refined",
            "position, median / 90 %",
            "rotation, median / 90 %",
            "flips",
            *THRESHOLDS.values(),
        ]
        lines += [f"| {' | '.join(heads)} |", "|" + "---|" * len(heads)]
        lines += [f"| {' | '.join(_cells(clouds, outcome))} |" for clouds, outcome in rows]
        apart = [
            [MEANINGS[clouds], outcome.method, *cells]
            for clouds, outcome in rows
            for cells in by_symmetry(outcome.summary)
        ]
        if apart:
            heads = ["cloud", "method", *SYMMETRY_HEADS]
            lines += [
                "",
                "The same by symmetry:",
                "",
                f"| {' | '.join(heads)} |",
                "|" + "---|" * len(heads),
                *(f"| {' | '.join(cells)} |" for cells in apart),
            ]
        lines += [""]
    return "\n".join(lines).rstrip() + "\n"


def write(path: Path, text: str) -> None:
    """Write a card, whole or not at all.

    Raises:
        InputError: the file cannot be written.
    """
    replace_file("tdf evaluate", path, text.encode())


def _told(settings: dict) -> str:
    options = {name: settings[name] for name in ("seed", "pairs", "inits", "iterations")}
    if settings["meshes"] is not None:
        options |= {"meshes": "DIR", "poses": settings["poses"]}
    options |= {"category": " ".join(settings["category"]), "clouds": " ".join(settings["clouds"])}
    told = " ".join(f"--{name} {value}" for name, value in options.items())
    return (
        "One pose at a place, shown on a generated object of the same size and symmetry, target in a uniform random pose, best of "
        f"{settings['inits']} starts by loss (`tdf evaluate {told}`). Errors are from the nearest of the poses that the target's symmetry makes "
        "equal. Success: position and rotation error both within the bounds; in brackets the 95 % bootstrap interval over objects."
    )


def _cells(clouds, outcome) -> list[str]:
    row = outcome.summary
    cells = [MEANINGS[clouds], outcome.method, *overlap_cells(row)]
    cells.append(f"{row['position_median_cm']:.2f} / {row['position_p90_cm']:.2f} cm")
    cells.append(f"{row['rotation_median_deg']:.1f} / {row['rotation_p90_deg']:.1f}°")
    return [*cells, str(row["flips"]), *successes(row)]
