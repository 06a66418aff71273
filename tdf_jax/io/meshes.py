"""Meshes in files; trimesh is imported only when one is read."""

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float

from tdf_jax._internal import checks
from tdf_jax._internal.errors import InputError

if TYPE_CHECKING:
    import trimesh

MESH_SUFFIXES = (".obj", ".stl", ".ply", ".glb", ".off")
AXES = {sign + name: {"+": 1.0, "-": -1.0}[sign] * np.eye(3)[i] for i, name in enumerate("xyz") for sign in "+-"}


def load_mesh(path: str | Path, scale: float = 1.0) -> "trimesh.Trimesh":
    """Read a mesh; the parts of a scene are joined into one, and coincident vertices are merged.

    Args:
        path: .obj, .stl, .ply, .glb or .off file.
        scale: metres per unit of the file, such as 0.01 for centimetres.

    Returns:
        The mesh, metres, in the frame of the file.

    Raises:
        InputError: the file is missing, unreadable, of another format, without faces, or not finite.
    """
    path = existing_file("load_mesh()", path, MESH_SUFFIXES, scale)
    mesh = mesh_in("load_mesh()", path, read_scene("load_mesh()", path), scale)
    if mesh is None:
        raise InputError(f"load_mesh(): {path} has no faces; expected a surface; read a point cloud by load_points()")
    return mesh


def file_axes(up: str, front: str) -> Float[np.ndarray, "3 3"]:
    """Compute the rotation from the canonical object frame (z up, x to the front or to the handle) to a file's frame.

    Args:
        up: axis of the file that points up, a key of `AXES`.
        front: axis of the file that points to the front, a key of `AXES`.

    Returns:
        R_file_object, (3, 3).

    Raises:
        InputError: an axis is unknown, or the two are parallel.
    """
    for name in (up, front):
        if name not in AXES:
            raise InputError(f"file_axes(): {name!r} is no axis; expected one of {', '.join(AXES)}")
    z, x = AXES[up], AXES[front]
    if z @ x:
        raise InputError(
            f"file_axes(): up is {up} and front is {front}, which are parallel; expected two different axes"
        )
    return np.stack([x, np.cross(z, x), z], axis=1)


def existing_file(function: str, path: str | Path, suffixes: tuple[str, ...], scale: float) -> Path:
    """Check that a file exists and has a known suffix, and that its scale is positive.

    Args:
        function: name that error messages begin with.
        path: file to read.
        suffixes: known suffixes, in lower case.
        scale: metres per unit of the file.

    Returns:
        The path.

    Raises:
        InputError: the suffix is unknown, the file is missing, or scale is not above 0.
    """
    path = Path(path)
    if path.suffix.lower() not in suffixes:
        raise InputError(f"{function}: {path} has suffix {path.suffix!r}; expected one of {', '.join(suffixes)}")
    if not path.is_file():
        raise InputError(f"{function}: there is no file {path}; expected an existing file; check the path")
    checks.positive(function, "scale", scale, "metres per unit of the file")
    return path


def unreadable(function: str, path: Path, error: Exception) -> InputError:
    """Make the error of a damaged file.

    Args:
        function: name that the message begins with.
        path: damaged file.
        error: exception of the reader.

    Returns:
        The error to raise.
    """
    reason = str(error) or type(error).__name__
    return InputError(f"{function}: {path} cannot be read as {path.suffix.lower()} ({reason}); save it again")


def read_scene(function: str, path: Path) -> "trimesh.Scene":
    """Read all meshes and clouds of a file.

    Args:
        function: name that error messages begin with.
        path: file to read.

    Returns:
        The scene, in the unit of the file.

    Raises:
        InputError: the file cannot be read.
    """
    import trimesh

    try:
        # Processing would silently drop vertices that are not finite.
        return trimesh.load_scene(str(path), process=False)
    except Exception as error:  # parsers of damaged files raise many types, from struct.error to IndexError
        raise unreadable(function, path, error) from error


def mesh_in(function: str, path: Path, scene: "trimesh.Scene", scale: float) -> "trimesh.Trimesh | None":
    """Join the meshes of a scene.

    Args:
        function: name that error messages begin with.
        path: file of the scene, for error messages.
        scene: scene of `read_scene`.
        scale: metres per unit of the file.

    Returns:
        The mesh, metres, with coincident vertices merged; None if the scene has no faces.

    Raises:
        InputError: a vertex is not finite.
    """
    if not any(len(getattr(part, "faces", ())) for part in scene.geometry.values()):
        return None
    mesh = scene.to_mesh()
    if not np.isfinite(mesh.vertices).all():
        raise InputError(f"{function}: {path} has vertices that are NaN or infinite; expected finite coordinates")
    mesh.merge_vertices(merge_tex=True, merge_norm=True)
    return mesh.apply_scale(scale)
