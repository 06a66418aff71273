"""How sharply the energy determines a pose: curvature, covariance and free directions."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from tdf_jax._internal.deprecation import renamed_fields
from tdf_jax._internal.errors import InputError
from tdf_jax.energy.losses import waypoint_loss
from tdf_jax.energy.reference import Reference
from tdf_jax.geometry import se3
from tdf_jax.networks.field import DescriptorField

# The rise of the energy that counts as one sigma. Of 18 handles found on generated mugs the squared normalised errors
# were 6.6 on average and 4.7 in the median; 6 and 5.3 are those of six normal numbers. Nearly all of it is of moves:
# 6.3 of 3, and 0.16 of 3 of turns.
SCALE = 1e-4


# Below this share of the stiffest direction's curvature a direction is free. The turn about a cup's axis had at most
# 0.001 where the cloud had the symmetry exactly, and 0.008 to 0.016 at handle and rim, 0.02 to 0.03 at the base, where
# it was sampled at random; on mugs the softest direction had 0.05 at the handle, 0.08 at the rim, 0.15 at the base, or
# more.
FREE = 0.03


# Passes of the fit, and the share by which a pass may still change one sigma. The field of a mug takes three or four; a
# random network, on which the stiffest direction is 100 times as stiff as the softest in sigma, takes the most.
PASSES, SETTLED = 8, 0.01
FIRST_TURN, LARGEST_TURN = np.radians(5), np.radians(15)  # of the steps, which are lengths: turns times the rotation_scale
LARGEST_SIGMA = 1.0  # radians, times the rotation_scale: what a direction without any curvature gets
SLIDE = 1e-3  # a unit twist with less turn times rotation_scale has its axis a thousand rotation scales away
_FIRST, _SECOND = np.tril_indices(6, -1)
_AXES = np.eye(6)


# Plus and minus of each: six axes, then the sums and the differences of their 15 pairs, all of length 1.
_STEPS = np.concatenate(
    [_AXES, (_AXES[_FIRST] + _AXES[_SECOND]) / np.sqrt(2), (_AXES[_FIRST] - _AXES[_SECOND]) / np.sqrt(2)]
)


@dataclasses.dataclass(frozen=True, eq=False)
class Screw:
    """A twist as a motion about an axis.

    Attributes:
        direction: of the axis, unit vector, world frame; its sign means nothing.
        point: on the axis, the one nearest the query points' mean, metres, world frame.
        pitch: metres along the axis for one radian about it: 0 of a pure turn, infinite of a pure move, whose `point`
            is the mean itself.
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
    """How sharply the energy determines one pose. Twists are (turn about `centre`, move), radians and metres, world axes.

    Attributes:
        curvature: H of E(twist) = E(0) + twist' H twist / 2; energy over radians and metres.
        covariance: 2 `scale` H^-1: one sigma along any axis of the ellipsoid raises the energy by `scale`. It is
            nowhere more than 1 radian times the rotation_scale, which is also what directions get along which the energy does
            not rise at all.
        values: curvatures along `directions`, rising, energy / m^2: per metre of move, or of turn times the rotation_scale.
        directions: twists in rows, of length 1 m if turns are multiplied by the rotation_scale, and at right angles to each
            other in that measure.
        centre: the query points' mean at the pose, metres, world frame.
        rotation_scale: root mean square distance of the query points from their mean, metres: what a turn of one radian moves
            them by, in round numbers.
        scale: rise of the energy that counts as one sigma.
    """

    curvature: Float[Array, "6 6"]
    covariance: Float[Array, "6 6"]
    values: Float[Array, "6"]
    directions: Float[Array, "6 6"]
    centre: Float[Array, "3"]
    rotation_scale: Float[Array, ""]
    scale: Float[Array, ""]

    @property
    def free(self) -> Float[np.ndarray, "free 6"]:
        """Twists that the energy does not determine, flattest first: curvature under 3 % of the stiffest direction's, none to speak of, or a negative one.

        Where several are free, any mixture of them is as free.
        """
        values = np.asarray(self.values)
        if values.ndim != 1:
            raise InputError(
                f"PoseCovariance.free: there is a batch of shape {values.shape[:-1]}; expected one pose. Take one by jax.tree.map(lambda part: part[i], ...)"
            )
        bound = max(FREE * values[-1], float(_least_value(self.scale, self.rotation_scale)))
        return np.asarray(self.directions)[values <= bound]

    @property
    def screws(self) -> list[Screw]:
        """The free twists as motions about axes: an object of revolution's is a turn about its axis, pitch 0."""
        return [
            _screw(twist.astype(np.float64), np.asarray(self.centre, np.float64), float(self.rotation_scale))
            for twist in self.free
        ]


def pose_covariance(
    field: DescriptorField,
    reference: Reference,
    pose: Float[Array, "7"],
    waypoint: int = 0,
    *,
    scale: Float[Array, ""] | float = SCALE,
) -> PoseCovariance:
    """Curvature of a waypoint's descriptor energy at a pose that was found, and the covariance that follows.

    The energy is a mean of absolute values: with kinks, and near a perfect match a cone. Its second derivatives say
    little, so the curvature is a secant: it is fitted to rises of the energy, each the mean of a step and its opposite,
    which the slope left at the pose cancels out of. The steps are along six axes and their pairs' diagonals, the axes
    those of the ellipsoid that the pass before found, as long as raises the energy by `scale`, or 15 degrees times the
    rotation_scale if that is less.

    It says which directions are certain and which are not on one object; how much the shapes of two objects differ it
    cannot know. On 18 handles of generated mugs the root of the summed variances was 5.5 degrees and 3.4 mm in the
    median, the errors 1.2 degrees and 4.6 mm: turns were better, and moves along the handle, up to 12 mm, worse than it
    says.

    Args:
        field: the new object's.
        reference: the demonstration's.
        pose: T_world_query, `wxyz_xyz`, metres; a minimum of the energy, or nearly.
        waypoint: of the reference, which the pose is to match.
        scale: rise of the energy that counts as one sigma; traced.

    Returns:
        The covariance. Like the pose it is of the world frame, and it turns with object and pose. Works under
        `jax.vmap` and `jax.jit`.

    Raises:
        InputError: a pose that is not seven finite numbers with a rotation, a waypoint that is none, a scale that is
            not above zero, or query points all at one place.
    """
    pose = jnp.asarray(pose, reference.query.dtype)
    _check("pose_covariance()", reference, pose, waypoint, scale)
    return _covariance(field, reference.query, reference.descriptors[waypoint], pose, jnp.asarray(scale, pose.dtype))


def _check(function, reference, pose, waypoint, scale):
    if pose.shape != (7,):
        raise InputError(f"{function}: pose has shape {pose.shape}; expected (7,), wxyz_xyz. For several use jax.vmap")
    count = len(reference.descriptors)
    if not isinstance(waypoint, int | np.integer) or isinstance(waypoint, bool) or not -count <= waypoint < count:
        raise InputError(
            f"{function}: waypoint is {waypoint!r}; expected a whole number below the reference's {count} waypoints"
        )
    if not isinstance(pose, jax.core.Tracer) and not (np.isfinite(pose).all() and np.linalg.norm(pose[:4]) > 1e-6):
        raise InputError(
            f"{function}: pose is {np.asarray(pose).tolist()}; expected finite numbers, w x y z of a rotation first"
        )
    if not isinstance(scale, jax.core.Tracer) and not (np.ndim(scale) == 0 and 0 < scale < np.inf):
        raise InputError(f"{function}: scale is {scale}; expected an energy above 0, such as {SCALE}")
    if not isinstance(reference.query, jax.core.Tracer) and not np.ptp(reference.query, axis=0).any():
        raise InputError(
            f"{function}: all query points are at one place, where turns change nothing; expected several, such as tdf.box_query(key, count=500)"
        )


@jax.jit
def _covariance(field, query, descriptors, pose, scale):
    R, middle = se3.rotation(pose), jnp.mean(query, axis=0)
    query = query - middle
    rotation_scale = jnp.sqrt(jnp.mean(jnp.sum(query**2, axis=-1)))
    centre = se3.rotate(R, middle[None])[0] + se3.translation(pose)

    def energy(step):
        # In the query's axes the steps turn with object and pose, and so does all that follows from them.
        turned, moved = _screwed(R, step[:3] / rotation_scale, step[3:])
        return waypoint_loss(turned, centre + moved, field, query, descriptors)

    start = energy(jnp.zeros(6, query.dtype))
    steps = jnp.asarray(_STEPS, query.dtype)

    def stretched(values):
        """Lengths of steps that raise the energy by the scale, if the curvatures are right."""
        return jnp.sqrt(2 * scale / jnp.maximum(values, 2 * scale / (LARGEST_TURN * rotation_scale) ** 2))

    def again(found):
        count, lengths, _, values = found
        return (count == 0) | (count < PASSES) & jnp.any(jnp.abs(stretched(values) / lengths - 1) > SETTLED)

    def once(found):
        count, lengths, axes, values = found  # the axes in columns, of length 1
        lengths = jnp.where(count == 0, lengths, stretched(values))
        along = _product(steps, (axes * lengths).T)
        energies = jax.lax.map(energy, jnp.concatenate([along, -along])).reshape(2, -1)
        rises = jnp.mean(energies, axis=0) - start
        sums, differences = jnp.split(rises[6:], 2)
        # A least squares fit to all rises would mix those of the diagonals into the curvatures: a cone rises along a
        # free axis plus another by 1 / sqrt(2) instead of 1 / 2, and free axes came out at 0.004 to 0.01 of the
        # stiffest instead of under 0.001.
        mixed = jnp.zeros((6, 6), rises.dtype).at[_FIRST, _SECOND].set(sums - differences)
        matrix = (jnp.diag(2 * rises[:6]) + mixed + mixed.T) / (lengths[:, None] * lengths)
        values, rotated = jnp.linalg.eigh(matrix)
        return count + 1, lengths, _product(axes, rotated), values

    first = jnp.full(6, FIRST_TURN * rotation_scale, query.dtype), jnp.eye(6, dtype=query.dtype), jnp.zeros(6, query.dtype)
    _, _, axes, values = jax.lax.while_loop(again, once, (jnp.int32(0), *first))
    axes = jnp.concatenate([_product(R, axes[:3]), _product(R, axes[3:])])  # the world's axes
    # Twists of unit length in columns, and what measures a twist along them.
    directions = jnp.concatenate([axes[:3] / rotation_scale, axes[3:]])
    measures = jnp.concatenate([axes[:3] * rotation_scale, axes[3:]])
    sigma_squared = 2 * scale / jnp.maximum(values, _least_value(scale, rotation_scale))
    return PoseCovariance(
        curvature=_product(measures * values, measures.T),
        covariance=_product(directions * sigma_squared, directions.T),
        values=values,
        directions=directions.T,
        centre=centre,
        rotation_scale=rotation_scale,
        scale=scale,
    )


def _least_value(scale, rotation_scale):
    """The curvature at which one sigma is as large as it may be."""
    return 2 * scale / (LARGEST_SIGMA * rotation_scale) ** 2


def _screwed(R, turn, move):
    """A rotation after a twist, and where the twist carries the point that it turns about, relative to that point."""
    angle = jnp.linalg.norm(turn)
    safe = jnp.maximum(angle, 1e-12)
    axis = turn / safe
    sinc, versine = jnp.sinc(angle / jnp.pi), (1 - jnp.cos(angle)) / safe
    carried = sinc * move + (1 - sinc) * jnp.sum(axis * move) * axis + versine * jnp.cross(axis, move)
    return _product(R, se3.exp(turn)), se3.rotate(R, carried[None])[0]


def _product(a, b):
    # The default precision rounds float32 to 10 bits on some accelerators.
    return jnp.matmul(a, b, precision=jax.lax.Precision.HIGHEST)


def _screw(twist, centre, rotation_scale):
    turn, move = twist[:3], twist[3:]
    squared = turn @ turn
    if rotation_scale**2 * squared < SLIDE**2:
        return Screw(move / np.linalg.norm(move), centre, np.inf)
    return Screw(turn / np.sqrt(squared), centre + np.cross(turn, move) / squared, float(turn @ move / squared))
