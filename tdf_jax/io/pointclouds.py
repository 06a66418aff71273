"""Point clouds in files. Clouds are numpy arrays (points, 3), metres."""

import zipfile
from pathlib import Path

import numpy as np
from jaxtyping import Float

from tdf_jax._internal import checks
from tdf_jax._internal.errors import InputError
from tdf_jax.geometry.sampling import sample_surface
from tdf_jax.io.meshes import MESH_SUFFIXES, existing_file, mesh_in, read_scene, unreadable

_CLOUD_SUFFIXES = (".ply", ".npy", ".npz", ".xyz", ".pcd")


def load_points(
    path: str | Path, count: int | None = None, scale: float = 1.0, seed: int = 0
) -> Float[np.ndarray, "points 3"]:
    """Read a point cloud, or sample one from a mesh.

    Args:
        path: mesh (.obj, .stl, .ply, .glb, .off) or cloud (.ply without faces, .npy, .npz with the array `points` or a
            single array, .xyz with x y z first in each line, .pcd ascii or binary).
        count: number of points. A mesh is sampled by area, by default 1500 points. A larger cloud is reduced to a
            random subset in the order of the file, by default all points.
        scale: metres per unit of the file, such as 0.01 for centimetres.
        seed: seed of the samples.

    Returns:
        Point cloud, (points, 3), metres, float32, in the frame of the file.

    Raises:
        InputError: the file is missing, unreadable or of another format, or its points are not a point cloud.
    """
    path = existing_file("load_points()", path, tuple(dict.fromkeys(MESH_SUFFIXES + _CLOUD_SUFFIXES)), scale)
    if count is not None:
        checks.count("load_points()", "count", count)
    rng = np.random.default_rng(seed)
    if path.suffix.lower() in MESH_SUFFIXES:
        scene = read_scene("load_points()", path)
        mesh = mesh_in("load_points()", path, scene, scale)
        if mesh is not None:
            points = sample_surface(mesh, 1500 if count is None else count, rng)
            return checks.points("load_points()", points.astype(np.float32), str(path))
        if path.suffix.lower() not in _CLOUD_SUFFIXES:
            raise InputError(f"load_points(): {path} is a mesh without faces; expected a surface, or a cloud as .ply")
        parts = [np.asarray(part.vertices) for part in scene.geometry.values()]
        points = np.concatenate(parts) if parts else np.zeros((0, 3))
    else:
        points = _read_array(path)
    points = checks.points("load_points()", points, str(path)) * scale
    if count is not None and count < len(points):
        points = points[np.sort(rng.choice(len(points), count, replace=False))]
    return checks.points("load_points()", points.astype(np.float32), str(path))


def _read_array(path: Path) -> np.ndarray:
    readers = {".npy": _read_npy, ".npz": _read_npz, ".xyz": _read_xyz, ".pcd": _read_pcd}
    try:
        return readers[path.suffix.lower()](path)
    except (OSError, ValueError, EOFError, LookupError, zipfile.BadZipFile) as error:
        raise unreadable("load_points()", path, error) from error


def _read_npy(path: Path) -> np.ndarray:
    with path.open("rb") as file:
        return np.lib.format.read_array(file, allow_pickle=False)


def _read_npz(path: Path) -> np.ndarray:
    with path.open("rb") as file, np.lib.npyio.NpzFile(file, allow_pickle=False) as arrays:
        names = list(arrays)
        if "points" in names or len(names) == 1:
            return arrays["points" if "points" in names else names[0]]
    raise ValueError(f"it holds the arrays {names}; expected one named points, or a single one")


def _read_xyz(path: Path) -> np.ndarray:
    return _text_columns(path.read_text(), (0, 1, 2))


def _text_columns(text: str, columns: tuple[int, ...]) -> np.ndarray:
    lines = [line for line in text.splitlines() if line.split("#")[0].strip()]
    return np.loadtxt(lines, usecols=columns, ndmin=2) if lines else np.zeros((0, 3))


def _read_pcd(path: Path) -> np.ndarray:
    header, body = {}, path.read_bytes()
    while "DATA" not in header:
        line, newline, body = body.partition(b"\n")
        if not newline:
            raise ValueError("its header has no line DATA")
        key, *values = line.decode("ascii", "replace").split("#")[0].split() or [""]
        header[key] = values
    fields, count = header["FIELDS"], int(header["POINTS"][0])
    lengths = [int(length) for length in header.get("COUNT", ["1"] * len(fields))]
    if header["DATA"] == ["ascii"]:
        starts = np.cumsum([0, *lengths])
        points = _text_columns(body.decode(), tuple(int(starts[fields.index(axis)]) for axis in "xyz"))
    elif header["DATA"] == ["binary"]:
        kinds = {"F": "f", "I": "i", "U": "u"}
        types = [f"<{kinds[kind]}{size}" for kind, size in zip(header["TYPE"], header["SIZE"], strict=True)]
        # Several fields may have the name _ (padding), so the fields of the record are named by their index.
        record = np.dtype([(str(i), *part) for i, part in enumerate(zip(types, lengths, strict=True))])
        rows = np.frombuffer(body, dtype=record, count=count)
        points = np.stack([rows[str(fields.index(axis))].reshape(count) for axis in "xyz"], axis=1)
    else:
        raise ValueError(f"its DATA is {' '.join(header['DATA'])}; expected ascii or binary")
    if len(points) != count:
        raise ValueError(f"it has {len(points)} points; its header promises {count}")
    return points
