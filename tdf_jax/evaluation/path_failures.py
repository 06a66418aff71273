"""Failures of the library at whole trajectories: which they are, and what a picture of one needs."""

import dataclasses
from collections.abc import Sequence

import jax.numpy as jnp
import numpy as np

from tdf_jax.evaluation.path_methods import LIBRARY, Attempt
from tdf_jax.evaluation.path_scores import Score
from tdf_jax.evaluation.path_tasks import Task
from tdf_jax.evaluation.statistics import SUCCESS
from tdf_jax.geometry.trajectory import Trajectory
from tdf_jax.solvers.imitation_scene import ImitationScene
from tdf_jax.solvers.result import Result
from tdf_jax.uncertainty.advice import points_at
from tdf_jax.uncertainty.calibration import confidence_by


def failures(scores: Sequence[Score]) -> list[Score]:
    """Scores of the library whose picks are off by more than 2 cm or 20 degrees, by falling rotation error.

    Args:
        scores: scores of all methods.
    """
    failed = [one for one in scores if one.method == LIBRARY and not one.succeeds(SUCCESS)]
    return sorted(failed, key=lambda one: -one.angles[0])


def page_name(score: Score) -> str:
    """Name of the page of a failure.

    Args:
        score: the failure.
    """
    return f"task_{score.task}-{score.clouds}.html"


def page_title(score: Score) -> str:
    """Title of the page of a failure.

    Args:
        score: the failure.
    """
    return (
        f"Task {score.task}, {score.path.replace('_', ' ')}, {score.instance}, cloud {score.clouds}: the pick is off "
        f"by {100 * score.distances[0]:.1f} cm and {score.angles[0]:.0f} degrees"
    )


def failure_scene(task: Task, attempt: Attempt, weights: str) -> ImitationScene:
    """An attempt as a scene that pictures show, with the ground truth and the meshes of both objects.

    Args:
        task: the task.
        attempt: the attempt of a method on it.
        weights: name of the network's weights, which decides whether a confidence is known.
    """
    case, known = task.case, confidence_by(weights, attempt.residual)
    result = Result(
        trajectories=attempt.trajectories,
        energies=attempt.scores,
        # Attempts keep their final candidates only.
        candidate_history=np.zeros((len(attempt.scores), 0)),
        initial_trajectories=attempt.trajectories,
        history=np.zeros((len(attempt.scores), 0)),
        confidence=np.asarray(np.nan if known is None else known, np.float32),
    )
    if np.asarray(result.finite).any():
        seen = points_at(case.points_b, result.pick, task.demonstration.query)
        result = dataclasses.replace(result, points_at_pick=np.asarray(seen, np.int32))
    # Copies: a mesh is transformed in place.
    meshes = case.object_a.mesh.copy(), case.object_b.mesh.copy().apply_transform(case.T_world_b)
    expected = Trajectory(jnp.asarray(task.expected.wxyz_xyz))
    return ImitationScene(task.demonstration, case.points_b, result, expected=expected, meshes=meshes)
