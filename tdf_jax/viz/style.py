"""Colours, sizes and the canvas that all pictures share."""

import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal, cast

import matplotlib
import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from mpl_toolkits.mplot3d.axes3d import Axes3D

from tdf_jax._internal.files import replace_file

COLOURS = matplotlib.colormaps["viridis"]  # this map is readable in grey and by the colour-blind
CLOUD, INK, TRUTH = "#56616e", "#222222", "#d1495b"
ESTIMATE, MARKED, WAYPOINTS = "#2a6f97", "#f4845f", "#e9c46a"  # estimates; a place or path of its own; waypoints
CONTACT = "#c77dff"  # contact regions: this lilac is far from the others for every kind of colour blindness
PALE = "#9aa5b1"  # what is behind the subject
VIEW = {"elev": 22.0, "azim": -38.0}  # degrees: the handle faces the reader, and the path runs to the right
CENTIMETRES = 100.0  # unit of pictures; all other code uses metres
STYLE: dict[Any, Any] = {
    "font.size": 8,
    "axes.titlesize": 9,
    "figure.titlesize": 9.5,
    "legend.fontsize": 8,
    "axes.edgecolor": INK,
}
DPI = 200
LIGHT = np.array([0.13, -0.60, 0.79])  # direction to the light, above and to the left of the reader


def save_figure(path: str | os.PathLike, figure: Figure) -> None:
    """Write a figure as a .png; the file appears only once it is complete.

    Args:
        path: the file, in an existing folder.
        figure: the figure.

    Raises:
        InputError: the file cannot be written.
    """
    replace_file("save_figure()", Path(path), lambda file: figure.savefig(file, format="png", dpi=DPI))


def blank_figure(width: float, height: float, layout: Literal["constrained"] | None = None) -> Figure:
    """A white figure.

    Args:
        width: width, inches; the text of a page is about 7 inches wide.
        height: height, inches.
        layout: layout engine of matplotlib.
    """
    figure = Figure(figsize=(width, height), layout=layout, facecolor="white")
    FigureCanvasAgg(figure)
    return figure


def legend_of(axes) -> dict:
    """The handles in the legend of axes by their labels, one handle for each label."""
    return {label: handle for handle, label in zip(*axes.get_legend_handles_labels())}


def add_axes3d(figure: Figure, rectangle: tuple[float, float, float, float]) -> Axes3D:
    """Three-dimensional axes.

    Args:
        figure: the figure.
        rectangle: left, bottom, width and height, shares of the figure.
    """
    return cast(Axes3D, figure.add_axes(rectangle, projection="3d"))


def set_view(axes: Axes3D, size: Sequence[float], zoom: float, angles: dict[str, float]) -> None:
    """Set the proportions and the direction of view of three-dimensional axes.

    Args:
        axes: the axes.
        size: lengths of the three axes, (3,), any unit.
        zoom: magnification.
        angles: "elev" and "azim", degrees.
    """
    # The size is copied, because matplotlib changes an array in place. Zoom is declared with the type of its default.
    axes.set_box_aspect(tuple(size), zoom=zoom)  # pyright: ignore[reportArgumentType]
    axes.view_init(elev=angles["elev"], azim=angles["azim"])
