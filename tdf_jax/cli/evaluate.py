"""`tdf evaluate`: how well weights transfer a pose to unseen generated objects and to real meshes, beside baselines."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from tdf_jax._internal.errors import InputError

if TYPE_CHECKING:
    from tdf_jax.evaluation.comparison import Outcome
    from tdf_jax.evaluation.report import Outcomes
    from tdf_jax.networks.model import Model
    from tdf_jax.viz.reconstruction import Panel

NAMES = ("reconstructions.png", "transfers.png")
MOST_GENERATED = 6
_NONE = "(default: none)"
Category = Literal["mug", "bowl", "bottle"]
Cloud = Literal[
    "full", "views1", "views2", "views4", "points300", "points1000", "points3000", "noise", "half", "double", "all"
]


def evaluate(
    weights: str = "mug",
    category: Annotated[
        tuple[Category, ...], tyro.conf.arg(help_behavior_hint="(default: that of shipped weights; mug)")
    ] = (),
    pairs: int = 50,
    seed: int = 0,
    size: Annotated[float | None, tyro.conf.arg(help_behavior_hint="(default: 0.12, 0.20, 0.22)")] = None,
    place: Annotated[str | None, tyro.conf.arg(help_behavior_hint="(default: handle, rim, neck)")] = None,
    inits: int = 10,
    iterations: int = 100,
    clouds: tuple[Cloud, ...] = ("full",),
    baselines: bool = False,
    meshes: Annotated[Path | None, tyro.conf.arg(metavar="DIR", help_behavior_hint=_NONE)] = None,
    poses: int = 5,
    json: Annotated[Path | None, tyro.conf.arg(metavar="FILE", help_behavior_hint=_NONE)] = None,
    card: Annotated[Path | None, tyro.conf.arg(metavar="FILE", help_behavior_hint=_NONE)] = None,
    figures: Annotated[Path | None, tyro.conf.arg(metavar="DIR", help_behavior_hint=_NONE)] = None,
) -> None:
    """Transfer one pose between unseen objects, the target under a uniform random rotation, and print the errors.

    Args:
        weights: a name of shipped weights, or a .safetensors file.
        category: mug, bowl, bottle; several are evaluated one after the other.
        pairs: generated pairs of each category; 0 for none, beside --meshes.
        seed: of the objects, poses, query points and starts.
        size: of generated objects, metres: a mug's height, the diagonal of others; a real one keeps its size, and is
            demonstrated on a generated one of that.
        place: of a mug the handle, rim or base; of a bowl the rim, base or body; of a bottle the neck, base or body.
        inits: random starts of each transfer; the one with the least loss counts.
        iterations: Adam steps.
        clouds: the new object's cloud: full; from 1, 2 or 4 cameras; of 300 to 3000 points; 300 with 2 mm noise; half
            or double size.
        baselines: also random weights, alignment of principal axes and ICP, on the same cases with as many starts.
        meshes: folder of real objects of these categories and their meshes.json; see docs/guide/evaluation.md.
        poses: random poses of each real object.
        json: write every number to this file.
        card: write a model card in Markdown.
        figures: draw reconstructions and transfers into this folder; needs the extra "mesh".
    """
    import functools
    import sys

    from tdf_jax.cli.options import categories_of
    from tdf_jax.evaluation import model_card as cards, report as scores
    from tdf_jax.evaluation.annotated_meshes import load_annotated
    from tdf_jax.evaluation.cases import generated_case, mesh_case
    from tdf_jax.evaluation.comparison import BASELINES, compare
    from tdf_jax.evaluation.conditions import CONDITIONS
    from tdf_jax.geometry.winding import libigl
    from tdf_jax.networks.checkpoint import load_model
    from tdf_jax.solvers.adam import OptimizeConfig

    _check_numbers(pairs, seed, size, clouds, meshes, poses)
    categories = tuple(dict.fromkeys(category or categories_of(weights)))
    _check_place(place, categories)
    _check_outputs(json, card, figures)
    if meshes is not None or figures is not None:
        libigl("tdf evaluate")
    config = OptimizeConfig(inits=inits, iterations=iterations)
    settings = {
        "weights": weights, "category": categories, "pairs": pairs, "seed": seed, "size": size, "place": place, "inits": inits, "iterations": iterations,
        "meshes": None if meshes is None else str(meshes), "poses": poses, "clouds": clouds,
    }  # fmt: skip
    targets = [] if meshes is None else load_annotated(meshes)
    model = load_model(weights)
    unasked = sorted({target.category for target in targets} - set(categories))
    if unasked:
        raise InputError(
            f"tdf evaluate: --meshes has a {unasked[0]}; expected {', '.join(categories)} only; add it to --category, or move it away"
        )
    makers = {}
    for name in categories:
        makers[scores.label(name)] = [
            functools.partial(generated_case, name, seed, index, size=size) for index in range(pairs)
        ]
        real = [target for target in targets if target.category == name]
        makers[scores.label(name, real=True)] = [
            functools.partial(mesh_case, seed, pose, target) for target in real for pose in range(poses)
        ]
    outcomes = {}
    for objects, several in makers.items():
        for condition in (CONDITIONS if "all" in clouds else dict.fromkeys(clouds)) if several else ():
            print(f"{objects}, cloud {condition}", file=sys.stderr)
            cases = [make(place=place, clouds=condition) for make in several]
            outcomes[objects, condition] = compare(
                cases, model, BASELINES if baselines else (), seed=seed, config=config
            )
            if json is not None:  # as far as it goes: all of it can take hours
                scores.write(json, scores.record(outcomes, settings, model))
    print(scores.table(outcomes, settings))
    sys.stdout.flush()
    if card is not None:
        cards.write(card, cards.card(model, outcomes, settings))
    if figures is not None:
        _draw(figures, model, outcomes)


def _check_numbers(pairs, seed, size, clouds, meshes, poses) -> None:

    if pairs < 1 and (meshes is None or pairs < 0):
        raise InputError(f"tdf evaluate: --pairs is {pairs}; expected at least 1, or 0 with --meshes")
    if poses < 1:
        raise InputError(f"tdf evaluate: --poses is {poses}; expected at least 1")
    if not 0 <= seed < 2**32:
        raise InputError(f"tdf evaluate: --seed is {seed}; expected 0 to {2**32 - 1}")
    if size is not None and not 0.01 <= size <= 1.0:
        raise InputError(f"tdf evaluate: --size is {size}; expected metres between 0.01 and 1")
    if not clouds:
        raise InputError("tdf evaluate: --clouds is empty; expected at least one condition, such as full")


def _check_place(place: str | None, categories: tuple[str, ...]) -> None:
    from tdf_jax.shapes import FAMILIES

    for category in categories:
        if place is not None and place not in FAMILIES[category].places:
            raise InputError(
                f"tdf evaluate: --place is {place!r}; expected one of a {category}'s: {', '.join(FAMILIES[category].places)}"
            )


def _check_outputs(json: Path | None, card: Path | None, figures: Path | None) -> None:
    """Refuse now what could not be written in an hour."""
    for name, path in (("json", json), ("card", card)):
        if path is not None and (path.is_dir() or not path.parent.is_dir()):
            raise InputError(f"tdf evaluate: --{name} is {path}; expected a file in an existing folder")
    if figures is not None and not (figures.is_dir() or (figures.parent.is_dir() and not figures.exists())):
        raise InputError(f"tdf evaluate: --figures is {figures}; expected a folder, or a new name in an existing one")


def _draw(folder: Path, model: "Model", outcomes: "Outcomes") -> None:
    """Draw the first condition: up to `MOST_GENERATED` generated objects of a category, and every real one in its first pose.

    Args:
        folder: made if it is missing; pictures in it are replaced.
        model: whose outcomes are the first of each list.
        outcomes: of every method; baselines are not drawn.

    Raises:
        InputError: the folder or a picture cannot be written.
    """
    from tdf_jax.evaluation.report import is_real
    from tdf_jax.viz.reconstruction import reconstruction_figure, transfer_figure
    from tdf_jax.viz.style import save_figure

    _, condition = next(iter(outcomes))
    panels = []
    for (objects, clouds), (outcome, *_) in outcomes.items():
        if clouds == condition:
            names = [case.instance for case in outcome.cases]
            firsts = [names.index(name) for name in dict.fromkeys(names)]
            panels += [
                _panel(model, outcome, index) for index in firsts[: None if is_real(objects) else MOST_GENERATED]
            ]
    try:
        folder.mkdir(exist_ok=True)
    except OSError as error:
        raise InputError(
            f"tdf evaluate: cannot make {folder} ({error}); expected a place in an existing folder"
        ) from None
    words = f"weights {model.info.name}, cloud {condition}"
    figures = (
        reconstruction_figure(panels, f"Surfaces of occupancy 0.5, refined: {words}"),
        transfer_figure(panels, f"The place of a demonstration on other objects: {words}"),
    )
    for name, figure in zip(NAMES, figures):
        save_figure(folder / name, figure)


def _panel(model: "Model", outcome: "Outcome", index: int) -> "Panel":
    import numpy as np

    from tdf_jax.evaluation.pick_transfer import QUERY_SIZE
    from tdf_jax.geometry import se3
    from tdf_jax.networks.encoding import encode
    from tdf_jax.networks.refinement import refine
    from tdf_jax.networks.surface import reconstructed
    from tdf_jax.viz.reconstruction import Panel

    case, iou = outcome.cases[index], outcome.ious["iou_refined"][index]
    T_world_b = case.T_world_b
    T_world_found = np.eye(4)
    T_world_found[:3, :3], T_world_found[:3, 3] = se3.rotation(outcome.found[index]), outcome.found[index][4:]
    return Panel(
        name=case.instance,
        overlap="IoU n/a: not closed" if iou is None else f"IoU {iou:.2f}",
        error=f"{100 * outcome.distance[index]:.1f} cm, {outcome.angle[index]:.0f}° off",
        triangles=np.asarray(case.object_b.mesh.triangles),
        found=reconstructed(
            refine(model, encode(model, case.points_b), case.points_b), T_world_b, case.object_b.mesh.bounds
        ),
        T_object_true=np.linalg.inv(T_world_b) @ case.T_world_place_b,
        T_object_found=np.linalg.inv(T_world_b) @ T_world_found,
        size=QUERY_SIZE * case.scale,
    )
