"""STL files as programs write them: a box 1 x 2 x 3, known in area and volume."""

import numpy as np
import pytest
import trimesh

from tdf_jax._internal.errors import InputError
from tdf_jax.io.meshes import load_mesh

BOX = trimesh.creation.box((1, 2, 3))


def binary(header=b"", faces=BOX.faces, count=None):
    rows = np.zeros(len(faces), [("normal", "<f4", 3), ("vertices", "<f4", (3, 3)), ("attribute", "<u2")])
    rows["vertices"] = BOX.vertices[faces]
    return header.ljust(80)[:80] + np.uint32(len(faces) if count is None else count).tobytes() + rows.tobytes()


def text(faces=BOX.faces, name="box", number="{:g}", normal="nan nan nan"):
    loops = []
    for corners in BOX.vertices[faces]:
        vertices = "".join(f"      vertex {' '.join(number.format(x) for x in corner)}\n" for corner in corners)
        loops.append(f"  facet normal {normal}\n    outer loop\n{vertices}    endloop\n  endfacet\n")
    return f"solid {name}\n{''.join(loops)}endsolid {name}\n"


def quads():
    """Loops of four vertices, which are not in the format but in files."""
    loops = ""
    for axis in range(3):
        for side in (-0.5, 0.5):
            corners = np.insert([[-0.5, -0.5], [0.5, -0.5], [0.5, 0.5], [-0.5, 0.5]], axis, side, axis=1) * (1, 2, 3)
            corners = corners[:: (1 if side > 0 else -1) * (1 if axis != 1 else -1)]
            vertices = "".join("vertex {:g} {:g} {:g}\n".format(*corner) for corner in corners)
            loops += f"facet normal 0 0 0\nouter loop\n{vertices}endloop\nendfacet\n"
    return f"solid\n{loops}endsolid\n"


VALID = {
    "binary": binary(),
    "binary that begins like text": binary(b"solid made by a program"),
    "binary with the whole keyword": binary(b"solid facet normal outer loop vertex endsolid"),
    "binary with a colour in its header": binary(b"COLOR=\xff\x00\x00\xff,MATERIAL="),
    "text": text(),
    "text without a name": text(name=""),
    "names of keywords": text(name="vertex facet loop endfacet 1 2 3"),
    "name of an axis": text(name="normal of the outer loop"),
    "capital letters": text().upper(),
    "windows": text().replace("\n", "\r\n"),
    "one line": text().replace("\n", " "),
    "blanks in keywords": text().replace("endfacet", "end facet").replace("endloop", "end loop"),
    "two solids": text(BOX.faces[:5], "a") + text(BOX.faces[5:], "b"),
    "empty solid between": text(BOX.faces[:5], "a") + "solid none\nendsolid none\n" + text(BOX.faces[5:], "b"),
    "exponents": text(number="{:+.6E}"),
    "decimal commas": text(number="{:.3f}").replace(".", ","),
    "loops of four": quads(),
    "latin-1": text(name="Tülle").encode("latin-1"),
    "gbk": text(name="杯子").encode("gbk"),
    "utf-8 with a mark": text(name="杯子").encode("utf-8-sig"),
    "utf-16": text(name="杯子").encode("utf-16"),
    "utf-16 without a mark": text(name="杯子").encode("utf-16-le"),
}


@pytest.mark.parametrize("name", VALID)
def test_a_box_is_read_in_every_notation(tmp_path, name):
    content = VALID[name]
    (tmp_path / "box.stl").write_bytes(content if isinstance(content, bytes) else content.encode())
    mesh = load_mesh(tmp_path / "box.stl")
    assert mesh.is_watertight
    assert len(mesh.vertices) == 8 and len(mesh.faces) == 12
    assert mesh.volume == pytest.approx(6) and mesh.area == pytest.approx(22)
    np.testing.assert_allclose(mesh.bounds, [[-0.5, -1, -1.5], [0.5, 1, 1.5]])


DAMAGED = {
    "truncated": (
        binary()[:-20],
        "it is truncated: its header promises 12 triangles, which are 684 bytes, and it has 664",
    ),
    "too long": (binary() + b"\n", "it is too long: its header promises 12 triangles, which are 684 bytes"),
    "two in one": (binary() + binary(), "too long"),
    "count never written": (binary(count=0), "too long: its header promises 0 triangles"),
    "truncated, begins like text": (binary(b"solid box")[:-1], "truncated: its header promises 12"),
    "header only": (b"\0" * 83, "has 83 bytes; a binary one has at least 84"),
    "text, no end": (text()[:-13], "truncated: 1 solids, of which not all have an endsolid"),
    "text, second has no end": (text() + text()[:200], "truncated: 2 solids"),
    "text, first has no end": (text().replace("endsolid box\n", "") + text(), "truncated: 2 solids"),
    "text, open loop": (text().replace("endloop", "", 1), "without its words outer loop and endloop"),
    "text, two numbers": (text().replace("vertex 0.5 1 1.5", "vertex 0.5 1", 1), "a vertex that is not three numbers"),
    "text, a word": (text().replace("vertex 0.5", "vertex a", 1), "'a' is no number"),
    "no solid": (text()[10:], "truncated|too long"),
}


@pytest.mark.parametrize("name", DAMAGED)
def test_damaged_files_say_how(tmp_path, name):
    content, message = DAMAGED[name]
    (tmp_path / "box.stl").write_bytes(content if isinstance(content, bytes) else content.encode())
    with pytest.raises(InputError, match=rf"box.stl cannot be read as .stl \(.*({message}).*\); save it again"):
        load_mesh(tmp_path / "box.stl")


@pytest.mark.parametrize("content", [binary(faces=BOX.faces[:0]), b"solid\nendsolid\n"])
def test_files_without_triangles_have_no_faces(tmp_path, content):
    (tmp_path / "box.stl").write_bytes(content)
    with pytest.raises(InputError, match="box.stl has no faces"):
        load_mesh(tmp_path / "box.stl")


def test_a_second_reader_agrees(tmp_path):
    mesh = trimesh.creation.icosphere(1)
    for name, kind in (("binary.stl", "stl"), ("text.stl", "stl_ascii")):
        mesh.export(tmp_path / name, file_type=kind)
        theirs = trimesh.load(tmp_path / name, process=False)
        np.testing.assert_array_equal(load_mesh(tmp_path / name).triangles, theirs.triangles)
