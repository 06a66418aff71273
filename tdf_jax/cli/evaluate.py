"""`tdf evaluate`: accuracy of weights on the transfer of one pose to unseen objects, beside baselines."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from tdf_jax._internal import checks
from tdf_jax._internal.errors import InputError
from tdf_jax.cli.options import Category

if TYPE_CHECKING:
    from tdf_jax.evaluation.pick_report import Outcomes
    from tdf_jax.evaluation.pick_transfer import Outcome
    from tdf_jax.networks.model import Model
    from tdf_jax.viz.reconstruction import Panel

PICTURES = ("reconstructions.png", "transfers.png")
MOST_GENERATED = 6  # generated objects of a category in a picture
_NONE = "(default: none)"
Cloud = Literal[
    "full", "views1", "views2", "views3", "views4", "points300", "points1000", "points3000", "noise", "half", "double",
    "camera1", "camera2", "camera3", "all",
]  # fmt: skip
Clutter = Literal[
    "none", "table", "neighbour-same", "neighbour-other", "touching-same", "touching-other", "outliers", "all"
]


def evaluate(
    weights: str = "mug",
    category: Annotated[
        tuple[Category, ...], tyro.conf.arg(help_behavior_hint="(default: that of shipped weights; mug)")
    ] = (),
    pairs: int = 50,
    seed: int = 0,
    size: Annotated[float | None, tyro.conf.arg(help_behavior_hint="(default: 0.12, 0.20, 0.22, 0.38, 0.28)")] = None,
    place: Annotated[str | None, tyro.conf.arg(help_behavior_hint="(default: handle, rim, neck, peg, floor)")] = None,
    num_starts: int = 10,
    iterations: int = 100,
    clouds: tuple[Cloud, ...] = ("full",),
    clutter: tuple[Clutter, ...] = ("none",),
    stand: tuple[Literal["upright", "tilt60"], ...] = ("upright",),
    solver: Literal["adam", "carry"] = "adam",
    reconstruct: bool = True,
    baselines: bool = False,
    meshes: Annotated[Path | None, tyro.conf.arg(metavar="DIR", help_behavior_hint=_NONE)] = None,
    recursive: bool = False,
    num_poses: int = 5,
    json: Annotated[Path | None, tyro.conf.arg(metavar="FILE", help_behavior_hint=_NONE)] = None,
    card: Annotated[Path | None, tyro.conf.arg(metavar="FILE", help_behavior_hint=_NONE)] = None,
    figures: Annotated[Path | None, tyro.conf.arg(metavar="DIR", help_behavior_hint=_NONE)] = None,
) -> None:
    """Transfer one pose between unseen objects, the target under a uniform random rotation, and print the errors.

    Args:
        weights: a name of shipped weights, or a .safetensors file.
        category: category of the objects: mug, bowl, bottle, rack or container; several are evaluated one after the
            other.
        pairs: number of generated pairs of each category; 0 for none, with --meshes.
        seed: seed of the objects, poses, query points and starts.
        size: size of generated objects, metres: the height of a mug, the diagonal of others. A real object keeps its
            size, and the demonstration is on a generated object of that size.
        place: place that is transferred: handle, rim or base of a mug; rim, base or body of a bowl; neck, base or body
            of a bottle; peg, post or base of a rack, any of whose pegs is right; floor, opening or base of a container.
        num_starts: number of random starts of each transfer; the one with the lowest loss counts.
        iterations: number of Adam's steps.
        clouds: condition of the new object's cloud: full; from 1 to 4 cameras; 300 to 3000 points; 300 points with 2 mm
            noise; half or double size; or from 1 to 3 depth images with noise, on a table that is removed.
        clutter: what else the clouds full and camera1 to camera3 show, a fifth of their points: a strip of the table;
            another object of the same or another category, at 3 cm or touching; outliers.
        stand: how objects stand on a table, with depth images or clutter: upright, or tilted within 60 degrees.
        solver: adam, with the settings above; or carry, which tdf imitate uses, with its own settings, and which gives
            confidences.
        reconstruct: measure reconstructions too; --no-reconstruct saves a third of the time or more.
        baselines: evaluate also random weights, alignment of principal axes and ICP, on the same cases with as many
            starts.
        meshes: folder of real objects of these categories with a meshes.json; see docs/guide/evaluation.md.
        recursive: use the meshes in subfolders of that folder too.
        num_poses: number of random poses of each real object.
        json: file for a record of every number.
        card: file for a model card in Markdown.
        figures: folder for pictures of reconstructions and transfers; they need the extra "mesh".
    """
    import functools
    import sys

    from tdf_jax._internal.files import replace_file
    from tdf_jax.cli.options import categories_of
    from tdf_jax.evaluation import pick_report
    from tdf_jax.evaluation.annotated_meshes import load_annotated
    from tdf_jax.evaluation.cases import generated_case, mesh_case
    from tdf_jax.evaluation.pick_transfer import BASELINES, compare
    from tdf_jax.evaluation.records import folder_name, write_record
    from tdf_jax.geometry.winding import libigl
    from tdf_jax.networks.checkpoint import load_model
    from tdf_jax.solvers.adam import OptimizeConfig

    _check_numbers(pairs, seed, size, clouds, meshes, num_poses)
    conditions = _conditions(clouds, clutter, stand)
    categories = tuple(dict.fromkeys(category or categories_of(weights)))
    _check_place(place, categories)
    _check_outputs(json, card, figures)
    if meshes is not None or figures is not None:
        libigl("tdf evaluate")
    config = OptimizeConfig(num_starts=num_starts, iterations=iterations)
    settings = {
        "weights": weights, "category": categories, "pairs": pairs, "seed": seed, "size": size, "place": place,
        "num_starts": num_starts, "iterations": iterations, "meshes": folder_name(meshes),
        "recursive": recursive, "num_poses": num_poses, "clouds": clouds,
        "clutter": clutter, "stand": stand, "solver": solver,
    }  # fmt: skip
    targets = [] if meshes is None else load_annotated(meshes, recursive)
    model = load_model(weights)
    unasked = sorted({target.category for target in targets} - set(categories))
    if unasked:
        raise InputError(
            f"tdf evaluate: --meshes has a {unasked[0]}; expected {', '.join(categories)} only; add it to --category, "
            "or move it away"
        )
    makers = {}
    for name in categories:
        makers[pick_report.label(name)] = [
            functools.partial(generated_case, name, seed, index, size=size) for index in range(pairs)
        ]
        real = [target for target in targets if target.category == name]
        makers[pick_report.label(name, real=True)] = [
            functools.partial(mesh_case, seed, pose, target) for target in real for pose in range(num_poses)
        ]
    outcomes = {}
    for objects, several in makers.items():
        for name, condition in conditions.items() if several else ():
            print(f"{objects}, cloud {name}", file=sys.stderr)
            cases = [make(place=place, **condition) for make in several]
            outcomes[objects, name] = compare(
                cases,
                model,
                BASELINES if baselines else (),
                seed=seed,
                config=config,
                solver=solver,
                reconstruct=reconstruct,
            )
            if json is not None:  # the file is written after every condition, because all of them can take hours
                write_record("tdf evaluate", json, pick_report.record(outcomes, settings, model))
    print(pick_report.table(outcomes, settings))
    sys.stdout.flush()
    if card is not None:
        replace_file("tdf evaluate", card, pick_report.card(model, outcomes, settings).encode())
    if figures is not None:
        _draw(figures, model, outcomes)


def _check_numbers(pairs, seed, size, clouds, meshes, num_poses) -> None:
    if pairs < 1 and (meshes is None or pairs < 0):
        raise InputError(f"tdf evaluate: --pairs is {pairs}; expected at least 1, or 0 with --meshes")
    checks.count("tdf evaluate", "--num-poses", num_poses)
    checks.seed("tdf evaluate", seed, "--seed")
    if size is not None:
        checks.number("tdf evaluate", "--size", size, 0.01, 1, "metres")
    if not clouds:
        raise InputError("tdf evaluate: --clouds is empty; expected at least one condition, such as full")


def _conditions(clouds, clutter, stand) -> dict[str, dict[str, str]]:
    """The settings of a case for every condition, by the name that tables have for it."""
    from tdf_jax.evaluation.cases import CLOUDS
    from tdf_jax.evaluation.pick_report import condition
    from tdf_jax.evaluation.tabletop import CAMERAS, CLEAN, CLUTTER, CLUTTERED

    if not clutter or not stand:
        name, example = ("--clutter", "none") if not clutter else ("--stand", "upright")
        raise InputError(f"tdf evaluate: {name} is empty; expected at least one, such as {example}")
    conditions = {}
    for cloud in CLOUDS if "all" in clouds else dict.fromkeys(clouds):
        for foreign in CLUTTER if "all" in clutter else dict.fromkeys(clutter):
            if foreign != CLEAN and cloud not in CLUTTERED:
                if "all" in clouds:
                    continue
                raise InputError(
                    f"tdf evaluate: --clutter {foreign} with --clouds {cloud}; expected one of "
                    f"{', '.join(CLUTTERED)} with clutter; leave one of the two out"
                )
            table = foreign != CLEAN or cloud in CAMERAS
            for one in dict.fromkeys(stand) if table else ("upright",):
                conditions[condition(cloud, foreign, one)] = {"clouds": cloud, "clutter": foreign, "stand": one}
    return conditions


def _check_place(place: str | None, categories: tuple[str, ...]) -> None:
    from tdf_jax.shapes import FAMILIES

    for category in categories:
        if place is not None and place not in FAMILIES[category].places:
            raise InputError(
                f"tdf evaluate: --place is {place!r}; expected one of a {category}'s: "
                f"{', '.join(FAMILIES[category].places)}"
            )


def _check_outputs(json: Path | None, card: Path | None, figures: Path | None) -> None:
    """Refuse at once what could not be written after the evaluation."""
    for name, path in (("json", json), ("card", card)):
        if path is not None and (path.is_dir() or not path.parent.is_dir()):
            raise InputError(f"tdf evaluate: --{name} is {path}; expected a file in an existing folder")
    if figures is not None and not (figures.is_dir() or (figures.parent.is_dir() and not figures.exists())):
        raise InputError(f"tdf evaluate: --figures is {figures}; expected a folder, or a new name in an existing one")


def _draw(folder: Path, model: "Model", outcomes: "Outcomes") -> None:
    """Draw the first condition.

    Args:
        folder: folder of the pictures, made if it is missing; pictures in it are replaced.
        model: the network, whose outcomes are the first of each list.
        outcomes: outcomes of all methods; baselines are not drawn.

    Raises:
        PictureError: a picture cannot be drawn or written.
    """
    from tdf_jax.cli.pictures import Pictures

    pictures = Pictures("tdf evaluate")
    reconstructions, transfers = (folder / name for name in PICTURES)
    _, condition = next(iter(outcomes))
    words = f"weights {model.info.name}, cloud {condition}"
    panels = []
    with pictures.drawing(reconstructions, transfers):
        folder.mkdir(exist_ok=True)
        panels = _panels(model, outcomes, condition)
    if panels:
        with pictures.drawing(reconstructions):
            from tdf_jax.viz.reconstruction import reconstruction_figure
            from tdf_jax.viz.style import save_figure

            title = f"Surfaces of occupancy 0.5, refined: {words}"
            save_figure(reconstructions, reconstruction_figure(panels, title))
        with pictures.drawing(transfers):
            from tdf_jax.viz.reconstruction import transfer_figure
            from tdf_jax.viz.style import save_figure

            save_figure(transfers, transfer_figure(panels, f"The place of a demonstration on other objects: {words}"))
    pictures.check()


def _panels(model: "Model", outcomes: "Outcomes", condition: str) -> "list[Panel]":
    """Up to `MOST_GENERATED` generated objects of a category, and every real object in its first pose."""
    from tdf_jax.evaluation.pick_report import is_real

    panels = []
    for (objects, clouds), (outcome, *_) in outcomes.items():
        if clouds == condition:
            names = [case.instance for case in outcome.cases]
            firsts = [names.index(name) for name in dict.fromkeys(names)]
            panels += [
                _panel(model, outcome, index) for index in firsts[: None if is_real(objects) else MOST_GENERATED]
            ]
    return panels


def _panel(model: "Model", outcome: "Outcome", index: int) -> "Panel":
    import jax
    import numpy as np

    from tdf_jax.evaluation.cases import QUERY_SIZE
    from tdf_jax.geometry import se3
    from tdf_jax.networks.encoding import encode
    from tdf_jax.networks.refinement import refine
    from tdf_jax.networks.surface import surface_triangles
    from tdf_jax.viz.reconstruction import Panel

    case, iou = outcome.cases[index], outcome.ious["iou_refined"][index]
    T_world_b, points = case.T_world_b, jax.device_put(case.points_b)
    estimate, T_world_estimate = outcome.estimates[index], np.eye(4)
    T_world_estimate[:3, :3], T_world_estimate[:3, 3] = se3.rotation(estimate), estimate[4:]
    return Panel(
        name=case.instance,
        overlap="IoU n/a: not closed" if iou is None else f"IoU {iou:.2f}",
        error=f"{100 * outcome.distance[index]:.1f} cm, {outcome.angle[index]:.0f}° off",
        triangles=np.asarray(case.object_b.mesh.triangles),
        reconstructed=surface_triangles(
            refine(model, encode(model, points), points), T_world_b, case.object_b.mesh.bounds
        ),
        T_object_true=np.linalg.inv(T_world_b) @ case.T_world_place_b,
        T_object_estimate=np.linalg.inv(T_world_b) @ T_world_estimate,
        size=QUERY_SIZE * case.scale,
    )
