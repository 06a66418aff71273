"""Growth of time and memory with the numbers of starts, poses, query points and cloud points."""

from pathlib import Path

from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from bench.measure import measure
from bench.rows import encoding, step
from bench.workers import COMPETITORS, Workers
from tdf_jax._internal.files import replace_file

# Sizes that do not vary along an axis. "inits" is the number of starts: keys of records stay comparable.
CENTRE = {"inits": 4, "poses": 7, "queries": 250}
VALUES = {
    "inits": (1, 2, 4, 8, 16, 32),
    "poses": (2, 4, 7, 14, 28),
    "queries": (64, 125, 250, 500, 1000),
    "points": (250, 500, 1000, 2000, 4000),
}
QUICK_CENTRE, QUICK_VALUES = {"inits": 1, "poses": 2, "queries": 8}, {"inits": (1,), "points": (30, 60)}
LABELS = {"inits": "starts M", "poses": "poses n", "queries": "query points Q", "points": "cloud points N"}


def scaling(workers: Workers, state: dict, quick: bool, repetitions: int, progress=print) -> dict:
    """Measure the curves; a competitor whose graph would not fit into memory is excluded at that size.

    Returns:
        {axis: [{"value", "competitors": {name: {"seconds", "megabytes"}}}]}; one step per value of M, n and Q, one
        encoding per value of N; megabytes above what the process held before.
    """
    centre, values = (QUICK_CENTRE, QUICK_VALUES) if quick else (CENTRE, VALUES)
    curves = {}
    for axis, steps in values.items():
        curves[axis] = []
        for value in steps:
            sizes = centre | {axis: value}
            if axis == "points":
                row = encoding(value)
            else:
                row = step(sizes["inits"], sizes["poses"], sizes["queries"])
            for name, plan in list(row.plans.items()):
                if plan.scale != 1:
                    del row.plans[name]
            found = measure(row, workers, state, repetitions)["competitors"]
            curves[axis].append({"value": value, "competitors": {name: _point(one) for name, one in found.items()}})
            progress(
                f"{LABELS[axis]} {value}: "
                + ", ".join(f"{name} {one['seconds']['median']:.3g} s" for name, one in found.items())
            )
    return curves


def figure(curves: dict) -> Figure:
    """Time above and memory below, one column for each axis, on logarithmic scales.

    Args:
        curves: the curves, as `scaling` returns them.
    """
    drawn = Figure(figsize=(3.4 * len(curves), 6.0), layout="constrained")
    FigureCanvasAgg(drawn)
    axes = drawn.subplots(2, len(curves), squeeze=False)
    for column, (axis, points) in enumerate(curves.items()):
        for row, (quantity, label) in enumerate((("seconds", "seconds"), ("megabytes", "memory above the start, MB"))):
            panel = axes[row, column]
            for index, name in enumerate(COMPETITORS):
                known = [
                    (point["value"], point["competitors"][name][quantity])
                    for point in points
                    if name in point["competitors"]
                ]
                if known:
                    panel.loglog(*zip(*known), marker="o", color=f"C{index}", label=COMPETITORS[name].title)
            panel.set_xticks([point["value"] for point in points], [str(point["value"]) for point in points])
            panel.minorticks_off()
            panel.set_xlabel(LABELS[axis])
            panel.grid(alpha=0.3)
            if column == 0:
                panel.set_ylabel(label)
            if row == 0:
                panel.set_title("encoding" if axis == "points" else "one step")
    axes[0, 0].legend(fontsize="small")
    return drawn


def save(path: Path, curves: dict) -> None:
    """Draw the curves into a PNG."""
    replace_file("bench", path, lambda file: figure(curves).savefig(file, format="png", dpi=120))


def _point(found):
    return {
        "seconds": found["seconds"]["median"],
        "megabytes": max(1.0, found["peak_megabytes"] - found["base_megabytes"]),
    }
