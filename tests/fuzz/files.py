"""Cases of files: each reader, its undamaged file, variants that must not matter and damage that must be seen."""

import dataclasses
import io
import json
import pickle
import zipfile
from collections.abc import Callable
from typing import Any

import numpy as np

from . import damage, undamaged as good
from .cases import ANY, DOUBT, ONLY_REFUSED, ONLY_RIGHT, Case, differs, differs_as_set
from .undamaged import CLOUD, POLYGONS, TRIANGLES, VERTICES, World, leaves


@dataclasses.dataclass(frozen=True)
class Reader:
    """A reader and one undamaged file.

    Attributes:
        kind: kind of the file.
        name: name of the file.
        data: its bytes.
        read: reads a path.
        check: says how a result differs from the undamaged one.
        checked: whether the format has a checksum, so that all damage of bytes is seen or does not matter.
        counted: whether a file that is cut short must be refused.


    """

    kind: str
    name: str
    data: bytes
    read: Callable[[Any], Any]
    check: Callable[[Any], str | None]
    checked: bool = False
    counted: bool = False


def not_finite(result) -> str | None:
    """Say whether a result has numbers that are not finite."""
    return None if all(np.isfinite(leaf).all() for leaf in leaves(result)) else "not finite"


def mesh_problem(mesh) -> str | None:
    """How a mesh differs from the undamaged one: its corners as a set, its area and its volume."""
    from_faces = np.linalg.norm(np.cross(*_edges(VERTICES)), axis=1).sum() / 2
    problem = differs_as_set(mesh.vertices, VERTICES, 2e-6)
    if problem is None and abs(mesh.area - from_faces) > 1e-3 * from_faces:
        problem = f"area {mesh.area:.6g}; expected {from_faces:.6g}"
    if problem is None and abs(abs(mesh.volume) - _volume()) > 1e-3 * _volume():
        problem = f"volume {mesh.volume:.6g}; expected {_volume():.6g}"
    return problem


def _edges(vertices):
    a, b, c = np.moveaxis(vertices[TRIANGLES], 1, 0)
    return b - a, c - a


def _volume():
    a, b, c = np.moveaxis(VERTICES[TRIANGLES] - VERTICES.mean(axis=0), 1, 0)
    return abs(np.einsum("ij,ij->i", a, np.cross(b, c)).sum() / 6)


def samples_problem(points) -> str | None:
    """How samples of a surface cannot be of the undamaged one: their number, and where they lie."""
    if points.shape != (1500, 3):
        return f"shape {points.shape}; expected (1500, 3)"
    outside = np.maximum(VERTICES.min(axis=0) - points, points - VERTICES.max(axis=0)).max()
    apart = np.abs(np.ptp(points, axis=0) - np.ptp(VERTICES, axis=0)).max()
    return None if outside < 1e-5 and apart < 0.01 else f"{outside:.3g} outside, extent differs by {apart:.3g}"


def cloud_problem(points) -> str | None:
    """How a cloud differs from the undamaged one, as a set."""
    return differs_as_set(points, CLOUD)


def one_of(rng, options):
    """One of some options."""
    return options[int(rng.integers(len(options)))]


# Meshes


def mesh_variant(rng):
    """Name, bytes and meaning of a mesh file that is valid."""
    turn = rng.permutation(len(VERTICES))
    back = np.argsort(turn)
    vertices, faces = VERTICES[turn], back[TRIANGLES]
    rolled = [np.roll(face, int(rng.integers(3))) for face in rng.permutation(TRIANGLES)]
    wide = [[int(back[i]) for i in polygon] for polygon in POLYGONS]
    scene, buffer = good.gltf_parts(vertices, faces)
    offset = np.array([0.5, 0.25, -0.125])
    moved = good.gltf_parts(VERTICES - offset, TRIANGLES, offset)
    doubled = np.concatenate([TRIANGLES, TRIANGLES + len(VERTICES)])
    options = {
        "vertices permuted.obj": good.obj_text(vertices, faces),
        "faces permuted.obj": good.obj_text(VERTICES, rolled),
        "polygons.obj": good.obj_text(vertices, wide),
        "relative indices.obj": good.obj_text(relative=True, corner="{}"),
        "colours.obj": good.obj_text(vertex_end=" 0.5 0.5 0.5"),
        "normals.obj": "vn 0 0 1\nvt 0 0\n" + good.obj_text(corner="{}/1/1"),
        "groups.obj": "mtllib none.mtl\no a\ng b\nusemtl c\ns 1\n" + good.obj_text(),
        "comments in Latin-1.obj": b"# Gr\xf6\xdfe\n" + good.obj_text().encode(),
        "comments in GBK.obj": "# 杯子\n".encode("gbk") + good.obj_text().encode(),
        "carriage returns.obj": good.obj_text().replace("\n", "\r\n"),
        "blanks.obj": good.obj_text().replace(" ", " \t ").replace("\n", "  \n\n"),
        "byte order mark.obj": b"\xef\xbb\xbf" + good.obj_text().encode(),
        "no last newline.obj": good.obj_text().rstrip("\n"),
        "vertices permuted.off": good.off_text(vertices, faces),
        "polygons.off": good.off_text(vertices, wide),
        "counts in the first line.off": good.off_text(head="OFF "),
        "comments.off": good.off_text(head="# a\nOFF\n# b\n"),
        "binary.stl": good.stl_bytes(),
        "named solid.stl": good.stl_bytes(header=b"solid of a binary file"),
        "faces permuted.stl": good.stl_bytes(VERTICES, rolled),
        "text.stl": good.stl_text(),
        "upper case.stl": good.stl_text().upper().replace("SOLID BODY", "solid body"),
        "ascii.ply": good.ply_bytes("ascii", vertices, faces),
        "little.ply": good.ply_bytes("binary_little_endian", vertices, wide),
        "big.ply": good.ply_bytes("binary_big_endian", vertices, wide, "double"),
        "other columns.ply": good.ply_bytes("binary_little_endian", extra=4),
        "columns permuted.ply": good.ply_bytes("binary_little_endian", axes="zxy"),
        "scene.glb": good.glb_bytes(scene, buffer),
        "moved.glb": good.glb_bytes(*moved),
        "text.gltf": good.gltf_text(scene, buffer),
        "triangles apart.obj": good.obj_text(
            VERTICES[TRIANGLES].reshape(-1, 3), np.arange(3 * len(TRIANGLES)).reshape(-1, 3)
        ),
        "unused vertices.obj": good.obj_text(np.concatenate([VERTICES, VERTICES + 5]), TRIANGLES),
        "unused infinite vertices.obj": good.obj_text(np.concatenate([VERTICES, [[np.nan] * 3]]), TRIANGLES),
    }
    del doubled
    name = one_of(rng, list(options))
    data = options[name]
    return name, data.encode() if isinstance(data, str) else data


def mesh_reader(rng, world: World) -> Reader:
    """A mesh that is read as a mesh or as points."""
    name, data = mesh_variant(rng)
    counted = name.endswith((".stl", ".ply", ".glb", ".gltf")) and not name.startswith(("text.s", "upper", "ascii"))
    if rng.random() < 0.7:
        return Reader("mesh", name, data, world.tdf.load_mesh, mesh_problem, counted=counted)
    return Reader("mesh", name, data, world.tdf.load_points, samples_problem, counted=counted)


def mesh_content(rng, world: World, folder):
    """Meshes whose content is wrong: the damage is known, and must be seen."""
    spoilt, faces = VERTICES.copy(), TRIANGLES.copy()
    spoilt[int(rng.integers(len(spoilt))), int(rng.integers(3))] = one_of(rng, [np.nan, np.inf, -np.inf])
    faces[int(rng.integers(len(faces))), 0] = one_of(rng, [len(VERTICES), 60000, 2**16 - 1])
    scene, buffer = good.gltf_parts()
    needed = scene | {"extensionsRequired": ["KHR_draco_mesh_compression"]}
    cut = scene | {"bufferViews": [scene["bufferViews"][0] | {"byteLength": 10}, scene["bufferViews"][1]]}
    beyond = scene | {"accessors": [scene["accessors"][0] | {"count": 10**7}, scene["accessors"][1]]}
    circle = scene | {"nodes": [{"children": [0], "mesh": 0}]}
    options = {
        "NaN or infinite.obj": good.obj_text(spoilt), "NaN or infinite.off": good.off_text(spoilt),
        "NaN or infinite.stl": good.stl_bytes(spoilt), "NaN or infinite.ply": good.ply_bytes("ascii", spoilt),
        "no such vertex.obj": good.obj_text(VERTICES, faces), "no such vertex.off": good.off_text(VERTICES, faces),
        "no such vertex.ply": good.ply_bytes("binary_little_endian", VERTICES, faces),
        "negative index.off": good.off_text(VERTICES, [[-1, 1, 2], *TRIANGLES]),
        "negative index.ply": good.ply_bytes("binary_little_endian", VERTICES, [[-1, 1, 2], *TRIANGLES]),
        "index zero.obj": good.obj_text().replace("f 1 ", "f 0 ", 1) + "f 0 1 2\n",
        "no such vertex.glb": good.glb_bytes(*good.gltf_parts(VERTICES, faces)),
        "NaN or infinite.glb": good.glb_bytes(scene, np.asarray(spoilt,
        "<f4").tobytes() + buffer[len(VERTICES) * 12 :]),
        "compressed.glb": good.glb_bytes(needed, buffer), "short view.glb": good.glb_bytes(cut, buffer),
        "long accessor.glb": good.glb_bytes(beyond, buffer), "nodes in a circle.glb": good.glb_bytes(circle, buffer),
        "no faces.obj": good.obj_text(VERTICES, []), "no area.obj": good.obj_text(VERTICES * [1, 0, 0], TRIANGLES),
        "word for a number.obj": good.obj_text().replace("v 0", "v zero", 1),
        "decimal commas.obj": good.obj_text().replace(".", ","),
        "two coordinates.obj": "v 1 2\n" + good.obj_text(),
        "promises more.stl": good.stl_bytes()[:-50], "has more.stl": good.stl_bytes() + bytes(50),
        "wrong byte order.ply": good.ply_bytes("binary_big_endian").replace(b"big_endian", b"little_endian"),
    }  # fmt: skip
    name = one_of(rng, list(options))
    data = options[name]
    path = folder / name
    path.write_bytes(data.encode() if isinstance(data, str) else data)
    read = world.tdf.load_points if name in {"no area.obj", "no faces.obj"} else world.tdf.load_mesh
    if name == "decimal commas.obj":  # may be read, if it is read right
        return Case("mesh content", name, lambda: read(path), mesh_problem)
    # 23 vertices without faces are a cloud, and a right one.
    expected = ANY if name == "no faces.obj" else ONLY_REFUSED
    return Case("mesh content", name, lambda: read(path), lambda r: None, expected)


# Clouds


def cloud_variant(rng):
    """Name and bytes of a cloud file that is valid and unambiguous."""
    points = CLOUD[rng.permutation(len(CLOUD))]
    colours = (lambda i: str(i % 7), lambda i: "128", lambda i: str(255 - i))
    named = np.zeros(len(points), [("intensity", "f4"), ("x", "f4"), ("y", "f8"), ("z", "f4")])
    named["x"], named["y"], named["z"] = points.T
    text = good.text_cloud(points)
    counting = "".join(f"{i} {line}\n" for i, line in enumerate(text.splitlines()))
    mixed = good.text_cloud(points[:, [2, 0, 1]], head="z x y\n")
    kind = [".xyz", ".txt", ".asc", ".pts"][int(rng.integers(4))]
    csv = good.text_cloud(points, ",", "x,y,z\n")
    options = {
        f"rows permuted{kind}": text, f"colours behind{kind}": good.text_cloud(points, columns=colours),
        f"tabs{kind}": good.text_cloud(points, "\t"), f"commas{kind}": good.text_cloud(points, ","),
        f"semicolons{kind}": good.text_cloud(points, "; "), f"comments{kind}": "# x y z\n// made by hand\n" + text,
        f"decimal commas{kind}": good.text_cloud(points, "; ", decimal=","),
        f"carriage returns{kind}": text.replace("\n", "\r\n"),
        f"count line{kind}": f"{len(points)}\n" + text, f"names{kind}": "x y z\n" + text,
        f"names permuted{kind}": mixed,
        f"byte order mark{kind}": b"\xef\xbb\xbf" + text.encode(), f"UTF-16{kind}": text.encode("utf-16"),
        f"counting column{kind}": counting, f"no last newline{kind}": text.rstrip("\n"),
        f"blanks{kind}": text.replace(" ", "   "),
        "names.csv": csv, "quoted names.csv": csv.replace("x,y,z", '"X","Y","Z"'),
        "other columns.csv": good.text_cloud(points[:, [0, 0, 1, 2]], ",", "id,x,y,z\n"),
        "ascii.pcd": good.pcd_bytes("ascii", points), "binary.pcd": good.pcd_bytes("binary", points),
        "compressed.pcd": good.pcd_bytes("binary_compressed", points),
        "no POINTS.pcd": good.pcd_bytes("binary", points, with_points=False),
        "fields permuted.pcd": good.pcd_bytes("binary", points, "yzx"),
        "fields permuted, ascii.pcd": good.pcd_bytes("ascii", points, "zxy"),
        "ascii.ply": good.ply_bytes("ascii", points, None),
        "binary.ply": good.ply_bytes("binary_little_endian", points, None),
        "big.ply": good.ply_bytes("binary_big_endian", points, None),
        "doubles.ply": good.ply_bytes("binary_big_endian", points, None, "double"),
        "columns permuted.ply": good.ply_bytes("binary_little_endian", points, None, axes="yzx", extra=3),
        "no faces.ply": good.ply_bytes("ascii", points, []),
        "float32.npy": good.npy_bytes(points), "float64.npy": good.npy_bytes(points.astype(float)),
        "big endian.npy": good.npy_bytes(points.astype(">f4")),
        "Fortran order.npy": good.npy_bytes(np.asfortranarray(points)),
        "transposed.npy": good.npy_bytes(points.T), "one more axis.npy": good.npy_bytes(points[None]),
        "colours.npy": good.npy_bytes(np.column_stack([points, points[:, ::-1]])), "named.npy": good.npy_bytes(named),
        "points.npz": good.npz_bytes(points=points), "single.npz": good.npz_bytes(anything=points),
        "others.npz": good.npz_bytes(points=points, normals=points * 2, name=np.array("mug")),
        "named.npz": good.npz_bytes(points=named),
    }  # fmt: skip
    name = one_of(rng, list(options))
    data = options[name]
    return name, data.encode() if isinstance(data, str) else data


def cloud_reader(rng, world: World) -> Reader:
    """A cloud."""
    name, data = cloud_variant(rng)
    checked = name.endswith(".npz")
    counted = name.endswith((".npy", ".npz", ".pcd", ".ply")) and "ascii" not in name and name != "no faces.ply"
    return Reader("cloud", name, data, world.tdf.load_points, cloud_problem, checked, counted)


def cloud_content(rng, world: World, folder):
    """Clouds whose numbers are wrong; what is wrong is known."""
    points = CLOUD.astype(float)
    spoilt, sentinel = points.copy(), points.copy()
    rows = rng.choice(len(points), int(rng.integers(2, 15)), replace=False)
    spoilt[rows[0], int(rng.integers(3))] = one_of(rng, [np.nan, np.inf, -np.inf])
    # Twice the origin is no measurement; of other values, two may be a duplicate.
    sentinel[rows] = one_of(rng, [[0, 0, 0], [0, 0, 0], [-1, -1, -1], [9.99, 9.99, 9.99]][: 4 if len(rows) > 2 else 2])
    labels = np.column_stack([rng.integers(0, 4, len(points)), points])
    turned = np.column_stack([good.poses(5, 40)[:, 4:], good.poses(5, 40)[:, :4]])
    arrays = {
        "not finite": spoilt, "a sentinel": sentinel, "all equal": np.tile(points[:1], (40, 1)), "all zero": 0 * points,
        "20 points": points[:20], "no points": points[:0], "two columns": points[:, :2], "one column": points[:, :1],
        "labels first": labels, "poses": turned, "all NaN": np.full_like(points, np.nan),
    }  # fmt: skip
    what = one_of(rng, list(arrays))
    array = arrays[what]
    suffix = one_of(rng, [".npy", ".npz", ".xyz", ".csv", ".ply", ".pcd"])
    if suffix in {".ply", ".pcd"} and array.shape[1] != 3:
        suffix = ".npy"
    data = {
        ".npy": lambda: good.npy_bytes(array), ".npz": lambda: good.npz_bytes(points=array),
        ".xyz": lambda: _rows(array, " "), ".csv": lambda: _rows(array, ","),
        ".ply": lambda: good.ply_bytes(one_of(rng, ["ascii", "binary_little_endian"]), array, None),
        ".pcd": lambda: good.pcd_bytes(one_of(rng, ["ascii", "binary", "binary_compressed"]), array),
    }[suffix]()  # fmt: skip
    if rng.random() < 0.25:  # arrays that are no numbers
        odd = damage.no_numbers(rng, points)
        while not isinstance(odd[1], np.ndarray) or odd[0] in {"one more axis", "two more axes", "a column more"}:
            odd = damage.no_numbers(rng, points)
        what, data, suffix = odd[0], good.npy_bytes(odd[1]), ".npy"
    path = folder / f"cloud{suffix}"
    path.write_bytes(data)
    drop = rng.random() < 0.2 and what in {"not finite", "a sentinel"}
    if not drop:
        return Case("cloud content", what + suffix, lambda: world.tdf.load_points(path), expected=ONLY_REFUSED)
    gone = rows[:1] if what == "not finite" else rows
    kept = np.delete(points, gone, axis=0)
    return Case(
        "cloud content", f"{what}{suffix}, dropped", lambda: world.tdf.load_points(path, drop_invalid=True),
        lambda found: differs(found, kept), DOUBT,
    )  # fmt: skip


def _rows(array, separator):
    return "".join(separator.join(f"{x:.9g}" for x in row) + "\n" for row in array).encode()


def cloud_numbers(rng, world: World, folder):
    """Scalars of `load_points`, and numbers far from 1 that are read exactly."""
    name, data = cloud_variant(rng)
    path = folder / name
    path.write_bytes(data)
    read = world.tdf.load_points
    if rng.random() < 0.3:
        power = float(one_of(rng, [1e-6, 1e-3, 1e3, 1e6, 1e15, 1e30]))
        offset = np.array(one_of(rng, [[0, 0, 0], [412345, 5412345, 120]]), float)
        far = CLOUD.astype(float) * power + offset
        name = one_of(rng, ["far.npy", "far.npz", "far.ply", "far.xyz"])
        path = folder / name
        path.write_bytes(
            {"npy": good.npy_bytes(far), "npz": good.npz_bytes(points=far),
             "ply": _double_ply(far),
             "xyz": "".join("{:.17g} {:.17g} {:.17g}\n".format(*row) for row in far).encode()}[name[4:]]
        )  # fmt: skip
        tolerance = 1e-9 if np.abs(far).max() > 100 else 1e-6
        tolerance = max(tolerance, 1e-5 / max(power, 1.0))

        def check(found):
            return differs(np.asarray(found, float) - offset, CLOUD.astype(float) * power, tolerance)

        return Case("cloud numbers", f"{power:g} at {offset[0]:g} in {name}", lambda: read(path), check, ANY)
    options = [{"scale": value} for value in (0, -1, np.nan, np.inf, "1", None, [1.0], 1j, True, np.zeros(3), {})]
    options += [{"count": value} for value in (0, -3, 2.5, "30", True, np.nan, [30], 10.0)]
    options += [{"seed": value} for value in (-1, 1.5, "0", [0.5], 2**70 + 0.5, np.nan)]
    keywords = one_of(rng, options)
    if "scale" not in keywords:
        keywords = {"count": 30} | keywords
    return Case("cloud numbers", f"{keywords} of {name}", lambda: read(path, **keywords), expected=ONLY_REFUSED)


def _double_ply(points):
    head = ["ply", "format binary_little_endian 1.0", f"element vertex {len(points)}"]
    head += [f"property double {axis}" for axis in "xyz"]
    return ("\n".join([*head, "end_header"]) + "\n").encode() + np.asarray(points, "<f8").tobytes()


# Demonstrations and trajectories


def demonstration_problem(found) -> str | None:
    """How a demonstration differs from the undamaged one; the points as a set."""
    problem = differs_as_set(found.points, CLOUD) or differs(found.trajectory.wxyz_xyz, good.poses())
    indices = (found.grasp % good.POSES, found.release % good.POSES)
    return problem or differs(found.query, good.query()) or (None if indices == (1, 2) else f"indices {indices}")


def demonstration_reader(rng, world: World) -> Reader:
    """A demonstration; all damage is seen by the checksums of the archive."""
    arrays = good.demonstration_arrays()
    arrays["points"] = arrays["points"][rng.permutation(len(CLOUD))]
    for name in ("points", "wxyz_xyz", "query"):
        arrays[name] = arrays[name].astype(one_of(rng, ["<f4", "<f8", ">f4", ">f8"]))
    for name in ("grasp", "release", "schema"):
        arrays[name] = arrays[name].astype(one_of(rng, ["i1", "u1", ">i4", "<u8"]))
    if rng.random() < 0.3:
        arrays |= {"notes": np.array("mine"), "points2": np.zeros(3)}
    names = list(arrays)
    arrays = {names[i]: arrays[names[i]] for i in rng.permutation(len(names))}
    return Reader(
        "demonstration", "demo.npz", good.npz_bytes(**arrays), world.tdf.load_demonstration, demonstration_problem,
        True, True,
    )  # fmt: skip


def demonstration_content(rng, world: World, folder):
    """Demonstrations with wrong numbers: units, orders, frames, indices."""
    arrays = good.demonstration_arrays()
    points, poses, query = (arrays[name] for name in ("points", "wxyz_xyz", "query"))
    name = one_of(rng, ["points", "wxyz_xyz", "query"])
    unit = one_of(rng, [1000.0, 100.0])
    position = np.r_[np.ones(4), unit * np.ones(3)]
    ros, shuffled = poses[:, [4, 5, 6, 1, 2, 3, 0]], poses[:, [4, 5, 6, 0, 1, 2, 3]]
    odd = damage.no_numbers(rng, arrays[name])
    while not isinstance(odd[1], np.ndarray) or odd[0] == "objects":
        odd = damage.no_numbers(rng, arrays[name])
    # Not here, because nothing shows it: qx qy qz qw in place of qw qx qy qz, which has norm 1 as well.
    options = {
        f"{name}: {odd[0]}": {name: odd[1]}, f"{name}: objects": {name: np.full(3, None, object)},
        f"{name} transposed": {name: arrays[name].T}, f"no {name}": {name: None},
        "points in mm or cm": {"points": points * unit}, "poses in mm or cm": {"wxyz_xyz": poses * position},
        "all in mm or cm": {"points": points * unit, "wxyz_xyz": poses * position, "query": query * unit},
        "positions first, w last": {"wxyz_xyz": ros}, "positions first": {"wxyz_xyz": shuffled},
        "a quaternion of norm 2": {"wxyz_xyz": poses * [[2.0] * 4 + [1.0] * 3]},
        "a quaternion of zeros": {"wxyz_xyz": poses * [0, 0, 0, 0, 1, 1, 1]},
        "no poses": {"wxyz_xyz": poses[:0]}, "poses far away": {"wxyz_xyz": poses + np.r_[0, 0, 0, 0, 3, 0, 0]},
        "matrices": {"wxyz_xyz": np.tile(np.eye(4), (4, 1, 1))},
        "grasp beyond": {"grasp": np.int64(one_of(rng, [4, 99, -5, 2**40]))},
        "release beyond": {"release": np.int64(one_of(rng, [4, 99, -5]))},
        "release first": {"grasp": np.int64(3), "release": np.int64(0)}, "grasp of 0.5": {"grasp": np.float64(0.5)},
        "two grasps": {"grasp": np.array([0, 1])}, "a newer schema": {"schema": np.int64(one_of(rng, [0, -1, 99]))},
        "schema in words": {"schema": np.array("two")}, "everything NaN": {"points": points * np.nan},
        "half of the points zero": {"points": points * (np.arange(len(points)) % 2)[:, None]},
        "far from the origin": {"points": points + 4e5, "wxyz_xyz": poses + np.r_[0, 0, 0, 0, 4e5, 4e5, 4e5]},
    }  # fmt: skip
    what = one_of(rng, list(options))
    arrays = {name: array for name, array in (arrays | options[what]).items() if array is not None}
    if "two" in str(arrays["schema"]):
        pass
    path = folder / "demo.npz"
    np.savez(path, **arrays)
    return Case("demonstration content", what, lambda: world.tdf.load_demonstration(path), expected=DOUBT)


def trajectory_reader(rng, world: World) -> Reader:
    """A trajectory in one of its formats."""
    poses = good.poses()
    names = [list(good.COLUMNS)[i] for i in rng.permutation(7)]
    more = [*names[:3], "time", *names[3:], "speed"]
    options = {
        "t.npz": good.npz_bytes(wxyz_xyz=poses),
        "double.npz": good.npz_bytes(wxyz_xyz=poses.astype(">f8"), other=np.zeros(2)),
        "t.tum": good.tum_text(poses), "comments.tum": good.tum_text(poses, head="# t x y z qx qy qz qw\n"),
        "tabs.tum": good.tum_text(poses, separator="\t"),
        "carriage returns.tum": good.tum_text(poses).replace("\n", "\r\n"),
        "mark.tum": "\ufeff" + good.tum_text(poses), "t.csv": good.csv_text(poses),
        "permuted.csv": good.csv_text(poses, names),
        "semicolons.csv": good.csv_text(poses, names, ";"), "tabs.csv": good.csv_text(poses, names, "\t"),
        "other columns.csv": good.csv_text(poses, more),
        "upper case.csv": good.csv_text(poses).replace("qw,qx,qy,qz,x,y,z", "QW,QX,QY,QZ,X,Y,Z"),
        "quoted.csv": good.csv_text(poses).replace("qw,qx", '"qw","qx"'),
        "blanks.csv": good.csv_text(poses, names, " "),
    }  # fmt: skip
    name = one_of(rng, list(options))
    data = options[name]
    check = lambda found: differs(found.wxyz_xyz, poses, 1e-6)  # noqa: E731
    zipped = name.endswith(".npz")
    return Reader(
        "trajectory", name, data if isinstance(data, bytes) else data.encode(), world.tdf.load_trajectory, check,
        zipped, zipped,
    )  # fmt: skip


def trajectory_content(rng, world: World, folder):
    """Trajectories with wrong numbers or a wrong order."""
    poses = good.poses().astype(float)
    spoilt = poses.copy()
    spoilt[int(rng.integers(4)), int(rng.integers(7))] = one_of(rng, [np.nan, np.inf])
    order = one_of(rng, [(0, 1, 2, 3, 4, 5, 6), (4, 5, 6, 0, 1, 2, 3)])
    odd = damage.no_numbers(rng, poses)
    while not isinstance(odd[1], np.ndarray) or odd[0] == "objects":
        odd = damage.no_numbers(rng, poses)
    options = {
        f"{odd[0]}.npz": good.npz_bytes(wxyz_xyz=odd[1]), "another name.npz": good.npz_bytes(poses=poses),
        "objects.npz": good.npz_bytes(wxyz_xyz=np.full(3, None, object)),
        "transposed.npz": good.npz_bytes(wxyz_xyz=poses[:3].T),
        "ROS order.npz": good.npz_bytes(wxyz_xyz=poses[:, [4, 5, 6, 1, 2, 3, 0]]),
        "not finite.npz": good.npz_bytes(wxyz_xyz=spoilt), "not finite.tum": good.tum_text(spoilt),
        "not finite.csv": good.csv_text(spoilt),
        "another order, named.tum": good.tum_text(poses, (4, 5, 6, 0, 1, 2, 3), head="# t x y z qw qx qy qz\n"),
        "quaternion first.tum": good.tum_text(poses, (0, 1, 2, 3, 4, 5, 6)),
        "seven columns.tum": good.tum_text(poses, order[:6]), "nine columns.tum": good.tum_text(poses, (*range(7), 0)),
        "words.tum": good.tum_text(poses).replace("0 ", "zero ", 1), "commas.tum": good.tum_text(poses, separator=","),
        "no rows.tum": "# nothing\n", "no rows.csv": ",".join(good.COLUMNS) + "\n",
        "no names.csv": good.csv_text(poses).partition("\n")[2],
        "a column missing.csv": good.csv_text(poses, [n for n in good.COLUMNS if n != one_of(rng,
        list(good.COLUMNS))][:6]),
        "a column twice.csv": good.csv_text(poses, [*good.COLUMNS, "qw"]),
        "norm of 3.csv": good.csv_text(poses * [3, 3, 3, 3, 1, 1, 1]),
        "decimal commas.csv": good.csv_text(poses, separator=";").replace(".", ","),
        "a short row.csv": good.csv_text(poses) + "1,2\n",
        "metres times 1e6.csv": good.csv_text(poses * [1, 1, 1, 1, 1e6, 1e6, 1e6]),
        "zeros.csv": good.csv_text(poses * 0), "no numbers.csv": good.csv_text(poses).replace("0.", "a.", 1),
    }  # fmt: skip
    name = one_of(rng, list(options))
    data = options[name]
    path = folder / name
    path.write_bytes(data if isinstance(data, bytes) else data.encode())
    # A file with decimal commas may be read, if it is read right.
    check = (lambda found: differs(found.wxyz_xyz, poses)) if name.startswith("decimal") else (lambda found: None)
    expected = ANY if name.startswith("decimal") else ONLY_REFUSED
    return Case("trajectory content", name, lambda: world.tdf.load_trajectory(path), check, expected)


# Networks


def weights_reader(rng, world: World) -> Reader:
    """Weights; all damage is seen by their checksum."""
    import jax

    def check(found):
        pairs = zip(jax.tree.leaves(found.params), jax.tree.leaves(world.model.params), strict=True)
        return next((problem for a, b in pairs if (problem := differs(a, b, 0.0))), None) or (
            None if (found.config, found.info) == (world.model.config, world.model.info) else "another config or info"
        )

    return Reader("weights", "w.safetensors", world.weights, world.tdf.load_model, check, True, True)


def weights_content(rng, world: World, folder):
    """Weights whose header or tensors are changed; the checksum of some is right again, so that only reason sees it."""
    import safetensors.numpy

    from tdf_jax.networks import checkpoint

    path = folder / "w.safetensors"
    tensors = safetensors.numpy.load(world.weights)
    size = int.from_bytes(world.weights[:8], "little")
    header = json.loads(json.loads(world.weights[8 : 8 + size])["__metadata__"]["tdf_jax"])
    name = one_of(rng, sorted(tensors))
    x = tensors[name]
    spoilt = x.copy()
    spoilt.flat[0] = one_of(rng, [np.nan, np.inf])
    config = header["config"]
    field = one_of(rng, sorted(config))
    wrong = one_of(rng, [-1, 0, 10**12, "6", None, [1], 1e400, True, {}])
    what = one_of(
        rng, ["not finite", "half", "double", "one missing", "one more", "another shape", "config", "info", "schema",
        "bare", "not JSON"]
    )  # fmt: skip
    match what:
        case "not finite":
            tensors[name] = spoilt
        case "half":
            tensors[name] = x.astype(np.float16)
        case "double":
            tensors[name] = x.astype(np.float64)
        case "one missing":
            del tensors[name]
        case "one more":
            tensors["stranger"] = np.zeros(3, np.float32)
        case "another shape":
            tensors[name] = np.ascontiguousarray(np.concatenate([x, x]))
        case "config":
            config[field] = wrong
        case "info":
            field = one_of(rng, ["cloud_points", "smallest_diagonal", "name"])
            wrong = one_of(rng, [-1, "many", [1], {}, True])
            header["info"][field] = wrong
            if field == "name" and wrong == "many":
                header["info"]["name"] = 3
        case "schema":
            header["schema"] = one_of(rng, [0, 99, -1, "3", None, 2.5])
    if what != "bare" and rng.random() < 0.7:
        header["sha256"] = checkpoint._checksum(header, tensors)
    text = {"bare": None, "not JSON": {"tdf_jax": "{" * 3000}}.get(what, {"tdf_jax": json.dumps(header)})
    path.write_bytes(safetensors.numpy.save(tensors, text))
    # An offset is a number with a right value, and so is a slope; other values of theirs are another network.
    told = f"{what} {name if 'onfig' not in what else field} {wrong if what in ('config', 'info') else ''}"
    return Case(
        "weights content",
        told,
        lambda: world.tdf.load_model(path),
        not_finite,
        ANY if what in ("config", "info") else ONLY_REFUSED,
    )


def checkpoint_reader(rng, world: World) -> Reader:
    """A PyTorch checkpoint; all damage is seen by the checksums of the archive, if it concerns what is read."""
    import jax

    expected = world.__dict__.setdefault("_converted", None)
    if expected is None:
        path = world.folder / "whole.pth"
        path.write_bytes(world.checkpoint)
        expected = world.__dict__["_converted"] = world.tdf.convert_checkpoint(path)

    def check(found):
        pairs = zip(jax.tree.leaves(found.params), jax.tree.leaves(expected.params), strict=True)
        return next((problem for a, b in pairs if (problem := differs(a, b, 0.0))), None)

    return Reader("checkpoint", "c.pth", world.checkpoint, world.tdf.convert_checkpoint, check, True, True)


def checkpoint_content(rng, world: World, folder):
    """PyTorch checkpoints with other members: programs, strangers, legacy pickles, another byte order."""
    path = folder / "c.pth"
    source = zipfile.ZipFile(io.BytesIO(world.checkpoint))
    members = {name: source.read(name) for name in source.namelist()}
    pickled = next(name for name in members if name.endswith("data.pkl"))
    root = pickled.removesuffix("data.pkl")
    storage = one_of(rng, [name for name in members if "/data/" in name])

    class Evil:
        def __reduce__(self):
            return (open, (str(folder / "pwned"), "w"))

    what = one_of(
        rng, ["a program", "a dictionary", "a list", "no storage", "short storage", "long storage", "byte order",
        "unknown byte order",
              "two pickles", "no pickle", "legacy", "deep pickle", "not finite", "empty archive", "another archive"]
    )  # fmt: skip
    expected = ONLY_REFUSED
    match what:
        case "a program":
            members[pickled] = pickle.dumps({"a": Evil()}, 2)
        case "a dictionary":
            members[pickled] = pickle.dumps({"state_dict": {"epoch": 3}}, 2)
        case "a list":
            members[pickled] = pickle.dumps([1, [2, {}]], int(rng.integers(0, 6)))
        case "no storage":
            del members[storage]
        case "short storage":
            members[storage] = members[storage][: -int(rng.integers(1, 9))]
        case "long storage":
            members[storage] += bytes(int(rng.integers(1, 9)))
            expected = ANY
        case "byte order":
            # Swapped bytes of good weights are huge or tiny numbers: mostly seen, and no claim is made about the rest.
            members[root + "byteorder"] = b"big"
            expected = ANY
        case "unknown byte order":
            members[root + "byteorder"] = b"middle"
        case "two pickles":
            members["other/data.pkl"] = members[pickled]
        case "no pickle":
            del members[pickled]
        case "deep pickle":
            members[pickled] = b"\x80\x02" + b"]" * 200000 + b"a" * 199999 + b"."
        case "not finite":
            members[storage] = np.full(len(members[storage]) // 4, np.nan, "<f4").tobytes()
        case "empty archive":
            members = {}
        case "another archive":
            members = {"word/document.xml": b"<xml/>"}
    if what == "legacy":
        path.write_bytes(pickle.dumps(0x1950A86A20F9469CFC6C, 2) + pickle.dumps(1001, 2) + pickle.dumps({}, 2))
    else:
        with zipfile.ZipFile(path, "w", one_of(rng, [zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED])) as archive:
            for name, data in members.items():
                archive.writestr(name, data)
    return Case("checkpoint content", what, lambda: world.tdf.convert_checkpoint(path), not_finite, expected)


# Landscapes, data sets, run folders, folders of meshes


def landscape_reader(rng, world: World) -> Reader:
    """A landscape; all damage is seen by the checksums of the archive."""

    def check(found):
        landscape, about = found
        for name in ("values", "waypoints", "rotations", "turned", "combined"):
            problem = differs(getattr(landscape, name), getattr(world.landscape, name))
            if problem:
                return f"{name} {problem}"
        return differs(landscape.grid.points, world.landscape.grid.points) or (
            None if about == {"who": "a test"} else "about"
        )

    data = good.npz_bytes(**world.landscape_arrays)
    return Reader("landscape", "l.npz", data, world.tdf.load_landscape, check, True, True)


def landscape_content(rng, world: World, folder):
    """Landscapes with wrong arrays."""
    arrays = dict(world.landscape_arrays)
    header = json.loads(str(arrays["header"]))
    name = one_of(rng, [name for name in sorted(arrays) if name not in {"header", "turned"}])
    odd = damage.no_numbers(rng, arrays[name])
    while not isinstance(odd[1], np.ndarray) or odd[0] in {"objects", "no rows"}:
        odd = damage.no_numbers(rng, arrays[name])
    field = one_of(rng, sorted(header))
    options = {
        f"{name}: {odd[0]}": {name: odd[1]}, f"no {name}": {name: None},
        "values transposed": {"values": np.moveaxis(arrays["values"], 0, -1)},
        "waypoints missing": {"waypoints": arrays["waypoints"][:2]},
        "turned beyond": {"turned": arrays["turned"] + 7}, "turned negative": {"turned": arrays["turned"] - 9},
        "turned in floats": {"turned": arrays["turned"] + 0.5},
        "header in words": {"header": np.array("hello")}, "header of a list": {"header": np.array("[]")},
        "header of nothing": {"header": np.array("{}")}, "no header": {"header": None},
        f"header without {field}": {"header": np.array(json.dumps({k: v for k, v in header.items() if k != field}))},
        "another format": {"header": np.array(json.dumps(header | {"format": one_of(rng, [0, 99, "1", None])}))},
        "another reduction": {"header": np.array(json.dumps(header | {"reduce": one_of(rng, ["best", 3, None, []])}))},
        "temperature": {"header": np.array(json.dumps(header | {"temperature": one_of(rng, [0, -1, "a", None])}))},
        "a mask of another shape": {"mask": np.ones((2, 2), bool)}, "a mask of floats": {"mask": np.full((5, 5), 0.5)},
        "rotations that are none": {"rotations": 2 * arrays["rotations"]},
        "another frame": {"header": np.array(json.dumps(header | {"frame": "object"}))},
        "another unit": {"header": np.array(json.dumps(header | {"unit": "millimetre"}))},
    }  # fmt: skip
    what = one_of(rng, list(options))
    path = folder / "l.npz"
    np.savez(path, **{n: a for n, a in (arrays | options[what]).items() if a is not None})
    harmless = what in {
        "header without temperature",
        "header without frame",
        "header without unit",
        "header without about",
    }
    return Case(
        "landscape content", what, lambda: world.tdf.load_landscape(path), expected=ANY if harmless else ONLY_REFUSED
    )


def folder_case(rng, world: World, folder):
    """Folders of data sets and of meshes with one file damaged, missing, or replaced."""
    from tdf_jax.evaluation.annotated_meshes import load_annotated
    from tdf_jax.training.dataset import load

    is_data = rng.random() < 0.6
    files = dict(world.data_set if is_data else world.mesh_folder)
    read, place = (load, folder / "data") if is_data else (load_annotated, folder / "meshes")
    kind = "data set" if is_data else "mesh folder"
    name = one_of(rng, sorted(files))
    expected = ANY
    check: Callable = lambda result: None  # noqa: E731
    what = one_of(
        rng, ["bytes", "bytes", "bytes", "missing", "folder", "link", "dangling", "settings", "nothing", "extra"]
    )
    if what == "bytes":
        harm = one_of(rng, damage.BYTES)
        text, files[name] = harm(rng, files[name])
        if files[name] and harm in {damage.empty, damage.noise} or harm is damage.empty:
            expected = ONLY_REFUSED
        if name.endswith(".npz"):
            if harm is damage.truncated:
                expected = ONLY_REFUSED
            digest = [part.digest() for part in load_whole(world)]
            check = lambda result: None if [part.digest() for part in result] == digest else "another data set"  # noqa: E731
    elif what == "settings":
        text, name = _wrong_settings(rng, files, is_data)
        expected = ONLY_REFUSED
    else:
        text = what
    place.mkdir()
    for each, data in files.items():
        (place / each).write_bytes(data)
    target = place / name
    if what in {"missing", "folder", "link", "dangling"}:
        target.rename(folder / "away")
        expected = ONLY_REFUSED
    if what == "folder":
        target.mkdir()
    if what == "link":
        target.symlink_to(folder / "away")
        expected = ONLY_RIGHT
    if what == "dangling":
        target.symlink_to("nothing")
    if what == "nothing":
        place, expected = one_of(rng, [(folder / "none", ONLY_REFUSED), (target, ONLY_REFUSED), (folder, ONLY_REFUSED)])
    if what == "extra":
        (place / "notes.txt").write_text("mine")
        (place / ".DS_Store").write_bytes(b"\0")
        expected = ONLY_RIGHT
    return Case(kind, f"{name}: {text}", lambda: read(place), check, expected)


def load_whole(world: World):
    """The undamaged data set."""
    from tdf_jax.training.dataset import load

    if "_loaded" not in world.__dict__:
        world.data_set  # noqa: B018
        world.__dict__["_loaded"] = load(world.folder / "data")
    return world.__dict__["_loaded"]


def _wrong_settings(rng, files, is_data):
    if is_data:
        manifest = json.loads(files["dataset.json"])
        value = one_of(rng, [-1, 10**9, "many", None, [], {}, 1.5])
        field = one_of(rng, ["objects", "validation", "queries", "points"])
        manifest["recipe"][field] = value
        if rng.random() < 0.2:
            manifest = one_of(rng, [[], {}, 3, None, {"recipe": None}, {"recipe": {"stranger": 1}}])
            field, value = "manifest", manifest
        files["dataset.json"] = json.dumps(manifest).encode()
        return f"{field} is {value!r}", "dataset.json"
    entry = good.SIDECAR_ENTRY
    wrong = one_of(
        rng, [{"unit": 0}, {"unit": -1}, {"unit": "m"}, {"unit": None}, {"unit": 1000}, {"up": "z"}, {"up": 3},
        {"symmetry": "square"},
              {"symmetry": 2}, {"category": "vase"}, {"category": None}, {"places": 3}, {"places": {"rim": [[1]]}},
              {"unit": float("nan")},
              {"places": {"top": np.eye(4).tolist()}}, {"stranger": 1}, {"unit": True}, {"up": ["+z"]},
              {"category": []}]
    )  # fmt: skip
    entries: Any = {"bottle.obj": entry | wrong}
    if rng.random() < 0.3:
        wrong = one_of(
            rng,
            [
                [],
                3,
                None,
                {},
                {"none.obj": entry},
                {"../away/bottle.obj": entry},
                {"bottle.obj": 3},
                {"bottle.obj": None},
                {"": entry},
            ],
        )
        entries = wrong
    files["meshes.json"] = json.dumps(entries).encode()
    return f"{wrong!r}", "meshes.json"


def run_folder_case(rng, world: World, folder):
    """Settings, metrics and checkpoint of a training run; a checkpoint has no checksum: its numbers are not judged."""
    from tdf_jax.training import run_folder

    params = {"a": np.arange(6, dtype=np.float32).reshape(2, 3), "b": np.ones(4, np.float32)}
    state = {"m": np.zeros(3, np.float32)}
    what = one_of(rng, ["settings", "metrics", "state"])
    settings = {"steps": 3, "seed": 0, "network": {"latent": 4}}
    rows = [{"step": i, "loss": 0.5} for i in range(5)]
    run_folder.claim(folder, settings)
    for row in rows:
        run_folder.add_metrics(folder, row)
    run_folder.save(folder, params, state, 3)
    name = {"settings": run_folder.CONFIG, "metrics": run_folder.METRICS, "state": run_folder.STATE}[what]
    harm = one_of(rng, damage.BYTES)
    text, data = harm(rng, (folder / name).read_bytes())
    (folder / name).write_bytes(data)
    if what == "settings":
        return Case("run folder", f"{name}: {text}", lambda: run_folder.settings_of(folder))
    if what == "state":
        return Case("run folder", f"{name}: {text}", lambda: run_folder.restore(folder, params, state))
    return Case(
        "run folder", f"{name}: {text}", lambda: run_folder.drop_later_metrics(folder, 3), writes=(run_folder.METRICS,)
    )


# Any reader with damage to bytes or to the path


READERS = (
    mesh_reader, cloud_reader, demonstration_reader, trajectory_reader, weights_reader, checkpoint_reader,
    landscape_reader
)  # fmt: skip
TEXTS = (".obj", ".off", ".xyz", ".txt", ".asc", ".pts", ".csv", ".tum", ".gltf")


def valid_case(rng, world: World, folder, make):
    """A valid variant at a path of some kind."""
    reader = make(rng, world)
    text, path, readable = one_of(rng, damage.PATHS)(rng, folder, reader.name, reader.data)
    # A name with an unusual case may be refused, but not misread.
    expected = ONLY_RIGHT if readable else ONLY_REFUSED if readable is False else ANY
    return Case(reader.kind, f"{reader.name}: {text}", lambda: reader.read(path), reader.check, expected)


def damaged_case(rng, world: World, folder, make):
    """A valid variant with damage to its bytes."""
    reader = make(rng, world)
    harm = one_of(rng, damage.BYTES)
    text, data = harm(rng, reader.data)
    path = folder / reader.name
    path.write_bytes(data)
    expected, check = ANY, _judge_numbers
    if reader.checked:
        check = reader.check  # the same, or refused
    if harm in {damage.empty, damage.foreign, damage.noise} or (harm is damage.truncated and reader.counted):
        expected = ONLY_REFUSED
    # Random bytes may be a text of numbers, and cut text a shorter list. Where nothing counts or checks the numbers,
    # changed ones cannot be seen, and only what a result must always be is judged.
    return Case(f"{reader.kind} bytes", f"{reader.name}: {text}", lambda: reader.read(path), check, expected)


def _judge_numbers(result):
    return not_finite(result)


def renamed_case(rng, world: World, folder, make):
    """The content of one format under the suffix of another."""
    reader = make(rng, world)
    suffixes = {
        "mesh": (".obj", ".stl", ".ply", ".glb", ".off", ".xyz", ".pcd", ".npy", ".npz", ".fbx", ".step", ".zip", ""),
        "cloud": (".obj", ".stl", ".ply", ".glb", ".off", ".pcd", ".npy", ".npz", ".las", ".e57", ".bag", ""),
        "demonstration": (".npy", ".npz.bak", ".zip", ".json", ""),
        "trajectory": (".npz", ".tum", ".csv", ".txt", ".bag", ""),
        "weights": (".pth", ".npz", ".bin", ".onnx", ""),
        "checkpoint": (".pt", ".safetensors", ""),
        "landscape": (".npy", ".json", ""),
    }[reader.kind]
    before = "." + reader.name.rpartition(".")[2]
    suffix = one_of(rng, [other for other in suffixes if other != before])
    path = folder / (reader.name.removesuffix(before) + suffix)
    path.write_bytes(reader.data)
    # The suffix of networks does not matter, and the two of glTF may be told apart by their content.
    free = reader.kind in {"checkpoint", "weights"} or {before, suffix} == {".glb", ".gltf"}
    expected = ANY if free else ONLY_REFUSED
    return Case(
        f"{reader.kind} suffix", f"{reader.name} as {suffix!r}", lambda: reader.read(path), reader.check, expected
    )


def saved_case(rng, world: World, folder):
    """Writers whose target cannot be written, or whose disk is full; what was there before stays."""
    tdf = world.tdf
    writers = {
        "demo.npz": lambda path: tdf.save_demonstration(path, world.demonstration),
        "t.npz": lambda path: tdf.save_trajectory(path, tdf.Trajectory(good.poses())),
        "t.tum": lambda path: tdf.save_trajectory(path, tdf.Trajectory(good.poses())),
        "w.safetensors": lambda path: tdf.save_model(world.model, path),
        "l.npz": lambda path: tdf.save_landscape(path, world.landscape),
    }
    world.demonstration, world.model, world.landscape  # noqa: B018
    name = one_of(rng, list(writers))
    write = writers[name]
    if rng.random() < 0.4:
        text, path = damage.bad_target(rng, folder, name)
        return Case("writing", f"{name}: {text}", lambda: write(path), expected=ONLY_REFUSED)
    if rng.random() < 0.5:
        path = folder / name
        if rng.random() < 0.5:
            path.write_bytes(b"before")
        size = int(rng.integers(0, 150))

        def act():
            with damage.full_disk(size):
                write(path)

        return Case("writing", f"{name}: room for {size} bytes", act, expected=ONLY_REFUSED)
    # Not over a pipe, which is written to and waits for a reader, as with every program.
    places = [place for place in damage.PATHS if place is not damage.fifo]
    text, path, readable = one_of(rng, places)(rng, folder, name, b"before")
    fine = text not in {
        "a folder",
        "a path through a file",
        "a name of 400 characters",
        "a name with a zero byte",
    } and not text.startswith("the path")
    names = tuple(
        str(p.relative_to(folder)) for p in [folder / "real", folder / "middle", folder / "other", folder / "nothing"]
    )
    if fine:
        from pathlib import Path

        names += (str(Path(path).resolve().relative_to(folder.resolve())) if text != "a link to itself" else name,)
        names += (str(Path(path).relative_to(folder)),)
    return Case("writing", f"{name} over {text}", lambda: write(path), expected=ANY, writes=names)


def file_case(rng, world: World, folder) -> Case:
    """A case of files."""
    draw = rng.random()
    make = one_of(rng, READERS)
    if make in {checkpoint_reader, weights_reader} and rng.random() < 0.3:  # more of what has most formats
        make = one_of(rng, (mesh_reader, cloud_reader))
    if draw < 0.15:
        return valid_case(rng, world, folder, make)
    if draw < 0.25:  # as it is
        reader = one_of(rng, (mesh_reader, cloud_reader, trajectory_reader, demonstration_reader))(rng, world)
        path = folder / reader.name
        path.write_bytes(reader.data)
        return Case(reader.kind, reader.name, lambda: reader.read(path), reader.check, ONLY_RIGHT)
    if draw < 0.5:
        return damaged_case(rng, world, folder, make)
    if draw < 0.56:
        return renamed_case(rng, world, folder, make)
    content = (
        mesh_content, cloud_content, cloud_content, cloud_numbers, demonstration_content, trajectory_content,
        weights_content,
        checkpoint_content, landscape_content, folder_case, folder_case, run_folder_case, saved_case, saved_case,
    )  # fmt: skip
    return one_of(rng, content)(rng, world, folder)
