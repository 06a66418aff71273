"""Trajectories in files: .npz, the text format of TUM, and .csv with named columns."""

import re
from pathlib import Path
from typing import BinaryIO

import jax.numpy as jnp
import numpy as np

from tdf_jax._internal import checks
from tdf_jax._internal.boundary import public
from tdf_jax._internal.files import replace_file
from tdf_jax.geometry.trajectory import Trajectory, check_trajectory
from tdf_jax.io.content import UnsupportedError, known_suffix, reading


@public
def save_trajectory(path: str | Path, trajectory: Trajectory) -> None:
    """Write a trajectory.

    Args:
        path: .npz file (array `wxyz_xyz`), or .tum file (lines `t x y z qx qy qz qw`, where t is the index as seconds).
        trajectory: trajectory to write, at least one pose.

    Raises:
        InputError: the suffix is unknown, the file cannot be written, or the trajectory fails `check_trajectory`.
    """
    path = known_suffix("save_trajectory()", path, (".npz", ".tum"))
    wxyz_xyz = np.asarray(check_trajectory(trajectory).wxyz_xyz)

    def write(file: BinaryIO) -> None:
        if path.suffix.lower() == ".npz":
            np.savez(file, wxyz_xyz=wxyz_xyz)
        else:
            digits = np.finfo(wxyz_xyz.dtype).precision + 3  # enough digits to read the same bits
            rows = np.column_stack([np.arange(len(wxyz_xyz)), wxyz_xyz[:, [4, 5, 6, 1, 2, 3, 0]]])
            np.savetxt(file, rows, fmt=f"%.{digits}g", header="t x y z qx qy qz qw")

    replace_file("save_trajectory()", path, write)


@public
def load_trajectory(path: str | Path) -> Trajectory:
    """Read a trajectory written by `save_trajectory`, or another program's .tum or .csv file.

    Args:
        path: .npz, .tum or .csv file. The lines of a .tum file are poses in order; timestamps are ignored, and # starts
            a comment. The first line of a .csv file names its columns, of which x, y, z, qx, qy, qz and qw are read, in
            any order; separators are commas, semicolons, tabs or spaces.

    Returns:
        The trajectory.

    Raises:
        InputError: the file is missing, unreadable or of another dialect, its poses fail `check_trajectory`, or they
            are farther from the origin than float32 resolves.
    """
    path = known_suffix("load_trajectory()", path, tuple(_READERS))
    checks.existing_file("load_trajectory()", path)
    with reading("load_trajectory()", path):
        wxyz_xyz = _READERS[path.suffix.lower()](path)
    # In numpy, because far coordinates and bad norms must be seen before they are rounded.
    check_trajectory(Trajectory(wxyz_xyz), str(path))  # pyright: ignore[reportArgumentType]
    checks.near("load_trajectory()", str(path), wxyz_xyz[:, 4:])
    return Trajectory(jnp.asarray(wxyz_xyz))


def _read_npz(path: Path) -> np.ndarray:
    with path.open("rb") as file, np.lib.npyio.NpzFile(file, allow_pickle=False) as arrays:
        if "wxyz_xyz" not in arrays:
            raise ValueError(f"it holds the arrays {list(arrays)}; expected wxyz_xyz")
        wxyz_xyz = arrays["wxyz_xyz"]
    if wxyz_xyz.dtype.kind not in "fiu":
        raise ValueError(f"wxyz_xyz has dtype {wxyz_xyz.dtype}; expected numbers")
    return wxyz_xyz.astype(np.result_type(wxyz_xyz, np.float32))


def _read_tum(path: Path) -> np.ndarray:
    lines = path.read_text(encoding="utf-8-sig", errors="replace").splitlines()
    for line in lines:
        names = [word.lower() for word in re.split(r"[\s,;]+", line.partition("#")[2]) if word]
        quaternion = [name for name in names if name in ("qw", "qx", "qy", "qz")]
        if len(quaternion) == 4 and quaternion != ["qx", "qy", "qz", "qw"]:
            raise UnsupportedError(
                f"has a comment that names the order {' '.join(quaternion)}; expected TUM's, qx qy qz qw at the end"
            )
    lines = [line for line in lines if line.split("#")[0].strip()]
    rows = np.loadtxt(lines, ndmin=2) if lines else np.zeros((0, 8))
    if rows.shape[1] != 8:
        raise UnsupportedError(f"has {rows.shape[1]} columns; expected the 8 of t x y z qx qy qz qw")
    return rows[:, [7, 4, 5, 6, 1, 2, 3]]


def _read_csv(path: Path) -> np.ndarray:
    lines = path.read_text(encoding="utf-8-sig", errors="replace").splitlines()
    lines = [line.strip() for line in lines if line.strip()]
    separator = next((mark for mark in (";", "\t", ",") if lines and mark in lines[0]), None)
    names = [name.strip(" \"'#").lower() for name in (lines[0].split(separator) if lines else [])]
    missing = [name for name in COLUMNS if name not in names]
    if missing:
        raise UnsupportedError(
            f"has a first line that names no column {', '.join(missing)}; expected {', '.join(COLUMNS)}"
        )
    repeated = [name for name in COLUMNS if names.count(name) > 1]
    if repeated:
        raise UnsupportedError(
            f"has a first line that names {', '.join(repeated)} more than once; expected each column once"
        )
    rows = [line.split(separator) for line in lines[1:]]
    for number, row in enumerate(rows, 2):
        if len(row) != len(names):
            raise UnsupportedError(
                f"has {len(row)} values in line {number}; expected {len(names)}, as the first line names"
            )
    columns = [names.index(name) for name in COLUMNS]
    return np.array([[float(row[column]) for column in columns] for row in rows]).reshape(-1, 7)


COLUMNS = ("qw", "qx", "qy", "qz", "x", "y", "z")
_READERS = {".npz": _read_npz, ".tum": _read_tum, ".csv": _read_csv}
