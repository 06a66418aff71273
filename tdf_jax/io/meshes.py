"""Meshes on the host: read, turn upright, sample, tell inside from outside. Metres; trimesh is imported only when one is read."""

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Bool, Float

from tdf_jax._internal.errors import InputError

if TYPE_CHECKING:
    import trimesh

MESH_SUFFIXES = (".obj", ".stl", ".ply", ".glb", ".off")
MOST_UNDECIDED = 0.2  # of the points not clearly outside; a mug whose handle is open at its ends has none
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


def sample_surface(
    mesh: "trimesh.Trimesh", count: int, rng: np.random.Generator | int
) -> Float[np.ndarray, "points 3"]:
    """Points drawn uniformly by area from the surface of a mesh.

    Args:
        mesh: The mesh.
        count: How many, at least 1.
        rng: Random generator, or a seed.

    Returns:
        Points, in the unit of the mesh, float64.

    Raises:
        InputError: If count is below 1 or the mesh has no area.
    """
    if count < 1:
        raise InputError(f"sample_surface(): count is {count}; expected at least 1.")
    rng = np.random.default_rng(rng)
    corner, second, third = np.moveaxis(np.asarray(mesh.vertices)[np.asarray(mesh.faces)], 1, 0)
    u, v = second - corner, third - corner
    cumulative = np.cumsum(np.linalg.norm(np.cross(u, v), axis=1))
    if len(cumulative) == 0 or not cumulative[-1] > 0:
        raise InputError(f"sample_surface(): the mesh of {len(cumulative)} faces has no area; expected a surface.")
    face = np.searchsorted(cumulative, rng.random(count) * cumulative[-1])
    a, b = rng.random((2, count, 1))
    outside = a + b > 1  # the other half of the parallelogram, folded back onto the triangle
    a, b = np.where(outside, 1 - a, a), np.where(outside, 1 - b, b)
    return corner[face] + a * u[face] + b * v[face]


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
        raise InputError(f"file_axes(): up is {up} and front is {front}, which are parallel; expected two different axes")
    return np.stack([x, np.cross(z, x), z], axis=1)


def inside(mesh: "trimesh.Trimesh", x: Float[np.ndarray, "points 3"]) -> Bool[np.ndarray, " points"] | None:
    """Tell which points a mesh encloses, by its winding number; small holes do not matter, nor which way the faces look.

    Args:
        mesh: the surface.
        x: spread over the mesh's bounding box and about it, in its unit.

    Returns:
        True inside; None for an open surface: of the points not clearly outside, more than `MOST_UNDECIDED` are not clearly inside.

    Raises:
        InputError: libigl is not installed.
    """
    winding = np.abs(winding_number(mesh, x))
    undecided = np.sum((winding > 0.25) & (winding < 0.75))
    return None if undecided > MOST_UNDECIDED * np.sum(winding > 0.25) else winding > 0.5


def winding_number(mesh: "trimesh.Trimesh", x: Float[np.ndarray, "points 3"]) -> Float[np.ndarray, " points"]:
    """The generalised winding number of points: 1 inside, 0 outside, in between where a surface is open.

    Raises:
        InputError: libigl is not installed.

    Source:
        Barill, Dickson, Schmidt, Levin, Jacobson, Fast winding numbers for soups and clouds, SIGGRAPH 2018.
    """
    igl = libigl("winding_number()")
    return igl.fast_winding_number(np.asarray(mesh.vertices, float), np.asarray(mesh.faces, np.int64), np.asarray(x, float))


def libigl(function: str):
    """The module of libigl, of the extra "mesh".

    Raises:
        InputError: it is not installed.
    """
    try:
        import igl
    except ImportError:
        raise InputError(
            f"{function}: libigl is not installed; expected the extra 'mesh'; run: pip install 'tdf_jax[mesh]'"
        ) from None
    return igl


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
