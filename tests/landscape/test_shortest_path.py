"""Lowest-cost paths through landscapes."""

import dataclasses

import numpy as np
import pytest

from tdf_jax._internal.errors import InputError
from tdf_jax.geometry.grid import Grid, path_grid, plane_grid, volume_grid
from tdf_jax.landscape.shortest_path import lowest_cost_path
from tdf_jax.landscape.storage import Landscape


def of(grid, energy):
    """A landscape of one waypoint with an energy at every point."""
    values = np.asarray(energy, float)[None]
    return Landscape(grid, values, np.zeros((1, 3)), np.eye(3)[None], np.zeros(values.shape, np.int32))


def length(path):
    return np.linalg.norm(np.diff(path, axis=0), axis=1).sum()


def test_under_a_constant_energy_the_path_is_the_shortest():
    grid = plane_grid(1.0, 21)
    path = lowest_cost_path(of(grid, np.ones(grid.shape)), (-1, -1, 0), (1, 1, 0))
    np.testing.assert_allclose(path, np.linspace((-1, -1, 0), (1, 1, 0), 21), atol=1e-9)
    bent = lowest_cost_path(of(grid, np.ones(grid.shape)), (-1, 0, 0), (1, 0.5, 0))
    np.testing.assert_allclose(length(bent), 0.5 * np.sqrt(2) + 1.5)


def test_a_path_follows_a_valley_and_a_sharper_one_farther():
    grid = plane_grid(1.0, 41)
    x, y = np.moveaxis(grid.points[..., :2], -1, 0)
    valley = 0.002 + 0.01 * np.abs(np.hypot(x, y) - 0.8)  # a ring
    ends = (-0.8, 0, 0), (0.8, 0, 0)
    away = []
    for sharpness in (0.0, 1.0, 3.0):
        path = lowest_cost_path(of(grid, valley), *ends, sharpness)
        np.testing.assert_allclose(path[[0, -1]], ends, atol=1e-9)
        assert (np.linalg.norm(np.diff(path, axis=0), axis=1) <= 0.05 * np.sqrt(2) + 1e-9).all()
        away.append(np.abs(np.linalg.norm(path, axis=1) - 0.8).mean())
    assert away[0] > 0.3
    assert away[2] < 0.03


def test_the_cost_is_the_integral_over_length():
    """Two ways around a wall: the longer one is cheaper by less than its length costs, or by more."""
    grid = Grid(np.zeros(3), np.eye(3)[:2], (np.linspace(0, 0.4, 5), np.linspace(0, 0.2, 3)))
    for toll, row in ((3.0, 2), (1.2, 0)):
        energy = np.full(grid.shape, 1e6)
        energy[:, 0], energy[:, 2], energy[0], energy[-1] = 1.0, 1.0, 1.0, 1.0
        energy[1:-1, 0] = toll
        path = lowest_cost_path(of(grid, energy), (0, 0, 0), (0.4, 0, 0))
        assert path[2, 1] == pytest.approx(0.1 * row)


def test_a_step_costs_the_mean_of_both_ends():
    """The expensive point is next to the goal on one way; each of its two steps costs half of its energy."""
    grid = Grid(np.zeros(3), np.eye(3)[:2], (np.linspace(0, 0.2, 3), np.linspace(0, 0.1, 2)))
    energy = np.array([[1.0, 1.0], [2.4, 1.0], [1.0, 9.0]])  # straight: 2 x 1.7; by (0.1, 0.1), diagonal: 2 x 1.414
    np.testing.assert_allclose(lowest_cost_path(of(grid, energy), (0, 0, 0), (0.2, 0, 0))[1], (0.1, 0.1, 0))
    energy[1, 0] = 1.7  # straight: 2 x 1.35, though entering (0.1, 0) at its own price would cost 1.7 + 1
    np.testing.assert_allclose(lowest_cost_path(of(grid, energy), (0, 0, 0), (0.2, 0, 0))[1], (0.1, 0, 0))
    # leaving counts too: (0.5 + 1.95) / 2 + (1.95 + 1) / 2 against 1.414 x (0.75 + 1)
    energy[1, 0], energy[0, 0] = 1.95, 0.5
    np.testing.assert_allclose(lowest_cost_path(of(grid, energy), (0, 0, 0), (0.2, 0, 0))[1], (0.1, 0.1, 0))


def test_paths_in_volumes_with_unequal_steps_remain_inside_the_mask():
    grid = Grid(np.zeros(3), np.eye(3), (np.linspace(0, 0.3, 4), np.linspace(0, 0.2, 3), np.linspace(0, 0.5, 6)))
    path = lowest_cost_path(of(grid, np.ones(grid.shape)), (0, 0, 0), (0.3, 0, 0.5))
    assert length(path) == pytest.approx(3 * np.sqrt(0.02) + 0.2)
    bent = np.array([[0.0, 0, 0], [0.3, 0, 0], [0.3, 0.3, 0]])
    near = path_grid(bent, 0.05, 0.025)
    energy = np.where(near.mask, 1.0, np.nan)
    around = lowest_cost_path(of(near, energy), bent[0], bent[-1])
    assert length(around) > 0.5  # straight across: 0.42
    assert all(near.mask.ravel()[np.abs(near.points.reshape(-1, 3) - x).sum(axis=1).argmin()] for x in around)


def test_bad_arguments_are_refused():
    grid = volume_grid(0.1, 3)
    whole = of(grid, np.ones(grid.shape))
    with pytest.raises(InputError, match="goal .* lies 0.* m from the nearest point of the grid"):
        lowest_cost_path(whole, (0, 0, 0), (1, 0, 0))
    with pytest.raises(InputError, match="start is"):
        lowest_cost_path(whole, (0, np.nan, 0), (0, 0, 0))
    for sharpness in (-1.0, 51.0, np.nan):
        with pytest.raises(InputError, match="sharpness is"):
            lowest_cost_path(whole, (0, 0, 0), (0, 0, 0.1), sharpness)
    energy = np.ones(grid.shape)
    energy[1] = np.nan
    with pytest.raises(InputError, match="no path inside the grid's mask joins"):
        lowest_cost_path(of(grid, energy), (-0.1, 0, 0), (0.1, 0, 0))
    each = dataclasses.replace(whole, values=whole.values[:, None], turned=None)
    with pytest.raises(InputError, match="every rotation"):
        lowest_cost_path(each, (0, 0, 0), (0, 0, 0.1))
