"""Shared evaluations: layers of query points, tiles of a grid, and the number of evaluations."""

import numpy as np
import pytest

import tdf_jax as tdf
from tdf_jax.geometry.grid import Grid, path_grid, plane_grid, volume_grid
from tdf_jax.landscape import shared_lattice

TILTED = np.array([[np.cos(0.5), np.sin(0.5), 0.0], [-np.sin(0.5), np.cos(0.5), 0.0], [0.0, 0.0, 1.0]])


def positions(grid, layers, index):
    """Positions of the query points with the query frame at a grid point, from the layers, in the query's order."""
    axes = grid.steps[:, None] * grid.directions
    points = np.empty((len(layers.order), 3))
    for base, begin, end in zip(layers.offsets, layers.first, layers.first[1:]):
        points[layers.order[begin:end]] = grid.first + np.asarray(index) @ axes + base + layers.shifts[begin:end] @ axes
    return points


@pytest.mark.parametrize("share", [True, False])
@pytest.mark.parametrize(
    "grid", [plane_grid(0.06, 11), plane_grid(0.06, 11, axes=TILTED[:2]), volume_grid(0.03, 6), plane_grid(0.05, 8)]
)
def test_layers_give_the_position_of_every_query_point(grid, share):
    rng = np.random.default_rng(0)
    offsets = np.concatenate([tdf.lattice_query((2, 3, 2), 0.012), rng.normal(size=(5, 3)) * 0.03])
    layers = shared_lattice.layers(grid, offsets, share)
    assert sorted(layers.order) == list(range(17))
    index = (3, 1, 2)[: len(grid.shape)]
    np.testing.assert_allclose(positions(grid, layers, index), grid.points[index] + offsets, atol=1e-7)
    assert layers.shifts.min() == 0


def test_a_lattice_forms_a_layer_for_each_height_above_a_plane():
    query = np.asarray(tdf.lattice_query((6, 6, 7), 0.012))  # an even number: its nodes are half a step off the middle
    layers = shared_lattice.layers(plane_grid(0.6, 101), query)
    assert len(layers.offsets) == 7
    np.testing.assert_array_equal(np.diff(layers.first), 36)
    assert layers.span == (5, 5)
    volume = shared_lattice.layers(volume_grid(0.06, 11), query)
    assert len(volume.offsets) == 1
    assert volume.span == (5, 5, 6)


def test_a_lattice_of_half_the_pitch_forms_layers_that_interlock():
    layers = shared_lattice.layers(volume_grid(0.06, 11), np.asarray(tdf.lattice_query((4, 4, 4), 0.006)))
    assert len(layers.offsets) == 8
    np.testing.assert_array_equal(np.diff(layers.first), 8)


def test_a_rotated_lattice_shares_if_the_grid_is_rotated_with_it():
    query = np.asarray(tdf.lattice_query((3, 3, 2), 0.012)) @ TILTED
    assert len(shared_lattice.layers(plane_grid(0.06, 11, axes=TILTED[:2]), query).offsets) == 2
    assert len(shared_lattice.layers(plane_grid(0.06, 11), query).offsets) == 18


def test_points_nearly_on_the_lattice_do_not_share():
    """A hundredth of a step, 0.1 mm, is more than the tolerance."""
    query = np.asarray(tdf.lattice_query((2, 2, 1), 0.012), float)
    query[0, 0] += 1e-4
    assert len(shared_lattice.layers(plane_grid(0.06, 11), query).offsets) == 2
    query[0, 0] -= 1e-4 - 1e-8  # the rounding of float32 is less
    assert len(shared_lattice.layers(plane_grid(0.06, 11), query).offsets) == 1


def test_a_query_that_spans_far_more_than_a_tile_shares_nothing(monkeypatch):
    monkeypatch.setattr(shared_lattice, "NODES", 1000)
    offsets = np.array([[0.0, 0, 0], [1.2, 1.2, 1.2]])
    layers = shared_lattice.layers(volume_grid(0.06, 11), offsets)
    assert len(layers.offsets) == 2
    assert layers.span == (0, 0, 0)


def test_points_drawn_at_random_share_nothing():
    offsets = np.random.default_rng(0).normal(size=(20, 3))
    layers = shared_lattice.layers(volume_grid(0.06, 11), offsets)
    assert len(layers.offsets) == 20
    assert layers.span == (0, 0, 0)


@pytest.mark.parametrize(
    ("shape", "span"),
    [((101, 101), (5, 5)), ((64, 64, 64), (5, 5, 6)), ((7,), (0,)), ((2, 3, 2000), (0, 0, 3)), ((9, 5), (40, 200))],
)
def test_tiles_cover_a_grid_once(shape, span, monkeypatch):
    monkeypatch.setattr(shared_lattice, "NODES", 3000)
    grid = Grid(np.zeros(3), np.eye(3)[: len(shape)], tuple(np.arange(count) for count in shape))
    covered = np.zeros(shape, int)
    sizes = set()
    for tile in shared_lattice.tiles(grid, span):
        covered[tile.within(shape)] += 1
        sizes.add(tuple(b - a for a, b in zip(tile.start, tile.stop)))
    assert (covered == 1).all()
    (size,) = sizes  # one compiled program
    assert size[-1] % shared_lattice.LANES == 0
    nodes = np.prod(np.add(size, span))
    assert nodes <= 3000 or size == (1,) * (len(shape) - 1) + (shared_lattice.LANES,)


def test_tiles_outside_the_mask_are_omitted(monkeypatch):
    monkeypatch.setattr(shared_lattice, "NODES", 500)
    grid = path_grid(np.array([[0.0, 0, 0], [0.5, 0.5, 0.5]]), 0.03, 0.01)
    tiles = shared_lattice.tiles(grid, (0, 0, 0))
    covered = np.zeros(grid.shape, bool)
    for tile in tiles:
        covered[tile.within(grid.shape)] = True
    assert not (grid.mask & ~covered).any()
    assert covered.mean() < 0.3


def test_a_shared_sweep_evaluates_thirty_times_less():
    """The case of the benchmark: 101 x 101 grid points, 6 x 6 x 7 query points, one pitch."""
    grid, query = plane_grid(0.6, 101), np.asarray(tdf.lattice_query((6, 6, 7), 0.012))
    shared, direct = (
        shared_lattice.evaluations(grid, shared_lattice.layers(grid, query, share)) for share in (True, False)
    )
    assert direct >= 101 * 101 * 252
    assert shared < 101 * 101 * 252 / 29
