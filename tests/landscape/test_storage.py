"""Landscapes: reductions, minimisers, and files."""

import dataclasses
import io

import numpy as np
import pytest

import tdf_jax as tdf
from tdf_jax._internal.errors import InputError
from tdf_jax.geometry.grid import Grid, path_grid, plane_grid, volume_grid
from tdf_jax.landscape.storage import Landscape, load_landscape, save_landscape


def made(values, grid=None, **fields):
    """A landscape of given energies, in one orientation."""
    values = np.asarray(values, float)
    fields = {
        "waypoints": np.zeros((len(values), 3)),
        "rotations": np.eye(3)[None],
        "turned": np.zeros(values.shape, np.int32),
    } | fields
    return Landscape(grid or plane_grid(1.0, 2), values, **fields)


@pytest.fixture
def landscape():
    """Two waypoints over two by two points."""
    return made(np.arange(8.0).reshape(2, 2, 2)[::-1] / 100)


def test_minimum_and_mean_are_over_waypoints(landscape):
    np.testing.assert_allclose(landscape.combined, np.array([[0, 1], [2, 3]]) / 100)
    np.testing.assert_allclose(dataclasses.replace(landscape, reduce="mean").combined, np.array([[2, 3], [4, 5]]) / 100)


def test_the_softmin_lies_between_minimum_and_mean(landscape):
    soft = dataclasses.replace(landscape, reduce="softmin", temperature=0.01)
    np.testing.assert_allclose(soft.combined, -0.01 * np.log(np.mean(np.exp(-soft.values / 0.01), axis=0)))
    low, mean = landscape.combined, dataclasses.replace(landscape, reduce="mean").combined
    # and does not overflow
    np.testing.assert_allclose(dataclasses.replace(soft, temperature=1e-9).combined, low, atol=1e-8)
    np.testing.assert_allclose(dataclasses.replace(soft, temperature=1e3).combined, mean, rtol=1e-4)
    assert ((low < soft.combined) & (soft.combined < mean)).all()


def test_points_are_assigned_to_waypoints_by_their_distance_from_the_first():
    grid = Grid(np.zeros(3), np.eye(3)[:2], (np.linspace(-3, 3, 7), np.linspace(-1, 1, 3)))
    waypoints = np.array([[0.0, 0, 0], [1, 0, 0], [0, 3, 0]])
    landscape = made(np.arange(3)[:, None, None] + np.zeros((3, 7, 3)), grid, waypoints=waypoints, reduce="assigned")
    expected = [[2, 2, 2], [2, 1, 2], [1, 1, 1], [1, 0, 1], [1, 1, 1], [2, 1, 2], [2, 2, 2]]
    expected[1][1] = expected[5][1] = 1  # 2 is as far from 1 as from 3: the first
    np.testing.assert_array_equal(landscape.rings, expected)
    np.testing.assert_array_equal(landscape.combined, expected)
    each = np.broadcast_to(landscape.values[:, None], (3, 2, 7, 3)) + np.array([0, 10])[:, None, None]
    kept = dataclasses.replace(landscape, values=each, rotations=np.stack([np.eye(3)] * 2), turned=None)
    np.testing.assert_array_equal(kept.combined, [expected, np.add(expected, 10)])


def test_minimisers_skip_points_outside_the_mask():
    grid = dataclasses.replace(plane_grid(1.0, 3), mask=np.array([[0, 1, 1], [1, 1, 1], [1, 1, 1]], bool))
    values = np.full((2, 3, 3), 5.0)
    values[:, 0, 0], values[0, 1, 2], values[1, 2, 0] = np.nan, 1, 2
    landscape = made(values, grid)
    np.testing.assert_allclose(landscape.minimisers, [[0, 1, 0], [1, -1, 0]])
    assert np.isnan(landscape.combined[0, 0])


@pytest.mark.parametrize("kind", ["best", "each", "masked"])
def test_a_file_gives_the_same_landscape(tmp_path, kind):
    rng = np.random.default_rng(0)
    grid = path_grid(np.zeros((1, 3)), 0.1, 0.05) if kind == "masked" else volume_grid(0.1, 3, (0.1, 0.2, 0.3))
    shape = (2, *((4,) if kind == "each" else ()), *grid.shape)
    turned = None if kind == "each" else rng.integers(4, size=shape).astype(np.int32)
    rotations = tdf.rotation_grid(4)
    first = Landscape(
        grid,
        rng.uniform(size=shape).astype(np.float32),
        rng.normal(size=(2, 3)),
        rotations,
        turned,
        "softmin",
        0.002,
    )
    save_landscape(tmp_path / "it.npz", first, {"seed": 3})
    again, about = load_landscape(tmp_path / "it.npz")
    assert about == {"seed": 3}
    assert (again.reduce, again.temperature) == ("softmin", 0.002)
    for name in ("values", "waypoints", "rotations", "turned", "combined", "minimisers", "minimiser_rotations"):
        np.testing.assert_array_equal(getattr(again, name), getattr(first, name))
    np.testing.assert_array_equal(again.grid.points, grid.points)
    np.testing.assert_array_equal(again.grid.mask, grid.mask)
    assert again.values.dtype == np.float32
    assert [file.name for file in tmp_path.iterdir()] == ["it.npz"]


def test_other_files_are_refused(tmp_path, landscape):
    with pytest.raises(InputError, match="no file"):
        load_landscape(tmp_path / "none.npz")
    for name in ("it.npy", "it"):
        with pytest.raises(InputError, match="expected .npz"):
            save_landscape(tmp_path / name, landscape)
    path = tmp_path / "it.npz"
    np.savez(path, values=landscape.values)
    with pytest.raises(InputError, match="cannot read"):
        load_landscape(path)
    save_landscape(path, landscape)
    whole = path.read_bytes()
    path.write_bytes(whole[: len(whole) // 2])
    with pytest.raises(InputError, match="cannot read"):
        load_landscape(path)
    with np.load(io.BytesIO(whole)) as file:
        arrays = dict(file)
    np.savez(path, **arrays | {"header": np.array(str(arrays["header"]).replace('"format": 2', '"format": 9'))})
    with pytest.raises(InputError, match=r"format 9; expected one of \(1, 2\)"):
        load_landscape(path)
    with pytest.raises(InputError, match="cannot write"):
        save_landscape(tmp_path / "no folder" / "it.npz", landscape)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"reduce": "median"}, "reduce is 'median'"),
        ({"temperature": 0.0}, "temperature is 0.0"),
        ({"turned": None}, "values have shape"),
    ],
)
def test_inconsistent_landscapes_are_refused(landscape, changes, words):
    with pytest.raises(InputError, match=words):
        dataclasses.replace(landscape, **changes)
