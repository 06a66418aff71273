"""Rotations and poses against scipy, jaxlie and hand-computed cases, at the singular places on purpose."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from scipy.spatial.transform import Rotation
from scipy.stats import kstest

from tdf_jax._internal.errors import InputError
from tdf_jax.geometry import se3

TOLERANCE = {jnp.float32: 2e-5, jnp.float64: 1e-10}
# Zero, far below and just about the borders of the power series (0.0632 in log, 0.1732 in exp), pi, and beyond.
ANGLES = [0, 1e-12, 1e-8, 1e-4, 1e-2, 0.063, 0.0634, 0.173, 0.1735, 1, 2, 3, np.pi - 1e-3, np.pi - 1e-6, np.pi]
QUARTER_TURN_Z = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
HALF_TURNS = [np.diag([1.0, -1, -1]), np.diag([-1.0, 1, -1]), np.diag([-1.0, -1, 1])]


@pytest.fixture(params=[jnp.float32, pytest.param(jnp.float64, marks=pytest.mark.slow)], ids=["float32", "float64"])
def dtype(request):
    with jax.enable_x64(request.param is jnp.float64), jax.debug_nans(True):
        yield request.param


def axes(count=20):
    directions = np.random.default_rng(0).normal(size=(count, 3))
    directions[:3] = np.eye(3)
    directions[3:6] = -np.eye(3)
    return directions / np.linalg.norm(directions, axis=1, keepdims=True)


def vectors(angles, dtype):
    """Rotation vectors (angles, axes, 3), and the same after rounding to dtype, in float64 for scipy."""
    v = jnp.asarray(np.array(angles)[:, None, None] * axes(), dtype)
    return v, Rotation.from_rotvec(np.array(v, np.float64).reshape(-1, 3)), np.array(angles)[:, None]


def random_poses(shape, dtype, seed=0):
    wxyz_xyz = np.random.default_rng(seed).normal(size=(*shape, 7))
    wxyz_xyz[..., :4] /= np.linalg.norm(wxyz_xyz[..., :4], axis=-1, keepdims=True)
    return jnp.asarray(wxyz_xyz, dtype)


def matrices(wxyz_xyz):
    """4x4 matrices by scipy."""
    wxyz_xyz = np.array(wxyz_xyz, np.float64)
    T = np.broadcast_to(np.eye(4), (*wxyz_xyz.shape[:-1], 4, 4)).copy()
    flat = Rotation.from_quat(wxyz_xyz[..., :4].reshape(-1, 4), scalar_first=True).as_matrix()
    T[..., :3, :3], T[..., :3, 3] = flat.reshape(T[..., :3, :3].shape), wxyz_xyz[..., 4:]
    return T


def test_exp_is_scipys(dtype):
    v, turns, _ = vectors([*ANGLES, 5, 20], dtype)
    R = np.array(se3.exp(v))
    assert R.dtype == dtype
    # A few roundings only: the last term of the series is 1e-13 where it is largest.
    np.testing.assert_allclose(R.reshape(-1, 3, 3), turns.as_matrix(), atol=16 * jnp.finfo(dtype).eps, rtol=0)


def test_log_inverts_exp_to_an_error_relative_to_the_angle(dtype):
    v, turns, angles = vectors(ANGLES, dtype)
    back = jax.jit(lambda v: se3.log(se3.exp(v)))(v)
    assert back.dtype == dtype
    # By the turn left over, since both signs of a half turn are right.
    left_over = (Rotation.from_rotvec(np.array(back, np.float64).reshape(-1, 3)).inv() * turns).magnitude()
    tolerance = 16 * jnp.finfo(dtype).eps * angles
    assert (left_over.reshape(back.shape[:-1]) <= tolerance).all()
    below_pi = angles[:, 0] < 3.1
    assert (np.abs(np.array(back) - np.array(v)).max(axis=-1) <= tolerance)[below_pi].all()
    assert np.linalg.norm(back, axis=-1).max() < np.pi + TOLERANCE[dtype] / 10


def test_distance_from_the_identity_is_the_length_of_the_vector(dtype):
    v, turns, angles = vectors(ANGLES, dtype)
    distance = jax.jit(lambda v: se3.rotation_distance(jnp.eye(3, dtype=dtype), se3.exp(v)))(v)
    error = np.abs(np.array(distance) - turns.magnitude().reshape(distance.shape))
    assert (error <= TOLERANCE[dtype] / 10 * angles).all()


def test_exp_of_a_quarter_turn(dtype):
    R = se3.exp(jnp.array([0, 0, np.pi / 2], dtype))
    np.testing.assert_allclose(R, QUARTER_TURN_Z, atol=TOLERANCE[dtype] / 10)
    np.testing.assert_allclose(se3.log(R), [0, 0, np.pi / 2], atol=TOLERANCE[dtype] / 10)


def test_derivatives_of_exp_at_zero_rotation():
    zero = jnp.zeros(3)
    x, y, z = [[0, 0, 0], [0, 0, -1], [0, 1, 0]], [[0, 0, 1], [0, 0, 0], [-1, 0, 0]], [[0, -1, 0], [1, 0, 0], [0, 0, 0]]
    with jax.debug_nans(True):
        for differentiate in (jax.jacfwd, jax.jacrev):
            np.testing.assert_array_equal(jax.jit(differentiate(se3.exp))(zero), np.stack([x, y, z], axis=-1))
        # R = 1 + K + K^2 / 2 + ..., so R_xx = 1 - (y^2 + z^2) / 2 and R_xy = xy / 2 - z.
        second = np.array(jax.jit(jax.hessian(se3.exp))(zero))
    np.testing.assert_allclose(second[0, 0], np.diag([0, -1, -1]), atol=1e-6)
    np.testing.assert_allclose(second[0, 1], [[0, 0.5, 0], [0.5, 0, 0], [0, 0, 0]], atol=1e-6)


def test_derivative_of_exp_is_the_finite_difference():
    with jax.enable_x64(True), jax.debug_nans(True):
        v = np.array(vectors([*ANGLES, 5], jnp.float64)[0]).reshape(-1, 3)
        derivative = jax.jit(jax.vmap(jax.jacfwd(se3.exp)))(v)
        step = 1e-6 * np.eye(3)
        ahead, behind = se3.exp(v[:, None] + step), se3.exp(v[:, None] - step)
        difference = (np.array(ahead) - np.array(behind)) / 2e-6
        np.testing.assert_allclose(derivative, np.moveaxis(difference, 1, -1), atol=1e-8)


def test_derivative_of_log_after_exp_is_the_identity(dtype):
    v = vectors(ANGLES, dtype)[0]
    jacobian = jax.jit(jax.vmap(jax.vmap(jax.jacrev(lambda x: se3.log(se3.exp(x))))))(v)
    assert np.isfinite(jacobian).all()
    below_pi = np.array(ANGLES) < 3.1  # at pi rounding may land on the other side of the jump
    expected = np.broadcast_to(np.eye(3), jacobian.shape)
    np.testing.assert_allclose(jacobian[below_pi], expected[below_pi], atol=TOLERANCE[dtype])


def test_gradients_at_singular_rotations_are_finite():
    """Identity and half turns, alone and in pairs, so that distances of zero and pi occur in both arguments."""
    R = np.array([np.eye(3), *HALF_TURNS], np.float32)
    a, b = np.repeat(R, 4, axis=0), np.tile(R, (4, 1, 1))

    def gradients(a, b):
        return (
            jax.jacrev(se3.log)(a),
            jax.jacrev(se3.wxyz_from_matrix)(a),
            jax.grad(se3.rotation_distance, (0, 1))(a, b),
            jax.jacrev(lambda a, b: se3.geodesic(a, b, 0.3), (0, 1))(a, b),
        )

    for gradient in jax.tree.leaves(jax.jit(jax.vmap(gradients))(a, b)):
        assert np.isfinite(gradient).all()


def test_gradient_of_the_distance_is_a_unit_step_along_the_axis(dtype):
    axis = np.array([2, -1, 2]) / 3
    gradient = jax.jit(jax.grad(lambda v: se3.rotation_distance(se3.exp(v), jnp.eye(3, dtype=dtype))))
    for angle in (1e-3, 1.0, 3.0):
        np.testing.assert_allclose(gradient(jnp.asarray(angle * axis, dtype)), axis, atol=TOLERANCE[dtype])
    np.testing.assert_array_equal(gradient(jnp.zeros(3, dtype)), np.zeros(3))


def test_log_and_distance_of_half_turns(dtype):
    R = jnp.asarray(HALF_TURNS, dtype)
    v = se3.log(R)
    np.testing.assert_allclose(np.abs(v), np.pi * np.eye(3), atol=TOLERANCE[dtype] / 10)
    np.testing.assert_allclose(se3.exp(v), R, atol=TOLERANCE[dtype] / 10)
    distance = se3.rotation_distance(R, jnp.eye(3, dtype=dtype))
    np.testing.assert_allclose(distance, np.pi, atol=TOLERANCE[dtype] / 10)


def test_matrix_from_wxyz_is_scipys_for_any_length(dtype):
    wxyz = np.random.default_rng(1).normal(size=(5, 10, 4))
    expected = matrices(np.concatenate([wxyz, np.zeros((5, 10, 3))], axis=-1))[..., :3, :3]
    for length in (-1, 1e-3, 100):
        R = se3.matrix_from_wxyz(jnp.asarray(length * wxyz, dtype))
        np.testing.assert_allclose(R, expected, atol=TOLERANCE[dtype])


def test_wxyz_from_matrix_inverts_with_w_not_negative(dtype):
    """Each of the four components is the largest in turn, of both signs, the others down to zero."""
    wxyz = np.array(list(itertools.product([-1, -0.3, 0, 0.3, 1], repeat=4)))
    wxyz = wxyz[np.abs(wxyz).sum(axis=1) > 0]
    wxyz /= np.linalg.norm(wxyz, axis=1, keepdims=True)
    R = se3.matrix_from_wxyz(jnp.asarray(wxyz, dtype))
    back = np.array(se3.wxyz_from_matrix(R))
    assert back.dtype == dtype
    assert (back[:, 0] >= 0).all()
    np.testing.assert_allclose(np.linalg.norm(back, axis=1), 1, atol=TOLERANCE[dtype] / 10)
    error = np.minimum(np.abs(back - wxyz).max(axis=1), np.abs(back + wxyz).max(axis=1))
    assert error.max() < TOLERANCE[dtype] / 10


def test_uniform_rotations_are_haar():
    R = se3.uniform_rotations(jax.random.key(0), 4000)
    assert R.shape == (4000, 3, 3)
    np.testing.assert_allclose(np.linalg.det(R), 1, atol=1e-5)
    # Under the Haar measure the angle has density (1 - cos a) / pi, and every image of an axis is uniform: each
    # coordinate of it is uniform in [-1, 1].
    angles = np.array(se3.rotation_distance(R, jnp.eye(3)))
    assert kstest(angles, lambda a: (a - np.sin(a)) / np.pi).pvalue > 0.01
    for i, j in itertools.product(range(3), repeat=2):
        assert kstest(np.array(R[:, i, j]), "uniform", args=(-1, 2)).pvalue > 0.001


def test_uniform_rotations_follow_the_key():
    first, again, other = (se3.uniform_rotations(jax.random.key(seed), 3) for seed in (0, 0, 1))
    np.testing.assert_array_equal(first, again)
    assert not np.allclose(first, other, atol=0.1)
    with pytest.raises(InputError, match=r"uniform_rotations\(\): count is 0; expected a whole number of at least 1"):
        se3.uniform_rotations(jax.random.key(0), 0)


def test_rotation_distance_is_scipys_and_broadcasts(dtype):
    a, b = random_poses((4, 1), dtype, 1), random_poses((6,), dtype, 2)
    R_a, R_b = se3.rotation(a), se3.rotation(b)
    distance = se3.rotation_distance(R_a, R_b)
    relative = np.swapaxes(matrices(a)[..., :3, :3], -1, -2) @ matrices(b)[..., :3, :3]
    expected = Rotation.from_matrix(relative.reshape(-1, 3, 3)).magnitude().reshape(4, 6)
    np.testing.assert_allclose(distance, expected, atol=TOLERANCE[dtype])
    np.testing.assert_allclose(se3.rotation_distance(R_b, R_a), expected, atol=TOLERANCE[dtype])


def test_geodesic_turns_evenly_from_one_rotation_to_the_other(dtype):
    R_a = np.concatenate([np.eye(3)[None], matrices(random_poses((4,), dtype, 3))[:, :3, :3]])
    R_b = np.concatenate([QUARTER_TURN_Z[None], matrices(random_poses((4,), dtype, 4))[:, :3, :3]])
    R_a, R_b = jnp.asarray(R_a, dtype), jnp.asarray(R_b, dtype)
    fractions = np.linspace(0, 1, 7, dtype=dtype)[:, None]
    path = np.array(se3.geodesic(R_a, R_b, fractions))
    assert path.shape == (7, 5, 3, 3)
    np.testing.assert_allclose(path[0], R_a, atol=TOLERANCE[dtype] / 10)
    np.testing.assert_allclose(path[-1], R_b, atol=TOLERANCE[dtype] / 10)
    expected = Rotation.from_rotvec([0, 0, np.pi / 6]).as_matrix()
    np.testing.assert_allclose(path[2, 0], expected, atol=TOLERANCE[dtype] / 10)
    from_a, from_b = np.array(se3.rotation_distance(R_a, path)), np.array(se3.rotation_distance(R_b, path))
    np.testing.assert_allclose(from_a, fractions * from_a[-1], atol=TOLERANCE[dtype])
    np.testing.assert_allclose(from_b, (1 - fractions) * from_a[-1], atol=TOLERANCE[dtype])


def test_pose_by_hand(dtype):
    T = se3.pose(jnp.asarray(QUARTER_TURN_Z, dtype), jnp.array([1, 2, 3], dtype))
    half = np.sqrt(0.5)
    np.testing.assert_allclose(T, [half, 0, 0, half, 1, 2, 3], atol=TOLERANCE[dtype] / 10)
    np.testing.assert_allclose(se3.rotation(T), QUARTER_TURN_Z, atol=TOLERANCE[dtype] / 10)
    np.testing.assert_array_equal(se3.translation(T), [1, 2, 3])
    moved = se3.transform(T, jnp.array([[1, 0, 0], [0, 1, 0], [0, 0, 1]], dtype))
    np.testing.assert_allclose(moved, [[1, 3, 3], [0, 2, 3], [1, 2, 4]], atol=TOLERANCE[dtype] / 10)


def test_pose_broadcasts_a_rotation_over_translations(dtype):
    T = se3.pose(jnp.eye(3, dtype=dtype), jnp.arange(6, dtype=dtype).reshape(2, 3))
    np.testing.assert_array_equal(T, [[1, 0, 0, 0, 0, 1, 2], [1, 0, 0, 0, 3, 4, 5]])


@pytest.mark.parametrize("length", [1, -3], ids=["unit", "any quaternion"])
def test_compose_inverse_and_transform_are_those_of_matrices(length, dtype):
    a, b = random_poses((4, 1), dtype, 5), random_poses((3,), dtype, 6)
    T_a, T_b = matrices(a), matrices(b)
    scale = np.array([length] * 4 + [1] * 3, dtype)
    a, b = a * scale, b * scale
    x = jnp.asarray(np.random.default_rng(7).normal(size=(10, 3)), dtype)
    composed, inverted, moved = se3.compose(a, b), se3.inverse(b), se3.transform(b, x)
    assert {composed.dtype, inverted.dtype, moved.dtype} == {jnp.dtype(dtype)}
    np.testing.assert_allclose(matrices(composed), T_a @ T_b, atol=TOLERANCE[dtype])
    np.testing.assert_allclose(matrices(inverted), np.linalg.inv(T_b), atol=TOLERANCE[dtype])
    expected = np.einsum("pij,qj->pqi", T_b[:, :3, :3], x) + T_b[:, None, :3, 3]
    np.testing.assert_allclose(moved, expected, atol=TOLERANCE[dtype])
    for wxyz in (np.array(composed)[..., :4], np.array(inverted)[..., :4]):
        assert (wxyz[..., 0] >= 0).all()
        np.testing.assert_allclose(np.linalg.norm(wxyz, axis=-1), 1, atol=TOLERANCE[dtype])


def test_rotate_pairs_each_rotation_with_its_points(dtype):
    R = se3.rotation(random_poses((2, 4), dtype, 11))
    x = jnp.asarray(np.random.default_rng(12).normal(size=(4, 6, 3)), dtype)
    np.testing.assert_allclose(se3.rotate(R, x), np.einsum("bpij,pqj->bpqi", R, x), atol=TOLERANCE[dtype])


@pytest.mark.slow
def test_the_layout_is_jaxlies():
    import jaxlie

    a, b, x = random_poses((5,), jnp.float32, 13), random_poses((5,), jnp.float32, 14), np.float32(axes()[:5])

    @jax.jit
    def theirs(a, b, x):
        T_a, T_b = jaxlie.SE3(a), jaxlie.SE3(b)
        matrices_of_both = (T_a @ T_b).as_matrix(), T_a.inverse().as_matrix()
        return *matrices_of_both, T_a @ x, T_a.rotation().as_matrix(), T_a.translation()

    @jax.jit
    def ours(a, b, x):
        back = se3.pose(se3.rotation(a), se3.translation(a))
        moved = se3.transform(back, x[:, None])[:, 0]
        return se3.compose(a, b), se3.inverse(a), moved, se3.rotation(back), se3.translation(back)

    composed, inverted, *rest = ours(a, b, x)
    for mine, reference in zip((matrices(composed), matrices(inverted), *rest), theirs(a, b, x), strict=True):
        np.testing.assert_allclose(mine, reference, atol=2e-5)


numbers = st.floats(-2, 2, width=32, allow_subnormal=False)
vectors3 = st.tuples(numbers, numbers, numbers)


@jax.jit
def group_laws(u, v, t):
    """Pairs of point sets that the group axioms say are equal."""
    a = se3.pose(se3.exp(u), t)
    b = se3.pose(se3.exp(v), u)
    x = jnp.stack([u, v, t])
    both = se3.transform(se3.compose(a, b), x)
    back = se3.compose(se3.inverse(b), se3.inverse(a))
    return (
        (se3.transform(se3.compose(a, se3.inverse(a)), x), x),
        (both, se3.transform(a, se3.transform(b, x))),
        (se3.transform(back, both), x),
    )


@given(vectors3, vectors3, vectors3)
@settings(max_examples=50, deadline=None, derandomize=True)
def test_group_axioms(u, v, t):
    for left, right in group_laws(jnp.array(u), jnp.array(v), jnp.array(t)):
        np.testing.assert_allclose(left, right, atol=2e-5)


def test_a_grid_of_rotations_leaves_no_large_hole():
    """Alexa's spiral: with 512, no rotation is farther than 30 degrees from the grid; random grids have larger gaps."""
    grid = se3.rotation_grid(512)
    np.testing.assert_allclose(grid @ grid.swapaxes(1, 2), np.broadcast_to(np.eye(3), grid.shape), atol=1e-5)
    probes = np.asarray(se3.uniform_rotations(jax.random.key(0), 2000))

    def hole(rotations):
        traces = np.einsum("aij,bij->ab", probes, rotations).max(axis=1)
        return np.degrees(np.arccos(np.clip((traces - 1) / 2, -1, 1))).max()

    assert hole(grid) < 30
    assert hole(np.asarray(se3.uniform_rotations(jax.random.key(1), 512))) > 35


def test_turns_go_once_around_an_axis():
    turns = se3.turns((0, 0, 2), 4)
    np.testing.assert_allclose(turns @ [1, 0, 0], [[1, 0, 0], [0, 1, 0], [-1, 0, 0], [0, -1, 0]], atol=1e-6)
    start = se3.exp(jnp.array([0.3, 0.0, 0.0]))
    np.testing.assert_allclose(se3.turns((0, 0, 1), 2, start)[0], start, atol=1e-6)


def test_rotations_that_make_no_sense_are_refused():
    with pytest.raises(InputError, match="count is 0"):
        se3.rotation_grid(0)
    with pytest.raises(InputError, match="axis is"):
        se3.turns((0, 0, 0), 3)
    with pytest.raises(InputError, match="count is 0"):
        se3.turns((0, 0, 1), 0)
