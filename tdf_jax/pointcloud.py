"""Point clouds on the host: read meshes and clouds, check, sample, thin, cut to what a camera sees.

Points are numpy arrays (points, 3) in metres. Meshes are read with trimesh, imported only when one is.
"""

import zipfile
from pathlib import Path
from typing import TYPE_CHECKING

import jax
import numpy as np
from jaxtyping import Float, Int

from tdf_jax.errors import InputError

if TYPE_CHECKING:
    import trimesh

MINIMUM_POINTS = 21  # the encoder's 20 nearest neighbours, the point itself included, and one to choose from

MESH_SUFFIXES = (".obj", ".stl", ".ply", ".glb", ".off")
_CLOUD_SUFFIXES = (".ply", ".npy", ".npz", ".xyz", ".pcd")


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
    path = _existing_file("load_mesh", path, MESH_SUFFIXES, scale)
    mesh = _mesh_in("load_mesh", path, _read_scene("load_mesh", path), scale)
    if mesh is None:
        raise InputError(f"load_mesh(): {path} has no faces; expected a surface. A cloud is read by load_points().")
    return mesh


def load_points(
    path: str | Path, count: int | None = None, scale: float = 1.0, seed: int = 0
) -> Float[np.ndarray, "points 3"]:
    """Read a point cloud, or sample one from a mesh.

    Args:
        path: A mesh (.obj, .stl, .ply, .glb, .off) or a cloud (.ply without faces, .npy, .npz with the array
            `points` or a single array, .xyz with x y z first in each line, .pcd ascii or binary).
        count: How many points: of a mesh, drawn by area (default 1500); of a larger cloud, a random subset in the
            file's order (default all points).
        scale: Metres per unit of the file: 0.01 for centimetres.
        seed: Seed of the draw.

    Returns:
        Points, metres, float32.

    Raises:
        InputError: If the file is missing, unreadable or of another kind, or its points fail `check_points`.
    """
    path = _existing_file("load_points", path, tuple(dict.fromkeys(MESH_SUFFIXES + _CLOUD_SUFFIXES)), scale)
    if count is not None and count < 1:
        raise InputError(f"load_points(): count is {count}; expected at least 1, or None for the default.")
    rng = np.random.default_rng(seed)
    if path.suffix.lower() in MESH_SUFFIXES:
        scene = _read_scene("load_points", path)
        mesh = _mesh_in("load_points", path, scene, scale)
        if mesh is not None:
            points = sample_surface(mesh, 1500 if count is None else count, rng)
            return check_points(points.astype(np.float32), str(path))
        if path.suffix.lower() not in _CLOUD_SUFFIXES:
            raise InputError(f"load_points(): {path} is a mesh without faces; expected a surface, or a cloud as .ply.")
        parts = [np.asarray(part.vertices) for part in scene.geometry.values()]
        points = np.concatenate(parts) if parts else np.zeros((0, 3))
    else:
        points = _read_array(path)
    points = check_points(points, str(path)) * scale
    if count is not None and count < len(points):
        points = points[np.sort(rng.choice(len(points), count, replace=False))]
    return check_points(points.astype(np.float32), str(path))


def check_points(points, name: str = "points"):
    """Check that an array can be encoded as a point cloud; nothing is changed or dropped.

    Under `jax.jit` only the shape is checked: the values are not known yet.

    Args:
        points: Array (points, 3), numpy or jax, metres.
        name: What the message calls it.

    Returns:
        The same array; a list as a numpy array, integers as float32.

    Raises:
        InputError: If the shape is not (points, 3), there are fewer than 21, one is not finite, or all are equal.
    """
    if not isinstance(points, jax.Array):
        try:
            points = np.asarray(points)
        except ValueError as error:
            raise InputError(f"check_points(): {name} is not an array of numbers: {error}") from error
    if points.dtype.kind in "iu":
        points = points.astype(np.float32)
    if not jax.numpy.issubdtype(points.dtype, np.floating):
        raise InputError(f"check_points(): {name} has dtype {points.dtype}; expected floating point metres.")
    if points.ndim != 2 or points.shape[1] != 3:
        raise InputError(f"check_points(): {name} has shape {points.shape}; expected (points, 3).")
    if len(points) < MINIMUM_POINTS:
        raise InputError(
            f"check_points(): {name} has {len(points)} points; expected at least {MINIMUM_POINTS} "
            "(the encoder looks at 20 neighbours). Use a denser cloud."
        )
    if isinstance(points, jax.core.Tracer):
        return points
    values = np.asarray(points)
    bad = np.count_nonzero(~np.isfinite(values).all(axis=1))
    if bad:
        raise InputError(
            f"check_points(): {bad} of the {len(values)} points of {name} are NaN or infinite; expected finite "
            "metres. Remove them: points[np.isfinite(points).all(axis=1)]."
        )
    if not np.ptp(values, axis=0).any():
        raise InputError(
            f"check_points(): the {len(values)} points of {name} are all equal to {values[0].tolist()}; "
            "expected a surface."
        )
    return points


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


def thin(points: Float[np.ndarray, "points 3"], count: int) -> Float[np.ndarray, "thinned 3"]:
    """Evenly spread subset of a cloud by farthest-point thinning; arguments and errors as `thin_indices`."""
    indices = thin_indices(points, count)
    return points if len(indices) == len(points) else points[indices]


def thin_indices(points: Float[np.ndarray, "points 3"], count: int) -> Int[np.ndarray, " thinned"]:
    """Indices of a farthest-point thinning: deterministic, distinct, each the farthest from those before it.

    The first is the point farthest from the mean; ties go to the lowest index.

    Args:
        points: Points, metres.
        count: How many to keep, at least 1.

    Returns:
        Indices in the order of choice; if there are no more points than count, all of them in their own order.

    Raises:
        InputError: If count is below 1 or the shape is not (points, 3).
    """
    points = np.asarray(points)
    if points.ndim != 2 or points.shape[1] != 3:
        raise InputError(f"thin(): points have shape {points.shape}; expected (points, 3).")
    if count < 1:
        raise InputError(f"thin(): count is {count}; expected at least 1.")
    if len(points) <= count:
        return np.arange(len(points))
    x, y, z = np.ascontiguousarray((points - points.mean(axis=0)).T)  # columns: five times faster than rows
    distance = x * x + y * y + z * z
    indices = np.empty(count, dtype=np.int64)
    indices[0] = np.argmax(distance)
    distance.fill(np.inf)
    for i in range(1, count):
        last = indices[i - 1]
        dx, dy, dz = x - x[last], y - y[last], z - z[last]
        np.minimum(distance, dx * dx + dy * dy + dz * dz, out=distance)
        distance[last] = -1  # never again, even where other points coincide with chosen ones
        indices[i] = np.argmax(distance)
    return indices


def single_view(
    points: Float[np.ndarray, "points 3"], camera: Float[np.ndarray, "3"], reach: float = 100.0
) -> Float[np.ndarray, "visible 3"]:
    """The points a camera sees: hidden point removal by spherical flipping.

    Points are mirrored outwards through a large sphere around the camera; those on the convex hull of the mirrored
    points and the camera are visible. With the default reach, on 1500 points of a real mug seen from 0.6 m, 81-92 %
    of the points returned are truly visible, and 81-96 % of those visible are returned.

    Args:
        points: Points of an object, metres.
        camera: Position of the camera, metres, the same frame.
        reach: Radius of the sphere over the distance of the farthest point, above 1. Larger returns more points:
            a small one misses surfaces at grazing angles, a large one sees through sparse surfaces.

    Returns:
        The points seen, in their order.

    Raises:
        InputError: If the shapes are wrong, the camera is at a point, or points and camera lie in one plane.

    Source:
        Katz, Tal and Basri, Direct visibility of point sets, SIGGRAPH 2007.
    """
    return merge_views(points, np.asarray(camera)[None], reach)


def merge_views(
    points: Float[np.ndarray, "points 3"], cameras: Float[np.ndarray, "cameras 3"], reach: float = 100.0
) -> Float[np.ndarray, "visible 3"]:
    """The points that at least one of several cameras sees, in their order; see `single_view`."""
    points, cameras = np.asarray(points), np.asarray(cameras)
    if points.ndim != 2 or points.shape[1] != 3 or cameras.ndim != 2 or cameras.shape[1] != 3 or len(cameras) == 0:
        raise InputError(
            f"merge_views(): points have shape {points.shape} and cameras {cameras.shape}; "
            "expected (points, 3) and (cameras, 3) with at least one camera."
        )
    if not reach > 1:
        raise InputError(f"merge_views(): reach is {reach}; expected more than 1.")
    return points[np.unique(np.concatenate([_visible(points, camera, reach) for camera in cameras]))]


def _visible(points: np.ndarray, camera: np.ndarray, reach: float) -> np.ndarray:
    from scipy.spatial import ConvexHull, QhullError

    from_camera = points.astype(np.float64) - camera
    distance = np.linalg.norm(from_camera, axis=1, keepdims=True)
    if not distance.all():
        raise InputError(f"merge_views(): the camera {camera.tolist()} is at one of the points; move it away.")
    flipped = from_camera * (2 * reach * distance.max(initial=0) / distance - 1)
    try:
        hull = ConvexHull(np.concatenate([flipped, np.zeros((1, 3))]))
    except (QhullError, ValueError) as error:
        raise InputError(
            f"merge_views(): the {len(points)} points and the camera {camera.tolist()} lie in one plane or are not "
            "finite; expected at least 3 finite points and a camera outside their plane."
        ) from error
    return hull.vertices[hull.vertices < len(points)]


def _existing_file(function: str, path: str | Path, suffixes: tuple[str, ...], scale: float) -> Path:
    path = Path(path)
    if path.suffix.lower() not in suffixes:
        raise InputError(f"{function}(): {path} has suffix {path.suffix!r}; expected one of {', '.join(suffixes)}.")
    if not path.is_file():
        raise InputError(f"{function}(): there is no file {path}; check the path.")
    if not (np.isfinite(scale) and scale > 0):
        raise InputError(f"{function}(): scale is {scale}; expected metres per unit of the file, above 0.")
    return path


def _unreadable(function: str, path: Path, error: Exception) -> InputError:
    reason = str(error) or type(error).__name__
    return InputError(f"{function}(): {path} cannot be read as {path.suffix.lower()}: {reason}. Save it again.")


def _read_scene(function: str, path: Path) -> "trimesh.Scene":
    import trimesh

    try:
        # Unprocessed: processing would silently drop vertices that are not finite.
        return trimesh.load_scene(str(path), process=False)
    except Exception as error:  # damaged files raise whatever the parser stumbles on, struct.error to IndexError
        raise _unreadable(function, path, error) from error


def _mesh_in(function: str, path: Path, scene: "trimesh.Scene", scale: float) -> "trimesh.Trimesh | None":
    if not any(len(getattr(part, "faces", ())) for part in scene.geometry.values()):
        return None
    mesh = scene.to_mesh()
    if not np.isfinite(mesh.vertices).all():
        raise InputError(f"{function}(): {path} has vertices that are NaN or infinite; expected finite coordinates.")
    mesh.merge_vertices(merge_tex=True, merge_norm=True)
    return mesh.apply_scale(scale)


def _read_array(path: Path) -> np.ndarray:
    readers = {".npy": _read_npy, ".npz": _read_npz, ".xyz": _read_xyz, ".pcd": _read_pcd}
    try:
        return readers[path.suffix.lower()](path)
    except (OSError, ValueError, EOFError, LookupError, zipfile.BadZipFile) as error:
        raise _unreadable("load_points", path, error) from error


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
        points = _text_columns(body.decode(), tuple(starts[fields.index(axis)] for axis in "xyz"))
    elif header["DATA"] == ["binary"]:
        kinds = {"F": "f", "I": "i", "U": "u"}
        types = [f"<{kinds[kind]}{size}" for kind, size in zip(header["TYPE"], header["SIZE"], strict=True)]
        # Fields may share the name _ (padding), so the record's names are their positions.
        record = np.dtype([(str(i), *part) for i, part in enumerate(zip(types, lengths, strict=True))])
        rows = np.frombuffer(body, dtype=record, count=count)
        points = np.stack([rows[str(fields.index(axis))].reshape(count) for axis in "xyz"], axis=1)
    else:
        raise ValueError(f"its DATA is {' '.join(header['DATA'])}; expected ascii or binary")
    if len(points) != count:
        raise ValueError(f"it has {len(points)} points; its header promises {count}")
    return points
