"""An object with a trajectory of query boxes in three dimensions: the panel that several pictures share."""

import dataclasses
from collections.abc import Sequence
from typing import TYPE_CHECKING

import matplotlib
import numpy as np
from jaxtyping import Float
from matplotlib.cm import ScalarMappable
from matplotlib.colors import BoundaryNorm, ListedColormap
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
from mpl_toolkits.mplot3d.axes3d import Axes3D

from tdf_jax.geometry.trajectory import Trajectory
from tdf_jax.viz import polygons3d
from tdf_jax.viz.style import CENTIMETRES, CLOUD, COLOURS, INK, LIGHT, STYLE, TRUTH, blank_figure, legend_of

if TYPE_CHECKING:
    import trimesh

WIDTH = 7.2  # inches, a page's text
SHOWN_POINTS = 1500  # of a cloud; more are a blot at the width of a page
VIEW = {"elev": 22, "azim": -38}  # the handle faces the reader, the way to the place runs to the right
MOST_TRIANGLES = 40_000  # of a mesh that is drawn as such: 1 s of matplotlib


@dataclasses.dataclass(frozen=True)
class View:
    """One panel, in metres: the object, as triangles where they are known, and the paths.

    Attributes:
        points: the object's cloud.
        triangles: its mesh, drawn instead of the points; see `triangles_of`.
        trajectory: drawn with its boxes.
        expected: the true one, drawn dashed.
        reference: the demonstration's, drawn thin.
    """

    points: Float[np.ndarray, "points 3"]
    triangles: Float[np.ndarray, "faces 3 3"] | None
    trajectory: Trajectory
    expected: Trajectory | None = None
    reference: Trajectory | None = None


def triangles_of(mesh: "trimesh.Trimesh | None") -> Float[np.ndarray, "faces 3 3"] | None:
    """A mesh's triangles; None where it is missing or has too many to draw."""
    if mesh is None or len(mesh.faces) > MOST_TRIANGLES:
        return None
    return np.asarray(mesh.triangles)


def bounds(query: Float[np.ndarray, "queries 3"]) -> Float[np.ndarray, "8 3"]:
    """Corners of the query points' bounding box, in the query frame."""
    low, high = query.min(axis=0), query.max(axis=0)
    return low + polygons3d.CORNERS * (high - low)


def _carried(trajectory, box):
    """Corners of the box at every waypoint, (poses, 8, 3), world frame."""
    R, t = np.asarray(trajectory.rotations), np.asarray(trajectory.translations)
    return np.einsum("nij,cj->nci", R, box) + t[:, None]


def content(view: View, box: Float[np.ndarray, "8 3"]) -> Float[np.ndarray, "points 3"]:
    """Every point that a view has to show."""
    paths = [path for path in (view.trajectory, view.expected, view.reference) if path is not None]
    return np.concatenate([view.points, *(_carried(path, box).reshape(-1, 3) for path in paths)])


def draw(axes: Axes3D, view: View, box: Float[np.ndarray, "8 3"]) -> None:
    """Draw a view's object, boxes and paths."""
    pieces = polygons3d.Pieces([], [], [])
    if view.triangles is None:
        cloud = view.points[:: -(-len(view.points) // SHOWN_POINTS)]
        axes.scatter(*(CENTIMETRES * cloud.T), s=2.4, color=CLOUD, linewidths=0, label="object's points")
    else:
        pieces += polygons3d.surface(CENTIMETRES * view.triangles, LIGHT)
    corners = CENTIMETRES * _carried(view.trajectory, box)
    for fraction, one in zip(np.linspace(0, 1, len(corners)), corners):
        pieces += polygons3d.box(one, COLOURS(fraction))
    if view.expected is not None:
        pieces += polygons3d.box(CENTIMETRES * _carried(view.expected, box)[0], TRUTH, filled=False, dashed=True)
    axes.computed_zorder = False
    # `frame` sets the limits. Left to matplotlib, they are taken over polygons padded to one length with uninitialised
    # memory: once in a while an overflow.
    axes.add_collection3d(pieces.collection(), autolim=False)
    line = {"lw": 1.2, "marker": "o", "ms": 2.5}
    if view.expected is not None:
        path = CENTIMETRES * np.asarray(view.expected.translations)
        axes.plot(*path.T, color=TRUTH, ls=(0, (3, 2)), mfc="white", zorder=5, label="true trajectory and pick", **line)
    if view.reference is not None:
        path = CENTIMETRES * np.asarray(view.reference.translations)
        axes.plot(*path.T, color=CLOUD, ls=":", lw=1.2, zorder=4, label="reference trajectory")
    path = CENTIMETRES * np.asarray(view.trajectory.translations)
    axes.plot(*path.T, color=INK, zorder=6, label="trajectory of the query frame", **line)


def frame(axes: Axes3D, content: Float[np.ndarray, "points 3"], size: Float[np.ndarray, "3"]) -> None:
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


def panels(
    views: Sequence[tuple[str, View]], columns: int, box: Float[np.ndarray, "8 3"], poses: int, share: float = 0.93
) -> Figure:
    """Three-dimensional views at one scale, with a legend below.

    Args:
        views: by their titles, from the upper left.
        columns: panels in a row.
        box: corners of the query points' bounding box, query frame, metres.
        poses: of the trajectories.
        share: of a row's height that its panels take; tall contents need more room between rows.
    """
    rows = -(-len(views) // columns)
    contents = [content(view, box) for _, view in views]
    size = np.max([np.ptp(one, axis=0) for one in contents], axis=0) * 1.06
    height = 6.6 / columns * rows + 0.6
    foot = 0.6 / height
    with matplotlib.rc_context(STYLE):
        figure = blank_figure(WIDTH, height)
        legend = {}
        for index, (title, view) in enumerate(views):
            row, column = divmod(index, columns)
            tall = (1 - foot) / rows
            axes = figure.add_axes(
                (
                    (column + 0.07) / columns,
                    foot + tall * (rows - 1 - row + (0.93 - share) / 2),
                    0.83 / columns,
                    share * tall,
                ),
                projection="3d",
            )
            draw(axes, view, box)
            frame(axes, contents[index], size)
            axes.set_title(title, y=1.0, fontsize=8)
            legend |= legend_of(axes)
        waypoint_bar(figure, poses, (0.62, 0.42 / height, 0.3, 0.1 / height))
        figure.legend(legend.values(), legend.keys(), loc="lower left", bbox_to_anchor=(0.01, 0.0), frameon=False)
    return figure


def waypoint_bar(figure: Figure, poses: int, place: tuple[float, float, float, float]) -> None:
    """The colours of the query boxes, in a rectangle of the figure."""
    axes = figure.add_axes(place)
    norm = BoundaryNorm(np.arange(poses + 1) - 0.5, poses)
    colours = ListedColormap(COLOURS(np.linspace(0, 1, poses)))
    bar = figure.colorbar(ScalarMappable(norm, colours), cax=axes, orientation="horizontal", ticks=[0, poses - 1])
    bar.set_ticklabels(["pick", "place"])
    bar.set_label("query boxes; the filled face is +x of the query frame", labelpad=1)
    bar.ax.tick_params(length=0)
