"""Colours, sizes and the canvas that all pictures share; a picture is a file of numbers until `save_figure`."""

import os
from pathlib import Path

import matplotlib
import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from tdf_jax._internal.files import replace_file

COLOURS = matplotlib.colormaps["viridis"]  # readable in grey and by the colour-blind
CLOUD, INK, TRUTH = "#56616e", "#222222", "#d1495b"
CENTIMETRES = 100.0  # in pictures; metres everywhere else
STYLE = {"font.size": 8, "axes.titlesize": 9, "figure.titlesize": 9.5, "legend.fontsize": 8, "axes.edgecolor": INK}
DPI = 200
LIGHT = np.array([0.13, -0.60, 0.79])  # from above the reader's left


def save_figure(path: str | os.PathLike, figure: Figure) -> None:
    """Write a figure as a .png, whole or not at all.

    Raises:
        InputError: the file cannot be written.
    """
    replace_file("save_figure", Path(path), lambda file: figure.savefig(file, format="png", dpi=DPI))


def blank_figure(width: float, height: float, layout: str | None = None) -> Figure:
    """A white figure of so many inches; a page's text is about 7 wide."""
    figure = Figure(figsize=(width, height), layout=layout, facecolor="white")
    FigureCanvasAgg(figure)
    return figure


def legend_of(axes) -> dict:
    """Labels and handles of axes, one handle a label."""
    return {label: handle for handle, label in zip(*axes.get_legend_handles_labels())}
