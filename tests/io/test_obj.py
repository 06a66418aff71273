"""OBJ files as programs write them: a prism whose base is an L, 2 high, known in area and volume."""

import numpy as np
import pytest
import trimesh

from tdf_jax._internal.errors import InputError
from tdf_jax.io.meshes import load_mesh
from tdf_jax.io.pointclouds import load_points

# The L: a square of side 3 without one of side 2 at its upper right corner. Its first corner cannot see all others.
BASE = np.array([[3, 0], [3, 1], [1, 1], [1, 3], [0, 3], [0, 0]], float)
VERTICES = np.array([[x, y, z] for z in (0, 2) for x, y in BASE])
POLYGONS = [[5, 4, 3, 2, 1, 0], [6, 7, 8, 9, 10, 11], *([i, (i + 1) % 6, (i + 1) % 6 + 6, i + 6] for i in range(6))]
AREA, VOLUME = 2 * 5 + 2 * 12, 10

V = "".join("v {:g} {:g} {:g}\n".format(*vertex) for vertex in VERTICES)


def faces(corner=lambda i: str(i + 1), polygons=POLYGONS):
    return "".join(f"f {' '.join(corner(i) for i in polygon)}\n" for polygon in polygons)


def in_blocks():
    """Every face behind its own vertices, which it counts back from itself."""
    text = ""
    for polygon in POLYGONS:
        text += "".join("v {:g} {:g} {:g}\n".format(*VERTICES[i]) for i in polygon)
        text += "f " + " ".join(str(i - len(polygon)) for i in range(len(polygon))) + "\n"
    return text


VALID = {
    "plain": V + faces(),
    "faces first": faces() + V,
    "negative indices at the end": V + faces(lambda i: str(i - 12)),
    "negative indices between the vertices": in_blocks(),
    "texture coordinates": V + "vt 0 0\n" + faces(lambda i: f"{i + 1}/1"),
    "normals": V + "vn 0 0 1\n" + faces(lambda i: f"{i + 1}//1"),
    "texture coordinates and normals": V + "vt 0 0\nvn 0 0 1\n" + faces(lambda i: f"{i + 1}/1/1"),
    "negative with normals": V + "vn 0 0 1\n" + faces(lambda i: f"{i - 12}//-1"),
    "textures of some faces": V
    + "vt 0 0\n"
    + faces(lambda i: f"{i + 1}/1", POLYGONS[:3])
    + faces(polygons=POLYGONS[3:]),
    "continued lines": V.replace("v 3 0 0\n", "v 3 \\\n 0 \\\n0\n") + faces().replace(" 4 3", " \\\n4 3"),
    "windows": (V + faces()).replace("\n", "\r\n"),
    "old mac": (V + faces()).replace("\n", "\r"),
    "tabs and blanks": (" " + V + faces()).replace(" ", "\t").replace("\n", " \n\n"),
    "no newline at the end": (V + faces()).rstrip("\n"),
    "comments behind": V.replace("\n", " # a vertex\n") + faces().replace("\n", " # a face\n"),
    "comment that ends like a continued line": "# C:\\meshes\\\n" + V + faces(),
    "colours": V.replace("\n", " 0.1 0.2 0.3\n") + faces(),
    "colours of some": V.replace("\n", " 0.1 0.2 0.3\n", 3) + faces(),
    "weights of one": V.replace("\n", " 1.0\n") + faces(),
    "exponents": V.replace("v 3", "v 3.0e+00") + faces(),
    "decimal commas": V.replace("v 3 0", "v 3,0 0,0") + faces(),
    "lines and points": V + "l 1 2 3\np 1 5\n" + faces(),
    "two groups": "o a\ng b c\ns off\nusemtl red\n"
    + V
    + faces(polygons=POLYGONS[:4])
    + "g d\n"
    + faces(polygons=POLYGONS[4:]),
    "materials, whose file is missing": "mtllib none.mtl\nusemtl a\n" + V + faces(),
    "materials that alternate": V + "".join(f"usemtl {i % 3}\n{faces(polygons=[p])}" for i, p in enumerate(POLYGONS)),
    "former keyword": V + faces().replace("f ", "fo "),
    "faces of two corners": V + "f 1 2\n" + faces(),
    "vertices of no face": V + "v 99 99 99\nv nan nan nan\n" + faces(),
    "keywords of programs": "# MRGB ff\ncstype bezier\nxyz 1 2\n" + V + faces(),
}


@pytest.mark.parametrize("name", VALID)
def test_an_l_is_read_in_every_notation(tmp_path, name):
    (tmp_path / "l.obj").write_bytes(VALID[name].encode())
    mesh = load_mesh(tmp_path / "l.obj")
    assert mesh.is_watertight
    assert len(mesh.vertices) == 12 and len(mesh.faces) == 20
    assert mesh.volume == pytest.approx(VOLUME) and mesh.area == pytest.approx(AREA)
    np.testing.assert_array_equal(mesh.bounds, [[0, 0, 0], [3, 3, 2]])


NAMES = {
    "latin-1": "# Tülle\ng Tülle\n".encode("latin-1"),
    "gbk": "# 誠\no 誠\nusemtl 杯子\n".encode("gbk"),  # the second byte of the first is a backslash
    "shift-jis": "# 表\ng 表\n".encode("shift-jis"),  # here as well
    "utf-8": "# 杯子\ng 杯子\n".encode(),
    "utf-8 with a mark": "\ufeff# 杯子\n".encode(),
    "noise": b"# \x00\xff\x85\x1c\x0b\ng \x85\x1c\n",
}


@pytest.mark.parametrize("name", NAMES)
def test_comments_and_names_may_be_in_any_encoding(tmp_path, name):
    """A comment's byte is neither the end of a line nor the continuation of one."""
    (tmp_path / "l.obj").write_bytes(NAMES[name] + V.encode() + NAMES[name].lstrip(b"\xef\xbb\xbf") + faces().encode())
    assert load_mesh(tmp_path / "l.obj").volume == pytest.approx(VOLUME)


@pytest.mark.parametrize("encoding", ["utf-16", "utf-16-le", "utf-16-be", "utf-32"])
def test_text_of_two_or_four_bytes_a_character(tmp_path, encoding):
    (tmp_path / "l.obj").write_bytes(("# 杯\n" + V + faces()).encode(encoding))
    assert load_mesh(tmp_path / "l.obj").volume == pytest.approx(VOLUME)


def test_a_second_reader_agrees_where_it_reads_right(tmp_path):
    """trimesh, on random triangles and quads with textures and normals; relative indices it reads only at the end."""
    rng = np.random.default_rng(0)
    points = rng.normal(size=(50, 3))
    text = "".join("v {:.9g} {:.9g} {:.9g}\n".format(*point) for point in points) + "vt 0 0\nvn 0 0 1\n"
    for _ in range(40):
        corners = rng.choice(50, 3, replace=False)
        text += "f " + " ".join(f"{i + 1}/1/1" if rng.random() < 0.5 else f"{i - 50}/-1/-1" for i in corners) + "\n"
    (tmp_path / "noise.obj").write_text(text)
    ours, theirs = load_mesh(tmp_path / "noise.obj"), trimesh.load(tmp_path / "noise.obj", force="mesh", process=False)
    np.testing.assert_allclose(ours.triangles, theirs.triangles, rtol=1e-12)


DAMAGED = {
    "v 0 0\n" + V + faces(): "line 1 has a vertex of 2 numbers",
    V.replace("v 3", "v x") + faces(): "'x' is no number",
    V + "f 1 2 13\n": "line 13 has vertex 13; there are 12",
    V + "f 1 2 0\n": "line 13 has vertex 0; there are 12, counted from 1",
    "v 0 0 0\nf -1 -2 -3\n" + V: "line 2 has vertex -2",
    V + "f 1 2 a\n": "'a' is no number",
    V + "f 1 /2 3\n": "a face with a corner that has no vertex",
    V + "f 1 f 3\n": "a face with a corner that has no vertex",
    V + "f 1 2 3.5\n": "'3.5' is no whole number",
    V + "f 1 2 3\nf 4 5": "ends within a face of 2 corners",
    V + "1 2 3\n" + faces(): "line 13 begins with the number 1",
    V + "f 1 2 \\\n": "ends within line 13, which is continued",
}


@pytest.mark.parametrize("text", DAMAGED, ids=DAMAGED.values())
def test_damaged_files_say_where(tmp_path, text):
    (tmp_path / "l.obj").write_text(text)
    with pytest.raises(
        InputError, match=rf"load_mesh\(\): .*l.obj cannot be read as .obj \(.*{DAMAGED[text]}.*save it"
    ):
        load_mesh(tmp_path / "l.obj")


UNSUPPORTED = {
    V + faces() + "cstype bezier\nsurf 0 1 0 1 1 2 3 4\n": "has a free-form surface in line 22; expected polygons only",
    V + faces() + "call other.obj\n": "has another file in line 21",
    V.replace("\n", " 0.5\n") + faces(): "has vertices with a fourth number other than 1.*remove the fourth number",
    V.replace("\n", " 0.5\n", 3) + faces(): "has vertices with a fourth number other than 1",
    V + "l 1 2\n": "has no faces, only lines; expected a surface",
    V.replace("v 3 0", "v 3,5 0.5") + faces(): "has numbers with commas as well as points",
}


@pytest.mark.parametrize("text", UNSUPPORTED, ids=UNSUPPORTED.values())
def test_features_that_are_not_read_are_named(tmp_path, text):
    (tmp_path / "l.obj").write_text(text)
    with pytest.raises(InputError, match=f"l.obj {UNSUPPORTED[text]}") as error:
        load_mesh(tmp_path / "l.obj")
    assert "save it again" not in str(error.value)


def test_vertices_alone_are_a_cloud(tmp_path):
    points = np.random.default_rng(0).normal(size=(30, 3)).astype(np.float32)
    rows = ["v {:.9g} {:.9g} {:.9g} 0.5 0.5 0.5\n".format(*point) for point in points]
    (tmp_path / "cloud.obj").write_text("vn 0 0 1\n" + "".join(rows) + "p 1 2 3\n")
    np.testing.assert_array_equal(load_points(tmp_path / "cloud.obj"), points)
    with pytest.raises(InputError, match="cloud.obj has no faces"):
        load_mesh(tmp_path / "cloud.obj")
