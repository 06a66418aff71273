"""Trajectories: resampling, displacing, files and their damage."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tdf_jax._internal.errors import InputError
from tdf_jax.geometry.paths import line, wave
from tdf_jax.geometry.trajectory import Trajectory, check_trajectory, displace, resample
from tdf_jax.io.trajectories import load_trajectory, save_trajectory

IDENTITY = np.array([1, 0, 0, 0, 0, 0, 0], np.float32)


def random_trajectory(poses=5, dtype=np.float32, seed=0):
    wxyz_xyz = np.random.default_rng(seed).normal(size=(poses, 7))
    wxyz_xyz[:, :4] /= np.linalg.norm(wxyz_xyz[:, :4], axis=1, keepdims=True)
    return Trajectory(jnp.asarray(wxyz_xyz, dtype))


def scipy_rotations(trajectory):
    return Rotation.from_quat(np.array(trajectory.wxyz_xyz[:, :4], np.float64), scalar_first=True)


def test_a_trajectory_is_a_pytree_of_one_array():
    trajectory = random_trajectory()
    assert trajectory.num_poses == 5
    assert jax.tree.leaves(trajectory) == [trajectory.wxyz_xyz]
    doubled = jax.tree.map(lambda x: 2 * x, trajectory)
    assert isinstance(doubled, Trajectory)
    batch = jax.tree.map(lambda x: jnp.stack([x, x]), trajectory)
    lengths = jax.vmap(lambda one: jnp.sum(one.translations**2))(batch)
    np.testing.assert_allclose(lengths, np.sum(np.array(trajectory.wxyz_xyz[:, 4:]) ** 2), rtol=1e-6)
    with pytest.raises(AttributeError):
        trajectory.wxyz_xyz = None


def test_rotations_translations_and_matrices():
    trajectory = random_trajectory()
    np.testing.assert_allclose(trajectory.rotations, scipy_rotations(trajectory).as_matrix(), atol=1e-6)
    np.testing.assert_array_equal(trajectory.translations, trajectory.wxyz_xyz[:, 4:])
    np.testing.assert_allclose(trajectory.matrices[:, :3, :3], scipy_rotations(trajectory).as_matrix(), atol=1e-6)
    np.testing.assert_array_equal(trajectory.matrices[:, :3, 3], trajectory.translations)
    np.testing.assert_array_equal(trajectory.matrices[:, 3], np.tile([0, 0, 0, 1], (trajectory.num_poses, 1)))
    back = Trajectory.from_matrices(trajectory.matrices)
    sign = np.where(trajectory.wxyz_xyz[:, :1] < 0, -1, 1) * [1, 1, 1, 1, 0, 0, 0] + [0, 0, 0, 0, 1, 1, 1]
    np.testing.assert_allclose(back.wxyz_xyz, trajectory.wxyz_xyz * sign, atol=1e-6)


def test_transformed_multiplies_from_the_left():
    trajectory, T_new_world = random_trajectory(), random_trajectory(seed=1).wxyz_xyz[0]
    expected = np.array(Trajectory(T_new_world[None]).matrices[0]) @ np.array(trajectory.matrices)
    np.testing.assert_allclose(trajectory.transformed(T_new_world).matrices, expected, atol=1e-5)


def test_resampling_by_hand():
    """Lengths 1 and 3 along a corner; the first leg turns by 90 degrees about z, the second by -60."""
    turns = Rotation.from_rotvec([[0, 0, 0], [0, 0, np.pi / 2], [0, 0, np.pi / 6]])
    wxyz_xyz = np.concatenate([turns.as_quat(scalar_first=True), [[0, 0, 0], [1, 0, 0], [1, 3, 0]]], axis=1)
    again = resample(Trajectory(jnp.asarray(wxyz_xyz, jnp.float32)), 9)
    expected = [[0, 0, 0], [0.5, 0, 0], *([1, 0.5 * i, 0] for i in range(7))]
    np.testing.assert_allclose(again.translations, expected, atol=1e-6)
    angles = scipy_rotations(again).as_rotvec()
    np.testing.assert_allclose(np.rad2deg(angles), [[0, 0, a] for a in (0, 45, 90, 80, 70, 60, 50, 40, 30)], atol=1e-4)


def test_resampling_to_the_same_number_keeps_an_even_trajectory():
    trajectory = line(5, rotation=np.eye(3), end_rotation=Rotation.from_rotvec([1, 0.5, 0]).as_matrix())
    np.testing.assert_allclose(resample(trajectory, 5).wxyz_xyz, trajectory.wxyz_xyz, atol=1e-6)
    np.testing.assert_allclose(resample(wave(301), 7).translations, wave(7).translations, atol=2e-6)


def test_resampling_with_poses_at_one_place():
    wxyz_xyz = np.tile(IDENTITY, (4, 1))
    wxyz_xyz[2:, 4] = 1  # stays, moves, stays
    again = resample(Trajectory(jnp.asarray(wxyz_xyz)), 5)
    np.testing.assert_allclose(again.translations[:, 0], [0, 0.25, 0.5, 0.75, 1], atol=1e-6)
    wxyz_xyz[:, :4] = Rotation.from_rotvec([[0, 0, 0.1 * i] for i in range(4)]).as_quat(scalar_first=True)
    wxyz_xyz[:, 4] = 0  # turns in one place
    turning = scipy_rotations(resample(Trajectory(jnp.asarray(wxyz_xyz)), 7)).as_rotvec()
    np.testing.assert_allclose(turning[:, 2], 0.05 * np.arange(7), atol=1e-6)


def test_resampling_refuses_one_pose():
    with pytest.raises(InputError, match=r"resample\(\): num_poses is 1"):
        resample(line(), 1)


@pytest.mark.parametrize(("where", "index"), [("goal", -1), ("start", 0)])
def test_displacing_moves_one_end_only(where, index):
    trajectory = random_trajectory()
    moved = displace(trajectory, (-0.2, 0.1, 0.3), where)
    expected = np.array(trajectory.wxyz_xyz)
    expected[index, 4:] += np.float32([-0.2, 0.1, 0.3])
    np.testing.assert_array_equal(moved.wxyz_xyz, expected)
    np.testing.assert_array_equal(trajectory.displaced((-0.2, 0.1, 0.3), where).wxyz_xyz, expected)


def test_displacing_moves_the_goal_by_default_and_can_be_traced():
    moved = jax.jit(lambda offset: displace(line(), offset))(jnp.ones(3))
    np.testing.assert_allclose(moved.translations[-1], [1, 1.3, 1], atol=1e-6)
    np.testing.assert_array_equal(moved.translations[:-1], line().translations[:-1])


def test_displacing_refuses_bad_arguments():
    with pytest.raises(InputError, match="where is 'end'; expected one of start, goal"):
        displace(line(), (0, 0, 1), "end")
    for offset in ((0, 1), np.zeros((7, 3)), (0, 0, np.nan)):
        with pytest.raises(InputError, match=r"(?s)displace\(\): offset is .*; expected three finite numbers"):
            displace(line(), offset)


def broken(row, column, value):
    wxyz_xyz = np.tile(IDENTITY, (3, 1))
    wxyz_xyz[row, column] = value
    return wxyz_xyz


BAD_POSES = {
    r"has shape \(3, 6\); expected \(poses, 7\)": np.zeros((3, 6), np.float32),
    r"has shape \(7,\)": IDENTITY,
    "has no pose; expected at least one": np.zeros((0, 7), np.float32),
    "pose 1 of path is NaN or infinite": broken(1, 5, np.nan),
    "pose 2 of path is NaN or infinite": broken(2, 0, np.inf),
    "pose 1 of path has a quaternion of norm 0": broken(1, 0, 0),
    "has dtype int32": np.ones((3, 7), np.int32),
    "is a list; expected an array": [[1, 0, 0, 0, 0, 0, 0]] * 2,
}


@pytest.mark.parametrize("message", BAD_POSES)
def test_check_trajectory_says_what_is_wrong(message):
    with pytest.raises(InputError, match=message):
        check_trajectory(Trajectory(BAD_POSES[message]), "path")


def test_broken_trajectories_are_refused_where_they_are_used(tmp_path):
    trajectory = Trajectory(broken(1, 5, np.nan))
    for use in (
        lambda: resample(trajectory, 3),
        lambda: displace(trajectory, (0, 0, 1)),
        lambda: save_trajectory(tmp_path / "path.npz", trajectory),
    ):
        with pytest.raises(InputError, match="pose 1 of trajectory is NaN"):
            use()
    assert list(tmp_path.iterdir()) == []


def test_check_trajectory_inside_jit_checks_the_shape():
    with jax.debug_nans(False):
        assert jax.jit(lambda x: check_trajectory(Trajectory(x)))(broken(1, 5, np.nan)).num_poses == 3
    with pytest.raises(InputError, match="has no pose"):
        jax.jit(lambda x: check_trajectory(Trajectory(x)))(IDENTITY[:0].reshape(0, 7))


def test_from_matrices_refuses_what_is_not_rigid():
    T = np.tile(np.eye(4), (3, 1, 1))
    for index, value, message in [
        ((1, 0, 0), -1, "not orthonormal with determinant 1"),
        ((1, 0, 1), 0.1, "not orthonormal"),
        ((2, 3, 0), 0.1, "last row"),
        ((0, 2, 3), np.nan, "NaN or infinite"),
    ]:
        bad = T.copy()
        bad[index] = value
        with pytest.raises(InputError, match=rf"Trajectory.from_matrices\(\): .*{message}"):
            Trajectory.from_matrices(bad)
    for bad in (T[:, :3], T[0], np.zeros((3, 7))):
        with pytest.raises(InputError, match=r"have shape .*; expected \(poses, 4, 4\)"):
            Trajectory.from_matrices(bad)
    assert Trajectory.from_matrices(T[:1]).num_poses == 1
    with pytest.raises(InputError, match="the trajectory has one pose; expected at least 2"):
        resample(Trajectory.from_matrices(T[:1]), 3)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("name", ["path.npz", "path.tum"])
def test_files_give_back_the_same_bits(tmp_path, name, dtype):
    with jax.enable_x64(dtype is np.float64):
        trajectory = random_trajectory(dtype=dtype)
        save_trajectory(tmp_path / name, line())
        save_trajectory(str(tmp_path / name), trajectory)  # over an older one
        back = load_trajectory(tmp_path / name)
        np.testing.assert_array_equal(back.wxyz_xyz, trajectory.wxyz_xyz)
        assert name.endswith("tum") or back.wxyz_xyz.dtype == dtype
    assert [path.name for path in tmp_path.iterdir()] == [name]


def test_the_layout_of_tum_files(tmp_path):
    half = np.sqrt(0.5)
    wxyz_xyz = [[1, 0, 0, 0, 1, 2, 3], [half, 0, 0, half, 4, 5, 6]]
    save_trajectory(tmp_path / "path.tum", Trajectory(jnp.array(wxyz_xyz)))
    lines = (tmp_path / "path.tum").read_text().splitlines()
    assert lines[0] == "# t x y z qx qy qz qw"
    assert lines[1] == "0 1 2 3 0 0 0 1"
    np.testing.assert_allclose(np.array(lines[2].split(), float), [1, 4, 5, 6, 0, 0, half, half], atol=1e-7)
    text = "# made elsewhere\n\n12.5 1 2 3 0 0 0 1 # pick\n13 4 5 6 0 0 0.70710678 0.70710678\n"
    (tmp_path / "other.tum").write_text(text)
    np.testing.assert_allclose(load_trajectory(tmp_path / "other.tum").wxyz_xyz, wxyz_xyz, atol=1e-7)


def test_files_of_plain_numbers_are_read(tmp_path):
    np.savez(tmp_path / "whole.npz", wxyz_xyz=np.tile(IDENTITY, (2, 1)).astype(np.int64), other=1)
    assert jnp.issubdtype(load_trajectory(tmp_path / "whole.npz").wxyz_xyz.dtype, jnp.floating)


DAMAGED = {
    "text.npz": b"hello",
    "torn.npz": b"PK\x03\x04xx",
    "empty.tum": b"",
    "seven.tum": b"0 1 2 3 0 0 1\n" * 3,
    "words.tum": b"a b c d e f g h\n" * 3,
    "ragged.tum": b"0 1 2 3 0 0 0 1\n1 2 3\n",
    "binary.tum": b"\xff\xfe\x00",
    "none.tum": b"# no pose\n",
    "nan.tum": b"0 1 2 3 0 0 0 1\n1 nan 2 3 0 0 0 1\n",
    "zero.tum": b"0 1 2 3 0 0 0 1\n1 1 2 3 0 0 0 0\n",
}


@pytest.mark.parametrize("name", DAMAGED)
def test_damaged_files_are_input_errors_that_name_the_file(tmp_path, name):
    (tmp_path / name).write_bytes(DAMAGED[name])
    with pytest.raises(InputError, match=name):
        load_trajectory(tmp_path / name)


@pytest.mark.parametrize(
    ("arrays", "message"),
    [
        ({"poses": IDENTITY}, r"holds the arrays \['poses'\]; expected wxyz_xyz"),
        ({"wxyz_xyz": np.full((2, 7), "a")}, "dtype <U1; expected numbers"),
        ({"wxyz_xyz": np.ones((2, 7), complex)}, "dtype complex128; expected numbers"),
        ({"wxyz_xyz": np.array([{"a": 1}], dtype=object)}, "path.npz cannot be read"),
        ({"wxyz_xyz": np.zeros((2, 6))}, r"has shape \(2, 6\)"),
    ],
)
def test_npz_files_with_something_else_are_refused(tmp_path, arrays, message):
    np.savez(tmp_path / "path.npz", **arrays)
    with pytest.raises(InputError, match=message):
        load_trajectory(tmp_path / "path.npz")


def test_wrong_paths(tmp_path):
    for call in (lambda path: save_trajectory(path, line()), load_trajectory):
        with pytest.raises(InputError, match="suffix '.txt'; expected one of .npz, .tum"):
            call(tmp_path / "path.txt")
    with pytest.raises(InputError, match="there is no file .*path.tum"):
        load_trajectory(tmp_path / "path.tum")
    with pytest.raises(InputError, match="cannot write .*path.npz"):
        save_trajectory(tmp_path / "nowhere" / "path.npz", line())
    (tmp_path / "folder.tum").mkdir()
    with pytest.raises(InputError, match="cannot write .*folder.tum"):
        save_trajectory(tmp_path / "folder.tum", line())
    assert [path.name for path in tmp_path.iterdir()] == ["folder.tum"]


def test_shifted_takes_numpy_poses_and_changes_translations_only():
    shown = Trajectory(np.tile(np.float32([0.6, 0.8, 0, 0, 1, 2, 3]), (2, 1)))
    moved = shown.shifted(np.array([0.5, 0, -1]))
    np.testing.assert_allclose(moved.wxyz_xyz, [[0.6, 0.8, 0, 0, 1.5, 2, 2]] * 2, rtol=1e-6)
