"""Attempts of all methods on all tasks, kept between runs, and their errors."""

import dataclasses
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path

import jax
import numpy as np
from tqdm.auto import tqdm

from tdf_jax._internal.cache import kept
from tdf_jax._internal.errors import InputError
from tdf_jax._internal.version import __version__
from tdf_jax.evaluation.metrics import FLIP_DEGREES, frechet_distance, jerk, longest_step, penetration, pose_error
from tdf_jax.evaluation.path_methods import METHODS, Attempt, Attempts, tried
from tdf_jax.evaluation.path_tasks import Task
from tdf_jax.evaluation.statistics import FINE, THRESHOLDS, Threshold, bootstrap_interval, percentiles, success_rates
from tdf_jax.geometry.trajectory import Trajectory
from tdf_jax.networks.model import Model, fingerprint
from tdf_jax.uncertainty.calibration import confidence_by

FORMAT = 2  # format number; raise it when the computation of an attempt changes
LEAST_JERK = 1e-4  # smallest denominator of a ratio of jerks, metres


def run(
    makers: Sequence[Callable[[], Task]],
    model: Model,
    methods: Sequence[str],
    folder: Path,
    *,
    seed: int = 0,
    num_starts: int = 10,
    progress: bool = True,
) -> Iterator[tuple[Task, str, Attempt]]:
    """Run methods on tasks; an interrupted run continues where it stopped.

    Args:
        makers: functions that make one task each.
        model: the network.
        methods: names of `METHODS`.
        folder: existing folder that keeps the attempts.
        seed: seed of the starts.
        num_starts: number of random starts.
        progress: show a progress bar.

    Yields:
        Task, name of the method, attempt. Methods that cannot run on a task are skipped; variants run on every fifth
        task only.

    Raises:
        InputError: there is no such method, or a kept file is damaged.
    """
    for method in methods:
        if method not in METHODS:
            raise InputError(f"run(): methods has {method!r}; expected some of {', '.join(METHODS)}")
    about = [FORMAT, __version__, jax.default_backend(), fingerprint(model), seed, num_starts]
    key = jax.random.key(seed)
    for make in tqdm(makers, desc="benchmark", unit="task", disable=not progress):
        task = make()
        attempts = Attempts(task, model, key, num_starts)
        for method in (method for method in methods if tried(method, task.index)):

            def arrays(attempts=attempts, method=method):
                attempt = attempts.of(method)
                return {} if attempt is None else vars(attempt)

            what = [*about, *task.identity, method]
            attempt = kept("tdf benchmark", folder, what, arrays, _attempt)
            if attempt is not None:
                yield task, method, attempt


def _attempt(arrays) -> Attempt | None:
    """Build an attempt from stored arrays, which are empty if the method cannot run on the task."""
    if not arrays:
        return None
    return Attempt(arrays["trajectories"], arrays["scores"], float(arrays["seconds"]), float(arrays["residual"]))


@dataclasses.dataclass(frozen=True)
class Score:
    """Errors of one attempt; lengths in metres, angles in degrees.

    Attributes:
        method, task, instance, path, displacement, clouds: the method and the task.
        distances, angles: errors of the waypoints of the selected trajectory, each (poses,).
        best_pick: errors of the start whose pick is nearest to the ground truth: distance and angle. The nearest has
            the smallest sum of the distance over 1 cm and the angle over 10 degrees.
        best_path: mean waypoint distance of the start whose path is nearest to the ground truth.
        frechet: discrete Frechet distance to the ground truth.
        jerk: jerk of the path over that of the ground truth, which counts as 0.1 mm if it is less.
        longest_step: longest step over the mean step.
        expected_step: the same of the ground truth.
        penetration: share of query points inside the object, minus that of the ground truth; None where the object has
            no inside.
        starts: number of starts.
        seconds: time of the attempt.
        confidence: probability that the pick is right; None where the method or the weights have none.
    """

    method: str
    task: int
    instance: str
    path: str
    displacement: str
    clouds: str
    distances: list[float]
    angles: list[float]
    best_pick: tuple[float, float]
    best_path: float
    frechet: float
    jerk: float
    longest_step: float
    expected_step: float
    penetration: float | None
    starts: int
    seconds: float
    confidence: float | None

    def succeeds(self, threshold: Threshold) -> bool:
        """Whether the selected pick is within the bounds."""
        return bool(threshold.holds(self.distances[0], self.angles[0]))

    def best_succeeds(self, threshold: Threshold) -> bool:
        """Whether the pick of the best start is within the bounds."""
        return bool(threshold.holds(*self.best_pick))

    @property
    def path_error(self) -> float:
        """Mean distance of the waypoints, metres, without the goal, which is given."""
        return float(np.mean(self.distances[:-1]))


def score(method: str, attempt: Attempt, task: Task, weights: str) -> Score:
    """Measure an attempt against the ground truth of its task.

    Args:
        method: name of the method.
        attempt: its trajectories.
        task: the task.
        weights: name of the network's weights.
    """
    # A start that is not finite counts as the unchanged demonstration. It is not selected while another is finite.
    demonstrated = np.asarray(task.demonstration.trajectory.wxyz_xyz)
    trajectories = np.where(attempt.finite[:, None, None], attempt.trajectories, demonstrated)
    distance, angle = pose_error(trajectories, task.expected.wxyz_xyz)
    angle = np.degrees(angle)
    best, nearest = attempt.best, int(np.argmin(distance[:, 0] / FINE.metres + angle[:, 0] / FINE.degrees))
    selected = Trajectory(trajectories[best])
    path, truth = np.asarray(selected.translations), np.asarray(task.expected.translations)
    inside, inside_truth = (
        penetration(one, np.asarray(task.demonstration.query), task.case.object_b, task.case.T_world_b)
        for one in (selected, task.expected)
    )
    return Score(
        method=method,
        task=task.index,
        instance=task.case.instance,
        path=task.path,
        displacement=task.displacement,
        clouds=task.case.clouds,
        distances=[float(x) for x in distance[best]],
        angles=[float(x) for x in angle[best]],
        best_pick=(float(distance[nearest, 0]), float(angle[nearest, 0])),
        best_path=float(distance[:, :-1].mean(axis=1).min()),
        frechet=frechet_distance(path, truth),
        jerk=jerk(path) / max(jerk(truth), LEAST_JERK),
        longest_step=longest_step(path),
        expected_step=longest_step(truth),
        penetration=None if inside is None or inside_truth is None else inside - inside_truth,
        starts=len(attempt.scores),
        seconds=attempt.seconds,
        confidence=confidence_by(weights, attempt.residual),
    )


def summary(scores: Sequence[Score], seed: int = 0) -> dict:
    """Medians, 90th percentiles and success rates of one method over tasks, with 95 % bootstrap intervals over objects.

    Args:
        scores: scores of one method.
        seed: seed of the bootstrap.

    Returns:
        Plain numbers by name: lengths in centimetres, angles in degrees. A key that begins with "oracle" is of the
        start that is nearest to the ground truth.
    """
    objects = [one.instance for one in scores]
    picks, pick_angles = np.array([(one.distances[0], one.angles[0]) for one in scores]).T
    waypoints, waypoint_angles = (
        np.concatenate([values[:-1] for values in several])
        for several in ([one.distances for one in scores], [one.angles for one in scores])
    )
    paths = 100 * np.array([one.path_error for one in scores])
    inside = [one.penetration for one in scores if one.penetration is not None]
    return {
        "tasks": len(scores),
        "objects": len(set(objects)),
        "flips": int(np.sum(pick_angles > FLIP_DEGREES)),
        **percentiles("pick", 100 * picks, "cm"),
        **percentiles("pick", pick_angles, "deg"),
        **percentiles("waypoint", 100 * waypoints, "cm"),
        **percentiles("waypoint", waypoint_angles, "deg"),
        **success_rates(picks, pick_angles, objects, seed),
        **{
            f"oracle_{name}": float(np.mean([one.best_succeeds(threshold) for one in scores]))
            for name, threshold in THRESHOLDS.items()
        },
        **percentiles("path", paths, "cm"),
        "interval_path_median_cm": bootstrap_interval(paths, objects, "median", seed),
        "oracle_path_median_cm": 100 * float(np.median([one.best_path for one in scores])),
        "frechet_median_cm": 100 * float(np.median([one.frechet for one in scores])),
        **{
            f"{name}_median": float(np.median([getattr(one, name) for one in scores]))
            for name in ("jerk", "longest_step", "expected_step", "seconds")
        },
        "penetration_mean": float(np.mean(inside)) if inside else None,
    }


def by_method(scores: Sequence[Score]) -> Mapping[str, list[Score]]:
    """Scores by method, in the order in which methods first appear."""
    groups: dict[str, list[Score]] = {}
    for one in scores:
        groups.setdefault(one.method, []).append(one)
    return groups
