"""Relations: where an object goes on a second object, the target, from the region where the two met in a demonstration.

The region is found twice, by descriptors: on the target as it stands, pose X_t of the contact frame, and on the object
in its initial pose, X_o. The object's motion M = X_t inverse(X_o) brings the two together. With the demonstrated
motion D of the object, and the motions A_t of the region on the target and A_o of the region on the object,
M = A_t D inverse(A_o).
"""

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, PRNGKeyArray

from tdf_jax._internal import checks, devices
from tdf_jax._internal.boundary import host
from tdf_jax._internal.errors import InputError
from tdf_jax.energy.losses import EnergyWeights
from tdf_jax.energy.reference import Contact, Reference, describe
from tdf_jax.energy.residual import pick_residual
from tdf_jax.energy.seating import overlap, touch_distances
from tdf_jax.geometry import se3
from tdf_jax.geometry.demonstration import Demonstration, check_apart
from tdf_jax.geometry.registration import refine_region
from tdf_jax.geometry.sampling import subset
from tdf_jax.geometry.trajectory import Trajectory, resample
from tdf_jax.geometry.transport import arrival_depth, carry_to_target
from tdf_jax.networks.encoding import encode
from tdf_jax.networks.field import DescriptorField
from tdf_jax.networks.model import Model
from tdf_jax.solvers.multistart import solve
from tdf_jax.solvers.pick import CarryConfig, carry
from tdf_jax.solvers.result import Result, with_ends
from tdf_jax.uncertainty.doubt import warn_of_one_network, warn_of_target
from tdf_jax.uncertainty.modes import cluster_poses

# Folded into the key, so that the pick is the same with and without a target. The numbers are arbitrary, but fixed:
# results depend on them.
OBJECT_STREAM, TARGET_STREAM = 0x0B1EC7, 0x7A26E7
SPACING = 0.01  # metres between poses to a target: with fewer poses the path would skip the demonstrated approach
MAX_POSES = 200  # of a path that is made denser; one of more than 2 m has wider spacing, so that results stay small
# Largest distance from touch in the demonstration, metres. Beyond it the object does not rest on the target, and is not
# seated.
MAX_TOUCH_DISTANCE = 0.01
# Half edge of the region that is registered, a factor on the spread of the contact points along an axis: of points in a
# box, 0.6 of half its edge. A larger one reaches from the middle of a short peg to its post.
REGION = 1.05
REGISTERED = 4000  # most points of a cloud that are registered; more would cost up to minutes
MAX_SOLUTIONS = 25  # candidates of a result: distinct picks times distinct motions of the object


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
        The motion M of the object, `wxyz_xyz`, (7,), metres, world frame: a point x of the object in its initial
            pose ends at M x.

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
        on_target = _registered(on_target, on_object[0], objects, contact)
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


def _registered(
    contacts: Float[np.ndarray, "contacts 7"], on_object: Float[np.ndarray, "7"], objects: Objects, contact: Contact
) -> Float[np.ndarray, "contacts 7"]:
    """Contact poses on the target, refined by the points of both clouds in the region.

    Descriptors know where the region is and how it is turned, but little of its own shape: on a rack they give the
    height and the tilt of a common peg rather than of this one. Where several poses fit, as along a peg, the nearest is
    taken with which the object, at its best contact pose, does not overlap the target.
    """
    query = np.asarray(contact.query, float)
    T_contact_region = np.eye(4)  # the contact frame may be the world, far from its points
    T_contact_region[:3, 3] = query.mean(axis=0)
    radius = REGION * float(np.sqrt(np.mean((query - query.mean(axis=0)) ** 2)))
    T_region_world = np.linalg.inv(_matrix(contact.T_world_contact) @ T_contact_region)
    shown, points = (
        subset(np.asarray(cloud, float), REGISTERED) for cloud in (contact.target_points, objects.target_points)
    )
    demonstrated = shown @ T_region_world[:3, :3].T + T_region_world[:3, 3]
    back = np.linalg.inv(T_contact_region)
    T_contact_world = np.linalg.inv(_matrix(on_object))
    poses = []
    for pose in contacts:
        given = _matrix(pose) @ T_contact_region
        refined = refine_region(demonstrated, points, given, radius)
        if (refined[0] == given).all():
            poses.append(np.asarray(pose))
            continue
        free, least = refined[0], np.inf
        for T in refined:
            down = (T @ back)[:3, :3] @ np.asarray(contact.down, float)
            inside = overlap(objects.field, points, T @ back @ T_contact_world, down)
            if inside < least:
                free, least = T, inside
            if least == 0:
                break
        T = free @ back
        poses.append(np.asarray(se3.pose(T[:3, :3], T[:3, 3])))
    return np.stack(poses).astype(contacts.dtype)


def _matrix(pose) -> Float[np.ndarray, "4 4"]:
    return np.asarray(Trajectory(jnp.asarray(pose)[None]).matrices[0], float)


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


def distinct_contacts(
    function: str,
    what: str,
    field: DescriptorField,
    descriptors: Float[Array, "queries channels"],
    T_origin_contact: Float[Array, "7"],
    contact: Contact,
    key: PRNGKeyArray,
    config: CarryConfig,
) -> tuple[Float[np.ndarray, "contacts 7"], Float[np.ndarray, " contacts"]]:
    """Distinct poses of the contact frame in a field, and their energies, the best first.

    Args:
        function: name that the messages begin with.
        what: "object" or "target", for them.
        field: field of the object or of the target.
        descriptors: descriptors of the demonstrated region in the demonstrated object's or target's field.
        T_origin_contact: its pose there, relative to the centroid of the cloud, `wxyz_xyz`, (7,).
        contact: the demonstrated region.
        key: random key.
        config: settings of the search.

    Returns:
        The poses, world frame, `wxyz_xyz`, (contacts, 7), and their energies, (contacts,).

    Raises:
        InputError: nothing finite was found.
    """
    alone = Reference(descriptors[None], Trajectory(T_origin_contact[None]), contact.query)
    found = solve(field, alone, key, fix_last=False, energy=EnergyWeights(0.0), config=config.solver)
    modes = cluster_poses(jnp.asarray(found.picks), jnp.asarray(found.energies))
    if not modes:
        raise InputError(f"{function}: on the {what}, {found.status}; check its cloud and the contact points")
    return np.stack([mode.pose for mode in modes]), np.array([mode.energy for mode in modes], np.float32)


def carry_object(
    objects: Objects,
    reference: Reference,
    key: PRNGKeyArray,
    *,
    seat: bool = True,
    config: CarryConfig = CarryConfig(),
    progress: Callable[[int, Float[np.ndarray, " candidates"]], None] | None = None,
    device_mesh: jax.sharding.Mesh | None = None,
) -> Result:
    """Find the pick and the motion of the object to the target, and warp the demonstrated path between them.

    The pose at the release is M times the pick in every candidate, so that a change of the pick changes it.

    Args:
        objects: the new object and the new target.
        reference: a demonstration with a target.
        key: random key; the pick is that of `carry` with the same key.
        seat: see `relate`.
        config: settings of the search for the pick and for the contact region.
        progress: see `solve`; of the pick.
        device_mesh: see `solve`; for the pick.

    Returns:
        The result; its candidates are pairs of a distinct pick and a distinct motion, by the sum of their energies.

    Raises:
        InputError: as for `solve`, or the demonstration has no target.
    """
    relations = find_relations("imitate()", objects, reference, key, config, seat)
    assert reference.contact is not None  # `find_relations` has refused it
    plain = dataclasses.replace(reference, approach=reference.approach[:0], retreat=reference.retreat[:0])
    picked = carry(objects.field, plain, key, fix_last=False, config=config, progress=progress, device_mesh=device_mesh)
    picks, motions = np.asarray(picked.picks), np.asarray(relations.motions)
    # One candidate of every distinct pick; all of them if none is finite, so that the result says so.
    modes = cluster_poses(jnp.asarray(picks), jnp.asarray(picked.energies))
    distinct = np.array([mode.members[0] for mode in modes]) if modes else np.arange(len(picks))
    pick_energies = np.where(np.asarray(picked.finite), np.asarray(picked.energies), np.inf)[distinct]
    joint = pick_energies[:, None] + relations.energies
    order = np.argsort(joint, axis=None, kind="stable")[:MAX_SOLUTIONS]
    rows, columns = np.unravel_index(order, joint.shape)
    energies, rows = joint[rows, columns], distinct[rows]
    contact, points = reference.contact, np.asarray(objects.points, float)
    target_points = contact.target_points if objects.target_points is None else objects.target_points
    outwards = np.asarray(se3.rotation(jnp.asarray(relations.target_contacts)) @ contact.outward, float)
    deeper = [
        deeper_arrival(points, target_points, motion, outward, float(contact.depth))
        for motion, outward in zip(motions, outwards)
    ]
    # Always as many candidates, so that one compiled program carries those of every object.
    pairs = np.arange(MAX_SOLUTIONS) % len(rows)
    trajectories = _carried(
        dense(reference.trajectory),
        _released_contact(reference),
        jnp.asarray(picks[rows][pairs]),
        jnp.asarray(motions[columns][pairs]),
        jnp.asarray(relations.target_contacts[columns][pairs]),
        contact.arrival,
        jnp.asarray(np.asarray(deeper, motions.dtype)[columns][pairs]),
    )
    trajectories = jnp.asarray(np.asarray(trajectories)[: len(rows)])
    result = dataclasses.replace(
        picked,
        trajectories=trajectories,
        energies=jnp.asarray(energies.astype(picked.energies.dtype)),
        candidate_history=jnp.asarray(picked.candidate_history)[rows],
        target_trajectories=jnp.asarray(relations.target_contacts[columns][:, None]),
        target_residual=np.asarray(relations.target_residual, np.float32),
        seatings=relations.seatings[columns],
    )
    return with_ends(result, reference)


def deeper_arrival(
    points: Float[np.ndarray, "points 3"],
    target_points: Float[Array | np.ndarray, "target_points 3"],
    motion: Float[Array | np.ndarray, "7"],
    outward: Float[np.ndarray, "3"],
    depth: float,
) -> float:
    """How much farther than demonstrated an object comes from, into a target that is deeper, metres, at least 0.

    Args:
        points: cloud of the object in its initial pose, (points, 3), metres, world frame.
        target_points: cloud of the target, (target_points, 3), metres, world frame.
        motion: motion of the object to its target, `wxyz_xyz`, (7,).
        outward: unit vector from the object's place at the target to where it comes from, world frame, (3,).
        depth: that of the demonstrated arrival, see `Arrival`, metres.
    """
    return max(0.0, arrival_depth(_moved(points, motion), np.asarray(target_points, float), outward) - depth)


def dense(trajectory: Trajectory) -> Trajectory:
    """The demonstrated path to a target with poses at most `SPACING` apart, and at least as many as it has.

    Args:
        trajectory: path from the grasp to the release.
    """
    length = float(np.linalg.norm(np.diff(np.asarray(trajectory.translations), axis=0), axis=1).sum())
    count = min(MAX_POSES, 1 + int(np.ceil(length / SPACING)))
    return trajectory if count <= trajectory.num_poses else resample(trajectory, count)


def _released_contact(reference: Reference) -> Float[Array, "7"]:
    """Pose of the contact frame at the release in the frame of the reference's trajectory."""
    poses, contact = jnp.asarray(reference.trajectory.wxyz_xyz), reference.contact
    assert contact is not None  # `find_relations` has refused it
    return se3.compose(se3.compose(poses[-1], se3.inverse(poses[0])), contact.T_object_contact)


def _moved(points, motion):
    R = np.asarray(se3.rotation(jnp.asarray(motion)), float)
    return points @ R.T + np.asarray(motion, float)[4:]


@devices.quickly_compiled
def _carried(path: Trajectory, released_contact, picks, motions, target_contacts, arrival, deeper):
    def one(pick, motion, target_contact, deeper):
        target_motion = se3.compose(target_contact, se3.inverse(released_contact))
        goal = se3.compose(motion, pick)
        return carry_to_target(path, pick, goal, target_motion, arrival=arrival, deeper=deeper).wxyz_xyz

    return jax.vmap(one)(picks, motions, target_contacts, deeper)
