"""Which of several clouds is the demonstration's object, and which its target."""

import dataclasses
import warnings
from collections.abc import Sequence
from typing import Any, Literal, NamedTuple, overload

import jax
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from tdf_jax._internal import checks
from tdf_jax._internal.boundary import host
from tdf_jax._internal.errors import InputError, SizeWarning
from tdf_jax.energy.reference import Reference, describe
from tdf_jax.energy.residual import pick_residual
from tdf_jax.geometry.demonstration import Demonstration
from tdf_jax.networks.encoding import encode
from tdf_jax.networks.field import DescriptorField
from tdf_jax.networks.model import Model
from tdf_jax.relation.object_motion import OBJECT_STREAM, TARGET_STREAM
from tdf_jax.relation.regions import distinct_contacts
from tdf_jax.solvers.pick import CarryConfig, carry

# A cloud of one side of an object is smaller than the object, and its box in another orientation is larger.
SMALLER, LARGER = 2.0, 1.3


class Choice(NamedTuple):
    """Which clouds were chosen, and why.

    Attributes:
        object: index of the object's cloud.
        target: index of the target's cloud; None if the demonstration has no target.
        residuals: residual of each cloud as the object, (clouds,), see `tdf_jax.confidence`; with a target, the mean of
            those of the pick and of the contact region. NaN without a demonstration.
        target_residuals: residual of the contact region of each cloud as the target, (clouds,); NaN without a target.
    """

    object: int
    target: int | None
    residuals: Float[np.ndarray, " clouds"]
    target_residuals: Float[np.ndarray, " clouds"]


@overload
def pick_object(
    model: Model,
    clouds: Sequence[Float[Array | np.ndarray, "_ 3"]],
    demonstration: Demonstration | Sequence[Demonstration] | Reference | None = None,
    *,
    target_model: Model | None = None,
    key: PRNGKeyArray | None = None,
    config: CarryConfig = CarryConfig(),
    return_choice: Literal[False] = False,
) -> Any: ...
@overload
def pick_object(
    model: Model,
    clouds: Sequence[Float[Array | np.ndarray, "_ 3"]],
    demonstration: Demonstration | Sequence[Demonstration] | Reference | None = None,
    *,
    target_model: Model | None = None,
    key: PRNGKeyArray | None = None,
    config: CarryConfig = CarryConfig(),
    return_choice: Literal[True],
) -> tuple[Any, Choice]: ...
@host
def pick_object(
    model: Model,
    clouds: Sequence[Float[Array | np.ndarray, "_ 3"]],
    demonstration: Demonstration | Sequence[Demonstration] | Reference | None = None,
    *,
    target_model: Model | None = None,
    key: PRNGKeyArray | None = None,
    config: CarryConfig = CarryConfig(),
    return_choice: bool = False,
) -> Any:
    """Choose the object among the clouds of a scene, and the target if the demonstration has one.

    With a demonstration, the object is the cloud in which its pick has the smallest residual: descriptors at the place
    to pick distinguish objects better than the surface alone does. Of a demonstration with a target, object and target
    are two different clouds with the smallest sum of residuals.

    Without a demonstration the fields say nothing that is reliable for all weights. The object is then the cloud of
    most points among those of a size that the weights know, or among all if none is or if the sizes are unknown.

    Args:
        model: network of the object.
        clouds: point clouds, (points, 3) each, metres, world frame, such as from `separate_objects`.
        demonstration: one, several, or a `Reference` from `describe`; None if there is none.
        target_model: network of the target; by default `model`.
        key: random key of the searches; by default `jax.random.key(0)`.
        config: settings of the searches.
        return_choice: also return the indices and the residuals.

    Returns:
        The object's cloud as it was given, or the object's and the target's; with `return_choice`, and the `Choice`.

    Raises:
        InputError: there are no clouds, or only one for object and target, one of them is no cloud, or there is a
            target's network without a target.
    """
    function = "pick_object()"
    if not isinstance(model, Model):
        raise InputError(f"{function}: model is {model!r}; expected a Model, such as tdf.load_model('mug')")
    checks.boolean(function, "return_choice", return_choice)
    if not isinstance(config, CarryConfig):
        raise InputError(f"{function}: config is {config!r}; expected a CarryConfig")
    key = jax.random.key(0) if key is None else checks.key(function, key)
    given = _listed(function, clouds)
    points = [np.asarray(checks.points(function, cloud, f"clouds[{index}]")) for index, cloud in enumerate(given)]
    reference = None if demonstration is None else _described(function, model, demonstration, target_model)
    related = reference is not None and reference.contact is not None
    if target_model is not None and not related:
        raise InputError(f"{function}: there is a target_model, and the demonstration has no target; drop it")
    if related and len(points) < 2:
        raise InputError(
            f"{function}: there is one cloud, and the demonstration has an object and a target; expected at least two"
        )
    unknown = np.full(len(points), np.nan)
    choice = Choice(_by_size(model, points), None, unknown, unknown)
    if reference is not None:
        choice = _by_residual(
            function, model, model if target_model is None else target_model, points, reference, key, config
        )
    picked = given[choice.object] if choice.target is None else (given[choice.object], given[choice.target])
    return (picked, choice) if return_choice else picked


def _listed(function: str, clouds) -> list:
    if np.ndim(clouds) == 2 if isinstance(clouds, np.ndarray | jax.Array) else not isinstance(clouds, Sequence):
        raise InputError(
            f"{function}: clouds is a {type(clouds).__name__}; expected a list of clouds, such as from "
            "tdf.separate_objects; of one cloud, [points]"
        )
    if not len(clouds):
        raise InputError(f"{function}: there are no clouds; expected at least one")
    return list(clouds)


def _described(function: str, model: Model, demonstration, target_model: Model | None) -> Reference:
    """The reference, with the target's side if there is a target."""
    if not isinstance(demonstration, Reference):
        several = [demonstration] if isinstance(demonstration, Demonstration) else list(demonstration)
        related = any(getattr(one, "target", None) is not None for one in several)
        side = model if target_model is None else target_model
        return describe(model, several, target_model=side if related else None)
    if demonstration.contact is not None and demonstration.contact.target_descriptors is None:
        raise InputError(
            f"{function}: the reference does not have the target's descriptors; expected "
            "describe(model, demonstration, target_model=...)"
        )
    return demonstration


def _by_size(model: Model, clouds: list[np.ndarray]) -> int:
    least, most = model.info.smallest_diagonal, model.info.largest_diagonal
    sizes = np.array([np.linalg.norm(np.ptp(cloud, axis=0)) for cloud in clouds])
    fits = np.ones(len(clouds), bool)
    if least is not None and most is not None:
        fits = (sizes >= least / SMALLER) & (sizes <= most * LARGER)
    counts = np.array([len(cloud) for cloud in clouds])
    return int(np.argmax(np.where(fits if fits.any() else True, counts, -1)))


def _by_residual(
    function: str,
    model: Model,
    target_model: Model,
    clouds: list[np.ndarray],
    reference: Reference,
    key: PRNGKeyArray,
    config: CarryConfig,
) -> Choice:
    contact = reference.contact
    plain = dataclasses.replace(reference, approach=reference.approach[:0], retreat=reference.retreat[:0], contact=None)
    object_key, target_key = (jax.random.fold_in(key, stream) for stream in (OBJECT_STREAM, TARGET_STREAM))

    def region(what: str, field: DescriptorField, descriptors, T_origin_contact, stream) -> float:
        """Residual of the contact region in a field."""
        assert contact is not None
        energies = distinct_contacts(function, what, field, descriptors, T_origin_contact, contact, stream, config)[1]
        return pick_residual(float(energies[0]), descriptors)

    as_object, as_target = (np.full(len(clouds), np.nan) for _ in range(2))
    for index, cloud in enumerate(clouds):
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", SizeWarning)  # what is not the object may have any size
            # Most of them are of something else, and no part of that would fit a field: do not search for one.
            field = encode(model, cloud, clean=False)
            other = field if target_model is model or contact is None else encode(target_model, cloud, clean=False)
        as_object[index] = float(carry(field, plain, key, fix_last=False, config=config).residual)
        if contact is not None:
            on_object = region("object", field, contact.object_descriptors, contact.T_object_contact, object_key)
            as_object[index] = (as_object[index] + on_object) / 2
            as_target[index] = region("target", other, contact.target_descriptors, contact.T_target_contact, target_key)
    costs = np.where(np.isfinite(as_object), as_object, np.inf)
    if contact is None:
        return Choice(int(np.argmin(costs)), None, as_object, as_target)
    pairs = costs[:, None] + np.where(np.isfinite(as_target), as_target, np.inf)
    np.fill_diagonal(pairs, np.inf)
    row, column = np.unravel_index(int(np.argmin(pairs)), pairs.shape)
    return Choice(int(row), int(column), as_object, as_target)
