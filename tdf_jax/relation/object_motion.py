"""`relate`: motions of an object to its target, by which both contact regions meet and the object touches it."""

import dataclasses
from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from tdf_jax._internal import checks
from tdf_jax._internal.boundary import host
from tdf_jax._internal.errors import InputError
from tdf_jax.energy.reference import Contact, Reference
from tdf_jax.energy.residual import pick_residual
from tdf_jax.energy.seating import touch_distances
from tdf_jax.geometry import se3
from tdf_jax.geometry.demonstration import Demonstration
from tdf_jax.networks.encoding import encode
from tdf_jax.networks.model import Model
from tdf_jax.relation.regions import distinct_contacts, registered_contacts
from tdf_jax.relation.two_objects import Objects, check_scene, kept_points, reference_of, target_field
from tdf_jax.solvers.pick import CarryConfig
from tdf_jax.uncertainty.doubt import warn_of_target
from tdf_jax.uncertainty.modes import cluster_poses

# Folded into the key, so that the pick is the same with and without a target. The numbers are arbitrary, but fixed:
# results depend on them.
OBJECT_STREAM, TARGET_STREAM = 0x0B1EC7, 0x7A26E7
# Largest distance from touch in the demonstration, metres. Beyond it the object does not rest on the target, and is not
# seated.
MAX_TOUCH_DISTANCE = 0.01
MAX_SOLUTIONS = 25  # candidates of a result: distinct picks times distinct motions of the object


@dataclasses.dataclass(frozen=True)
class Relations:
    """Distinct motions of an object to a target, the best first.

    Attributes:
        target_contacts: poses X_t of the contact frame on the target, world frame, (solutions, 7).
        object_contacts: poses X_o of the contact frame on the object in its initial pose, world frame, (solutions, 7).
        energies: sum of the descriptor energies of both, (solutions,); on the target before registration.
        seatings: displacements of the object after both regions are brought together, so that it touches the target,
            world frame, (solutions, 3), metres; NaN where it is not seated.
        target_residual: residual of the best contact pose on the target before registration; NaN if the target has not
            moved.
    """

    target_contacts: Float[np.ndarray, "solutions 7"]
    object_contacts: Float[np.ndarray, "solutions 7"]
    energies: Float[np.ndarray, " solutions"]
    seatings: Float[np.ndarray, "solutions 3"]
    target_residual: float

    @property
    def motions(self) -> Float[Array, "solutions 7"]:
        """Motions M of the object: a point x of it in its initial pose ends at M x."""
        together = se3.compose(jnp.asarray(self.target_contacts), se3.inverse(jnp.asarray(self.object_contacts)))
        return together.at[:, 4:].add(jnp.asarray(np.nan_to_num(self.seatings)))


@host
def relate(
    model: Model,
    demonstration: Demonstration | Sequence[Demonstration] | Reference,
    *,
    points: Float[Array | np.ndarray, "points 3"],
    target_points: Float[Array | np.ndarray, "target_points 3"] | None = None,
    target_model: Model | None = None,
    key: PRNGKeyArray,
    seat: bool = True,
    clean: bool = True,
    config: CarryConfig = CarryConfig(),
) -> Float[Array, "7"]:
    """Find the motion that places a new object on a new target as in a demonstration, without a pick.

    Args:
        model: network of the object.
        demonstration: one with a target, several with the same contact points, or a `Reference` from
            `describe(..., target_model=...)`.
        points: point cloud of the new object in its initial pose, (points, 3), metres, world frame.
        target_points: point cloud of the new target, (points, 3), metres, world frame; None if the demonstrated target
            has not moved.
        target_model: network of the target, the one that described a `Reference`; by default `model` for a new target.
            A demonstrated target that has not moved needs none, but with one the object is seated by the fields of
            both.
        key: random key; the result is a function of it.
        seat: lower or raise the object by up to 1.5 cm until it touches the target, if the demonstrated object touched
            its target from above; see `tdf_jax.energy.seating`.
        clean: remove foreign points from both clouds, see `encode`.
        config: settings of the search on both objects.

    Returns:
        The motion M of the object, `wxyz_xyz`, (7,), metres, world frame. A point x of the object in its initial pose
        ends at M x.

    Raises:
        InputError: bad clouds, clouds of one object, a demonstration without a target, no target points where the
            demonstrated targets differ, or a `Reference` whose target was described by another network.

    Warns:
        CategoryWarning: the target is probably of another category than the demonstrated one, or the weights of the
            object describe a demonstrated target that is probably not of their category, where that is known for the
            weights.
        ForeignPointsWarning: the object's cloud may be a part of the target's; see `encode` too.
    """
    checks.key("relate()", key)
    reference = reference_of("relate()", model, demonstration, target_points, target_model)
    checks.boolean("relate()", "seat", seat)
    if not isinstance(config, CarryConfig):
        raise InputError(f"relate(): config is {config!r}; expected a CarryConfig")
    checks.boolean("relate()", "clean", clean)
    target, placed = target_field(model, reference, target_points, target_model, clean)
    field, kept = encode(model, points, clean=clean, return_kept=True)
    objects = Objects(kept_points(points, kept), placed, field, target)
    check_scene("relate()", points, target_points, reference)  # after `encode`, which refuses what is no cloud
    found = find_relations("relate()", objects, reference, key, config, seat)
    weights = (model if target_model is None else target_model).info.name
    warn_of_target("relate()", found.target_residual, weights, target, placed)
    return found.motions[0]


def find_relations(
    function: str,
    objects: Objects,
    reference: Reference,
    key: PRNGKeyArray,
    config: CarryConfig,
    seat: bool,
) -> Relations:
    """Find the contact region on both objects, and combine what was found.

    Args:
        function: name that the messages begin with.
        objects: the new object and the new target.
        reference: the demonstration.
        key: random key.
        config: settings of the search.
        seat: see `relate`.

    Returns:
        Pairs of a distinct pose on the target and one on the object, by the sum of their energies; of those that are
            seated, the ones that touch.

    Raises:
        InputError: the demonstration has no target, or nothing finite was found.
    """
    contact = reference.contact
    if contact is None:
        raise InputError(
            f"{function}: the demonstration has no target; expected Demonstration(target=tdf.Target(...)), or a goal"
        )
    object_key, target_key = (jax.random.fold_in(key, stream) for stream in (OBJECT_STREAM, TARGET_STREAM))
    on_object, object_energies = distinct_contacts(
        function,
        "object",
        objects.field,
        contact.object_descriptors,
        contact.T_object_contact,
        contact,
        object_key,
        config,
    )
    residual = np.nan
    if objects.target_points is None:
        on_target, target_energies = np.asarray(contact.T_world_contact)[None], np.zeros(1, object_energies.dtype)
    else:
        if objects.target is None or contact.target_descriptors is None or contact.T_target_contact is None:
            raise InputError(f"{function}: the reference does not have the target's descriptors; see `describe`")
        on_target, target_energies = distinct_contacts(
            function,
            "target",
            objects.target,
            contact.target_descriptors,
            contact.T_target_contact,
            contact,
            target_key,
            config,
        )
        residual = pick_residual(float(target_energies[0]), contact.target_descriptors)
        on_target = registered_contacts(on_target, on_object[0], objects, contact)
        # Several may now be one.
        modes = cluster_poses(jnp.asarray(on_target), jnp.asarray(target_energies))
        on_target, target_energies = (
            np.stack([mode.pose for mode in modes]),
            np.array([mode.energy for mode in modes], np.float32),
        )
    energies = target_energies[:, None] + object_energies
    order = np.argsort(energies, axis=None, kind="stable")[:MAX_SOLUTIONS]
    rows, columns = np.unravel_index(order, energies.shape)
    unseated = np.full((len(rows), 3), np.nan, np.float32)
    found = Relations(on_target[rows], on_object[columns], energies[rows, columns], unseated, residual)
    return _seated(objects, found, contact) if seat else found


def _seated(objects: Objects, found: Relations, contact: Contact) -> Relations:
    """The relations with displacements of the placed object until it touches the target; only those that touch it.

    One that does not touch its target anywhere near, or cannot come free of it, is not what was demonstrated. If none
    touches, all are kept.
    """
    if not abs(float(contact.touch)) <= MAX_TOUCH_DISTANCE:  # also where it is not known
        return found
    target_points = contact.target_points if objects.target_points is None else objects.target_points
    rotations = se3.rotation(jnp.asarray(found.target_contacts))
    directions = np.asarray(rotations @ contact.down, float)
    distances = touch_distances(objects.field, objects.target, objects.points, target_points, found.motions, directions)
    kept = np.isfinite(distances) | np.isnan(distances).all()
    return dataclasses.replace(
        found,
        target_contacts=found.target_contacts[kept],
        object_contacts=found.object_contacts[kept],
        energies=found.energies[kept],
        seatings=(distances[:, None] * directions).astype(np.float32)[kept],
    )
