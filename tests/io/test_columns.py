"""Text clouds in the dialects of programs and countries: one cloud, written in all of them."""

import numpy as np
import pytest

from tdf_jax._internal.errors import InputError
from tdf_jax.io.pointclouds import load_points

CLOUD = np.random.default_rng(0).uniform(-0.2, 0.2, (40, 3)).round(4) + 0.00001
POINTS = [[f"{x:.5f}" for x in point] for point in CLOUD]
SORTED = sorted(POINTS, key=lambda row: float(row[0]))


def text(delimiter=" ", head="", before=(), behind=(), rows=POINTS, end="\n", decimal="."):
    """Rows with columns before and behind the coordinates; a callable makes the entry of a row."""
    lines = []
    for i, row in enumerate(rows):
        extra = [[entry(i) if callable(entry) else entry for entry in entries] for entries in (before, behind)]
        lines.append(delimiter.join([*extra[0], *row, *extra[1]]).replace(".", decimal))
    return head + "".join(line + end for line in lines)


def index(i):
    return str(i)


def index_from_one(i):
    return str(i + 1)


SHUFFLED = np.random.default_rng(1).permutation(40)
MILLIMETRES = [[f"{x * 1000:.0f}" for x in point] for point in CLOUD]
DIRECTIONS = np.random.default_rng(2).normal(size=(40, 3))
DIRECTIONS /= np.linalg.norm(DIRECTIONS, axis=1, keepdims=True)
NORMALS = tuple(lambda i, axis=axis: f"{DIRECTIONS[i, axis]:.6f}" for axis in range(3))


def varying(i):
    return str(37 * i % 256)


COLOUR, NORMAL = ("255", "0", "17"), ("0.0", "0.6", "0.8")
VALID = {
    "blanks": text(),
    "many blanks and tabs": text("  \t ", end=" \n\n"),
    "tabs": text("\t"),
    "commas": text(","),
    "commas and blanks": text(", "),
    "blanks and commas": text(" ,", behind=("0.5",)),
    "commas at the end": text(",", end=",\n"),
    "semicolons": text(";"),
    "semicolons and blanks": text(" ; ", end=" ;\n"),
    "decimal commas and blanks": text(decimal=","),
    "decimal commas and tabs": text("\t", decimal=","),
    "decimal commas and semicolons": text(";", decimal=","),
    "decimal commas, commas and blanks": text(", ", decimal=","),
    "decimal commas, blanks and commas": text(" ,", decimal=","),
    "decimal commas and words behind": text(behind=("mug",), decimal=","),
    "decimal commas and some whole numbers": text(behind=("1", "2"), decimal=","),
    "exponents": text(rows=[[f"{x:.12E}" for x in point] for point in CLOUD]),
    "exponents of Fortran": text(rows=[[f"{x:.12E}".replace("E", "D") for x in point] for point in CLOUD]),
    "plus signs": text(rows=[[f"{x:+.5f}" for x in point] for point in CLOUD]),
    "quoted": text(",", rows=[[f'"{x}"' for x in point] for point in POINTS]),
    "colours": text(behind=COLOUR),
    "normals and colours": text(behind=(*NORMAL, *COLOUR)),
    "normals and a curvature": text(behind=(*NORMAL, "0.0")),
    "intensity": text(behind=("0.5",)),
    "homogeneous": text(behind=("1",)),
    "words behind": text(behind=("mug",)),
    "sorted": text(rows=SORTED),
    "sorted, colours behind": text(rows=SORTED, behind=COLOUR),
    "sorted, varying colours behind": text(rows=SORTED, behind=(varying, varying, "0")),
    "sorted, normals behind": text(rows=SORTED, behind=NORMALS),
    "sorted, a whole intensity behind": text(rows=SORTED, behind=(varying,)),
    "varying normals and colours": text(behind=(*NORMALS, varying, "0", varying)),
    "numbers in disorder": text(before=(lambda i: str(SHUFFLED[i]),)),
    "numbers in disorder from one, colours behind": text(before=(lambda i: str(SHUFFLED[i] + 1),), behind=COLOUR),
    "falling numbers": text(before=(lambda i: str(40 - i),)),
    "comments": text(head="# made by a program\n// a cloud\n% more\n", end=" # point\n"),
    "a comment of names": text(head="# x y z nx ny nz\n", behind=NORMAL),
    "a comment of names of CloudCompare": text(head="//X Y Z R G B\n", behind=COLOUR),
    "names": text(head="x y z\n"),
    "names with commas": text(",", head="X,Y,Z\n"),
    "names with blanks, numbers with commas": text(",", head="x y z\n"),
    "quoted names": text(",", head='"x","y","z","r","g","b"\n', behind=COLOUR),
    "names with units": text(";", head="x [m];y [m];z [m]\n"),
    "names of ParaView": text(",", head='"v","Points:0","Points:1","Points:2"\n', before=("0.5",)),
    "names in another order": text(",", head="z,x,y\n", rows=[[z, x, y] for x, y, z in POINTS]),
    "coordinates behind others": text(",", head="time,label,x,y,z\n", before=(lambda i: f"{i * 0.1:.1f}", "mug")),
    "normals before": text(",", head="nx,ny,nz,x,y,z\n", before=NORMAL),
    "a number of the row without a name": text(",", head=",x,y,z\n", before=(index,)),
    "names of R": text(head='"x" "y" "z"\n', before=(lambda i: f'"{i + 1}"',)),
    "names of the point": text(",", head="id,x,y,z\n", before=(lambda i: str(7 * i + 3),)),
    "numbers from zero": text(before=(index,)),
    "numbers from one": text(before=(index_from_one,)),
    "numbers from one, colours behind": text(",", before=(index_from_one,), behind=COLOUR),
    "numbers from one as floats": text(before=(lambda i: f"{i + 1:.18e}",)),
    "numbers of whole millimetres": text(before=(index_from_one,), rows=POINTS),
    "count": text(head="40\n"),
    "count and intensity, as in .pts": text(head="40\n", behind=("-1200", *COLOUR)),
    "count and an empty line": text(head="40\n\n"),
    "count and a title": text(head="40\nscan of a mug\n"),
    "count and names": text(head="40\nz x y\n", rows=[[z, x, y] for x, y, z in POINTS]),
    "count of rows and columns": text(head="40 3\n"),
    "names of CloudCompare above a count": text(
        ";", head="//X;Y;Z;Illuminance (PCV);Nx (a)\n40\n", behind=("0.5", "1")
    ),
    "a mark where files were joined": text(rows=POINTS[:20]) + "\ufeff" + text(rows=POINTS[20:]),
    "quoted decimal commas": text(",", rows=[[f'"{x}"'.replace(".", ",") for x in point] for point in POINTS]),
    "quoted words with commas": text(",", head="name,x,y,z\n", before=('"mug, red"',)),
    "separator line of spreadsheets": text(";", head="sep=;\n", decimal=","),
    "windows": text(end="\r\n"),
    "old mac": text(end="\r"),
    "no newline at the end": text().rstrip(),
    "utf-8 with a mark": text(head="x y z\n").encode("utf-8-sig"),
    "utf-16": text(",", head="x,y,z\n").encode("utf-16"),
    "utf-16 without a mark": text("\t").encode("utf-16-le"),
    "latin-1": text(head="# Tülle\n").encode("latin-1"),
    "gbk": text(head="# 杯子\n").encode("gbk"),
}


@pytest.mark.parametrize("name", VALID)
def test_a_cloud_is_read_in_every_dialect(tmp_path, name):
    content = VALID[name]
    (tmp_path / "cloud.xyz").write_bytes(content if isinstance(content, bytes) else content.encode())
    expected = sorted(CLOUD, key=lambda row: row[0]) if name.startswith("sorted") else CLOUD
    np.testing.assert_allclose(load_points(tmp_path / "cloud.xyz"), expected, atol=1e-8)


@pytest.mark.parametrize("suffix", [".xyz", ".txt", ".csv", ".asc", ".pts", ".XYZ"])
def test_the_suffixes_of_text(tmp_path, suffix):
    (tmp_path / f"cloud{suffix}").write_text(text(","))
    np.testing.assert_allclose(load_points(tmp_path / f"cloud{suffix}"), CLOUD, atol=1e-8)


def test_whole_millimetres(tmp_path):
    """Without decimals every dialect still is one; the first column here counts nothing."""
    millimetres = np.rint(CLOUD * 1000)
    rows = [[f"{x:.0f}" for x in point] for point in millimetres]
    for delimiter in (" ", ",", ";", "\t"):
        (tmp_path / "cloud.xyz").write_text(text(delimiter, rows=rows))
        np.testing.assert_allclose(load_points(tmp_path / "cloud.xyz", scale=0.001), millimetres / 1000, atol=1e-8)
    (tmp_path / "cloud.xyz").write_text(text(",", head="x,y,z,r,g,b\n", behind=COLOUR, rows=rows))
    np.testing.assert_allclose(load_points(tmp_path / "cloud.xyz", scale=0.001), millimetres / 1000, atol=1e-8)


@pytest.mark.parametrize("first", [0, 1])
def test_numbers_in_disorder_before_whole_millimetres_are_left_out(tmp_path, first):
    (tmp_path / "cloud.xyz").write_text(text(before=(lambda i: str(SHUFFLED[i] + first),), rows=MILLIMETRES))
    expected = np.array(MILLIMETRES, dtype=float) / 1000
    np.testing.assert_allclose(load_points(tmp_path / "cloud.xyz", scale=0.001), expected, atol=1e-8)


@pytest.mark.parametrize("behind", [COLOUR, NORMALS, ("17",), (varying,)])
def test_whole_millimetres_keep_x_whatever_is_behind(tmp_path, behind):
    (tmp_path / "cloud.xyz").write_text(text(rows=MILLIMETRES, behind=behind))
    expected = np.array(MILLIMETRES, dtype=float) / 1000
    np.testing.assert_allclose(load_points(tmp_path / "cloud.xyz", scale=0.001), expected, atol=1e-8)


def test_units_of_names_must_match_the_scale(tmp_path):
    rows = [[f"{x * 1000:.2f}" for x in point] for point in CLOUD]
    (tmp_path / "cloud.csv").write_text(text(",", head="x [mm],y [mm],z [mm]\n", rows=rows))
    with pytest.raises(InputError, match=r"coordinates in mm, as its names say; pass scale=0.001"):
        load_points(tmp_path / "cloud.csv")
    np.testing.assert_allclose(load_points(tmp_path / "cloud.csv", scale=0.001), CLOUD, atol=1e-7)
    with pytest.raises(InputError, match=r"coordinates in mm, as its names say, and scale is 0.01; pass scale=0.001"):
        load_points(tmp_path / "cloud.csv", scale=0.01)
    (tmp_path / "cloud.csv").write_text(text(",", head="x [m],y [m],z [m]\n"))
    np.testing.assert_allclose(load_points(tmp_path / "cloud.csv"), CLOUD, atol=1e-7)
    with pytest.raises(InputError, match=r"coordinates in m, as its names say, and scale is 0.001; leave out scale"):
        load_points(tmp_path / "cloud.csv", scale=0.001)


def test_empty_fields_are_missing_measurements(tmp_path):
    rows = [["", "NULL", "-"] if i in {3, 5} else row for i, row in enumerate(POINTS)]
    (tmp_path / "cloud.csv").write_text(text(",", head="x,y,z\n", rows=rows))
    with pytest.raises(InputError, match="2 of the 40 points of .*cloud.csv are NaN"):
        load_points(tmp_path / "cloud.csv")


def molecule(title=""):
    return text(head=f"40\n{title}\n", before=(lambda i: ("C", "H", "O", "Cl")[i % 4],))


UNSUPPORTED = {
    "molecule": (molecule(), "the word [CH] in line [34], as files of molecules have"),
    "molecule with a title": (molecule("water"), "the word [CH] in line [34], as files of molecules have"),
    "molecule with numbers as a title": (
        molecule("1.0 2.0 3.0"),
        "the word C in line 3, as files of molecules have",
    ),
    "labels": (
        text(before=(lambda i: str(i % 3),)),
        "numbers of the points, times or labels; expected x y z first; remove the first",
    ),
    "numbers from seven": (
        text(before=(lambda i: str(i + 7),)),
        "a first column of whole numbers, unlike those after it",
    ),
    "numbers with gaps": (
        text(before=(lambda i: str(3 * i + 5),)),
        "a first column of whole numbers, unlike those after it",
    ),
    "labels of one value": (text(",", before=("7",)), "a first column of whole numbers"),
    "numbers before two columns": (
        text(rows=[[str(i), *row[:2]] for i, row in enumerate(POINTS)]),
        "first column that counts the",
    ),
    "decimal commas between commas": (
        text(",", decimal=","),
        "6 columns between commas, which may be whole numbers or decimal",
    ),
    "decimal commas between commas, and a number": (
        text(",", before=(index,), decimal=","),
        "7 columns between commas",
    ),
    "decimal commas and exponents between commas": (
        text(",", rows=[[f"{x:.6e}" for x in point] for point in CLOUD], decimal=","),
        "6 columns between commas, which may be",
    ),
    "decimal commas behind whole numbers": (
        text(
            ",",
            head="id,x,y,z,i\n",
            before=(index,),
            behind=("0,5",),
            rows=[[f"{x * 1000:.0f}" for x in p] for p in CLOUD],
        ),
        "names 5 columns in its first line, and has 6",
    ),
    "labels before whole millimetres": (
        text(before=(lambda i: str(i % 4),), rows=[[f"{x * 1000:.0f}" for x in point] for point in CLOUD]),
        "a first column of few different numbers",
    ),
    "times": (text(before=(lambda i: f"{i / 30:.3f}",)), "a first column of rising numbers, unlike those after it"),
    "commas of thousands": (text(rows=[["1,234.5", *row[1:]] for row in POINTS]), "commas as well as points"),
    "commas and points": (
        text(";", rows=[[row[0].replace(".", ","), *row[1:]] for row in POINTS]),
        "commas as well as points",
    ),
    "other names": (
        text(",", head="lon,lat,height\n"),
        "first line 'lon,lat,height'; expected numbers, or names of columns",
    ),
    "names without z": (text(",", head="x,y,depth\n"), "first line 'x,y,depth'"),
    "a name twice": (text(",", head="x,y,z,x\n", behind=("1",)), "first line 'x,y,z,x'"),
    "names for less columns": (
        text(",", head="x,y,z\n", behind=COLOUR),
        "names 3 columns in its first line, and has 6",
    ),
    "two columns": (text(rows=[row[:2] for row in POINTS]), "has 2 columns; expected x, y and z"),
    "a depth image": (text(rows=[row * 20 for row in POINTS]), "has 60 columns; expected at most 20"),
    "a trajectory": (
        text(before=(lambda i: f"{i * 0.1:.2f}",), behind=("0.0", "0.6", "0.0", "0.8")),
        "rows that are poses",
    ),
    "poses": (text(before=("0.0", "0.6", "0.0", "0.8")), "rows that are poses"),
    "poses, quaternion last": (text(behind=("0.0", "0.6", "0.0", "0.8")), "rows that are poses"),
    "PTX": (text(head="5\n8\n0 0 0\n1 0 0\n0 1 0\n0 0 1\n"), "single whole numbers in its first lines, as PTX has"),
    "ESRI grid": (text(head="ncols 3\nnrows 40\n"), "first line 'ncols 3'"),
    "a count of more": (text(head="50\n"), "count 50 in its first line, and 40 points follow; expected the same"),
    "a count of less": (text(head="30\n"), "count 30 in its first line, and 40 points follow; .* correct"),
    "a count of less, with a title": (text(head="30\nscan\n"), "count 30 in its first line, and 40 points follow"),
    "falling numbers before whole millimetres": (
        text(before=(lambda i: str(40 - i),), rows=MILLIMETRES),
        "a first column of falling numbers",
    ),
    "falling numbers with gaps before whole millimetres": (
        text(before=(lambda i: str(400 - 3 * i),), rows=MILLIMETRES),
        "a first column of falling numbers",
    ),
    "some of the numbers, in disorder, before whole millimetres": (
        text(before=(lambda i: str(7 * SHUFFLED[i]),), rows=[[str(int(x) // 40) for x in row] for row in MILLIMETRES]),
        "a first column of different whole numbers",
    ),
    "labels before whole millimetres of a flat object": (
        text(before=(lambda i: str(i % 4),), rows=[[*row[:2], str(i % 5)] for i, row in enumerate(MILLIMETRES)]),
        "a first column of few different numbers",
    ),
    "labels before a plane": (
        text(before=(lambda i: str(i % 3),), rows=[[*row[:2], "0"] for row in POINTS]),
        "a first column of whole numbers",
    ),
    "times of dual returns": (text(before=(lambda i: f"{i // 2 / 30:.3f}",)), "a first column of rising numbers"),
    "times of scan lines": (text(before=(lambda i: f"{i // 13 / 30:.3f}",)), "a first column of rising numbers"),
    "times that fall": (text(before=(lambda i: f"{(40 - i) // 2 / 30:.3f}",)), "a first column of falling numbers"),
    "times on a conveyor": (
        text(before=(lambda i: f"{i / 30:.3f}",), rows=sorted(POINTS, key=lambda row: float(row[0]))),
        "a first column of rising numbers",
    ),
    "times of a scanner in one plane": (
        text(before=(lambda i: f"{i / 30:.3f}",), rows=[[*row[:2], "0"] for row in POINTS]),
        "a first column of rising numbers",
    ),
    "times before whole millimetres": (
        text(before=(lambda i: f"{i / 30:.3f}",), rows=MILLIMETRES, behind=COLOUR),
        "a first column of rising numbers",
    ),
    "times before points and colours": (
        text(before=(lambda i: f"{i / 30:.3f}",), behind=COLOUR),
        "a first column of rising numbers",
    ),
    "pixels": (
        text(before=(lambda i: str(i % 8), lambda i: str(i // 8))),
        "a first column of whole numbers.* names of all columns into the first line of a text, such as x y z r g b",
    ),
    "numbers and pixels": (
        text(before=(index, lambda i: str(i % 8), lambda i: str(i // 8))),
        "a first column of whole numbers",
    ),
    "numbers and poses": (text(before=(index,), behind=("0.0", "0.6", "0.0", "0.8")), "rows that are poses"),
    "colours first": (
        text(before=(lambda i: str(SHUFFLED[i] % 31), lambda i: str(6 * SHUFFLED[i]), lambda i: str(255 - i))),
        "first three columns of whole numbers from 0 to 255, .* may be colours",
    ),
    "normals first": (text(before=NORMALS), "first three columns of norm 1, .* may be normals; expected x y z first"),
    "a word": (text(rows=[*POINTS[:7], ["0.1", "a", "0.2"], *POINTS[8:]]), "has 'a' in line 8; expected a number"),
    "names twice": (text(",", head="x,y,z\n") + "x,y,z\n", "has 'x' in line 42; expected a number"),
    "brackets": (text(rows=[["[" + row[0], *row[1:]] for row in POINTS]), r"first line '\[0.0548"),
    "points of COLMAP": (
        text(head="# POINT3D_ID, X, Y, Z, R, G, B, ERROR, TRACK[] as (IMAGE_ID, POINT2D_IDX)\n", behind=COLOUR)
        + "1 2 3\n"
        + text(),
        "has 3 columns in line 42, and 6 in line 2; expected one point",
    ),
    "one name less, and no numbers of rows": (
        text(head="x y z\n", behind=("0.5",)),
        "names 3 columns in its first line, and has 4",
    ),
    "quaternions": (text(rows=[["0.0", "0.6", "0.0", "0.8"]] * 40), "poses, or quaternions of norm 1"),
    "web page": ("<!DOCTYPE html>\n<html>", "is a web page; .* download the file itself"),
    "pointer of Git LFS": (
        "version https://git-lfs.github.com/spec/v1\noid sha256:0\n",
        "a pointer of Git LFS.*run git lfs pull",
    ),
    "a .ply": ("ply\nformat ascii 1.0\n", "holds the content of a .ply file; expected .xyz; rename it to .ply"),
}
DAMAGED = {
    "truncated": (text()[:-12], "ends within line 40, which has 2 columns and not 3"),
    "names alone": ("x,y,z\n", "a line of names, and no numbers"),
    "comments alone": ("# nothing\n\n", "it has no numbers"),
    "nothing": ("", "it is empty, 0 bytes"),
}


@pytest.mark.parametrize("name", UNSUPPORTED)
def test_what_is_not_clear_is_named(tmp_path, name):
    content, message = UNSUPPORTED[name]
    (tmp_path / "cloud.xyz").write_text(content)
    with pytest.raises(InputError, match=rf"load_points\(\): .*cloud.xyz .*({message})") as error:
        load_points(tmp_path / "cloud.xyz")
    assert "save it again" not in str(error.value)


@pytest.mark.parametrize("name", DAMAGED)
def test_damaged_files_say_where(tmp_path, name):
    content, message = DAMAGED[name]
    (tmp_path / "cloud.xyz").write_text(content)
    with pytest.raises(InputError, match=rf"load_points\(\): .*cloud.xyz .*({message})"):
        load_points(tmp_path / "cloud.xyz")


NUMBERS = {"5f": (1, "{:.5f}"), "e": (1, "{:.6e}"), "g": (1, "{:.4g}"), "mm": (1000, "{:.0f}"), "mm1": (1000, "{:.1f}")}
BEFORE = {
    "nothing": (),
    "from zero": (index,),
    "from one": (index_from_one,),
    "gaps": (lambda i: str(3 * i + 10),),
    "label": (lambda i: str(i % 4),),
    "one label": ("1",),
    "time": (lambda i: f"{i * 0.033:.3f}",),
    "colour": ("10", "200", "30"),
}
BEHIND = {"nothing": (), "colour": COLOUR, "normal": NORMAL, "intensity": ("0.5",), "one": ("1",), "word": ("mug",)}


def test_any_mixture_of_dialects_is_right_or_refused(tmp_path):
    """Never wrong, and without a column before x and decimal commas among commas hardly ever refused."""
    rng, refused, plain = np.random.default_rng(0), 0, 0
    for _ in range(150):
        factor, number = NUMBERS[rng.choice(list(NUMBERS))]
        delimiter, decimal = rng.choice([" ", "  ", "\t", ",", ", ", ";", "; ", " ,"]), rng.choice([".", ","])
        before, behind = BEFORE[rng.choice(list(BEFORE))], BEHIND[rng.choice(list(BEHIND))]
        names = delimiter.join([*(f"a{i}" for i in range(len(before))), *"xyz", *(f"b{i}" for i in range(len(behind)))])
        head = rng.choice(["", f"{names}\n", f"# {names}\n", "40\n", "40\nscan of a mug\n", f"40\n{names}\n"])
        rows = [[number.format(x * factor) for x in point] for point in CLOUD]
        content = text(delimiter, head, before, behind, rows, decimal=decimal)
        (tmp_path / "cloud.xyz").write_text(content)
        clear = before == () and not ("," in delimiter and (decimal == "," or behind == COLOUR))
        plain += clear
        try:
            points = load_points(tmp_path / "cloud.xyz", scale=1 / factor)
        except InputError as error:
            assert not clear, f"{error}\n{content[:200]}"
            refused += 1
            continue
        expected = np.array(rows, float) / factor
        np.testing.assert_allclose(points, expected, atol=1e-6, err_msg=content[:200])
    assert plain >= 8 and refused < 75
