"""Imitation in one call: a demonstration and a new object's point cloud give a trajectory."""

import dataclasses
import inspect
import warnings
from collections.abc import Callable, Iterable, Sequence
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from tdf_jax._internal import checks
from tdf_jax._internal.boundary import host
from tdf_jax._internal.deprecation import caller_level, renamed_keywords
from tdf_jax._internal.devices import one_at_a_time
from tdf_jax._internal.errors import ConfidenceWarning, InputError, TdfWarning
from tdf_jax.energy.losses import EnergyWeights
from tdf_jax.energy.reference import Reference
from tdf_jax.geometry.demonstration import Demonstration
from tdf_jax.networks.encoding import encode
from tdf_jax.networks.field import with_decoder_of
from tdf_jax.networks.model import Model
from tdf_jax.relation.placed_path import carry_object
from tdf_jax.relation.two_objects import Objects, check_scene, kept_points, reference_of, target_field
from tdf_jax.solvers.adam import OptimizeConfig, optimize
from tdf_jax.solvers.initial import default_goal
from tdf_jax.solvers.multistart import SolveConfig, solve
from tdf_jax.solvers.pick import CarryConfig, carry, carry_together
from tdf_jax.solvers.result import Result
from tdf_jax.uncertainty.advice import look_from, points_at
from tdf_jax.uncertainty.calibration import CURVES, confidence_by, recognition, surface_logit
from tdf_jax.uncertainty.doubt import DOUBT, warn_of_category, warn_of_target

# Objects whose picks an accelerator finds together. It is an estimate, as `devices.ACCELERATOR_POINTS` is: the first
# stage then evaluates 65,536 query points.
ACCELERATOR_TARGETS = 64
T = TypeVar("T")


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
        ConfidenceWarning: the pick is probably wrong. This and the category are judged with shipped weights and the
            default config only.
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
    goal = _goal(field, reference, goal, goal_offset)
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


def _goal(field, reference: Reference, goal, goal_offset) -> Array | None:
    """The goal with its offset; None for the default one."""
    goal = None if goal is None else jnp.asarray(checks.pose("imitate()", "goal", goal), float)
    if goal_offset is not None:
        goal = default_goal(field, reference) if goal is None else goal
        goal = goal + jnp.pad(jnp.asarray(checks.vector("imitate()", "goal_offset", goal_offset)), (4, 0))
    return goal


def _merged(points) -> Any:
    """One cloud of several views; anything else as it is."""
    if not isinstance(points, list | tuple) or not points or not all(np.ndim(view) == 2 for view in points):
        return points
    views = [np.asarray(checks.coordinates("imitate()", f"points[{index}]", view)) for index, view in enumerate(points)]
    return np.concatenate(views)


def _judged(result: Result, weights: str, field, points, reference: Reference) -> Result:
    """The result with the probabilities that shipped weights are calibrated for, NaN where they are not, and advice."""
    recognised, confident = None, confidence_by(weights, float(result.residual))
    if weights in CURVES:
        recognised = recognition(float(result.residual), surface_logit(field, points), CURVES[weights])
    if confident is not None:
        result = dataclasses.replace(
            result, points_at_pick=np.asarray(points_at(points, result.pick, reference.query), np.int32)
        )
    check = "points, their unit, the weights, and whether the cloud shows enough of the object"
    warn_of_category("imitate()", "object", recognised, weights, check)
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
    chunk_targets: int | None = None,
    **settings,
) -> list[Result]:
    """Imitate on many new objects.

    The demonstration is encoded once. On an accelerator the picks of many objects are found together, in one program.
    On a CPU, where one object's starts fill the machine, they are found one after the other, and memory does not grow
    with their number; `chunk_targets` finds them together there too, which is not faster.

    Args:
        model: as for `imitate`.
        demonstration: as for `imitate`.
        clouds: one point cloud for each object, (points, 3), metres, world frame; sizes may differ.
        key: random key; object i uses `jax.random.fold_in(key, i)`.
        chunk_targets: number of objects whose picks are found in one program. None chooses: 1 on a CPU, and
            `ACCELERATOR_TARGETS` on an accelerator where the settings allow it. More than one needs a `CarryConfig`, a
            demonstration without a target, and neither `progress` nor `device_mesh`.
        **settings: as for `imitate`, shared by all objects; so is a new target.

    Returns:
        One result for each object, in order; those of `imitate` up to rounding.

    Raises:
        InputError: no clouds, or as for `imitate`; what is about one object names it.

    Warns:
        As `imitate`; what is about one object names it.
    """
    checks.key("imitate_batch()", key)
    if chunk_targets is not None:
        checks.count("imitate_batch()", "chunk_targets", chunk_targets)
    every = list(clouds)
    if not every:
        raise InputError("imitate_batch(): there are no clouds; expected at least one")
    inspect.signature(imitate).bind_partial(**settings)  # a TypeError names what it does not know
    target_points, target_model = (settings.get(name) for name in ("target_points", "target_model"))
    reference = reference_of("imitate_batch()", model, demonstration, target_points, target_model)
    keys = [jax.random.fold_in(key, index) for index in range(len(every))]
    alone = _alone(reference, settings)
    if chunk_targets is None:
        chunk_targets = 1 if alone or one_at_a_time() else ACCELERATOR_TARGETS
    if chunk_targets > 1:
        if alone:
            raise InputError(
                f"imitate_batch(): chunk_targets is {chunk_targets}, and {alone}; expected 1, which imitates on one "
                "object after the other"
            )
        results = []
        for start in range(0, len(every), chunk_targets):
            part = range(start, min(start + chunk_targets, len(every)))
            results += _together(model, reference, every, keys, part, chunk_targets, **settings)
        return results
    return [
        _naming(index, lambda index=index: imitate(model, reference, every[index], key=keys[index], **settings))
        for index in range(len(every))
    ]


def _alone(reference: Reference, settings: dict[str, Any]) -> str:
    """Why objects cannot be imitated on together, in words; empty if they can be."""
    if not isinstance(settings.get("config", CarryConfig()), CarryConfig) or settings.get("energy") is not None:
        return "the method is not that of a CarryConfig"
    if reference.contact is not None:
        return "the demonstration has a target"
    given = [name for name in ("progress", "device_mesh") if settings.get(name) is not None]
    return f"there is a {given[0]}" if given else ""


def _together(
    model: Model,
    reference: Reference,
    clouds: list,
    keys: list,
    part: range,
    room: int,
    *,
    goal=None,
    goal_offset=None,
    fix_last: bool = True,
    seat: bool = True,
    clean: bool = True,
    config: CarryConfig = CarryConfig(),
    **others,
) -> list[Result]:
    """Results of a part of the objects, whose picks one program finds that has room for `room` of them.

    Of the settings of `imitate`, those in `others` are None, or have no effect here.
    """
    for name, value in (("fix_last", fix_last), ("seat", seat), ("clean", clean)):
        checks.boolean("imitate_batch()", name, value)
    if not fix_last and (goal is not None or goal_offset is not None):
        raise InputError("imitate_batch(): there is a goal, and fix_last=False does not keep it; drop one of them")
    fields, seen, foreign, goals = [], [], [], []
    for index in part:
        cloud = _merged(clouds[index])
        field, kept = _naming(index, lambda cloud=cloud: encode(model, cloud, clean=clean, return_kept=True))
        # Copies of the decoder's weights would take 2.6 MB each.
        fields.append(with_decoder_of(field, fields[0]) if fields else field)
        seen.append(kept_points(cloud, kept))
        foreign.append(np.asarray(np.count_nonzero(~kept), np.int32))
        end = _goal(field, reference, goal, goal_offset)
        goals.append(default_goal(field, reference) if end is None else end)
    found = carry_together(fields, reference, keys[part.start : part.stop], goals if fix_last else None, room, config)
    results = []
    for index, result, field, cloud, count in zip(part, found, fields, seen, foreign, strict=True):
        judged = _naming(
            index,
            lambda result=result, field=field, cloud=cloud: _judged(result, model.info.name, field, cloud, reference),
        )
        results.append(dataclasses.replace(judged, foreign_points=count))
    return results


def _naming(index: int, call: Callable[[], T]) -> T:
    """What a call about one object returns; what it raises and warns of names the object."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        try:
            value = call()
        except InputError as error:
            raise InputError(f"imitate_batch(): object {index}: {error}") from None
    for one in caught:
        words = one.message
        if issubclass(one.category, TdfWarning):
            words = f"imitate_batch(): object {index}: {words}"
        warnings.warn(words, one.category, stacklevel=caller_level())
    return value
