"""Depth images: rays against triangles by brute force, the table, edges, noise and cameras."""

import numpy as np
import pytest
import trimesh

from tdf_jax.evaluation.depth_images import (
    DISTANCES,
    ELEVATIONS,
    FOVY,
    NOISE,
    NOISE_DISTANCE,
    NOTHING,
    TABLE,
    camera_poses,
    cast,
    depth_image,
)
from tdf_jax.geometry.pinhole import camera_matrix, looking_at

BOX = trimesh.creation.box((0.06, 0.08, 0.1)).apply_translation((0, 0, 0.05))
SMALL = {"width": 320, "height": 240}
CAMERA = looking_at(np.array([0.5, 0.1, 0.4]), np.array([0.0, 0.0, 0.05]))


def brute_force(triangles, K, shape):
    """Depths by Moeller and Trumbore's test of every ray against every triangle."""
    rows, columns = np.mgrid[: shape[0], : shape[1]]
    rays = np.stack([columns.ravel(), rows.ravel(), np.ones(rows.size)], axis=1) @ np.linalg.inv(K).T
    nearest = np.full(rows.size, np.inf)
    for a, b, c in triangles:
        ab, ac = b - a, c - a
        across = np.cross(rays, ac)
        volume = across @ ab
        u = across @ -a / volume
        v = rays @ np.cross(-a, ab) / volume
        depth = ac @ np.cross(-a, ab) / volume
        hit = (u >= 0) & (v >= 0) & (u + v <= 1) & (depth > 0)
        nearest[hit] = np.minimum(nearest[hit], depth[hit])
    return nearest.reshape(shape)


def test_rays_meet_the_nearest_triangle(monkeypatch):
    rng = np.random.default_rng(0)
    triangles = rng.uniform((-0.5, -0.4, 0.8), (0.5, 0.4, 1.5), (30, 3, 3))
    K, shape = camera_matrix(FOVY, 40, 30), (30, 40)
    expected = brute_force(triangles, K, shape)
    assert 0.2 < np.isfinite(expected).mean() < 1
    np.testing.assert_allclose(cast(triangles, K, shape), expected, rtol=1e-9)
    monkeypatch.setattr("tdf_jax.evaluation.depth_images.CHUNK", 500)
    np.testing.assert_allclose(cast(triangles, K, shape), expected, rtol=1e-9)


@pytest.fixture(scope="module")
def clean():
    return depth_image([BOX.triangles], CAMERA, np.random.default_rng(0), noise=0.0, **SMALL)


def world(image):
    rows, columns = np.nonzero(image.depth)
    pixels = np.stack([columns, rows, np.ones(len(rows))], axis=1)
    camera = pixels @ np.linalg.inv(image.K).T * image.depth[rows, columns][:, None]
    T = image.T_world_camera
    return camera @ T[:3, :3].T + T[:3, 3], image.labels[rows, columns]


def test_pixels_are_on_the_table_on_the_mesh_or_between_the_two(clean):
    points, labels = world(clean)
    assert np.abs(points[labels == TABLE, 2]).max() < 1e-4
    assert (clean.labels[clean.depth == 0] == NOTHING).all()
    # Of a box, the distance is the largest excess over its half extents, or inside it the least distance to a side.
    offset = np.abs(points[labels == 1] - [0, 0, 0.05]) - [0.03, 0.04, 0.05]
    on = np.abs(offset.max(axis=1)) < 5e-4
    assert on.mean() > 0.9 and (~on).sum() > 20  # the others lie between two surfaces
    assert offset[~on].max() < 0.3
    assert (labels == 1).sum() > 1000


def test_noise_grows_with_the_depth_squared(clean):
    noisy = depth_image([BOX.triangles], CAMERA, np.random.default_rng(1), **SMALL)
    measured = clean.depth > 0
    np.testing.assert_array_equal(noisy.depth > 0, measured)
    depth, error = clean.depth[measured], (noisy.depth - clean.depth)[measured]
    for part in (depth < np.quantile(depth, 0.3), depth > np.quantile(depth, 0.7)):
        expected = NOISE * np.mean((depth[part] / NOISE_DISTANCE) ** 2)
        assert np.std(error[part]) == pytest.approx(expected, rel=0.1)


def test_what_is_nearer_hides_the_rest():
    wall = trimesh.creation.box((0.01, 0.5, 0.5)).apply_translation((0.1, 0, 0.25))
    image = depth_image([BOX.triangles, wall.triangles], CAMERA, np.random.default_rng(0), noise=0.0, **SMALL)
    assert (image.labels == 2).sum() > 1000 and not (image.labels == 1).any()


def test_cameras_look_at_the_object_from_the_stated_distances_and_elevations():
    target = np.array([0.1, -0.2, 0.06])
    for seed in range(20):
        poses = camera_poses(3, target, np.random.default_rng(seed))
        np.testing.assert_array_equal(poses[:1], camera_poses(1, target, np.random.default_rng(seed)))
        for T in poses:
            np.testing.assert_allclose(T[:3, :3] @ T[:3, :3].T, np.eye(3), atol=1e-12)
            assert np.linalg.det(T[:3, :3]) > 0 and T[2, 1] < 0  # the image's y axis points down
            away = T[:3, 3] - target
            distance = np.linalg.norm(away)
            np.testing.assert_allclose(T[:3, 2], -away / distance, atol=1e-12)
            assert DISTANCES[0] <= distance <= DISTANCES[1]
            assert ELEVATIONS[0] <= np.degrees(np.arcsin(away[2] / distance)) <= ELEVATIONS[1]
        sides = np.arctan2(*(poses[:, :2, 3] - target[:2]).T)
        sides = np.sort(np.degrees(sides).astype(float))
        np.testing.assert_allclose(sides[1:] - sides[:-1], 120, atol=1e-6)
