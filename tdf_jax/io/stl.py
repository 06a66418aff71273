"""STL, binary and ASCII: triangles."""

import re

import numpy as np
from jaxtyping import Float, Int

from tdf_jax.io.polygons import triangulate
from tdf_jax.io.text import decode, numbers

_HEADER = 84  # bytes: 80 of anything, which may begin with "solid", and the number of triangles
_TRIANGLE = np.dtype([("normal", "<f4", 3), ("vertices", "<f4", (3, 3)), ("attribute", "<u2")])


def read_stl(data: bytes) -> tuple[Float[np.ndarray, "vertices 3"], Int[np.ndarray, "faces 3"]]:
    """Read the surface of an STL file; several solids are joined. Normals and attributes are left out.

    Args:
        data: content of the file.

    Returns:
        vertices, (vertices, 3), in the unit and frame of the file, those of each triangle.
        faces, (faces, 3).

    Raises:
        ValueError: the file is damaged.
    """
    count = int.from_bytes(data[80:_HEADER], "little")
    if len(data) >= _HEADER and len(data) == _HEADER + count * _TRIANGLE.itemsize:
        vertices = np.frombuffer(data, dtype=_TRIANGLE, offset=_HEADER)["vertices"].reshape(-1, 3).astype(np.float64)
        return vertices, np.arange(len(vertices)).reshape(-1, 3)
    head = decode(data[:512])
    if re.match(r"\s*solid\b", head, re.IGNORECASE) and "\0" not in head[:_HEADER]:  # a count has a zero byte
        return _ascii(decode(data).lower())
    if len(data) < _HEADER:
        raise ValueError(f"it has {len(data)} bytes; a binary one has at least {_HEADER}, an ASCII one begins by solid")
    size = _HEADER + count * _TRIANGLE.itemsize
    raise ValueError(
        f"it is {'truncated' if len(data) < size else 'too long'}: its header promises {count} triangles, which are "
        f"{size} bytes, and it has {len(data)}"
    )


def _ascii(text):
    if re.search("end[ \t]", text):
        text = re.sub(r"\bend[ \t]+(?=(loop|facet|solid)\b)", "end", text)
    text, names = _without_names(text)
    if not names or names[-1] != "endsolid" or 2 * names.count("solid") != len(names):
        raise ValueError(f"it is truncated: {names.count('solid')} solids, of which not all have an endsolid")
    *loops, rest = text.split("endloop")
    if "loop" in rest or "vertex" in rest:
        raise ValueError("it is truncated: not every outer loop has an endloop")
    found = [_corners(loop.split()) for loop in loops]
    coordinates = [number for corners in found for number in corners]
    sizes = np.array([len(corners) // 3 for corners in found], dtype=np.int64)
    vertices = numbers(coordinates).reshape(-1, 3)
    return vertices, triangulate(vertices, np.arange(len(vertices)), sizes)


def _corners(words):
    """Coordinates of the vertices of a loop, which follow the words outer loop."""
    first = words.index("vertex") if "vertex" in words else len(words)
    vertices = words[first:]
    if (
        words[first - 2 : first] != ["outer", "loop"]
        or len(vertices) % 4
        or vertices[::4].count("vertex") * 4 != len(vertices)
    ):
        raise ValueError(
            "it has a vertex that is not three numbers, or a loop without its words outer loop and endloop"
        )
    del vertices[::4]
    return vertices


def _without_names(text):
    """Text without the lines solid and endsolid, whose names may be any words, and the keywords of these lines."""
    pieces, keywords, last, position = [], [], 0, 0
    while (found := text.find("solid", position)) >= 0:
        start = found - 3 if text.startswith("end", max(found - 3, 0)) else found
        before = text[text.rfind("\n", 0, start) + 1 : start].strip()
        position = found + len("solid")
        if before and not before.endswith("endfacet"):
            continue
        stop = text.find("\n", position)
        stop = len(text) if stop < 0 else stop
        facet = re.search(r"\bfacet\s+normal\b", text[position:stop])  # a file may be one line
        position = position + facet.start() if facet else stop
        pieces.append(text[last:start])
        keywords.append(text[start : found + len("solid")])
        last = position
    return " ".join([*pieces, text[last:]]), keywords
