"""Imitation in one call: a demonstration and a new object's point cloud give a trajectory."""

import dataclasses
import warnings
from collections.abc import Callable, Iterable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from tdf_jax._internal import checks
from tdf_jax._internal.boundary import host
from tdf_jax._internal.deprecation import caller_level, renamed_keywords
from tdf_jax._internal.errors import ConfidenceWarning, InputError
from tdf_jax.energy.losses import EnergyWeights
from tdf_jax.energy.reference import Reference
from tdf_jax.geometry.demonstration import Demonstration
from tdf_jax.networks.encoding import encode
from tdf_jax.networks.model import Model
from tdf_jax.relation import Objects, carry_object, check_scene, kept_points, reference_of, target_field
from tdf_jax.solvers.adam import OptimizeConfig, optimize
from tdf_jax.solvers.initial import default_goal
from tdf_jax.solvers.multistart import SolveConfig, solve
from tdf_jax.solvers.pick import CarryConfig, carry
from tdf_jax.solvers.result import Result
from tdf_jax.uncertainty.advice import look_from, points_at
from tdf_jax.uncertainty.calibration import CALIBRATED, CURVES, confidence, recognition, surface_logit
from tdf_jax.uncertainty.doubt import DOUBT, warn_of_category, warn_of_target


@host
@renamed_keywords(mesh="device_mesh")
def imitate(
    model: Model,
    demonstration: Demonstration | Sequence[Demonstration] | Reference,
    points: Float[Array | np.ndarray, "points 3"] | Sequence[Float[Array | np.ndarray, "_ 3"]],
    *,
    target_points: Float[Array | np.ndarray, "target_points 3"] | None = None,
    target_model: Model | None = None,
    key: PRNGKeyArray,
    goal: Float[Array | np.ndarray, "7"] | None = None,
    goal_offset: Float[Array | np.ndarray, "3"] | Sequence[float] | None = None,
    fix_last: bool = True,
    seat: bool = True,
    clean: bool = True,
    energy: EnergyWeights | None = None,
    config: CarryConfig | SolveConfig | OptimizeConfig = CarryConfig(),
    progress: Callable | None = None,
    device_mesh: jax.sharding.Mesh | None = None,
) -> Result:
    """Imitate a demonstrated trajectory on a new object of the same category.

    By default the pick is found by descriptors, and the demonstrated path is warped from there to end at the goal. With
    `config=SolveConfig()` or `OptimizeConfig()` the paper's energy, eq. 3, is minimised over all waypoints, by
    Gauss-Newton steps or by Adam (docs/results/benchmark.md compares them).

    A cloud denser than the network's training clouds is reduced by farthest-point sampling, see `encode`.

    Args:
        model: the network.
        demonstration: one, several with the same query points, or a `Reference` from `describe` to share between calls.
        points: point cloud of the new object, (points, 3), metres, world frame; or a list of several views of it in one
            world frame, which are merged.
        target_points: point cloud of the new target, (points, 3), metres, world frame, if the demonstration has one.
            Without it the demonstrated target has not moved, and the object is placed there.
        target_model: network of the targets, the one that described a `Reference`; by default `model`. A demonstrated
            target that has not moved needs none; with one the object is seated by the fields of both.
        key: random key, such as `jax.random.key(0)`; the result is a function of it.
        goal: pose at the release, (7,), T_world_query as `wxyz_xyz`; by default, with `fix_last`, the demonstration's,
            moved by the centroids. Poses after the release follow it rigidly.
        goal_offset: vector that is added to the goal's translation, (3,), metres, world frame.
        fix_last: keep the pose at the release at the goal. Otherwise, such as for the one pose of a grasp, the
            demonstration is carried rigidly with the pick; with the other configs all poses are free, and a goal is
            where the pose at the release starts.
        seat: with a target, lower or raise the placed object until it touches the target; see `relate`.
        clean: remove foreign points from both clouds, such as of the table, see `encode`; the result counts them.
        energy: weights of the terms of eq. 3, by default the paper's; only with a `config` that minimises it.
        config: settings of `carry`, of `solve`, or, for Adam as in the paper and for energies with eq. 6, of
            `optimize`.
        progress: see `solve` and `optimize`.
        device_mesh: see `solve` and `optimize`.

    Returns:
        The result; `.trajectory` is the best trajectory, T_world_query.

    Raises:
        InputError: bad points, goal, offset or settings, an energy that `carry` would not use, no target points where
            the demonstrated targets differ, or a `Reference` whose target was described by another network.

    Warns:
        CategoryWarning: the object, or the target, is probably of another category than the demonstration's, or the
            network of the object describes a demonstrated target that is probably not of its category.
        ForeignPointsWarning: see `encode`.
        ConfidenceWarning: the pick is probably wrong. Both are known for shipped weights and the default config.
        SizeWarning: see `encode`.
    """
    checks.key("imitate()", key)
    if not isinstance(config, CarryConfig | SolveConfig | OptimizeConfig):
        raise InputError(f"imitate(): config is {config!r}; expected a CarryConfig, SolveConfig or OptimizeConfig")
    if isinstance(config, CarryConfig) and energy is not None:
        raise InputError(
            "imitate(): energy is given, but `carry` does not minimise eq. 3; expected no energy, or "
            "config=SolveConfig() or OptimizeConfig() with it"
        )
    checks.boolean("imitate()", "fix_last", fix_last)
    checks.boolean("imitate()", "seat", seat)
    checks.boolean("imitate()", "clean", clean)
    cloud = _merged(points)
    reference = reference_of("imitate()", model, demonstration, target_points, target_model)
    if reference.contact is not None:
        given = {"goal": goal is not None, "goal_offset": goal_offset is not None, "fix_last=False": not fix_last}
        contradicting = ", ".join(name for name, is_given in given.items() if is_given)
        if contradicting or not isinstance(config, CarryConfig):
            raise InputError(
                f"imitate(): {contradicting or 'config is ' + type(config).__name__}, and the demonstration has a "
                "target, which gives the goal; expected no goal and a CarryConfig. Drop one of them"
            )
    field, kept = encode(model, cloud, clean=clean, return_kept=True)
    foreign, cloud = np.asarray(np.count_nonzero(~kept), np.int32), kept_points(cloud, kept)
    if reference.contact is not None:
        target, placed = target_field(model, reference, target_points, target_model, clean)
        objects = Objects(cloud, placed, field, target)
        check_scene("imitate()", cloud, placed, reference)
        search = {"config": config, "seat": seat, "progress": progress, "device_mesh": device_mesh}
        result = carry_object(objects, reference, key, **search)
        if target_points is not None:
            weights = (model if target_model is None else target_model).info.name
            warn_of_target("imitate()", float(result.target_residual), weights, target, placed)
            foreign_of_target = np.asarray(len(target_points) - len(placed), np.int32)
            result = dataclasses.replace(result, target_foreign_points=foreign_of_target)
        judged = _judged(result, model.info.name, field, cloud, reference)
        return dataclasses.replace(judged, foreign_points=foreign)
    goal = None if goal is None else jnp.asarray(checks.pose("imitate()", "goal", goal), float)
    if goal_offset is not None:
        goal = default_goal(field, reference) if goal is None else goal
        goal = goal + jnp.pad(jnp.asarray(checks.vector("imitate()", "goal_offset", goal_offset)), (4, 0))
    settings = {"goal": goal, "fix_last": fix_last, "progress": progress, "device_mesh": device_mesh}
    if isinstance(config, CarryConfig):
        result = carry(field, reference, key, config=config, **settings)
        judged = _judged(result, model.info.name, field, cloud, reference)
        return dataclasses.replace(judged, foreign_points=foreign)
    weights = EnergyWeights() if energy is None else energy
    if isinstance(config, OptimizeConfig):
        result = optimize(field, reference, key, energy=weights, config=config, **settings)
    else:
        result = solve(field, reference, key, energy=weights, config=config, **settings)
    return dataclasses.replace(result, foreign_points=foreign)


def _merged(points) -> Any:
    """One cloud of several views; anything else as it is."""
    if not isinstance(points, list | tuple) or not points or not all(np.ndim(view) == 2 for view in points):
        return points
    views = [np.asarray(checks.coordinates("imitate()", f"points[{index}]", view)) for index, view in enumerate(points)]
    return np.concatenate(views)


def _judged(result: Result, weights: str, field, points, reference: Reference) -> Result:
    """The result with the probabilities that shipped weights are calibrated for, NaN where they are not, and advice."""
    recognised = confident = None
    if weights in CURVES:
        recognised = recognition(float(result.residual), surface_logit(field, points), CURVES[weights])
    if weights in CALIBRATED:
        confident = confidence(float(result.residual))
    if confident is not None:
        result = dataclasses.replace(
            result, points_at_pick=np.asarray(points_at(points, result.pick, reference.query), np.int32)
        )
    warn_of_category("imitate()", "object", recognised, weights, "points, their unit and the weights")
    known: dict[str, Any] = {"recognised": recognised, "confidence": confident}
    if confident is not None and confident < DOUBT:
        known["look_from"] = look_from(field, points)
    # In numpy, because under `jax_debug_nans` an array of jax must not hold NaN.
    result = dataclasses.replace(
        result, **{name: np.asarray(np.nan if value is None else value, np.float32) for name, value in known.items()}
    )
    if confident is not None and confident < DOUBT and (recognised is None or recognised >= DOUBT):
        warnings.warn(
            f"imitate(): the pick is right with a probability of {confident:.2g} only: {result.advice}. Several views "
            "are passed as points=[first, second]",
            ConfidenceWarning,
            stacklevel=caller_level(),
        )
    return result


@host
@renamed_keywords(mesh="device_mesh")
def imitate_batch(
    model: Model,
    demonstration: Demonstration | Sequence[Demonstration] | Reference,
    clouds: Iterable[Float[Array | np.ndarray, "points 3"]],
    *,
    key: PRNGKeyArray,
    **settings,
) -> list[Result]:
    """Imitate on many new objects with one compiled program.

    The demonstration is encoded once. Objects run one after the other: one object's starts already fill the machine,
    and memory does not grow with their number.

    Args:
        model: as for `imitate`.
        demonstration: as for `imitate`.
        clouds: one point cloud for each object, (points, 3), metres, world frame; sizes may differ.
        key: random key; object i uses `jax.random.fold_in(key, i)`.
        **settings: as for `imitate`, shared by all objects; so is a new target.

    Returns:
        One result for each object, in order.

    Raises:
        InputError: no clouds, or as for `imitate`.
    """
    checks.key("imitate_batch()", key)
    clouds = list(clouds)
    if not clouds:
        raise InputError("imitate_batch(): there are no clouds; expected at least one")
    target_points, target_model = (settings.get(name) for name in ("target_points", "target_model"))
    reference = reference_of("imitate_batch()", model, demonstration, target_points, target_model)
    return [
        imitate(model, reference, points, key=jax.random.fold_in(key, index), **settings)
        for index, points in enumerate(clouds)
    ]
