"""An object and its target: clouds, fields and the reference of their demonstration, checked."""

import dataclasses
from typing import Any

import numpy as np
from jaxtyping import Array, Bool, Float

from tdf_jax._internal.errors import InputError
from tdf_jax.energy.reference import Contact, Reference, describe
from tdf_jax.geometry.demonstration import check_apart
from tdf_jax.networks.encoding import encode
from tdf_jax.networks.field import DescriptorField
from tdf_jax.networks.model import Model
from tdf_jax.uncertainty.doubt import warn_of_one_network


@dataclasses.dataclass(frozen=True)
class Objects:
    """The new object and the new target.

    Attributes:
        points: cloud of the object in its initial pose, (points, 3), metres, world frame.
        target_points: cloud of the target, (points, 3), metres, world frame; None if the demonstrated one has not
            moved.
        field: field of the object in its initial pose.
        target: field of the target; None to look for the contact region on the object alone and to seat it by the
            object's field alone, which is possible if the demonstrated target has not moved.
    """

    points: Float[Array | np.ndarray, "points 3"]
    target_points: Float[Array | np.ndarray, "target_points 3"] | None
    field: DescriptorField
    target: DescriptorField | None


def reference_of(function: str, model: Model, demonstration, target_points, target_model: Model | None) -> Reference:
    """The reference of a demonstration, with the target's side if there is a new target.

    Args:
        function: name that error messages begin with.
        model: network of the object.
        demonstration: a demonstration, several of them, or a `Reference`, which is returned as it is.
        target_points: point cloud of the new target, (points, 3), metres, world frame; None if the demonstrated one has
            not moved.
        target_model: network of the target; by default `model`.

    Returns:
        The reference.

    Raises:
        InputError: a new target, or a network for it, without a demonstrated one; no new target, and several
            demonstrations whose targets differ or stand at different places; or a new target, and a reference whose
            target was described by another network.

    Warns:
        CategoryWarning: the network of the object describes the target too, and probably does not know its category.
    """
    if isinstance(demonstration, Reference):
        reference = demonstration
    else:
        side = target_model if target_points is None or target_model is not None else model
        reference = describe(model, demonstration, target_model=side)
    if reference.contact is None and (target_points is not None or target_model is not None):
        raise InputError(
            f"{function}: there is a target, and the demonstration has none; expected one with target=tdf.Target(...)"
        )
    if reference.contact is not None:
        _check_target_side(function, reference.contact, model if target_model is None else target_model, target_points)
        warn_of_one_network(function, model.info.name, np.asarray(reference.contact.target_logits))
    return reference


def _check_target_side(function: str, contact: Contact, target_model: Model, target_points) -> None:
    if target_points is None:
        if contact.num_targets > 1:
            raise InputError(
                f"{function}: the demonstrations have {contact.num_targets} targets, which differ or stand at "
                "different places, and there are no target_points: it is not known which of them stands there; "
                "expected target_points, or demonstrations on one target"
            )
        return
    if contact.target_descriptors is None:
        raise InputError(
            f"{function}: there are target_points, and the reference does not have the target's descriptors; expected "
            "describe(model, demonstration, target_model=...)"
        )
    described, used = contact.target_info, target_model.info
    if described is not None and (described.name, described.source) != (used.name, used.source):
        raise InputError(
            f"{function}: the weights of the target are {used.name!r} ({used.source}), and its demonstration is "
            f"described by {described.name!r} ({described.source}), whose descriptors are not comparable; expected "
            "target_model as for describe()"
        )


def target_field(
    model: Model, reference: Reference, target_points, target_model: Model | None, clean: bool
) -> tuple[DescriptorField | None, Any]:
    """Field of the target, and its points.

    Args:
        model: network of the object.
        reference: the demonstration.
        target_points: point cloud of the new target, (points, 3), metres, world frame; None if the demonstrated one has
            not moved.
        target_model: network of the target; by default `model` for a new target.
        clean: remove foreign points, see `encode`.

    Returns:
        The field; None if the demonstrated target has not moved and there is no network for it. The points of the new
            target that were kept, (kept, 3), metres, world frame; None if the demonstrated one has not moved.
    """
    if target_points is not None:
        side = model if target_model is None else target_model
        field, kept = encode(side, target_points, clean=clean, return_kept=True)
        return field, kept_points(target_points, kept)
    if target_model is None or reference.contact is None:
        return None, None
    return encode(target_model, reference.contact.target_points, clean=clean), None


def kept_points(points, kept: Bool[np.ndarray, " points"]) -> Any:
    """The points of a cloud that were kept; the cloud as it was given if all were.

    Args:
        points: point cloud, (points, 3), metres.
        kept: mask from `encode`, (points,).
    """
    return points if kept.all() else np.asarray(points)[kept]


def check_scene(function: str, points, target_points, reference: Reference) -> None:
    """Check that object and target are two objects.

    Args:
        function: name that error messages begin with.
        points: point cloud of the new object, (points, 3), metres, world frame.
        target_points: point cloud of the new target, (points, 3); None if the demonstrated one has not moved.
        reference: the demonstration.

    Raises:
        InputError: the clouds show the same points or surface.

    Warns:
        ForeignPointsWarning: most of the object's points lie on the target's surface.
    """
    if reference.contact is not None:
        check_apart(function, points, reference.contact.target_points if target_points is None else target_points)
