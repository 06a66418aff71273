import dataclasses

import jax
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

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


@pytest.mark.parametrize("indices", [(0, -1), (1, 2), (-3, -2)])
def test_grasp_and_release_survive_the_file(tmp_path, demonstration, indices):
    recording = dataclasses.replace(demonstration, grasp=indices[0], release=indices[1])
    save_demonstration(tmp_path / "demo.npz", recording)
    again = load_demonstration(tmp_path / "demo.npz")
    assert (again.grasp, again.release) == indices


@pytest.mark.parametrize(
    ("extra", "message"),
    [
        ({"grasp": 2.0}, "grasp in .* is 2.0; expected one integer"),
        ({"release": [1, 2]}, "release in .*expected one integer"),
        ({"grasp": 9}, "grasp is 9; expected a whole number from -4 to 3"),
        ({"grasp": 3, "release": 1}, "expected the grasp first"),
        ({"schema": 2, "grasp": 1}, "has no array release; expected points, wxyz_xyz, query, grasp, release"),
        ({"schema": 4, "grasp": 0, "release": 1}, "has schema 4; expected 1 to 3"),
        ({"contact_query": np.zeros((4, 3))}, "has a target, but of its arrays only contact_query"),
    ],
)
def test_bad_indices_and_newer_files_are_refused(tmp_path, demonstration, extra, message):
    np.savez(tmp_path / "demo.npz", **arrays(demonstration), **extra)
    with pytest.raises(InputError, match=message):
        load_demonstration(tmp_path / "demo.npz")


POINTS = 0.1 * np.random.default_rng(2).normal(size=(60, 3)) + [0.1, 0.05, 0.1]
T_GRASP = np.array([0.6, 0.0, 0.8, 0.0, 0.12, 0.07, 0.15])
FRAMES = {
    "right": (POINTS, T_GRASP, False),
    "diagonal of 795 m; .*It is probably in millimetres": (1000 * POINTS, T_GRASP, True),
    "It is probably in millimetres: multiply it by 0.001": (300 * (POINTS - POINTS.mean(axis=0)), T_GRASP, True),
    "the positions are probably in millimetres": (POINTS, T_GRASP * [1, 1, 1, 1, 1e3, 1e3, 1e3], True),
    "the positions are probably in centimetres": (POINTS, T_GRASP * [1, 1, 1, 1, 100, 100, 100], True),
    "the poses are probably T_query_world": (POINTS + [3, 0, 0], None, True),
    "check that cloud and poses are in one frame": (POINTS + [3, 4, 5], T_GRASP, True),
}


@pytest.mark.parametrize("message", FRAMES)
def test_wrong_units_and_frames_are_refused_with_the_likely_one(tmp_path, message):
    points, grasp, wrong = FRAMES[message]
    if grasp is None:  # the inverse of a grasp at the cloud
        turn = Rotation.from_quat(T_GRASP[:4], scalar_first=True).inv()
        grasp = np.concatenate([turn.as_quat(scalar_first=True), -turn.apply(T_GRASP[4:] + [3, 0, 0])])
    query = 0.02 * np.random.default_rng(3).normal(size=(8, 3))
    np.savez(tmp_path / "demo.npz", points=points, wxyz_xyz=grasp[None], query=query)
    if not wrong:
        assert load_demonstration(tmp_path / "demo.npz").trajectory.num_poses == 1
        return
    with pytest.raises(InputError, match=rf"load_demonstration\(\): .*{message}"):
        load_demonstration(tmp_path / "demo.npz")
