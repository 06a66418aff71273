"""Pictures of `tdf benchmark`: the ground truth, the errors of all methods, and the reliability of the confidence."""

from collections.abc import Mapping, Sequence

import matplotlib
import numpy as np
from matplotlib.figure import Figure

from tdf_jax.evaluation.path_scores import Score, by_method
from tdf_jax.evaluation.path_tasks import Task
from tdf_jax.evaluation.statistics import FINE, SUCCESS
from tdf_jax.viz.scene3d import WIDTH, View, bounds, panels, triangles_of
from tdf_jax.viz.style import CENTIMETRES, CLOUD, COLOURS, INK, STYLE, TRUTH, blank_figure, legend_of

LINES = ("-", "--", "-.", ":")
MAX_ERROR = 20.0  # end of the axis, centimetres


def truth_figure(tasks: Sequence[Task]) -> Figure:
    """The true trajectories of tasks, each with the demonstrated path in its own place.

    Args:
        tasks: the tasks, one panel each.
    """
    views = []
    for task in tasks:
        mesh = task.case.object_b.mesh.copy().apply_transform(task.case.T_world_b)
        view = View(task.case.points_b, triangles_of(mesh), task.expected, None, task.demonstration.trajectory)
        words = {"none": "", "opposite": ", goal opposite"}.get(
            task.displacement, f", goal moved by {task.displacement}"
        )
        views.append((task.path.replace("_", " ") + words, view))
    return panels(views, 3, bounds(np.asarray(tasks[0].demonstration.query)), tasks[0].expected.num_poses, share=0.78)


def errors_figure(scores: Sequence[Score], bold: str) -> Figure:
    """Shares of tasks whose pick and path errors are at most a distance, for every method.

    Args:
        scores: scores of all methods.
        bold: method that is drawn bold.
    """
    groups = by_method(scores)
    with matplotlib.rc_context(STYLE):
        figure = blank_figure(WIDTH, 4.2, layout="constrained")
        both = figure.subplots(1, 2, sharey=True)
        for axes, name, error in zip(
            both, ("pick", "path"), (lambda one: one.distances[0], lambda one: one.path_error)
        ):
            for index, (method, several) in enumerate(groups.items()):
                values = np.sort([CENTIMETRES * error(one) for one in several])
                shares = np.arange(1, len(values) + 1) / len(values)
                style = (
                    {"color": TRUTH, "lw": 2.2, "zorder": 5}
                    if method == bold
                    else {"color": COLOURS(index / len(groups)), "lw": 1.1, "ls": LINES[index % len(LINES)]}
                )
                axes.step(
                    np.concatenate([[0], values, [MAX_ERROR]]),
                    np.concatenate([[0], shares, shares[-1:]]),
                    where="post",
                    label=method,
                    **style,
                )
            axes.set(xlabel=f"{name} error (cm)", xscale="symlog", xlim=(0, MAX_ERROR), ylim=(0, 1.01))
            axes.set_xticks([0, 0.5, 1, 2, 5, 10, 20], ["0", "0.5", "1", "2", "5", "10", "20"])
            axes.minorticks_off()
            axes.spines[["top", "right"]].set_visible(False)
            axes.grid(alpha=0.25, lw=0.5)
        both[0].set_ylabel("share of tasks within")
        labels = legend_of(both[0])
        figure.legend(labels.values(), labels.keys(), loc="outside lower center", ncols=3, frameon=False)
    return figure


def reliability_figure(scores: Sequence[Score], bins: Sequence[Mapping]) -> Figure:
    """The share of right picks against the confidence, and the number of picks of each confidence.

    Args:
        scores: scores; those without a confidence are excluded.
        bins: bins as `tdf_jax.uncertainty.calibration.bins` makes them.
    """
    confident = [one for one in scores if one.confidence is not None]
    predicted = np.array([one.confidence for one in confident])
    right = np.array([one.succeeds(SUCCESS) for one in confident])
    with matplotlib.rc_context(STYLE):
        figure = blank_figure(3.6, 3.8, layout="constrained")
        axes, counts = figure.subplots(2, 1, sharex=True, height_ratios=(4, 1))
        axes.plot([0, 1], [0, 1], color=CLOUD, lw=0.8, ls="--", label="ideal")
        means = np.array([one["predicted"] for one in bins])
        rates = np.array([one["right"] for one in bins])
        limits = np.array([one["interval"] for one in bins])
        axes.errorbar(
            means,
            rates,
            np.abs(limits.T - rates),
            color=INK,
            fmt="o",
            ms=4,
            lw=1,
            capsize=2,
            label="picks, 95 % interval",
        )
        axes.set(ylabel="share within 2 cm and 20°", ylim=(-0.02, 1.04), xlim=(-0.02, 1.02))
        axes.legend(frameon=False, loc="lower right")
        counts.hist(
            [predicted[right], predicted[~right]],
            bins=20,
            range=(0, 1),
            color=[COLOURS(0.6), TRUTH],
            label=["right", "wrong"],
        )
        counts.set(xlabel="confidence", ylabel="picks", yscale="log", ylim=(0.7, None))
        counts.yaxis.set_major_formatter("{x:g}")
        counts.minorticks_off()
        counts.legend(frameon=False, loc="upper left")
        for one in (axes, counts):
            one.spines[["top", "right"]].set_visible(False)
    return figure


def demonstrations_figure(counts: Sequence[Mapping]) -> Figure:
    """Success and median error of picks against the number of demonstrations.

    Args:
        counts: `tdf_jax.evaluation.demonstration_count.CountErrors`, as mappings.
    """
    with matplotlib.rc_context(STYLE):
        figure = blank_figure(WIDTH, 2.8, layout="constrained")
        left, right = figure.subplots(1, 2)
        clouds = list(dict.fromkeys(one["clouds"] for one in counts))
        ways = list(dict.fromkeys(one["way"] for one in counts))
        for condition in clouds:
            first = [one for one in counts if one["clouds"] == condition and one["count"] == 1]
            for way in ways:
                rows = first + [
                    one for one in counts if one["clouds"] == condition and one["way"] == way and one["count"] > 1
                ]
                rows.sort(key=lambda one: one["count"])
                style = {
                    "color": COLOURS(0.15 + 0.6 * clouds.index(condition) / max(1, len(clouds) - 1)),
                    "ls": LINES[ways.index(way)],
                    "marker": "o",
                    "ms": 3,
                    "label": f"{condition}, {way}",
                }
                numbers = [one["count"] for one in rows]
                within = [np.mean(FINE.holds(one["distances"], one["angles"])) for one in rows]
                left.plot(numbers, within, **style)
                right.plot(numbers, [CENTIMETRES * np.median(one["distances"]) for one in rows], **style)
        left.set(ylabel="share within 1 cm and 10°", ylim=(0, 1.02))
        right.set(ylabel="median error (cm)")
        right.set_ylim(0, 1.1 * right.get_ylim()[1])
        for axes in (left, right):
            axes.set_xlabel("demonstrations")
            axes.set_xticks(sorted({one["count"] for one in counts}))
            axes.spines[["top", "right"]].set_visible(False)
            axes.grid(alpha=0.25, lw=0.5)
        labels = legend_of(left)
        figure.legend(labels.values(), labels.keys(), loc="outside lower center", ncols=4, frameon=False)
    return figure
