"""Figures of the paper, drawn from the data of `tdf_jax.paper`."""

import jax.numpy as jnp
import matplotlib
import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator, MultipleLocator

from tdf_jax.evaluation.scene import Scene
from tdf_jax.geometry.trajectory import Trajectory
from tdf_jax.paper.energy_maps import Swept
from tdf_jax.paper.figures import PAPER_DISTANCES, mean_over_seeds, turned
from tdf_jax.paper.runs import Run
from tdf_jax.paper.table import vector
from tdf_jax.viz.scene3d import WIDTH, View, bounds, panels, triangles_of
from tdf_jax.viz.style import CLOUD, COLOURS, INK, STYLE, TRUTH, blank_figure, legend_of

SHAPE_COLOURS = {"line": COLOURS(0.05), "semicircle": COLOURS(0.5), "wave": COLOURS(0.85)}
SHAPE_STYLES = {"line": "-", "semicircle": "--", "wave": "-."}  # distinct without colour too
OUTLINE = 400  # points of an object that are drawn


def figure1(runs: dict[str, Run], scene: Scene) -> Figure:
    """Reference, random start, result of l_t alone, and result of l_t + l_c, all of the best start of l_t + l_c.

    Args:
        runs: runs of `tdf_jax.paper.figures.figure1`.
        scene: scene of their setting.
    """
    alone, whole = runs["l_t"], runs["l_t + l_c"]
    test = {"points": scene.points, "triangles": triangles_of(scene.meshes[1])}
    demonstration = scene.demonstration
    truth = Trajectory(jnp.asarray(whole.expected))
    views = {
        "reference": View(np.asarray(demonstration.points), triangles_of(scene.meshes[0]), demonstration.trajectory),
        "random start": View(trajectory=Trajectory(jnp.asarray(whole.initial_trajectories[whole.best])), **test),
        r"after $l_t$ alone": View(
            trajectory=Trajectory(jnp.asarray(alone.trajectories[whole.best])), expected=truth, **test
        ),
        r"after $l_t + k\,l_c$": View(trajectory=Trajectory(jnp.asarray(whole.trajectory)), expected=truth, **test),
    }
    return panels(list(views.items()), 2, bounds(np.asarray(demonstration.query)), len(whole.expected))


def figure4(runs: dict[tuple, Run], scenes: dict[tuple, Scene]) -> Figure:
    """Test against reference, six panels.

    Args:
        runs: runs by (trajectory, displacement), of `tdf_jax.paper.figures.figure4`.
        scenes: their scenes, by the same keys.
    """
    views = []
    for (shape, displacement), run in runs.items():
        scene = scenes[shape, displacement]
        title = shape if not any(displacement) else f"{shape}, endpoint + {vector(displacement)} m"
        views.append(
            (
                title,
                View(
                    scene.points,
                    triangles_of(scene.meshes[1]),
                    Trajectory(jnp.asarray(run.trajectory)),
                    Trajectory(jnp.asarray(run.expected)),
                    scene.demonstration.trajectory,
                ),
            )
        )
    query = np.asarray(next(iter(scenes.values())).demonstration.query)
    return panels(views, 3, bounds(query), len(next(iter(runs.values())).expected))


def figure4_turn(runs: dict[tuple, Run]) -> Figure:
    """Rotation of the query frame from the demonstration along the path, estimated and true.

    Args:
        runs: runs by (trajectory, displacement), of `tdf_jax.paper.figures.figure4`.
    """
    with matplotlib.rc_context(STYLE):
        figure = blank_figure(WIDTH, 2.6, layout="constrained")
        displacements = list(dict.fromkeys(displacement for _, displacement in runs))
        panels = figure.subplots(1, len(displacements), sharey=True, squeeze=False)[0]
        for axes, displacement in zip(panels, displacements):
            for (shape, moved), run in runs.items():
                if moved == displacement:
                    steps = np.arange(len(run.expected))
                    angles = turned(run.trajectory, run.reference)
                    axes.plot(
                        steps, angles, SHAPE_STYLES[shape], color=SHAPE_COLOURS[shape], marker="o", ms=3, label=shape
                    )
                    truth = turned(run.expected, run.reference)
            axes.plot(steps, truth, color=TRUTH, lw=1, ls=":", label="even rotation to the goal")
            axes.set_title(
                "endpoint not displaced" if not any(displacement) else f"endpoint displaced by {vector(displacement)}"
            )
            axes.set_xlabel("pose, from the pick to the place")
            axes.xaxis.set_major_locator(MaxNLocator(integer=True))
            _plain(axes)
        panels[0].set_ylabel("angle from the demonstration's\norientation (degrees)")
        panels[0].set_ylim(bottom=0)
        panels[-1].legend(frameon=False)
    return figure


def figure5(runs: dict[str, Run]) -> Figure:
    """Loss against iteration: the best start of each shape, and the range over its starts.

    Args:
        runs: runs by shape, of `tdf_jax.paper.figures.figure5`.
    """
    with matplotlib.rc_context(STYLE):
        figure = blank_figure(4.8, 3.2, layout="constrained")
        axes = figure.add_subplot()
        for shape, run in runs.items():
            steps = np.arange(run.losses.shape[1])
            colour = SHAPE_COLOURS[shape]
            axes.fill_between(steps, run.losses.min(axis=0), run.losses.max(axis=0), color=colour, alpha=0.18, lw=0)
            axes.plot(steps, run.losses[run.best], SHAPE_STYLES[shape], color=colour, lw=1.8, label=shape)
        axes.fill_between([], [], [], color=CLOUD, alpha=0.3, lw=0, label="range over starts")
        axes.set(xlabel="iteration", ylabel="loss (no unit)", xlim=(0, steps[-1]))
        axes.set_ylim(bottom=0)
        axes.legend(frameon=False)
        _plain(axes)
    return figure


def figure3(runs: dict[tuple, Run]) -> Figure:
    """Error against the distance of the query points from the centroid of the cloud.

    Dotted lines mark the three distances of the paper.

    Args:
        runs: runs by (k, distance, seed), of `tdf_jax.paper.figures.figure3`.
    """
    panels = (
        ("pick pose", "distance from the truth (cm)", lambda run: 100 * run.pick_error[0]),
        ("pick pose", "angle from the truth (degrees)", lambda run: np.degrees(run.pick_error[1])),
        ("mean over all poses", "distance from the truth (cm)", lambda run: 100 * run.waypoint_error[0]),
    )
    with matplotlib.rc_context(STYLE):
        figure = blank_figure(WIDTH, 2.6, layout="constrained")
        for axes, (title, label, value) in zip(figure.subplots(1, len(panels)), panels):
            for (k, row), style, colour in zip(mean_over_seeds(runs, value).items(), ("-", "--"), (0.2, 0.7)):
                axes.plot(
                    list(row), list(row.values()), style, color=COLOURS(colour), marker="o", ms=3, label=f"k = {k:g}"
                )
            for distance in PAPER_DISTANCES:
                axes.axvline(distance, color=CLOUD, lw=0.8, ls=":", zorder=0, label="the paper's distances")
            axes.set(ylabel=label, title=title)
            axes.set_xlim(left=0)
            axes.set_ylim(bottom=0)
            _plain(axes)
        figure.supxlabel("distance of the first query points from the centroid of the cloud (units)", fontsize=8)
        legend = legend_of(axes)
        figure.legend(legend.values(), legend.keys(), loc="outside upper center", ncols=3, frameon=False)
    return figure


def figure2(fields: dict[str, dict[str, Swept]]) -> Figure:
    """Energy landscapes, one row for each field, and one column for each shape.

    Args:
        fields: landscapes by the name of the field and by shape.
    """
    rows, shapes = len(fields), list(next(iter(fields.values())))
    # All panels have one colour scale, so that rows can be compared.
    low = min(panel.energies.min() for row in fields.values() for panel in row.values())
    high = max(panel.energies.max() for row in fields.values() for panel in row.values())
    with matplotlib.rc_context(STYLE):
        figure = blank_figure(WIDTH, 0.55 + 2.25 * rows, layout="constrained")
        grid = figure.subplots(rows, len(shapes), sharex=True, sharey=True, squeeze=False)
        for line, (name, row) in zip(grid, fields.items()):
            for axes, shape in zip(line, shapes):
                picture = _landscape(axes, row[shape], low, high)
                axes.set_title(shape if rows == 1 else f"{shape}; {name}", fontsize=8)
            line[0].set_ylabel("y (units)")
        for axes in grid[-1]:
            axes.set_xlabel("x (units)")
        figure.colorbar(picture, ax=grid, label="energy E (no unit)", shrink=0.9 if rows == 1 else 0.5, pad=0.01)
        legend = legend_of(grid[-1, 0])
        # White marks need a dark background in the legend too.
        figure.legend(
            legend.values(),
            legend.keys(),
            loc="outside lower center",
            ncols=6,
            facecolor=COLOURS(0.45),
            labelcolor="white",
        )
    return figure


def _landscape(axes, panel: Swept, low: float, high: float):
    picture = axes.pcolormesh(
        panel.x, panel.y, panel.energies.T, cmap=COLOURS, vmin=low, vmax=high, shading="nearest", rasterized=True
    )
    axes.contour(
        panel.x, panel.y, panel.energies.T, levels=np.linspace(low, high, 13), colors="white", linewidths=0.3, alpha=0.7
    )
    outline = panel.outline[:: max(1, len(panel.outline) // OUTLINE)]
    axes.scatter(*outline.T, s=0.6, color="white", alpha=0.5, linewidths=0)
    axes.plot([], [], ".", color="white", ms=3, label="object's points")
    axes.plot(*panel.path.T, color="white", lw=1.0, marker="o", ms=3, mec=INK, mew=0.4, label="demonstration")
    if not np.array_equal(panel.carried, panel.path):
        axes.plot(*panel.carried.T, color="white", lw=1.0, ls="--", label="rotated with the mug")
    for point, marker, label in ((panel.path[0], "s", "start"), (panel.path[-1], "*", "end")):
        axes.plot(
            *point, marker=marker, ls="", color="white", mec=INK, ms=6 if marker == "s" else 10, mew=0.8, label=label
        )
    # Minimisers are drawn last, because the first one lies under the mark of the start.
    axes.plot(*panel.minimisers.T, ls="", marker="x", color=TRUTH, ms=5, mew=1.3, label=r"minimisers $x_i^*$")
    axes.set_aspect("equal")
    axes.set(xlim=(panel.x[0], panel.x[-1]), ylim=(panel.y[0], panel.y[-1]))
    axes.xaxis.set_major_locator(MultipleLocator(0.6))
    axes.yaxis.set_major_locator(MultipleLocator(0.6))
    return picture


def _plain(axes) -> None:
    axes.spines[["top", "right"]].set_visible(False)
    axes.grid(alpha=0.25, lw=0.5)
