"""`tdf benchmark --relations`: objects placed on targets by the library and by baselines."""

import functools
from pathlib import Path
from typing import Any

PAGE, RECORD = "relations.md", "relations.json"


def measure(out: Path, settings: dict[str, Any]) -> None:
    """Place all pairs by all methods, or read what was kept of them, and write the page, the record and pictures.

    Args:
        out: folder of the page; its folder runs keeps the placements.
        settings: options of the command by name.

    Raises:
        InputError: an option is wrong, the extra "mesh" is not installed, or the folder cannot be written.
        PictureError: a picture cannot be drawn or written.
    """
    from tdf_jax._internal import checks
    from tdf_jax._internal.errors import InputError
    from tdf_jax._internal.files import replace_file
    from tdf_jax.cli.attempts import attempts_folder
    from tdf_jax.evaluation.conditions import SCALES
    from tdf_jax.evaluation.records import write_record
    from tdf_jax.evaluation.relation_report import page, record
    from tdf_jax.evaluation.relation_scores import DEMONSTRATIONS, LIBRARY, METHODS, UNSEATED, Condition, Networks, run
    from tdf_jax.evaluation.relation_tasks import RELATIONS, draw_pair
    from tdf_jax.geometry.winding import libigl
    from tdf_jax.networks.checkpoint import load_model

    checks.count("tdf benchmark", "--pairs", settings["pairs"])
    checks.seed("tdf benchmark", settings["seed"], "--seed")
    for name in settings["methods"]:
        checks.choice("tdf benchmark", "--methods", name, (*METHODS, "all"))
    names = [name for name in METHODS if {name, "all"} & set(settings["methods"])]
    for task in settings["tasks"]:
        checks.choice("tdf benchmark --relations", "--tasks", task, RELATIONS)
    for flag in ("methods", "clouds", "tasks", "pose"):
        if not settings[flag]:
            raise InputError(f"tdf benchmark: --{flag} is empty; expected at least one")
    for condition in settings["clouds"]:
        if condition in SCALES:
            raise InputError(
                f"tdf benchmark: --clouds is {condition!r}; expected no condition of size with --relations, whose "
                "objects have their natural size"
            )
    for count in settings["demonstrations"]:
        checks.choice("tdf benchmark", "--demonstrations", count, (1, DEMONSTRATIONS))
    if 1 not in settings["demonstrations"] and not {LIBRARY, UNSEATED} & set(names):
        raise InputError(
            f"tdf benchmark --relations: --methods {' '.join(names)} have one demonstration, and --demonstrations is "
            f"{DEMONSTRATIONS}; expected 1"
        )
    for flag, side in (("object_weights", "object"), ("target_weights", "target")):
        sides = sorted({getattr(RELATIONS[task], side) for task in settings["tasks"]})
        if settings[flag] is not None and len(sides) > 1:
            raise InputError(
                f"tdf benchmark: --{flag.replace('_', '-')} is given, and --tasks need weights of {', '.join(sides)}; "
                "expected tasks of one category there"
            )
    libigl("tdf benchmark --relations")
    load = functools.cache(load_model)
    networks = {
        task: Networks(
            load(settings["object_weights"] or RELATIONS[task].object),
            load(settings["target_weights"] or RELATIONS[task].target),
        )
        for task in dict.fromkeys(settings["tasks"])
    }
    conditions = [
        Condition(task, poses, clouds, count)
        for task in dict.fromkeys(settings["tasks"])
        for clouds in dict.fromkeys(settings["clouds"])
        for poses in dict.fromkeys(settings["pose"])
        for count in dict.fromkeys(settings["demonstrations"])
    ]
    folder = attempts_folder("tdf benchmark", out, PAGE, RECORD)
    scores = list(run(conditions, networks, names, folder, pairs=settings["pairs"], seed=settings["seed"]))
    redrawn = {
        task: sum(draw_pair(task, settings["seed"], number).redrawn for number in range(settings["pairs"]))
        for task in dict.fromkeys(settings["tasks"])
    }
    write_record("tdf benchmark", out / RECORD, record(scores, networks, settings, redrawn), indent=None)
    replace_file("tdf benchmark", out / PAGE, page(scores, settings, redrawn).encode())
    print(out / PAGE)
    _draw_failures(out, scores, settings["seed"])


def _draw_failures(out: Path, scores, seed: int) -> None:
    from tdf_jax.cli.pictures import Pictures
    from tdf_jax.evaluation.relation_report import failures, penetration, picture
    from tdf_jax.evaluation.relation_tasks import draw_pair, place_pair

    pictures = Pictures("tdf benchmark")
    for task in dict.fromkeys(one.condition.task for one in scores):
        failed = failures(scores, task)
        if not failed:
            (out / picture(task)).unlink(missing_ok=True)  # that of an earlier run with fewer pairs
            continue
        with pictures.drawing(out / picture(task)) as path:
            from tdf_jax.viz.placements import PlacedMeshes, placements_figure
            from tdf_jax.viz.style import save_figure

            drawn = []
            for one in failed:
                pair = draw_pair(task, seed, one.number)
                placement = place_pair(pair, seed, one.condition.poses, one.condition.clouds)
                lengths = f"gap {1e3 * one.placed.gap:.0f} mm, penetration {penetration(one.placed)} mm"
                title = f"{one.condition.poses}, {one.condition.clouds}, pair {one.number}\n{lengths}"
                found, frames = placement.placed(one.motion), (pair.T_target_object, pair.T_target_contact)
                drawn.append(PlacedMeshes(title, pair.object.mesh, pair.target.mesh, found, *frames))
            save_figure(path, placements_figure(drawn))
    pictures.check()
