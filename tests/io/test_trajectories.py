"""Trajectories from files of other programs."""

import numpy as np
import pytest
from conftest import random_poses

import tdf_jax as tdf
from tdf_jax._internal.errors import InputError

POSES = random_poses(0, 5)
COLUMNS = dict(zip(("qw", "qx", "qy", "qz", "x", "y", "z"), POSES.T, strict=True)) | {"t": np.arange(5.0)}


def write(path, names, separator, header="", encoding="utf-8"):
    rows = np.column_stack([COLUMNS[name] for name in names])
    lines = [header or separator.join(names), *(separator.join(f"{value:.9f}" for value in row) for row in rows)]
    path.write_text("\n".join(lines) + "\n", encoding=encoding)
    return path


@pytest.mark.parametrize("separator", [",", ";", "\t", " ", ", "])
@pytest.mark.parametrize("names", ["x y z qx qy qz qw", "t x y z qw qx qy qz", "qz t x qw y qx z qy"])
def test_columns_are_taken_by_their_names(tmp_path, names, separator):
    path = write(tmp_path / "path.CSV", names.split(), separator, encoding="utf-8-sig")
    np.testing.assert_allclose(tdf.load_trajectory(path).wxyz_xyz, POSES, atol=1e-6)


@pytest.mark.parametrize(
    ("header", "message"),
    [
        ("0.1,0.2,0.3,0,0,0,1", "names no column qw, qx"),
        ("x,y,z,qx,qy,qz,w", "names no column qw"),
        ("x,x,y,qx,qy,qz,qw", "names no column z"),
        ("x,y,z,qx,qy,qz,qw,qw", "names qw more than once"),
    ],
)
def test_columns_without_the_names_are_refused(tmp_path, header, message):
    path = write(tmp_path / "path.csv", ["x", "y", "z", "qx", "qy", "qz", "qw"], ",", header)
    with pytest.raises(InputError, match=rf"load_trajectory\(\): .*path.csv has a first line that {message}"):
        tdf.load_trajectory(path)


def test_rows_of_other_lengths_are_refused_by_their_line(tmp_path):
    path = write(tmp_path / "path.csv", ["x", "y", "z", "qx", "qy", "qz", "qw"], ",")
    path.write_text(path.read_text().replace("\n", ",1\n", 3).replace(",1\n", "\n", 1))
    with pytest.raises(InputError, match="has 8 values in line 2; expected 7"):
        tdf.load_trajectory(path)


def test_a_tum_file_of_another_order_is_refused(tmp_path):
    named = write(tmp_path / "a.tum", ["t", "x", "y", "z", "qw", "qx", "qy", "qz"], " ", "# t x y z qw qx qy qz")
    with pytest.raises(InputError, match="names the order qw qx qy qz; expected TUM's"):
        tdf.load_trajectory(named)
    moved = write(tmp_path / "b.tum", ["t", "qx", "qy", "qz", "qw", "x", "y", "z"], " ", "# no names")
    with pytest.raises(InputError, match=r"b.tum has a quaternion of norm"):
        tdf.load_trajectory(moved)


def test_far_positions_are_refused(tmp_path):
    path = write(tmp_path / "a.csv", ["x", "y", "z", "qx", "qy", "qz", "qw"], ",")
    tdf.load_trajectory(path)
    path.write_text(path.read_text().replace("\n-", "\n-54123").replace("\n0", "\n541230"))
    with pytest.raises(InputError, match="expected at most 250 m from the origin"):
        tdf.load_trajectory(path)
