"""Pictures on axes that are given, or on new ones: what `tdf.plot` draws."""

from typing import TYPE_CHECKING, Any, cast

import matplotlib
import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import ListedColormap, Normalize
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
from mpl_toolkits.mplot3d.axes3d import Axes3D

from tdf_jax._internal.errors import InputError
from tdf_jax.geometry.trajectory import Trajectory
from tdf_jax.uncertainty.modes import Mode
from tdf_jax.viz import polygons3d
from tdf_jax.viz.motion import motion_of
from tdf_jax.viz.scene3d import MARGIN, View, bounds, content, draw, frame, thinned, triangles_of
from tdf_jax.viz.style import CENTIMETRES, CLOUD, COLOURS, ESTIMATE, LIGHT, STYLE, add_axes3d, blank_figure, legend_of

if TYPE_CHECKING:
    import trimesh

SIZE = 4.6, 4.2  # inches, of a new figure with one 3-D panel
LEAST_RANGE = 1.05  # highest energy of a scale of colours, in the lowest: one pick has a scale too


def axes3d(function: str, ax: Any | None) -> tuple[Figure, Axes3D]:
    """The figure and its three-dimensional axes: those that are given, or new ones.

    Args:
        function: name that the error message begins with.
        ax: axes of matplotlib with projection="3d", or None.

    Raises:
        InputError: the axes are not three-dimensional.
    """
    if ax is None:
        figure = blank_figure(*SIZE)
        return figure, add_axes3d(figure, (0.02, 0.16, 0.9, 0.82))
    if getattr(ax, "name", None) != "3d":
        raise InputError(
            f"{function}: ax is {type(ax).__name__}; expected three-dimensional axes, as of "
            'figure.add_subplot(projection="3d")'
        )
    return cast(Figure, ax.figure), ax


def axes2d(function: str, ax: Any | None, size: tuple[float, float] = (4.8, 3.2)) -> tuple[Figure, Axes]:
    """The figure and its plane axes: those that are given, or new ones.

    Args:
        function: name that the error message begins with.
        ax: axes of matplotlib, or None.
        size: width and height of a new figure, inches.

    Raises:
        InputError: the axes are no plane axes of matplotlib.
    """
    if ax is None:
        figure = blank_figure(*size, layout="constrained")
        return figure, figure.add_subplot()
    if not isinstance(ax, Axes) or ax.name == "3d":
        raise InputError(f"{function}: ax is {type(ax).__name__}; expected axes of matplotlib in a plane")
    return cast(Figure, ax.figure), ax


def trajectory_panel(
    ax: Axes3D,
    trajectory: Trajectory,
    query: Float[np.ndarray, "queries 3"] | None = None,
    points: Float[np.ndarray, "points 3"] | None = None,
    mesh: "trimesh.Trimesh | None" = None,
    expected: Trajectory | None = None,
) -> None:
    """Draw a trajectory with its boxes of query points and, if there is one, its object.

    Args:
        ax: three-dimensional axes.
        trajectory: the trajectory, T_world_query.
        query: query points, (queries, 3), metres, query frame; None for small boxes that show the orientation.
        points: cloud of the object, (points, 3), metres, world frame.
        mesh: mesh of the object, drawn instead of the points.
        expected: ground truth, drawn dashed.
    """
    if query is None:
        reach = max(0.01, 0.05 * float(np.linalg.norm(np.ptp(np.asarray(trajectory.translations), axis=0))))
        query = reach * np.array([[-1.0, -1, -1], [1, 1, 1]])
    cloud = np.zeros((0, 3)) if points is None else np.asarray(points)
    view = View(cloud, triangles_of(mesh), trajectory, expected)
    box = bounds(np.asarray(query))
    shown = content(view, box)
    alone = not len(cloud) and view.triangles is None
    draw(ax, View(np.asarray(trajectory.translations), None, trajectory, expected) if alone else view, box)
    frame(ax, shown, MARGIN * np.ptp(shown, axis=0))
    _legend(ax, "object's points" if alone else None)


def candidates_panel(
    ax: Axes3D, modes: list[Mode], points: Float[np.ndarray, "points 3"], query: Float[np.ndarray, "queries 3"]
) -> None:
    """Draw the object with the box of query points at every distinct pick, coloured by the energy.

    Args:
        ax: three-dimensional axes.
        modes: the distinct picks by rising energy.
        points: cloud of the object, (points, 3), metres, world frame.
        query: query points, (queries, 3), metres, query frame.
    """
    energies = [mode.energy for mode in modes]
    scale = Normalize(energies[0], max(energies[-1], LEAST_RANGE * energies[0]))
    cloud = thinned(points)
    size: Any = 2.0
    ax.computed_zorder = False
    ax.scatter(*(CENTIMETRES * cloud.T), s=size, color=CLOUD, linewidths=0)
    pieces, contents = polygons3d.Pieces([], [], []), [cloud]
    for mode in reversed(modes):
        one = motion_of(np.asarray(mode.pose)[None], 0, 0)
        corners = bounds(np.asarray(query)) @ one.rotations[0].T + one.translations[0]
        pieces += polygons3d.box(CENTIMETRES * corners, COLOURS(0.9 * scale(mode.energy)))
        contents.append(corners)
    ax.add_collection3d(pieces.collection(), autolim=False)
    shown = np.concatenate(contents)
    frame(ax, shown, MARGIN * np.ptp(shown, axis=0))
    colours = ListedColormap(COLOURS(np.linspace(0, 0.9, 64)))
    bar = cast(Figure, ax.figure).colorbar(
        ScalarMappable(scale, colours), ax=ax, orientation="horizontal", shrink=0.6, pad=0.02, aspect=30
    )
    bar.set_label(f"energy of the {len(modes)} distinct picks (no unit)")
    bar.locator = MaxNLocator(4)
    bar.update_ticks()


def losses_panel(ax: Axes, losses: Float[np.ndarray, "rows steps"], best: int, rows: str = "candidate") -> None:
    """Draw the loss of every candidate against the steps, the best bold.

    Args:
        ax: plane axes.
        losses: energies, (rows, steps); a curve ends where it becomes non-finite.
        best: number of the best row.
        rows: what a row is, for the legend.
    """
    losses = np.asarray(losses)
    steps = np.arange(losses.shape[1])
    for index, row in enumerate(losses):
        if index != best:
            ax.plot(steps, row, color=CLOUD, lw=0.7, alpha=0.8, label=f"other {rows}s")
    ax.plot(steps, losses[best], color=COLOURS(0.35), lw=2.0, label=f"best, {rows} {best + 1} of {len(losses)}")
    legend = legend_of(ax)
    ax.legend(legend.values(), legend.keys(), frameon=False)
    ax.set(xlabel="step", ylabel="loss (no unit)", xlim=(0, max(1, steps[-1])))
    ax.set_ylim(bottom=0)
    ax.xaxis.set_major_locator(MaxNLocator(integer=True))
    ax.spines[["top", "right"]].set_visible(False)
    ax.grid(alpha=0.25, lw=0.5)


def surface_panel(ax: Axes3D, triangles: Float[np.ndarray, "faces 3 3"], points: Float[np.ndarray, "points 3"]) -> None:
    """Draw a reconstructed surface with the points that it was reconstructed from.

    Args:
        ax: three-dimensional axes.
        triangles: the surface, (faces, 3, 3), metres, world frame; it may have no triangle.
        points: the points, (points, 3), metres, world frame.
    """
    points = np.asarray(points)
    cloud = thinned(points)
    ax.computed_zorder = False
    if len(triangles):
        ax.add_collection3d(polygons3d.surface(CENTIMETRES * triangles, LIGHT).collection(), autolim=False)
    else:
        ax.text2D(0.5, 0.9, "no point is inside: the surface is empty", ha="center", transform=ax.transAxes)
    size: Any = 3.0
    ax.scatter(*(CENTIMETRES * cloud.T), s=size, color=ESTIMATE, alpha=0.8, linewidths=0, label="points of the cloud")
    shown = np.concatenate([points, triangles.reshape(-1, 3)])
    frame(ax, shown, MARGIN * np.ptp(shown, axis=0))
    _legend(ax)


def _legend(ax: Axes3D, without: str | None = None) -> None:
    legend = {name: handle for name, handle in legend_of(ax).items() if name != without}
    if legend:
        place = {
            "loc": "upper center",
            "bbox_to_anchor": (0.5, -0.085),
            "frameon": False,
            "fontsize": 7,
            "markerscale": 2,
        }
        ax.legend(legend.values(), legend.keys(), **place)


def styled():
    """The style of all pictures, for a `with` block."""
    return matplotlib.rc_context(STYLE)
