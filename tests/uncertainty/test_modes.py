"""Modes of several candidates; curvature, covariance and free directions of one pose."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import carried, compilations, composed, random_cloud, random_poses
from scipy.spatial.transform import Rotation

import tdf_jax as tdf
from tdf_jax._internal.errors import InputError
from tdf_jax.energy.losses import waypoint_loss
from tdf_jax.geometry import se3
from tdf_jax.uncertainty import covariance as covariance_module
from tdf_jax.uncertainty.covariance import pose_covariance
from tdf_jax.uncertainty.modes import cluster_poses

BOUNDS = {"angle": np.radians(10), "distance": 0.01}


# ---- clusters ----


BASE = random_poses(0, 1)[0]


def made(*steps, base=BASE):
    """Poses that differ from a base by a rotation about its x, degrees, and a translation along its y, metres."""
    rotations = Rotation.from_quat(base[:4], scalar_first=True) * Rotation.from_rotvec(
        [[np.radians(degrees), 0, 0] for degrees, _ in steps]
    )
    places = carried(base, [[0, metres, 0] for _, metres in steps])
    return np.concatenate([rotations.as_quat(scalar_first=True), places], axis=1)


def members(found):
    return [mode.members.tolist() for mode in found]


def test_candidates_join_modes_by_rising_energy():
    """0, 8 and 16 degrees: the last is near the second but not near the first, which leads."""
    found = cluster_poses(made((16, 0), (8, 0), (0, 0), (90, 0)), np.array([0.4, 0.2, 0.1, 0.3]), **BOUNDS)
    assert members(found) == [[2, 1], [3], [0]]
    assert [mode.energy for mode in found] == [0.1, 0.3, 0.4]
    assert [mode.share for mode in found] == [0.5, 0.25, 0.25]
    np.testing.assert_array_equal(found[0].pose, made((0, 0))[0])
    # Where the middle one leads, it gathers both.
    assert members(cluster_poses(made((16, 0), (8, 0), (0, 0)), np.array([0.4, 0.05, 0.1]), **BOUNDS)) == [[1, 2, 0]]


@pytest.mark.parametrize(("step", "together"), [((9.9, 0.0099), True), ((10.1, 0.0), False), ((0.0, 0.0101), False)])
def test_rotation_and_distance_both_have_to_be_within_their_bounds(step, together):
    found = cluster_poses(made((0, 0), step), np.array([0.1, 0.2]), **BOUNDS)
    assert members(found) == ([[0, 1]] if together else [[0], [1]])


def test_a_quaternion_and_its_opposite_are_one_rotation_and_half_turns_close_up():
    there = made((179, 0), (-179, 0), (-160, 0))
    for signs in ((1, 1, 1), (1, -1, 1), (-1, 1, -3)):  # of any length
        signed = there * np.where(np.arange(7) < 4, np.array(signs)[:, None], 1)
        assert members(cluster_poses(signed, np.array([1.0, 2.0, 3.0]), **BOUNDS)) == [[0, 1], [2]]


def test_candidates_that_are_not_finite_belong_to_no_mode():
    there, energies = made(*[(0, 0)] * 4, (90, 0), (0, 0)), np.array([np.nan, 0.3, np.inf, 0.2, 0.5, 0.1])
    there[5, 6] = np.nan
    found = cluster_poses(there, energies, **BOUNDS)
    assert members(found) == [[3, 1], [4]] and [mode.share for mode in found] == [2 / 3, 1 / 3]
    assert cluster_poses(there[:1], energies[:1]) == []


def test_one_candidate_is_one_mode():
    (mode,) = cluster_poses(made((30, 0)), np.array([0.7]))
    assert mode.members.tolist() == [0] and mode.share == 1 and mode.energy == 0.7


@pytest.fixture(scope="module")
def scattered():
    """Poses about five places, close enough to meet here and there."""
    rng = np.random.default_rng(4)
    centres = random_poses(1, 5, 0.02)
    places = [centres[index % 5] for index in range(40)]
    steps = [(16 * rng.normal(), 0.006 * rng.normal()) for _ in places]
    return np.concatenate([made(step, base=place) for place, step in zip(places, steps)]), rng.permutation(40) / 40


def test_modes_do_not_depend_on_the_order_of_the_candidates(scattered):
    there, energies = scattered
    found = cluster_poses(there, energies)
    assert 5 <= len(found) < 40 and [mode.energy for mode in found] == sorted(mode.energy for mode in found)
    order = np.random.default_rng(5).permutation(40)
    again = cluster_poses(there[order], energies[order])
    assert members(found) == [order[mode.members].tolist() for mode in again]
    assert sorted(sum(members(found), [])) == list(range(40))


def test_modes_are_equivariant_under_rigid_motions(scattered):
    there, energies = scattered
    motion = random_poses(8, 1, 3.0)[0]
    found, moved = cluster_poses(there, energies), cluster_poses(composed(motion, there), energies)
    assert members(found) == members(moved)
    for mode, other in zip(found, moved):
        np.testing.assert_allclose(composed(motion, mode.pose[None])[0, 4:], other.pose[4:], atol=1e-12)


@pytest.mark.parametrize(
    ("there", "energies", "bounds", "message"),
    [
        (np.ones((2, 1, 7)), np.ones(2), {}, r"poses have shape \(2, 1, 7\).*such as result\.picks"),
        (np.ones((2, 7)), np.ones(3), {}, r"poses have shape \(2, 7\) and energies \(3,\)"),
        (np.zeros((2, 7)), np.ones(2), {}, "the quaternion of candidate 0 has length 0"),
        (np.ones((2, 7)), np.ones(2), {"angle": -0.1}, "angle is -0.1"),
        (np.ones((2, 7)), np.ones(2), {"distance": np.nan}, "distance is nan"),
    ],
)
def test_bad_candidates_are_refused(there, energies, bounds, message):
    with pytest.raises(InputError, match=rf"cluster_poses\(\): {message}"):
        cluster_poses(there, energies, **bounds)


# ---- a field whose energy is a quadratic form ----


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Squares:
    """Descriptors that grow with the squares of a point's coordinates, so that the energy of matching zeros is smooth.

    With the points' second moments s_i along the axes, the energy of a move v and a turn w is sum k_i v_i^2 / 3 +
    sum (k_i - k_j) (s_j - s_i) w_k^2 / 3, the second one up to w^4.
    """

    weights: jax.Array

    def descriptors(self, x):
        return self.weights * x**2


EXTENTS = np.array([0.05, 0.03, 0.02])  # of query points, one each way along each axis
R_WORLD_QUERY, OFFSET = Rotation.random(random_state=3).as_matrix(), np.array([0.02, -0.01, 0.03])


def squares(weights):
    """Field, reference, a pose with its query points along the world's axes, and the curvatures of its twists."""
    arms = np.concatenate([np.diag(EXTENTS), -np.diag(EXTENTS)])
    query = jnp.asarray(arms @ R_WORLD_QUERY + OFFSET, jnp.float32)
    pose = se3.pose(jnp.asarray(R_WORLD_QUERY, jnp.float32), jnp.asarray(-R_WORLD_QUERY @ OFFSET, jnp.float32))
    k, s = np.array(weights), EXTENTS**2 / 3
    turns = [2 * (k[i] - k[j]) * (s[j] - s[i]) / 3 for i, j in ((1, 2), (2, 0), (0, 1))]
    reference = tdf.Reference(jnp.zeros((1, 6, 3)), tdf.Trajectory(pose[None]), query)
    return Squares(jnp.asarray(weights, jnp.float32)), reference, pose, np.array([*turns, *2 * k / 3])


def test_a_quadratic_energy_has_its_own_curvature_and_covariance():
    field, reference, pose, expected = squares((1.0, 3.0, 8.0))
    found = pose_covariance(field, reference, pose, scale=2e-6)
    assert found.rotation_scale == pytest.approx(np.sqrt(np.mean(EXTENTS**2)), rel=1e-5)
    np.testing.assert_allclose(found.centre, 0, atol=1e-7)
    size = np.sqrt(np.outer(expected, expected))
    np.testing.assert_allclose(found.curvature / size, np.eye(6), atol=0.02)
    np.testing.assert_allclose(found.covariance * size / (2 * 2e-6), np.eye(6), atol=0.02)
    assert found.free.shape == (0, 6) and found.screws == []


def test_an_energy_that_ignores_one_axis_has_a_free_translation():
    field, reference, pose, expected = squares((0.0, 3.0, 8.0))
    found = pose_covariance(field, reference, pose, scale=2e-6)
    np.testing.assert_allclose(np.abs(found.free), [[0, 0, 0, 1, 0, 0]], atol=2e-3)
    (screw,) = found.screws
    np.testing.assert_allclose(np.abs(screw.direction), [1, 0, 0], atol=2e-3)
    assert abs(screw.pitch) > 100 * found.rotation_scale
    # What is not known has a variance all the same, a radian at the rotation_scale; the others are as before.
    np.testing.assert_allclose(found.covariance[3, 3], found.rotation_scale**2, rtol=0.01)
    np.testing.assert_allclose(
        np.diagonal(found.covariance)[[0, 1, 2, 4, 5]], 2 * 2e-6 / expected[[0, 1, 2, 4, 5]], rtol=0.02
    )


@pytest.mark.parametrize(("weight", "count"), [(0.2, 1), (0.28, 0)])
def test_a_direction_is_free_below_its_share_of_the_stiffest(weight, count):
    """Shares of 0.025 and 0.035; the covariance is the curvature's inverse either way."""
    field, reference, pose, expected = squares((weight, 3.0, 8.0))
    found = pose_covariance(field, reference, pose, scale=2e-6)
    assert found.values[0] == pytest.approx(weight / 8 * float(found.values[-1]), rel=0.02)
    assert len(found.free) == len(found.screws) == count
    np.testing.assert_allclose(np.diagonal(found.covariance), 2 * 2e-6 / expected, rtol=0.02)


def test_under_a_constant_energy_every_direction_is_free():
    field, reference, pose, _ = squares((0.0, 0.0, 0.0))
    found = pose_covariance(field, reference, pose)
    assert found.free.shape == (6, 6)
    np.testing.assert_allclose(found.covariance, np.diag([1.0] * 3 + [found.rotation_scale**2] * 3), atol=1e-6)


def test_a_direction_of_falling_energy_has_negative_curvature_and_is_free():
    """The weights the other way around: the points' longest axis lies where the energy is steepest."""
    field, reference, pose, expected = squares((8.0, 3.0, 1.0))
    found = pose_covariance(field, reference, pose, scale=2e-6)
    assert (expected[:3] < 0).all() and (np.asarray(found.values[:3]) < 0).all()
    np.testing.assert_allclose(found.free[:, 3:], 0, atol=1e-4)
    assert found.free.shape == (3, 6) and all(abs(screw.pitch) < 1e-4 for screw in found.screws)
    assert np.linalg.eigvalsh(found.covariance).min() > 0


@pytest.mark.parametrize(
    ("twist", "direction", "point", "pitch"),
    [
        # a turn about an axis 0.1 m away along -x, see the test
        ((0, 0, 2, 0, -0.2, 0), (0, 0, 1), (0.2, 0.3, 0.1), 0),
        ((0, 0, 2, 0, -0.2, 0.5), (0, 0, 1), (0.2, 0.3, 0.1), 0.25),
        ((0, 0, 0, 0, 0.6, 0.8), (0, 0.6, 0.8), (0.1, 0.3, 0.1), np.inf),
    ],
)
def test_a_twist_is_a_screw_motion(twist, direction, point, pitch):
    centre = np.array([0.1, 0.3, 0.1])
    screw = covariance_module._screw(np.array(twist, float), centre, 0.03)
    np.testing.assert_allclose(screw.direction, direction, atol=1e-12)
    np.testing.assert_allclose(screw.point, point, atol=1e-12)
    assert screw.pitch == pytest.approx(pitch)
    if np.isfinite(pitch):  # the twist moves the centre as the motion about the axis does
        turn = 2 * screw.direction
        np.testing.assert_allclose(np.cross(turn, centre - screw.point) + pitch * turn, twist[3:], atol=1e-12)


def test_a_twist_without_pitch_rotates_about_its_axis_at_any_angle():
    rng = np.random.default_rng(0)
    axis, point, centre = rng.normal(size=3), rng.normal(size=3), rng.normal(size=3)
    axis *= 2.5 / np.linalg.norm(axis)
    for share in (1e-6, 0.01, 1.0):
        turn = share * axis
        R, moved = covariance_module._screw_motion(
            jnp.eye(3), jnp.asarray(turn, jnp.float32), jnp.asarray(np.cross(turn, centre - point), jnp.float32)
        )
        expected = Rotation.from_rotvec(turn)
        np.testing.assert_allclose(R, expected.as_matrix(), atol=1e-6)
        np.testing.assert_allclose(moved, expected.apply(centre - point) + point - centre, atol=2e-6)


# ---- a network ----


@pytest.fixture(scope="module")
def shown(small_model, demonstration):
    """The demonstration's own field, where its poses match exactly."""
    return tdf.encode(small_model, demonstration.points)


def test_one_sigma_along_the_axes_raises_the_energy_by_the_scale(shown, reference, demonstration):
    """At an exact match the energy is a cone: second derivatives would not tell."""
    pose, scale = demonstration.trajectory.wxyz_xyz[3], 2e-6
    found = pose_covariance(shown, reference, pose, 3, scale=scale)
    sigma = np.sqrt(2 * scale / np.asarray(found.values))
    assert sigma.max() < np.radians(15) * found.rotation_scale and sigma.max() > 10 * sigma.min()
    R, middle = se3.rotation(pose), jnp.mean(reference.query, axis=0)

    def energy(twist):
        """By turning about the centre in the world, then moving: not as screws, which differs by little here."""
        turned = se3.exp(twist[:3]) @ R
        return waypoint_loss(
            turned, found.centre + twist[3:] - turned @ middle, shown, reference.query, reference.descriptors[3]
        )

    steps = jnp.asarray(sigma[:, None] * np.asarray(found.directions), jnp.float32)
    energies = jax.jit(jax.vmap(energy))
    rises = [energies(sign * steps) - energies(jnp.zeros((1, 6))) for sign in (1, -1)]
    np.testing.assert_allclose(np.mean(rises, axis=0), scale, rtol=0.05)
    # The three descriptions of the ellipsoid are of the same one.
    directions, values = (np.asarray(part, np.float64) for part in (found.directions, found.values))
    np.testing.assert_allclose(directions @ found.curvature @ directions.T, np.diag(values), atol=1e-4 * values[-1])
    measured = directions * np.repeat([found.rotation_scale**2, 1], 3)
    np.testing.assert_allclose(
        measured @ found.covariance @ measured.T, np.diag(sigma**2), atol=1e-4 * sigma.max() ** 2
    )
    np.testing.assert_allclose(measured @ directions.T, np.eye(6), atol=1e-5)


def test_the_covariance_is_equivariant_under_rigid_motions(small_model, field, reference, demonstration):
    motion = random_poses(6, 1, 0.5)[0]
    R = np.kron(np.eye(2), Rotation.from_quat(motion[:4], scalar_first=True).as_matrix())
    pose = np.asarray(demonstration.trajectory.wxyz_xyz[2], np.float64)
    moved = tdf.encode(small_model, jnp.asarray(carried(motion, random_cloud(3)), jnp.float32))
    here = pose_covariance(field, reference, pose, 2)
    there = pose_covariance(moved, reference, composed(motion, pose[None])[0], 2)
    np.testing.assert_allclose(there.centre, carried(motion, here.centre), atol=1e-5)
    for name in ("curvature", "covariance"):
        expected = R @ getattr(here, name) @ R.T
        units = np.sqrt(np.outer(*[np.repeat([np.trace(expected[:3, :3]), np.trace(expected[3:, 3:])], 3)] * 2))
        np.testing.assert_allclose(getattr(there, name) / np.abs(units), expected / np.abs(units), atol=0.02)


def test_each_waypoint_has_its_own_and_the_last_can_be_counted_from_the_end(shown, reference, demonstration):
    T_world_query = demonstration.trajectory.wxyz_xyz
    found = [pose_covariance(shown, reference, T_world_query[index], index) for index in (0, 3, -1)]
    alone = dataclasses.replace(reference, descriptors=reference.descriptors[3:])
    np.testing.assert_array_equal(found[1].curvature, found[2].curvature)
    np.testing.assert_allclose(found[1].curvature, pose_covariance(shown, alone, T_world_query[3]).curvature)
    assert np.abs(found[0].curvature - found[1].curvature).max() > 0.1 * np.abs(found[1].curvature).max()


def test_many_poses_by_vmap_are_those_one_by_one(shown, reference, demonstration):
    T_world_query = demonstration.trajectory.wxyz_xyz[:2]
    many = jax.vmap(lambda pose: pose_covariance(shown, reference, pose, 1))(T_world_query)
    for index, pose in enumerate(T_world_query):
        one = pose_covariance(shown, reference, pose, 1)
        np.testing.assert_allclose(many.values[index], one.values, atol=2e-2 * np.abs(one.values).max())


def test_waypoints_poses_and_scales_share_one_program(shown, reference, demonstration):
    T_world_query = demonstration.trajectory.wxyz_xyz
    pose_covariance(shown, reference, T_world_query[0])
    with compilations() as compiled:
        pose_covariance(shown, reference, T_world_query[1], 1, scale=3e-4)
    assert "jit(_covariance)" not in compiled


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"pose": np.ones((2, 7))}, r"pose has shape \(2, 7\).*jax.vmap"),
        ({"pose": np.zeros(7)}, "pose has a quaternion of norm 0"),
        ({"pose": np.full(7, np.nan)}, "pose is"),
        ({"waypoint": 4}, "waypoint is 4; expected a whole number from -4 to 3"),
        ({"waypoint": 1.0}, "waypoint is 1.0"),
        ({"scale": 0.0}, "scale is 0.0"),
        ({"scale": np.inf}, "scale is inf"),
    ],
)
def test_bad_settings_are_refused(shown, reference, settings, message):
    with pytest.raises(InputError, match=rf"pose_covariance\(\): {message}"), jax.debug_nans(False):
        pose_covariance(shown, reference, **{"pose": random_poses(0, 1)[0], **settings})


def test_coinciding_query_points_are_refused(shown, reference):
    one = dataclasses.replace(reference, query=jnp.ones((8, 3)))
    with pytest.raises(InputError, match="all query points coincide"):
        pose_covariance(shown, one, random_poses(0, 1)[0])


# ---- the shipped network ----

T_WORLD_OBJECT = random_poses(11, 1, 0.2)[0]
QUERIES = 64


def cup(seed, bottom, top, height=0.1, folds=8):
    """256 points of an open cup: 32 random points on an eighth of it, rotated about z.

    Distances are equal only by symmetry, so the neighbours, and with them the field, have the symmetry.
    """
    rng = np.random.default_rng(seed)
    up, part = rng.uniform(size=32), rng.choice(3, 32, p=[0.45, 0.4, 0.15])  # outside, inside, floor
    radius = np.choose(part, [bottom + (top - bottom) * up, bottom + (top - bottom) * up - 0.004, bottom * np.sqrt(up)])
    z = np.where(part == 2, 0.0, up * height) - height / 2
    angle = rng.uniform(0, 2 * np.pi / folds, 32) + 2 * np.pi / folds * np.arange(folds)[:, None]
    return np.stack([radius * np.cos(angle), radius * np.sin(angle), np.broadcast_to(z, angle.shape)], axis=-1).reshape(
        -1, 3
    )


@pytest.fixture(scope="module")
def mug_model():
    return tdf.load_model("mug")


@pytest.fixture(scope="module")
def query():
    return tdf.box_query(jax.random.key(5), QUERIES, 0.06)


def transferred(model, query, points_a, points_b, place):
    """A place shown on one object and found on another, which lies elsewhere: the covariance there."""
    field = tdf.encode(model, points_a.astype(np.float32))
    shown = tdf.Trajectory(
        se3.pose(jnp.asarray(place[:3, :3], jnp.float32), jnp.asarray(place[:3, 3], jnp.float32))[None]
    )
    reference = tdf.Reference(tdf.trajectory_descriptor(field, shown, query), shown.shifted(-field.origin), query)
    moved = tdf.encode(model, carried(T_WORLD_OBJECT, points_b).astype(np.float32))
    config = tdf.SolveConfig(num_starts=32, num_candidates=2)
    result = tdf.solve(
        moved, reference, jax.random.key(1), fix_last=False, energy=tdf.EnergyWeights(0.0), config=config
    )
    return pose_covariance(moved, reference, result.trajectory.wxyz_xyz[0])


def at(*place):
    return np.block([[np.eye(3), np.array(place)[:, None]], [np.zeros(3), 1]])


@pytest.mark.slow
@pytest.mark.parametrize("place", [at(-0.04, 0, 0.05), at(0.06, 0, 0), at(0, 0, 0.05)], ids=["rim", "side", "axis"])
def test_a_cup_without_a_handle_has_a_free_rotation_about_its_axis(mug_model, query, place, quick_compilation):
    found = transferred(mug_model, query, cup(0, 0.040, 0.045), cup(1, 0.038, 0.043), place)
    assert (
        found.values[0] < 0.005 * found.values[-1] and found.values[1] > 2 * covariance_module.FREE * found.values[-1]
    )
    (screw,) = found.screws
    turn = Rotation.from_quat(T_WORLD_OBJECT[:4], scalar_first=True)
    direction, point = turn.inv().apply(screw.direction), turn.inv().apply(screw.point - T_WORLD_OBJECT[4:])
    assert np.degrees(np.arccos(min(1, abs(direction[2])))) < 3
    assert np.linalg.norm(point[:2]) < 0.003 and abs(screw.pitch) < 0.001


@pytest.mark.slow
def test_a_mug_with_a_handle_has_no_free_direction(mug_model, query, quick_compilation):
    a, b = tdf.build_mug(), tdf.build_mug(tdf.sample_mug(np.random.default_rng(77)))
    clouds = (np.asarray(tdf.sample_surface(one.mesh, 1500, 0)) for one in (a, b))
    found = transferred(mug_model, query, *clouds, a.handle_frame)
    assert len(found.free) == 0 and found.values[0] > 1.5 * covariance_module.FREE * found.values[-1]
    turn = Rotation.from_quat(T_WORLD_OBJECT[:4], scalar_first=True)
    assert np.linalg.norm(found.centre - carried(T_WORLD_OBJECT, b.handle_frame[:3, 3])) < 0.015  # the handle it is
    sigma = np.sqrt(np.diagonal(found.covariance))
    assert np.degrees(sigma[:3]).max() < 10 and sigma[3:].max() < 0.01
    # Along the handle one knows least where one is: that is the object's z.
    covariance = turn.as_matrix().T @ found.covariance[3:, 3:] @ turn.as_matrix()
    assert np.argmax(np.diagonal(covariance)) == 2
