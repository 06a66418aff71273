"""`differentiable_pick`: derivatives of a found pick with respect to the field, the query points and the demonstration.

A pick is a minimum of the energy, which moves with all that the energy depends on. The implicit function theorem gives
its derivative, -H^-1 G, from the Hessian H of the energy and the derivative G of its gradient.
The energy is a mean of absolute values of descriptors from a network with ReLUs: its second derivatives by automatic
differentiation are noise. Both are therefore those of a sum of weighted squares of the differences r of descriptors,
with the weights W of the solver's steps, 1 / max(|r|, s), where s is the mean |r| of the query point: H = J' W J and
G = J' W dr, with the Jacobian J of r with respect to the pose. A common factor of both cancels.
"""

import dataclasses
import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from tdf_jax._internal import checks
from tdf_jax._internal.boundary import public
from tdf_jax._internal.errors import InputError
from tdf_jax._internal.precision import full_precision
from tdf_jax.energy.reference import Reference
from tdf_jax.geometry import se3
from tdf_jax.networks.field import DescriptorField
from tdf_jax.solvers.initial import check_channels

# Directions whose curvature is below this share of the stiffest one's are free, as in `pose_covariance`.
FREE = 0.03
SCALE = 0.03  # metres per radian, of query points in a box of 6 cm, where they all coincide
# Radians; times the rotation_scale 2 mm with query points in a box of 6 cm. Farther from the minimum a pick is not what
# a solver would find.
LARGEST_OFFSET = 0.07


@functools.partial(
    jax.tree_util.register_dataclass,
    data_fields=["pose", "directions", "curvatures", "num_free", "offset", "rotation_scale"],
    meta_fields=[],
)
@dataclasses.dataclass(frozen=True)
class DifferentiablePick:
    """A pick with derivatives, and what is known of them.

    Attributes:
        pose: the pick, T_world_query, `wxyz_xyz`, (7,), metres; the attribute that has derivatives.
        directions: principal axes of the weighted squares as twists, the softest first, (6, 6): a rotation about the
            centroid of the query points, radians, and a translation of it, metres, along the world's axes. The first
            `num_free` are free.
        curvatures: curvatures along these axes, rising, as shares of the largest, (6,).
        num_free: number of directions, of six, that the energy does not determine, such as the rotation about the axis
            of a bowl: their curvature is below 3 % of the largest. The derivatives have no part along them.
        offset: length of the next step towards the minimum of the energy, metres; a rotation counts as the distance by
            which it moves the query points. Free directions do not count.
        rotation_scale: root mean square distance of the query points from their centroid, metres per radian.
    """

    pose: Float[Array, "7"]
    directions: Float[Array, "6 6"]
    curvatures: Float[Array, "6"]
    num_free: Int[Array, ""]
    offset: Float[Array, ""]
    rotation_scale: Float[Array, ""]

    @property
    @public
    def status(self) -> str:
        """What the derivatives hold for, in words; the pick must not be traced.

        Raises:
            InputError: the numbers are traced, or there is a batch of them.
        """
        if checks.traced(self.num_free, self.offset) or np.ndim(self.offset):
            raise InputError(
                "DifferentiablePick.status: the numbers are traced or a batch; expected those of one pick. Look at "
                "num_free and offset"
            )
        free, offset = int(self.num_free), float(self.offset)
        if not offset <= LARGEST_OFFSET * float(self.rotation_scale):
            return (
                f"the pick is {1e3 * offset:.1f} mm from the minimum of the energy, of which the derivatives are: find "
                "it by tdf.carry"
            )
        if free:
            directions = "1 direction is" if free == 1 else f"{free} directions are"
            return f"{directions} not determined by the energy; the derivatives have no part along free directions"
        return "all six directions are determined by the energy"


@public
def differentiable_pick(
    field: DescriptorField, reference: Reference, pick: Float[Array | np.ndarray, "7"]
) -> DifferentiablePick:
    """Give a found pick its derivatives, by the implicit function theorem.

    The value is the pick as it is. `jax.grad`, `jax.jvp`, `jax.jacobian`, `jax.jit` and `jax.vmap` see it as a function
    of the field (and so of the object's points, through `encode`), of the query points and of the demonstration's
    descriptors: the minimum near the pick, which a solver would find again. The derivatives are those of weighted
    squares (see the module); docs/results/uncertainty.md#derivatives-of-a-pick compares them with picks that are found
    again.

    Args:
        field: descriptor field of the object.
        reference: the demonstration. The derivative with respect to query points alone holds the descriptors fixed; it
            includes them if the reference comes from `describe` inside of the differentiated function.
        pick: pose T_world_query at a minimum of the energy, such as `carry(...).pick`, `wxyz_xyz`, (7,), metres. It is
            taken as a constant: its own derivative is zero.

    Returns:
        The pick, and a status of its derivatives.

    Raises:
        InputError: the pick is not one finite pose, or field and reference have different channels.
    """
    check_channels("differentiable_pick()", field, reference)
    given = jnp.asarray(checks.pose("differentiable_pick()", "pick", pick))
    dtype = jnp.result_type(given, reference.query, reference.descriptors, field.latent)
    return _differentiable(field, reference.query, reference.descriptors[0], jax.lax.stop_gradient(given.astype(dtype)))


@jax.jit
@full_precision
def _differentiable(field, query, demonstrated, pick):
    model, status = _model(*jax.lax.stop_gradient((field, query, demonstrated)), pick)
    return dataclasses.replace(status, pose=_implicit(field, query, demonstrated, pick, model))


@jax.custom_jvp
def _implicit(field, query, demonstrated, pick, model):
    """The pick, whose derivative is that of the minimum of the weighted squares."""
    return pick


@_implicit.defjvp
def _implicit_jvp(primals, tangents):
    pick, model = primals[3:]
    changes = jax.jvp(functools.partial(_residual, pick), primals[:3], tangents[:3])[1]
    step = -model.solved(changes)
    # The rotation w moves the quaternion q by (0, w) q / 2, and the pose's origin about the centroid.
    w, v = step[:3], step[3:] * model.scale
    real, imaginary, origin = pick[0], pick[1:4], pick[4:]
    turned = -jnp.sum(w * imaginary)[None], real * w + jnp.cross(w, imaginary)
    return pick, jnp.concatenate([*(part / 2 for part in turned), v + jnp.cross(w, origin - model.centroid)])


class _Model(NamedTuple):
    """The weighted squares at a pick.

    Attributes:
        axes: principal axes of the Hessian in columns, (6, 6), of a rotation, radians, and a translation, in units of
            the scale.
        flexibilities: inverses of the curvatures along them, (6,); zero along free directions.
        weighted: the weighted Jacobian, (queries, 6, channels).
        centroid: centroid of the query points, (3,), metres, world frame.
        scale: root mean square distance of the query points from it, metres per radian.
    """

    axes: Float[Array, "6 6"]
    flexibilities: Float[Array, "6"]
    weighted: Float[Array, "queries 6 channels"]
    centroid: Float[Array, "3"]
    scale: Float[Array, ""]

    def solved(self, differences: Float[Array, "queries channels"]) -> Float[Array, "6"]:
        """The inverse of the Hessian times the gradient that belongs to differences of descriptors."""
        gradient = jnp.einsum("qac,qc->a", self.weighted, differences)
        return self.axes @ (self.flexibilities * (self.axes.T @ gradient))


def _residual(pick, field, query, demonstrated):
    return field.descriptors(se3.transform(pick, query)) - demonstrated


def _model(field, query, demonstrated, pick):
    """The model, and the pick with the status of its derivatives."""
    centre = jnp.mean(query, axis=0)
    arm = se3.rotate(se3.rotation(pick), query - centre)
    scale = jnp.sqrt(jnp.mean(jnp.sum(arm**2, axis=-1)))
    # Coincident query points determine no rotation: its curvature is zero, whatever a rotation counts as.
    scale = jnp.where(scale > 0, scale, SCALE)
    found, tangents = _descriptors_and_derivatives(field, se3.transform(pick, query))
    residual = found - demonstrated
    across = jnp.cross(jnp.eye(3, dtype=found.dtype)[None], arm[:, None])
    jacobian = jnp.concatenate([jnp.einsum("qai,qic->qac", across, tangents), scale * tangents], axis=1)
    size = jnp.abs(residual)
    weighted = jacobian / jnp.maximum(jnp.maximum(size, jnp.mean(size, axis=-1, keepdims=True)), 1e-9)[:, None]
    curvatures, axes = jnp.linalg.eigh(jnp.einsum("qac,qbc->ab", weighted, jacobian))
    determined = curvatures > FREE * curvatures[-1]
    flexibilities = jnp.where(determined, 1 / jnp.where(determined, curvatures, 1.0), 0.0)
    model = _Model(axes, flexibilities, weighted, se3.transform(pick, centre[None])[0], scale)
    directions = jnp.concatenate([axes[:3], axes[3:] * scale]).T
    shares = curvatures / jnp.where(curvatures[-1] > 0, curvatures[-1], 1.0)
    offset = scale * jnp.linalg.norm(model.solved(residual))
    return model, DifferentiablePick(pick, directions, shares, jnp.sum(~determined), offset, scale)


def _descriptors_and_derivatives(field, x):
    """Descriptors at points, (points, channels), and their derivatives along the three axes, (points, 3, channels)."""

    def along(axis):
        return jax.jvp(field.descriptors, (x,), (jnp.broadcast_to(axis, x.shape),))

    return jax.vmap(along, out_axes=(None, 1))(jnp.eye(3, dtype=x.dtype))
