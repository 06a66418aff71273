"""Triangulation: areas by the shoelace formula, and points inside against their winding number."""

import numpy as np
import pytest

from tdf_jax.io.polygons import strip_triangles, triangulate


def star(n, rng):
    """A simple polygon of n corners around the origin, concave in general, from a random corner on."""
    angles = (np.arange(n) + rng.uniform(0, 0.8, n)) * 2 * np.pi / n
    return np.roll(
        rng.uniform(0.2, 1.0, n)[:, None] * np.stack([np.cos(angles), np.sin(angles)], 1), rng.integers(n), 0
    )


def spiral(n):
    """A band along a spiral of two turns: no corner sees more than a few others."""
    t = np.linspace(0.5, 2.5, n // 2) * 2 * np.pi
    inner, outer = (np.stack([(t + w) * np.cos(t), (t + w) * np.sin(t)], axis=1) for w in (0, 2))
    return np.concatenate([outer, inner[::-1]])


def shoelace(flat):
    x, y = flat.T
    return 0.5 * (x @ np.roll(y, -1) - y @ np.roll(x, -1))


def areas(flat, faces):
    a, b, c = flat[faces[:, 0]], flat[faces[:, 1]], flat[faces[:, 2]]
    return 0.5 * ((b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0])


def in_space(flat, rng):
    frame = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    return flat @ frame[:2] + rng.normal(size=3), frame


POLYGONS = {
    **{
        f"star of {n}, {seed}": star(n, np.random.default_rng([n, seed])) for n in (4, 5, 6, 9, 30) for seed in range(4)
    },
    "spiral": spiral(60),
    "square with a hole and a bridge": np.array(
        [[0, 0], [4, 0], [4, 4], [0, 4], [0, 0], [1, 1], [1, 3], [3, 3], [3, 1], [1, 1]], float
    ),
    "corners on an edge": np.array([[0, 0], [1, 0], [2, 0], [2, 1], [2, 2], [1, 1], [0, 2]], float),
    "the same corner twice": np.array([[0, 0], [2, 0], [2, 0], [2, 2], [1, 0.5], [0, 2]], float),
}


@pytest.mark.parametrize("mirrored", [False, True])
@pytest.mark.parametrize("name", POLYGONS)
def test_triangles_of_a_polygon_fill_it_once(name, mirrored):
    flat = POLYGONS[name][:: -1 if mirrored else 1]
    points, frame = in_space(flat, np.random.default_rng(1))
    faces = triangulate(points, np.arange(len(flat)), np.array([len(flat)]))
    assert faces.shape == (len(flat) - 2, 3)
    signed = areas(flat, faces)
    assert (signed * np.sign(shoelace(flat)) >= -1e-12).all()
    assert signed.sum() == pytest.approx(shoelace(flat))


def test_convex_polygons_stay_fans_and_polygons_keep_their_order():
    turn = np.linspace(0, 2 * np.pi, 7)[:-1]
    points = np.stack([np.cos(turn), np.sin(turn), 0 * turn], axis=1)
    corners = np.array([0, 1, 2, 3, 4, 5, 0, 1, 2, 3, 2, 1, 0, 1, 0])
    faces = triangulate(points, corners, np.array([6, 3, 4, 2, 0]))
    np.testing.assert_array_equal(faces, [[0, 1, 2], [0, 2, 3], [0, 3, 4], [0, 4, 5], [0, 1, 2], [3, 2, 1], [3, 1, 0]])


def test_a_concave_quad_is_cut_from_its_reflex_corner():
    arrow = np.array([[0, 0, 0], [1, 1, 0], [0, 2, 0], [3, 1, 0]], float)
    for shift in range(4):
        faces = triangulate(np.roll(arrow, shift, axis=0), np.arange(4), np.array([4]))
        reflex = (1 + shift) % 4
        assert all(reflex in face for face in faces)


def test_a_bent_polygon_is_cut_as_seen_along_its_normal():
    flat = star(9, np.random.default_rng(3))
    points = np.column_stack([flat, 0.1 * np.random.default_rng(4).normal(size=9)])
    assert areas(flat, triangulate(points, np.arange(9), np.array([9]))).sum() == pytest.approx(shoelace(flat))


def test_far_from_the_origin_the_cut_is_the_same():
    flat = star(12, np.random.default_rng(5))
    points = np.column_stack([flat, np.zeros(12)])
    near, far = (triangulate(points + shift, np.arange(12), np.array([12])) for shift in (0, 1e6))
    np.testing.assert_array_equal(near, far)


def test_polygons_without_an_inside_become_fans():
    """One that crosses itself, one without area, and one that is not finite."""
    for points in ([[0, 0, 0], [1, 1, 0], [1, 0, 0], [0, 1, 0]], np.zeros((5, 3)), np.full((5, 3), np.nan)):
        points = np.array(points, float)
        faces = triangulate(points, np.arange(len(points)), np.array([len(points)]))
        assert faces.shape == (len(points) - 2, 3)


def test_corners_outside_are_refused():
    for corner in (-1, 3):
        with pytest.raises(ValueError, match=f"a face has vertex {corner}, counted from 0; there are 3 vertices"):
            triangulate(np.eye(3), np.array([0, 1, corner]), np.array([3]))


def test_strips_keep_one_orientation():
    """A flat strip, triangles counter-clockwise; a vertex twice in a row turns a corner without an area."""
    points = np.array([[0, 0], [0, 1], [1, 0], [1, 1], [2, 0], [2, 1]], float)
    faces = strip_triangles(np.arange(6)[::-1])
    assert faces.shape == (4, 3)
    assert len(set(np.sign(areas(points, faces)))) == 1
    assert len(strip_triangles(np.array([0, 1, 2, 2, 3]))) == 1
    assert strip_triangles(np.array([0, 1])).shape == (0, 3)
