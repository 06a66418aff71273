"""Trajectories in files: .npz, and the text format of TUM."""

import zipfile
from pathlib import Path
from typing import BinaryIO

import jax.numpy as jnp
import numpy as np

from tdf_jax._internal.errors import InputError
from tdf_jax._internal.files import replace_file
from tdf_jax.geometry.trajectory import Trajectory, check_trajectory


def save_trajectory(path: str | Path, trajectory: Trajectory) -> None:
    """Write a trajectory.

    Args:
        path: .npz file (array `wxyz_xyz`), or .tum file (lines `t x y z qx qy qz qw`, where t is the index as seconds).
        trajectory: trajectory to write, at least one pose.

    Raises:
        InputError: the suffix is unknown, the file cannot be written, or the trajectory fails `check_trajectory`.
    """
    path = _known_suffix("save_trajectory()", path)
    wxyz_xyz = np.asarray(check_trajectory(trajectory).wxyz_xyz)

    def write(file: BinaryIO) -> None:
        if path.suffix == ".npz":
            np.savez(file, wxyz_xyz=wxyz_xyz)
        else:
            digits = np.finfo(wxyz_xyz.dtype).precision + 3  # enough digits to read the same bits
            rows = np.column_stack([np.arange(len(wxyz_xyz)), wxyz_xyz[:, [4, 5, 6, 1, 2, 3, 0]]])
            np.savetxt(file, rows, fmt=f"%.{digits}g", header="t x y z qx qy qz qw")

    replace_file("save_trajectory", path, write)


def load_trajectory(path: str | Path) -> Trajectory:
    """Read a trajectory written by `save_trajectory`, or another program's .tum file.

    Args:
        path: .npz or .tum file. The lines of a .tum file are poses in order; timestamps are ignored, and # starts a
            comment.

    Returns:
        The trajectory.

    Raises:
        InputError: the file is missing or unreadable, or its poses fail `check_trajectory`.
    """
    path = _known_suffix("load_trajectory()", path)
    if not path.is_file():
        raise InputError(f"load_trajectory(): there is no file {path}; expected an existing file; check the path")
    try:
        wxyz_xyz = _READERS[path.suffix](path)
    except (OSError, ValueError, EOFError, KeyError, zipfile.BadZipFile) as error:
        raise InputError(
            f"load_trajectory(): {path} cannot be read as {path.suffix} ({error}); save it again"
        ) from error
    return check_trajectory(Trajectory(jnp.asarray(wxyz_xyz)), str(path))


def _read_npz(path: Path) -> np.ndarray:
    with path.open("rb") as file, np.lib.npyio.NpzFile(file, allow_pickle=False) as arrays:
        if "wxyz_xyz" not in arrays:
            raise ValueError(f"it holds the arrays {list(arrays)}; expected wxyz_xyz")
        wxyz_xyz = arrays["wxyz_xyz"]
    if wxyz_xyz.dtype.kind not in "fiu":
        raise ValueError(f"wxyz_xyz has dtype {wxyz_xyz.dtype}; expected numbers")
    return wxyz_xyz.astype(np.result_type(wxyz_xyz, np.float32))


def _read_tum(path: Path) -> np.ndarray:
    lines = [line for line in path.read_text().splitlines() if line.split("#")[0].strip()]
    rows = np.loadtxt(lines, ndmin=2) if lines else np.zeros((0, 8))
    if rows.shape[1] != 8:
        raise ValueError(f"it has {rows.shape[1]} columns; expected the 8 of t x y z qx qy qz qw")
    return rows[:, [7, 4, 5, 6, 1, 2, 3]]


_READERS = {".npz": _read_npz, ".tum": _read_tum}


def _known_suffix(function: str, path: str | Path) -> Path:
    path = Path(path)
    if path.suffix not in _READERS:
        raise InputError(f"{function}: {path} has suffix {path.suffix!r}; expected {' or '.join(_READERS)}")
    return path
