"""What the viewer computes: the pick on an object that was dragged, the path to a goal, and energies of poses."""

import dataclasses
import functools
import time
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from tdf_jax._internal import devices
from tdf_jax._internal.errors import InputError
from tdf_jax.energy.descriptors import pose_descriptor
from tdf_jax.energy.reference import Reference, describe
from tdf_jax.energy.residual import pick_residual
from tdf_jax.geometry import se3
from tdf_jax.geometry.transport import Arrival, arrival_of, carry_to_picks, carry_to_target
from tdf_jax.networks.checkpoint import load_model
from tdf_jax.networks.encoding import encode
from tdf_jax.networks.field import DescriptorField
from tdf_jax.networks.model import Model, fingerprint
from tdf_jax.networks.surface import surface_triangles
from tdf_jax.relation.placed_path import deeper_arrival, dense
from tdf_jax.solvers.imitation_scene import ImitationScene
from tdf_jax.solvers.pick import carry
from tdf_jax.solvers.result import Result
from tdf_jax.solvers.tracking import track
from tdf_jax.uncertainty.calibration import CALIBRATED, confidence
from tdf_jax.uncertainty.modes import Mode, cluster_poses

IDENTITY = np.array([1.0, 0, 0, 0, 0, 0, 0])
STARTS = 0  # number that seeds the starts of `carry`, where `track` is lost


@dataclasses.dataclass(frozen=True, eq=False)
class Problem:
    """What the viewer solves again and again.

    Attributes:
        scene: the imitation that is shown.
        model: its network.
        reference: its demonstration, described.
        points: cloud of the new object in its initial pose, (points, 3), metres, world frame.
        field: field of that cloud.
    """

    scene: ImitationScene
    model: Model
    reference: Reference
    points: Float[np.ndarray, "points 3"]
    field: DescriptorField

    @functools.cached_property
    def modes(self) -> list[Mode]:
        """Distinct picks by rising energy of the result: with a target, the sum with those of the contact regions."""
        return cluster_poses(jnp.asarray(self.scene.result.picks), jnp.asarray(self.scene.result.energies))

    @property
    def placed(self) -> bool:
        """Whether the object is placed on a target that was found by its contact region."""
        return len(self.scene.result.target_trajectories) > 0

    @functools.cached_property
    def pick_energies(self) -> list[float]:
        """Energy of the descriptors of every distinct pick alone, in the order of `modes`."""
        if self.placed:
            return [self.energy_in_place(mode.pose) for mode in self.modes]
        return [float(mode.energy) for mode in self.modes]

    @functools.cached_property
    def arrival(self) -> Arrival:
        """How the demonstrated object arrives at its target."""
        return arrival_of(self.scene.demonstration)

    def energy_in_place(self, pose: Float[np.ndarray | Array, "7"]) -> float:
        """Energy of the descriptors at a pose (eq. 2 of one waypoint), on the object in its initial pose.

        Args:
            pose: T_world_query, `wxyz_xyz`, (7,).
        """
        pose = jnp.asarray(pose, jnp.float32)
        return float(_energy(self.field, pose, self.reference.query, self.reference.descriptors[0]))


@dataclasses.dataclass(frozen=True, eq=False)
class ToTarget:
    """What a path to a target repeats of the demonstrated arrival.

    Attributes:
        target_motion: motion of the demonstrated target to where the object goes, `wxyz_xyz`, (7,), world frame.
        deeper: how much farther than demonstrated the object comes from, metres.
    """

    target_motion: Float[np.ndarray, "7"]
    deeper: float


@dataclasses.dataclass(frozen=True, eq=False)
class Solution:
    """A pick with its path, as the viewer shows it.

    Attributes:
        pick: T_world_query at the grasp, `wxyz_xyz`, (7,).
        goal: T_world_query at the release.
        path: T_world_query of every pose, approach and retreat included, (poses, 7).
        energy: energy of the pick's descriptors (eq. 2 of one waypoint).
        motion: where the object was dragged to, `wxyz_xyz`: a point x of `Problem.points` is at M x.
        result: result whose best candidate the pick is.
        confidence: probability that the pick is right, see `tdf_jax.confidence`; NaN where it is not calibrated.
        seconds: time of the encoding and of the search, seconds; None if nothing was searched.
        tracked: whether `track` found the pick; otherwise `carry` did, from many starts.
        to_target: how the object arrives at its target; None without one.
    """

    pick: Float[np.ndarray, "7"]
    goal: Float[np.ndarray, "7"]
    path: Float[np.ndarray, "poses 7"]
    energy: float
    motion: Float[np.ndarray, "7"]
    result: Result
    confidence: float = np.nan
    seconds: tuple[float, float] | None = None
    tracked: bool = True
    to_target: ToTarget | None = None

    @property
    def pick_in_place(self) -> Float[np.ndarray, "7"]:
        """The pick on the object in its initial pose, where it was before it was dragged, `wxyz_xyz`, (7,)."""
        back = se3.inverse(jnp.asarray(self.motion, jnp.float32))
        return np.asarray(se3.compose(back, jnp.asarray(self.pick, jnp.float32)))


def model_of(scene: ImitationScene, weights: str | None) -> Model:
    """The network that an imitation was made with.

    Args:
        scene: the imitation.
        weights: name or file of the weights; None for what the scene names.

    Raises:
        InputError: the scene names no weights, they cannot be read, or they are others than those of the scene.
    """
    kept = scene.weights
    if weights is None and kept is None:
        raise InputError("tdf view: the scene names no weights; expected --weights NAME or FILE")
    name = weights if weights is not None else kept.name  # pyright: ignore[reportOptionalMemberAccess]
    if weights is None and name.endswith(".safetensors") and not Path(name).is_file():
        raise InputError(
            f"tdf view: the imitation was made with the weights {name}, and there is no such file; expected it there, "
            "or --weights FILE"
        )
    model = load_model(name)
    if kept is not None and fingerprint(model) != kept.fingerprint:
        raise InputError(
            f"tdf view: the weights {name} are not those that the imitation was made with ({kept.name}, "
            f"{kept.fingerprint[:12]}); expected the same, whose descriptors and energies are comparable: give "
            "--weights FILE, or run `tdf imitate` again"
        )
    return model


def problem_of(scene: ImitationScene, model: Model) -> Problem:
    """Encode an imitation's object and describe its demonstration.

    Args:
        scene: the imitation.
        model: its network.

    Raises:
        InputError: the imitation has no pick.
    """
    if not np.asarray(scene.result.finite).any():
        raise InputError(
            f"tdf view: the imitation has no pick to show: {scene.result.status}; expected a finite candidate: check "
            "the clouds, and run `tdf imitate` again"
        )
    alone = dataclasses.replace(scene.demonstration, target=None)
    clean = int(scene.result.foreign_points) > 0
    field, kept = encode(model, scene.points, clean=clean, return_kept=True)
    return Problem(scene, model, describe(model, alone), np.asarray(scene.points)[np.asarray(kept)], field)


def chosen(problem: Problem, number: int) -> Solution:
    """The result of the folder: one of its distinct picks.

    Args:
        problem: the problem.
        number: index of the distinct pick, by rising energy.
    """
    index = int(problem.modes[number].members[0])
    result = problem.scene.result
    path = np.asarray(result.trajectories)[index]
    energy = problem.pick_energies[number]
    confident = float(result.confidence) if number == 0 else np.nan
    one = [index]
    first = np.asarray(result.first_residual)
    if np.isfinite(first):
        # By which `track` knows whether it is lost: a worse pick has a higher one.
        first = np.float32(pick_residual(energy, problem.reference.descriptors[0]))
    alone = dataclasses.replace(
        result,
        trajectories=np.asarray(result.trajectories)[one],
        energies=np.asarray(result.energies)[one],
        candidate_history=np.asarray(result.candidate_history)[one],
        first_residual=first,
        lost=np.zeros((), bool),
    )
    to_target = _to_target(problem, index) if problem.placed else None
    ends = path[result.grasp], path[result.release]
    return Solution(*ends, path, energy, IDENTITY.copy(), alone, confident, to_target=to_target)


def dragged(problem: Problem, motion: Float[np.ndarray, "7"], last: Solution) -> Solution:
    """Find the pick on the object where it was dragged to, from the last pick.

    The object is encoded anew there, as if a camera saw it. The goal is that of the last result; an object that is
    placed on a target keeps its place there instead, and the goal follows from the pick.

    Args:
        problem: the problem.
        motion: M, `wxyz_xyz`: a point x of `problem.points` is at M x.
        last: the last result.
    """
    began = time.perf_counter()
    points = np.asarray(se3.transform(jnp.asarray(motion, jnp.float32), jnp.asarray(problem.points, jnp.float32)))
    field = jax.block_until_ready(encode(problem.model, points, clean=False))
    encoded = time.perf_counter()
    result, tracked = _searched(field, problem.reference, last)
    pick = np.asarray(result.pick)
    energy = float(result.loss)
    goal = last.goal
    if last.to_target is not None:
        step = se3.compose(jnp.asarray(motion), se3.inverse(jnp.asarray(last.motion)))
        released = se3.compose(jnp.asarray(last.goal), se3.inverse(jnp.asarray(last.pick)))  # the object's motion
        goal = np.asarray(se3.compose(se3.compose(released, se3.inverse(step)), jnp.asarray(pick)))
    seconds = (encoded - began, time.perf_counter() - encoded)
    path = path_between(problem, pick, goal, last.to_target)
    confident = _confidence(problem, energy)
    return Solution(pick, goal, path, energy, np.asarray(motion), result, confident, seconds, tracked, last.to_target)


def with_goal(problem: Problem, goal: Float[np.ndarray, "7"], last: Solution) -> Solution:
    """The same pick, with the demonstration warped to another goal; the arrival at a target moves with the goal.

    Args:
        problem: the problem.
        goal: the goal, T_world_query, `wxyz_xyz`.
        last: the last result.
    """
    to_target = last.to_target
    if to_target is not None:
        shift = se3.compose(jnp.asarray(goal, jnp.float32), se3.inverse(jnp.asarray(last.goal, jnp.float32)))
        moved = np.asarray(se3.compose(shift, jnp.asarray(to_target.target_motion)))
        to_target = dataclasses.replace(to_target, target_motion=moved)
    path = path_between(problem, last.pick, goal, to_target)
    return dataclasses.replace(last, goal=np.asarray(goal), path=path, seconds=None, to_target=to_target)


def path_between(
    problem: Problem, pick: Float[np.ndarray, "7"], goal: Float[np.ndarray, "7"], to_target: ToTarget | None = None
) -> Float[np.ndarray, "poses 7"]:
    """The demonstration warped to a pick and a goal, with its approach and its retreat, (poses, 7).

    Args:
        problem: the problem.
        pick: T_world_query at the grasp, `wxyz_xyz`, (7,).
        goal: T_world_query at the release.
        to_target: how the object arrives at its target; None without one.
    """
    reference = problem.reference
    begin, end = jnp.asarray(pick, jnp.float32), jnp.asarray(goal, jnp.float32)
    if to_target is None:
        transfer = carry_to_picks(reference.trajectory, begin[None], end)[0]
    else:
        transfer = _carried(
            dense(problem.scene.demonstration.transfer),
            begin,
            end,
            jnp.asarray(to_target.target_motion, jnp.float32),
            jnp.float32(problem.arrival.length),
            jnp.float32(to_target.deeper),
        )
    demonstrated = reference.trajectory.wxyz_xyz
    parts = [
        se3.compose(se3.compose(transfer[0], se3.inverse(demonstrated[0])), reference.approach),
        transfer,
        se3.compose(se3.compose(transfer[-1], se3.inverse(demonstrated[-1])), reference.retreat),
    ]
    return np.concatenate([np.asarray(part).reshape(-1, 7) for part in parts])


def contact_of(problem: Problem, solution: Solution) -> Float[np.ndarray, "7"] | None:
    """Pose of the contact frame on the new target, T_world_contact, `wxyz_xyz`, (7,); None without a target.

    Args:
        problem: the problem.
        solution: the pick and the path; the contact moves with its goal.
    """
    target = problem.scene.demonstration.target
    if target is None or solution.to_target is None:
        return None
    motion = jnp.asarray(solution.to_target.target_motion, jnp.float32)
    return np.asarray(se3.compose(motion, jnp.asarray(target.T_world_contact, jnp.float32)))


def _to_target(problem: Problem, index: int) -> ToTarget:
    """How the object of a candidate arrives at its target."""
    scene, result, arrival = problem.scene, problem.scene.result, problem.arrival
    shown = scene.demonstration.target
    assert shown is not None  # there would be no contact poses
    path = jnp.asarray(np.asarray(result.trajectories)[index])
    motion = se3.compose(path[result.release], se3.inverse(path[result.grasp]))
    contact = jnp.asarray(np.asarray(result.target_trajectories)[index, 0], jnp.float32)
    target_motion = se3.compose(contact, se3.inverse(jnp.asarray(shown.T_world_contact, jnp.float32)))
    outward = np.asarray(se3.rotation(target_motion), float) @ arrival.outward
    target_points = np.asarray(shown.points if scene.target_points is None else scene.target_points)
    deeper = deeper_arrival(np.asarray(problem.points, float), target_points, motion, outward, arrival.depth)
    return ToTarget(np.asarray(target_motion), deeper)


@devices.quickly_compiled
def _carried(path, pick, goal, target_motion, arrival, deeper):
    return carry_to_target(path, pick, goal, target_motion, arrival=arrival, deeper=deeper).wxyz_xyz


@jax.jit
def _energy(field, pose, query, descriptors):
    return jnp.mean(jnp.abs(pose_descriptor(field, pose, query) - descriptors))


def point_under(
    points: Float[np.ndarray, "points 3"],
    origin: Float[np.ndarray, "3"],
    direction: Float[np.ndarray, "3"],
    reach: float,
) -> Float[np.ndarray, "3"] | None:
    """The point of a cloud that a ray meets first; None if it passes by.

    Args:
        points: cloud, (points, 3), metres.
        origin: where the ray begins, (3,).
        direction: its direction, (3,).
        reach: largest distance of a point from the ray, metres.
    """
    direction = np.asarray(direction, float) / np.linalg.norm(direction)
    relative = np.asarray(points, float) - origin
    along = relative @ direction
    aside = np.linalg.norm(relative - along[:, None] * direction, axis=1)
    near = np.flatnonzero((aside < reach) & (along > 0))
    return None if not len(near) else np.asarray(points[near[np.argmin(along[near])]], float)


def reconstructed(problem: Problem) -> Float[np.ndarray, "faces 3 3"]:
    """The surface that the network sees: where the occupancy of the field is 1/2, (faces, 3, 3), metres, world frame.

    Args:
        problem: the problem, whose object is in its initial pose.

    Raises:
        InputError: libigl is not installed.
    """
    bounds = np.stack([problem.points.min(axis=0), problem.points.max(axis=0)])
    return surface_triangles(problem.field, np.eye(4), bounds)


def _searched(field: DescriptorField, reference: Reference, last: Solution) -> tuple[Result, bool]:
    """The pick by `track`, or by `carry` where that is lost or has nothing to begin with; and which of the two."""
    ends: dict[str, Any] = {"goal": jnp.asarray(last.goal)}
    if reference.trajectory.num_poses == 1:
        ends = {"fix_last": False}
    # Results of other methods, and of few query points, have no latent or no residual to begin with.
    if last.result.latent.shape == field.latent.shape and np.isfinite(last.result.first_residual):
        result = track(field, reference, last.result, **ends)
        if not np.asarray(result.lost):
            return result, True
    return carry(field, reference, jax.random.key(STARTS), **ends), False


def _confidence(problem: Problem, energy: float) -> float:
    if problem.model.info.name not in CALIBRATED:
        return np.nan
    probability = confidence(pick_residual(energy, problem.reference.descriptors[0]))
    return np.nan if probability is None else probability
