"""The result of a solver: final candidates, and where every start began and how its energy fell."""

import dataclasses
import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from tdf_jax._internal import checks
from tdf_jax._internal.boundary import public
from tdf_jax._internal.deprecation import renamed_fields
from tdf_jax._internal.errors import InputError
from tdf_jax.energy.reference import Reference
from tdf_jax.geometry import se3
from tdf_jax.geometry.trajectory import Trajectory


def _no_contacts() -> np.ndarray:
    return np.zeros((0, 1, 7), np.float32)


def _no_seatings() -> np.ndarray:
    return np.zeros((0, 3), np.float32)


def _none() -> np.ndarray:
    return np.zeros((), np.int32)


def _uncounted() -> np.ndarray:
    return np.full((), -1, np.int32)


def _nowhere() -> np.ndarray:
    return np.full(3, np.nan, jax.dtypes.canonicalize_dtype(np.float64))


def _no_latent() -> np.ndarray:
    return np.zeros((0, 3), np.float32)


def _no() -> np.ndarray:
    return np.zeros((), bool)


def _unknown() -> np.ndarray:
    return np.full((), np.nan, np.float32)


@renamed_fields(losses="candidate_history", starts="initial_trajectories")
@functools.partial(
    jax.tree_util.register_dataclass,
    data_fields=[
        "trajectories",
        "energies",
        "candidate_history",
        "initial_trajectories",
        "history",
        "residual",
        "confidence",
        "recognised",
        "target_trajectories",
        "target_residual",
        "target_confidence",
        "seatings",
        "foreign_points",
        "target_foreign_points",
        "points_at_pick",
        "look_from",
        "origin",
        "latent",
        "first_residual",
        "lost",
    ],
    meta_fields=["grasp", "release"],
)
@dataclasses.dataclass(frozen=True, repr=False, eq=False)
class Result:
    """Result of any solver. Every field but the indices `grasp` and `release` is an array; unknown values are NaN.

    The indices are static, because they select rows.

    `optimize` keeps every start to the end, so its candidates are its starts. `solve` and `carry` follow many starts on
    a few query points, drop most of them, and refine the best distinct candidates on all query points.

    The properties work on traced values and on results with leading batch axes, such as those that `jax.vmap` returns.

    Attributes:
        trajectories: final candidates, (candidates, poses, 7), `wxyz_xyz`, T_world_query.
        energies: energy of each candidate after the last step, (candidates,).
        candidate_history: energy of each candidate before each step, (candidates, steps). Before the last stage of
            `solve` and `carry`, row k holds the energies of the k-th best candidates at that step, on the coarse query
            points.
        initial_trajectories: initial poses of every start, (starts, poses, 7), T_world_query.
        history: energy of every start before each step, (starts, steps); NaN, or infinite in a traced call, where the
            solver does not follow the start. Of several waypoints `solve` follows the starts as trajectories in the
            search stage only.
        residual: normalised descriptor energy of the best pick of `carry`, see `tdf_jax.confidence`; a scalar, NaN for
            other solvers.
        confidence: probability that the pick is right, in [0, 1], see `tdf_jax.confidence`; a scalar, set by `imitate`
            with weights that it is calibrated for.
        recognised: probability that the object is of the demonstration's category, in [0, 1], see
            `tdf_jax.recognition`; a scalar, set by `imitate` with shipped weights.
        target_trajectories: pose of the contact frame on the target of each candidate, (candidates, 1, 7),
            T_world_contact; no candidates unless the demonstration has a target.
        target_residual: normalised descriptor energy of the contact points on the target, of the pose at which it is
            the least, before registration and seating; a scalar, NaN if the target has not moved.
        target_confidence: probability that the contact pose on the target is right; a scalar, NaN where it is not
            calibrated.
        seatings: displacement of the placed object by which it touches its target, world frame, (candidates, 3),
            metres; NaN where it was not seated, see `imitate`. No candidates unless the demonstration has a target.
        foreign_points: number of points of the object's cloud that were removed because they are not of the object, see
            `encode`; a scalar, set by `imitate`.
        target_foreign_points: the same for the new target's cloud.
        points_at_pick: number of points of the object's cloud in the box of query points at the pick; a scalar, set by
            `imitate` where it gives a confidence, else -1.
        look_from: direction from the object towards a camera that would see what is expected and not seen yet, (3,),
            unit vector, world frame; set by `imitate` where the confidence is below one half, else NaN.
        origin: origin of the object's field, (3,), metres, world frame; NaN for solvers but `carry` and `track`.
        latent: latent of that field, (latent, 3); empty for solvers but `carry` and `track`.
        first_residual: residual of the pick of `carry` that `track` began with; of `carry` its own. NaN for others.
        lost: whether `track` did not find the pick again; a scalar. A lost result has no best candidate.
        grasp: index of the pose at which the object is grasped; poses before it are the approach.
        release: index of the pose at which it is released, from the end: -1 unless there is a retreat.
    """

    trajectories: Float[Array | np.ndarray, "*batch candidates poses 7"]
    energies: Float[Array | np.ndarray, "*batch candidates"]
    candidate_history: Float[Array | np.ndarray, "*batch candidates steps"]
    initial_trajectories: Float[Array | np.ndarray, "*batch starts poses 7"]
    history: Float[Array | np.ndarray, "*batch starts steps"]
    residual: Float[Array | np.ndarray, "*batch"] = dataclasses.field(default_factory=_unknown)
    confidence: Float[Array | np.ndarray, "*batch"] = dataclasses.field(default_factory=_unknown)
    recognised: Float[Array | np.ndarray, "*batch"] = dataclasses.field(default_factory=_unknown)
    target_trajectories: Float[Array | np.ndarray, "*batch targets 1 7"] = dataclasses.field(
        default_factory=_no_contacts
    )
    target_residual: Float[Array | np.ndarray, "*batch"] = dataclasses.field(default_factory=_unknown)
    target_confidence: Float[Array | np.ndarray, "*batch"] = dataclasses.field(default_factory=_unknown)
    seatings: Float[Array | np.ndarray, "*batch targets 3"] = dataclasses.field(default_factory=_no_seatings)
    foreign_points: Int[Array | np.ndarray, "*batch"] = dataclasses.field(default_factory=_none)
    target_foreign_points: Int[Array | np.ndarray, "*batch"] = dataclasses.field(default_factory=_none)
    points_at_pick: Int[Array | np.ndarray, "*batch"] = dataclasses.field(default_factory=_uncounted)
    look_from: Float[Array | np.ndarray, "*batch 3"] = dataclasses.field(default_factory=_nowhere)
    origin: Float[Array | np.ndarray, "*batch 3"] = dataclasses.field(default_factory=_nowhere)
    latent: Float[Array | np.ndarray, "*batch latent 3"] = dataclasses.field(default_factory=_no_latent)
    first_residual: Float[Array | np.ndarray, "*batch"] = dataclasses.field(default_factory=_unknown)
    lost: Bool[Array | np.ndarray, "*batch"] = dataclasses.field(default_factory=_no)
    grasp: int = 0
    release: int = -1

    @property
    @public
    def finite(self) -> Bool[Array | np.ndarray, "*batch candidates"]:
        """Which candidates are finite."""
        xp = self._numpy
        return xp.isfinite(self.energies) & xp.isfinite(xp.asarray(self.trajectories)).all(axis=(-2, -1))

    @property
    @public
    def best(self) -> int | Int[Array | np.ndarray, "*batch"]:
        """Index of the finite candidate with the least energy; of a batch, one for each result.

        Raises:
            InputError: no candidate is finite, or the pick is lost. Traced values are not checked: index 0 is taken,
                and `lost` says whether the pick is.
        """
        finite, xp = self.finite, self._numpy
        if not checks.traced(self.lost) and np.asarray(self.lost).any():
            raise InputError(
                f"Result.best: {self.status}; expected a pick that `track` found. Call carry(), or take "
                "result.trajectories to see where the search ended"
            )
        if not checks.traced(finite) and not np.asarray(finite).any(axis=-1).all():
            raise InputError(
                f"Result.best: {self.status}; check the weights and the query points, or, with Adam, lower "
                "rotation_rate and translation_rate"
            )
        best = xp.argmin(xp.where(finite, xp.asarray(self.energies), xp.inf), axis=-1)
        return best if checks.traced(finite) or np.ndim(best) else int(best)

    @property
    @public
    def trajectory(self) -> Trajectory:
        """The best trajectory, T_world_query."""
        xp = self._numpy
        index = xp.asarray(self.best)[..., None, None, None]
        best = xp.take_along_axis(xp.asarray(self.trajectories), index, axis=-3)[..., 0, :, :]
        return Trajectory(jnp.asarray(best))

    @property
    @public
    def picks(self) -> Float[Array | np.ndarray, "*batch candidates 7"]:
        """Pose of the query frame at the grasp of every candidate, T_world_query, `wxyz_xyz`."""
        return self.trajectories[..., self.grasp, :]

    @property
    @public
    def pick(self) -> Float[Array, "*batch 7"]:
        """Pose of the query frame at the grasp, of the best trajectory, T_world_query, `wxyz_xyz`."""
        return self.trajectory.wxyz_xyz[..., self.grasp, :]

    @property
    @public
    def goal(self) -> Float[Array, "*batch 7"]:
        """Pose of the query frame at the release, of the best trajectory, T_world_query, `wxyz_xyz`."""
        return self.trajectory.wxyz_xyz[..., self.release, :]

    @property
    @public
    def object_motion(self) -> Float[Array, "*batch 7"]:
        """Motion of the object from the grasp to the release, `wxyz_xyz`: a point x in its initial pose ends at M x."""
        return se3.compose(self.goal, se3.inverse(self.pick))

    @property
    @public
    def loss(self) -> float | Float[Array | np.ndarray, "*batch"]:
        """Energy of the best trajectory; a Python float outside a trace, unless there is a batch."""
        xp = self._numpy
        loss = xp.take_along_axis(xp.asarray(self.energies), xp.asarray(self.best)[..., None], axis=-1)[..., 0]
        return loss if checks.traced(loss) or loss.ndim else float(loss)

    @property
    @public
    def status(self) -> str:
        """How the candidates ended, in words."""
        finite, lost = np.asarray(self.finite), np.asarray(self.lost)
        if lost.any():
            which = f"{np.count_nonzero(lost)} of {lost.size} picks are lost" if lost.ndim else "the pick is lost"
            found, before = np.asarray(self.residual), np.asarray(self.first_residual)
            with np.errstate(all="ignore"):
                ratios = ", ".join(f"{ratio:.2g}" for ratio in np.atleast_1d(found / before)[np.atleast_1d(lost)])
            return f"{which}: the energy is {ratios} times that of the pick of carry()"
        failed, kind = np.argwhere(~finite), "candidates" if self._pruned else "starts"
        if len(failed) == 0:
            return f"all {finite.size} {kind} finite"
        names = ", ".join(str(index[0]) if len(index) == 1 else str(tuple(map(int, index))) for index in failed)
        return f"{len(failed)} of {finite.size} {kind} became non-finite: {names}"

    @property
    @public
    def advice(self) -> str:
        """What to do about a pick that is probably wrong, in words; empty if there is nothing to say.

        Raises:
            InputError: the result is a batch, or traced.
        """
        from tdf_jax.uncertainty.advice import SEEN  # what is displayed may look there, see `_distinct_picks`
        from tdf_jax.uncertainty.doubt import DOUBT

        if checks.traced(self.confidence, self.look_from) or np.ndim(self.confidence):
            raise InputError(
                "Result.advice: the result is a batch or traced; expected one result outside of a trace. Take one with "
                "jax.tree.map(lambda x: x[i], result)"
            )
        if not float(self.confidence) < DOUBT:
            return ""
        count = int(self.points_at_pick)
        unseen = 0 <= count < SEEN  # -1 where they are not counted
        place = f"its place is not seen ({count} points of the cloud are there); " * unseen
        if not np.isfinite(np.asarray(self.look_from)).all():
            return f"{place}compare the other candidates, and check that the cloud shows nothing but the object"
        direction = _numbers(self.look_from)
        return f"{place}look from the direction {direction}, a unit vector from the object to the camera, world frame"

    @property
    def _numpy(self) -> Any:
        return jnp if checks.traced(self.energies, self.trajectories) else np

    @property
    def _pruned(self) -> bool:
        return np.shape(self.energies)[-1] != np.shape(self.history)[-2]

    @public
    def __repr__(self) -> str:
        rows = self._summary()
        width = max(map(len, rows))
        return "\n".join(["Result", *(f"  {name:<{width}}  {value}" for name, value in rows.items())])

    @public
    def _repr_html_(self) -> str:
        rows = self._summary()
        from tdf_jax.viz.cards import card, result_card  # what is displayed may look there, see `_distinct_picks`

        return result_card(self, rows) if "pick" in rows else card("Result", rows, None)

    def _summary(self) -> dict[str, str]:
        """Rows that `repr` prints; of traced values and batches, shapes only."""
        shapes = {"trajectories": str(np.shape(self.trajectories)), "starts": str(np.shape(self.history)[:-1])}
        if checks.traced(self.energies, self.trajectories) or np.ndim(self.energies) != 1:
            return shapes
        starts, candidates = len(self.history), len(self.energies)
        rows = {
            "starts": f"{starts}" + (f", {candidates} final candidates" if self._pruned else ""),
            "poses": f"{np.shape(self.trajectories)[-2]}",
            "status": self.status,
        }
        removed = {"object": int(self.foreign_points), "target": int(self.target_foreign_points)}
        if any(removed.values()):
            words = ", ".join(f"{number} of the {name}'s cloud" for name, number in removed.items() if number)
            rows["foreign points"] = f"removed {words}"
        if not np.asarray(self.finite).any() or np.asarray(self.lost):
            return rows
        pick = np.asarray(self.picks)[self.best]
        energies = np.sort(np.asarray(self.energies)[np.asarray(self.finite)])
        others = ", ".join(f"{energy:.5f}" for energy in energies[1:4]) + (", ..." if len(energies) > 4 else "")
        rows["pick"] = f"xyz {_numbers(pick[4:])} m, wxyz {_numbers(pick[:4])} (T_world_query)"
        rows["loss"] = f"{energies[0]:.5f}" + (f" (others: {others})" if others else "")
        for name, words in (
            ("confidence", "that the pick is right to 2 cm and 20 degrees"),
            ("recognised", "that the object is of the demonstration's category"),
        ):
            value = float(getattr(self, name))
            rows[name] = f"{value:.2f} {words}" if np.isfinite(value) else "unknown"
        if self.advice:
            rows["advice"] = self.advice
        distinct = _distinct_picks(self)
        rows["solutions"] = f"{distinct} distinct pick{'' if distinct == 1 else 's'}"
        return rows


def with_ends(result: Result, reference: Reference) -> Result:
    """Add the demonstrated approach and retreat to a result of the poses from the grasp to the release.

    The approach moves rigidly with the pick, the retreat with the pose of the release.

    Args:
        result: result whose trajectories are as long as the reference's.
        reference: the demonstration.

    Returns:
        The result with longer trajectories and initial trajectories; the same if there is neither part.
    """
    before, after = len(reference.approach), len(reference.retreat)
    if not before and not after:
        return result
    grasp, release = reference.trajectory.wxyz_xyz[0], reference.trajectory.wxyz_xyz[-1]
    ends = (grasp, release, reference.approach, reference.retreat)
    longer = {name: _longer(getattr(result, name), *ends) for name in ("trajectories", "initial_trajectories")}
    return dataclasses.replace(result, **longer, grasp=result.grasp + before, release=result.release - after)


@jax.jit
def _longer(trajectories, grasp, release, approach, retreat):
    def extend(wxyz_xyz):
        pick_motion = se3.compose(wxyz_xyz[0], se3.inverse(grasp))
        goal_motion = se3.compose(wxyz_xyz[-1], se3.inverse(release))
        parts = [se3.compose(pick_motion, approach), wxyz_xyz, se3.compose(goal_motion, retreat)]
        return jnp.concatenate(parts).astype(wxyz_xyz.dtype)

    return jax.vmap(extend)(jnp.asarray(trajectories))


def _numbers(values) -> str:
    return "(" + ", ".join(f"{value:.3f}" for value in values) + ")"


def _distinct_picks(result: Result) -> int:
    # Display may look at what comes after the solvers: tests/test_layout.py lists this import.
    from tdf_jax.uncertainty.modes import cluster_poses

    return len(cluster_poses(jnp.asarray(result.picks), jnp.asarray(result.energies)))
