"""Figures of an imitation, in matplotlib and without its global state: each function returns a `Figure`."""

import dataclasses
import os
from pathlib import Path
from typing import TYPE_CHECKING

import matplotlib
import numpy as np
from jaxtyping import Float
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.cm import ScalarMappable
from matplotlib.colors import BoundaryNorm, ListedColormap
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
from mpl_toolkits.mplot3d.axes3d import Axes3D

from tdf_jax.demonstration import Demonstration
from tdf_jax.files import replace_file
from tdf_jax.trajectory import Trajectory
from tdf_jax.viz import solid

if TYPE_CHECKING:
    import trimesh

COLOURS = matplotlib.colormaps["viridis"]  # readable in grey and by the colour-blind
CLOUD, INK, TRUTH = "#56616e", "#222222", "#d1495b"
CENTIMETRES = 100.0  # in pictures; metres everywhere else
STYLE = {"font.size": 8, "axes.titlesize": 9, "figure.titlesize": 9.5, "legend.fontsize": 8, "axes.edgecolor": INK}
DPI = 200
SHOWN_POINTS = 1500  # of a cloud; more are a blot at the width of a page
VIEW = {"elev": 22, "azim": -38}  # the handle faces the reader, the way to the place runs to the right
LIGHT = np.array([0.13, -0.60, 0.79])  # from above the reader's left
MOST_TRIANGLES = 40_000  # of a mesh that is drawn as such: 1 s of matplotlib


@dataclasses.dataclass(frozen=True)
class _View:
    """One side of the picture, in metres: the object, as triangles where they are known, and the paths."""

    points: Float[np.ndarray, "points 3"]
    triangles: Float[np.ndarray, "faces 3 3"] | None
    trajectory: Trajectory
    expected: Trajectory | None


def imitation_figure(
    demonstration: Demonstration,
    points: Float[np.ndarray, "points 3"],
    trajectory: Trajectory,
    expected: Trajectory | None = None,
    meshes: "tuple[trimesh.Trimesh | None, trimesh.Trimesh | None]" = (None, None),
    title: str = "",
) -> Figure:
    """Reference and test side by side, as in figure 4 of the paper.

    Args:
        demonstration: the reference.
        points: the test object's cloud, metres, world frame.
        trajectory: found on the test object.
        expected: the true one, drawn dashed.
        meshes: of the reference's and the test's object, metres, world frame; drawn instead of the points.
        title: above both.

    Returns:
        The figure; its axes are the reference, the test and the colour bar.
    """
    box = _bounds(np.asarray(demonstration.query))
    triangles = [None if mesh is None else np.asarray(mesh.triangles) for mesh in meshes]
    triangles = [None if corners is None or len(corners) > MOST_TRIANGLES else corners for corners in triangles]
    views = {
        "reference": _View(np.asarray(demonstration.points), triangles[0], demonstration.trajectory, None),
        "test": _View(np.asarray(points), triangles[1], trajectory, expected),
    }
    contents = [_content(view, box) for view in views.values()]
    size = np.max([np.ptp(content, axis=0) for content in contents], axis=0) * 1.06
    with matplotlib.rc_context(STYLE):
        figure = _figure(7.2, 4.5)
        legend = {}
        for column, (name, view) in enumerate(views.items()):
            axes = figure.add_axes((0.5 * column - 0.005, 0.17, 0.46, 0.74), projection="3d")
            _draw_view(axes, view, box)
            _frame(axes, contents[column], size)
            axes.set_title(name, y=0.99)
            legend |= _legend(axes)
        _waypoint_bar(figure, trajectory.poses)
        placing = {"loc": "lower left", "bbox_to_anchor": (0.02, 0.0), "frameon": False}
        figure.legend(legend.values(), legend.keys(), **placing)
        figure.suptitle(title, y=0.98)
    return figure


def loss_figure(losses: Float[np.ndarray, "inits iterations"], best: int, title: str = "") -> Figure:
    """Loss against iteration of every start, as in figure 5 of the paper.

    Args:
        losses: energies; a start that became non-finite ends there.
        best: the start drawn bold.
        title: above.
    """
    losses = np.asarray(losses)
    steps = np.arange(losses.shape[1])
    with matplotlib.rc_context(STYLE):
        figure = _figure(4.8, 3.2, layout="constrained")
        axes = figure.add_subplot()
        for index, row in enumerate(losses):
            if index != best:
                axes.plot(steps, row, color=CLOUD, lw=0.7, alpha=0.8, label="other starts")
        axes.plot(steps, losses[best], color=COLOURS(0.35), lw=2.0, label=f"best, start {best + 1} of {len(losses)}")
        legend = _legend(axes)
        axes.legend(legend.values(), legend.keys(), frameon=False)
        axes.set(xlabel="iteration", ylabel="loss (no unit)", title=title, xlim=(0, max(1, steps[-1])))
        axes.set_ylim(bottom=0)
        axes.xaxis.set_major_locator(MaxNLocator(integer=True))
        axes.spines[["top", "right"]].set_visible(False)
        axes.grid(alpha=0.25, lw=0.5)
    return figure


def save_figure(path: str | os.PathLike, figure: Figure) -> None:
    """Write a figure as a .png, whole or not at all.

    Raises:
        InputError: the file cannot be written.
    """
    replace_file("save_figure", Path(path), lambda file: figure.savefig(file, format="png", dpi=DPI))


def _figure(width: float, height: float, layout: str | None = None) -> Figure:
    """Inches; a page's text is about 7 wide."""
    figure = Figure(figsize=(width, height), layout=layout, facecolor="white")
    FigureCanvasAgg(figure)
    return figure


def _legend(axes) -> dict:
    """One handle a label."""
    return {label: handle for handle, label in zip(*axes.get_legend_handles_labels())}


def _bounds(query):
    """Corners (8, 3) of the query points' bounding box, in the query frame."""
    low, high = query.min(axis=0), query.max(axis=0)
    return low + solid.CORNERS * (high - low)


def _carried(trajectory, box):
    """Corners of the box at every waypoint, (poses, 8, 3), world frame."""
    R, t = np.asarray(trajectory.rotations), np.asarray(trajectory.translations)
    return np.einsum("nij,cj->nci", R, box) + t[:, None]


def _content(view: _View, box):
    """Every point that a view has to show."""
    paths = [path for path in (view.trajectory, view.expected) if path is not None]
    return np.concatenate([view.points, *(_carried(path, box).reshape(-1, 3) for path in paths)])


def _draw_view(axes: Axes3D, view: _View, box) -> None:
    pieces = solid.Pieces([], [], [])
    if view.triangles is None:
        cloud = view.points[:: -(-len(view.points) // SHOWN_POINTS)]
        axes.scatter(*(CENTIMETRES * cloud.T), s=2.4, color=CLOUD, linewidths=0, label="object's points")
    else:
        pieces += solid.surface(CENTIMETRES * view.triangles, LIGHT)
    corners = CENTIMETRES * _carried(view.trajectory, box)
    for fraction, one in zip(np.linspace(0, 1, len(corners)), corners):
        pieces += solid.box(one, COLOURS(fraction))
    if view.expected is not None:
        pieces += solid.box(CENTIMETRES * _carried(view.expected, box)[0], TRUTH, filled=False, dashed=True)
    axes.computed_zorder = False
    # `_frame` sets the limits. Left to matplotlib, they are taken over polygons padded to one length with uninitialised
    # memory: once in a while an overflow.
    axes.add_collection3d(pieces.collection(), autolim=False)
    line = {"lw": 1.2, "marker": "o", "ms": 2.5}
    if view.expected is not None:
        path = CENTIMETRES * np.asarray(view.expected.translations)
        axes.plot(*path.T, color=TRUTH, ls=(0, (3, 2)), mfc="white", zorder=5, label="true trajectory and pick", **line)
    path = CENTIMETRES * np.asarray(view.trajectory.translations)
    axes.plot(*path.T, color=INK, zorder=6, label="trajectory of the query frame", **line)


def _frame(axes: Axes3D, content, size) -> None:
    """Equal scale on all axes and in both views; few ticks, so that they do not touch."""
    centre = (content.min(axis=0) + content.max(axis=0)) / 2
    for name, middle, length in zip("xyz", CENTIMETRES * centre, CENTIMETRES * size):
        getattr(axes, f"set_{name}lim")(middle - length / 2, middle + length / 2)
        getattr(axes, f"set_{name}label")(f"{name} (cm)", labelpad=-6)
        axis = getattr(axes, f"{name}axis")
        axis.set_major_locator(MaxNLocator(4))
        axis.set_pane_color((0.97, 0.97, 0.97))
        axis._axinfo["grid"].update(color=(0.87, 0.87, 0.87), linewidth=0.5)
    axes.tick_params(pad=-2, labelsize=7)
    axes.set_box_aspect(tuple(size), zoom=1.01)  # a copy: matplotlib changes an array in place
    axes.patch.set_visible(False)
    axes.view_init(**VIEW)


def _waypoint_bar(figure: Figure, poses: int) -> None:
    axes = figure.add_axes((0.62, 0.085, 0.3, 0.025))
    norm = BoundaryNorm(np.arange(poses + 1) - 0.5, poses)
    colours = ListedColormap(COLOURS(np.linspace(0, 1, poses)))
    bar = figure.colorbar(ScalarMappable(norm, colours), cax=axes, orientation="horizontal", ticks=[0, poses - 1])
    bar.set_ticklabels(["pick", "place"])
    bar.set_label("query boxes; the filled face is +x of the query frame", labelpad=1)
    bar.ax.tick_params(length=0)
