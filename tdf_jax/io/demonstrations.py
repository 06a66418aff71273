"""A demonstration on disk: one .npz file of three arrays, metres, world frame."""

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
        path: an .npz file in an existing folder. It gets the arrays `points` (points, 3), the object's cloud;
            `wxyz_xyz` (poses, 7), T_world_query from the pick to the place; `query` (queries, 3), in the query frame.
        demonstration: what to write.

    Raises:
        InputError: another suffix, or the file cannot be written.
    """
    path = _npz("save_demonstration", path)
    values = (demonstration.points, demonstration.trajectory.wxyz_xyz, demonstration.query)
    arrays = {name: np.asarray(value) for name, value in zip(ARRAYS, values)}
    replace_file("save_demonstration", path, lambda file: np.savez(file, **arrays))


def load_demonstration(path: str | os.PathLike) -> Demonstration:
    """Read a demonstration that `save_demonstration` wrote, or any .npz file of the same three arrays.

    Args:
        path: the file.

    Returns:
        The demonstration, float32.

    Raises:
        InputError: the file is missing, unreadable, without one of the arrays, or they make no demonstration.
    """
    path = _npz("load_demonstration", path)
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
        return Demonstration(points, Trajectory(jnp.asarray(wxyz_xyz)), query)
    except InputError as error:
        raise InputError(f"load_demonstration(): {path}: {error}") from None


def _npz(function: str, path: str | os.PathLike) -> Path:
    path = Path(path)
    if path.suffix != ".npz":
        raise InputError(f"{function}(): {path} has suffix {path.suffix!r}; expected .npz")
    return path
