import jax
import numpy as np
import pytest

import tdf_jax as tdf
from tdf_jax._internal.errors import InputError
from tdf_jax.io.demonstrations import load_demonstration, save_demonstration


@pytest.fixture
def demonstration():
    points = np.random.default_rng(0).normal(size=(30, 3)).astype(np.float32)
    return tdf.Demonstration(points, tdf.semicircle(num_poses=4), tdf.box_query(jax.random.key(1), count=5))


def arrays(demonstration):
    return {
        "points": np.asarray(demonstration.points),
        "wxyz_xyz": np.asarray(demonstration.trajectory.wxyz_xyz),
        "query": np.asarray(demonstration.query),
    }


def test_a_demonstration_survives_the_file(tmp_path, demonstration):
    save_demonstration(tmp_path / "demo.npz", demonstration)
    again = load_demonstration(tmp_path / "demo.npz")
    for name, array in arrays(demonstration).items():
        np.testing.assert_array_equal(arrays(again)[name], array)
    assert [p.name for p in tmp_path.iterdir()] == ["demo.npz"]


def test_any_npz_of_the_three_arrays_will_do(tmp_path, demonstration):
    wide = {name: array.astype(np.float64) for name, array in arrays(demonstration).items()}
    np.savez_compressed(tmp_path / "demo.npz", label="mug 3", **wide)
    again = load_demonstration(tmp_path / "demo.npz")
    assert again.points.dtype == again.trajectory.wxyz_xyz.dtype == again.query.dtype == np.float32
    np.testing.assert_array_equal(again.points, demonstration.points)


@pytest.mark.parametrize(("name", "value", "message"), [
    ("points", None, "no array points"),
    ("query", None, "no array query"),
    ("points", np.zeros((20, 3)), "20 points"),
    ("points", np.full((30, 3), np.nan), "NaN"),
    ("points", np.array(["a"] * 30), "dtype"),
    ("points", np.array([{}] * 30), "cannot be read"),
    ("wxyz_xyz", np.ones((0, 7)), "no pose"),
    ("wxyz_xyz", np.ones((4, 6)), r"\(4, 6\)"),
    ("wxyz_xyz", np.zeros((4, 7)), "quaternion"),
    ("query", np.zeros((5, 2)), r"\(5, 2\)"),
    ("query", np.full((5, 3), np.inf), "infinite"),
])  # fmt: skip
def test_what_makes_no_demonstration(tmp_path, demonstration, name, value, message):
    content = arrays(demonstration) | {name: value}
    np.savez(tmp_path / "demo.npz", **{key: array for key, array in content.items() if array is not None})
    with pytest.raises(InputError, match=rf"^load_demonstration\(\): .*demo\.npz.*{message}"):
        load_demonstration(tmp_path / "demo.npz")


@pytest.mark.parametrize("content", [None, b"", b"PK\x03\x04", b"not an archive"])
def test_a_file_that_is_no_archive(tmp_path, content):
    if content is not None:
        (tmp_path / "demo.npz").write_bytes(content)
    with pytest.raises(InputError, match=r"^load_demonstration\(\): .*demo\.npz"):
        load_demonstration(tmp_path / "demo.npz")


def test_other_suffixes_and_folders(tmp_path, demonstration):
    with pytest.raises(InputError, match=r"expected \.npz"):
        save_demonstration(tmp_path / "demo.npy", demonstration)
    with pytest.raises(InputError, match="cannot write"):
        save_demonstration(tmp_path / "missing" / "demo.npz", demonstration)
    assert not list(tmp_path.iterdir())
