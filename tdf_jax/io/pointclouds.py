"""Point clouds in files. Clouds are numpy arrays (points, 3), metres."""

from pathlib import Path

import numpy as np
from jaxtyping import Float

from tdf_jax._internal import checks
from tdf_jax._internal.errors import InputError
from tdf_jax.geometry.sampling import drop_invalid as without_invalid, sample_surface
from tdf_jax.io.arrays import read_npy, read_npz
from tdf_jax.io.columns import read_columns
from tdf_jax.io.content import check_spacing, file_bytes, reading, supported_file
from tdf_jax.io.meshes import MESH_SUFFIXES, joined_mesh, read_surface
from tdf_jax.io.pcd import read_pcd

_TEXT_SUFFIXES = (".xyz", ".txt", ".csv", ".asc", ".pts")
CLOUD_SUFFIXES = (".pcd", ".npy", ".npz", *_TEXT_SUFFIXES)
SUFFIXES = MESH_SUFFIXES + CLOUD_SUFFIXES
_ROUNDING = 1e-5  # metres that rounding to float32 may move a coordinate, a tenth of what a pose is exact to


def load_points(
    path: str | Path, count: int | None = None, scale: float = 1.0, seed: int = 0, *, drop_invalid: bool = False
) -> Float[np.ndarray, "points 3"]:
    """Read a point cloud, or sample one from a mesh.

    A file whose numbers could be read in more than one way is refused, with what to change.

    Args:
        path: mesh (.obj, .stl, .ply, .glb, .gltf, .off, as `load_mesh` reads it), or cloud: one of these without
            faces, .pcd, .npy, .npz with the array `points` or a single array, or text with a point in each line (.xyz,
            .txt, .csv, .asc, .pts). Text and arrays have x y z in their first columns or in those of that name;
            colours, normals and the like after them are left out, and so is a column before them that counts the
            rows, in any order.
        count: number of points. A mesh is sampled by area, by default 1500 points. A larger cloud is reduced to a
            random subset in the order of the file, by default all points.
        scale: metres per unit of the file, such as 0.01 for centimetres.
        seed: seed of the samples.
        drop_invalid: whether to remove the rows of a cloud that are no measurements, as `tdf.drop_invalid` does,
            instead of refusing them. The other rows keep their order.

    Returns:
        Point cloud, (points, 3), metres, in the frame of the file. It is float32, or float64 if rounding to float32
        would move a coordinate by more than 0.01 mm, as in map coordinates.

    Raises:
        InputError: the file is missing, unreadable or of another format, or its points are not a point cloud, or they
            are float32 numbers so far from the origin that these are more than 1 mm apart.
    """
    function = "load_points()"
    path = supported_file(function, path, SUFFIXES, scale)
    if count is not None:
        checks.count(function, "count", count)
    checks.seed(function, seed)
    rng = np.random.default_rng(seed)
    if path.suffix.lower() in MESH_SUFFIXES:
        points, faces = read_surface(function, path)
        if len(faces):
            mesh = joined_mesh(function, path, points, faces, scale)
            if not mesh.area > 0:
                raise InputError(f"{function}: {path} has {len(faces)} faces without area; expected a surface")
            return _rounded(checks.points(function, sample_surface(mesh, count or 1500, rng), str(path)))
        if not len(points):
            raise InputError(f"{function}: {path} has neither faces nor points; expected a surface or a cloud")
    else:
        points = _read_cloud(function, path, scale)
    if drop_invalid:
        points = without_invalid(points)
    points = checks.points(function, points, str(path))
    check_spacing(function, path, points, scale)
    points = points * scale
    if count is not None and count < len(points):
        points = points[np.sort(rng.choice(len(points), count, replace=False))]
    return _rounded(checks.points(function, points, str(path)))


def _read_cloud(function, path, scale):
    with reading(function, path):
        data = file_bytes(path)
        match path.suffix.lower():
            case ".npy":
                return read_npy(data, scale)
            case ".npz":
                return read_npz(data, scale)
            case ".pcd":
                return read_pcd(data)
        return read_columns(data, scale)


def _rounded(points):
    with np.errstate(over="ignore"):
        rounded = points.astype(np.float32)
    return rounded if np.abs(rounded - points).max() <= _ROUNDING else points
