"""Sentences about rows of campaigns, computed from them: against published rates, and from one condition to another."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from tdf_jax.evaluation.statistics import bootstrap_interval
from tdf_jax.sim.condition import GENERATED, LIBRARY, TRUTH
from tdf_jax.sim.published import PAPERS, peers_of
from tdf_jax.sim.rows import Row

FEW = 30  # episodes, below which a row shows little
# What the reading compares: a field of the condition, and the values before and after the change, in words.
CHANGES = (
    ("mode", "teleport", "execute", "Executed instead of teleported"),
    ("poses", "upright", "tilt60", "Starts tilted by up to 60 degrees instead of upright"),
    ("poses", "upright", "uniform", "Starts in any orientation instead of upright"),
    ("target", "known", "found", "A target that is found instead of a known one"),
    ("clouds", "full", "views3", "Clouds of three cameras instead of complete ones"),
    ("clouds", "full", "views1", "Clouds of one camera instead of complete ones"),
    ("mask", "simulator", "segmented", "Our own segmentation instead of the simulator's mask"),
    ("demonstrations", 1, 10, "Ten demonstrations instead of one"),
)
SAME_EPISODES = ("mode", "clouds", "mask", "demonstrations")  # fields that change neither objects nor starts


def reading(rows: Sequence[Row]) -> list[str]:
    """What the rows show together, in sentences that are computed from them.

    Args:
        rows: all campaigns.
    """
    ours = [row for row in rows if row.condition.method == LIBRARY]
    lines = [*_against_published(ours)]
    for field, before, after, words in CHANGES:
        pairs = _pairs(ours, field, before, after)
        if pairs:
            masses = {(one.condition.mass, other.condition.mass) for one, other in pairs}
            also = ", and objects with masses by their volume" if any(a and not b for a, b in masses) else ""
            lines.append(f"- {words}{also}: overall success {_difference(pairs, field in SAME_EPISODES)}.")
    methods = dict.fromkeys(row.condition.method for row in rows if row.condition.method != LIBRARY)
    for method in methods:
        pairs = _pairs(rows, "method", method, LIBRARY)
        if pairs and method == TRUTH:
            lines.append(
                f"- The library instead of the true pick and release: overall success {_difference(pairs)}. What the "
                "truth misses too is lost by the robot, its planner and the physics, not by the imitation."
            )
        elif pairs:
            lines.append(f"- The library instead of {method}: overall success {_difference(pairs)}.")
    for mode, words in (("teleport", "teleported"), ("execute", "executed")):
        mine = [row for row in ours if row.condition.mode == mode]
        failed = {}
        for row in mine:
            for cause, count in row.causes.items():
                failed[cause] = failed.get(cause, 0) + count
        if failed:
            most = sorted(failed.items(), key=lambda one: (-one[1], one[0]))
            listed = ", ".join(f"{cause} {count}" for cause, count in most)
            total = sum(len(row.runs) for row in mine)
            lines.append(f"- Causes of failure in {total} {words} episodes of the library: {listed}.")
    lines += [f"- Not drawn, and not counted: {words}." for row in rows for words in row.not_drawn]
    few = min(len(row.runs) for row in rows)
    if few < FEW:
        lines.append(f"- Rows of {few} episodes show that the command works, and little else.")
    general = (
        "Teleport tests the grasp and the placement apart, and nothing moves between them. An executed episode also "
        "needs a posture of the arm at both ends, a way without collision, and an object that stays in the hand; it "
        "may move there, if it ends where it should. Every drawn episode counts, also one for which no motion is found."
    )
    return [general, "\n".join(lines)] if lines else [general]


def _against_published(ours: Sequence[Row]) -> list[str]:
    """How many rows of the library have their published peers below, in or above their intervals."""
    lines = []
    for system in PAPERS:
        counts = {"below": 0, "in": 0, "above": 0}
        for row in ours:
            if row.condition.objects != GENERATED or not row.runs:
                continue
            name = "place" if system == "R-NDF" else "overall"
            peers = [one for one in peers_of(row.condition) if one.system == system]
            theirs = getattr(max(peers, key=lambda one: one.demonstrations), name) if peers else None
            if theirs is not None:
                low, high = row.likely(name)
                counts["below" if theirs < low else "above" if theirs > high else "in"] += 1
        total = sum(counts.values())
        if total:
            what = "place" if system == "R-NDF" else "overall"
            lines.append(
                f"- {system}, {what}: the published rate is below our interval in {counts['below']}, in it in "
                f"{counts['in']} and above it in {counts['above']} of {total} rows. Same protocol, other objects."
            )
    return lines


def _pairs(rows: Sequence[Row], field: str, before: Any, after: Any) -> list[tuple[Row, Row]]:
    """Pairs of rows that differ in one field; executed objects are never light, so masses may differ with the mode."""

    def key(row):
        other = row.condition._asdict()
        other.pop(field)
        if field == "mode":
            other.pop("mass")
        return tuple(other.items())

    first = {key(row): row for row in rows if getattr(row.condition, field) == before}
    pairs = [(first[key(row)], row) for row in rows if getattr(row.condition, field) == after and key(row) in first]
    return [
        (one, other) for one, other in pairs if {run.number for run in one.runs} & {run.number for run in other.runs}
    ]


def _difference(pairs: Sequence[tuple[Row, Row]], same: bool = True) -> str:
    """The change of the overall rate from the first to the second of each pair, in points, paired by numbers.

    Args:
        pairs: rows before and after.
        same: whether episodes of one number have the same objects and starts in both.
    """
    changes, objects = [], []
    for before, after in pairs:
        first, second = before.values("overall"), after.values("overall")
        for number, (value, one) in first.items():
            if number in second:
                changes.append(second[number][0] - value)
                objects.append(one)
    mean, interval = float(np.mean(changes)), bootstrap_interval(np.array(changes), objects)
    points = f"{abs(100 * mean):.1f}"
    words = (
        f"is {'higher' if mean > 0 else 'lower'} by {points} point{'s' * (points != '1.0')}" if mean else "is the same"
    )
    span = "" if interval is None else f", 95 % interval {100 * interval[0]:+.1f} to {100 * interval[1]:+.1f}"
    count = len(pairs)
    return f"{words}{span} ({count} pair{'s' * (count > 1)} of rows{', the same episodes' * same})"
