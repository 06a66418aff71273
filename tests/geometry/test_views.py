"""Visible points: of clouds by hidden point removal; of meshes, against marching along rays through exact solids."""

import numpy as np
import pytest
import trimesh

from tdf_jax._internal.errors import InputError
from tdf_jax.geometry import views
from tdf_jax.geometry.sampling import sample_surface
from tdf_jax.geometry.views import merge_views, single_view
from tdf_jax.shapes import build_mug, sample_mug


def truly_visible(mug, points, direction):
    """No clay between a point and the camera, at steps finer than any wall."""
    middle, diagonal = mug.mesh.bounds.mean(axis=0), np.linalg.norm(mug.mesh.extents)
    towards = middle + views.DISTANCE * diagonal * direction - points
    towards /= np.linalg.norm(towards, axis=1, keepdims=True)
    hidden = np.zeros(len(points), bool)
    for step in np.concatenate([np.linspace(0.0007, 0.02, 20), np.linspace(0.02, 1.3 * diagonal, 120)]):
        hidden |= mug.contains(points + step * towards)
    return ~hidden


@pytest.mark.parametrize("index", range(2))
def test_a_mug_seen_from_outside(index):
    rng = np.random.default_rng([8, index])
    mug = build_mug(sample_mug(rng))
    points = sample_surface(mug.mesh, 1500, rng)
    directions = views.cameras(6, rng)
    seen = views.visible(mug.mesh, points, directions, rng)
    assert seen.shape == (6, 1500) and seen.dtype == bool
    truth = np.stack([truly_visible(mug, points, direction) for direction in directions[:3]])
    # Of what is said to be seen nearly all is; grazing surfaces are lost, as a depth camera loses them.
    assert np.sum(seen[:3] & truth) > 0.85 * np.sum(seen[:3])
    assert np.sum(seen[:3] & truth) > 0.6 * np.sum(truth)


def test_a_ball_hides_its_far_half():
    ball = trimesh.creation.icosphere(subdivisions=4, radius=0.1)
    points = ball.vertices + [0.3, -0.2, 0.5]
    ball.apply_translation([0.3, -0.2, 0.5])
    directions = views.cameras(8, np.random.default_rng(0))
    seen = views.visible(ball, points, directions, np.random.default_rng(1))
    # The horizon is where the cosine is radius / distance.
    horizon = 0.1 / (views.DISTANCE * np.linalg.norm(ball.extents))
    for row, direction in zip(seen, directions):
        cosine = (points - ball.centroid) @ direction / 0.1
        assert row[cosine < horizon - 0.2].mean() < 0.01  # pixels that the silhouette just touches
        assert row[cosine > 0.6].all()


def test_cameras_are_all_around_and_turned_by_chance():
    first, again, other = (views.cameras(16, np.random.default_rng(seed)) for seed in (0, 0, 1))
    np.testing.assert_array_equal(first, again)
    assert np.abs(first - other).max() > 0.1
    np.testing.assert_allclose(np.linalg.norm(first, axis=1), 1, atol=1e-12)
    nearest = np.sort(first @ first.T, axis=1)[:, -2]
    assert nearest.max() < np.cos(np.radians(20))  # none on top of another
    rng = np.random.default_rng(2).normal(size=(500, 3))
    covered = (rng / np.linalg.norm(rng, axis=1, keepdims=True) @ first.T).max(axis=1)
    assert covered.min() > np.cos(np.radians(45))  # no direction far from all


def sphere(count=600):
    directions = np.random.default_rng(2).normal(size=(count, 3))
    return directions / np.linalg.norm(directions, axis=1, keepdims=True)


def test_a_view_of_a_sphere_is_its_cap():
    """From distance 4 a unit sphere is visible where x > 1/4; a band about the edge is left open."""
    points = sphere()
    seen = single_view(points, np.array([4.0, 0, 0]))
    rows = [np.flatnonzero((points == point).all(axis=1)).item() for point in seen]
    assert rows == sorted(rows)
    visible = np.isin(np.arange(len(points)), rows)
    assert visible[points[:, 0] > 0.5].all()
    assert not visible[points[:, 0] < -0.1].any()
    assert len(single_view(points, np.array([4.0, 0, 0]), reach=1e5)) > len(seen)


def test_views_are_merged_without_repeats():
    points = sphere()
    cameras = 4.0 * np.array([[1, 0, 0], [-1, 0, 0], [0, 1, 0]])
    merged = merge_views(points, cameras)
    union = {tuple(point) for camera in cameras for point in single_view(points, camera)}
    assert len(merged) == len(union)
    assert {tuple(point) for point in merged} == union
    assert merge_views(points.astype(np.float32), cameras).dtype == np.float32


def test_views_refuse_bad_input():
    points = sphere(50)
    with pytest.raises(InputError, match="reach is 1"):
        single_view(points, np.array([4.0, 0, 0]), reach=1)
    with pytest.raises(InputError, match="at one of the points"):
        single_view(points, points[7])
    with pytest.raises(InputError, match="in one plane"):
        single_view(points * [1, 1, 0], np.array([4.0, 0, 0]))
    for bad_points, cameras in [(points[:, :2], np.eye(3)), (points, np.eye(2)), (points, np.zeros((0, 3)))]:
        with pytest.raises(InputError, match="(points|cameras) has shape"):
            merge_views(bad_points, cameras)
