"""Contents of files: bytes, what they hold in spite of the suffix, and the errors of what cannot be read."""

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
from jaxtyping import Float

from tdf_jax._internal import checks
from tdf_jax._internal.errors import InputError

# What the content of a file begins with, and the suffix that belongs to it.
_MAGIC = {
    b"ply\n": ".ply",
    b"ply\r": ".ply",
    b"glTF": ".glb",
    b"\x93NUMPY": ".npy",
    b"# .PCD": ".pcd",
    b"#.PCD": ".pcd",
}
# First bytes of files of other kinds, what such a file is, and the fix; None if the fix depends on the reader.
_FOREIGN: dict[bytes, tuple[str, str | None]] = {
    b"version https://git-lfs": ("is a pointer of Git LFS, not the file itself", "run git lfs pull"),
    b"\x1f\x8b": ("is compressed by gzip", "unpack it by gunzip"),
    b"BZh": ("is compressed by bzip2", "unpack it by bunzip2"),
    b"\xfd7zXZ": ("is compressed by xz", "unpack it by unxz"),
    b"\x28\xb5\x2f\xfd": ("is compressed by zstd", "unpack it by unzstd"),
    b"PK\x03\x04": ("is a zip archive", "unpack it"),
    b"7z\xbc\xaf": ("is a 7z archive", "unpack it"),
    b"Rar!": ("is a RAR archive", "unpack it"),
    b"\x89HDF": ("is an HDF5 file", None),
    b"\x89PNG": ("is a picture", None),
    b"\xff\xd8\xff": ("is a picture", None),
    b"LASF": ("is a LAS cloud", None),
    b"%PDF": ("is a PDF document", None),
    b"<!doctype html": ("is a web page", "download the file itself"),
    b"<html": ("is a web page", "download the file itself"),
}
_FIXES = {
    "is an HDF5 file": "read the array by h5py and save it by np.save",
    "is a LAS cloud": "convert it to .ply",
}
_LONGEST_REASON = 300  # characters: some parsers quote all that they could not read
_SPACING = 1e-3  # metres between neighbouring numbers of a file, above which a shape is not what was measured


class UnsupportedError(ValueError):
    """Raised for a valid file that uses what is not read; the message says what, what is expected and the fix."""


def known_suffix(function: str, path: str | os.PathLike, suffixes: tuple[str, ...]) -> Path:
    """Check that a path has one of several suffixes, in lower or upper case.

    Args:
        function: name that error messages begin with.
        path: file to read or to write.
        suffixes: known suffixes, in lower case.

    Returns:
        The path.

    Raises:
        InputError: the suffix is unknown.
    """
    path = checks.path(function, path)
    if path.suffix.lower() not in suffixes:
        expected = suffixes[0] if len(suffixes) == 1 else f"one of {', '.join(suffixes)}"
        raise InputError(f"{function}: {path} has suffix {path.suffix!r}; expected {expected}")
    return path


def supported_file(function: str, path: str | Path, suffixes: tuple[str, ...], scale: float) -> Path:
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
    path = known_suffix(function, path, suffixes)
    checks.existing_file(function, path)
    checks.positive(function, "scale", scale, "metres per unit of the file")
    return path


@contextmanager
def reading(function: str, path: Path) -> Iterator[None]:
    """Turn what a reader raises into an `InputError` that names the file.

    Args:
        function: name that error messages begin with.
        path: file that is read.

    Yields:
        None, while the file is read.

    Raises:
        InputError: the reader raised.
    """
    try:
        yield
    except InputError:
        raise
    except UnsupportedError as error:
        raise InputError(f"{function}: {path} {error}") from error
    except OSError as error:
        reason = error.strerror or str(error)
        raise InputError(f"{function}: {path} cannot be opened ({reason}); expected a file you may read") from error
    except Exception as error:  # what parsers of damaged files raise goes from KeyError to RecursionError
        reason = (str(error) or type(error).__name__)[:_LONGEST_REASON]
        suffix = path.suffix.lower()
        raise InputError(f"{function}: {path} cannot be read as {suffix} ({reason}); save it again") from error


def foreign_kind(data: bytes) -> tuple[str, str | None] | None:
    """Recognise a file that is no mesh, cloud or checkpoint at all, such as a web page.

    Args:
        data: content of the file, or its first 512 bytes.

    Returns:
        What it is, such as "is a web page", and the fix, which is None if it depends on the reader; None for the pair
        if the kind is not known.
    """
    start = data[:512].lstrip(b"\xef\xbb\xbf \t\r\n").lower()
    return next((kind for magic, kind in _FOREIGN.items() if start.startswith(magic.lower())), None)


def file_bytes(path: Path) -> bytes:
    """Read the bytes of a file, unless they are plainly of another kind than the suffix says.

    Args:
        path: file to read.

    Returns:
        All bytes of the file.

    Raises:
        OSError: the file cannot be opened.
        ValueError: the file is empty.
        UnsupportedError: it is compressed, a web page, or of another format.
    """
    data, suffix = path.read_bytes(), path.suffix.lower()
    if not data:
        raise ValueError("it is empty, 0 bytes")
    foreign = foreign_kind(data)
    if foreign is not None and suffix != ".npz":  # which is itself a zip archive, of arrays
        kind, fix = foreign
        fix = fix or _FIXES.get(kind, "give the cloud or the mesh")
        raise UnsupportedError(f"{kind}; expected the content of a {suffix} file; {fix}")
    for magic, other in _MAGIC.items():
        if data.startswith(magic) and suffix != other and {suffix, other} != {".glb", ".gltf"}:
            raise UnsupportedError(f"holds the content of a {other} file; expected {suffix}; rename it to {other}")
    return data


def check_spacing(function: str, path: Path, points: Float[np.ndarray, "points 3"], scale: float) -> None:
    """Refuse points that float32 has rounded to more than 1 mm, as it does in map coordinates.

    Args:
        function: name that error messages begin with.
        path: file of the points, for error messages.
        points: points, (points, 3), finite, in the unit of the file.
        scale: metres per unit of the file.

    Raises:
        InputError: all points are float32 numbers, and these are more than 1 mm apart where half of the points are.
    """
    with np.errstate(over="ignore"):
        if not len(points) or (points.astype(np.float32) != points).any():
            return  # float64 says more, whatever type a header names
    far = np.median(np.abs(points), axis=0).max()  # not the largest, which may be one wrong measurement
    step = float(np.spacing(np.float32(far)))
    if step < 1 and (points == np.rint(points)).all():
        return  # whole numbers, which float32 holds exactly
    spacing = step * scale
    if spacing > _SPACING:
        raise InputError(
            f"{function}: {path} stores float32 numbers, which are {spacing:.2g} m apart at its coordinates of "
            f"{far * scale:.3g} m, so that shapes are lost; expected at most {_SPACING:g} m; export it with doubles "
            "or relative to an offset near the points, or pass scale if its unit is not metres"
        )
