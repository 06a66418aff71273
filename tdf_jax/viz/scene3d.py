"""A three-dimensional panel of an object with a trajectory of query boxes, which several pictures share."""

import dataclasses
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import matplotlib
import numpy as np
from jaxtyping import Float, Int
from matplotlib.cm import ScalarMappable
from matplotlib.colors import BoundaryNorm, ListedColormap
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
from mpl_toolkits.mplot3d.axes3d import Axes3D

from tdf_jax.geometry.trajectory import Trajectory
from tdf_jax.viz import polygons3d
from tdf_jax.viz.style import (
    CENTIMETRES,
    CLOUD,
    COLOURS,
    INK,
    LIGHT,
    STYLE,
    TRUTH,
    VIEW,
    add_axes3d,
    blank_figure,
    legend_of,
    set_view,
)

if TYPE_CHECKING:
    import trimesh

WIDTH = 7.2  # width of a page's text, inches
SHOWN_POINTS = 1500  # points of a cloud; more points overlap at the width of a page
TICKS, LABEL = 4, -1.2  # intervals between ticks on the longest axis, and points between ticks and the axis's name
NEAR_LABEL = -6  # the same in narrow panels, whose neighbours would hide the names of z
MOST_BOXES = 8  # along a path: more would hide the object
MARGIN = 1.06  # length of the axes, in that of their contents
MOST_TRIANGLES = 40_000  # a mesh with more triangles is drawn as points, because matplotlib would take seconds


@dataclasses.dataclass(frozen=True)
class View:
    """Content of one panel, metres.

    Attributes:
        points: cloud of the object, (points, 3).
        triangles: mesh of the object, (faces, 3, 3), drawn instead of the points; see `triangles_of`.
        trajectory: trajectory that is drawn with its boxes.
        expected: ground truth, drawn dashed.
        reference: demonstrated trajectory, drawn dotted.
    """

    points: Float[np.ndarray, "points 3"]
    triangles: Float[np.ndarray, "faces 3 3"] | None
    trajectory: Trajectory
    expected: Trajectory | None = None
    reference: Trajectory | None = None


def triangles_of(mesh: "trimesh.Trimesh | None") -> Float[np.ndarray, "faces 3 3"] | None:
    """Triangles of a mesh, (faces, 3, 3); None if there is no mesh, or if it has too many triangles to draw."""
    if mesh is None or len(mesh.faces) > MOST_TRIANGLES:
        return None
    return np.asarray(mesh.triangles)


def thinned(points: Float[np.ndarray, "points 3"], most: int = SHOWN_POINTS) -> Float[np.ndarray, "shown 3"]:
    """Every k-th point of a cloud, so that few enough are left to draw.

    Args:
        points: the cloud, (points, 3); it may have no point.
        most: largest number of points that are left.
    """
    return np.asarray(points, float)[:: max(1, -(-len(points) // most))]


def bounds(query: Float[np.ndarray, "queries 3"]) -> Float[np.ndarray, "8 3"]:
    """Corners of the bounding box of query points, (8, 3), metres, query frame."""
    low, high = query.min(axis=0), query.max(axis=0)
    return low + polygons3d.CORNERS * (high - low)


def shown_boxes(num_poses: int) -> Int[np.ndarray, " boxes"]:
    """Indices of the poses whose boxes are drawn, (boxes,): all, or `MOST_BOXES` with the first and the last."""
    return np.unique(np.linspace(0, num_poses - 1, min(num_poses, MOST_BOXES)).round().astype(int))


def _carried(trajectory, box):
    """Corners of the box at every waypoint, (poses, 8, 3), world frame."""
    R, t = np.asarray(trajectory.rotations), np.asarray(trajectory.translations)
    return np.einsum("nij,cj->nci", R, box) + t[:, None]


def content(view: View, box: Float[np.ndarray, "8 3"]) -> Float[np.ndarray, "points 3"]:
    """All points that a view shows, (points, 3), metres.

    Args:
        view: the view.
        box: corners of the box of query points, (8, 3), metres, query frame.
    """
    paths = [path for path in (view.trajectory, view.expected, view.reference) if path is not None]
    return np.concatenate([view.points, *(_carried(path, box).reshape(-1, 3) for path in paths)])


def draw(axes: Axes3D, view: View, box: Float[np.ndarray, "8 3"]) -> None:
    """Draw the object, the boxes and the paths of a view; of more than `MOST_BOXES` boxes, that many, evenly chosen.

    Args:
        axes: the axes.
        view: the view.
        box: corners of the box of query points, (8, 3), metres, query frame.
    """
    pieces = polygons3d.Pieces([], [], [])
    if view.triangles is None:
        cloud = thinned(view.points)
        size: Any = 2.4  # square points; the declared type is that of the default
        axes.scatter(*(CENTIMETRES * cloud.T), s=size, color=CLOUD, linewidths=0, label="object's points")
    else:
        pieces += polygons3d.surface(CENTIMETRES * view.triangles, LIGHT)
    corners = CENTIMETRES * _carried(view.trajectory, box)
    for index in shown_boxes(len(corners)):
        pieces += polygons3d.box(corners[index], COLOURS(index / max(1, len(corners) - 1)))
    if view.expected is not None:
        pieces += polygons3d.box(CENTIMETRES * _carried(view.expected, box)[0], TRUTH, filled=False, dashed=True)
    axes.computed_zorder = False
    # `frame` sets the limits. Matplotlib would take them over polygons padded to one length with uninitialised memory,
    # which sometimes overflows.
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


def frame(
    axes: Axes3D, content: Float[np.ndarray, "points 3"], size: Float[np.ndarray, "3"], label: float = LABEL
) -> None:
    """Set equal scales on all axes, and few ticks, so that they do not touch.

    Args:
        axes: the axes.
        content: points in the middle of the axes, (points, 3), metres.
        size: lengths of the axes, (3,), metres; those of several panels are equal.
        label: distance of the names of the axes from the ticks, points.
    """
    centre = (content.min(axis=0) + content.max(axis=0)) / 2
    for name, middle, length in zip("xyz", CENTIMETRES * centre, CENTIMETRES * size):
        getattr(axes, f"set_{name}lim")(middle - length / 2, middle + length / 2)
        getattr(axes, f"set_{name}label")(f"{name} (cm)", labelpad=label)
        axis = getattr(axes, f"{name}axis")
        axis.set_major_locator(MaxNLocator(round(1 + (TICKS - 1) * length / max(CENTIMETRES * size))))
        axis.set_pane_color((0.97, 0.97, 0.97))
        axis._axinfo["grid"].update(color=(0.87, 0.87, 0.87), linewidth=0.5)
    axes.tick_params(pad=-2, labelsize=7)
    axes.patch.set_visible(False)
    set_view(axes, tuple(size), 1.01, VIEW)


def panels(
    views: Sequence[tuple[str, View]], columns: int, box: Float[np.ndarray, "8 3"], num_poses: int, share: float = 0.93
) -> Figure:
    """Three-dimensional views at one scale, with a legend below.

    Args:
        views: views with their titles, from the upper left.
        columns: number of panels in a row.
        box: corners of the box of query points, (8, 3), metres, query frame.
        num_poses: number of poses of the trajectories.
        share: share of the height of a row that its panels take; tall contents need more room between rows.
    """
    rows = -(-len(views) // columns)
    contents = [content(view, box) for _, view in views]
    size = np.max([np.ptp(one, axis=0) for one in contents], axis=0) * MARGIN
    height = 6.6 / columns * rows + 0.6
    foot = 0.6 / height
    with matplotlib.rc_context(STYLE):
        figure = blank_figure(WIDTH, height)
        legend = {}
        for index, (title, view) in enumerate(views):
            row, column = divmod(index, columns)
            tall = (1 - foot) / rows
            bottom = foot + tall * (rows - 1 - row + (0.93 - share) / 2)
            axes = add_axes3d(figure, ((column + 0.07) / columns, bottom, 0.83 / columns, share * tall))
            draw(axes, view, box)
            frame(axes, contents[index], size, LABEL if columns < 3 else NEAR_LABEL)
            axes.set_title(title, y=1.0, fontsize=8)
            legend |= legend_of(axes)
        waypoint_bar(figure, num_poses, (0.62, 0.42 / height, 0.3, 0.1 / height))
        figure.legend(legend.values(), legend.keys(), loc="lower left", bbox_to_anchor=(0.01, 0.0), frameon=False)
    return figure


def waypoint_bar(figure: Figure, num_poses: int, rectangle: tuple[float, float, float, float]) -> None:
    """Add a colour bar of the query boxes.

    Args:
        figure: the figure.
        num_poses: number of poses of the trajectory.
        rectangle: left, bottom, width and height, shares of the figure.
    """
    axes = figure.add_axes(rectangle)
    boxes = shown_boxes(num_poses)
    norm = BoundaryNorm(np.arange(len(boxes) + 1) - 0.5, len(boxes))
    colours = ListedColormap(COLOURS(boxes / max(1, num_poses - 1)))
    bar = figure.colorbar(ScalarMappable(norm, colours), cax=axes, orientation="horizontal", ticks=[0, len(boxes) - 1])
    bar.set_ticklabels(["pick", "place"])
    bar.set_label("query boxes; the filled face is +x of the query frame", labelpad=1)
    bar.ax.tick_params(length=0)
