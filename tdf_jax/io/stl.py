"""STL, binary and ASCII: triangles."""

import re

import numpy as np
from jaxtyping import Float, Int

from tdf_jax.io.polygons import triangulate
from tdf_jax.io.text import decode, numbers

_HEADER = 84  # bytes: 80 of anything, which may begin with "solid", and the number of triangles
_TRIANGLE = np.dtype([("normal", "<f4", 3), ("vertices", "<f4", (3, 3)), ("attribute", "<u2")])
_VERTEX = re.compile(r"\bvertex\s+(\S+)\s+(\S+)\s+(\S+)")
# The name of a solid may be any text, also the word facet. A file may also be written in a single line.
_NAME = re.compile(r"(?:^|(?<=endfacet))[ \t]*(endsolid|solid)\b(?:(?!\bfacet\s+normal\b).)*", re.MULTILINE)


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
        return _ascii(re.sub(r"\bend[ \t]+(?=(loop|facet|solid)\b)", "end", decode(data).lower()))
    if len(data) < _HEADER:
        raise ValueError(f"it has {len(data)} bytes; a binary one has at least {_HEADER}, an ASCII one begins by solid")
    size = _HEADER + count * _TRIANGLE.itemsize
    raise ValueError(
        f"it is {'truncated' if len(data) < size else 'too long'}: its header promises {count} triangles, which are "
        f"{size} bytes, and it has {len(data)}"
    )


def _ascii(text):
    names = [match.group(1) for match in _NAME.finditer(text)]
    if not names or not names[-1].startswith("end") or 2 * names.count("solid") != len(names):
        raise ValueError(f"it is truncated: {names.count('solid')} solids, of which not all have an endsolid")
    text = _NAME.sub(" ", text)
    loops = re.split(r"\bendloop\b", text)
    if len(re.findall(r"\bouter\s+loop\b", text)) != len(loops) - 1 or "vertex" in loops[-1]:
        raise ValueError("it is truncated: not every outer loop has an endloop")
    found = [_VERTEX.findall(loop) for loop in loops[:-1]]
    if sum(map(len, found)) != text.count("vertex"):
        raise ValueError("it has a vertex that is not three numbers")
    vertices = numbers([number for loop in found for vertex in loop for number in vertex]).reshape(-1, 3)
    return vertices, triangulate(vertices, np.arange(len(vertices)), np.array([len(loop) for loop in found], np.int64))
