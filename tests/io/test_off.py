"""OFF files as programs write them: a pyramid over an L, known in area and volume."""

import numpy as np
import pytest
import trimesh

from tdf_jax._internal.errors import InputError
from tdf_jax.io.meshes import load_mesh
from tdf_jax.io.pointclouds import load_points

VERTICES = ["3 0 0", "3 1 0", "1 1 0", "1 3 0", "0 3 0", "0 0 0", "0 0 3"]  # the last is above the corner
FACES = ["6 5 4 3 2 1 0", *(f"3 {i} {(i + 1) % 6} 6" for i in range(6))]
VOLUME = 5  # a third of 5 x 3


def off(head="OFF\n7 7 0\n", vertex="", face="", faces=FACES):
    return head + "".join(f"{row}{vertex}\n" for row in VERTICES) + "".join(f"{row}{face}\n" for row in faces)


VALID = {
    "plain": off(),
    "counts behind the keyword": off("OFF 7 7 0\n"),
    "counts without a blank": off("OFF7 7 0\n"),
    "no number of edges": off("OFF\n7 7\n"),
    "no keyword": off("7 7 0\n"),
    "small letters": off("off\n7 7 0\n"),
    "comments and empty lines": "# a mug\n" + off().replace("\n", " # that\n\n"),
    "colours of faces": off(face=" 255 0 0"),
    "float colours with alpha": off(face=" 0.5 0.5 0.5 1.0"),
    "colours of some faces": off(faces=[FACES[0] + " 1 0 0", *FACES[1:]]),
    "COFF": off("COFF\n7 7 0\n", " 255 0 0 255"),
    "NOFF": off("NOFF\n7 7 0\n", " 0 0 1"),
    "CNOFF": off("CNOFF\n7 7 0\n", " 0 0 1 255 0 0 255"),
    "STOFF": off("STOFF\n7 7 0\n", " 0.5 0.5"),
    "lines that end anywhere": off().replace("\n", " ").replace("OFF ", "OFF\n").replace("7 7 0 ", "7 7 0\n"),
    "points and lines among the faces": off("OFF\n7 9 0\n", faces=["1 0", "2 0 1", *FACES]),
    "windows": off().replace("\n", "\r\n"),
    "tabs": off().replace(" ", "\t"),
    "no newline at the end": off().rstrip(),
    "decimal commas": off().replace("3 0 0\n3 1 0", "3,0 0,0 0\n3 1 0"),
    "latin-1": "# Tülle\n".encode("latin-1") + off().encode(),
    "gbk": off().encode() + "# 杯子\n".encode("gbk"),
    "utf-8 with a mark": off().encode("utf-8-sig"),
    "utf-16": off().encode("utf-16"),
}


@pytest.mark.parametrize("name", VALID)
def test_a_pyramid_is_read_in_every_notation(tmp_path, name):
    content = VALID[name]
    (tmp_path / "l.off").write_bytes(content if isinstance(content, bytes) else content.encode())
    mesh = load_mesh(tmp_path / "l.off")
    assert mesh.is_watertight
    assert mesh.volume == pytest.approx(VOLUME)
    np.testing.assert_array_equal(mesh.bounds, [[0, 0, 0], [3, 3, 3]])


WRONG = {
    "binary": (b"OFF BINARY\n\0\0\0\x07", "l.off is a binary OFF file; expected text"),
    "four dimensions": (off("4OFF\n7 7 0\n", " 1").encode(), "l.off has vertices of 4OFF, not of three dimensions"),
    "n dimensions": (off("nOFF\n3\n7 7 0\n").encode(), "l.off has vertices of nOFF"),
    "truncated": (off()[:-12].encode(), r"promises 7 vertices and 7 faces, and has 13 lines.*save it again"),
    "more faces than promised": (off("OFF\n7 6 0\n").encode(), "promises 7 vertices and 6 faces, and has 14 lines"),
    "no counts": (b"OFF\n", "does not begin by OFF and the numbers of vertices, faces and edges"),
    "words": (b"hello\nworld\n", "does not begin by OFF"),
    "short face": (off(faces=[*FACES[:-1], "3 5 0"]).encode(), "a face with fewer corners than its first number"),
    "short vertex": (off().replace("3 1 0\n", "3 1\n").encode(), "a vertex of fewer than three numbers"),
    "vertex that is none": (off(faces=[*FACES[:-1], "3 5 0 7"]).encode(), "a face has vertex 7.* there are 7 vertices"),
    "negative": (off(faces=[*FACES[:-1], "3 5 0 -1"]).encode(), "a face has vertex -1"),
}


@pytest.mark.parametrize("name", WRONG)
def test_what_cannot_be_read_is_named(tmp_path, name):
    content, message = WRONG[name]
    (tmp_path / "l.off").write_bytes(content)
    with pytest.raises(InputError, match=message):
        load_mesh(tmp_path / "l.off")


def test_vertices_alone_are_a_cloud(tmp_path):
    points = np.random.default_rng(0).normal(size=(30, 3)).astype(np.float32)
    (tmp_path / "cloud.off").write_text(
        "COFF\n30 0 0\n" + "".join("{:.9g} {:.9g} {:.9g} 1 0 0 1\n".format(*point) for point in points)
    )
    np.testing.assert_array_equal(load_points(tmp_path / "cloud.off"), points)


def test_a_second_reader_agrees(tmp_path):
    trimesh.creation.icosphere(1).export(tmp_path / "ball.off")
    theirs = trimesh.load(tmp_path / "ball.off", process=False)
    np.testing.assert_array_equal(load_mesh(tmp_path / "ball.off").triangles, theirs.triangles)
