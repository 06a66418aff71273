"""Cells of a fixed grid, against loops over the points."""

import numpy as np

from tdf_jax.perception.voxels import canonical_order, voxels_of


def cloud(count=400):
    return np.random.default_rng(0).normal(size=(count, 3)) * 0.05


def test_voxels_are_the_points_of_each_cell():
    points = cloud()
    found = voxels_of(points, 0.02)
    cells = {}
    for row, point in enumerate(points):
        cells.setdefault(tuple(int(np.floor(x / 0.02)) for x in point), []).append(row)
    assert {tuple(map(int, cell)) for cell in found.cells} == set(cells)
    for cell, mean, count in zip(found.cells, found.means, found.counts):
        rows = cells[tuple(map(int, cell))]
        assert count == len(rows)
        np.testing.assert_allclose(mean, points[rows].mean(axis=0), atol=1e-15)
        assert (found.cells[found.index[rows]] == cell).all()


def test_the_canonical_order_forgets_the_given_one():
    points = cloud()
    mixed = points[np.random.default_rng(1).permutation(len(points))]
    np.testing.assert_array_equal(points[canonical_order(points)], mixed[canonical_order(mixed)])


def test_one_more_cell_changes_at_most_one_choice():
    points = cloud()
    before, after = (voxels_of(one, 0.02) for one in (points, np.vstack([points, [3.0, 0, 0]])))
    chosen = [{tuple(cell) for cell in found.cells[found.spread(30)]} for found in (before, after)]
    assert len(before.cells) > 60 and len(chosen[0]) == len(chosen[1]) == 30
    assert len(chosen[0] - chosen[1]) <= 1
