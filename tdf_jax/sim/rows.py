"""Rows of a comparison: campaigns that are planned together, and what became of the episodes of each."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from tdf_jax._internal import checks
from tdf_jax._internal.errors import InputError
from tdf_jax.sim import report
from tdf_jax.sim.campaign import Run
from tdf_jax.sim.condition import DEMONSTRATIONS, GENERATED, LIBRARY, SEGMENTED, Condition, Settings
from tdf_jax.sim.physics import LIGHT_MASS
from tdf_jax.sim.tasks import TASKS

# Targets of each task as the published protocols have them: NDF's stay where they were demonstrated, R-NDF's are found.
TARGETS = {
    "mug_on_rack": ("known", "found"),
    "bowl_on_shelf": ("known",),
    "bottle_on_shelf": ("known",),
    "bowl_on_mug": ("found",),
    "bottle_in_container": ("found",),
}


class Row:
    """A campaign that has run.

    Attributes:
        settings: what its episodes share.
        runs: the episodes that were drawn.
        condition: what they are measured under.
        not_drawn: what could not be drawn, and why, in words.
    """

    def __init__(self, settings: Settings, runs: Sequence[Run]):
        """Keep both.

        Args:
            settings: what the episodes share.
            runs: the episodes, at least one.
        """
        self.settings, self.condition = settings, settings.condition
        self.all, self.runs = list(runs), [one for one in runs if one.outcome.drawn]
        self.not_drawn = report.not_drawn(runs)
        self.rates = report.rates(self.runs)
        self.causes = report.causes(self.runs)

    def values(self, rate: str) -> dict[int, tuple[float, tuple[str, str | int]]]:
        """What each episode has in a rate, 0 or 1, and its object, by the number of the episode."""
        task = self.condition.task
        return {one.number: (float(getattr(one.outcome, rate)), (task, one.object)) for one in self.runs}

    def likely(self, rate: str) -> tuple[float, float]:
        """Interval of a rate; where all episodes are alike the bootstrap has no width, and the rule of three counts."""
        share, interval = self.rates[rate]
        if share is None:
            return 0.0, 1.0
        low, high = interval or (share, share)
        if low == high:
            # Of n successes, a rate below 1 - 3 / n is unlikely (5 %).
            reach = 3 / len({one.object for one in self.runs})
            low, high = max(low - reach, 0.0), min(high + reach, 1.0)
        return low, high

    def in_hand_motion(self) -> tuple[float, float] | None:
        """Median movement in the hand after closing, metres and degrees; None if nothing was held."""
        return report.in_hand_motion(self.runs)

    def rejections(self) -> tuple[int, int]:
        """Numbers of starts out of reach, and of pairs that do not fit or of which no start is within reach."""
        return sum(one.rejected for one in self.all), sum(one.redrawn for one in self.all)

    def seconds(self) -> Float[np.ndarray, "episodes 3"]:
        """Wall times of `tdf_jax.sim.report.PARTS`, (episodes, 3), seconds."""
        return report.seconds(self.runs)


def planned_rows(
    tasks: Sequence[str],
    modes: Sequence[str],
    targets: Sequence[str] | None,
    poses: Sequence[str],
    clouds: Sequence[str],
    methods: Sequence[str],
    demonstrations: Sequence[int],
    light: bool,
    objects: Sequence[str] = (GENERATED,),
    masks: Sequence[str] = (SEGMENTED,),
) -> list[Condition]:
    """All combinations that can be measured.

    A shelf is always known, and ten demonstrations are the library's, of targets that are found.

    Args:
        tasks: names of `tdf_jax.sim.tasks.TASKS`.
        modes: "execute" and "teleport".
        targets: "known" and "found"; None for those of the published protocols, `TARGETS`.
        poses: how objects start.
        clouds: "full", or what three cameras or one see.
        methods: names of `tdf_jax.sim.condition.METHODS`.
        demonstrations: numbers of demonstrations, 1 and 10.
        light: whether teleported objects have the mass of those in NDF and R-NDF; executed ones never do.
        objects: names of `tdf_jax.sim.condition.OBJECTS`.
        masks: names of `tdf_jax.sim.condition.MASKS`, for clouds of cameras.

    Raises:
        InputError: an argument is empty, or one of its values is in no combination.
    """
    function = "tdf benchmark --simulation"
    given = {
        "tasks": tasks, "modes": modes, "pose": poses, "clouds": clouds, "methods": methods,
        "demonstrations": demonstrations,
    }  # fmt: skip
    for flag, values in given.items():
        if not values:
            raise InputError(f"{function}: --{flag} is empty; expected at least one")
    if targets is not None and not targets:
        raise InputError(f"{function}: --targets is empty; expected at least one")
    for count in demonstrations:
        checks.choice(function, "--demonstrations", count, (1, DEMONSTRATIONS))
    rows = [
        Condition(
            task,
            target,
            start,
            mode,
            cloud,
            count,
            method,
            LIGHT_MASS if light and mode == "teleport" else 0.0,
            kind,
            mask,
        )
        for task in dict.fromkeys(tasks)
        for mode in dict.fromkeys(modes)
        for kind in dict.fromkeys(objects)
        for target in dict.fromkeys(targets or TARGETS[task])
        for cloud in dict.fromkeys(clouds)
        for mask in (dict.fromkeys(masks) if cloud != "full" else (SEGMENTED,))
        for start in dict.fromkeys(poses)
        for count in dict.fromkeys(demonstrations)
        for method in dict.fromkeys(methods)
        if not (target == "found" and TASKS[task].target == "board")
        and not (count > 1 and (target == "known" or method != LIBRARY))
    ]
    for flag, field, values in (
        ("targets", "target", targets or ()),
        ("demonstrations", "demonstrations", demonstrations),
        ("methods", "method", methods),
        ("tasks", "task", tasks),
        ("masks", "mask", masks),
    ):
        for value in values:
            if value not in {getattr(row, field) for row in rows}:
                raise InputError(
                    f"{function}: --{flag} has {value!r}, for which there is no row with the other options; expected "
                    "--targets known for shelves, --demonstrations 10 for tdf_jax with --targets found only, and "
                    "--masks with --clouds of cameras"
                )
    return rows
