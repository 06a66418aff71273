"""The contact region on an object or a target: distinct poses by descriptors, refined by the points of both clouds."""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from tdf_jax._internal.errors import InputError
from tdf_jax.energy.losses import EnergyWeights
from tdf_jax.energy.reference import Contact, Reference
from tdf_jax.energy.seating import overlap
from tdf_jax.geometry import se3
from tdf_jax.geometry.registration import refine_region
from tdf_jax.geometry.sampling import subset
from tdf_jax.geometry.trajectory import Trajectory
from tdf_jax.networks.field import DescriptorField
from tdf_jax.relation.two_objects import Objects
from tdf_jax.solvers.multistart import solve
from tdf_jax.solvers.pick import CarryConfig
from tdf_jax.uncertainty.modes import cluster_poses

# Half edge of the region that is registered, a factor on the spread of the contact points along an axis: of points in a
# box, 0.6 of half its edge. A larger one reaches from the middle of a short peg to its post.
REGION = 1.05
REGISTERED = 4000  # most points of a cloud that are registered; more would cost up to minutes


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


def registered_contacts(
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
