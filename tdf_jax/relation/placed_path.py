"""The demonstrated path from the pick of an object to its place at a target, as dense as the arrival there needs."""

import dataclasses
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from tdf_jax._internal import devices
from tdf_jax.energy.reference import Reference
from tdf_jax.geometry import se3
from tdf_jax.geometry.trajectory import Trajectory, resample
from tdf_jax.geometry.transport import arrival_depth, carry_to_target
from tdf_jax.relation.object_motion import MAX_SOLUTIONS, find_relations
from tdf_jax.relation.two_objects import Objects
from tdf_jax.solvers.pick import CarryConfig, carry
from tdf_jax.solvers.result import Result, with_ends
from tdf_jax.uncertainty.modes import cluster_poses

SPACING = 0.01  # metres between poses to a target: with fewer poses the path would skip the demonstrated approach
MAX_POSES = 200  # of a path that is made denser; one of more than 2 m has wider spacing, so that results stay small


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
