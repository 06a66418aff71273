"""Imitation, the whole way in one call: demonstration + new object's cloud -> trajectory."""

import dataclasses
import warnings
from collections.abc import Callable, Iterable, Sequence

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

from tdf_jax._internal import checks
from tdf_jax._internal.errors import CategoryWarning, InputError
from tdf_jax.energy.losses import EnergyWeights
from tdf_jax.energy.reference import Reference, describe
from tdf_jax.geometry.demonstration import Demonstration
from tdf_jax.networks.encoding import encode
from tdf_jax.networks.model import Model
from tdf_jax.solvers.adam import OptimizeConfig, optimize
from tdf_jax.solvers.initial import default_goal
from tdf_jax.solvers.multistart import SolveConfig, solve
from tdf_jax.solvers.pick import CarryConfig, carry
from tdf_jax.solvers.result import Result
from tdf_jax.uncertainty.calibration import CALIBRATED, CURVES, confidence, recognition, surface_logit

DOUBT = 0.5  # probability of the demonstration's category below which a warning is issued


def imitate(
    model: Model,
    demonstration: Demonstration | Sequence[Demonstration] | Reference,
    points: Float[Array, "points 3"],
    *,
    key: PRNGKeyArray,
    goal: Float[Array, "7"] | None = None,
    goal_offset: Float[Array, "3"] | None = None,
    fix_last: bool = True,
    energy: EnergyWeights | None = None,
    config: CarryConfig | SolveConfig | OptimizeConfig = CarryConfig(),
    progress: Callable | None = None,
    mesh: jax.sharding.Mesh | None = None,
) -> Result:
    """Imitate a demonstrated trajectory on a new object of the same category.

    By default the pick is found by descriptors, and the demonstration is carried from there to the goal. With
    `config=SolveConfig()` or `OptimizeConfig()` the paper's energy, eq. 3, is minimised over all waypoints, by
    Gauss-Newton steps or by Adam (docs/results/benchmark.md compares them).

    Clouds denser than the network's training clouds are thinned, see `encode`.

    Args:
        model: the network.
        demonstration: one, several with the same query points, or a `Reference` from `describe` to share between calls.
        points: the new object's cloud, (points, 3), metres, world frame.
        key: random key, such as `jax.random.key(0)`; the result is a function of it.
        goal: last pose, T_world_query as `wxyz_xyz`; by default, if it is kept, the demonstration's last pose, carried
            by the centroids.
        goal_offset: world vector added to the goal's translation, metres.
        fix_last: keep the last pose at the goal. Without, such as for the one pose of a grasp, the demonstration is
            carried rigidly with the pick; or, with other configs, all poses are found alike, and a goal is where the
            last one starts.
        energy: weights of eq. 3's terms, by default the paper's; only with a `config` that minimises it.
        config: settings of `carry`; or of `solve`; or, for Adam as in the paper and for energies with eq. 6, of
            `optimize`.
        progress, mesh: see `solve` and `optimize`.

    Returns:
        The result; `.trajectory` is the best one, T_world_query. A `CategoryWarning` is issued if the object is more
        likely of another category than the demonstration's, where that is known: for shipped weights, and the default
        config.

    Raises:
        InputError: bad points, goal, offset or settings, or an energy that `carry` would not use.
    """
    checks.key("imitate()", key)
    if not isinstance(config, CarryConfig | SolveConfig | OptimizeConfig):
        raise InputError(f"imitate(): config is {config!r}; expected a CarryConfig, SolveConfig or OptimizeConfig")
    if isinstance(config, CarryConfig) and energy is not None:
        raise InputError(
            "imitate(): energy is given, but carrying minimises no eq. 3; expected config=SolveConfig() or OptimizeConfig() with it, or no energy"
        )
    reference = demonstration if isinstance(demonstration, Reference) else describe(model, demonstration)
    field = encode(model, points)
    goal = None if goal is None else _finite("goal", goal, (7,))
    if goal_offset is not None:
        goal = default_goal(field, reference) if goal is None else goal
        goal = goal + jnp.pad(_finite("goal_offset", goal_offset, (3,)), (4, 0))
    settings = {"goal": goal, "fix_last": fix_last, "progress": progress, "mesh": mesh}
    if isinstance(config, CarryConfig):
        result = carry(field, reference, key, config=config, **settings)
        return _judged(result, model.info.name, field, points)
    minimise = optimize if isinstance(config, OptimizeConfig) else solve
    return minimise(
        field, reference, key, energy=EnergyWeights() if energy is None else energy, config=config, **settings
    )


def _judged(result: Result, weights: str, field, points) -> Result:
    """The result with what shipped weights are calibrated for: how likely the pick is right, and the object one of their category."""
    recognised = (
        recognition(result.residual, surface_logit(field, points), CURVES[weights]) if weights in CURVES else None
    )
    if recognised is not None and recognised < DOUBT:
        warnings.warn(
            f"imitate(): the object does not look like one of the demonstration's category to the weights {weights!r} (probability {recognised:.2g}); check the target, its unit and "
            "the weights",
            CategoryWarning,
            stacklevel=3,
        )
    return dataclasses.replace(
        result, recognised=recognised, confidence=confidence(result.residual) if weights in CALIBRATED else None
    )


def imitate_batch(
    model: Model,
    demonstration: Demonstration | Sequence[Demonstration] | Reference,
    clouds: Iterable[Float[Array, "points 3"]],
    *,
    key: PRNGKeyArray,
    **settings,
) -> list[Result]:
    """Imitate on many new objects with one compiled program.

    The demonstration is encoded once. Targets run one after the other: one target's starts already fill the machine,
    and memory does not grow with the number of targets.

    Args:
        model, demonstration: as for `imitate`.
        clouds: one cloud a target, (points, 3), metres, world frame; sizes may differ.
        key: random key; target i uses `jax.random.fold_in(key, i)`.
        settings: as for `imitate`, shared by all targets.

    Returns:
        One result a target, in order.

    Raises:
        InputError: no clouds, or as for `imitate`.
    """
    checks.key("imitate_batch()", key)
    clouds = list(clouds)
    if not clouds:
        raise InputError("imitate_batch(): there are no clouds; expected at least one")
    reference = demonstration if isinstance(demonstration, Reference) else describe(model, demonstration)
    return [
        imitate(model, reference, points, key=jax.random.fold_in(key, index), **settings)
        for index, points in enumerate(clouds)
    ]


def _finite(name, value, shape):
    value = jnp.asarray(value, dtype=float)
    if value.shape != shape:
        raise InputError(f"imitate(): {name} has shape {value.shape}; expected {shape}")
    if not jnp.isfinite(value).all():
        raise InputError(f"imitate(): {name} is {value}; expected finite numbers")
    return value
