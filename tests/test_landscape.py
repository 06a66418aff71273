"""Energy landscapes: grids, equality with the energy of poses one by one, minimisers."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import compilations, random_cloud, random_poses

import tdf_jax as tdf
from tdf_jax import landscape, poses
from tdf_jax.energy import waypoint_loss
from tdf_jax.errors import InputError
from tdf_jax.landscape import Grid, Landscape, energy_landscape, plane_grid


def test_a_plane_is_a_square_of_points_about_its_middle():
    grid = plane_grid(0.2, 5, origin=(1.0, 2.0, 3.0), axes="xz")
    assert grid.shape == (5, 5)
    assert grid.points.shape == (5, 5, 3)
    np.testing.assert_allclose(grid.points[0, 0], (0.8, 2.0, 2.8))
    np.testing.assert_allclose(grid.points[4, 1], (1.2, 2.0, 2.9))
    np.testing.assert_allclose(grid.points[2, 2], (1.0, 2.0, 3.0))


def test_grids_may_be_lines_and_volumes_along_any_directions():
    tilted = np.array([[0.6, 0.8, 0.0], [-0.8, 0.6, 0.0], [0.0, 0.0, 1.0]])
    volume = Grid(np.array([1.0, 0.0, 0.0]), tilted, (np.array([0.0, 1.0]), np.array([0.0, 2.0, 3.0]), np.array([5.0])))
    assert volume.points.shape == (2, 3, 1, 3)
    np.testing.assert_allclose(volume.points[1, 2, 0], (1 + 0.6 - 2.4, 0.8 + 1.8, 5.0))


@pytest.mark.parametrize("turned", [False, True])
def test_energies_equal_those_of_single_poses(field, reference, turned, monkeypatch):
    monkeypatch.setattr(landscape, "CHUNK_POINTS", 40)  # 8 query points: five grid points at a time, a last chunk of four
    R = poses.rotation(jnp.asarray(random_poses(5, 1)[0], jnp.float32)) if turned else jnp.eye(3)
    grid = Grid(np.asarray(field.origin), np.eye(3)[:2], (np.linspace(-0.1, 0.1, 4), np.linspace(-0.2, 0.1, 6)))
    swept = energy_landscape(field, reference, grid, R if turned else None)
    assert swept.values.shape == (4, 4, 6)
    for waypoint, row, column in [(0, 0, 0), (1, 3, 5), (2, 1, 2), (3, 2, 4)]:
        t = jnp.asarray(grid.points[row, column], jnp.float32)
        expected = waypoint_loss(R, t, field, reference.query, reference.descriptors[waypoint])
        np.testing.assert_allclose(swept.values[waypoint, row, column], expected, rtol=1e-5)


def test_the_demonstrations_own_waypoints_are_the_minimisers(small_model):
    """On the object of the demonstration itself, each waypoint's energy is zero at its place."""
    grid = plane_grid(0.3, 7)
    places = [(2, 5), (3, 3), (6, 1)]
    path = jnp.asarray([[1, 0, 0, 0, *grid.points[place]] for place in places], jnp.float32)
    query = tdf.box_query(jax.random.key(2), count=8, size=0.05)
    demonstration = tdf.Demonstration(jnp.asarray(random_cloud(0), jnp.float32), tdf.Trajectory(path), query)
    swept = energy_landscape(tdf.encode(small_model, demonstration.points), tdf.describe(small_model, demonstration), grid)
    np.testing.assert_allclose(swept.minimisers, path[:, 4:], atol=1e-6)
    for waypoint, place in enumerate(places):
        assert swept.values[waypoint][place] < 1e-6
        assert swept.least[place] < 1e-6
    assert np.median(swept.least) > 1e-4


def test_the_least_is_over_waypoints():
    values = np.arange(8.0).reshape(2, 2, 2)[::-1]
    np.testing.assert_array_equal(Landscape(plane_grid(1.0, 2), values).least, [[0, 1], [2, 3]])
    np.testing.assert_array_equal(Landscape(plane_grid(1.0, 2), values).mean, [[2, 3], [4, 5]])


def test_another_grid_of_one_size_compiles_nothing(field, reference):
    energy_landscape(field, reference, plane_grid(0.2, 3))
    with compilations() as names:
        energy_landscape(field, reference, plane_grid(0.4, 3, origin=(0.1, 0.0, 0.0), axes="yz"))
    assert names == []


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ({"half": 0.0}, "half is 0.0"),
        ({"half": float("nan")}, "half is nan"),
        ({"half": 1.0, "count": 1}, "count is 1"),
        ({"half": 1.0, "count": 2.5}, "count is 2.5"),
        ({"half": 1.0, "axes": "zx"}, "axes is 'zx'"),
        ({"half": 1.0, "origin": (0.0, 1.0)}, "origin is"),
    ],
)
def test_grids_that_make_no_sense_are_refused(arguments, words):
    with pytest.raises(InputError, match=words):
        plane_grid(**arguments)


def test_what_does_not_fit_is_refused(field, reference):
    with pytest.raises(InputError, match=r"rotation has shape \(7,\)"):
        energy_landscape(field, reference, plane_grid(0.2, 3), jnp.zeros(7))
    other = dataclasses.replace(reference, descriptors=reference.descriptors[..., :5])
    with pytest.raises(InputError, match="same model"):
        energy_landscape(field, other, plane_grid(0.2, 3))
