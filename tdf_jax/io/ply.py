"""PLY, the polygon file format, ASCII and binary: vertices, polygons and triangle strips."""

import re
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from tdf_jax.io.content import UnsupportedError
from tdf_jax.io.polygons import strip_triangles, triangulate
from tdf_jax.io.text import decode, indices, lines, numbers

_TYPES = {
    **{"char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4"},
    **{"int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4", "uint32": "u4"},
    **{"long": "i8", "ulong": "u8", "int64": "i8", "uint64": "u8"},
    **{"float": "f4", "double": "f8", "float16": "f2", "float32": "f4", "float64": "f8"},
}
_ORDERS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}
_CORNERS = ("vertex_indices", "vertex_index")


@dataclass
class _Element:
    """What a header promises of one kind of row."""

    name: str
    count: int
    names: list[str]  # of the properties
    types: list[str]  # of a number, or of the entries of a list
    lengths: list[str]  # type of a list's length; empty for a number


def read_ply(data: bytes) -> tuple[Float[np.ndarray, "vertices 3"], Int[np.ndarray, "faces 3"]]:
    """Read the surface or the cloud of a PLY file; other elements and properties are left out.

    Args:
        data: content of the file.

    Returns:
        vertices, (vertices, 3), in the unit and frame of the file, all that the file has.
        faces, (faces, 3), polygons and strips cut into triangles; none for a cloud.

    Raises:
        ValueError: the file is damaged.
        UnsupportedError: its vertices have no x, y and z, or its faces no list of vertices.
    """
    order, elements, body = _header(data)
    rows = lines(decode(body), comment=None) if order == "" else []  # a comment is in the header only
    offset, vertices, polygons, strips = 0, None, [], []
    for element in elements:
        corners = next((name for name in _CORNERS if name in element.names), None)
        wanted = {"vertex": ("x", "y", "z"), "face": (corners,), "tristrips": (corners,)}.get(element.name, ())
        if element.count and any(name not in element.names for name in wanted):
            expected = "x, y and z" if element.name == "vertex" else "vertex_indices"
            raise UnsupportedError(
                f"has the properties {', '.join(element.names)} of each {element.name}; expected {expected} among them"
            )
        wanted = wanted if element.count else ()
        if order == "":
            found, offset = _text_columns(element, wanted, rows, offset)
        else:
            found, offset = _binary_columns(element, wanted, body, offset, order)
        known = element.name in {"vertex", "face", "tristrips", "range_grid"}
        if element.count and corners and not known:
            raise UnsupportedError(f"has the element {element.name} with lists of vertices; expected face, tristrips")
        if element.name == "vertex":
            columns = [values for values, _ in found]
            vertices = np.stack(columns, axis=1).astype(np.float64) if columns else np.zeros((0, 3))
        elif wanted:
            (polygons if element.name == "face" else strips).extend(found)
    rest = len(rows) - offset if order == "" else len(body[offset:].strip())
    if rest:
        raise ValueError(f"it has {rest} {'lines' if order == '' else 'bytes'} more than its header promises")
    if vertices is None:
        raise UnsupportedError(f"has the elements {', '.join(e.name for e in elements)}; expected vertex among them")
    faces = [triangulate(vertices, corners, sizes) for corners, sizes in polygons]
    for corners, sizes in strips:
        for strip in np.split(corners, np.cumsum(sizes)[:-1]):
            parts = np.split(strip, np.flatnonzero(strip == -1))
            triangles = np.concatenate([strip_triangles(part[part != -1]) for part in parts])
            faces.append(triangulate(vertices, triangles.ravel(), np.full(len(triangles), 3)))
    return vertices, np.concatenate(faces) if faces else np.zeros((0, 3), dtype=np.int64)


def _header(data):
    """Byte order (empty for text), elements and the bytes after the header."""
    if data[:2] in {b"\xff\xfe", b"\xfe\xff"} or data[:6] in {b"p\0l\0y\0", b"\0p\0l\0y"}:
        data = decode(data).encode()  # text in UTF-16; a binary file has a header of single bytes
    data = data.removeprefix(b"\xef\xbb\xbf")
    end = re.search(rb"(?:^|[\r\n])[ \t]*end_header[ \t]*(\r\n|\n|\r|$)", data)
    if not re.match(rb"ply[ \t]*[\r\n]", data) or not end:
        raise ValueError("its header does not go from ply to end_header")
    stop = end.end()
    if end[1] == b"\r\n" and b"\r\n" not in data[: end.start() + 2]:
        stop -= 1  # lines end by \r, and the body begins with the byte \n
    order, elements = None, []
    for line in lines(decode(data[: end.start()]), comment=None)[1:]:
        match line.split():
            case ["comment" | "obj_info", *_]:
                pass
            case ["format", name, *_] if name in _ORDERS:
                order = _ORDERS[name]
            case ["element", name, count] if count.isdecimal():
                elements.append(_Element(name.lower(), int(count), [], [], []))
            case ["property", "list", length, kind, name] if elements and length in _TYPES and kind in _TYPES:
                if _TYPES[length][0] == "f":
                    raise ValueError(f"its header has lists whose length is of type {length}")
                _add(elements[-1], name, _TYPES[kind], _TYPES[length])
            case ["property", kind, name] if elements and kind in _TYPES:
                _add(elements[-1], name, _TYPES[kind], "")
            case _:
                raise ValueError(f"its header has the line {line[:80]!r}")
    if order is None:
        raise ValueError("its header has no line format")
    return order, elements, data[stop:]


def _add(element, name, kind, length):
    element.names.append(name.lower())
    element.types.append(kind)
    element.lengths.append(length)
    if element.names.count(name.lower()) > 1 and name.lower() in {"x", "y", "z", *_CORNERS}:
        raise ValueError(f"its header has the property {name} of {element.name} twice")


def _text_columns(element, wanted, rows, start):
    """Of each wanted property, (values, lengths of lists), and the line after the element."""
    stop = start + element.count
    if len(rows) < stop:
        raise ValueError(
            f"it is truncated: its header promises {element.count} rows of {element.name}, of which "
            f"{stop - len(rows)} are missing"
        )
    table = [row.split() for row in rows[start:stop]]
    if not any(element.lengths):
        width = len(element.names)
        if any(len(row) != width for row in table):
            raise ValueError(f"a row of {element.name} has not the {width} numbers that the header promises")
        columns = [element.names.index(name) for name in wanted]
        return [(numbers([row[column] for row in table]), None) for column in columns], stop
    found = {name: ([], []) for name in wanted}
    for row in table:
        position = 0
        for name, length in zip(element.names, element.lengths):
            size = int(row[position]) if length and position < len(row) else 1
            position += bool(length)
            if size < 0:
                raise ValueError(f"a row of {element.name} has a list of {size} entries")
            if name in found:
                found[name][0].extend(row[position : position + size])
                found[name][1].append(size)
            position += size
        if position != len(row):
            raise ValueError(
                f"a row of {element.name} has {len(row)} numbers; its lists and properties need {position}"
            )
    read = indices if element.name != "vertex" else numbers
    return [(read(values), np.array(sizes, dtype=np.int64)) for values, sizes in found.values()], stop


def _binary_columns(element, wanted, body, start, order):
    """Of each wanted property, (values, lengths of lists), and the byte after the element."""
    types = [np.dtype(order + kind) for kind in element.types]
    lengths = [np.dtype(order + kind) if kind else None for kind in element.lengths]
    if not any(element.lengths):
        record = np.dtype([(str(i), kind) for i, kind in enumerate(types)])
        stop = start + element.count * record.itemsize
        _promised(element, stop, body)
        rows = np.frombuffer(body[start:stop], dtype=record) if record.itemsize else np.zeros(0, record)
        return [(rows[str(element.names.index(name))], None) for name in wanted], stop
    found, stop = {name: ([], []) for name in wanted}, start  # of each property, its bytes' offsets and its lengths
    alike = _alike(element, types, lengths, body, start)
    if alike is not None:  # the usual case, all rows of one layout, without a loop
        size, offsets, first = alike
        stop = start + element.count * size
        rows = start + np.arange(element.count) * size
        for name in wanted:
            field = element.names.index(name)
            found[name] = ((rows + offsets[field]).tolist(), [first[field]] * element.count)
    for _ in range(element.count if alike is None else 0):
        for name, kind, length in zip(element.names, types, lengths):
            size = 1
            if length is not None:
                size, stop = _length(element, length, body, stop)
            if name in found:
                found[name][0].append(stop)
                found[name][1].append(size)
            stop += size * kind.itemsize
        _promised(element, stop, body)
    columns = []
    for name, (offsets, sizes) in found.items():
        kind, sizes = types[element.names.index(name)], np.array(sizes, dtype=np.int64)
        items = np.arange(sizes.sum()) - np.repeat(np.cumsum(sizes) - sizes, sizes)
        first = np.repeat(np.array(offsets, dtype=np.int64), sizes) + items * kind.itemsize
        raw = np.frombuffer(body, dtype=np.uint8)[first[:, None] + np.arange(kind.itemsize)]
        values = np.ascontiguousarray(raw).view(kind).ravel()
        columns.append((values if element.name == "vertex" else _whole(element, values), sizes))
    return columns, stop


def _whole(element, values):
    """Indices of vertices as int64; some programs write them as floats."""
    if values.dtype.kind == "f" and not (np.abs(values) < 2**53).all() or (values != np.rint(values)).any():
        raise ValueError(f"a row of {element.name} has a vertex that is no whole number")
    return values.astype(np.int64)


def _length(element, kind, body, start):
    """Length of the list that begins at a byte, and the byte after the length."""
    stop = start + kind.itemsize
    _promised(element, stop, body)
    size = int.from_bytes(body[start:stop], "big" if kind.str[0] == ">" else "little", signed=kind.kind == "i")
    if size < 0:
        raise ValueError(f"a row of {element.name} has a list of {size} entries")
    return size, stop


def _alike(element, types, lengths, body, start):
    """Bytes of a row, offsets and lengths of its properties, if all rows are laid out as the first; else None."""
    fields, offsets, sizes, stop = [], [], [], start
    if not element.count:
        return None
    for index, (kind, length) in enumerate(zip(types, lengths)):
        size = 1
        if length is not None:
            size, stop = _length(element, length, body, stop)
            fields.append((f"length {index}", length))
        offsets.append(stop - start)
        sizes.append(size)
        stop += size * kind.itemsize
        _promised(element, stop, body)
        fields.append((str(index), kind, (size,)))
    record = np.dtype(fields)
    if start + element.count * record.itemsize > len(body):
        return None
    rows = np.frombuffer(body, dtype=record, count=element.count, offset=start)
    if any((rows[f"length {i}"] != size).any() for i, size in enumerate(sizes) if lengths[i] is not None):
        return None
    return record.itemsize, offsets, sizes


def _promised(element, stop, body):
    if stop > len(body):
        raise ValueError(
            f"it is truncated: its header promises {element.count} rows of {element.name}, which need {stop} bytes "
            f"after the header, and it has {len(body)}"
        )
