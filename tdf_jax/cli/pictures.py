"""The pictures of `tdf evaluate`."""

from pathlib import Path

import numpy as np

from tdf_jax.geometry import se3 as poses
from tdf_jax.evaluation.report import Outcomes, is_real
from tdf_jax._internal.errors import InputError
from tdf_jax.evaluation.comparison import Outcome
from tdf_jax.evaluation.pick_transfer import QUERY_SIZE
from tdf_jax.networks.model import Model, encode
from tdf_jax.networks.refinement import refine
from tdf_jax.viz.style import save_figure
from tdf_jax.viz.reconstruction import Panel, reconstructed, reconstruction_figure, transfer_figure

NAMES = ("reconstructions.png", "transfers.png")
MOST_GENERATED = 6


def draw(folder: Path, model: Model, outcomes: Outcomes) -> None:
    """Draw the first condition: up to `MOST_GENERATED` generated objects of a category, and every real one in its first pose.

    Args:
        folder: made if it is missing; pictures in it are replaced.
        model: whose outcomes are the first of each list.
        outcomes: of every method; baselines are not drawn.

    Raises:
        InputError: the folder or a picture cannot be written.
    """
    _, condition = next(iter(outcomes))
    panels = []
    for (objects, clouds), (outcome, *_) in outcomes.items():
        if clouds == condition:
            names = [case.instance for case in outcome.cases]
            firsts = [names.index(name) for name in dict.fromkeys(names)]
            panels += [_panel(model, outcome, index) for index in firsts[: None if is_real(objects) else MOST_GENERATED]]
    try:
        folder.mkdir(exist_ok=True)
    except OSError as error:
        raise InputError(f"tdf evaluate: cannot make {folder} ({error}); expected a place in an existing folder") from None
    words = f"weights {model.info.name}, cloud {condition}"
    figures = (
        reconstruction_figure(panels, f"Surfaces of occupancy 0.5, refined: {words}"),
        transfer_figure(panels, f"The place of a demonstration on other objects: {words}"),
    )
    for name, figure in zip(NAMES, figures):
        save_figure(folder / name, figure)


def _panel(model: Model, outcome: Outcome, index: int) -> Panel:
    case, iou = outcome.cases[index], outcome.ious["iou_refined"][index]
    T_world_b = case.T_world_b
    T_world_found = np.eye(4)
    T_world_found[:3, :3], T_world_found[:3, 3] = poses.rotation(outcome.found[index]), outcome.found[index][4:]
    return Panel(
        name=case.instance,
        overlap="IoU n/a: not closed" if iou is None else f"IoU {iou:.2f}",
        error=f"{100 * outcome.distance[index]:.1f} cm, {outcome.angle[index]:.0f}° off",
        triangles=np.asarray(case.object_b.mesh.triangles),
        found=reconstructed(refine(model, encode(model, case.points_b), case.points_b), T_world_b, case.object_b.mesh.bounds),
        T_object_true=np.linalg.inv(T_world_b) @ case.T_world_place_b,
        T_object_found=np.linalg.inv(T_world_b) @ T_world_found,
        size=QUERY_SIZE * case.scale,
    )
