"""How objects show themselves in a notebook: a short table and a picture."""

import base64
import html
import io
from collections.abc import Callable, Mapping
from typing import Any

import jax
import numpy as np
from matplotlib.figure import Figure

from tdf_jax.geometry.demonstration import Demonstration
from tdf_jax.geometry.trajectory import Trajectory
from tdf_jax.landscape.storage import Landscape
from tdf_jax.networks.model import Model
from tdf_jax.solvers.result import Result
from tdf_jax.viz.landscapes import Marks, map_panel
from tdf_jax.viz.single import axes2d, axes3d, losses_panel, styled, trajectory_panel
from tdf_jax.viz.style import CENTIMETRES, COLOURS

DPI = 100


def card(title: str, rows: Mapping[str, str], draw: Callable[[], Figure] | None) -> str:
    """A table with a picture beside it, HTML.

    Args:
        title: caption of the table.
        rows: the table.
        draw: draws the picture; None for none. A picture that fails leaves the table.
    """
    left = "style='text-align:left; white-space:normal'"
    lines = "".join(
        f"<tr><th {left}>{html.escape(name)}</th><td {left}>{html.escape(value)}</td></tr>"
        for name, value in rows.items()
    )
    table = f"<table><caption>{html.escape(title)}</caption>{lines}</table>"
    if draw is None:
        return table
    try:
        content = io.BytesIO()
        draw().savefig(content, format="png", dpi=DPI)
    except Exception:  # what is displayed must not fail, and the table says the rest
        return table
    picture = base64.b64encode(content.getvalue()).decode()
    image = f"<img alt='{html.escape(title)}' style='max-width:460px' src='data:image/png;base64,{picture}'>"
    return f"<div style='display:flex; flex-wrap:wrap; gap:16px; align-items:center'>{table}{image}</div>"


def result_card(result: Result, rows: Mapping[str, str]) -> str:
    """A result: its summary, and the energy of every candidate against the steps.

    Args:
        result: one result, not traced.
        rows: its summary.
    """

    def draw() -> Figure:
        with styled():
            figure, axes = axes2d("card()", None)
            losses_panel(axes, np.asarray(result.candidate_history), int(result.best))
        return figure

    return card("Result", rows, draw)


def trajectory_card(trajectory: Trajectory) -> str:
    """A trajectory: its length, and its path with the orientations.

    Args:
        trajectory: one trajectory, not traced.
    """

    def draw() -> Figure:
        with styled():
            figure, axes = axes3d("card()", None)
            trajectory_panel(axes, trajectory)
        return figure

    return card("Trajectory", _path_rows(trajectory), draw)


def demonstration_card(demonstration: Demonstration) -> str:
    """A demonstration: its sizes, and its object with the boxes along the path.

    Args:
        demonstration: the demonstration, not traced.
    """
    points, query, target = demonstration.points, demonstration.query, demonstration.target
    release = demonstration.release % demonstration.trajectory.num_poses
    rows = {
        "object": f"{len(points)} points, {_extent(points)}",
        **_path_rows(demonstration.trajectory),
        "grasp, release": f"pose {demonstration.grasp}, pose {release}",
        "query points": f"{len(query)} in {_extent(query)}",
        "target": "none" if target is None else f"{len(target.points)} points, {_extent(target.points)}",
    }

    def draw() -> Figure:
        with styled():
            figure, axes = axes3d("card()", None)
            trajectory_panel(axes, demonstration.trajectory, np.asarray(query), np.asarray(points))
        return figure

    return card("Demonstration", rows, draw)


def landscape_card(landscape: Landscape) -> str:
    """A landscape: its grid and its energies, and the map of a plane or of the middle slice of a volume.

    Args:
        landscape: the landscape.
    """
    energy, grid = landscape.combined, landscape.grid
    steps = ", ".join(f"{CENTIMETRES * step:.2g}" for step in grid.steps)
    rows = {
        "grid": " x ".join(map(str, grid.shape)) + f" points, {steps} cm apart",
        "waypoints": f"{len(landscape.waypoints)}, combined by {landscape.reduce!r}",
        "orientations": f"{len(landscape.rotations)}",
        "energy": f"{np.nanmin(energy):.5f} to {np.nanmax(energy):.5f}, median {np.nanmedian(energy):.5f}",
    }

    def draw() -> Figure:
        with styled():
            figure, axes = axes2d("card()", None, (4.2, 3.6))
            map_panel(axes, landscape, Marks(np.zeros((0, 3))))
        return figure

    drawn = energy.shape == grid.shape and len(grid.shape) in (2, 3)
    return card("Landscape", rows, draw if drawn else None)


def model_card(model: Model) -> str:
    """A network: its origin and its sizes, and the number of parameters of its parts.

    Args:
        model: the network.
    """
    parts = {
        name: sum(int(np.size(leaf)) for leaf in jax.tree.leaves(value)) for name, value in sorted(model.params.items())
    }
    info, config = model.info, model.config
    rows = {
        "name": info.name,
        "source": info.source,
        "descriptors": f"{config.channels} channels, latent ({config.latent}, 3)",
        "parameters": f"{sum(parts.values()):,}",
    }
    if info.cloud_points is not None:
        rows["clouds"] = f"{info.cloud_points} points in training"
    if info.smallest_diagonal is not None and info.largest_diagonal is not None:
        rows["objects"] = f"{100 * info.smallest_diagonal:.0f} to {100 * info.largest_diagonal:.0f} cm in training"

    def draw() -> Figure:
        with styled():
            figure, axes = axes2d("card()", None, (4.2, 1.0 + 0.3 * len(parts)))
            axes.barh(list(parts), [count / 1000 for count in parts.values()], color=COLOURS(0.35))
            axes.invert_yaxis()
            axes.set(xlabel="parameters (thousands)")
            axes.spines[["top", "right"]].set_visible(False)
        return figure

    return card("Model", rows, draw)


def _path_rows(trajectory: Trajectory) -> dict[str, str]:
    t = np.asarray(trajectory.translations, float)
    length = float(np.linalg.norm(np.diff(t, axis=0), axis=1).sum())
    return {
        "poses": f"{len(t)}, T_world_query",
        "path": f"{CENTIMETRES * length:.1f} cm long, from {_place(t[0])} to {_place(t[-1])}",
    }


def _place(xyz: Any) -> str:
    return "(" + ", ".join(f"{CENTIMETRES * value:.1f}" for value in xyz) + ") cm"


def _extent(points: Any) -> str:
    return " x ".join(f"{CENTIMETRES * side:.1f}" for side in np.ptp(np.asarray(points), axis=0)) + " cm"
