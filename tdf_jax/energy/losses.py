"""Energies of one trajectory: its distance from the demonstration (eq. 2, 3 and 6 of the TDF paper).

Each function takes one trajectory; the caller batches. The energy is a mean over poses of terms of one pose each, plus
eq. 6, which couples neighbours. `optimize` relies on that to hold one chunk of descriptors at a time.
"""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from tdf_jax._internal import checks
from tdf_jax._internal.boundary import public
from tdf_jax._internal.deprecation import renamed_fields, renamed_keywords
from tdf_jax._internal.errors import InputError
from tdf_jax.energy.descriptors import check_poses
from tdf_jax.energy.reference import Reference
from tdf_jax.geometry import se3
from tdf_jax.geometry.trajectory import Trajectory
from tdf_jax.networks.field import DescriptorField

POSE_NORMS = ("frobenius", "metres_radians", "mean_absolute")
COMPENSATOR_ORDERS = ("frobenius", "infinity")


@renamed_fields(lever="rotation_scale")
@functools.partial(
    jax.tree_util.register_dataclass,
    data_fields=["correlation", "compensator", "rotation_scale"],
    meta_fields=["pose_norm", "compensator_order"],
)
@dataclasses.dataclass(frozen=True)
class EnergyWeights:
    """Weights of the energy's terms. They are traced, so a changed number does not compile again.

    Attributes:
        correlation: k of eq. 3; the paper's best is 0.02.
        compensator: weight of eq. 6, which the paper tried and rejected.
        rotation_scale: metres that a rotation difference of one unit counts as in eq. 3, which the paper does not
            state. At 1 m, the plain norm, the rotation outweighs the descriptors of a real mug by far, and the solution
            does not follow a mug in another orientation (docs/guide/energy.md).
        pose_norm: norm of eq. 3, which the paper does not specify: "frobenius", of the difference of the 4x4 matrices;
            "metres_radians", sqrt(distance^2 + angle^2); or "mean_absolute", over the twelve numbers of (R, t), as eq.
            2 is over channels.
        compensator_order: norm over waypoints in eq. 6, see `compensator_loss`.

    Raises:
        InputError: a negative weight, or an unknown norm or order.
    """

    correlation: Float[Array, ""] | float = 0.02
    compensator: Float[Array, ""] | float = 0.0
    rotation_scale: Float[Array, ""] | float = 0.05
    pose_norm: str = "frobenius"
    compensator_order: str = "frobenius"

    def __post_init__(self):
        for name, known in (("pose_norm", POSE_NORMS), ("compensator_order", COMPENSATOR_ORDERS)):
            checks.choice("EnergyWeights()", name, getattr(self, name), known)
        for name in ("correlation", "compensator", "rotation_scale"):
            value = getattr(self, name)
            if isinstance(value, int | float | np.number):  # not arrays: a gradient is an EnergyWeights too
                checks.number("EnergyWeights()", name, value, least=0)


@public
def trajectory_energy(
    trajectory: Trajectory, field: DescriptorField, reference: Reference, weights: EnergyWeights
) -> Float[Array, ""]:
    """Energy that `optimize` and `solve` minimise: eq. 3, and eq. 6 if it has a weight.

    Args:
        trajectory: poses of the query frame, T_world_query.
        field: descriptor field of the new object.
        reference: the demonstration.
        weights: weights of the terms.

    Returns:
        The energy, a scalar.

    Raises:
        InputError: the trajectory is not of shape (poses, 7), or has another number of poses than the reference.
    """
    _check("trajectory_energy()", trajectory, reference)
    R, t = trajectory.rotations, trajectory.translations
    return descriptor_loss(trajectory, field, reference) + pose_energy(R, t, field.origin, reference, weights)


@public
def descriptor_loss(trajectory: Trajectory, field: DescriptorField, reference: Reference) -> Float[Array, ""]:
    """l_t of eq. 2: mean absolute difference of descriptors over poses, queries and channels.

    Args:
        trajectory: poses of the query frame, T_world_query.
        field: descriptor field of the new object.
        reference: the demonstration.

    Returns:
        The loss, a scalar.

    Raises:
        InputError: as for `trajectory_energy`.
    """
    _check("descriptor_loss()", trajectory, reference)

    def one(pose):
        T_world_query, descriptors = pose
        R, t = se3.rotation(T_world_query), se3.translation(T_world_query)
        return waypoint_loss(R, t, field, reference.query, descriptors)

    return jnp.mean(jax.lax.map(one, (trajectory.wxyz_xyz, reference.descriptors)))


def waypoint_loss(
    R: Float[Array, "3 3"],
    t: Float[Array, "3"],
    field: DescriptorField,
    query: Float[Array, "queries 3"],
    descriptors: Float[Array, "queries channels"],
) -> Float[Array, ""]:
    """Term of one waypoint in eq. 2: mean absolute difference of descriptors over queries and channels.

    Args:
        R: rotation of the query frame in the world, (3, 3).
        t: translation of the query frame in the world, (3,), metres.
        field: descriptor field of the new object.
        query: query points, (queries, 3), metres, query frame.
        descriptors: descriptors of the demonstration at the same waypoint, (queries, channels).

    Returns:
        The loss, a scalar.
    """
    return jnp.mean(jnp.abs(field.descriptors(se3.rotate(R, query) + t) - descriptors))


def pose_energy(
    R: Float[Array, "poses 3 3"],
    t: Float[Array, "poses 3"],
    origin: Float[Array, "3"],
    reference: Reference,
    weights: EnergyWeights,
) -> Float[Array, ""]:
    """Weighted terms of the energy that depend on the poses alone, without descriptors.

    It takes matrices because the optimiser has them: by way of quaternions it compiles longer.

    Args:
        R: rotations of the query frame in the world, (poses, 3, 3).
        t: translations of the query frame in the world, (poses, 3), metres.
        origin: centroid of the new object's cloud, (3,), metres, world frame.
        reference: the demonstration.
        weights: weights of the terms.

    Returns:
        The weighted sum of eq. 3's correlation term and eq. 6, a scalar.
    """
    correlation = _correlation(R, t, origin, reference, weights.rotation_scale, weights.pose_norm)
    return weights.correlation * correlation + weights.compensator * _compensator(R, t, weights.compensator_order)


@public
@renamed_keywords(lever="rotation_scale")
def correlation_loss(
    trajectory: Trajectory,
    origin: Float[Array, "3"],
    reference: Reference,
    rotation_scale: Float[Array, ""] | float = 1.0,
    pose_norm: str = "frobenius",
) -> Float[Array, ""]:
    """l_c of eq. 3: mean over waypoints of ||T_ref - T||, on poses relative to each cloud's centroid with world axes.

    The term follows the object's translation and not its rotation, which is a limit of the paper.

    Args:
        trajectory: poses of the query frame, T_world_query.
        origin: centroid of the new object's cloud, (3,), metres, world frame.
        reference: the demonstration.
        rotation_scale: metres that a rotation difference of one unit counts as, see `EnergyWeights`.
        pose_norm: norm of the difference, see `EnergyWeights`; by default the plain Frobenius norm of the 4x4 matrices.

    Returns:
        The loss, a scalar, metres.

    Raises:
        InputError: as for `trajectory_energy`, or an unknown norm.
    """
    _check("correlation_loss()", trajectory, reference)
    checks.choice("correlation_loss()", "pose_norm", pose_norm, POSE_NORMS)
    return _correlation(trajectory.rotations, trajectory.translations, origin, reference, rotation_scale, pose_norm)


@public
def compensator_loss(trajectory: Trajectory, order: str = "frobenius") -> Float[Array, ""]:
    """l_p of eq. 6: sum over neighbouring waypoints of ||T_i^-1 T_{i+1} - I||_F.

    Args:
        trajectory: poses of the query frame, T_world_query.
        order: "frobenius" sums over pairs as eq. 6 does; "infinity" takes the largest of them.

    Returns:
        The loss, a scalar.

    Raises:
        InputError: an unknown order, or a trajectory that is not of shape (poses, 7).
    """
    checks.choice("compensator_loss()", "order", order, COMPENSATOR_ORDERS)
    check_poses("compensator_loss()", trajectory)
    return _compensator(trajectory.rotations, trajectory.translations, order)


def pose_difference(
    R: Float[Array, "*batch 3 3"],
    t: Float[Array, "*batch 3"],
    origin: Float[Array, "3"],
    target: Float[Array, "*batch 7"],
    rotation_scale: Float[Array, ""] | float,
    pose_norm: str,
) -> Float[Array, "*batch numbers"]:
    """Difference that eq. 3 takes the norm of: of poses from the demonstration's, relative to each cloud's centroid.

    Args:
        R: rotations of the query frame in the world, (*batch, 3, 3).
        t: translations of the query frame in the world, (*batch, 3), metres.
        origin: centroid of the new object's cloud, (3,), metres, world frame.
        target: poses of the demonstration relative to its centroid, (*batch, 7), `wxyz_xyz`.
        rotation_scale: metres that a rotation difference of one unit counts as.
        pose_norm: see `EnergyWeights`.

    Returns:
        12 numbers a pose; 4 with "metres_radians".
    """
    translation = t - origin - se3.translation(target)
    if pose_norm == "metres_radians":
        rotation = se3.rotation_distance(R, se3.rotation(target))[..., None]
    else:
        rotation = (R - se3.rotation(target)).reshape(*R.shape[:-2], 9)
    return jnp.concatenate([translation, rotation_scale * rotation], axis=-1)


def _check(function: str, trajectory: Trajectory, reference: Reference) -> None:
    check_poses(function, trajectory)
    if len(trajectory.wxyz_xyz) != len(reference.descriptors):
        raise InputError(
            f"{function}: the trajectory has {len(trajectory.wxyz_xyz)} poses and the reference "
            f"{len(reference.descriptors)}; expected as many. Use resample() before describe()"
        )


def _correlation(R, t, origin, reference, rotation_scale, pose_norm):
    difference = pose_difference(R, t, origin, reference.trajectory.wxyz_xyz, rotation_scale, pose_norm)
    return jnp.mean(_norm(difference[..., None] if pose_norm == "mean_absolute" else difference))


def _compensator(R, t, order):
    # ||T_i^-1 T_{i+1} - I||_F of neighbouring poses does not change if both are multiplied by one rotation.
    rotation = (R[1:] - R[:-1]).reshape(-1, 9)
    lengths = _norm(jnp.concatenate([t[1:] - t[:-1], rotation], axis=-1))
    return jnp.max(lengths) if order == "infinity" else jnp.sum(lengths)


def _norm(x):
    """Euclidean norm over the last axis, with gradient zero at zero.

    The gradient matters because a fixed last pose often equals the reference's exactly.
    """
    squared = jnp.sum(x * x, axis=-1)
    zero = squared == 0
    return jnp.where(zero, 0.0, jnp.sqrt(jnp.where(zero, 1.0, squared)))
