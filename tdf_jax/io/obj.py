"""Wavefront OBJ: vertices and polygons."""

import numpy as np
from jaxtyping import Float, Int

from tdf_jax.io.content import UnsupportedError
from tdf_jax.io.polygons import triangulate
from tdf_jax.io.text import decode, indices, numbers

# Keywords whose lines may hold names in any encoding: a last byte that looks like \ does not continue them.
_NAMES = {"o", "g", "usemtl", "mtllib", "usemap", "maplib", "s", "mg"}
# Free-form surfaces, the older patches, and what includes another file.
_SURFACES = {"surf": "a free-form surface", "bsp": "a B-spline patch", "bzp": "a Bezier patch", "call": "another file"}


def read_obj(data: bytes) -> tuple[Float[np.ndarray, "vertices 3"], Int[np.ndarray, "faces 3"]]:
    """Read the surface of an OBJ file; groups and objects are joined, lines and points are left out.

    Args:
        data: content of the file.

    Returns:
        vertices, (vertices, 3), in the unit and frame of the file, all that the file has.
        faces, (faces, 3), polygons cut into triangles; none for a cloud.

    Raises:
        ValueError: the file is damaged.
        UnsupportedError: it has surfaces that are not polygons, or weights of vertices.
    """
    vertex_rows, corner_rows, seen, places, has_lines = [], [], [], [], False
    text = decode(data)
    for number, line in _statements(text):
        word, *rest = line.split()
        if word == "v":
            vertex_rows.append(rest)
            if len(rest) not in {3, 4, 6, 7}:
                raise ValueError(f"line {number} has a vertex of {len(rest)} numbers")
        elif word in {"f", "fo"}:
            corner_rows.append([corner.partition("/")[0] for corner in rest] if "/" in line else rest)
            seen.append(len(vertex_rows))
            places.append(number)
        elif word == "l":
            has_lines = True
        elif word in _SURFACES:
            raise UnsupportedError(f"has {_SURFACES[word]} in line {number}; expected polygons only; export it as such")
        elif word[:1].isdigit() or word[:1] in "+-.":
            raise ValueError(f"line {number} begins with the number {word}; expected a keyword such as v or f")
    if corner_rows and len(corner_rows[-1]) < 3 and not text.endswith("\n"):
        raise ValueError(f"it ends within a face of {len(corner_rows[-1])} corners")
    vertices = _vertices(vertex_rows)
    if not corner_rows:
        if has_lines:
            raise UnsupportedError("has no faces, only lines; expected a surface or a point cloud")
        return vertices, np.zeros((0, 3), dtype=np.int64)
    sizes = np.array([len(row) for row in corner_rows])
    corners = indices([corner for row in corner_rows for corner in row])
    number = np.repeat(places, sizes)
    # Indices count from 1; negative ones count back from the last vertex above the line.
    resolved = np.where(corners < 0, np.repeat(seen, sizes) + corners, corners - 1)
    wrong = (corners == 0) | (resolved < 0) | (resolved >= len(vertices))
    if wrong.any():
        first = int(np.argmax(wrong))
        raise ValueError(
            f"line {number[first]} has vertex {corners[first]}; there are {len(vertices)}, counted from 1 or from -1"
        )
    return vertices, triangulate(vertices, resolved, sizes)


def _statements(text):
    """Lines with their numbers: without comments, continued ones joined."""
    pending, start = "", 0
    for number, line in enumerate(text.rstrip("\n").split("\n"), 1):
        if "#" in line:
            line = line.partition("#")[0]
        line = line.strip()
        if pending:
            line, number = f"{pending} {line}", start
        if line.endswith("\\"):
            line = line[:-1].rstrip()
            if line.split(None, 1)[:1] and line.split(None, 1)[0] not in _NAMES:
                pending, start = line, number
                continue
        pending = ""
        if line:
            yield number, line
    if pending:
        raise ValueError(f"it ends within line {start}, which is continued")


def _vertices(rows):
    if not rows:
        return np.zeros((0, 3))
    if any(len(row) in {4, 7} for row in rows):
        weights = numbers([row[3] for row in rows if len(row) == 4])
        if (weights != 1).any():
            raise UnsupportedError(
                "has vertices with a fourth number other than 1, which readers take for different things; expected "
                "x y z, or x y z with a colour; remove the fourth number"
            )
    return numbers([value for row in rows for value in row[:3]]).reshape(-1, 3)
