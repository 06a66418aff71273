"""Baselines of simulated episodes: the demonstrated path by other means between the same ends, or to other ends."""

import dataclasses
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, PRNGKeyArray
from numpy.typing import ArrayLike

from tdf_jax._internal.errors import InputError
from tdf_jax.energy.losses import EnergyWeights
from tdf_jax.energy.reference import Reference, describe
from tdf_jax.evaluation.baselines import iterative_closest_points
from tdf_jax.geometry import se3
from tdf_jax.geometry.demonstration import Demonstration
from tdf_jax.geometry.trajectory import Trajectory
from tdf_jax.geometry.transport import carry_trajectory
from tdf_jax.imitation import imitate
from tdf_jax.networks.model import Model
from tdf_jax.solvers.multistart import SolveConfig
from tdf_jax.solvers.result import Result

ICP_STARTS = 10
PAPER = EnergyWeights(0.02)  # k of the paper's best


class Replay(NamedTuple):
    """What a method gives an episode.

    Attributes:
        paths: poses of the gripper's frame from the pick to the release, (poses, 4, 4) each, metres, world frame, the
            best first.
        motion: motion M of the object: a point x of it ends at M x, 4x4.
    """

    paths: list[Float[np.ndarray, "poses 4 4"]]
    motion: Float[np.ndarray, "4 4"]


def replay_by_centroids(
    demonstration: Demonstration,
    points: Float[np.ndarray, "points 3"],
    target_points: Float[np.ndarray, "target_points 3"] | None = None,
) -> Replay:
    """Move the demonstrated pick with the centroid of the object's cloud, and the goal with that of the target's.

    Args:
        demonstration: a demonstration with a target.
        points: cloud of the object, (points, 3), metres, world frame.
        target_points: cloud of the target, (target_points, 3); None if it stands where it stood.
    """
    ours, theirs = np.eye(4), np.eye(4)
    ours[:3, 3] = np.mean(points, axis=0, dtype=float) - np.mean(demonstration.points, axis=0, dtype=float)
    if target_points is not None:
        theirs[:3, 3] = np.mean(target_points, axis=0, dtype=float) - _target(demonstration).mean(axis=0)
    return _replayed(demonstration, ours, theirs)


def replay_by_registration(
    demonstration: Demonstration,
    points: Float[np.ndarray, "points 3"],
    target_points: Float[np.ndarray, "target_points 3"] | None = None,
    *,
    key: PRNGKeyArray,
) -> Replay:
    """Move the demonstrated pick with the object's cloud, and the goal with the target's, both registered by ICP.

    Args:
        demonstration: a demonstration with a target.
        points: cloud of the object, (points, 3), metres, world frame.
        target_points: cloud of the target, (target_points, 3); None if it stands where it stood.
        key: random key of the starts, the same for both.
    """
    rotations = np.asarray(se3.uniform_rotations(key, ICP_STARTS), float)
    ours = iterative_closest_points(np.asarray(demonstration.points, float), points, rotations)
    theirs = np.eye(4)
    if target_points is not None:
        theirs = iterative_closest_points(_target(demonstration), target_points, rotations)
    return _replayed(demonstration, ours, theirs)


def replay_candidates(result: Result) -> Replay:
    """The candidates of an imitation, and its motion of the object.

    Args:
        result: what `imitate` found.

    Raises:
        InputError: no candidate is finite.
    """
    return Replay([_matrices(Trajectory(jnp.asarray(poses))) for poses in _finite(result)], _motion(result))


def blend_evenly(demonstration: Demonstration, result: Result) -> Replay:
    """Join the picks and releases of an imitation by the demonstrated path, blended evenly over its poses.

    This is `tdf_jax.geometry.transport.carry_trajectory`, without the demonstrated departure and arrival.

    Args:
        demonstration: the demonstration.
        result: what `imitate` found.

    Raises:
        InputError: no candidate is finite.
    """
    paths = [carry_trajectory(demonstration.transfer, poses[0], poses[-1]) for poses in _finite(result)]
    return Replay([_matrices(path) for path in paths], _motion(result))


def describe_without_target(model: Model, demonstration: Demonstration) -> Reference:
    """The descriptors of a demonstration for `replay_by_energy`: the paper knows no target.

    Args:
        model: network of the object.
        demonstration: the demonstration.
    """
    return describe(model, dataclasses.replace(demonstration, target=None))


def replay_by_energy(
    model: Model, reference: Reference, points: Float[np.ndarray, "points 3"], goal: ArrayLike, *, key: PRNGKeyArray
) -> Replay:
    """Minimise the paper's energy, eq. 3 with k = 0.02, over all poses but the last, which is given.

    `solve` minimises it, as in the library's benchmark of whole paths: from as many starts it reaches lower energies
    than the paper's Adam.

    Args:
        model: network of the object.
        reference: of `describe_without_target`.
        points: cloud of the object, (points, 3), metres, world frame.
        goal: pose at the release, T_world_query as `wxyz_xyz`, (7,), metres.
        key: random key of the starts.

    Raises:
        InputError: no candidate is finite.
    """
    result = imitate(model, reference, points, goal=jnp.asarray(goal), energy=PAPER, config=SolveConfig(), key=key)
    return replay_candidates(result)


def _finite(result: Result) -> list[Float[np.ndarray, "poses 7"]]:
    """Poses from the pick to the release of the candidates that stayed finite, the best first."""
    finite = np.asarray(result.finite)
    order = [row for row in np.argsort(np.asarray(result.energies), kind="stable") if finite[row]]
    if not order:
        raise InputError(f"imitate(): no candidate is finite: {result.status}; expected one, see Result.status")
    candidates = np.asarray(result.trajectories)[order]
    return list(candidates[:, result.grasp : candidates.shape[1] + result.release + 1])


def _replayed(demonstration: Demonstration, ours: np.ndarray, theirs: np.ndarray) -> Replay:
    """The demonstrated path to ends that move with the object and the target, blended evenly between the two."""
    path = demonstration.transfer
    pick = ours @ _matrices(path)[0]
    motion = theirs @ _motion(demonstration) @ np.linalg.inv(ours)
    ends = Trajectory.from_matrices(jnp.asarray(np.stack([pick, motion @ pick]))).wxyz_xyz
    return Replay([_matrices(carry_trajectory(path, ends[0], ends[1]))], motion)


def _target(demonstration: Demonstration) -> Float[np.ndarray, "target_points 3"]:
    if demonstration.target is None:
        raise InputError(
            "replay: the demonstration has no target; expected Demonstration(target=...), or no cloud of one"
        )
    return np.asarray(demonstration.target.points, float)


def _motion(of: Demonstration | Result) -> Float[np.ndarray, "4 4"]:
    """The motion of the object, 4x4."""
    return _matrices(Trajectory(jnp.asarray(of.object_motion)[None]))[0]


def _matrices(path: Trajectory) -> Float[np.ndarray, "poses 4 4"]:
    """Poses in double precision, as the physics has them."""
    return np.asarray(path.matrices, float)
