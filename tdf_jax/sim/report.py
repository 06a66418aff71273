"""What became of many episodes: success with intervals, causes of failure, and the record of a run."""

import collections
import dataclasses
import re
from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import Float

from tdf_jax._internal.version import __version__
from tdf_jax.evaluation.statistics import bootstrap_interval
from tdf_jax.evaluation.tables import percent
from tdf_jax.sim.campaign import Run
from tdf_jax.sim.condition import Condition, Settings
from tdf_jax.sim.episode import CRITERIA
from tdf_jax.sim.tasks import TASKS

PARTS = ("imitation", "planning", "physics")  # of an episode's wall time
RATES = ("grasp", "place", "overall", "strict")
WORDS = {  # of the criteria of a place
    "touches": "touches the target",
    "off_table": "not the table",
    "settled": "settled",
    "upright": "upright",
    "comes_off": "comes off upside down",
    "hung": "hung by the handle",
    "no_collision": "no collision",
}
SCHEMA = 2  # raised when a key changes its name or its meaning


def rates(runs: Sequence[Run]) -> dict[str, tuple[float | None, list[float] | None]]:
    """Success rates with 95 % bootstrap intervals over objects, of the episodes that were drawn; None if none was.

    Args:
        runs: episodes under one condition. Every generated object is another one; a user's mesh has several episodes.
    """
    return {name: _rate(runs, name) for name in RATES}


def criteria(runs: Sequence[Run]) -> dict[str, tuple[float | None, list[float] | None]]:
    """How often each criterion of the place holds, with intervals as of `rates`.

    These are the criteria that the protocol of the condition has: R-NDF's in "teleport".

    Args:
        runs: episodes under one condition, at least one.
    """
    condition = runs[0].condition
    return {name: _rate(runs, name) for name in CRITERIA if is_tested(name, condition)}


def in_hand_motion(runs: Sequence[Run]) -> tuple[float, float] | None:
    """Median movement in the hand after closing, metres and degrees, of the objects that were held; None if none was.

    Args:
        runs: episodes under one condition.
    """
    moved = np.array([(one.outcome.slip, one.outcome.turn) for one in runs if one.outcome.grasp], float)
    moved = moved.reshape(-1, 2)
    moved = moved[np.isfinite(moved).all(axis=1)]
    if not len(moved):
        return None
    slip, turn = np.median(moved, axis=0)
    return float(slip), float(turn)


def is_tested(criterion: str, condition: Condition) -> bool:
    """Whether a criterion of the place is a part of what is measured.

    Args:
        criterion: one of `tdf_jax.sim.episode.CRITERIA`.
        condition: what episodes are measured under.
    """
    if criterion in ("comes_off", "no_collision"):
        return (criterion == "comes_off") == (condition.mode == "teleport")
    if criterion in ("hung", "upright"):
        return (criterion == "hung") == (TASKS[condition.task].object == "mug")
    return True


def _rate(runs: Sequence[Run], name: str) -> tuple[float | None, list[float] | None]:
    used = [one for one in runs if one.outcome.drawn]
    if not used:
        return None, None
    values = np.array([getattr(one.outcome, name) for one in used], float)
    return float(values.mean()), bootstrap_interval(values, [one.object for one in used])


def causes(runs: Sequence[Run]) -> dict[str, int]:
    """How often each cause failed an episode, the most frequent first.

    Args:
        runs: episodes under one condition.
    """
    failed = [one.outcome.cause for one in runs if one.outcome.drawn and one.outcome.cause]
    return dict(collections.Counter(failed).most_common())


def not_drawn(runs: Sequence[Run]) -> list[str]:
    """What could not be drawn, and why, in words, the same thing once.

    Args:
        runs: episodes under one condition.
    """
    numbers: dict[str, list[int]] = {}
    for one in runs:
        if not one.outcome.drawn:
            reason = re.sub(r"\(episode \d+, |of episode \d+ \(", "(", one.outcome.detail)
            numbers.setdefault(f"{one.instance}{': ' * bool(one.instance)}{reason}", []).append(one.number)
    return [f"{', '.join(map(str, several))}: {reason}" for reason, several in numbers.items()]


def summary(runs: Sequence[Run]) -> str:
    """The rates and causes of one condition in a few lines.

    Args:
        runs: episodes under one condition.
    """
    condition = runs[0].condition
    used = [one for one in runs if one.outcome.drawn]
    meshes = dict.fromkeys(one.instance for one in runs if one.instance)
    lines = [
        f"{condition.task}, target {condition.target}, {condition.poses}, {condition.mode}, {condition.inputs} clouds, "
        f"{condition.demonstrations} demonstration{'s' * (condition.demonstrations > 1)}, {condition.method}: "
        f"{len(used)} episodes"
    ]
    if meshes:
        lines.append(f"  meshes: {', '.join(meshes)}")
    lines += [f"  not drawn, and not counted: {words}" for words in not_drawn(runs)]
    for name, (rate, interval) in rates(runs).items():
        if name == "strict" and condition.task != "mug_on_rack":
            continue
        words = {"strict": "overall, hung by the handle"}.get(name, name)
        between = "" if interval is None else f" ({100 * interval[0]:.0f}-{100 * interval[1]:.0f})"
        lines.append(f"  {words}: {percent(rate)}{between}")
    parts_of_place = ", ".join(f"{WORDS[name]} {percent(rate)}" for name, (rate, _) in criteria(runs).items())
    lines.append(f"  of the place: {parts_of_place}")
    moved = in_hand_motion(runs)
    if moved is not None:
        lines.append(f"  moved in the hand, median: {1e3 * moved[0]:.1f} mm, {moved[1]:.1f} degrees")
    lines += [f"  failed: {cause}: {count}" for cause, count in causes(runs).items()]
    parts = seconds(used)
    rejected, redrawn = (sum(getattr(one, name) for one in runs) for name in ("rejected", "redrawn"))
    lines.append(
        f"  drawn before: {rejected} starts out of reach, {redrawn} pairs that do not fit or have no start within reach"
    )
    for words, values in (("median", np.median(parts, axis=0)), ("all episodes", parts.sum(axis=0))) if used else ():
        named = (f"{name} {value:.1f}" for name, value in zip(PARTS, values))
        lines.append(f"  seconds, {words}: {', '.join(named)}")
    return "\n".join(lines)


def seconds(runs: Sequence[Run]) -> Float[np.ndarray, "episodes 3"]:
    """Wall times of imitation, planning and physics, (episodes, 3), seconds; `teleport` plans nothing.

    Args:
        runs: the episodes.
    """
    return np.array([one.seconds for one in runs], float).reshape(-1, len(PARTS))


def _value(run: Run, name: str, value):
    """A field of an outcome in JSON; None for what is not known or not tested."""
    if isinstance(value, float) and np.isnan(value):
        return None
    return None if name in CRITERIA and not is_tested(name, run.condition) else value


def record(settings: Settings, runs: Sequence[Run]) -> dict[str, Any]:
    """The JSON record of a run: what is the same on a rerun, and "seconds", which are not.

    Under "seconds" are the sums of the wall times of imitation, planning and physics, and these of every episode.

    Args:
        settings: what the episodes share.
        runs: the episodes.
    """
    parts = seconds(runs)
    return {
        "schema": SCHEMA,
        "tdf_jax": __version__,
        "condition": settings.condition._asdict(),
        "seed": settings.seed,
        "weights": {"object": settings.object_weights, "target": settings.target_weights},
        "rates": {name: {"rate": rate, "interval": interval} for name, (rate, interval) in rates(runs).items()},
        "place_criteria": {
            name: {"rate": rate, "interval": interval} for name, (rate, interval) in criteria(runs).items()
        },
        "causes": causes(runs),
        "not_drawn": [one.number for one in runs if not one.outcome.drawn],
        "episodes": [
            {
                "number": one.number,
                "rejected": one.rejected,
                "redrawn": one.redrawn,
                "mesh": one.instance or None,
                **{name: _value(one, name, value) for name, value in dataclasses.asdict(one.outcome).items()},
            }
            for one in runs
        ],
        "seconds": {**dict(zip(PARTS, parts.sum(axis=0).tolist())), "episodes": parts.tolist()},
    }
