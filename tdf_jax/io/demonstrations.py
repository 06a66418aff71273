"""Demonstrations in files: one .npz file of three arrays."""

import os
import zipfile
from pathlib import Path

import jax.numpy as jnp
import numpy as np

from tdf_jax._internal.errors import InputError
from tdf_jax._internal.files import replace_file
from tdf_jax.geometry.demonstration import Demonstration
from tdf_jax.geometry.trajectory import Trajectory

ARRAYS = ("points", "wxyz_xyz", "query")


def save_demonstration(path: str | os.PathLike, demonstration: Demonstration) -> None:
    """Write a demonstration.

    Args:
        path: .npz file in an existing folder. It holds three arrays: `points`, the object point cloud, (points, 3),
            metres, world frame; `wxyz_xyz`, the poses T_world_query from the pick to the place, (poses, 7); `query`,
            the query points, (queries, 3), metres, query frame.
        demonstration: demonstration to write.

    Raises:
        InputError: the suffix is not .npz, or the file cannot be written.
    """
    path = _npz("save_demonstration()", path)
    points, query = np.asarray(demonstration.points), np.asarray(demonstration.query)
    wxyz_xyz = np.asarray(demonstration.trajectory.wxyz_xyz)
    replace_file("save_demonstration", path, lambda file: np.savez(file, points=points, wxyz_xyz=wxyz_xyz, query=query))


def load_demonstration(path: str | os.PathLike) -> Demonstration:
    """Read a demonstration that `save_demonstration` wrote, or any .npz file of the same three arrays.

    Args:
        path: .npz file.

    Returns:
        The demonstration, float32.

    Raises:
        InputError: the file is missing or unreadable, an array is missing, or the arrays are not a demonstration.
    """
    path = _npz("load_demonstration()", path)
    if not path.is_file():
        raise InputError(f"load_demonstration(): there is no file {path}; check the path")
    try:
        with path.open("rb") as file, np.lib.npyio.NpzFile(file, allow_pickle=False) as archive:
            arrays = {name: archive[name] for name in ARRAYS if name in archive}
    except (OSError, ValueError, EOFError, KeyError, zipfile.BadZipFile) as error:
        raise InputError(f"load_demonstration(): {path} cannot be read as .npz ({error}); save it again") from None
    if len(arrays) < len(ARRAYS):
        absent = ", ".join(name for name in ARRAYS if name not in arrays)
        raise InputError(f"load_demonstration(): {path} has no array {absent}; expected {', '.join(ARRAYS)}")
    for name, array in arrays.items():
        if array.dtype.kind not in "fiu":
            raise InputError(f"load_demonstration(): {name} in {path} has dtype {array.dtype}; expected numbers")
    points, wxyz_xyz, query = (arrays[name].astype(np.float32) for name in ARRAYS)
    try:
        return Demonstration(points, Trajectory(jnp.asarray(wxyz_xyz)), query)  # pyright: ignore[reportArgumentType]
    except InputError as error:
        raise InputError(f"load_demonstration(): {path}: {error}") from None


def _npz(function: str, path: str | os.PathLike) -> Path:
    path = Path(path)
    if path.suffix != ".npz":
        raise InputError(f"{function}: {path} has suffix {path.suffix!r}; expected .npz")
    return path
