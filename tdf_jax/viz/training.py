"""Curves of a training run, in matplotlib without its global state."""

from collections.abc import Sequence

import matplotlib
import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import LogFormatter

from tdf_jax.viz.scene3d import WIDTH
from tdf_jax.viz.style import ESTIMATE, INK, PALE, STYLE, TRUTH, blank_figure, legend_of

PANELS = (
    ("bce", "occupancy: binary cross-entropy", "log"),
    ("iou", "occupancy: IoU at 0.5; transfer: success", "linear"),
    ("frame", "frame from the latent: squared error", "log"),
    ("place", "places: -log probability of the right pose", "linear"),
)
SMOOTH = 50  # steps over which the training curves are averaged
SETS = (("validation", "validation, complete clouds", TRUTH), ("one_view", "validation, one view", INK))


def training_figure(rows: Sequence[dict]) -> Figure:
    """Losses and IoU over the steps, of training batches and of both validations.

    Args:
        rows: metrics of the steps, from `tdf_jax.training.run_folder.metrics`.
    """
    with matplotlib.rc_context(STYLE):
        figure = blank_figure(WIDTH, 4.6, layout="constrained")
        axes = figure.subplots(2, 2, sharex=True)
        steps = np.array([row["step"] for row in rows])
        width = max(1, min(SMOOTH, len(rows) // 10))
        for panel, (name, label, scale) in zip(axes.flat, PANELS):
            values = np.convolve([row[name] for row in rows], np.ones(width) / width, mode="valid")
            panel.plot(steps[width - 1 :], values, color=PALE, lw=1, label=f"training, mean of {width} steps")
            for key, shown, colour in SETS:
                measured = [(row["step"], row[key][name]) for row in rows if key in row]
                panel.plot(*np.array(measured).reshape(-1, 2).T, color=colour, marker="o", ms=2.5, lw=1, label=shown)
            panel.set(title=label, yscale=scale)
            if scale == "log":
                panel.yaxis.set_major_formatter("{x:g}")
                # An axis of less than a decade would have no number with powers of ten only.
                panel.yaxis.set_minor_formatter(LogFormatter(minor_thresholds=(1, 0.5)))
            panel.grid(color="#dddddd", lw=0.5)
        shares = [(row["step"], row["transfer"]["success"]) for row in rows if "transfer" in row]
        transfer = axes[0, 1].plot(
            *np.array(shares).reshape(-1, 2).T, color=ESTIMATE, ls="--", marker="o", ms=2.5, lw=1
        )
        legend = legend_of(axes[0, 0]) | {"transfers within 2 cm and 20°": transfer[0]}
        figure.legend(legend.values(), legend.keys(), loc="outside lower center", ncols=2, frameon=False)
        for panel in axes[1]:
            panel.set_xlabel("step")
    return figure
