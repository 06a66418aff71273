"""NumPy files: shapes, types and fields in which programs keep a cloud."""

import io
import re

import numpy as np
import pytest

from tdf_jax._internal.errors import InputError
from tdf_jax.io.pointclouds import load_points

CLOUD = np.random.default_rng(0).normal(size=(40, 3)).astype(np.float32)
ONES = np.ones((40, 1))


def structured(names=("x", "y", "z"), before="", kind="f4"):
    fields = [*((name, "u4") for name in before.split()), *((name, kind) for name in names), ("intensity", "f4")]
    array = np.zeros(40, fields)
    for name, column in zip(names, CLOUD.T, strict=True):
        array[name] = column
    return array


def pair():
    array = np.zeros(40, [("id", "i4"), ("position", "f4", 3)])
    array["position"] = CLOUD
    return array


def organised(height=30, width=24):
    """A bent surface as a depth camera sees it, (height, width, 3)."""
    v, u = np.mgrid[-0.5 : 0.5 : height * 1j, -0.5 : 0.5 : width * 1j]
    return np.stack([u, v, 1 + u * u], axis=-1)


VALID = {
    "rows": CLOUD,
    "Fortran order": np.asfortranarray(CLOUD),
    "big-endian": CLOUD.astype(">f8"),
    "columns": CLOUD.T,
    "columns, Fortran order": np.asfortranarray(CLOUD.T),
    "homogeneous": np.hstack([CLOUD, ONES]),
    "homogeneous columns": np.hstack([CLOUD, ONES]).T,
    "intensity": np.hstack([CLOUD, 0.5 * ONES]),
    "colours": np.hstack([CLOUD, ONES, 0 * ONES, 0 * ONES]),
    "normals and a curvature": np.hstack([CLOUD, 0.6 * ONES, 0.8 * ONES, 0 * ONES, 0 * ONES]),
    "numbers from zero": np.hstack([np.arange(40)[:, None], CLOUD]),
    "numbers from one": np.hstack([np.arange(1, 41)[:, None], CLOUD, ONES]),
    "a batch of one": CLOUD[None],
    "rows of one, as in OpenCV": CLOUD[:, None],
    "columns of one": CLOUD[:, :, None],
    "fields": structured(),
    "fields behind others": structured(before="id label"),
    "capital fields": structured(("X", "Y", "Z")),
    "double fields in rows and columns": structured(kind=">f8").reshape(8, 5),
    "a field of three": pair(),
}


@pytest.mark.parametrize("suffix", ["npy", "npz"])
@pytest.mark.parametrize("name", VALID)
def test_a_cloud_is_read_exactly_from_every_array(tmp_path, name, suffix):
    path = tmp_path / f"cloud.{suffix}"
    np.save(path, VALID[name]) if suffix == "npy" else np.savez_compressed(path, points=VALID[name], colours=ONES)
    np.testing.assert_array_equal(load_points(path), CLOUD)


@pytest.mark.parametrize("layout", ["last", "first"])
def test_organised_clouds_are_read_row_by_row(tmp_path, layout):
    grid = organised()
    np.save(tmp_path / "grid.npy", grid if layout == "last" else np.moveaxis(grid, -1, 0))
    np.testing.assert_allclose(load_points(tmp_path / "grid.npy"), grid.reshape(-1, 3), rtol=1e-6)
    np.save(tmp_path / "grid.npy", np.concatenate([grid, np.ones((30, 24, 3))], axis=-1))
    np.testing.assert_allclose(load_points(tmp_path / "grid.npy"), grid.reshape(-1, 3), rtol=1e-6)


@pytest.mark.parametrize("missing", [np.nan, 0.0])
def test_missing_measurements_of_an_organised_cloud_are_counted(tmp_path, missing):
    grid = organised()
    grid[np.random.default_rng(0).random((30, 24)) < 0.4] = missing
    grid[:5] = missing
    count = np.count_nonzero(~(grid != missing).any(axis=-1) | np.isnan(grid).any(axis=-1))
    np.save(tmp_path / "grid.npy", grid)
    with pytest.raises(InputError, match=f"{count} "):
        load_points(tmp_path / "grid.npy")


@pytest.mark.parametrize("kind", ["f2", "i2", "i8", "u1", "<f8", np.longdouble])
def test_types_of_numbers(tmp_path, kind):
    numbers = np.random.default_rng(0).integers(0, 200, (40, 3)).astype(kind)
    np.save(tmp_path / "cloud.npy", numbers)
    np.testing.assert_allclose(
        load_points(tmp_path / "cloud.npy", scale=0.001), numbers.astype(float) / 1000, rtol=1e-6
    )


@pytest.mark.parametrize("name", ["xyz", "pc", "point_cloud", "coords"])
def test_usual_names_among_several_arrays(tmp_path, name):
    np.savez(tmp_path / "cloud.npz", **{"colours": ONES, name: CLOUD, "labels": ONES[:, 0]})
    np.testing.assert_array_equal(load_points(tmp_path / "cloud.npz"), CLOUD)


UNSUPPORTED = {
    "flat": (CLOUD.ravel(), r"has shape \(120,\) .*save points.reshape\(-1, 3\)"),
    "one number": (np.float32(1), r"has shape \(\)"),
    "two columns": (CLOUD[:, :2], r"has shape \(40, 2\); expected \(points, 3\); save points\[:, :3\]"),
    "a depth image": (np.ones((48, 64)), r"has shape \(48, 64\); .* depth image"),
    "six rows": (np.vstack([CLOUD.T, CLOUD.T]), r"has shape \(6, 40\); .* save points\[:3\].T"),
    "four rows": (np.vstack([CLOUD.T, 2 * ONES.T]), r"has shape \(4, 40\); .* save points\[:3\].T"),
    "a batch": (np.stack([CLOUD] * 30), r"has shape \(30, 40, 3\), which may be several clouds; .* points\[0\]"),
    "a batch of columns": (
        np.stack([CLOUD.T] * 4),
        r"has shape \(4, 3, 40\), which may be several clouds; .*transpose\(0, 2, 1\).*points\[0, :3\].T",
    ),
    "columns of rows and columns": (
        CLOUD.T.reshape(3, 2, 20),
        r"has shape \(3, 2, 20\), which may be several clouds; .* points\[:3\].reshape\(3, -1\).T",
    ),
    "a volume": (np.zeros((20, 20, 20)), r"has shape \(20, 20, 20\); expected \(points, 3\); save the x y z"),
    "a batch in another order": (
        np.random.default_rng(0).normal(size=(25, 30, 3)),
        r"\(25, 30, 3\), which may be several",
    ),
    "few frames of a tracked cloud": (organised(12, 30), r"has shape \(12, 30, 3\), which may be several clouds"),
    "two cameras": (np.stack([organised()] * 2), r"has shape \(2, 30, 24, 3\)"),
    "triangles": (np.zeros((40, 3, 3)), r"has shape \(40, 3, 3\), which may be several clouds"),
    "matrices": (np.tile(np.eye(4), (40, 1, 1)), r"has shape \(40, 4, 4\)"),
    "a picture": (np.zeros((40, 40, 3), np.uint8), r"has shape \(40, 40, 3\) and type uint8"),
    "poses": (np.hstack([ONES, 0 * CLOUD, CLOUD]), "rows that are poses"),
    "quaternions": (np.hstack([0 * CLOUD, ONES]), "poses, or quaternions of norm 1"),
    "labels": (np.hstack([np.arange(40)[:, None] % 3, CLOUD]), "numbers of the points, times or labels"),
    "complex": (CLOUD.astype(complex), "has numbers of type complex128; expected floats"),
    "logical": (CLOUD > 0, "has numbers of type bool; expected floats"),
    "words": (CLOUD.astype(str), r"has numbers of type <U\d+; expected floats; save points.astype\(np.float64\)"),
    "times": (CLOUD.astype("m8[s]"), "has numbers of type timedelta64"),
    "bfloat16 without its library": (np.zeros((40, 3), "V2"), r"has numbers of type \|V2"),
    "other fields": (
        structured(("lon", "lat", "height")),
        "has the fields lon, lat, height, intensity; expected numbers x, y",
    ),
    "words in fields": (structured(kind="U9"), "has the fields x, y, z, intensity; expected numbers"),
    "objects": (CLOUD.astype(object), r"Python objects, .* save np.asarray\(points.tolist\(\), dtype=float\)"),
    "several": (np.array([{"a": 1}], object), "Python objects"),
}


@pytest.mark.filterwarnings("ignore::DeprecationWarning")
@pytest.mark.parametrize("suffix", ["npy", "npz"])
@pytest.mark.parametrize("name", UNSUPPORTED)
def test_what_is_not_clear_is_named_with_the_fix(tmp_path, name, suffix):
    array, message = UNSUPPORTED[name]
    path = tmp_path / f"cloud.{suffix}"
    np.save(path, array) if suffix == "npy" else np.savez(path, array)
    with pytest.raises(InputError, match=rf"load_points\(\): .*cloud.{suffix} .*{message}") as error:
        load_points(path)
    assert "save it again" not in str(error.value)


FIXES = {
    "flat": "points.reshape(-1, 3)",
    "six rows": "points[:3].T",
    "a batch": "points[0]",
    "a batch of columns": "points[0, :3].T",
    "columns of rows and columns": "points[:3].reshape(3, -1).T",
    "words": "points.astype(np.float64)",
    "objects": "np.asarray(points.tolist(), dtype=float)",
}


@pytest.mark.parametrize("name", FIXES)
def test_the_fix_of_a_message_is_code_that_works(tmp_path, name):
    array, path = UNSUPPORTED[name][0], tmp_path / "cloud.npy"
    np.save(path, array, allow_pickle=True)
    with pytest.raises(InputError, match=re.escape(FIXES[name])):
        load_points(path)
    np.save(path, eval(FIXES[name], {"points": array, "np": np}))
    np.testing.assert_allclose(load_points(path), CLOUD, rtol=1e-6)


def test_pieces_of_columns_are_joined_by_the_code_of_the_message(tmp_path):
    path, pieces = tmp_path / "cloud.npy", np.stack([CLOUD[:20].T, CLOUD[20:].T])
    fix = "points[:, :3].transpose(0, 2, 1).reshape(-1, 3)"
    np.save(path, pieces)
    with pytest.raises(InputError, match=re.escape(fix)):
        load_points(path)
    np.save(path, eval(fix, {"points": pieces}))
    np.testing.assert_array_equal(load_points(path), CLOUD)


@pytest.mark.parametrize("suffix", ["npy", "npz"])
def test_units_of_fields_must_match_the_scale(tmp_path, suffix):
    path, array = tmp_path / f"cloud.{suffix}", structured(("x_mm", "y_mm", "z_mm"))
    np.save(path, array) if suffix == "npy" else np.savez(path, points=array)
    with pytest.raises(InputError, match=r"coordinates in mm, as its names say; pass scale=0.001"):
        load_points(path)
    with pytest.raises(InputError, match=r"coordinates in mm, as its names say, and scale is 0.01; pass scale=0.001"):
        load_points(path, scale=0.01)
    np.testing.assert_allclose(load_points(path, scale=0.001), CLOUD / 1000, rtol=1e-6)


def test_numbers_in_disorder_before_whole_millimetres_are_left_out(tmp_path):
    millimetres = np.rint(1000 * CLOUD).astype(int)
    numbers = np.random.default_rng(1).permutation(40)[:, None]
    np.save(tmp_path / "cloud.npy", np.hstack([numbers, millimetres]))
    np.testing.assert_allclose(load_points(tmp_path / "cloud.npy", scale=0.001), millimetres / 1000, rtol=1e-6)


def test_the_arrays_of_an_npz_must_be_clear(tmp_path):
    path = tmp_path / "several.npz"
    np.savez(path, a=CLOUD, b=CLOUD)
    with pytest.raises(InputError, match=r"holds the arrays \['a', 'b'\]; expected one named points.*np.savez"):
        load_points(path)
    np.savez(path, xyz=CLOUD, pc=CLOUD)
    with pytest.raises(InputError, match=r"holds the arrays \['xyz', 'pc'\]"):
        load_points(path)
    np.savez(path)
    with pytest.raises(InputError, match=r"holds the arrays \[\]"):
        load_points(path)
    np.savez(path, points=CLOUD, occupancies=ONES)
    with pytest.raises(InputError, match="points are samples of space; expected points of a surface"):
        load_points(path)


def test_damaged_files_are_named(tmp_path):
    stream = io.BytesIO()
    np.save(stream, CLOUD)
    whole = stream.getvalue()
    for content, message in {
        whole[:-5]: "cannot be read as .npy .*save it again",
        whole[:20]: "cannot be read as .npy",
        whole + whole: "holds more than one array; expected one; save it as .npz",
        b"hello": "cannot be read as .npy",
    }.items():
        (tmp_path / "cloud.npy").write_bytes(content)
        with pytest.raises(InputError, match=message):
            load_points(tmp_path / "cloud.npy")
    stream = io.BytesIO()
    np.savez(stream, points=CLOUD)
    for content in (stream.getvalue()[:-30], b"PK\x03\x04xx", b"hello", stream.getvalue().replace(b"NUMPY", b"NUMPI")):
        (tmp_path / "cloud.npz").write_bytes(content)
        with pytest.raises(InputError, match=r"cloud.npz (cannot be read as .npz|holds points, which is no array)"):
            load_points(tmp_path / "cloud.npz")
