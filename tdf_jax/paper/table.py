"""Table 1: the nine rows of the paper, and variations of its settings."""

import csv
import dataclasses
import io
from collections.abc import Callable, Sequence

import numpy as np

from tdf_jax.evaluation.tables import markdown
from tdf_jax.paper.runs import Run
from tdf_jax.paper.setting import Setting

# Shape and displacement of the endpoint -> the paper's final loss (k = 0.02, 100 epochs).
PAPER = {
    ("line", (0.0, 0.0, 0.0)): 0.006797,
    ("line", (0.0, 0.0, 0.4)): 0.011077,
    ("line", (-0.2, 0.1, 0.3)): 0.011253,
    ("semicircle", (0.0, 0.0, 0.0)): 0.004429,
    ("semicircle", (0.0, 0.1, 0.0)): 0.005685,
    ("semicircle", (-0.2, 0.1, 0.3)): 0.006624,
    ("wave", (0.0, 0.0, 0.0)): 0.005342,
    ("wave", (-0.2, 0.0, 0.0)): 0.005408,
    ("wave", (-0.2, 0.1, 0.3)): 0.007355,
}
SWEPT = (("line", (0.0, 0.0, 0.0)), ("semicircle", (0.0, 0.1, 0.0)), ("wave", (-0.2, 0.1, 0.3)))
SEEDS = 5
COMPENSATOR = 0.02  # weight of eq. 6; the paper gives none, so it is the weight of the correlation term

TABLE = "table 1"  # group of the rows of the paper
UNCHANGED = "nothing"
# Words for a variation, and the fields that it changes: first the paper's own questions, then the choices that it
# leaves open.
VARIATIONS: dict[str, dict] = {
    UNCHANGED: {},
    "k = 0": {"k": 0.0},
    "k = 0.002": {"k": 0.002},
    "k = 0.2": {"k": 0.2},
    "l_p for l_c, Frobenius": {"k": 0.0, "compensator": COMPENSATOR},
    "l_p for l_c, infinity": {"k": 0.0, "compensator": COMPENSATOR, "compensator_order": "infinity"},
    "n = 3": {"num_poses": 3},
    "n = 5": {"num_poses": 5},
    "n = 13": {"num_poses": 13},
    "n = 25": {"num_poses": 25},
    "last pose free": {"fix_last": False},
    "start displaced by (-0.2, 0, 0)": {"displacement": (-0.2, 0.0, 0.0), "displaced": "start"},
    "start displaced by (-0.2, 0.1, 0.3)": {"displacement": (-0.2, 0.1, 0.3), "displaced": "start"},
    "l_c towards the demonstration stretched to the goal": {"correlated": "stretched"},
    "pose norm: rotation scale 0.02 m": {"rotation_scale": 0.02},
    "pose norm: rotation scale 1 m, the plain norm": {"rotation_scale": 1.0},
    "pose norm: metres and radians": {"pose_norm": "metres_radians"},
    "pose norm: mean absolute": {"pose_norm": "mean_absolute", "rotation_scale": 1.0},
    "query: Gaussian, sigma 2.5 cm": {"query": "gaussian"},
    "query: box of 5 cm": {"query_size": 0.05},
    "query: box of 20 cm": {"query_size": 0.2},
    "start: the whole path rotated": {"start": "carried"},
    "translation rate 0.01 m": {"translation_rate": 0.01},
    "10 starts": {"num_starts": 10},
    "objects of 0.2 m": {"diagonal": 0.2},
    "objects of one unit (0.3 m)": {"unit": 0.3},
    "test mug as the reference lies": {"turn": 0.0},
    "test mug in any orientation": {"turn": "any"},
}
FAST_VARIATIONS = (UNCHANGED, "k = 0", "k = 0.2", "l_p for l_c, infinity", "n = 3", "last pose free")

COLUMNS = (
    "group",
    "trajectory",
    "displaced",
    "displacement",
    "seeds",
    "paper_loss",
    "loss",
    "loss_spread",
    "start_loss",
    "descriptor_loss",
    "true_loss",
    "true_descriptor_loss",
    "settled",
    "pick_cm",
    "pick_degrees",
    "flips",
    "waypoint_cm",
    "waypoint_degrees",
    "path_cm",
    "shape_cm",
    "longest_step",
)


@dataclasses.dataclass(frozen=True)
class Row:
    """Means over the seeds of one row.

    Attributes:
        group: the variation, a key of `VARIATIONS`; `TABLE` for the rows of the paper.
        setting: setting of the first seed.
        runs: one run for each seed.
    """

    group: str
    setting: Setting
    runs: tuple[Run, ...]

    @property
    def paper_loss(self) -> float | None:
        """Final loss in the paper; None where the paper has no such row."""
        setting = self.setting
        return (
            PAPER.get((setting.trajectory, setting.displacement))
            if self.group == TABLE and setting.displaced == "goal"
            else None
        )

    def mean(self, value: Callable[[Run], float]) -> float:
        """Mean of a property of the runs over the seeds."""
        return float(np.mean([value(run) for run in self.runs]))

    def spread(self, value: Callable[[Run], float]) -> float | None:
        """Standard deviation of a property of the runs over the seeds; None for one seed."""
        return float(np.std([value(run) for run in self.runs], ddof=1)) if len(self.runs) > 1 else None

    def numbers(self) -> dict:
        """The values of all `COLUMNS`."""
        return {
            "group": self.group,
            "trajectory": self.setting.trajectory,
            "displaced": self.setting.displaced,
            "displacement": self.setting.displacement,
            "seeds": len(self.runs),
            "paper_loss": self.paper_loss,
            "loss": self.mean(lambda run: run.loss),
            "loss_spread": self.spread(lambda run: run.loss),
            "start_loss": self.mean(lambda run: run.start_loss),
            "descriptor_loss": self.mean(lambda run: run.descriptor[0]),
            "true_loss": self.mean(lambda run: float(run.expected_energy)),
            "true_descriptor_loss": self.mean(lambda run: run.descriptor[1]),
            "settled": self.mean(lambda run: run.settled),
            "pick_cm": self.mean(lambda run: 100 * run.pick_error[0]),
            "pick_degrees": self.mean(lambda run: np.degrees(run.pick_error[1])),
            "flips": sum(run.flipped for run in self.runs),
            "waypoint_cm": self.mean(lambda run: 100 * run.waypoint_error[0]),
            "waypoint_degrees": self.mean(lambda run: np.degrees(run.waypoint_error[1])),
            "path_cm": self.mean(lambda run: 100 * run.path_error),
            "shape_cm": self.mean(lambda run: 100 * run.shape_error),
            "longest_step": self.mean(lambda run: run.longest_step),
        }


def planned(
    base: Setting, seeds: int = SEEDS, variations: Sequence[str] = tuple(VARIATIONS)
) -> list[tuple[str, list[Setting]]]:
    """The settings of all rows: (group, settings), one setting for each seed.

    Args:
        base: all other numbers.
        seeds: number of seeds of the rows of the paper, from `base.seed` on; variations have one seed.
        variations: keys of `VARIATIONS`.
    """
    plan = []
    for trajectory, displacement in PAPER:
        row = dataclasses.replace(base, trajectory=trajectory, displacement=displacement)
        plan.append((TABLE, [dataclasses.replace(row, seed=base.seed + k) for k in range(seeds)]))
    for group in variations:
        for trajectory, displacement in SWEPT:
            row = dataclasses.replace(base, trajectory=trajectory, displacement=displacement)
            plan.append((group, [dataclasses.replace(row, **VARIATIONS[group])]))
    return plan


def rows(run: Callable[[Setting], Run], plan: list[tuple[str, list[Setting]]]) -> list[Row]:
    """Table 1 and its variations.

    Args:
        run: makes the run of a setting, such as `tdf_jax.paper.store.Store.run`.
        plan: plan as `planned` makes it.
    """
    return [Row(group, settings[0], tuple(run(setting) for setting in settings)) for group, settings in plan]


def as_csv(table: Sequence[Row]) -> str:
    """All rows as CSV, lengths in centimetres, angles in degrees."""
    text = io.StringIO()
    writer = csv.DictWriter(text, COLUMNS, lineterminator="\n")
    writer.writeheader()
    for row in table:
        numbers = row.numbers()
        numbers["displacement"] = " ".join(f"{value:g}" for value in row.setting.displacement)
        writer.writerow(
            {name: f"{value:.6g}" if isinstance(value, float) else value for name, value in numbers.items()}
        )
    return text.getvalue()


def as_markdown(table: Sequence[Row]) -> str:
    """Two Markdown tables: the rows of the paper, and the variations.

    Args:
        table: rows as `rows` makes them.
    """
    own = [row.numbers() for row in table if row.group == TABLE]
    end = {"goal": "endpoint", "start": "starting point"}[own[0]["displaced"]]
    heads = [
        "trajectory",
        f"{end} displaced by (units)",
        "paper's loss",
        "our loss",
        "at the start",
        "of the true path",
    ]
    heads += ["95 % of the drop after", "pick error", "waypoint error", "shape error"]
    cells = []
    for n in own:
        paper = "" if n["paper_loss"] is None else f"{n['paper_loss']:.4f}"
        spread = "" if n["loss_spread"] is None else f" ± {n['loss_spread']:.4f}"
        cells.append(
            [
                n["trajectory"],
                vector(n["displacement"]),
                paper,
                f"{n['loss']:.4f}{spread}",
                f"{n['start_loss']:.4f}",
                f"{n['true_loss']:.4f}",
                f"{n['settled']:.0f} iterations",
                f"{n['pick_cm']:.1f} cm, {n['pick_degrees']:.0f}°",
                f"{n['waypoint_cm']:.1f} cm",
                f"{n['shape_cm']:.1f} cm",
            ]
        )
    flips = sum(n["flips"] for n in own)
    words = f"Means over {own[0]['seeds']} seeds, ± their standard deviation. "
    words += f"Picks with a rotation error above 170°: {flips}."
    blocks = [markdown(heads, cells), words]
    groups = [group for group in dict.fromkeys(row.group for row in table) if group != TABLE]
    if groups:
        names = ", ".join(f"{trajectory} {vector(moved)}" for trajectory, moved in SWEPT)
        blocks += [f"Variations; one seed, three values in a cell: {names}.", _variations(table, groups)]
    return "\n\n".join(blocks) + "\n"


def _variations(table: Sequence[Row], groups: Sequence[str]) -> str:
    heads = ["changed", "loss", "descriptor loss", "pick error (cm)", "pick error (degrees)", "waypoint error (cm)"]
    heads += ["true path from estimated path (cm)", "shape error (cm)", "longest step over mean"]
    columns = {"loss": ".4f", "descriptor_loss": ".4f", "pick_cm": ".1f", "pick_degrees": ".0f", "waypoint_cm": ".1f"}
    columns |= {"path_cm": ".1f", "shape_cm": ".1f", "longest_step": ".1f"}
    cells = []
    for group in groups:
        numbers = [row.numbers() for row in table if row.group == group]
        cells.append([group, *(", ".join(format(n[name], form) for n in numbers) for name, form in columns.items())])
    return markdown(heads, cells)


def vector(displacement: tuple[float, float, float]) -> str:
    """A displacement in words."""
    return "(" + ", ".join(f"{value:g}" for value in displacement) + ")"
