"""OFF, the Object File Format of Geomview: vertices and polygons."""

import re

import numpy as np
from jaxtyping import Float, Int

from tdf_jax.io.content import UnsupportedError
from tdf_jax.io.polygons import triangulate
from tdf_jax.io.text import decode, indices, lines, numbers

# Texture coordinates (ST), colours (C) and normals (N) follow the coordinates; 4 and n change what those are. The
# counts may stand after the keyword, even without a blank, as in the files of ModelNet.
_KEYWORD = re.compile(r"(ST)?(C)?(N)?(4)?(n)?OFF\b\s*|(ST)?(C)?(N)?OFF(?=\d)")


def read_off(data: bytes) -> tuple[Float[np.ndarray, "vertices 3"], Int[np.ndarray, "faces 3"]]:
    """Read the surface of an OFF file; colours, normals and texture coordinates are left out.

    Args:
        data: content of the file.

    Returns:
        vertices, (vertices, 3), and faces, (faces, 3), as of `tdf_jax.io.obj.read_obj`.

    Raises:
        ValueError: the file is damaged.
        UnsupportedError: it is binary, or its vertices have more than three dimensions.
    """
    rows = lines(decode(data))
    if not rows:
        raise ValueError("it has no lines")
    first = rows[0].upper() if rows[0].islower() else rows[0]
    keyword = _KEYWORD.match(first)
    if keyword:
        if keyword[4] or keyword[5]:
            raise UnsupportedError(f"has vertices of {keyword[0].strip()}, not of three dimensions; expected OFF")
        if "BINARY" in first:
            raise UnsupportedError("is a binary OFF file; expected text; save it as ASCII OFF, .ply or .stl")
        rows[0] = rows[0][keyword.end() :]
        rows = rows[not rows[0] :]
    if not rows or len(rows[0].split()) not in {2, 3}:
        raise ValueError("it does not begin by OFF and the numbers of vertices, faces and edges")
    num_vertices, num_faces = (int(count) for count in indices(rows[0].split())[:2])
    table = [row.split() for row in rows[1:]]
    if len(table) != num_vertices + num_faces and not (keyword and keyword[0].strip() != "OFF"):
        table = _rewrapped([word for row in table for word in row], num_vertices, num_faces) or table
    if min(num_vertices, num_faces) < 0 or len(table) != num_vertices + num_faces:
        raise ValueError(
            f"it promises {num_vertices} vertices and {num_faces} faces, and has {len(table)} lines for them"
        )
    points, polygons = table[:num_vertices], table[num_vertices:]
    if any(len(point) < 3 for point in points):
        raise ValueError("it has a vertex of fewer than three numbers")
    vertices = numbers([number for point in points for number in point[:3]]).reshape(-1, 3)
    sizes = indices([polygon[0] for polygon in polygons])
    if any(not 0 <= size < len(polygon) for size, polygon in zip(sizes, polygons)):
        raise ValueError("it has a face with fewer corners than its first number promises")
    corners = [corner for size, polygon in zip(sizes, polygons) for corner in polygon[1 : size + 1]]
    return vertices, triangulate(vertices, indices(corners), sizes)


def _rewrapped(words, num_vertices, num_faces):
    """Rows of a file whose lines end anywhere, which is allowed without colours; None if it is none."""
    rows, start = [words[3 * i : 3 * i + 3] for i in range(max(num_vertices, 0))], 3 * num_vertices
    for _ in range(num_faces):
        if not 0 <= start < len(words) or not words[start].isdecimal():
            return None
        rows.append(words[start : start + int(words[start]) + 1])
        start += int(words[start]) + 1
    return rows if start == len(words) else None
