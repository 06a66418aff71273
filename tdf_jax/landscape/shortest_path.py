"""The lowest-cost path through a landscape's combined energy."""

import itertools

import numpy as np
from jaxtyping import Float
from scipy.sparse import coo_array
from scipy.sparse.csgraph import dijkstra

from tdf_jax._internal.errors import InputError
from tdf_jax.landscape.storage import Landscape

SHARPEST = 50.0  # energies differ by a factor of 10 or so: costs then span as many decades, and float64 holds 300


def lowest_cost_path(
    landscape: Landscape, start: Float[np.ndarray, "3"], goal: Float[np.ndarray, "3"], sharpness: float = 1.0
) -> Float[np.ndarray, "corners 3"]:
    """The path from start to goal along which the integral of energy^sharpness over length is least.

    Dijkstra's algorithm (scipy) over the points that count, each joined to all its neighbours, diagonal ones included;
    a step costs its length times the mean of both ends' energy^sharpness. Memory grows with the points: by estimate 1
    kB each. A step of the grid is the resolution, and directions are multiples of 45 degrees.

    Args:
        landscape: in one orientation, or the best of several.
        start, goal: metres, world frame; the path goes between the grid's points nearest to them.
        sharpness: 0 to 50; 0 gives the shortest path; the larger, the more of a detour a valley is worth.

    Returns:
        Points of the grid from start to goal, metres, world frame.

    Raises:
        InputError: each rotation's energies were kept, an end is no point or lies more than a step outside the grid,
            the sharpness is not in 0 to 50, or the points that count do not join both ends.
    """
    if landscape.turned is None:
        raise InputError(
            "lowest_cost_path(): the landscape keeps each rotation's energies; expected the best, or one rotation's"
        )
    if not 0 <= sharpness <= SHARPEST:
        raise InputError(f"lowest_cost_path(): sharpness is {sharpness}; expected 0 to {SHARPEST:g}")
    grid, energy = landscape.grid, landscape.combined
    points = grid.points.reshape(-1, 3)
    counts = np.isfinite(energy)
    ends = [_nearest(name, grid, points, counts, end) for name, end in (("start", start), ("goal", goal))]
    # Over the least energy: powers of numbers near 0.002 would fall out of the range of what can be told apart.
    cost = np.where(counts, energy / np.nanmin(energy[energy > 0], initial=np.inf), np.inf).astype(float) ** sharpness
    _, before = dijkstra(_graph(grid, cost, counts), indices=ends[0], return_predecessors=True)
    path = [ends[1]]
    while path[-1] != ends[0]:
        if before[path[-1]] < 0:
            raise InputError(
                "lowest_cost_path(): the grid's points that count do not join start and goal; expected a grid with both in one piece"
            )
        path.append(before[path[-1]])
    return points[path[::-1]]


def _nearest(name, grid, points, counts, end):
    end = np.asarray(end, dtype=float)
    if end.shape != (3,) or not np.isfinite(end).all():
        raise InputError(f"lowest_cost_path(): {name} is {end.tolist()}; expected three finite numbers, metres")
    apart = np.where(counts.ravel(), np.linalg.norm(points - end, axis=1), np.inf)
    if apart.min() > np.linalg.norm(grid.steps):
        raise InputError(
            f"lowest_cost_path(): {name} {end.tolist()} lies {apart.min():.3f} m from the grid's nearest point; expected it inside"
        )
    return int(apart.argmin())


def _graph(grid, cost, counts):
    """Costs of steps between neighbours, each pair once in both directions."""
    numbers = np.arange(cost.size).reshape(grid.shape)
    rows, columns, costs = [], [], []
    for move in itertools.product((-1, 0, 1), repeat=len(grid.shape)):
        if move <= (0,) * len(move):
            continue  # half of the moves: the others are the same steps backwards
        here = tuple(slice(max(-m, 0), size - max(m, 0)) for m, size in zip(move, grid.shape))
        there = tuple(slice(max(m, 0), size - max(-m, 0)) for m, size in zip(move, grid.shape))
        both = counts[here] & counts[there]
        rows.append(numbers[here][both])
        columns.append(numbers[there][both])
        costs.append(np.linalg.norm(move * grid.steps) * (cost[here][both] + cost[there][both]) / 2)
    rows, columns, costs = map(np.concatenate, (rows, columns, costs))
    both_ways = np.concatenate([rows, columns]), np.concatenate([columns, rows])
    return coo_array((np.tile(costs, 2), both_ways), shape=(cost.size, cost.size)).tocsr()
