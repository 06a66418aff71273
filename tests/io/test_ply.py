"""PLY files as programs write them: a prism over an L of hexagons and quads, or a box, and clouds."""

import struct

import numpy as np
import pytest
import trimesh

from tdf_jax._internal.errors import InputError
from tdf_jax.io.meshes import load_mesh
from tdf_jax.io.pointclouds import load_points

BASE = [(3, 0), (3, 1), (1, 1), (1, 3), (0, 3), (0, 0)]
VERTICES = [(x, y, z) for z in (0, 2) for x, y in BASE]
POLYGONS = [[5, 4, 3, 2, 1, 0], [6, 7, 8, 9, 10, 11], *([i, (i + 1) % 6, (i + 1) % 6 + 6, i + 6] for i in range(6))]
FORMATS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}
CODES = {
    **{"char": "b", "uchar": "B", "short": "h", "ushort": "H", "int": "i", "uint": "I", "float": "f", "double": "d"},
    **{"int8": "b", "uint8": "B", "int16": "h", "uint16": "H", "int32": "i", "uint32": "I"},
    **{"float32": "f", "float64": "d"},
}


def ply(kind, elements, newline="\n", extra=""):
    """Write elements: (name, properties, rows), each property of a kind like "float" or a pair for lists."""
    header = [f"ply{newline}format {kind} 1.0", *extra.splitlines()]
    body = b""
    for name, properties, rows in elements:
        header.append(f"element {name} {len(rows)}")
        for label, type_ in properties.items():
            header.append(f"property {type_ if isinstance(type_, str) else 'list ' + ' '.join(type_)} {label}")
        for row in rows:
            flat = []
            for type_, value in zip(properties.values(), row, strict=True):
                if isinstance(type_, str):
                    flat.append((type_, value))
                else:
                    flat += [(type_[0], len(value)), *((type_[1], entry) for entry in value)]
            if kind == "ascii":
                words = (f"{value:.9g}" if type_[0] in "fd" else str(int(value)) for type_, value in flat)
                body += (" ".join(words) + newline).encode()
            else:
                codes = "".join(CODES[type_] for type_, _ in flat)
                body += struct.pack(FORMATS[kind] + codes, *(value for _, value in flat))
    return newline.join([*header, "end_header", ""]).encode("latin-1") + body


XYZ = {"x": "float", "y": "float", "z": "float"}


def vertex(number="float"):
    return ("vertex", dict.fromkeys("xyz", number), VERTICES)


def face(length="uchar", index="int", name="vertex_indices", polygons=POLYGONS):
    return ("face", {name: (length, index)}, [[polygon] for polygon in polygons])


TRIANGLES = [[0, polygon[i], polygon[i + 1]] for polygon in POLYGONS for i in range(1, len(polygon) - 1)]
LAYOUTS = {
    "triangles, quads and hexagons": [vertex(), face()],
    "vertex_index": [vertex(), face(name="vertex_index")],
    "faces before vertices": [face(), vertex()],
    "double": [vertex("double"), face("uint", "uint")],
    "short coordinates": [vertex("short"), face("int", "short")],
    "modern names of types": [vertex("float32"), face("uint8", "int32")],
    "smallest types": [vertex("int8"), face("uint8", "uint8")],
    "ushort lengths": [vertex(), face("ushort", "ushort")],
    "signed lengths": [vertex(), face("char", "char")],
    "one face each of two elements": [vertex(), face(polygons=POLYGONS[:4]), face(polygons=POLYGONS[4:])],
    "colours and normals": [
        ("vertex", {"nx": "float", **XYZ, "red": "uchar", "quality": "double"}, [(0, *v, 255, 0.5) for v in VERTICES]),
        (
            "face",
            {"flags": "int", "texcoord": ("uchar", "float"), "vertex_indices": ("uchar", "int"), "red": "uchar"},
            [(7, [0.5] * (2 * i), polygon, 255) for i, polygon in enumerate(POLYGONS)],
        ),
    ],
    "lists of vertices": [
        ("vertex", {"weights": ("uchar", "float"), **XYZ}, [([0.5] * (i % 3), *v) for i, v in enumerate(VERTICES)]),
        face(),
    ],
    "edges and materials": [
        ("material", {"shine": "float"}, [(0.5,)]),
        vertex(),
        ("edge", {"vertex1": "int", "vertex2": "int"}, [(0, 1), (1, 2)]),
        face(),
        ("tags", {"words": ("uchar", "uchar")}, [([1, 2],), ([],)]),
    ],
    "points and lines among the faces": [vertex(), face(polygons=[[], [0], [0, 1], *POLYGONS])],
}


@pytest.mark.parametrize("kind", FORMATS)
@pytest.mark.parametrize("name", LAYOUTS)
def test_an_l_is_read_in_every_layout(tmp_path, name, kind):
    (tmp_path / "l.ply").write_bytes(ply(kind, LAYOUTS[name]))
    mesh = load_mesh(tmp_path / "l.ply")
    assert mesh.is_watertight
    assert len(mesh.vertices) == 12 and len(mesh.faces) == 20
    assert mesh.volume == pytest.approx(10) and mesh.area == pytest.approx(34)
    np.testing.assert_array_equal(mesh.bounds, [[0, 0, 0], [3, 3, 2]])


@pytest.mark.parametrize("kind", FORMATS)
def test_polygons_may_have_255_corners(tmp_path, kind):
    """Beside a triangle, so that the rows differ in length."""
    turn = np.linspace(0, 2 * np.pi, 256)[:-1]
    vertices = [(np.cos(angle), np.sin(angle), 0.0) for angle in turn]
    elements = [("vertex", XYZ, vertices), face(polygons=[list(range(255)), [2, 1, 0]])]
    (tmp_path / "disc.ply").write_bytes(ply(kind, elements))
    mesh = load_mesh(tmp_path / "disc.ply")
    assert len(mesh.faces) == 254
    assert mesh.area == pytest.approx(np.pi, rel=1e-3)


@pytest.mark.parametrize("kind", FORMATS)
def test_strips_are_read(tmp_path, kind):
    """A box of two strips, parted by -1, the second of which begins with a turn of its corner."""
    corners = [(x, y, z) for z in (0, 3) for y in (0, 2) for x in (0, 1)]
    strips = [0, 2, 1, 3, 5, 7, 4, 6, -1, 3, 2, 7, 6, 6, 2, 4, 0, 5, 1]
    elements = [("vertex", XYZ, corners), ("tristrips", {"vertex_indices": ("int", "int")}, [(strips,)])]
    (tmp_path / "box.ply").write_bytes(ply(kind, elements))
    mesh = load_mesh(tmp_path / "box.ply")
    assert mesh.is_watertight
    assert mesh.volume == pytest.approx(6) and mesh.area == pytest.approx(22)


@pytest.mark.parametrize("kind", FORMATS)
@pytest.mark.parametrize("newline", ["\n", "\r\n", "\r"])
def test_lines_may_end_as_on_any_system(tmp_path, kind, newline):
    """Also if the first byte behind the header is that of a line feed, and comments are in any encoding."""
    first = struct.unpack(
        "<f" if kind.endswith("little_endian") else ">f", b"\n\0\0\0" if "little" in kind else b"\n\1\1\1"
    )
    vertices = [(*first, 0, 0), *VERTICES]
    polygons = [[i + 1 for i in polygon] for polygon in POLYGONS]
    extra = "comment T\xfclle\nobj_info end_header\ncomment"
    content = ply(kind, [("vertex", XYZ, vertices), face(polygons=polygons)], newline, extra)
    (tmp_path / "l.ply").write_bytes(content)
    assert load_mesh(tmp_path / "l.ply").volume == pytest.approx(10)


@pytest.mark.parametrize("encoding", ["utf-8-sig", "utf-16", "utf-16-le"])
def test_text_in_any_encoding(tmp_path, encoding):
    content = ply("ascii", LAYOUTS["colours and normals"]).decode().encode(encoding)
    (tmp_path / "l.ply").write_bytes(content)
    assert load_mesh(tmp_path / "l.ply").volume == pytest.approx(10)


@pytest.mark.parametrize("kind", FORMATS)
def test_clouds_are_read_exactly(tmp_path, kind):
    points = np.random.default_rng(0).normal(size=(30, 3))
    rows = [(*point, 1, 2, 3) for point in points]
    properties = {"x": "double", "y": "double", "z": "double", "red": "uchar", "green": "uchar", "blue": "uchar"}
    elements = [("vertex", properties, rows), ("face", {"vertex_indices": ("uchar", "int")}, [])]
    (tmp_path / "cloud.ply").write_bytes(ply(kind, elements))
    np.testing.assert_allclose(load_points(tmp_path / "cloud.ply"), points, rtol=1e-6)
    ranges = ("range_grid", {"vertex_indices": ("uchar", "int")}, [([i],) for i in range(30)])
    (tmp_path / "scan.ply").write_bytes(ply(kind, [elements[0], ranges]))
    np.testing.assert_allclose(load_points(tmp_path / "scan.ply"), points, rtol=1e-6)


def damaged(
    kind="binary_little_endian", elements=LAYOUTS["triangles, quads and hexagons"], cut=None, old="", new="", more=b""
):
    return ply(kind, elements).replace(old.encode(), new.encode())[:cut] + more


WRONG = {
    "truncated text": (
        damaged("ascii", cut=-13),
        r"truncated: .* 8 rows of face, of which 1 are missing\); save it again",
    ),
    "truncated vertices": (damaged(cut=250), r"truncated: .* 12 rows of vertex, which need 144 bytes.*; save it again"),
    "truncated in a mixed list": (damaged(cut=-10), "truncated: .* 8 rows of face, which need"),
    "truncated in a uniform list": (
        damaged(elements=[vertex(), face(polygons=TRIANGLES)], cut=-1),
        "truncated: .* 20 rows of face, which need",
    ),
    "truncated header": (b"ply\nformat ascii 1.0\nelement vertex 3\n", "does not go from ply to end_header"),
    "more bytes": (damaged(more=b"\1\2\3"), "has 3 bytes more than its header promises"),
    "more lines": (damaged("ascii", more=b"1 2 3\n"), "has 1 lines more than its header promises"),
    "more numbers in a row": (
        damaged("ascii", old="\n0 0 2\n", new="\n0 0 2 1\n"),
        "a row of vertex has not the 3 numbers",
    ),
    "less numbers in a list": (damaged("ascii", old="4 0 1 7 6\n", new="4 0 1 7\n"), "a row of face has 4 numbers"),
    "negative length": (damaged("ascii", old="4 0 1 7 6\n", new="-4 0 1 7 6\n"), "has a list of -4 entries"),
    "a word": (damaged("ascii", old="\n0 0 2\n", new="\n0 a 2\n"), "'a' is no number"),
    "unknown type": (
        damaged(old="property float y", new="property real y"),
        "its header has the line 'property real y'",
    ),
    "unknown format": (damaged(old="binary_little", new="binary_middle"), "the line 'format binary_middle_endian 1.0'"),
    "no format": (damaged(old="format binary_little_endian 1.0\n"), "its header has no line format"),
    "vertex that is none": (damaged("ascii", old="4 0 1 7 6\n", new="4 0 1 7 12\n"), "a face has vertex 12"),
    "x twice": (damaged("ascii", old="float y", new="float x"), "the property x of vertex twice"),
}
UNSUPPORTED = {
    "no z": (
        damaged("ascii", old="float z", new="float depth"),
        "has the properties x, y, depth of each vertex; expected x, y",
    ),
    "lists of another name": (
        damaged(old="vertex_indices", new="corners"),
        "has the properties corners of each face; expected",
    ),
    "no vertices": (ply("ascii", [("point", XYZ, VERTICES)]), "has the elements point; expected vertex among them"),
    "faces of another name": (
        damaged(old="element face", new="element quad"),
        "has the element quad with lists of vertices",
    ),
}


@pytest.mark.parametrize("name", WRONG)
def test_damaged_files_say_how(tmp_path, name):
    content, message = WRONG[name]
    (tmp_path / "l.ply").write_bytes(content)
    with pytest.raises(InputError, match=rf"load_mesh\(\): .*l.ply cannot be read as .ply \(.*{message}"):
        load_mesh(tmp_path / "l.ply")


@pytest.mark.parametrize("name", UNSUPPORTED)
def test_features_that_are_not_read_are_named(tmp_path, name):
    content, message = UNSUPPORTED[name]
    (tmp_path / "l.ply").write_bytes(content)
    with pytest.raises(InputError, match=rf"load_mesh\(\): .*l.ply {message}"):
        load_mesh(tmp_path / "l.ply")


def test_a_second_reader_agrees(tmp_path):
    mesh = trimesh.creation.icosphere(1)
    for encoding in ("ascii", "binary"):
        mesh.export(tmp_path / "ball.ply", encoding=encoding)
        theirs = trimesh.load(tmp_path / "ball.ply", process=False)
        np.testing.assert_allclose(load_mesh(tmp_path / "ball.ply").triangles, theirs.triangles, atol=1e-7)
