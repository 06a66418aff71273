"""Meshes in files; trimesh is imported only when one is read."""

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float, Int

from tdf_jax._internal.errors import InputError
from tdf_jax.io.content import check_spacing, file_bytes, reading, supported_file
from tdf_jax.io.gltf import read_gltf
from tdf_jax.io.obj import read_obj
from tdf_jax.io.off import read_off
from tdf_jax.io.ply import read_ply
from tdf_jax.io.stl import read_stl

if TYPE_CHECKING:
    import trimesh

MESH_SUFFIXES = (".obj", ".stl", ".ply", ".glb", ".gltf", ".off")
AXES = {sign + name: {"+": 1.0, "-": -1.0}[sign] * np.eye(3)[i] for i, name in enumerate("xyz") for sign in "+-"}
_FARTHEST = 1e10  # units; trimesh compares vertices as whole numbers of 1e-8, which end at 9e10
_READERS = {".obj": read_obj, ".stl": read_stl, ".ply": read_ply, ".off": read_off}


def load_mesh(path: str | Path, scale: float = 1.0) -> "trimesh.Trimesh":
    """Read a mesh; its parts are joined into one, and coincident vertices are merged.

    Polygons are cut into triangles, concave ones as well. The parts of a glTF scene are placed as the scene places
    them, in the pose that the file stores, not that of an animation. Colours, textures, normals, lines and points are
    left out. A file with a feature that changes the geometry and that is not read, such as a compressed mesh or a
    skeleton, is refused.

    Args:
        path: .obj, .stl, .ply, .glb, .gltf or .off file.
        scale: metres per unit of the file, such as 0.01 for centimetres.

    Returns:
        The mesh, metres, in the frame of the file. Its vertices are float64, so that they may be far from the origin.

    Raises:
        InputError: the file is missing, unreadable, of another format, without faces, or not finite.
    """
    path = supported_file("load_mesh()", path, MESH_SUFFIXES, scale)
    vertices, faces = read_surface("load_mesh()", path)
    if not len(faces):
        raise InputError(f"load_mesh(): {path} has no faces; expected a surface; read a point cloud by load_points()")
    return joined_mesh("load_mesh()", path, vertices, faces, scale)


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


def read_surface(function: str, path: Path) -> tuple[Float[np.ndarray, "vertices 3"], Int[np.ndarray, "faces 3"]]:
    """Read the vertices and triangles of all parts of a file.

    Args:
        function: name that error messages begin with.
        path: file with one of `MESH_SUFFIXES`.

    Returns:
        vertices, (vertices, 3), float64, in the unit and frame of the file. They need not be finite.
        faces, (faces, 3); none for a cloud.

    Raises:
        InputError: the file cannot be read.
    """
    with reading(function, path):
        data, suffix = file_bytes(path), path.suffix.lower()
        return read_gltf(data, path.parent) if suffix in {".glb", ".gltf"} else _READERS[suffix](data)


def joined_mesh(
    function: str,
    path: Path,
    vertices: Float[np.ndarray, "vertices 3"],
    faces: Int[np.ndarray, "faces 3"],
    scale: float,
) -> "trimesh.Trimesh":
    """Make a mesh of the vertices that its faces use, coincident ones merged.

    Args:
        function: name that error messages begin with.
        path: file of the mesh, for error messages.
        vertices: vertices, (vertices, 3), in the unit of the file.
        faces: triangles, (faces, 3), at least one.
        scale: metres per unit of the file.

    Returns:
        The mesh, metres.

    Raises:
        InputError: a vertex of a face is not finite, farther away than vertices can be merged, or
            rounded to more than 1 mm.
    """
    import trimesh

    used = np.zeros(len(vertices), dtype=bool)
    used[faces] = True
    vertices, faces = vertices[used], (np.cumsum(used) - 1)[faces]
    if not np.isfinite(vertices).all():
        raise InputError(f"{function}: {path} has vertices that are NaN or infinite; expected finite coordinates")
    if np.abs(vertices).max() > _FARTHEST:
        raise InputError(
            f"{function}: {path} has vertices up to {np.abs(vertices).max():.3g} from the origin; expected at most "
            f"{_FARTHEST:g} units; the file is damaged, or a vertex of it is"
        )
    check_spacing(function, path, vertices, scale)
    mesh = trimesh.Trimesh(vertices, faces, process=False)
    mesh.merge_vertices()
    return mesh.apply_scale(scale)
