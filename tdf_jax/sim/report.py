"""What became of many episodes: success with intervals, causes of failure, and the record of a run."""

import collections
import dataclasses
from collections.abc import Sequence
from importlib.metadata import version
from typing import Any

import numpy as np
from jaxtyping import Float

from tdf_jax.evaluation.statistics import bootstrap_interval
from tdf_jax.sim.campaign import Run, Settings

PARTS = ("imitation", "planning", "physics")  # of an episode's wall time
RATES = ("grasp", "place", "overall", "strict")
SCHEMA = 2  # raised when a key changes its name or its meaning


def rates(runs: Sequence[Run]) -> dict[str, tuple[float, list[float] | None]]:
    """Success rates with 95 % bootstrap intervals over objects, of which every episode has its own.

    Args:
        runs: episodes under one condition.
    """
    objects = [one.number for one in runs]
    table = {}
    for name in RATES:
        values = np.array([getattr(one.outcome, name) for one in runs], float)
        table[name] = float(values.mean()), bootstrap_interval(values, objects)
    return table


def causes(runs: Sequence[Run]) -> dict[str, int]:
    """How often each cause failed an episode, the most frequent first.

    Args:
        runs: episodes under one condition.
    """
    return dict(collections.Counter(one.outcome.cause for one in runs if one.outcome.cause).most_common())


def summary(runs: Sequence[Run]) -> str:
    """The rates and causes of one condition in a few lines.

    Args:
        runs: episodes under one condition.
    """
    condition = runs[0].condition
    lines = [
        f"{condition.task}, target {condition.target}, {condition.poses}, {condition.mode}, {condition.clouds} clouds, "
        f"{condition.demonstrations} demonstration{'s' * (condition.demonstrations > 1)}, {condition.method}: "
        f"{len(runs)} episodes"
    ]
    for name, (rate, interval) in rates(runs).items():
        if name == "strict" and condition.task != "mug_on_rack":
            continue
        words = {"strict": "overall, hung by the handle"}.get(name, name)
        between = "" if interval is None else f" ({100 * interval[0]:.0f}-{100 * interval[1]:.0f})"
        lines.append(f"  {words}: {100 * rate:.0f} %{between}")
    slips = np.array([[one.outcome.slip, one.outcome.turn] for one in runs])
    if np.isfinite(slips).any():
        slip, turn = np.nanmedian(slips, axis=0)
        lines.append(f"  moved in the hand, median: {1e3 * slip:.1f} mm, {turn:.1f} degrees")
    lines += [f"  failed: {cause}: {count}" for cause, count in causes(runs).items()]
    parts = seconds(runs)
    rejected, redrawn = (sum(getattr(one, name) for one in runs) for name in ("rejected", "redrawn"))
    lines.append(f"  drawn before: {rejected} starts out of reach, {redrawn} pairs that do not fit")
    for words, values in (("median", np.median(parts, axis=0)), ("all episodes", parts.sum(axis=0))):
        named = (f"{name} {_seconds(value)}" for name, value in zip(PARTS, values))
        lines.append(f"  seconds, {words}: {', '.join(named)}")
    return "\n".join(lines)


def seconds(runs: Sequence[Run]) -> Float[np.ndarray, "episodes 3"]:
    """Wall times of imitation, planning and physics, (episodes, 3), seconds.

    The last two are NaN where an earlier version kept only their sum; `teleport` plans nothing.

    Args:
        runs: the episodes.
    """
    return np.array([(one.seconds[0], one.planning, one.seconds[1] - one.planning) for one in runs])


def _seconds(value: float) -> str:
    return f"{value:.1f}" if np.isfinite(value) else "unknown"


def record(settings: Settings, runs: Sequence[Run]) -> dict[str, Any]:
    """The JSON record of a run: what is the same on a rerun, and "seconds", which are not.

    Under "seconds" are the sums of the wall times of imitation, planning and physics, and these of every episode; null
    where they are not known.

    Args:
        settings: what the episodes share.
        runs: the episodes.
    """
    parts = seconds(runs)
    times = [[value if np.isfinite(value) else None for value in row] for row in (parts.sum(axis=0), *parts)]
    return {
        "schema": SCHEMA,
        "tdf_jax": version("tdf_jax"),
        "condition": settings.condition._asdict(),
        "seed": settings.seed,
        "weights": {"object": settings.object_weights, "target": settings.target_weights},
        "rates": {name: {"rate": rate, "interval": interval} for name, (rate, interval) in rates(runs).items()},
        "causes": causes(runs),
        "episodes": [
            {
                "number": one.number,
                "rejected": one.rejected,
                "redrawn": one.redrawn,
                **{
                    name: None if isinstance(value, float) and np.isnan(value) else value
                    for name, value in dataclasses.asdict(one.outcome).items()
                },
            }
            for one in runs
        ],
        "seconds": {**dict(zip(PARTS, times[0])), "episodes": times[1:]},
    }
