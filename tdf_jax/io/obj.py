"""Wavefront OBJ: vertices and polygons."""

import re

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
    # Lines are kept as text and split at once, which is quicker than many short lists.
    vertex_lines, face_lines, vertex_sizes, sizes, seen, places, has_lines = [], [], [], [], [], [], False
    text = decode(data)
    for number, line in _statements(text):
        words = line.split()
        word, size = words[0], len(words) - 1
        if word == "v":
            if size not in {3, 4, 6, 7}:
                raise ValueError(f"line {number} has a vertex of {size} numbers")
            vertex_lines.append(line)
            vertex_sizes.append(size)
        elif word in {"f", "fo"}:
            face_lines.append(line)
            sizes.append(size)
            seen.append(len(vertex_lines))
            places.append(number)
        elif word == "l":
            has_lines = True
        elif word in _SURFACES:
            raise UnsupportedError(f"has {_SURFACES[word]} in line {number}; expected polygons only; export it as such")
        elif word[:1].isdigit() or word[:1] in "+-.":
            raise ValueError(f"line {number} begins with the number {word}; expected a keyword such as v or f")
    if sizes and sizes[-1] < 3 and not text.endswith("\n"):
        raise ValueError(f"it ends within a face of {sizes[-1]} corners")
    vertices = _vertices(vertex_lines, vertex_sizes)
    if not face_lines:
        if has_lines:
            raise UnsupportedError("has no faces, only lines; expected a surface or a point cloud")
        return vertices, np.zeros((0, 3), dtype=np.int64)
    words = re.sub(r"/\S*", "", " ".join(face_lines)).split()
    corners = indices([word for word in words if word not in {"f", "fo"}])
    if len(corners) != sum(sizes):
        raise ValueError("it has a face with a corner that has no vertex")
    sizes = np.array(sizes)
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


def _vertices(lines, sizes):
    if not lines:
        return np.zeros((0, 3))
    if len(set(sizes)) == 1:
        words, step = " ".join(lines).split(), sizes[0] + 1
        columns = [words[column::step] for column in range(1, step)]
        weights = columns[3] if step == 5 else []
    else:
        rows = [line.split() for line in lines]
        columns = [[row[column] for row in rows] for column in (1, 2, 3)]
        weights = [row[4] for row in rows if len(row) == 5]
    if (numbers(weights) != 1).any():
        raise UnsupportedError(
            "has vertices with a fourth number other than 1, which readers take for different things; expected "
            "x y z, or x y z with a colour; remove the fourth number"
        )
    x, y, z = columns[:3]
    return numbers([*x, *y, *z]).reshape(3, -1).T.copy()
