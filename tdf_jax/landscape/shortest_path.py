"""The lowest-cost path through a landscape's combined energy."""

import itertools

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike
from scipy.sparse import coo_array
from scipy.sparse.csgraph import dijkstra

from tdf_jax._internal import checks
from tdf_jax._internal.boundary import public
from tdf_jax._internal.errors import InputError
from tdf_jax.landscape.storage import Landscape

SHARPEST = 50.0  # energies differ by a factor of about 10, so costs span 50 decades of the 300 of float64


@public
def lowest_cost_path(
    landscape: Landscape, start: ArrayLike, goal: ArrayLike, sharpness: float = 1.0
) -> Float[np.ndarray, "corners 3"]:
    """Compute the path from start to goal that minimises the integral of energy^sharpness over its length.

    The graph of Dijkstra's algorithm (scipy) joins each point of the grid to all its neighbours, also diagonally. A
    step costs its length times the mean of energy^sharpness at its ends. The step of the grid is the resolution, and
    directions are multiples of 45 degrees. Memory grows with the number of points
    (docs/results/code_notes.md#landscapeshortest_path).

    Args:
        landscape: landscape in one orientation, or in the best of several.
        start: start of the path, (3,), metres, world frame; the path begins at the nearest point of the grid.
        goal: end of the path, (3,), metres, world frame; the path ends at the nearest point of the grid.
        sharpness: exponent of the energy, 0 to 50; 0 gives the shortest path, and larger exponents allow longer detours
            through valleys.

    Returns:
        Points of the grid from start to goal, (corners, 3), metres, world frame.

    Raises:
        InputError: the landscape has the energies of every rotation, an end is not a finite point or lies more than a
            step outside the grid, the sharpness is not in 0 to 50, or no path inside the grid's mask joins both ends.
    """
    if not isinstance(landscape, Landscape):
        raise InputError(
            f"lowest_cost_path(): landscape is a {type(landscape).__name__}; expected a Landscape, from "
            "tdf.energy_landscape or tdf.load_landscape"
        )
    if landscape.turned is None:
        raise InputError(
            "lowest_cost_path(): the landscape has the energies of every rotation; expected those of the best, or of "
            "one. Use over_rotations='best'"
        )
    checks.number("lowest_cost_path()", "sharpness", sharpness, least=0, most=SHARPEST)
    grid, energy = landscape.grid, landscape.combined
    points = grid.points.reshape(-1, 3)
    used = np.isfinite(energy)
    ends = [_nearest(name, grid, points, used, end) for name, end in (("start", start), ("goal", goal))]
    # The energy is divided by its minimum, because powers of energies near 0.002 would underflow.
    cost = np.where(used, energy / np.nanmin(energy[energy > 0], initial=np.inf), np.inf).astype(float) ** sharpness
    _, before = dijkstra(_graph(grid, cost, used), indices=ends[0], return_predecessors=True)
    path = [ends[1]]
    while path[-1] != ends[0]:
        if before[path[-1]] < 0:
            raise InputError(
                "lowest_cost_path(): no path inside the grid's mask joins start and goal; expected both in one "
                "connected part of the grid"
            )
        path.append(before[path[-1]])
    return points[path[::-1]]


def _nearest(name, grid, points, used, end):
    """Index of the grid point nearest to an end of the path."""
    end = np.asarray(checks.vector("lowest_cost_path()", name, end))
    distances = np.where(used.ravel(), np.linalg.norm(points - end, axis=1), np.inf)
    if distances.min() > np.linalg.norm(grid.steps):
        raise InputError(
            f"lowest_cost_path(): {name} {end.tolist()} lies {distances.min():.3f} m from the nearest point of the "
            "grid; expected a point inside the grid"
        )
    return int(distances.argmin())


def _graph(grid, cost, used):
    """Sparse matrix of the costs of steps between neighbours, in both directions."""
    numbers = np.arange(cost.size).reshape(grid.shape)
    rows, columns, costs = [], [], []
    for step in itertools.product((-1, 0, 1), repeat=len(grid.shape)):
        if step <= (0,) * len(step):
            continue  # the other half of the steps are the same ones backwards, and no step at all
        here = tuple(slice(max(-move, 0), size - max(move, 0)) for move, size in zip(step, grid.shape))
        there = tuple(slice(max(move, 0), size - max(-move, 0)) for move, size in zip(step, grid.shape))
        both = used[here] & used[there]
        rows.append(numbers[here][both])
        columns.append(numbers[there][both])
        costs.append(np.linalg.norm(step * grid.steps) * (cost[here][both] + cost[there][both]) / 2)
    rows, columns, costs = map(np.concatenate, (rows, columns, costs))
    both_ways = np.concatenate([rows, columns]), np.concatenate([columns, rows])
    return coo_array((np.tile(costs, 2), both_ways), shape=(cost.size, cost.size)).tocsr()
