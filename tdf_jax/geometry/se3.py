"""Rotations and rigid poses: exponentials, logarithms, distances, geodesics.

Rotations are matrices `R` (..., 3, 3), rotation vectors (axis times angle, radians) or unit quaternions `wxyz`.
Poses are `wxyz_xyz` (..., 7), quaternion then translation in metres: the layout of `jaxlie.SE3`. Quaternions are
normalised on use, so any non-zero multiple of one is the same rotation, and they come out with w >= 0.

Every function is differentiable with finite gradients everywhere, the identity and half turns included, and compiled:
op by op, the first trajectory of a process would compile every operation on its own.
"""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from tdf_jax._internal.errors import InputError

# Below these squares a power series replaces the quotient 0/0. They are generous on purpose, so that second
# derivatives are accurate too; the terms left out are below 1e-16.
_SMALL_ANGLE_SQUARED = 0.03
_SMALL_SINE_SQUARED = 1e-3
SUPER_FIBONACCI = 1.533751168755204288118041  # the real root of psi^4 = psi + 4, of Alexa's table the best


@jax.jit
def exp(rotation_vector: Float[Array, "... 3"]) -> Float[Array, "... 3 3"]:
    """Rotation matrix of a rotation vector.

    Args:
        rotation_vector: Axis times angle, radians, of any length.

    Returns:
        Rotation matrices.
    """
    angle_squared = jnp.sum(rotation_vector * rotation_vector, axis=-1, keepdims=True)
    small = angle_squared < _SMALL_ANGLE_SQUARED
    # The inner `where` keeps the unused branch finite: its gradient is multiplied by 0, and 0 * inf is NaN.
    angle = jnp.sqrt(jnp.where(small, 1.0, angle_squared))
    s = angle_squared
    cosine_series = 1 - s / 8 * (1 - s / 48 * (1 - s / 120 * (1 - s / 224)))
    sine_series = 0.5 * (1 - s / 24 * (1 - s / 80 * (1 - s / 168 * (1 - s / 288))))
    w = jnp.where(small, cosine_series, jnp.cos(angle / 2))
    xyz = jnp.where(small, sine_series, jnp.sin(angle / 2) / angle) * rotation_vector
    return matrix_from_wxyz(jnp.concatenate([w, xyz], axis=-1))


@jax.jit
def log(R: Float[Array, "... 3 3"]) -> Float[Array, "... 3"]:
    """Rotation vector of a rotation matrix, the shortest one.

    Args:
        R: Rotation matrices.

    Returns:
        Axis times angle, radians, with the angle in [0, pi]. At a half turn it is one of the two that exist.
    """
    wxyz = wxyz_from_matrix(R)
    w, xyz = wxyz[..., :1], wxyz[..., 1:]
    sine_squared = jnp.sum(xyz * xyz, axis=-1, keepdims=True)
    small = sine_squared < _SMALL_SINE_SQUARED
    sine = jnp.sqrt(jnp.where(small, 1.0, sine_squared))
    s = sine_squared
    series = 2 + s * (1 / 3 + s * (3 / 20 + s * (5 / 56 + s * 35 / 576)))  # 2 arcsin(sine) / sine
    return jnp.where(small, series, 2 * jnp.arctan2(sine, w) / sine) * xyz


@jax.jit
def matrix_from_wxyz(wxyz: Float[Array, "... 4"]) -> Float[Array, "... 3 3"]:
    """Rotation matrix of a quaternion.

    Args:
        wxyz: Quaternions, not zero; their length does not matter.

    Returns:
        Rotation matrices.
    """
    w, x, y, z = (wxyz[..., i] for i in range(4))
    scale = 2 / (w * w + x * x + y * y + z * z)
    entries = [
        1 - scale * (y * y + z * z), scale * (x * y - w * z), scale * (x * z + w * y),
        scale * (x * y + w * z), 1 - scale * (x * x + z * z), scale * (y * z - w * x),
        scale * (x * z - w * y), scale * (y * z + w * x), 1 - scale * (x * x + y * y),
    ]  # fmt: skip
    return jnp.stack(entries, axis=-1).reshape(*wxyz.shape[:-1], 3, 3)


@jax.jit
def wxyz_from_matrix(R: Float[Array, "... 3 3"]) -> Float[Array, "... 4"]:
    """Unit quaternion of a rotation matrix, with w >= 0.

    The entries of 4 q q^T are linear in R. Its row with the largest diagonal entry is a multiple of q no shorter
    than 2, so normalising that row is accurate for every rotation and needs no square root near zero.

    Args:
        R: Rotation matrices.

    Returns:
        Unit quaternions.
    """
    r00, r01, r02, r10, r11, r12, r20, r21, r22 = (R[..., i, j] for i in range(3) for j in range(3))
    rows = [
        [1 + r00 + r11 + r22, r21 - r12, r02 - r20, r10 - r01],
        [r21 - r12, 1 + r00 - r11 - r22, r01 + r10, r02 + r20],
        [r02 - r20, r01 + r10, 1 - r00 + r11 - r22, r12 + r21],
        [r10 - r01, r02 + r20, r12 + r21, 1 - r00 - r11 + r22],
    ]
    products = jnp.stack([jnp.stack(row, axis=-1) for row in rows], axis=-2)
    largest = jnp.argmax(jnp.diagonal(products, axis1=-2, axis2=-1), axis=-1)
    return _unit(jnp.take_along_axis(products, largest[..., None, None], axis=-2)[..., 0, :])


def uniform_rotations(key: PRNGKeyArray, count: int) -> Float[Array, "count 3 3"]:
    """Rotations drawn uniformly (Haar measure) from SO(3).

    Args:
        key: Random key.
        count: How many, at least 1.

    Returns:
        Rotation matrices.

    Raises:
        InputError: If count is below 1.
    """
    if count < 1:
        raise InputError(f"uniform_rotations(): count is {count}; expected at least 1.")
    return matrix_from_wxyz(jax.random.normal(key, (count, 4)))


def rotation_grid(count: int) -> Float[np.ndarray, "count 3 3"]:
    """Rotations spread evenly over SO(3): no draw, the same every time.

    A spiral on the quaternions' sphere with irrational turns (super-Fibonacci: Alexa, "Super-Fibonacci Spirals: Fast,
    Low-Discrepancy Sampling of SO(3)", CVPR 2022). Of 20,000 random rotations the one farthest from the grid was 60
    degrees away with a count of 64, 29 with 512 and 13 with 4096; on average they were 30, 15 and 8 away.

    Args:
        count: how many, at least 1.

    Raises:
        InputError: count is below 1.
    """
    if not isinstance(count, int | np.integer) or count < 1:
        raise InputError(f"rotation_grid(): count is {count}; expected a whole number of at least 1")
    s = np.arange(count) + 0.5
    inner, outer = np.sqrt(s / count), np.sqrt(1 - s / count)
    alpha, beta = 2 * np.pi * s / np.sqrt(2), 2 * np.pi * s / SUPER_FIBONACCI
    wxyz = np.stack([outer * np.cos(beta), inner * np.sin(alpha), inner * np.cos(alpha), outer * np.sin(beta)], axis=-1)
    return np.asarray(matrix_from_wxyz(wxyz))


def turns(
    axis: Float[Array, "3"], count: int, start: Float[Array, "3 3"] | None = None
) -> Float[np.ndarray, "count 3 3"]:
    """A slice of SO(3): an orientation turned about one axis in even steps, once around.

    Args:
        axis: in the world, of any length but zero.
        count: how many, at least 1; the first is `start`.
        start: the orientation that is turned; by default the world's axes.

    Raises:
        InputError: count is below 1, or the axis is none.
    """
    axis = np.asarray(axis, dtype=float)
    if axis.shape != (3,) or not 0 < np.linalg.norm(axis) < np.inf:
        raise InputError(f"turns(): axis is {axis.tolist()}; expected three numbers that are not all zero")
    if not isinstance(count, int | np.integer) or count < 1:
        raise InputError(f"turns(): count is {count}; expected a whole number of at least 1")
    angles = 2 * np.pi * np.arange(count) / count
    turned = np.asarray(exp(jnp.asarray(angles[:, None] * axis / np.linalg.norm(axis))))
    return turned if start is None else turned @ np.asarray(start)


@jax.jit
def rotation_distance(R_a: Float[Array, "... 3 3"], R_b: Float[Array, "... 3 3"]) -> Float[Array, "..."]:
    """Angle of the rotation between two rotations.

    Args:
        R_a: Rotation matrices.
        R_b: Rotation matrices; batch axes broadcast.

    Returns:
        Angles in [0, pi], radians. The gradient at equal rotations, where the angle has a kink, is zero.
    """
    wxyz = wxyz_from_matrix(_relative(R_a, R_b))
    sine_squared = jnp.sum(wxyz[..., 1:] ** 2, axis=-1)
    equal = sine_squared == 0
    sine = jnp.where(equal, 0.0, jnp.sqrt(jnp.where(equal, 1.0, sine_squared)))
    return 2 * jnp.arctan2(sine, wxyz[..., 0])


@jax.jit
def geodesic(
    R_a: Float[Array, "... 3 3"], R_b: Float[Array, "... 3 3"], fraction: Float[Array, "..."] | float
) -> Float[Array, "... 3 3"]:
    """Rotation part of the way along the shortest turn from one rotation to another.

    Args:
        R_a: Rotation matrices at fraction 0.
        R_b: Rotation matrices at fraction 1; batch axes broadcast.
        fraction: Fraction of the way; batch axes broadcast.

    Returns:
        Rotation matrices. Between rotations a half turn apart it is one of the two ways that exist.
    """
    return multiply(R_a, exp(jnp.asarray(fraction)[..., None] * log(_relative(R_a, R_b))))


@jax.jit
def pose(R: Float[Array, "... 3 3"], t: Float[Array, "... 3"]) -> Float[Array, "... 7"]:
    """Pose of a rotation matrix and a translation.

    Args:
        R: Rotation matrices.
        t: Translations, metres; batch axes broadcast.

    Returns:
        Poses `wxyz_xyz` of x -> R x + t.
    """
    return _join(wxyz_from_matrix(R), t)


def rotation(wxyz_xyz: Float[Array, "... 7"]) -> Float[Array, "... 3 3"]:
    """Rotation matrices of poses `wxyz_xyz`."""
    return matrix_from_wxyz(wxyz_xyz[..., :4])


def translation(wxyz_xyz: Float[Array, "... 7"]) -> Float[Array, "... 3"]:
    """Translations of poses `wxyz_xyz`, metres."""
    return wxyz_xyz[..., 4:]


@jax.jit
def compose(a: Float[Array, "... 7"], b: Float[Array, "... 7"]) -> Float[Array, "... 7"]:
    """Pose that applies b, then a: T_x_z = compose(T_x_y, T_y_z).

    Args:
        a: Poses `wxyz_xyz`.
        b: Poses `wxyz_xyz`; batch axes broadcast.

    Returns:
        Poses `wxyz_xyz`.
    """
    w, x, y, z = (a[..., i] for i in range(4))
    p, q, r, s = (b[..., i] for i in range(4))
    product = [
        w * p - x * q - y * r - z * s,
        w * q + x * p + y * s - z * r,
        w * r - x * s + y * p + z * q,
        w * s + x * r - y * q + z * p,
    ]
    return _join(_unit(jnp.stack(product, axis=-1)), transform(a, b[..., None, 4:])[..., 0, :])


@jax.jit
def inverse(a: Float[Array, "... 7"]) -> Float[Array, "... 7"]:
    """Inverse poses: compose(a, inverse(a)) is the identity.

    Args:
        a: Poses `wxyz_xyz`.

    Returns:
        Poses `wxyz_xyz`.
    """
    wxyz = _unit(a[..., :4] * jnp.array([1, -1, -1, -1], dtype=a.dtype))
    return _join(wxyz, -rotate(matrix_from_wxyz(wxyz), a[..., None, 4:])[..., 0, :])


@jax.jit
def transform(wxyz_xyz: Float[Array, "... 7"], x: Float[Array, "... queries 3"]) -> Float[Array, "... queries 3"]:
    """Points carried by poses: R x + t.

    Args:
        wxyz_xyz: Poses.
        x: Points, metres; the axes before the last two broadcast with the poses' batch axes.

    Returns:
        Points, metres.
    """
    return rotate(rotation(wxyz_xyz), x) + wxyz_xyz[..., None, 4:]


@jax.jit
def rotate(R: Float[Array, "... 3 3"], x: Float[Array, "... queries 3"]) -> Float[Array, "... queries 3"]:
    """Points turned by rotations: R x.

    The components are written out: on a CPU that is six times faster than a batched 3x3 einsum.

    Args:
        R: Rotation matrices.
        x: Points; the axes before the last two broadcast with the rotations' batch axes.

    Returns:
        Turned points.
    """
    R = R[..., None, :, :]
    components = [R[..., i, 0] * x[..., 0] + R[..., i, 1] * x[..., 1] + R[..., i, 2] * x[..., 2] for i in range(3)]
    return jnp.stack(components, axis=-1)


def multiply(R_a: Float[Array, "... 3 3"], R_b: Float[Array, "... 3 3"]) -> Float[Array, "... 3 3"]:
    """Rotations one after the other, the second first: R_a R_b; the default precision rounds float32 to 10 bits on some accelerators, 1e-3 radians.

    Args:
        R_a, R_b: Rotation matrices; batch axes broadcast.
    """
    return jnp.matmul(R_a, R_b, precision=jax.lax.Precision.HIGHEST)


def _relative(R_a: Float[Array, "... 3 3"], R_b: Float[Array, "... 3 3"]) -> Float[Array, "... 3 3"]:
    return multiply(jnp.swapaxes(R_a, -1, -2), R_b)


def _unit(wxyz: Float[Array, "... 4"]) -> Float[Array, "... 4"]:
    length = jnp.sqrt(jnp.sum(wxyz * wxyz, axis=-1, keepdims=True))
    return wxyz * jnp.where(wxyz[..., :1] < 0, -1, 1) / length


def _join(wxyz: Float[Array, "... 4"], t: Float[Array, "... 3"]) -> Float[Array, "... 7"]:
    batch = jnp.broadcast_shapes(wxyz.shape[:-1], t.shape[:-1])
    return jnp.concatenate([jnp.broadcast_to(wxyz, (*batch, 4)), jnp.broadcast_to(t, (*batch, 3))], axis=-1)
