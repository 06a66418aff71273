"""Sweeps: equality with the energy of poses one by one, rotations, masks, parts."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import compilations, random_cloud, random_poses, trajectory_energy

import tdf_jax as tdf
from tdf_jax._internal.errors import InputError
from tdf_jax.energy.losses import waypoint_loss
from tdf_jax.geometry import se3
from tdf_jax.geometry.grid import Grid, path_grid, plane_grid, volume_grid
from tdf_jax.landscape import shared_lattice
from tdf_jax.landscape.energy_grid import blank, energy_landscape, fill, query_change

SLOW = pytest.mark.slow
RANDOM = np.asarray(se3.rotation(jnp.asarray(random_poses(5, 3), jnp.float32)))


def one_by_one(field, reference, grid, R, index):
    """Every waypoint's energy at a grid point: that of a trajectory of one pose, without the correlation term."""
    at = tdf.Trajectory(se3.pose(jnp.asarray(R, jnp.float32), jnp.asarray(grid.points[index], jnp.float32))[None])
    alone = [dataclasses.replace(reference, descriptors=one[None], trajectory=at) for one in reference.descriptors]
    return np.array([trajectory_energy(at, field, one, tdf.EnergyWeights(0.0)) for one in alone])


def check(field, reference, landscape, R, indices, values=None):
    values = landscape.values if values is None else values
    for index in indices:
        np.testing.assert_allclose(values[:, *index], one_by_one(field, reference, landscape.grid, R, index), rtol=1e-5)


@pytest.fixture(scope="module")
def lattice_reference(small_model, demonstration):
    """The demonstration with a lattice of 2 x 3 x 2 query points, 12 mm apart."""
    return tdf.describe(small_model, dataclasses.replace(demonstration, query=tdf.lattice_query((2, 3, 2), 0.012)))


@pytest.fixture
def small_tiles(monkeypatch):
    """Small limits, so that small grids have several tiles and chunks, and the last block of channels is padded."""
    for name, value in {"NODES": 60, "CHUNK_POINTS": 40, "UNROLLED": 5}.items():
        monkeypatch.setattr(shared_lattice, name, value)


@pytest.mark.parametrize("R", [None, pytest.param(RANDOM[0], marks=SLOW)], ids=["upright", "rotated"])
def test_energies_equal_those_of_single_poses(field, reference, R, small_tiles):
    grid = Grid(np.asarray(field.origin), np.eye(3)[:2], (np.linspace(-0.1, 0.1, 4), np.linspace(-0.2, 0.1, 11)))
    landscape = energy_landscape(field, reference, grid, R)
    assert landscape.values.shape == (4, 4, 11)
    check(field, reference, landscape, np.eye(3) if R is None else R, [(0, 0), (3, 10), (1, 2), (2, 8)])


@pytest.mark.parametrize("axes", ["plane", pytest.param("volume", marks=SLOW), pytest.param("line", marks=SLOW)])
@pytest.mark.parametrize("R", [pytest.param(np.eye(3), marks=SLOW), RANDOM[1]], ids=["upright", "rotated"])
def test_shared_energies_equal_those_of_single_poses(field, lattice_reference, axes, R, small_tiles):
    count = {"line": 1, "plane": 2, "volume": 3}[axes]
    coordinates = tuple(0.012 * np.arange(-2, size) for size in (4, 3, 7)[:count])
    grid = Grid(np.asarray(field.origin) + 0.05, R.T[:count].astype(float), coordinates)
    layers = shared_lattice.layers(grid, np.asarray(lattice_reference.query) @ R.T)
    assert len(layers.offsets) == {"line": 6, "plane": 2, "volume": 1}[axes]
    landscape = energy_landscape(field, lattice_reference, grid, R)
    corner = tuple(size - 1 for size in grid.shape)
    check(field, lattice_reference, landscape, R, [(0,) * count, corner, (1, 3, 5)[:count], (4, 0, 8)[:count]])


def test_sharing_changes_nothing(field, lattice_reference, small_tiles):
    grid = volume_grid(0.03, 6, np.asarray(field.origin))
    shared, alone = (energy_landscape(field, lattice_reference, grid, share=share).values for share in (True, False))
    np.testing.assert_allclose(shared, alone, rtol=1e-5)


def test_each_point_and_waypoint_has_the_best_of_several_rotations(field, reference, small_tiles):
    grid = plane_grid(0.1, 4, np.asarray(field.origin))
    best = energy_landscape(field, reference, grid, RANDOM)
    each = energy_landscape(field, reference, grid, RANDOM, over_rotations="each")
    assert each.values.shape == (4, 3, 4, 4)
    assert each.turned is None
    for rotation, R in enumerate(RANDOM):
        check(field, reference, each, R, [(1, 2)], values=each.values[:, rotation])
    np.testing.assert_array_equal(best.values, each.values.min(axis=1))
    np.testing.assert_array_equal(best.turned, each.values.argmin(axis=1))
    assert len(np.unique(best.turned)) > 1
    np.testing.assert_array_equal(best.minimisers, each.minimisers)
    np.testing.assert_array_equal(best.minimiser_rotations, each.minimiser_rotations)
    for waypoint, (x, R) in enumerate(zip(best.minimisers, best.minimiser_rotations)):
        found = waypoint_loss(
            jnp.asarray(R, jnp.float32),
            jnp.asarray(x, jnp.float32),
            field,
            reference.query,
            reference.descriptors[waypoint],
        )
        np.testing.assert_allclose(found, best.values[waypoint].min(), rtol=1e-5)


@pytest.mark.slow
def test_points_outside_the_mask_are_nan(field, reference, small_tiles):
    grid = path_grid(np.asarray(field.origin) + np.array([[0.0, 0, 0], [0.1, 0.1, 0]]), 0.03, 0.015)
    landscape = energy_landscape(field, reference, grid)
    np.testing.assert_array_equal(np.isnan(landscape.values), np.broadcast_to(~grid.mask, landscape.values.shape))
    whole = energy_landscape(field, reference, dataclasses.replace(grid, mask=None))
    np.testing.assert_array_equal(landscape.values[:, grid.mask], whole.values[:, grid.mask])
    inside = [tuple(np.argwhere(grid.mask)[k]) for k in (0, 20, -1)]
    check(field, reference, landscape, np.eye(3), inside)
    nodes = {tuple(np.round(x, 6)) for x in grid.points[grid.mask]}
    assert all(tuple(np.round(x, 6)) in nodes for x in landscape.minimisers)


def test_the_demonstrations_own_waypoints_are_the_minimisers(small_model):
    """On the object of the demonstration itself, each waypoint has zero energy at its own position."""
    grid = plane_grid(0.3, 7)
    places = [(2, 5), (3, 3), (6, 1)]
    path = jnp.asarray([[1, 0, 0, 0, *grid.points[place]] for place in places], jnp.float32)
    query = tdf.box_query(jax.random.key(2), count=8, size=0.05)
    demonstration = tdf.Demonstration(jnp.asarray(random_cloud(0), jnp.float32), tdf.Trajectory(path), query)
    landscape = energy_landscape(
        tdf.encode(small_model, demonstration.points), tdf.describe(small_model, demonstration), grid
    )
    np.testing.assert_allclose(landscape.minimisers, path[:, 4:], atol=1e-6)
    np.testing.assert_allclose(landscape.waypoints, path[:, 4:], atol=1e-6)
    for waypoint, place in enumerate(places):
        assert landscape.values[waypoint][place] < 1e-6
        assert landscape.combined[place] < 1e-6
    assert np.median(landscape.combined) > 1e-4


@pytest.mark.parametrize("over_rotations", ["best", "each"])
def test_an_interrupted_sweep_continues(field, reference, over_rotations, small_tiles):
    grid = volume_grid(0.03, 5, np.asarray(field.origin))
    whole = energy_landscape(field, reference, grid, RANDOM, over_rotations=over_rotations)
    landscape = blank(field, reference, grid, RANDOM, over_rotations=over_rotations)
    assert np.isnan(landscape.values).all()
    count = 0
    for stop in (2, 7, 10**6):
        for done, total in fill(landscape, field, reference, count):
            count += 1
            assert done == count <= total
            if done == stop:
                break
    assert count == total > 7
    np.testing.assert_array_equal(landscape.values, whole.values)
    if over_rotations == "best":
        np.testing.assert_array_equal(landscape.turned, whole.turned)


def test_progress_is_reported(field, reference, small_tiles):
    calls = []
    energy_landscape(field, reference, plane_grid(0.1, 12), progress=lambda *both: calls.append(both))
    assert calls == [(done, len(calls)) for done in range(1, len(calls) + 1)]
    assert len(calls) > 1


def test_another_grid_of_one_size_compiles_nothing(field, reference):
    energy_landscape(field, reference, plane_grid(0.2, 3))
    with compilations() as names:
        energy_landscape(field, reference, plane_grid(0.4, 3, origin=(0.1, 0.0, 0.0), axes="yz"))
    assert names == []


@pytest.mark.slow
def test_query_change_measures_the_effect_of_snapping(small_model, demonstration, field, reference):
    grid = volume_grid(0.2, 5, np.asarray(field.origin))
    assert query_change(field, reference, reference, grid) == (0.0, 0.0)
    changes = []
    for pitch in (0.001, 0.03):
        snapped = dataclasses.replace(demonstration, query=tdf.snapped_query(demonstration.query, pitch))
        changes.append(query_change(field, reference, tdf.describe(small_model, snapped), grid, RANDOM[0]))
    assert 0 < changes[0][0] < changes[0][1] < changes[1][1]
    assert changes[0][0] < 0.3 * changes[1][0]
    whole = [
        energy_landscape(field, one, grid, RANDOM[0]).values for one in (reference, tdf.describe(small_model, snapped))
    ]
    true = np.abs(whole[1] / whole[0] - 1)
    sampled = query_change(field, reference, tdf.describe(small_model, snapped), grid, RANDOM[0], samples=2000)
    np.testing.assert_allclose(sampled, (np.median(true), true.max()), rtol=0.05)


def test_bad_arguments_are_refused(field, reference):
    grid = plane_grid(0.2, 3)
    with pytest.raises(InputError, match=r"rotation has shape \(7,\)"):
        energy_landscape(field, reference, grid, jnp.zeros(7))
    for matrix in (2 * np.eye(3), np.diag([1.0, 1.0, -1.0])):
        with pytest.raises(InputError, match="rotation is not orthonormal"):
            energy_landscape(field, reference, grid, matrix)
    with pytest.raises(InputError, match=r"energy_landscape\(\): device_mesh is .*expected a jax.sharding.Mesh"):
        energy_landscape(field, reference, grid, device_mesh=jax.devices())
    with pytest.raises(InputError, match="over_rotations is 'all'"):
        energy_landscape(field, reference, grid, over_rotations="all")
    with pytest.raises(InputError, match=r"energy_landscape\(\): reduce is 'max'"):
        energy_landscape(field, reference, grid, reduce="max")
    other = dataclasses.replace(reference, descriptors=reference.descriptors[..., :5])
    with pytest.raises(InputError, match="same model"):
        energy_landscape(field, other, grid)
