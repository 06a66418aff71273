"""Rotations and rigid poses: exponentials, logarithms, distances, geodesics.

Rotations are matrices `R` (..., 3, 3), rotation vectors (axis times angle, radians) or unit quaternions `wxyz`.
Poses are `wxyz_xyz` (..., 7), quaternion then translation in metres: the layout of `jaxlie.SE3`. Functions normalise
quaternions, so any non-zero multiple of a quaternion is the same rotation; returned quaternions have w >= 0.

Every function is differentiable with finite gradients everywhere, the identity and half turns included. Every function
is compiled as a whole, because op by op the first trajectory of a process would compile each operation separately.
"""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray
from numpy.typing import ArrayLike

from tdf_jax._internal import checks
from tdf_jax._internal.boundary import public

# Below these squares a power series replaces the quotient 0/0. They are large on purpose, so that second derivatives
# are accurate too; the omitted terms are below 1e-16.
_SMALL_ANGLE_SQUARED = 0.03
_SMALL_SINE_SQUARED = 1e-3
SUPER_FIBONACCI = 1.533751168755204288118041  # the positive root of psi^4 = psi + 4, the best in Alexa's table


@jax.jit
def exp(rotation_vector: Float[Array, "... 3"]) -> Float[Array, "... 3 3"]:
    """Compute the rotation matrix of a rotation vector.

    Args:
        rotation_vector: axis times angle, (..., 3), radians, of any length.

    Returns:
        Rotation matrices, (..., 3, 3).
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
    """Compute the shortest rotation vector of a rotation matrix.

    Args:
        R: rotation matrices, (..., 3, 3).

    Returns:
        Axis times angle, (..., 3), radians, with the angle in [0, pi]. At a half turn it is one of the two solutions.
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
    """Compute the rotation matrix of a quaternion.

    Args:
        wxyz: quaternions, (..., 4), not zero, of any length.

    Returns:
        Rotation matrices, (..., 3, 3).
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
    """Compute the unit quaternion of a rotation matrix, with w >= 0.

    The entries of 4 q q^T are linear in R. The row with the largest diagonal entry is a multiple of q whose length is
    at least 2, so normalising that row is accurate for every rotation and needs no square root near zero.

    Args:
        R: rotation matrices, (..., 3, 3).

    Returns:
        Unit quaternions wxyz, (..., 4).
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
    """Sample rotations uniformly (Haar measure) from SO(3).

    Args:
        key: random key.
        count: number of rotations, at least 1.

    Returns:
        Rotation matrices, (count, 3, 3).

    Raises:
        InputError: count is below 1.
    """
    checks.count("uniform_rotations()", "count", count)
    return matrix_from_wxyz(jax.random.normal(key, (count, 4)))


@public
def rotation_grid(count: int) -> Float[np.ndarray, "count 3 3"]:
    """Spread rotations evenly over SO(3); the grid is the same in every call.

    The grid is a super-Fibonacci spiral on the sphere of unit quaternions. docs/results/code_notes.md lists its
    covering radius.

    Args:
        count: number of rotations, at least 1.

    Returns:
        Rotation matrices, (count, 3, 3).

    Raises:
        InputError: count is below 1.

    References:
        Alexa, "Super-Fibonacci Spirals: Fast, Low-Discrepancy Sampling of SO(3)", CVPR 2022.
    """
    checks.count("rotation_grid()", "count", count)
    s = np.arange(count) + 0.5
    inner, outer = np.sqrt(s / count), np.sqrt(1 - s / count)
    alpha, beta = 2 * np.pi * s / np.sqrt(2), 2 * np.pi * s / SUPER_FIBONACCI
    wxyz = np.stack([outer * np.cos(beta), inner * np.sin(alpha), inner * np.cos(alpha), outer * np.sin(beta)], axis=-1)
    return np.asarray(matrix_from_wxyz(wxyz))


@public
def turns(axis: ArrayLike, count: int, start: Float[Array, "3 3"] | None = None) -> Float[np.ndarray, "count 3 3"]:
    """Rotate an orientation about one axis in even steps, once around: a slice of SO(3).

    Args:
        axis: rotation axis, (3,), world frame, of any length but zero.
        count: number of rotations, at least 1; the first is `start`.
        start: orientation that is rotated, (3, 3), world frame; by default the identity.

    Returns:
        Rotation matrices, (count, 3, 3).

    Raises:
        InputError: count is below 1, the axis is zero or not finite, or start is no rotation matrix.
    """
    direction = np.asarray(checks.direction("turns()", "axis", axis))
    checks.count("turns()", "count", count)
    angles = 2 * np.pi * np.arange(count) / count
    rotations = np.asarray(exp(jnp.asarray(angles[:, None] * direction / np.linalg.norm(direction))))
    return rotations if start is None else rotations @ np.asarray(checks.orientation("turns()", "start", start))


@jax.jit
def rotation_distance(R_a: Float[Array, "... 3 3"], R_b: Float[Array, "... 3 3"]) -> Float[Array, "..."]:
    """Compute the angle between two rotations.

    Args:
        R_a: rotation matrices, (..., 3, 3).
        R_b: rotation matrices, (..., 3, 3); batch axes broadcast.

    Returns:
        Angles in [0, pi], (...), radians. The gradient at equal rotations, where the angle has a kink, is zero.
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
    """Interpolate between two rotations along the SO(3) geodesic.

    Args:
        R_a: rotation matrices at fraction 0, (..., 3, 3).
        R_b: rotation matrices at fraction 1, (..., 3, 3); batch axes broadcast.
        fraction: fraction of the geodesic, (...); batch axes broadcast.

    Returns:
        Rotation matrices, (..., 3, 3). Between rotations that differ by a half turn they follow one of two geodesics.
    """
    return multiply(R_a, exp(jnp.asarray(fraction)[..., None] * log(_relative(R_a, R_b))))


@jax.jit
def pose(R: Float[Array, "... 3 3"], t: Float[Array, "... 3"]) -> Float[Array, "... 7"]:
    """Combine a rotation matrix and a translation into a pose.

    Args:
        R: rotation matrices, (..., 3, 3).
        t: translations, (..., 3), metres; batch axes broadcast.

    Returns:
        Poses `wxyz_xyz` of x -> R x + t, (..., 7).
    """
    return _join(wxyz_from_matrix(R), t)


@jax.jit
def matrix(wxyz_xyz: Float[Array, "... 7"]) -> Float[Array, "... 4 4"]:
    """Compute the homogeneous matrices of poses `wxyz_xyz`, (..., 4, 4), translations in metres."""
    upper = jnp.concatenate([rotation(wxyz_xyz), translation(wxyz_xyz)[..., None]], axis=-1)
    lower = jnp.broadcast_to(jnp.array([0, 0, 0, 1], upper.dtype), (*upper.shape[:-2], 1, 4))
    return jnp.concatenate([upper, lower], axis=-2)


@jax.jit
def shift(wxyz_xyz: Float[Array, "... 7"], offset: Float[Array, "... 3"]) -> Float[Array, "... 7"]:
    """Add an offset, (..., 3), to the translations of poses `wxyz_xyz`, (..., 7), metres."""
    return jnp.concatenate([wxyz_xyz[..., :4], translation(wxyz_xyz) + offset], axis=-1)


def rotation(wxyz_xyz: Float[Array, "... 7"]) -> Float[Array, "... 3 3"]:
    """Return the rotation matrices of poses `wxyz_xyz`, (..., 3, 3)."""
    return matrix_from_wxyz(wxyz_xyz[..., :4])


def translation(wxyz_xyz: Float[Array, "... 7"]) -> Float[Array, "... 3"]:
    """Return the translations of poses `wxyz_xyz`, (..., 3), metres."""
    return wxyz_xyz[..., 4:]


@jax.jit
def compose(a: Float[Array, "... 7"], b: Float[Array, "... 7"]) -> Float[Array, "... 7"]:
    """Compose poses; b is applied first.

    T_x_z is the composition of T_x_y and T_y_z.

    Args:
        a: poses `wxyz_xyz`, (..., 7), metres.
        b: poses `wxyz_xyz`, (..., 7), metres; batch axes broadcast.

    Returns:
        Poses `wxyz_xyz`, (..., 7).
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
    """Invert poses.

    Args:
        a: poses `wxyz_xyz`, (..., 7), metres.

    Returns:
        Poses `wxyz_xyz`, (..., 7).
    """
    wxyz = _unit(a[..., :4] * jnp.array([1, -1, -1, -1], dtype=a.dtype))
    return _join(wxyz, -rotate(matrix_from_wxyz(wxyz), a[..., None, 4:])[..., 0, :])


@jax.jit
def transform(wxyz_xyz: Float[Array, "... 7"], x: Float[Array, "... queries 3"]) -> Float[Array, "... queries 3"]:
    """Transform points by poses: R x + t.

    Args:
        wxyz_xyz: poses, (..., 7), metres.
        x: points, (..., queries, 3), metres; the axes before the last two broadcast with the poses' batch axes.

    Returns:
        Points, (..., queries, 3), metres.
    """
    return rotate(rotation(wxyz_xyz), x) + wxyz_xyz[..., None, 4:]


@jax.jit
def rotate(R: Float[Array, "... 3 3"], x: Float[Array, "... queries 3"]) -> Float[Array, "... queries 3"]:
    """Rotate points: R x.

    Args:
        R: rotation matrices, (..., 3, 3).
        x: points, (..., queries, 3); the axes before the last two broadcast with the rotations' batch axes.

    Returns:
        Rotated points, (..., queries, 3).
    """
    # The components are written out, because on a CPU that is six times faster than a batched 3x3 einsum.
    R = R[..., None, :, :]
    components = [R[..., i, 0] * x[..., 0] + R[..., i, 1] * x[..., 1] + R[..., i, 2] * x[..., 2] for i in range(3)]
    return jnp.stack(components, axis=-1)


def multiply(R_a: Float[Array, "... 3 3"], R_b: Float[Array, "... 3 3"]) -> Float[Array, "... 3 3"]:
    """Multiply rotation matrices: R_a R_b, which applies R_b first.

    Args:
        R_a: rotation matrices, (..., 3, 3).
        R_b: rotation matrices, (..., 3, 3); batch axes broadcast.

    Returns:
        Rotation matrices, (..., 3, 3).
    """
    # The default precision rounds float32 to 10 bits on some accelerators, an error of 1e-3 radians.
    return jnp.matmul(R_a, R_b, precision=jax.lax.Precision.HIGHEST)


def _relative(R_a: Float[Array, "... 3 3"], R_b: Float[Array, "... 3 3"]) -> Float[Array, "... 3 3"]:
    return multiply(jnp.swapaxes(R_a, -1, -2), R_b)


def _unit(wxyz: Float[Array, "... 4"]) -> Float[Array, "... 4"]:
    length = jnp.sqrt(jnp.sum(wxyz * wxyz, axis=-1, keepdims=True))
    return wxyz * jnp.where(wxyz[..., :1] < 0, -1, 1) / length


def _join(wxyz: Float[Array, "... 4"], t: Float[Array, "... 3"]) -> Float[Array, "... 7"]:
    batch = jnp.broadcast_shapes(wxyz.shape[:-1], t.shape[:-1])
    return jnp.concatenate([jnp.broadcast_to(wxyz, (*batch, 4)), jnp.broadcast_to(t, (*batch, 3))], axis=-1)
