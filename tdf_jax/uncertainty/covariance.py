"""How sharply the energy determines a pose: curvature, covariance and free directions.

Small motions of a pose are twists of six numbers (rotation, translation) along the world's axes: a rotation vector
(radians) about the centroid of the query points, and a translation of that centroid (metres). A twist acts as a screw
motion: (w, w x (c - a)), with the centroid c, is a rotation about the axis w through the point a, at any angle.
"""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from tdf_jax._internal import checks
from tdf_jax._internal.boundary import public
from tdf_jax._internal.deprecation import renamed_fields
from tdf_jax._internal.errors import InputError
from tdf_jax.energy.losses import waypoint_loss
from tdf_jax.energy.reference import Reference
from tdf_jax.geometry import se3
from tdf_jax.networks.field import DescriptorField

# The rise of the energy that counts as one sigma. For 18 handles on generated mugs, the squared normalised errors had a
# mean of 6.6 and a median of 4.7; six normal numbers have 6 and 5.3. Translations contribute 6.3 of an expected 3,
# rotations 0.16 of an expected 3.
SCALE = 1e-4

# A direction is free if its curvature is below this share of the stiffest direction's. The rotation about a cup's axis
# had at most 0.001 if the cloud had the exact symmetry. With random samples it had 0.008 to 0.016 at handle and rim,
# and 0.02 to 0.03 at the base. The softest direction of mugs had 0.05 at the handle, 0.08 at the rim, 0.15 at the base,
# or more.
FREE = 0.03

# Limit on the passes of the fit, and the relative change of every sigma below which it has converged. The field of a
# mug takes three or four passes. A random network, whose sigmas differ by a factor of 100, takes the most.
MAX_PASSES, CONVERGED = 8, 0.01
# Radians. Times the rotation_scale, they are the lengths of the first steps and the largest length of a step.
FIRST_ANGLE, MAX_ANGLE = float(np.radians(5)), float(np.radians(15))
MAX_SIGMA = 1.0  # radians; times the rotation_scale, the sigma of a direction without curvature
# A unit twist is a pure translation if its rotation times the rotation_scale is smaller: its axis is then a thousand
# rotation scales away.
PURE_TRANSLATION = 1e-3

# JAX 0.10 mistakes 64-bit indices after `jax_enable_x64` has changed.
_FIRST, _SECOND = (part.astype(np.int32) for part in np.tril_indices(6, -1))
_AXES = np.eye(6)
# Directions of the steps, of length 1, each of which is taken both ways: the six axes, then the sums and the
# differences of their 15 pairs.
_STEPS = np.concatenate(
    [_AXES, (_AXES[_FIRST] + _AXES[_SECOND]) / np.sqrt(2), (_AXES[_FIRST] - _AXES[_SECOND]) / np.sqrt(2)]
)


@dataclasses.dataclass(frozen=True, eq=False)
class Screw:
    """A twist as a screw motion about an axis.

    Attributes:
        direction: direction of the axis, a unit vector whose sign has no meaning, (3,), world frame.
        point: point of the axis nearest to the centroid of the query points, (3,), metres, world frame; the centroid
            itself if the twist is a pure translation.
        pitch: translation along the axis for each radian about it, metres per radian; 0 for a pure rotation, infinite
            for a pure translation.
    """

    direction: Float[np.ndarray, "3"]
    point: Float[np.ndarray, "3"]
    pitch: float


@renamed_fields(lever="rotation_scale")
@functools.partial(
    jax.tree_util.register_dataclass,
    data_fields=["curvature", "covariance", "values", "directions", "centre", "rotation_scale", "scale"],
    meta_fields=[],
)
@dataclasses.dataclass(frozen=True, eq=False)
class PoseCovariance:
    """How sharply the energy determines one pose.

    Twists are (rotation about `centre`, translation), radians and metres, along the world's axes.

    Attributes:
        curvature: H of E(twist) = E(0) + twist' H twist / 2, (6, 6), energy over radians and metres.
        covariance: 2 `scale` H^-1, (6, 6), radians and metres: one sigma along any axis of the ellipsoid raises the
            energy by `scale`. No sigma is larger than 1 radian times `rotation_scale`, which is also the sigma of
            directions along which the energy does not rise.
        values: curvatures along `directions`, rising, (6,), energy per square metre; rotations count as metres by
            `rotation_scale`.
        directions: twists in rows, (6, 6). They are orthogonal and have length 1 m if rotations are multiplied by
            `rotation_scale`.
        centre: centroid of the query points at the pose, (3,), metres, world frame.
        rotation_scale: root mean square distance of the query points from their centroid, metres per radian; about the
            distance by which a rotation of one radian moves them.
        scale: rise of the energy that counts as one sigma, an energy.
    """

    curvature: Float[Array, "6 6"]
    covariance: Float[Array, "6 6"]
    values: Float[Array, "6"]
    directions: Float[Array, "6 6"]
    centre: Float[Array, "3"]
    rotation_scale: Float[Array, ""]
    scale: Float[Array, ""]

    @property
    @public
    def free(self) -> Float[np.ndarray, "free 6"]:
        """Twists that the energy does not determine, by rising curvature, (free, 6).

        The curvature of a free direction is below 3 % of the stiffest direction's, too small for a finite sigma, or
        negative. If several directions are free, so are all linear combinations of them.

        Raises:
            InputError: there is a batch of poses.
        """
        values = np.asarray(self.values)
        if values.ndim != 1:
            raise InputError(
                f"PoseCovariance.free: got a batch of shape {values.shape[:-1]}; expected one pose. Take one by "
                "jax.tree.map(lambda part: part[i], ...)"
            )
        bound = max(FREE * values[-1], float(_min_curvature(self.scale, self.rotation_scale)))
        return np.asarray(self.directions)[values <= bound]

    @property
    @public
    def screws(self) -> list[Screw]:
        """The free twists as screw motions; an object of revolution has a rotation about its axis, with pitch 0.

        Raises:
            InputError: there is a batch of poses.
        """
        return [
            _screw(twist.astype(np.float64), np.asarray(self.centre, np.float64), float(self.rotation_scale))
            for twist in self.free
        ]


@public
def pose_covariance(
    field: DescriptorField,
    reference: Reference,
    pose: Float[Array, "7"],
    waypoint: int = 0,
    *,
    scale: Float[Array, ""] | float = SCALE,
) -> PoseCovariance:
    """Estimate the curvature of a waypoint's descriptor energy at a pose, and the covariance that follows from it.

    The energy is a mean of absolute values: it has kinks, and near a perfect match it is a cone. Second derivatives say
    little about it, so the curvature is a secant, fitted to rises of the energy. Each rise is the mean over a step and
    its opposite, which cancels the slope at the pose. The steps follow six axes and the diagonals of their pairs. The
    axes are those of the ellipsoid of the previous pass. A step raises the energy by `scale`, as far as the curvature
    predicts. It rotates by at most 0.26 rad (15 degrees) and translates by at most 0.26 rad times the rotation_scale,
    in metres.

    The covariance says which directions are certain on one object. It does not include the difference of shape between
    two objects (docs/results/code_notes.md#uncertaintycovariance).

    Args:
        field: descriptor field of the new object.
        reference: the demonstration.
        pose: pose T_world_query at or near a minimum of the energy, `wxyz_xyz`, (7,), metres.
        waypoint: index of the waypoint of the reference that the pose has to match; negative ones count from the end.
        scale: rise of the energy that counts as one sigma, an energy; it may be traced.

    Returns:
        The covariance, in the world frame. If object and pose move together, it rotates with them. The function works
        under `jax.vmap` and `jax.jit`.

    Raises:
        InputError: the pose is not seven finite numbers with a rotation, the waypoint does not exist, the scale is not
            above zero, or all query points coincide.
    """
    pose = jnp.asarray(pose, reference.query.dtype)
    _check("pose_covariance()", reference, pose, waypoint, scale)
    return _covariance(field, reference.query, reference.descriptors[waypoint], pose, jnp.asarray(scale, pose.dtype))


def _check(function, reference, pose, waypoint, scale):
    if pose.shape != (7,):
        raise InputError(f"{function}: pose has shape {pose.shape}; expected (7,), wxyz_xyz. For several use jax.vmap")
    checks.pose(function, "pose", pose)
    count = len(reference.descriptors)
    checks.count(function, "waypoint", waypoint, least=-count, most=count - 1)
    checks.positive(function, "scale", scale, unit="an energy")
    if not checks.traced(reference.query) and not np.ptp(reference.query, axis=0).any():
        raise InputError(
            f"{function}: all query points coincide, so that no rotation can be determined; expected distinct points, "
            "such as tdf.box_query(key, count=500)"
        )


@jax.jit
def _covariance(field, query, descriptors, pose, scale):
    R, centroid = se3.rotation(pose), jnp.mean(query, axis=0)
    query = query - centroid
    rotation_scale = jnp.sqrt(jnp.mean(jnp.sum(query**2, axis=-1)))
    centre = se3.rotate(R, centroid[None])[0] + se3.translation(pose)

    def energy(step):
        # Steps are along the axes of the query frame, so they rotate with object and pose, as do the results.
        R_stepped, shift = _screw_motion(R, step[:3] / rotation_scale, step[3:])
        return waypoint_loss(R_stepped, centre + shift, field, query, descriptors)

    start = energy(jnp.zeros(6, query.dtype))
    steps = jnp.asarray(_STEPS, query.dtype)

    def step_lengths(values):
        """Lengths of steps that raise the energy by the scale, if the curvatures are right."""
        return jnp.sqrt(2 * scale / jnp.maximum(values, 2 * scale / (MAX_ANGLE * rotation_scale) ** 2))

    def unconverged(state):
        count, lengths, _, values = state
        return (count == 0) | (count < MAX_PASSES) & jnp.any(jnp.abs(step_lengths(values) / lengths - 1) > CONVERGED)

    def one_pass(state):
        count, lengths, axes, values = state  # the axes are unit vectors in columns
        lengths = jnp.where(count == 0, lengths, step_lengths(values))
        along = _product(steps, (axes * lengths).T)
        energies = jax.lax.map(energy, jnp.concatenate([along, -along])).reshape(2, -1)
        rises = jnp.mean(energies, axis=0) - start
        sums, differences = jnp.split(rises[6:], 2)
        # A least squares fit to all rises would mix those of the diagonals into the curvatures. Along the diagonal of a
        # free axis and another one, a cone rises by 1 / sqrt(2) instead of 1 / 2, so free axes got curvatures of 0.004
        # to 0.01 of the stiffest instead of less than 0.001.
        mixed = jnp.zeros((6, 6), rises.dtype).at[_FIRST, _SECOND].set(sums - differences)
        matrix = (jnp.diag(2 * rises[:6]) + mixed + mixed.T) / (lengths[:, None] * lengths)
        values, vectors = jnp.linalg.eigh(matrix)
        return count + 1, lengths, _product(axes, vectors), values

    first = (
        jnp.full(6, FIRST_ANGLE * rotation_scale, query.dtype),
        jnp.eye(6, dtype=query.dtype),
        jnp.zeros(6, query.dtype),
    )
    _, _, axes, values = jax.lax.while_loop(unconverged, one_pass, (jnp.int32(0), *first))
    axes = jnp.concatenate([_product(R, axes[:3]), _product(R, axes[3:])])  # along the world's axes
    # Both are in columns: twists of unit length, and the covectors that give the components of a twist along them.
    directions = jnp.concatenate([axes[:3] / rotation_scale, axes[3:]])
    measures = jnp.concatenate([axes[:3] * rotation_scale, axes[3:]])
    sigma_squared = 2 * scale / jnp.maximum(values, _min_curvature(scale, rotation_scale))
    return PoseCovariance(
        curvature=_product(measures * values, measures.T),
        covariance=_product(directions * sigma_squared, directions.T),
        values=values,
        directions=directions.T,
        centre=centre,
        rotation_scale=rotation_scale,
        scale=scale,
    )


def _min_curvature(scale, rotation_scale):
    """The curvature at which sigma has its largest value."""
    return 2 * scale / (MAX_SIGMA * rotation_scale) ** 2


def _screw_motion(R, rotation, translation):
    """Apply a twist along the axes of the query frame to R; return the new R and the centroid's shift, world frame."""
    angle = jnp.linalg.norm(rotation)
    safe = jnp.maximum(angle, 1e-12)
    axis = rotation / safe
    sinc, versine = jnp.sinc(angle / jnp.pi), (1 - jnp.cos(angle)) / safe
    along = jnp.sum(axis * translation)
    shift = sinc * translation + (1 - sinc) * along * axis + versine * jnp.cross(axis, translation)
    return _product(R, se3.exp(rotation)), se3.rotate(R, shift[None])[0]


def _product(a, b):
    # On some accelerators the default precision rounds float32 to 10 bits.
    return jnp.matmul(a, b, precision=jax.lax.Precision.HIGHEST)


def _screw(twist, centre, rotation_scale):
    rotation, translation = twist[:3], twist[3:]
    squared = rotation @ rotation
    if rotation_scale**2 * squared < PURE_TRANSLATION**2:
        return Screw(translation / np.linalg.norm(translation), centre, np.inf)
    point = centre + np.cross(rotation, translation) / squared
    return Screw(rotation / np.sqrt(squared), point, float(rotation @ translation / squared))
