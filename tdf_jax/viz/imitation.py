"""Figures of an imitation, without the global state of matplotlib: each function returns a `Figure`."""

from typing import TYPE_CHECKING

import matplotlib
import numpy as np
from jaxtyping import Float
from matplotlib.figure import Figure

from tdf_jax.geometry.demonstration import Demonstration
from tdf_jax.geometry.trajectory import Trajectory
from tdf_jax.viz.scene3d import MARGIN, WIDTH, View, bounds, content, draw, frame, triangles_of, waypoint_bar
from tdf_jax.viz.single import losses_panel
from tdf_jax.viz.style import STYLE, add_axes3d, blank_figure, legend_of

if TYPE_CHECKING:
    import trimesh


def imitation_figure(
    demonstration: Demonstration,
    points: Float[np.ndarray, "points 3"],
    trajectory: Trajectory,
    expected: Trajectory | None = None,
    meshes: "tuple[trimesh.Trimesh | None, trimesh.Trimesh | None]" = (None, None),
    title: str = "",
) -> Figure:
    """Demonstration and imitation side by side, as in figure 4 of the paper.

    Of a path with more than eight poses, eight boxes are drawn: the first, the last and others evenly between them.

    Args:
        demonstration: the demonstration.
        points: cloud of the new object, (points, 3), metres, world frame.
        trajectory: trajectory on the new object.
        expected: ground truth, drawn dashed.
        meshes: meshes of the demonstrated and the new object, metres, world frame; drawn instead of the points.
        title: title above both panels.

    Returns:
        The figure; its axes are those of the demonstration, of the imitation and of the colour bar.
    """
    box = bounds(np.asarray(demonstration.query))
    triangles = [triangles_of(mesh) for mesh in meshes]
    views = {
        "demonstration": View(np.asarray(demonstration.points), triangles[0], demonstration.trajectory),
        "imitation": View(np.asarray(points), triangles[1], trajectory, expected),
    }
    contents = [content(view, box) for view in views.values()]
    size = np.max([np.ptp(one, axis=0) for one in contents], axis=0) * MARGIN
    with matplotlib.rc_context(STYLE):
        figure = blank_figure(WIDTH, 4.5)
        legend = {}
        for column, (name, view) in enumerate(views.items()):
            axes = add_axes3d(figure, (0.5 * column - 0.005, 0.17, 0.46, 0.74))
            draw(axes, view, box)
            frame(axes, contents[column], size)
            axes.set_title(name, y=0.99)
            legend |= legend_of(axes)
        waypoint_bar(figure, trajectory.num_poses, (0.62, 0.085, 0.3, 0.025))
        placing = {"loc": "lower left", "bbox_to_anchor": (0.02, 0.0), "frameon": False}
        figure.legend(legend.values(), legend.keys(), **placing)
        figure.suptitle(title, y=0.98)
    return figure


def loss_figure(losses: Float[np.ndarray, "rows steps"], best: int, title: str = "", rows: str = "start") -> Figure:
    """Loss against the steps of every start, as in figure 5 of the paper.

    Args:
        losses: energies, (rows, steps); the curve of a row ends where it becomes non-finite.
        best: number of the row that is drawn bold.
        title: title above the axes.
        rows: name of a row in the legend; the rows of the solver are candidates.
    """
    with matplotlib.rc_context(STYLE):
        figure = blank_figure(4.8, 3.2, layout="constrained")
        axes = figure.add_subplot()
        losses_panel(axes, losses, best, rows)
        axes.set_title(title)
    return figure
