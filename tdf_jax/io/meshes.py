"""Meshes on the host: read, turn upright, sample, tell inside from outside. Metres; trimesh is imported only when one is read."""

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float

from tdf_jax._internal.errors import InputError

if TYPE_CHECKING:
    import trimesh

MESH_SUFFIXES = (".obj", ".stl", ".ply", ".glb", ".off")
AXES = {sign + name: {"+": 1.0, "-": -1.0}[sign] * np.eye(3)[i] for i, name in enumerate("xyz") for sign in "+-"}


def load_mesh(path: str | Path, scale: float = 1.0) -> "trimesh.Trimesh":
    """Read a mesh; the parts of a scene are joined into one, vertices at the same place are merged.

    Args:
        path: An .obj, .stl, .ply, .glb or .off file.
        scale: Metres per unit of the file: 0.01 for centimetres.

    Returns:
        The mesh, metres.

    Raises:
        InputError: If the file is missing, unreadable, of another kind, without faces, or not finite.
    """
    path = existing_file("load_mesh", path, MESH_SUFFIXES, scale)
    mesh = mesh_in("load_mesh", path, read_scene("load_mesh", path), scale)
    if mesh is None:
        raise InputError(f"load_mesh(): {path} has no faces; expected a surface. A cloud is read by load_points().")
    return mesh


def file_axes(up: str, front: str) -> Float[np.ndarray, "3 3"]:
    """R_file_object: the canonical axes (z up, x to the front or the handle's side) in those of a file.

    Args:
        up, front: axes of the file, keys of `AXES`.

    Raises:
        InputError: there is no such axis, or the two are parallel.
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
    path = Path(path)
    if path.suffix.lower() not in suffixes:
        raise InputError(f"{function}(): {path} has suffix {path.suffix!r}; expected one of {', '.join(suffixes)}.")
    if not path.is_file():
        raise InputError(f"{function}(): there is no file {path}; check the path.")
    if not (np.isfinite(scale) and scale > 0):
        raise InputError(f"{function}(): scale is {scale}; expected metres per unit of the file, above 0.")
    return path


def unreadable(function: str, path: Path, error: Exception) -> InputError:
    reason = str(error) or type(error).__name__
    return InputError(f"{function}(): {path} cannot be read as {path.suffix.lower()}: {reason}. Save it again.")


def read_scene(function: str, path: Path) -> "trimesh.Scene":
    import trimesh

    try:
        # Unprocessed: processing would silently drop vertices that are not finite.
        return trimesh.load_scene(str(path), process=False)
    except Exception as error:  # damaged files raise whatever the parser stumbles on, struct.error to IndexError
        raise unreadable(function, path, error) from error


def mesh_in(function: str, path: Path, scene: "trimesh.Scene", scale: float) -> "trimesh.Trimesh | None":
    if not any(len(getattr(part, "faces", ())) for part in scene.geometry.values()):
        return None
    mesh = scene.to_mesh()
    if not np.isfinite(mesh.vertices).all():
        raise InputError(f"{function}(): {path} has vertices that are NaN or infinite; expected finite coordinates.")
    mesh.merge_vertices(merge_tex=True, merge_norm=True)
    return mesh.apply_scale(scale)
