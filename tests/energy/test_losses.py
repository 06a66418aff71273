"""Energies against the original's outputs and hand-computed cases, and their gradients at the singular places."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import carried, compilations, composed, enabled, random_cloud, random_poses, relative_error
from scipy.spatial.transform import Rotation

import tdf_jax as tdf
from tdf_jax._internal.errors import InputError
from tdf_jax.energy.losses import POSE_NORMS, pose_energy, waypoint_loss
from tdf_jax.energy.reference import Reference
from tdf_jax.geometry import se3
from tdf_jax.networks.field import DescriptorField

HALF = np.sqrt(0.5)
QUARTER_TURN_Z = [HALF, 0, 0, HALF]
IDENTITY = [1.0, 0, 0, 0]


def trajectory(*rows):
    """Trajectory of (quaternion, translation) pairs."""
    return tdf.Trajectory(jnp.array([[*wxyz, *t] for wxyz, t in rows], jnp.float32))


# ---- the original ----


descriptor_loss = jax.jit(tdf.descriptor_loss)


def golden_trajectory(golden, precision, suffix=""):
    wxyz = Rotation.from_rotvec(golden.arrays[f"traj_rot{suffix}"]).as_quat(scalar_first=True)
    return tdf.Trajectory(jnp.asarray(np.concatenate([wxyz, golden.arrays[f"traj_t{suffix}"]], axis=1), precision))


@pytest.fixture(scope="module")
def golden_reference(golden, golden_fields, precision):
    """The demonstration on object 0."""
    with enabled(precision):
        demonstrated = golden_trajectory(golden, precision, "_ref")
        query = jnp.asarray(golden.arrays["traj_query"], precision)
        return Reference(jax.jit(tdf.trajectory_descriptor)(golden_fields[0], demonstrated, query), demonstrated, query)


def test_the_trajectory_loss_is_the_originals(golden, golden_fields, golden_reference, precision):
    with enabled(precision):
        found = descriptor_loss(golden_trajectory(golden, precision), golden_fields[1], golden_reference)
    assert found.dtype == precision
    # The original's rotations are off by 1e-6 (below); the loss then is by 5e-9 of itself.
    assert relative_error(found, golden.arrays["traj_loss"]) < {"float32": 1e-4, "float64": 1e-7}[precision]


def original_exponential(v):
    """The rotation matrix in the original: Rodrigues' formula about v / (|v| + 1e-6), which is no unit vector."""
    angle = jnp.linalg.norm(v)
    x, y, z = axis = v / (angle + 1e-6)
    cross = jnp.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return jnp.cos(angle) * jnp.eye(3) + jnp.sin(angle) * cross + (1 - jnp.cos(angle)) * jnp.outer(axis, axis)


@pytest.mark.parametrize(
    ("exponential", "precision", "loss_tolerance", "gradient_tolerance"),
    [
        (original_exponential, "float64", 1e-10, 1e-10),
        (se3.exp, "float64", 1e-7, 1e-5),
        (se3.exp, "float32", 1e-4, 5e-3),
    ],
    indirect=["precision"],
)
def test_the_loss_of_every_waypoint_and_its_gradients_are_the_originals(
    golden, golden_fields, exponential, precision, loss_tolerance, gradient_tolerance
):
    first, second = golden_fields
    names = ("query", "rot_ref", "t_ref", "rot", "t")

    def losses(rotation_vectors, t, query, v_ref, t_ref):
        def one(v, t, v_ref, t_ref):
            descriptors = first.descriptors(se3.rotate(exponential(v_ref), query) + t_ref)
            return waypoint_loss(exponential(v), t, second, query, descriptors)

        each = jax.vmap(one)(rotation_vectors, t, v_ref, t_ref)
        return jnp.mean(each), each

    with enabled(precision):
        query, v_ref, t_ref, v, t = (jnp.asarray(golden.arrays[f"traj_{name}"], precision) for name in names)
        gradients, each = jax.jit(jax.grad(losses, argnums=(0, 1), has_aux=True))(v, t, query, v_ref, t_ref)
    assert relative_error(each, golden.arrays["traj_loss_per_pose"]) < loss_tolerance
    for gradient, name in zip(gradients, ("traj_grad_rot", "traj_grad_t"), strict=True):
        assert relative_error(gradient, golden.arrays[name]) < gradient_tolerance, name


# ---- hand-computed cases ----


class Coordinates(DescriptorField):
    """A field whose three channels are the coordinates relative to its origin."""

    origin = jnp.array([1.0, 2.0, 3.0])

    def __init__(self):
        """It has no decoder."""

    def descriptors(self, x):
        return x - self.origin


def coordinates_reference(query, *rows):
    """The reference of poses that are relative to the demonstrated object's origin already."""
    target = trajectory(*rows)
    query = jnp.asarray(query, jnp.float32)
    return Reference(se3.transform(target.wxyz_xyz, query), target, query)


def test_equation_2_is_the_mean_absolute_difference():
    reference = coordinates_reference([(0, 0, 0), (1, 0, 0)], (IDENTITY, (0, 0, 0)), (IDENTITY, (0, 1, 0)))
    # Pose 0: off by (0.3, 0, -0.6) at both query points, 1.8 in sum. Pose 1: the query point (1, 0, 0) goes to
    # (0, 1, 0) instead, 2 in sum. Means over 2 poses x 2 queries x 3 channels.
    found = trajectory((IDENTITY, (1.3, 2, 2.4)), (QUARTER_TURN_Z, (1, 3, 3)))
    np.testing.assert_allclose(tdf.descriptor_loss(found, Coordinates(), reference), (1.8 + 2) / 12, rtol=1e-6)


@pytest.mark.parametrize(
    ("settings", "turn"),
    [
        ({}, 2.0),  # ||R - I||_F of a quarter turn: four entries of 1
        ({"rotation_scale": 0.05}, 0.1),
        ({"pose_norm": "metres_radians"}, np.pi / 2),
        ({"pose_norm": "metres_radians", "rotation_scale": 0.05}, np.pi / 40),
    ],
)
def test_equation_3_is_the_mean_distance_of_centred_poses(settings, turn):
    origin = Coordinates.origin
    reference = coordinates_reference([(0, 0, 0)], (IDENTITY, (0, 0, 0)), (IDENTITY, (0, 1, 0)), (IDENTITY, (0, 0, 0)))
    # Pose 0: 5 m away. Pose 1: a quarter turn. Pose 2: both.
    found = trajectory((IDENTITY, (4, 6, 3)), (QUARTER_TURN_Z, (1, 3, 3)), (QUARTER_TURN_Z, (4, 6, 3)))
    expected = (5 + turn + np.hypot(5, turn)) / 3
    np.testing.assert_allclose(tdf.correlation_loss(found, origin, reference, **settings), expected, rtol=1e-6)


def test_the_mean_absolute_norm_is_over_the_twelve_numbers_of_a_pose():
    reference = coordinates_reference([(0, 0, 0)], (IDENTITY, (0, 0, 0)), (IDENTITY, (0, 1, 0)))
    # Pose 0: off by (3, -4, 0). Pose 1: a quarter turn, four entries of 1.
    found = trajectory((IDENTITY, (4, -2, 3)), (QUARTER_TURN_Z, (1, 3, 3)))
    loss = tdf.correlation_loss(found, Coordinates.origin, reference, rotation_scale=0.5, pose_norm="mean_absolute")
    np.testing.assert_allclose(loss, (7 / 12 + 2 / 12) / 2, rtol=1e-6)


def test_the_energy_takes_either_order_of_equation_6(field, reference, current):
    found = {}
    for order in ("frobenius", "infinity"):
        weights = tdf.EnergyWeights(0.0, 0.3, compensator_order=order)
        rest = tdf.trajectory_energy(current, field, reference, weights) - tdf.descriptor_loss(
            current, field, reference
        )
        np.testing.assert_allclose(rest, 0.3 * tdf.compensator_loss(current, order), rtol=1e-4)
        found[order] = float(rest)
    assert found["infinity"] < found["frobenius"]
    with pytest.raises(InputError, match="compensator_order is 'largest'"):
        tdf.EnergyWeights(compensator_order="largest")


def test_the_plain_norm_of_equation_3_is_that_of_the_matrices():
    found, target = (tdf.Trajectory(jnp.asarray(random_poses(seed, 5), jnp.float32)) for seed in (0, 1))
    reference = Reference(jnp.zeros((5, 1, 3)), target, jnp.zeros((1, 3)))
    difference = np.asarray(found.matrices) - np.asarray(target.matrices)
    difference[:, :3, 3] -= (1, 2, 3)
    expected = np.linalg.norm(difference, axis=(1, 2)).mean()
    np.testing.assert_allclose(tdf.correlation_loss(found, Coordinates.origin, reference), expected, rtol=1e-5)


def test_equation_6_sums_the_lengths_of_steps():
    # Seen from the turned pose, the second step goes along another axis; its length is the same.
    found = trajectory((IDENTITY, (0, 0, 0)), (QUARTER_TURN_Z, (0, 0, 0)), (QUARTER_TURN_Z, (3, 4, 0)))
    np.testing.assert_allclose(tdf.compensator_loss(found), 2 + 5, rtol=1e-6)
    np.testing.assert_allclose(tdf.compensator_loss(found, "infinity"), 5, rtol=1e-6)
    with pytest.raises(InputError, match="compensator_loss"):
        tdf.compensator_loss(found, "largest")


def test_equation_6_is_that_of_the_matrices():
    found = tdf.Trajectory(jnp.asarray(random_poses(0, 5), jnp.float32))
    T = np.asarray(found.matrices, np.float64)
    steps = np.linalg.inv(T[:-1]) @ T[1:] - np.eye(4)
    np.testing.assert_allclose(tdf.compensator_loss(found), np.linalg.norm(steps, axis=(1, 2)).sum(), rtol=1e-5)


# ---- the whole energy ----


@pytest.fixture(scope="module")
def current():
    """A trajectory on the object of `field`."""
    return tdf.Trajectory(jnp.asarray(random_poses(11, 4) + [0, 0, 0, 0, 0.3, -0.2, 0.1], jnp.float32))


@pytest.fixture(scope="module")
def energy():
    return jax.jit(tdf.trajectory_energy)


@pytest.mark.parametrize("pose_norm", POSE_NORMS)
def test_the_energy_is_the_weighted_sum_of_its_terms(energy, current, field, reference, pose_norm):
    weights = tdf.EnergyWeights(correlation=0.7, compensator=0.3, rotation_scale=0.2, pose_norm=pose_norm)
    correlation = tdf.correlation_loss(current, field.origin, reference, 0.2, pose_norm)
    expected = tdf.descriptor_loss(current, field, reference) + 0.7 * correlation + 0.3 * tdf.compensator_loss(current)
    np.testing.assert_allclose(energy(current, field, reference, weights), expected, rtol=1e-5)


def test_the_paper_weighs_the_correlation_by_002_and_rejects_the_compensator():
    assert tdf.EnergyWeights().correlation == 0.02 and tdf.EnergyWeights().compensator == 0


def test_weights_are_traced(energy, current, field, reference):
    energy(current, field, reference, tdf.EnergyWeights())
    with compilations() as compiled:
        energy(current, field, reference, tdf.EnergyWeights(correlation=0.5, compensator=0.1, rotation_scale=1.0))
    assert compiled == []
    slope = jax.jit(jax.grad(tdf.trajectory_energy, argnums=3))(current, field, reference, tdf.EnergyWeights())
    correlation = tdf.correlation_loss(current, field.origin, reference, tdf.EnergyWeights().rotation_scale)
    np.testing.assert_allclose(slope.correlation, correlation, rtol=1e-5)
    np.testing.assert_allclose(slope.compensator, tdf.compensator_loss(current), rtol=1e-5)


@pytest.mark.parametrize("name", ["correlation", "compensator", "rotation_scale"])
@pytest.mark.parametrize("value", [-1, -1e-9, np.inf, np.nan, np.float32(-1)])
def test_bad_weights_are_refused(name, value):
    with pytest.raises(InputError, match=rf"EnergyWeights\(\): {name} is"):
        tdf.EnergyWeights(**{name: value})


def test_an_unknown_norm_is_refused():
    with pytest.raises(InputError, match="'manhattan'; expected one of frobenius, metres_radians"):
        tdf.EnergyWeights(pose_norm="manhattan")


# ---- invariance ----


@pytest.mark.parametrize("seed", range(3))
def test_the_descriptor_loss_is_unchanged_when_all_moves_together(
    golden, golden_reference, precision, seed, quick_compilation
):
    motion, aside = random_poses(seed, 1)[0], np.array([1, 0, 0, 0, 0.3, -0.2, 0.1])
    with enabled(precision):

        def loss(points, wxyz_xyz):
            current = tdf.Trajectory(jnp.asarray(wxyz_xyz, precision))
            return float(descriptor_loss(current, tdf.encode(golden.model, points.astype(precision)), golden_reference))

        points = carried(aside, golden.arrays["point_cloud"][1])
        current = composed(aside, golden_trajectory(golden, precision).wxyz_xyz)
        before = loss(points, current)
        together = loss(carried(motion, points), composed(motion, current))
        apart = loss(carried(motion, points), current)
    assert abs(together - before) < {"float32": 1e-4, "float64": 1e-10}[precision] * before
    assert abs(apart - before) > 0.1 * before  # the loss does tell where the trajectory is


# ---- singular places ----


@pytest.fixture(scope="module", params=POSE_NORMS)
def gradient(request):
    """Energy gradient by either norm, with respect to turns away from rotations, and translations."""
    weights = tdf.EnergyWeights(correlation=0.5, compensator=0.5, pose_norm=request.param)

    def energy(variables, rotations, field, reference):
        turns, t = variables
        R = se3.exp(turns) @ rotations
        losses = jax.vmap(waypoint_loss, in_axes=(0, 0, None, None, 0))
        each = losses(R, t, field, reference.query, reference.descriptors)
        return jnp.mean(each) + pose_energy(R, t, field.origin, reference, weights)

    return jax.jit(jax.grad(energy))


def is_sound(gradient):
    return all(np.isfinite(part).all() and np.linalg.norm(part) > 1e-6 for part in gradient)


@pytest.mark.parametrize(
    "angles",
    [[0, 0, 0, 0], [np.pi, 0, np.pi, np.pi], [1e-20, 1e-6, np.pi - 1e-6, np.pi + 1e-6]],
    ids=["zero", "pi", "near"],
)
def test_gradients_are_finite_at_zero_and_half_turns(gradient, field, reference, angles):
    """The reference is not turned: these are also the turns from it to the trajectory, and between neighbours."""
    unturned = reference.trajectory.wxyz_xyz.at[:, :4].set(jnp.array(IDENTITY))
    reference = dataclasses.replace(reference, trajectory=tdf.Trajectory(unturned))
    turns = jnp.outer(jnp.asarray(angles, jnp.float32), jnp.array([0.6, 0.0, 0.8]))
    t = field.origin + jnp.asarray(random_poses(2, 4)[:, 4:], jnp.float32)
    rotations = jnp.broadcast_to(jnp.eye(3), (4, 3, 3))
    assert is_sound(gradient((turns, t), rotations, field, reference))


def test_gradients_are_finite_at_the_reference(gradient, field, reference):
    """Eq. 3 has a kink where a pose is the reference's, as the last one often is; eq. 6 where two poses are equal."""
    field = dataclasses.replace(field, origin=jnp.zeros(3))  # so that the poses are the reference's to the bit
    R, t = reference.trajectory.rotations, reference.trajectory.translations
    assert is_sound(gradient((jnp.zeros((4, 3)), t), R, field, reference))
    R, t = jnp.broadcast_to(R[:1], R.shape), jnp.broadcast_to(t[:1], t.shape)
    assert is_sound(gradient((jnp.zeros((4, 3)), t), R, field, reference))


def test_gradients_are_finite_for_coincident_points(gradient, small_model, reference):
    """A query point on a point of the cloud, and a cloud of duplicates."""
    points = jnp.asarray(np.tile(random_cloud(3, 20), (2, 1)), jnp.float32)
    field = tdf.encode(small_model, points)
    rotations = jnp.broadcast_to(jnp.eye(3), (4, 3, 3))
    for place in (points[0], field.origin):
        t = jnp.broadcast_to(place - reference.query[0], (4, 3))
        assert is_sound(gradient((jnp.zeros((4, 3)), t), rotations, field, reference))


@pytest.mark.parametrize("pose_norm", POSE_NORMS)
def test_equation_3_is_flat_at_the_reference(reference, pose_norm):
    """The kink's gradient is zero there, so that a pose at its minimum stays."""
    loss = jax.jit(jax.value_and_grad(tdf.correlation_loss), static_argnames="pose_norm")
    value, slope = loss(reference.trajectory, jnp.zeros(3), reference, pose_norm=pose_norm)
    assert value == 0 and not slope.wxyz_xyz.any()
