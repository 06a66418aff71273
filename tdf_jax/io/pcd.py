"""PCD, the clouds of the Point Cloud Library: ascii, binary and binary_compressed."""

import math

import numpy as np
from jaxtyping import Float

from tdf_jax.io.content import UnsupportedError
from tdf_jax.io.text import decode, lines, numbers

_KINDS = {"F": "f", "I": "i", "U": "u"}
_AXES = ("x", "y", "z")


def read_pcd(data: bytes) -> Float[np.ndarray, "points 3"]:
    """Read the points of a PCD file, row by row if it is organised; other fields are left out.

    Args:
        data: content of the file.

    Returns:
        Point cloud, (points, 3), in the unit and frame of the file.

    Raises:
        ValueError: the file is damaged.
        UnsupportedError: it has no fields x, y and z, or a viewpoint other than the origin.
    """
    header, body = _header(data)
    fields, count = [name.lower() for name in header["FIELDS"]], _count(header)
    lengths = [int(length) for length in header.get("COUNT", ["1"] * len(fields))]
    if len(lengths) != len(fields):
        raise ValueError(f"its header has {len(fields)} FIELDS and {len(lengths)} entries of COUNT")
    if any(fields.count(axis) != 1 or lengths[fields.index(axis)] != 1 for axis in _AXES):
        raise UnsupportedError(f"has the fields {' '.join(fields)}; expected x, y and z among them, once each")
    _check_viewpoint(header.get("VIEWPOINT", []))
    if header["DATA"] == ["ascii"]:
        return _text_rows(body, fields, lengths, count)
    types = _types(header, fields)
    if header["DATA"] == ["binary"]:
        return _binary_rows(body, fields, types, lengths, count)
    if header["DATA"] == ["binary_compressed"]:
        return _packed_columns(body, fields, types, lengths, count)
    raise ValueError(f"its DATA is {' '.join(header['DATA'])}; expected ascii, binary or binary_compressed")


def decompress_lzf(data: bytes, size: int) -> bytes:
    """Unpack bytes of liblzf.

    Args:
        data: packed bytes.
        size: number of bytes when unpacked.

    Returns:
        The unpacked bytes.

    Raises:
        ValueError: the data is damaged.
    """
    out, i, end = bytearray(), 0, len(data)
    while i < end and len(out) <= size:
        control = data[i]
        i += 1
        if control < 32:  # a run of bytes as they are
            if i + control + 1 > end:
                raise ValueError("its compressed data ends within a run")
            out += data[i : i + control + 1]
            i += control + 1
            continue
        length = control >> 5
        if length == 7 and i < end:
            length += data[i]
            i += 1
        if i >= end:
            raise ValueError("its compressed data ends within a reference")
        start = len(out) - ((control & 31) << 8) - data[i] - 1
        i, length = i + 1, length + 2
        if start < 0:
            raise ValueError("its compressed data refers to what is before its beginning")
        piece = out[start : start + length]
        out += (piece * (length // len(piece) + 1))[:length]  # a reference may reach into what it makes
    if len(out) != size:
        raise ValueError(f"its compressed data makes at least {len(out)} bytes, and it promises {size}")
    return bytes(out)


def _header(data):
    header, body = {}, data
    if data[:2] in {b"\xff\xfe", b"\xfe\xff"}:
        body = decode(data).encode()  # text in UTF-16
    while "DATA" not in header:
        line, newline, body = body.partition(b"\n")
        if not newline:
            raise ValueError("its header has no line DATA")
        key, *values = decode(line).split("#")[0].split() or [""]
        if key:
            header["FIELDS" if key.upper() == "COLUMNS" else key.upper()] = values
    if "FIELDS" not in header:
        raise ValueError("its header has no line FIELDS")
    return header, body


def _count(header):
    sides = [int(value) for key in ("WIDTH", "HEIGHT") for value in header.get(key, [])]
    points = [int(value) for value in header.get("POINTS", [])]
    if not sides and not points:
        raise ValueError("its header has neither WIDTH nor POINTS")
    count = points[0] if points else math.prod(sides)
    if count < 0 or (sides and points and math.prod(sides) != count):
        raise ValueError(f"its header promises {' x '.join(map(str, sides))} points and {count} POINTS")
    return count


def _check_viewpoint(values):
    viewpoint = numbers(values) if values else np.array([0.0, 0, 0, 1, 0, 0, 0])
    if len(viewpoint) != 7:
        raise ValueError(f"its VIEWPOINT has {len(viewpoint)} numbers; expected 7")
    if viewpoint[:3].any() or viewpoint[4:].any() or not viewpoint[3]:
        # Programs that write one disagree about whether the points are in the frame of the sensor or of the world.
        raise UnsupportedError(
            f"has the VIEWPOINT {' '.join(values)}, so that its points may be in the frame of the sensor or of the "
            "world; expected 0 0 0 1 0 0 0; move the points to the frame you want, or write 0 0 0 1 0 0 0 if they are "
            "in it"
        )


def _types(header, fields):
    kinds, sizes = header["TYPE"], header["SIZE"]
    if len(kinds) != len(fields) or len(sizes) != len(fields):
        raise ValueError(f"its header has {len(fields)} FIELDS, {len(kinds)} of TYPE and {len(sizes)} of SIZE")
    return [np.dtype(f"<{_KINDS[kind.upper()]}{size}") for kind, size in zip(kinds, sizes)]


def _text_rows(body, fields, lengths, count):
    rows = [line.split() for line in lines(decode(body))]
    width = sum(lengths)
    if len(rows) != count:
        raise ValueError(f"it has {len(rows)} points; its header promises {count}")
    if any(len(row) != width for row in rows):
        raise ValueError(f"it has a row without the {width} numbers that its header promises")
    columns = [sum(lengths[: fields.index(axis)]) for axis in _AXES]
    return numbers([row[column] for row in rows for column in columns]).reshape(-1, 3)


def _binary_rows(body, fields, types, lengths, count):
    # Several fields may have the name _ (padding), so the fields of the record are named by their index.
    record = np.dtype([(str(i), *part) for i, part in enumerate(zip(types, lengths))])
    size = count * record.itemsize
    if len(body) < size or body[size:].strip(b"\0\r\n"):
        kind = "truncated" if len(body) < size else "too long"
        raise ValueError(f"it is {kind}: {count} points are {size} bytes, and it has {len(body)}")
    rows = np.frombuffer(body[:size], dtype=record)
    return np.stack([rows[str(fields.index(axis))].reshape(count) for axis in _AXES], axis=1).astype(np.float64)


def _packed_columns(body, fields, types, lengths, count):
    packed, size = (int.from_bytes(body[start : start + 4], "little") for start in (0, 4))
    if len(body) < 8 + packed:
        raise ValueError(f"it is truncated: its data is {8 + packed} bytes, and it has {len(body)}")
    # The Point Cloud Library leaves out padding here, although it may list it; other programs pack it too.
    layouts = [[i for i in range(len(fields)) if padded or fields[i] != "_"] for padded in (True, False)]
    sizes = [count * sum(types[i].itemsize * lengths[i] for i in layout) for layout in layouts]
    if size not in sizes:
        raise ValueError(f"its data is {size} bytes when unpacked; {count} points are {sizes[0]}")
    raw = body[8 : 8 + packed]
    try:
        raw = decompress_lzf(raw, size)
    except ValueError:
        if packed != size:  # some programs write the data as it is if it does not become smaller
            raise
    columns, start = {}, 0
    for i in layouts[sizes.index(size)]:  # one field of all points after the other
        columns[fields[i]] = np.frombuffer(raw, types[i], count * lengths[i], start)
        start += types[i].itemsize * lengths[i] * count
    return np.stack([columns[axis] for axis in _AXES], axis=1).astype(np.float64)
