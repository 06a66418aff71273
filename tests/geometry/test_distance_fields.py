"""Signed distances of obstacles against known ones: boxes, meshes, clouds, and a mug as its field knows it."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import trimesh
from conftest import carried, enabled, random_cloud, random_poses

import tdf_jax as tdf
from tdf_jax._internal.errors import InputError
from tdf_jax.geometry import distance_fields, se3
from tdf_jax.geometry.distance_fields import DistanceGrid, box_obstacle, cloud_obstacle, mesh_obstacle
from tdf_jax.planning import occupied
from tdf_jax.planning.occupied import field_obstacle

pytestmark = pytest.mark.usefixtures("quick_compilation")
SIZE = np.array([0.1, 0.2, 0.04])


def box_distance(place, size=SIZE):
    """Signed distances in the box's frame, case by case: to the nearest point outside, to the nearest side inside."""
    nearest = np.clip(place, -size / 2, size / 2)
    inside = (np.abs(place) < size / 2).all(axis=-1)
    return np.where(inside, -(size / 2 - np.abs(place)).min(axis=-1), np.linalg.norm(place - nearest, axis=-1))


def box_mesh(pose=(1, 0, 0, 0, 0, 0, 0), size=SIZE):
    mesh = trimesh.creation.box(size)
    return trimesh.Trimesh(carried(pose, mesh.vertices), mesh.faces, process=False)


_distance = jax.jit(lambda obstacle, x: obstacle.distance(x))
_gradients = jax.jit(jax.grad(lambda obstacle, x: obstacle.distance(x).sum(), argnums=1))


def distance(obstacle, x):
    """In one program, as users have it."""
    return np.asarray(_distance(obstacle, jnp.asarray(x)))


def slopes(obstacle, x, step=1e-6):
    """Central differences of the distance, (points, 3); needs float64."""
    steps = step * np.eye(3)
    return np.stack([(distance(obstacle, x + s) - distance(obstacle, x - s)) / (2 * step) for s in steps], axis=-1)


def gradients(obstacle, x):
    return np.asarray(_gradients(obstacle, jnp.asarray(x)))


# Boxes


def test_distances_to_a_turned_box_are_exact():
    pose, place = random_poses(0, 1)[0], np.random.default_rng(1).uniform(-0.1, 0.1, (500, 3))
    expected = box_distance(place)
    assert (expected < 0).sum() > 10
    R = np.asarray(se3.rotation(jnp.asarray(pose)))
    for rotation in (pose[:4], R):
        box = box_obstacle(pose[4:], SIZE, rotation)
        np.testing.assert_allclose(distance(box, np.float32(carried(pose, place))), expected, atol=1e-6)
    assert jax.eval_shape(box.distance, jnp.zeros((2, 3, 3))).shape == (2, 3)


@pytest.mark.parametrize("of", ["box", "grid"])
def test_gradients_are_those_of_the_distances(of):
    with enabled("float64"):
        box = box_obstacle((0.3, 0.1, 0.0), SIZE, random_poses(0, 1)[0, :4])
        grid = DistanceGrid(
            jnp.array([0.2, 0.0, -0.1]), jnp.array(0.02), jnp.asarray(np.random.default_rng(0).normal(size=(9, 10, 11)))
        )
        x = np.random.default_rng(1).uniform(-0.1, 0.5, (300, 3))
        obstacle = {"box": box, "grid": grid}[of]
        np.testing.assert_allclose(gradients(obstacle, x), slopes(obstacle, x), atol=1e-5, rtol=1e-6)


def test_gradients_are_finite_where_distances_have_kinks():
    """The centre, the middle plane, a side, an edge, a corner; a node, the border of a grid and one of its corners."""
    box = box_obstacle((0, 0, 0), SIZE)
    at = jnp.asarray([[0, 0, 0], [0.01, 0.02, 0], [0.05, 0, 0], [0.05, 0.1, 0], [0.05, 0.1, 0.02], [0.2, 0.1, 0.02]])
    found = gradients(box, at)
    assert np.isfinite(found).all()
    # The middle of a wall pushes out by one of its sides, and a side straight out: a gradient of zero would keep a
    # motion where it is.
    np.testing.assert_allclose(np.abs(found[:3]), [[0, 0, 1], [0, 0, 1], [1, 0, 0]], atol=1e-6)
    grid = DistanceGrid(
        jnp.zeros(3), jnp.array(0.5), jnp.asarray(np.random.default_rng(0).normal(size=(3, 3, 3)), jnp.float32)
    )
    assert np.isfinite(
        gradients(grid, jnp.asarray([[0.5, 0.5, 0.5], [1.0, 0.2, 0.2], [1.0, 1.0, 1.0], [0.0, 0.0, -1.0]]))
    ).all()


# Grids


def test_a_grid_interpolates_and_goes_on_outside():
    values = jnp.asarray(
        np.add.outer(np.add.outer(np.arange(3.0), 10 * np.arange(4.0)), 100 * np.arange(5.0)), jnp.float32
    )
    grid = DistanceGrid(jnp.asarray([1.0, 0, 0]), jnp.asarray(0.1), values)
    inside = np.random.default_rng(0).uniform(0, 1, (50, 3)) * [0.2, 0.3, 0.4]
    np.testing.assert_allclose(
        distance(grid, np.float32(inside + [1, 0, 0])), inside @ [10, 100, 1000], rtol=1e-4, atol=1e-3
    )
    # 3 to one side and 4 to another from the corner (2, 0, 4), whose value is 402.
    np.testing.assert_allclose(distance(grid, np.float32([1.2 + 3, -4, 0.4])), 402 + 5, rtol=1e-6)


def test_a_mesh_is_tabulated_to_a_part_of_the_pitch():
    pose = random_poses(3, 1)[0]
    place = np.random.default_rng(1).uniform(-0.5, 0.5, (4000, 3)) * (SIZE + 0.06)
    expected = box_distance(place)
    for pitch in (0.01, 0.005):
        obstacle = mesh_obstacle(box_mesh(pose), pitch=pitch)
        error = distance(obstacle, np.float32(carried(pose, place))) - expected
        assert np.abs(error).max() < 0.87 * pitch and np.abs(error).mean() < 0.06 * pitch
    far = place + [0.5, 0, 0]
    beyond = distance(obstacle, np.float32(carried(pose, far))) - box_distance(far)
    # never less than true, and nowhere more than the way through the grid
    assert beyond.min() > -1e-5 and beyond.max() < 0.1


def test_an_open_mesh_and_one_inside_out_have_the_sides_they_ought_to():
    mesh = box_mesh(size=np.array([0.1, 0.1, 0.1]))
    x = jnp.asarray([[0.0, 0, 0], [0.03, 0, 0], [0.08, 0, 0]])
    flipped = trimesh.Trimesh(mesh.vertices, mesh.faces[:, ::-1], process=False)
    holed = trimesh.Trimesh(mesh.vertices, mesh.faces[1:], process=False)
    for other in (flipped, holed):
        assert (np.sign(distance(mesh_obstacle(other), x)) == [-1, -1, 1]).all()
    sheet = trimesh.Trimesh([[0, 0, 0], [0.2, 0, 0], [0, 0.2, 0]], [[0, 1, 2]], process=False)
    above = jnp.asarray([[0.05, 0.05, 0.02], [0.05, 0.05, -0.02]])
    np.testing.assert_allclose(distance(mesh_obstacle(sheet), above), 0.02, atol=1e-4)


@pytest.mark.slow
def test_a_cloud_is_a_ball_about_every_point():
    points = random_cloud(0, 60)
    x = points[np.random.default_rng(1).integers(0, 60, 500)] + np.random.default_rng(2).uniform(-0.03, 0.03, (500, 3))
    nearest = np.linalg.norm(x[:, None] - points, axis=-1).min(axis=1)
    error = distance(cloud_obstacle(points, radius=0.004, pitch=0.002, pad=0.03), np.float32(x)) - (nearest - 0.004)
    assert np.abs(error).max() < 0.87 * 0.002 and error.mean() < 2e-4
    assert distance(cloud_obstacle(points), np.float32(points)).max() < 0


# Fields


@pytest.fixture(scope="module")
def mug():
    """An unseen mug in the world, its cloud, and its field by the shipped network."""
    made, moved = tdf.build_mug(tdf.sample_mug(np.random.default_rng(1003))), np.array([0.3, -0.2, 0.1])
    points = np.asarray(tdf.sample_surface(made.mesh, 1500, 3) + moved, np.float32)
    model = tdf.load_model("mug")
    return made, moved, points, tdf.refine(model, tdf.encode(model, points), points)


@pytest.mark.slow
def test_distances_to_a_field_are_those_to_the_mug(mug):
    made, moved, points, field = mug
    import igl

    rng = np.random.default_rng(0)
    x = points[rng.integers(0, len(points), 3000)] + rng.uniform(-0.02, 0.02, (3000, 3))
    away = np.sqrt(
        igl.point_mesh_squared_distance(
            x - moved, np.asarray(made.mesh.vertices), np.asarray(made.mesh.faces, np.int64)
        )[0]
    )
    true = np.where(made.contains(x - moved), -away, away)
    obstacle = field_obstacle(field, points)
    error = np.abs(distance(obstacle, np.float32(x)) - true)
    assert error.mean() < 6e-4 and np.percentile(error, 95) < 2e-3
    # The network knows solid blobs in the air around; they are left out.
    nodes = np.argwhere(np.asarray(obstacle.values) < 0) * float(obstacle.pitch) + np.asarray(obstacle.origin)
    assert np.linalg.norm(nodes[:, None] - points, axis=-1).min(axis=1).max() < 0.01


def test_a_field_without_a_surface_near_the_points_is_refused(field, monkeypatch):
    directions = random_cloud(3, 200) - random_cloud(3, 200).mean(axis=0)
    points = np.float32(0.05 * directions / np.linalg.norm(directions, axis=1, keepdims=True) + [0.3, -0.2, 0.1])
    # a pea in the middle of a hollow ball
    monkeypatch.setattr(
        occupied, "_log_odds", lambda field, x: 0.005 - jnp.linalg.norm(x - points.mean(axis=0), axis=-1)
    )
    with pytest.raises(InputError, match=r"field_obstacle\(\): of \d+ solid pieces none is within 0.015 m"):
        field_obstacle(field, points, pitch=0.005)


# Errors


def test_bad_input_is_refused(field):
    points = random_cloud(3).astype(np.float32)
    for centre, size, rotation, message in (
        ((0, 0), SIZE, None, "centre is"),
        ((0, 0, 0), (1, 0, 1), None, "size is"), ((0, 0, 0), (1, 1), None, "size is"),
        ((0, 0, 0), SIZE, np.ones((3, 3)), "not orthonormal"), ((0, 0, 0), SIZE, np.zeros(4), "quaternion"),
        ((0, 0, 0), SIZE, np.zeros(3), "rotation has shape"),
    ):  # fmt: skip
        with pytest.raises(InputError, match=rf"box_obstacle\(\): .*{message}"):
            box_obstacle(centre, size, rotation)
    cloud = random_cloud(0)
    with pytest.raises(InputError, match="radius is -1"):
        cloud_obstacle(cloud, radius=-1)
    with pytest.raises(InputError, match="expected at least 21"):
        cloud_obstacle(cloud[:3])
    for make in (lambda **bad: cloud_obstacle(cloud, **bad), lambda **bad: field_obstacle(field, points, **bad)):
        for bad in ({"pitch": 0.0}, {"pad": -1.0}, {"pitch": np.nan}):
            with pytest.raises(InputError, match=f"{next(iter(bad))} is .*expected a positive number, metres"):
                make(**bad)
    with pytest.raises(InputError, match="expected at most 4000000 nodes; raise pitch"):
        cloud_obstacle(cloud, pitch=1e-4)
    with pytest.raises(InputError, match="0 faces"):
        mesh_obstacle(trimesh.Trimesh([[0, 0, 0]], np.zeros((0, 3), int), process=False))


def test_every_obstacle_is_a_pytree_that_compiles():
    box = box_obstacle((0, 0, 0), SIZE)
    grid = DistanceGrid(jnp.zeros(3), jnp.array(0.5), jnp.ones((2, 2, 2)))
    for obstacle, expected in ((box, box_distance(np.array([[0.3, 0.2, 0.1]]))), (grid, 1.0)):
        assert isinstance(obstacle, distance_fields.Box | distance_fields.DistanceGrid)
        leaves, tree = jax.tree.flatten(obstacle)
        again, x = jax.tree.unflatten(tree, leaves), np.float32([[0.3, 0.2, 0.1]])
        np.testing.assert_allclose(distance(again, x), expected, rtol=1e-6)
