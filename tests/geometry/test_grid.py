"""Grids: where their points are, and what is refused."""

import numpy as np
import pytest

import tdf_jax as tdf
from tdf_jax._internal.errors import InputError
from tdf_jax.geometry.grid import Grid, distance_from_polyline, path_grid, plane_grid, volume_grid

TILTED = np.array([[0.6, 0.8, 0.0], [-0.8, 0.6, 0.0], [0.0, 0.0, 1.0]])


def test_a_plane_is_a_square_of_points_about_its_middle():
    grid = plane_grid(0.2, 5, origin=(1.0, 2.0, 3.0), axes="xz")
    assert grid.shape == (5, 5)
    assert grid.points.shape == (5, 5, 3)
    np.testing.assert_allclose(grid.points[0, 0], (0.8, 2.0, 2.8))
    np.testing.assert_allclose(grid.points[4, 1], (1.2, 2.0, 2.9))
    np.testing.assert_allclose(grid.points[2, 2], (1.0, 2.0, 3.0))
    np.testing.assert_allclose(grid.first, grid.points[0, 0])
    np.testing.assert_allclose(grid.steps, (0.1, 0.1))


def test_a_plane_may_lie_in_any_direction():
    grid = plane_grid(1.0, 3, origin=(1.0, 0.0, 0.0), axes=TILTED[1:])
    np.testing.assert_allclose(grid.points[2, 0], (1 - 0.8, 0.6, -1.0))


def test_a_volume_is_a_cube_of_points_about_its_middle():
    grid = volume_grid(0.3, 4, (0.0, 1.0, 0.0))
    assert grid.shape == (4, 4, 4)
    np.testing.assert_allclose(grid.points[0, 3, 1], (-0.3, 1.3, -0.1), atol=1e-12)
    np.testing.assert_allclose(
        volume_grid(0.3, 4, axes=TILTED).points[3, 0, 0], 0.3 * (TILTED[0] - TILTED[1] - TILTED[2])
    )


def test_grids_may_be_lines_and_volumes_of_unequal_sides():
    volume = Grid(
        np.array([1.0, 0.0, 0.0]), TILTED, (np.array([0.0, 1.0]), np.array([0.0, 2.0, 4.0]), np.array([5.0, 5.5]))
    )
    assert volume.points.shape == (2, 3, 2, 3)
    np.testing.assert_allclose(volume.points[1, 2, 0], (1 + 0.6 - 3.2, 0.8 + 2.4, 5.0))
    line = Grid(np.zeros(3), TILTED[:1], (np.array([1.0, 2.0]),))
    np.testing.assert_allclose(line.points, TILTED[:1] * [[1], [2]])


def test_a_neighbourhood_is_the_points_near_a_path():
    corners = np.array([[0.0, 0, 0], [0.2, 0, 0], [0.2, 0.1, 0]])
    grid = path_grid(corners, 0.05, 0.01)
    np.testing.assert_array_equal(
        grid.mask.ravel(), distance_from_polyline(grid.points.reshape(-1, 3), corners) <= 0.05
    )
    for corner in corners:  # the lattice goes through the first corner, and here through the others
        assert np.abs(grid.points - corner).max(axis=-1).min() < 1e-12
    points = grid.points[grid.mask]
    np.testing.assert_allclose(points.min(axis=0), (-0.05, -0.05, -0.05))  # the grid leaves nothing out
    np.testing.assert_allclose(points.max(axis=0), (0.25, 0.15, 0.05))
    tube = np.pi * 0.05**2 * (0.3 + 0.05 * 4 / 3)  # two cylinders and two half balls, the corner counted roughly
    assert abs(grid.mask.sum() * 0.01**3 / tube - 1) < 0.1


def test_a_neighbourhood_may_have_axes_of_its_own():
    corners = np.array([[0.0, 0, 0], [0.1, 0.2, 0], [0.2, 0.1, 0.1]])
    turned = path_grid(corners @ TILTED, 0.05, 0.02, TILTED)  # the corners' coordinates along the axes are as before
    np.testing.assert_allclose(turned.points @ TILTED.T, path_grid(corners, 0.05, 0.02).points, atol=1e-9)


def test_single_precision_is_even_enough():
    grid = Grid(np.zeros(3), np.eye(3)[:1], (np.linspace(-0.6, 0.6, 101, dtype=np.float32),))
    np.testing.assert_allclose(grid.steps, 0.012, rtol=1e-6)


def test_a_trajectory_has_a_neighbourhood():
    path = tdf.line(3, start=(0, 0, 0), end=(0.3, 0, 0))
    np.testing.assert_array_equal(
        path_grid(path, 0.05, 0.02).mask, path_grid(np.asarray(path.translations), 0.05, 0.02).mask
    )


def test_distances_from_a_polyline():
    corners = np.array([[0.0, 0, 0], [2, 0, 0], [2, 0, 0], [2, 2, 0]])
    points = np.array([[-3.0, 4, 0], [1, -2, 0], [3, 1, 0], [2, 5, 4]])
    np.testing.assert_allclose(distance_from_polyline(points, corners), [5, 2, 1, 5])
    np.testing.assert_allclose(distance_from_polyline(points, corners[:1]), np.linalg.norm(points, axis=1))


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: plane_grid(0.0), "half is 0.0"),
        (lambda: plane_grid(float("nan")), "half is nan"),
        (lambda: plane_grid(1.0, 1), "count is 1"),
        (lambda: plane_grid(1.0, 2.5), "count is 2.5"),
        (lambda: plane_grid(1.0, axes="zx"), "axes is 'zx'"),
        (lambda: plane_grid(1.0, axes=np.eye(3)), r"axes have shape \(3, 3\)"),
        (lambda: plane_grid(1.0, axes=np.ones((2, 3))), "perpendicular unit vectors"),
        (lambda: plane_grid(1.0, origin=(0.0, 1.0)), "origin is"),
        (lambda: volume_grid(-1.0), r"volume_grid\(\): half is -1.0"),
        (lambda: volume_grid(1.0, 1), "count is 1"),
        (lambda: path_grid(np.zeros((2, 3)), 0.1, 0.0), "step is 0.0"),
        (lambda: path_grid(np.zeros((2, 3)), 0.1, 0.2), "step is 0.2 and radius 0.1"),
        (lambda: path_grid(np.zeros((2, 2)), 0.1, 0.1), r"path has shape \(2, 2\)"),
        (lambda: Grid(np.zeros(3), np.eye(3)[:1], (np.array([1.0]),)), "first axis has coordinates of shape"),
        (lambda: Grid(np.zeros(3), np.eye(3)[:2], (np.arange(3), np.zeros(3))), "second axis goes from 0.0 to 0.0"),
        (lambda: Grid(np.zeros(3), np.eye(3)[:1], (np.array([0.0, 1.0, 3.0]),)), "steps of the first axis differ"),
        (lambda: Grid(np.zeros(3), np.eye(3)[:1], (np.array([0.0, np.nan, 2.0]),)), "steps of the first axis differ"),
        (lambda: Grid(np.zeros(3), np.eye(3)[:1], ([0.0, None, 2.0],)), "steps of the first axis differ"),
        (lambda: Grid(np.zeros(3), [[1.0, 0.0, 0.0], [0.0, 1.0]], ([0.0, 1.0],) * 2), "expected real numbers"),
        (lambda: Grid(np.zeros(3), np.eye(3), (np.arange(3),)), "one list for each"),
        (lambda: Grid(np.zeros(3), np.eye(3)[:1], (np.arange(3),), np.ones(2, bool)), r"mask has shape \(2,\)"),
        (lambda: Grid(np.zeros(3), np.eye(3)[:1], (np.arange(3),), np.zeros(3, bool)), "0 points"),
    ],
)
def test_grids_that_make_no_sense_are_refused(make, words):
    with pytest.raises(InputError, match=words):
        make()
