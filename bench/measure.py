"""Measurement of one row: prepare every competitor, check that they agree, then repeat alternately."""

import dataclasses
import statistics
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from bench import machine
from bench.workers import COMPETITORS, WorkerError, Workers

PEERS = tuple(name for name, one in COMPETITORS.items() if one.module == "peer")
OURS = tuple(name for name, one in COMPETITORS.items() if one.module == "ours")
MATRIX = 2048  # rows of the square matrices that the matmul peak is measured with


class Plan(NamedTuple):
    """The task of one competitor in a row.

    Attributes:
        task: name of the task in the competitor's module.
        settings: settings of the task.
        num_starts: number of starts, if not all of them fit into memory.
        once: whether its only call is measured, without a first call that warms up.
        scale: factor of its time, if it does only a part of the work of the row.
        note: note in the report.
    """

    task: str
    settings: dict = {}
    num_starts: int | None = None
    once: bool = False
    scale: float = 1.0
    note: str = ""


@dataclasses.dataclass(frozen=True)
class Row:
    """One line of the benchmark.

    Attributes:
        name, title: for options and the report.
        sizes: what a time depends on; times of two runs are compared where these are equal.
        arrays: makes the inputs, the same for all.
        plans: competitors in the order in which they alternate.
        check: from results by competitor to checks, and facts to report.
        flops: operations of the whole row, see `bench.flops`; of each competitor where they differ, 0 where they are
            not known.
        most: repetitions at most, for rows of minutes.
    """

    name: str
    title: str
    sizes: dict
    arrays: Callable[[], dict]
    plans: dict[str, Plan]
    check: Callable[[dict], tuple[list[dict], dict]]
    flops: float | dict[str, float]
    most: int = 100


def check(what: str, error: float, tolerance: float) -> dict:
    """A correctness check's outcome; an error that is not a number fails."""
    return {"what": what, "error": float(error), "tolerance": tolerance, "passed": bool(error <= tolerance)}


def difference(found, expected) -> float:
    """||a - b|| / ||b||."""
    found, expected = (np.asarray(array, np.float64) for array in (found, expected))
    return float(np.linalg.norm(found - expected) / np.linalg.norm(expected))


def measure(row: Row, workers: Workers, state: dict, repetitions: int) -> dict:
    """Measure a row.

    Args:
        row: the row.
        workers: the competitors' processes.
        state: the network's tensors, as `bench.scene.weights` gives them.
        repetitions: of every competitor, after a first call that warms up or compiles.

    Returns:
        A JSON-ready record: competitors' times and memory, ratios, checks, facts, and the errors of those that failed.
        Where a check fails, times are those of first calls and no ratios are given.
    """
    runs, failed = {}, {}
    arrays = row.arrays()

    def attempt(name, function):
        if name not in failed:
            try:
                function(name, row.plans[name])
            except WorkerError as error:
                failed[name] = str(error)

    def prepare(name, plan):
        cut = arrays | {"starts": arrays["starts"][: plan.num_starts]} if plan.num_starts else arrays
        workers.ask(name, "prepare", {"task": plan.task, "settings": plan.settings, "arrays": cut, "state": state})
        runs[name] = {"base": workers.ask(name, "settle")["resident"], "calls": [], "others": 0.0}

    def call(name, plan):
        before = machine.busy()
        answer = workers.ask(name, "run")
        runs[name]["calls"].append(answer)
        runs[name]["others"] += machine.busy() - before - answer["worked"]

    def settle(name, plan):
        if not plan.once:
            workers.ask(name, "settle")  # the peak is of calls that are warm: compilation takes memory of its own

    def peak(name, plan):
        runs[name]["peak"] = workers.ask(name, "peak")["peak"]

    for step in (prepare, call):
        for name in row.plans:
            attempt(name, step)
    results = {name: found["calls"][0]["result"] for name, found in runs.items() if name not in failed}
    checks, facts = row.check(results) if results else ([], {})
    passed = all(one["passed"] for one in checks)
    for name in row.plans if passed else ():
        attempt(name, settle)
    for _ in range(min(repetitions, row.most) if passed else 0):
        for name, plan in row.plans.items():
            if not plan.once:
                attempt(name, call)
    for name in row.plans:
        attempt(name, peak)
    competitors = {
        name: _summary(
            row.plans[name], found, row.flops[name] if isinstance(row.flops, dict) else row.flops, name in OURS
        )
        for name, found in runs.items()
        if name not in failed
    }
    return {
        "title": row.title,
        "sizes": row.sizes,
        "competitors": competitors,
        "ratios": ratios(competitors) if passed else {},
        "ratios_of_least": ratios(competitors, "least") if passed else {},
        "checks": checks,
        "facts": facts,
        "errors": failed,
    }


def matmul_gflops(workers: Workers, state: dict, repetitions: int = 8) -> dict[str, float]:
    """Float32 matmul peak of this machine, GFLOP/s: the best square product in each library's process, alternately."""
    names, best = ("torch_tuned", "tdf_jax"), {}
    for name in names:
        workers.ask(name, "prepare", {"task": "matmul", "settings": {"size": MATRIX}, "arrays": {}, "state": state})
        workers.ask(name, "run")
    for _ in range(repetitions):
        for name in names:
            best[name] = min(best.get(name, np.inf), workers.ask(name, "run")["seconds"])
    return {name: 2 * MATRIX**3 / seconds / 1e9 for name, seconds in best.items()}


def ratios(competitors: dict[str, dict], of: str = "median") -> dict[str, float]:
    """Ratios of the times of every peer and each of ours, by names such as "torch / tdf_jax"; without a peer, of ours.

    Args:
        competitors: results by competitor.
        of: "median", or "least", which depends less on other processes.
    """
    ours = [name for name in OURS if name in competitors]
    pairs = [(peer, our) for our in ours for peer in PEERS if peer in competitors]
    pairs = pairs or [(other, ours[0]) for other in ours[1:]]
    return {
        f"{peer} / {our}": competitors[peer]["seconds"][of] / competitors[our]["seconds"][of] for peer, our in pairs
    }


def _summary(plan, found, flops, compiles):
    calls = found["calls"]
    warm = calls if plan.once or len(calls) == 1 else calls[1:]
    times = [plan.scale * call["seconds"] for call in warm]
    low, median, high = (float(np.quantile(times, share)) for share in (0.25, 0.5, 0.75))
    first = calls[0]["wall"] - statistics.median(call["wall"] for call in warm)
    return {
        "seconds": {"median": median, "least": min(times), "quartiles": [low, high], "most": max(times), "all": times},
        "compile_seconds": max(0.0, first) if compiles and len(calls) > 1 else None,
        "gflops": flops / median / 1e9 if flops else None,
        "peak_megabytes": found["peak"] / 1e6,
        "base_megabytes": found["base"] / 1e6,
        # By the system's count of processor time, in steps of 10 ms; the parent's own share is in it, and small.
        "others_cores": max(0.0, found["others"]) / sum(call["wall"] for call in calls),
        "note": plan.note,
    }
