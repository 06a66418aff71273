"""NumPy files, .npy and .npz: which numbers of an array are points."""

import io

import numpy as np
from jaxtyping import Float

from tdf_jax.io.columns import MOST_COLUMNS, check_unit, coordinate_columns, named_columns
from tdf_jax.io.content import UnsupportedError

_NAMES = ("points", "xyz", "pointcloud", "point_cloud", "cloud", "pc", "coords", "coordinates", "position", "positions")
_QUERIES = {"occupancies", "occupancy", "sdf"}  # beside them, points are samples of space
_LEAST_SIDE = 20  # of an organised cloud; a batch of clouds is mostly smaller


def read_npy(data: bytes, scale: float = 1.0) -> Float[np.ndarray, "points 3"]:
    """Read the points of an .npy file, as `array_points` takes them.

    Args:
        data: content of the file.
        scale: metres per unit of the file, to be compared with a unit that the names of fields tell.

    Returns:
        Point cloud, (points, 3), float64, in the unit and frame of the file.

    Raises:
        ValueError: the file is damaged.
        UnsupportedError: it has more than one array or Python objects, or it is not clear which numbers are points.
    """
    stream = io.BytesIO(data)
    with _no_objects():
        array = np.lib.format.read_array(stream, allow_pickle=False)
    if stream.tell() != len(data):
        raise UnsupportedError("holds more than one array; expected one; save it as .npz with the array points")
    return array_points(array, scale)


def read_npz(data: bytes, scale: float = 1.0) -> Float[np.ndarray, "points 3"]:
    """Read the points of an .npz file: its array `points`, its only one, or the one with a usual name such as xyz.

    Args:
        data: content of the file.
        scale: metres per unit of the file, see `read_npy`.

    Returns:
        Point cloud, (points, 3), as of `read_npy`.

    Raises:
        ValueError: the file is damaged.
        UnsupportedError: it is not clear which array or which numbers are points.
    """
    with np.lib.npyio.NpzFile(io.BytesIO(data), allow_pickle=False) as arrays:
        names = list(arrays)
        usual = [name for name in _NAMES if name in names]
        if _QUERIES & set(names):
            raise UnsupportedError(
                f"holds the arrays {names}, whose points are samples of space; expected points of a surface"
            )
        if "points" in names or len(names) == 1 or len(usual) == 1:
            name = "points" if "points" in names else names[0] if len(names) == 1 else usual[0]
            with _no_objects():
                array = arrays[name]
            if not isinstance(array, np.ndarray):
                raise UnsupportedError(f"holds {name}, which is no array; expected an array named points")
            return array_points(array, scale)
    raise UnsupportedError(
        f"holds the arrays {names}; expected one named points, or a single one; "
        f"np.savez(path, points=np.load(path)[{(names or ['points'])[0]!r}]) saves one of them"
    )


def array_points(array: np.ndarray, scale: float = 1.0) -> Float[np.ndarray, "points 3"]:
    """Take the points from an array, if it is clear which numbers they are.

    Args:
        array: numbers, (points, 3); (points, 4 to 20) with x y z first, as `coordinate_columns` takes them;
            (3, points); (4, points) with a last row of ones; one of these with further axes of length 1;
            (height, width, 3 or more), if neighbours in both directions are near each other; or an array with the
            fields x, y and z.
        scale: metres per unit of the array, to be compared with a unit that the names of fields tell.

    Returns:
        Point cloud, (points, 3), float64.

    Raises:
        UnsupportedError: it is not clear which numbers are points.
    """
    if array.dtype.names:
        return _fields(array, scale)
    if array.dtype.kind not in "fiu":
        raise UnsupportedError(f"has numbers of type {array.dtype}; expected floats; save points.astype(np.float64)")
    values = array.astype(np.float64)
    if values.ndim > 2:
        values = values.squeeze()
    if values.ndim == 3 and array.dtype != np.uint8:
        return _organised(values)
    if values.ndim != 2:
        raise UnsupportedError(
            f"has shape {array.shape} and type {array.dtype}; expected (points, 3); save points.reshape(-1, 3) if its "
            "numbers are x y z of one point after the other"
        )
    rows, columns = values.shape
    if rows == 3 != columns or (rows == 4 < columns and (values[3] == 1).all()):
        return values[:3].T
    if rows <= MOST_COLUMNS < columns:
        raise UnsupportedError(f"has shape {array.shape}; expected (points, 3); save points[:3].T if x y z are first")
    if columns < 3 or columns > MOST_COLUMNS:
        raise UnsupportedError(
            f"has shape {array.shape}; expected (points, 3); save points[:, :3] if x y z are first, and the points of "
            "the depths if this is a depth image"
        )
    return coordinate_columns(values)


class _no_objects:
    """Says what to do about arrays of Python objects, which are never unpickled."""

    def __enter__(self):
        return self

    def __exit__(self, kind, error, trace):
        if isinstance(error, ValueError) and "pickle" in str(error):
            raise UnsupportedError(
                "holds Python objects, which may run code when they are read; expected numbers; save "
                "np.asarray(points.tolist(), dtype=float)"
            ) from None


def _fields(array, scale):
    names = array.dtype.names
    found = named_columns(names)
    if found:
        columns = [array[names[column]].ravel() for column in found[0]]
        if all(column.dtype.kind in "fiu" and column.size == array.size for column in columns):
            check_unit(found[1], scale)
            return np.stack(columns, axis=1).astype(np.float64)
    for name in names:
        if name.lower() in _NAMES and array.dtype[name].shape == (3,) and array.dtype[name].base.kind in "fiu":
            return array[name].reshape(-1, 3).astype(np.float64)
    raise UnsupportedError(f"has the fields {', '.join(names)}; expected numbers x, y and z among them")


def _organised(values):
    shape = values.shape
    if shape[0] == 3 and not 3 <= shape[2] <= 12:
        values = np.moveaxis(values, 0, -1)
    if not 3 <= values.shape[2] <= 12 or min(values.shape[:2]) < _LEAST_SIDE or not _is_surface(values[..., :3]):
        if shape[2] <= 12:
            fix = f"points.reshape(-1, {shape[2]})[:, :3] if it is one cloud, in rows and columns, or points[0] for"
        elif 3 <= shape[1] <= 12:
            fix = (
                "points[:, :3].transpose(0, 2, 1).reshape(-1, 3) if it is one cloud, in pieces, or points[0, :3].T for"
            )
        elif 3 <= shape[0] <= 12:
            fix = "points[:3].reshape(3, -1).T if it is one cloud, in rows and columns, or points[:3, 0].T for"
        else:
            raise UnsupportedError(f"has shape {shape}; expected (points, 3); save the x y z of each point, in rows")
        raise UnsupportedError(
            f"has shape {shape}, which may be several clouds; expected (points, 3); save {fix} the first of several"
        )
    return values[..., :3].reshape(-1, 3)


def _is_surface(grid):
    """Whether neighbours in rows and in columns are near each other, as in an image and not in a batch of clouds."""
    valid = np.isfinite(grid).all(axis=-1) & grid.any(axis=-1)
    if not valid.any():
        return False
    spread = np.linalg.norm(grid[valid].std(axis=0))
    for axis in (0, 1):
        last = len(valid) if axis == 0 else valid.shape[1]
        pairs = np.take(valid, range(last - 1), axis) & np.take(valid, range(1, last), axis)
        steps = np.linalg.norm(np.diff(np.where(valid[..., None], grid, 0.0), axis=axis), axis=-1)[pairs]
        if len(steps) == 0 or not np.median(steps) < 0.5 * spread:
            return False
    return True
