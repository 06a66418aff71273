"""How far attempts are from the truth, and what that amounts to over many tasks."""

import dataclasses
from collections.abc import Callable, Mapping, Sequence

import numpy as np
from jaxtyping import Float

from tdf_jax.evaluation.methods import Attempt
from tdf_jax.evaluation.metrics import FLIP_DEGREES, frechet_distance, jerk, longest_step, penetration, pose_error
from tdf_jax.evaluation.path_tasks import Task
from tdf_jax.evaluation.statistics import RESAMPLES
from tdf_jax.geometry.trajectory import Trajectory
from tdf_jax.uncertainty.calibration import confidence

THRESHOLDS = {"1cm_10deg": (0.01, 10.0), "2cm_20deg": (0.02, 20.0), "5cm_30deg": (0.05, 30.0)}  # metres, degrees
LEAST_JERK = 1e-4  # metres
MISSED = THRESHOLDS["2cm_20deg"]  # beyond this a pick has failed


@dataclasses.dataclass(frozen=True)
class Score:
    """Errors of one attempt; lengths in metres, angles in degrees.

    Attributes:
        method, task, instance, path, displacement, clouds: what was tried on what.
        distances, angles: of the selected trajectory's waypoints.
        best_pick: distance and angle of the start whose pick is nearest to the truth (the sum of both over 1 cm and 10
            degrees).
        best_path: mean distance of waypoints of the start whose path is nearest to the truth.
        frechet: discrete Frechet distance to the expected path.
        jerk: of the path, over the expected path's, which is taken as 0.1 mm if it is less.
        longest_step: over the mean step; the expected path's is in `expected_step`.
        penetration: share of query points in the object's clay more than on the expected path; None where the object
            has no inside.
        starts: how many there were.
        seconds: of the attempt.
        confidence: of the method that the pick is right; None where it has none.
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

    def succeeds(self, metres: float, degrees: float) -> bool:
        """Whether the selected pick is within the bounds."""
        return self.distances[0] <= metres and self.angles[0] <= degrees

    @property
    def path_error(self) -> float:
        """Mean distance of waypoints, metres; the goal, which is given, is left out."""
        return float(np.mean(self.distances[:-1]))


def score(method: str, attempt: Attempt, task: Task) -> Score:
    """Measure an attempt against a task's truth."""
    # What is not finite counts as the demonstration where it was shown; a row like that is not chosen while another is
    # finite.
    shown = np.asarray(task.demonstration.trajectory.wxyz_xyz)
    trajectories = np.where(attempt.finite[:, None, None], attempt.trajectories, shown)
    distance, angle = pose_error(trajectories, task.expected.wxyz_xyz)
    angle = np.degrees(angle)
    best, nearest = attempt.best, int(np.argmin(distance[:, 0] / 0.01 + angle[:, 0] / 10.0))
    chosen = Trajectory(trajectories[best])
    places, truth = np.asarray(chosen.translations), np.asarray(task.expected.translations)
    inside = [
        penetration(path, np.asarray(task.demonstration.query), task.case.object_b, task.case.T_world_b)
        for path in (chosen, task.expected)
    ]
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
        frechet=frechet_distance(places, truth),
        jerk=jerk(places) / max(jerk(truth), LEAST_JERK),
        longest_step=longest_step(places),
        expected_step=longest_step(truth),
        penetration=None if None in inside else inside[0] - inside[1],
        starts=len(attempt.scores),
        seconds=attempt.seconds,
        confidence=confidence(attempt.residual),
    )


def summarised(scores: Sequence[Score], seed: int = 0) -> dict:
    """Medians, 90th percentiles and success rates of one method over tasks, with 95 % bootstrap intervals over objects.

    Args:
        scores: of one method.
        seed: of the bootstrap.

    Returns:
        Plain numbers by name: lengths in centimetres, angles in degrees.
    """
    picks, turns = (np.array([values[0] for values in several]) for several in _both(scores))
    ways, angles = (np.concatenate([values[:-1] for values in several]) for several in _both(scores))
    row = {
        "tasks": len(scores),
        "objects": len({one.instance for one in scores}),
        "flips": int(np.sum(turns > FLIP_DEGREES)),
    }
    for name, values, unit in (
        ("pick", 100 * picks, "cm"),
        ("pick", turns, "deg"),
        ("waypoint", 100 * ways, "cm"),
        ("waypoint", angles, "deg"),
    ):
        row |= {
            f"{name}_median_{unit}": float(np.median(values)),
            f"{name}_p90_{unit}": float(np.percentile(values, 90)),
        }
    for name, (metres, degrees) in THRESHOLDS.items():
        hits = np.array([one.succeeds(metres, degrees) for one in scores], float)
        row[f"success_{name}"], row[f"interval_{name}"] = float(hits.mean()), interval(scores, hits, np.mean, seed)
        row[f"oracle_{name}"] = float(
            np.mean([one.best_pick[0] <= metres and one.best_pick[1] <= degrees for one in scores])
        )
    paths = 100 * np.array([one.path_error for one in scores])
    row["path_median_cm"], row["path_p90_cm"] = float(np.median(paths)), float(np.percentile(paths, 90))
    row["interval_path_median_cm"] = interval(scores, paths, np.median, seed)
    row["oracle_path_median_cm"] = 100 * float(np.median([one.best_path for one in scores]))
    row["frechet_median_cm"] = 100 * float(np.median([one.frechet for one in scores]))
    for name in ("jerk", "longest_step", "expected_step", "seconds"):
        row[f"{name}_median"] = float(np.median([getattr(one, name) for one in scores]))
    deep = [one.penetration for one in scores if one.penetration is not None]
    row["penetration_mean"] = float(np.mean(deep)) if deep else None
    return row


def interval(
    scores: Sequence[Score], values: Float[np.ndarray, " tasks"], statistic: Callable, seed: int
) -> list[float] | None:
    """95 % bootstrap interval of a statistic; whole objects are drawn, each with all of its tasks. None for a single object."""
    names = list(dict.fromkeys(one.instance for one in scores))
    if len(names) < 2:
        return None
    groups = [np.array([value for one, value in zip(scores, values) if one.instance == name]) for name in names]
    rng = np.random.default_rng(seed)
    drawn = [
        statistic(np.concatenate([groups[i] for i in rng.choice(len(groups), len(groups))])) for _ in range(RESAMPLES)
    ]
    return [float(x) for x in np.percentile(drawn, (2.5, 97.5))]


def by_method(scores: Sequence[Score]) -> Mapping[str, list[Score]]:
    """Scores by method, in the order in which methods appear."""
    groups: dict[str, list[Score]] = {}
    for one in scores:
        groups.setdefault(one.method, []).append(one)
    return groups


def _both(scores):
    return [one.distances for one in scores], [one.angles for one in scores]
