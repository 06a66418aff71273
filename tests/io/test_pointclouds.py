"""Clouds, and the meshes they are sampled from: files of every kind and their damage, thinning."""

import functools
import os
import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import trimesh

from tdf_jax._internal import checks
from tdf_jax._internal.errors import InputError, InvalidPointsWarning
from tdf_jax.geometry.sampling import farthest_point_indices, thin
from tdf_jax.io.meshes import load_mesh
from tdf_jax.io.pointclouds import load_points

CLOUD = np.random.default_rng(0).normal(size=(40, 3)).astype(np.float32)
SUFFIXES = ["obj", "stl", "ply", "glb", "off"]


def two_boxes():
    """A scene of two boxes 1 x 2 x 3, the second moved by 10 along x."""
    box, scene = trimesh.creation.box((1, 2, 3)), trimesh.Scene()
    scene.add_geometry(box)
    scene.add_geometry(box, transform=trimesh.transformations.translation_matrix((10, 0, 0)))
    return scene


def write_ply(path, points):
    lines = ["ply", "format ascii 1.0", f"element vertex {len(points)}", *(f"property float {a}" for a in "xyz")]
    rows = ("{:.9g} {:.9g} {:.9g}".format(*point) for point in points)
    path.write_text("\n".join([*lines, "end_header", *rows]) + "\n")


def write_pcd(path, data, body):
    header = "# .PCD v0.7\nVERSION 0.7\nFIELDS _ x y z rgb _\nSIZE 1 4 4 4 4 1\nTYPE U F F F U U\nCOUNT 3 1 1 1 1 2\n"
    header += f"WIDTH 40\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS 40\nDATA {data}\n"
    path.write_bytes(header.encode() + body)


def pcd_record():
    fields = [("start", "u1", 3), ("x", "f4"), ("y", "f4"), ("z", "f4"), ("rgb", "u4"), ("end", "u1", 2)]
    record = np.zeros(len(CLOUD), fields)
    record["x"], record["y"], record["z"], record["rgb"] = *CLOUD.T, 7
    return record.tobytes()


def write_cloud(path):
    match path.name:
        case "cloud.npy":
            np.save(path, CLOUD)
        case "double.npy":
            np.save(path, CLOUD.astype(np.float64))
        case "single.npz":
            np.savez(path, anything=CLOUD)
        case "several.npz":
            np.savez(path, colours=np.zeros((2, 2)), points=CLOUD)
        case "cloud.xyz":
            path.write_text(
                "# x y z\n\n" + "".join("{:.9g} {:.9g} {:.9g} 0 0 1 # normal up\n".format(*p) for p in CLOUD)
            )
        case "ascii.pcd":
            write_pcd(path, "ascii", "".join("1 2 3 {:.9g} {:.9g} {:.9g} 7 0 0\n".format(*p) for p in CLOUD).encode())
        case "binary.pcd":
            write_pcd(path, "binary", pcd_record())
        case "ascii.ply":
            write_ply(path, CLOUD)
        case "binary.PLY":
            path.write_bytes(trimesh.PointCloud(CLOUD).export(file_type="ply"))


CLOUDS = "cloud.npy double.npy single.npz several.npz cloud.xyz ascii.pcd binary.pcd ascii.ply binary.PLY".split()


@pytest.mark.parametrize("name", CLOUDS)
def test_clouds_are_read_exactly(tmp_path, name):
    write_cloud(tmp_path / name)
    points = load_points(tmp_path / name)
    assert points.dtype == np.float32
    np.testing.assert_array_equal(points, CLOUD)
    np.testing.assert_allclose(load_points(str(tmp_path / name), scale=0.01), 0.01 * CLOUD, rtol=1e-6)


def test_larger_clouds_are_cut_to_a_random_subset(tmp_path):
    np.save(tmp_path / "cloud.npy", CLOUD)
    cut = load_points(tmp_path / "cloud.npy", count=25)
    rows = [np.flatnonzero((CLOUD == point).all(axis=1)).item() for point in cut]
    assert len(cut) == 25
    assert sorted(set(rows)) == rows
    np.testing.assert_array_equal(cut, load_points(tmp_path / "cloud.npy", count=25, seed=0))
    assert not np.array_equal(cut, load_points(tmp_path / "cloud.npy", count=25, seed=1))
    np.testing.assert_array_equal(load_points(tmp_path / "cloud.npy", count=41), CLOUD)


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_scenes_are_read_as_one_watertight_mesh(tmp_path, suffix):
    path = tmp_path / f"boxes.{suffix}"
    (two_boxes() if suffix == "glb" else two_boxes().to_mesh()).export(path)
    mesh = load_mesh(path, scale=0.1)
    np.testing.assert_allclose(mesh.bounds, [[-0.05, -0.1, -0.15], [1.05, 0.1, 0.15]], atol=1e-6)
    assert mesh.area == pytest.approx(2 * 22 * 0.01)
    assert mesh.is_watertight
    assert len(mesh.faces) == 24


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_meshes_are_sampled_on_their_surface(tmp_path, suffix):
    path = tmp_path / f"box.{suffix}"
    trimesh.creation.box((1, 2, 3)).export(path)
    points = load_points(path, scale=0.1)
    assert points.shape == (1500, 3)
    assert points.dtype == np.float32
    on_a_face = np.abs(np.abs(points) - [0.05, 0.1, 0.15]) < 1e-6
    assert on_a_face.any(axis=1).all()
    assert load_points(path, count=30).shape == (30, 3)
    np.testing.assert_array_equal(points, load_points(path, scale=0.1, seed=0))
    assert not np.array_equal(points, load_points(path, scale=0.1, seed=1))


DAMAGED = {
    "empty.xyz": b"# nothing\n",
    "two_columns.xyz": b"1 2\n" * 30,
    "binary.xyz": b"\xff\xfe\x00",
    "words.xyz": b"a b c\n" * 30,
    "text.npy": b"hello",
    "text.npz": b"hello",
    "torn.npz": b"PK\x03\x04xx",
    "noise.pcd": b"\x00\x01",
    "no_fields.pcd": b"POINTS 3\nDATA ascii\n",
    "torn.ply": b"ply\nformat ascii 1.0\nelement vert",
    "torn.glb": b"glTF\x02",
    "torn.off": b"OFF\n3 1",
    "torn.stl": b"\x00" * 10,
    "empty.obj": b"",
    "no_such_vertex.obj": b"v 0 0 0\nf 1 2 9\n",
    "no_faces.off": b"OFF\n3 0 0\n0 0 0\n1 0 0\n0 1 0\n",
    "infinite.off": b"OFF\n3 1 0\n0 0 0\n1 0 inf\n0 1 0\n3 0 1 2\n",
    "flat.off": b"OFF\n3 1 0\n0 0 0\n1 0 0\n2 0 0\n3 0 1 2\n",
}


@pytest.mark.parametrize("name", DAMAGED)
def test_damaged_files_are_input_errors_that_name_the_file(tmp_path, name):
    (tmp_path / name).write_bytes(DAMAGED[name])
    with pytest.raises(InputError, match=rf"load_points\(\): .*{name}"):
        load_points(tmp_path / name)


@pytest.mark.parametrize("suffix", ["obj", "ply", "off"])
def test_a_mesh_without_faces_is_a_cloud(tmp_path, suffix):
    path = tmp_path / f"points.{suffix}"
    rows = "".join("{:.9g} {:.9g} {:.9g}\n".format(*point) for point in CLOUD)
    if suffix == "ply":
        write_ply(path, CLOUD)
    elif suffix == "obj":
        path.write_text("v " + rows[:-1].replace("\n", "\nv "))
    else:
        path.write_text(f"OFF\n{len(CLOUD)} 0 0\n{rows}")
    np.testing.assert_array_equal(load_points(path), CLOUD)
    with pytest.raises(InputError, match=rf"load_mesh\(\): .*points.{suffix} has no faces"):
        load_mesh(path)


@pytest.mark.parametrize("content", ["# nothing\n", "o mug\nvn 0 0 1\n"])
def test_a_mesh_without_vertices_is_named(tmp_path, content):
    (tmp_path / "mug.obj").write_text(content)
    with pytest.raises(InputError, match="mug.obj has neither faces nor points; expected a surface or a cloud"):
        load_points(tmp_path / "mug.obj")


def test_vertices_that_are_damaged_are_named(tmp_path):
    (tmp_path / "mug.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1e30 0\nf 1 2 3\n")
    for load in (load_mesh, load_points):
        with pytest.raises(InputError, match=r"mug.obj has vertices up to 1e\+30 from the origin; expected at most"):
            load(tmp_path / "mug.obj")


FAR = np.array([412345.0, 5412345.0, 120.0])


@pytest.mark.parametrize("suffix", ["npy", "xyz", "ply", "pcd"])
def test_clouds_far_from_the_origin_stay_float64(tmp_path, suffix):
    """In map coordinates float32 has steps of half a metre, so that a mug would become a few points."""
    points, path = CLOUD.astype(np.float64) + FAR, tmp_path / f"far.{suffix}"
    rows = "".join("{:.9f} {:.9f} {:.9f}\n".format(*point) for point in points)
    match suffix:
        case "npy":
            np.save(path, points)
        case "xyz":
            path.write_text(rows)
        case "ply":
            head = "".join(f"property double {axis}\n" for axis in "xyz")
            path.write_text(f"ply\nformat ascii 1.0\nelement vertex 40\n{head}end_header\n{rows}")
        case "pcd":
            head = "FIELDS x y z\nSIZE 8 8 8\nTYPE F F F\nWIDTH 40\nHEIGHT 1\nDATA binary\n"
            path.write_bytes(head.encode() + points.tobytes())
    read = load_points(path)
    assert read.dtype == np.float64
    np.testing.assert_allclose(read - FAR, CLOUD, atol=2e-9)
    read = load_points(path, count=30, scale=0.001)
    assert read.dtype == np.float64 and read.shape == (30, 3)


def test_meshes_far_from_the_origin_stay_float64(tmp_path):
    box = trimesh.creation.box((0.1, 0.2, 0.3))
    box.apply_translation(FAR)
    rows = ["v {:.6f} {:.6f} {:.6f}".format(*vertex) for vertex in box.vertices]
    rows += ["f {} {} {}".format(*(face + 1)) for face in box.faces]
    (tmp_path / "box.obj").write_text("\n".join(rows))
    mesh, points = load_mesh(tmp_path / "box.obj"), load_points(tmp_path / "box.obj")
    assert mesh.vertices.dtype == points.dtype == np.float64
    np.testing.assert_allclose(mesh.bounds - FAR, [[-0.05, -0.1, -0.15], [0.05, 0.1, 0.15]], atol=1e-6)
    on_a_face = np.abs(np.abs(points - FAR) - [0.05, 0.1, 0.15]) < 1e-6
    assert on_a_face.any(axis=1).all()


@pytest.mark.parametrize("suffix", ["npy", "pcd", "ply", "stl"])
def test_float32_in_map_coordinates_is_refused(tmp_path, suffix):
    """The file has lost the shape already: float32 has steps of half a metre there."""
    points, path = (CLOUD.astype(np.float64) + FAR).astype(np.float32), tmp_path / f"far.{suffix}"
    match suffix:
        case "npy":
            np.save(path, points)
        case "pcd":
            head = "FIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nWIDTH 40\nHEIGHT 1\nDATA binary\n"
            path.write_bytes(head.encode() + points.tobytes())
        case "ply":
            head = "".join(f"property float {axis}\n" for axis in "xyz")
            head = f"ply\nformat binary_little_endian 1.0\nelement vertex 40\n{head}end_header\n"
            path.write_bytes(head.encode() + points.tobytes())
        case "stl":
            trimesh.creation.box((1, 2, 3)).apply_translation(FAR).export(path)
    for load in (load_points, load_mesh) if suffix == "stl" else (load_points,):
        with pytest.raises(InputError, match=r"stores float32 numbers, which are 0.5 m apart .*doubles or relative to"):
            load(path)


def test_float32_is_read_where_it_resolves_a_millimetre(tmp_path):
    path = tmp_path / "cloud.npy"
    for offset, scale in ((8000.0, 1.0), (1e6, 0.001)):
        np.save(path, (CLOUD / scale + np.float32(offset)).astype(np.float32))
        np.testing.assert_allclose(load_points(path, scale=scale), CLOUD + offset * scale, atol=1e-3)
    one_far = CLOUD.astype(np.float32)
    one_far[0, 0] = 1e5 + 0.25  # a wrong measurement says nothing about the others
    np.save(path, one_far)
    np.testing.assert_array_equal(load_points(path), one_far)


def test_clouds_become_float32_where_that_is_exact_to_a_hundredth_of_a_millimetre(tmp_path):
    for farthest, kind in ((80.0, np.float32), (900.0, np.float64)):
        np.save(tmp_path / "cloud.npy", np.linspace(-farthest, farthest, 300).reshape(100, 3))
        assert load_points(tmp_path / "cloud.npy").dtype == kind
    np.save(tmp_path / "cloud.npy", 1000 * np.arange(120.0).reshape(40, 3))  # whole numbers are exact in both
    assert load_points(tmp_path / "cloud.npy").dtype == np.float32


@pytest.mark.parametrize("suffix", ["npy", "xyz", "ply"])
def test_invalid_rows_are_refused_or_removed(tmp_path, suffix):
    points, path = np.repeat(CLOUD, 2, axis=0), tmp_path / f"cloud.{suffix}"
    points[[3, 4, 5]], points[10:20] = np.nan, 0
    if suffix == "npy":
        np.save(path, points)
    elif suffix == "xyz":
        np.savetxt(path, points, "%.9g")
    else:
        write_ply(path, points)
    with pytest.raises(InputError, match="3 of the 80 points of .* are NaN or infinite"):
        load_points(path)
    valid = np.isfinite(points).all(axis=1) & points.any(axis=1)
    with pytest.warns(InvalidPointsWarning, match="removed 13 of 80 points: 3 are NaN or infinite, 10 are"):
        np.testing.assert_array_equal(load_points(path, drop_invalid=True), points[valid])


def test_nothing_is_removed_from_a_valid_cloud(tmp_path):
    np.save(tmp_path / "cloud.npy", CLOUD)
    np.testing.assert_array_equal(load_points(tmp_path / "cloud.npy", drop_invalid=True), CLOUD)


FOREIGN = {
    "a.obj": (b"\x1f\x8b\x08\x00", "is compressed by gzip; expected the content of a .obj file; unpack it by gunzip"),
    "a.stl": (b"PK\x03\x04rest", "is a zip archive; expected the content of a .stl file; unpack it"),
    "a.glb": (
        b"version https://git-lfs.github.com/spec/v1\noid sha256:1\n",
        "is a pointer of Git LFS.*; run git lfs pull",
    ),
    "a.off": (b"\r\n<!DOCTYPE html><html></html>", "is a web page; .*; download the file itself"),
    "a.npy": (b"\x89HDF\r\n\x1a\n", "is an HDF5 file; .* read the array by h5py"),
    "a.ply": (b"glTF\x02\0\0\0", "holds the content of a .glb file; expected .ply; rename it to .glb"),
    "a.pcd": (b"\x93NUMPY\x01\0", "holds the content of a .npy file; expected .pcd"),
    "b.obj": (b"ply\r\nformat ascii 1.0\r\n", "holds the content of a .ply file; expected .obj"),
    "a.txt": (b"# .PCD v.7 - Point Cloud Data\n", "holds the content of a .pcd file; expected .txt"),
}


@pytest.mark.parametrize("name", FOREIGN)
def test_files_of_another_kind_are_named(tmp_path, name):
    content, message = FOREIGN[name]
    (tmp_path / name).write_bytes(content)
    with pytest.raises(InputError, match=rf"load_points\(\): .*{name} {message}") as error:
        load_points(tmp_path / name)
    assert "save it again" not in str(error.value)


@pytest.mark.skipif(os.geteuid() == 0, reason="root may read every file")
def test_files_that_may_not_be_read_are_named(tmp_path):
    np.save(tmp_path / "cloud.npy", CLOUD)
    (tmp_path / "cloud.npy").chmod(0)
    with pytest.raises(InputError, match=r"cloud.npy cannot be opened \(Permission denied\); expected a file you may"):
        load_points(tmp_path / "cloud.npy")


@pytest.mark.parametrize("load", [load_mesh, load_points])
def test_wrong_paths_and_scales(tmp_path, load):
    with pytest.raises(InputError, match=f"{load.__name__}.*there is no file .*mug.obj"):
        load(tmp_path / "mug.obj")
    with pytest.raises(InputError, match=f"{load.__name__}.*there is no file"):
        (tmp_path / "folder.ply").mkdir()
        load(tmp_path / "folder.ply")
    with pytest.raises(InputError, match=f"{load.__name__}.*suffix '.dae'; expected one of .obj, .stl, .ply, .glb, .g"):
        load(tmp_path / "mug.dae")
    trimesh.creation.box().export(tmp_path / "box.stl")
    for scale in (0, -1, np.nan, np.inf):
        with pytest.raises(InputError, match="scale is .*; expected a positive number, metres per unit"):
            load(tmp_path / "box.stl", scale=scale)


def test_bad_counts_and_points_of_files(tmp_path):
    np.save(tmp_path / "cloud.npy", CLOUD)
    with pytest.raises(InputError, match="count is 0"):
        load_points(tmp_path / "cloud.npy", count=0)
    with pytest.raises(InputError, match="has 20 points"):
        load_points(tmp_path / "cloud.npy", count=20)
    np.save(tmp_path / "flat.npy", CLOUD[:, :2])
    with pytest.raises(InputError, match=r"flat.npy has shape \(40, 2\)"):
        load_points(tmp_path / "flat.npy")


@pytest.mark.parametrize("array", [np.asarray, jnp.asarray])
def test_check_points_returns_good_points_as_they_are(array):
    points = array(CLOUD)
    assert checks.points("encode()", points) is points
    assert checks.points("encode()", points[:21]).shape == (21, 3)


def test_check_points_of_lists_and_integers():
    points = checks.points("encode()", CLOUD.tolist())
    assert isinstance(points, np.ndarray)
    np.testing.assert_array_equal(points, CLOUD)
    assert checks.points("encode()", np.arange(63).reshape(21, 3)).dtype == np.float64


def replaced(value):
    points = CLOUD.copy()
    points[[3, 5], 1] = value
    return points


BAD_POINTS = {
    r"has shape \(40, 2\); expected \(points, 3\)": CLOUD[:, :2],
    r"has shape \(120,\)": CLOUD.ravel(),
    r"has shape \(1, 40, 3\)": CLOUD[None],
    "has 20 points; expected at least 21": CLOUD[:20],
    "has 0 points": CLOUD[:0],
    "2 of the 40 points of cloud are NaN or infinite": replaced(np.nan),
    "2 of the 40 points of cloud are NaN or inf": replaced(np.inf),
    r"are all equal to \[1.0, 2.0, 3.0\]": np.tile([1.0, 2.0, 3.0], (30, 1)),
    "has dtype complex64": CLOUD.astype(np.complex64),
    "has dtype bool": CLOUD > 0,
    "has dtype <U1": np.full((30, 3), "a"),
    "that cannot be read as an array": [[1, 2, 3], [4, 5]],
}


@pytest.mark.parametrize("message", BAD_POINTS)
def test_check_points_says_what_is_wrong(message):
    with pytest.raises(InputError, match=message):
        checks.points("encode()", BAD_POINTS[message], "cloud")


def test_check_points_inside_jit_checks_the_shape():
    np.testing.assert_array_equal(jax.jit(functools.partial(checks.points, "encode()"))(CLOUD), CLOUD)
    with jax.debug_nans(False):
        assert np.isnan(jax.jit(functools.partial(checks.points, "encode()"))(replaced(np.nan))).sum() == 2
    with pytest.raises(InputError, match="has 20 points"):
        jax.jit(functools.partial(checks.points, "encode()"))(CLOUD[:20])


def test_thinning_by_hand():
    """On a line the mean is 3.4, so 10 is first, then 0; then 4 (4 away) before 3 (3) and 0.0."""
    points = np.array([[0, 0, 0], [3, 0, 0], [4, 0, 0], [10, 0, 0], [0, 0, 0]], np.float32)
    np.testing.assert_array_equal(farthest_point_indices(points, 3), [3, 0, 2])
    np.testing.assert_array_equal(thin(points, 3), points[[3, 0, 2]])
    np.testing.assert_array_equal(farthest_point_indices(points, 4), [3, 0, 2, 1])
    assert thin(points, 5) is points
    assert thin(points, 9) is points
    np.testing.assert_array_equal(farthest_point_indices(points, 9), range(5))


def test_thinning_takes_the_farthest_point_each_time():
    points = np.random.default_rng(1).normal(size=(200, 3))
    indices = farthest_point_indices(points, 30)
    assert indices[0] == np.argmax(np.linalg.norm(points - points.mean(axis=0), axis=1))
    distances = np.linalg.norm(points[:, None] - points[None], axis=-1)
    for i in range(1, 30):
        assert indices[i] == np.argmax(distances[:, indices[:i]].min(axis=1))


def test_thinning_never_takes_a_point_twice():
    points = np.repeat(np.eye(3), 10, axis=0)
    assert len(set(farthest_point_indices(points, 25))) == 25


def test_thinning_far_from_the_origin_is_the_same():
    points = CLOUD.astype(np.float64)
    np.testing.assert_array_equal(farthest_point_indices(points, 20), farthest_point_indices(points + 1e4, 20))


def test_thinning_refuses_bad_input():
    with pytest.raises(InputError, match="count is 0"):
        thin(CLOUD, 0)
    with pytest.raises(InputError, match=r"shape \(40, 2\)"):
        thin(CLOUD[:, :2], 5)


@pytest.mark.slow
def test_importing_does_not_load_trimesh():
    code = "import sys, tdf_jax.io.pointclouds; sys.exit('trimesh' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
