"""Clouds, and the meshes they are sampled from: files of every kind and their damage, thinning."""

import functools
import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import trimesh

from tdf_jax._internal import checks
from tdf_jax._internal.errors import InputError
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


def write_pcd(path, data, body, count=40):
    header = "# .PCD v0.7\nVERSION 0.7\nFIELDS _ x y z rgb _\nSIZE 1 4 4 4 4 1\nTYPE U F F F U U\nCOUNT 3 1 1 1 1 2\n"
    header += f"WIDTH {count}\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS {count}\nDATA {data}\n"
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
    with pytest.raises(InputError, match=name if name != "flat.off" else "has no area"):
        load_points(tmp_path / name)


def test_the_arrays_of_an_npz_must_be_clear(tmp_path):
    np.savez(tmp_path / "two.npz", a=CLOUD, b=CLOUD)
    with pytest.raises(InputError, match=r"holds the arrays \['a', 'b'\]; expected one named points"):
        load_points(tmp_path / "two.npz")


@pytest.mark.parametrize("name", ["objects.npy", "objects.npz"])
def test_pickles_are_refused(tmp_path, name):
    objects = np.array([{"a": 1}], dtype=object)
    (np.save if name.endswith("npy") else np.savez)(tmp_path / name, objects)
    with pytest.raises(InputError, match=f"{name} cannot be read"):
        load_points(tmp_path / name)


def test_pcd_files_that_break_their_promise(tmp_path):
    write_pcd(tmp_path / "torn.pcd", "binary", pcd_record()[:-5])
    with pytest.raises(InputError, match="cannot be read as .pcd"):
        load_points(tmp_path / "torn.pcd")
    write_pcd(tmp_path / "short.pcd", "ascii", b"1 2 3 0 0 0 7 0 0\n" * 30)
    with pytest.raises(InputError, match="has 30 points; its header promises 40"):
        load_points(tmp_path / "short.pcd")
    write_pcd(tmp_path / "packed.pcd", "binary_compressed", b"")
    with pytest.raises(InputError, match="DATA is binary_compressed; expected ascii or binary"):
        load_points(tmp_path / "packed.pcd")


@pytest.mark.parametrize("suffix", ["obj", "ply", "off"])
def test_meshes_without_faces_are_refused(tmp_path, suffix):
    path = tmp_path / f"points.{suffix}"
    if suffix == "ply":
        write_ply(path, CLOUD)
    elif suffix == "obj":
        path.write_text("".join("v {:.9g} {:.9g} {:.9g}\n".format(*point) for point in CLOUD))
    else:
        path.write_bytes(DAMAGED["no_faces.off"])
    with pytest.raises(InputError, match=rf"load_mesh\(\): .*points.{suffix} has no faces"):
        load_mesh(path)
    if suffix != "ply":
        with pytest.raises(InputError, match=rf"load_points\(\): .*points.{suffix} is a mesh without faces"):
            load_points(path)


@pytest.mark.parametrize("load", [load_mesh, load_points])
def test_wrong_paths_and_scales(tmp_path, load):
    with pytest.raises(InputError, match=f"{load.__name__}.*there is no file .*mug.obj"):
        load(tmp_path / "mug.obj")
    with pytest.raises(InputError, match=f"{load.__name__}.*there is no file"):
        (tmp_path / "folder.ply").mkdir()
        load(tmp_path / "folder.ply")
    with pytest.raises(InputError, match=f"{load.__name__}.*suffix '.txt'; expected one of .obj, .stl, .ply, .glb, .o"):
        load(tmp_path / "mug.txt")
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
    assert checks.points("encode()", np.arange(63).reshape(21, 3)).dtype == np.float32


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
    "is not an array of numbers": [[1, 2, 3], [4, 5]],
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
