"""The files and objects that are damaged, and what they mean. The writers share no code with the library's readers."""

import base64
import dataclasses
import io
import json
import struct
from functools import cached_property
from pathlib import Path

import numpy as np

FIXTURES = Path(__file__).parents[1] / "fixtures"
POINTS, POSES, QUERIES = 40, 4, 8
SIDECAR_ENTRY = {
    "category": "bottle", "unit": 1, "up": "+z", "symmetry": "round",
    "places": {name: np.eye(4).tolist() for name in ("neck", "body", "base")},
}  # fmt: skip
TINY_NETWORK = dict(latent=4, vector_hidden=6, vector_width=12, decoder_width=8, blocks=2)


def cloud(seed=0, count=POINTS):
    """A lopsided cloud of a mug's size, metres, with four decimals, so that text holds the same numbers."""
    rng = np.random.default_rng(seed)
    points = rng.normal(size=(count, 3)) * (0.05, 0.03, 0.02) + rng.gamma(1.0, 0.03, size=(count, 3)) + (0.3, -0.2, 0.1)
    return np.round(points, 4).astype(np.float32)


def poses(seed=1, count=POSES):
    """Poses `wxyz_xyz` at the cloud and to the side of it, float32."""
    rng = np.random.default_rng(seed)
    wxyz = rng.normal(size=(count, 4))
    wxyz /= np.linalg.norm(wxyz, axis=1, keepdims=True)
    return np.concatenate([wxyz, (0.33, -0.17, 0.13) + 0.05 * rng.normal(size=(count, 3))], axis=1).astype(np.float32)


def query(seed=2):
    """Query points about the query frame's origin, metres, float32."""
    return np.random.default_rng(seed).uniform(-0.03, 0.03, (QUERIES, 3)).astype(np.float32)


def body():
    """Vertices and triangles of a closed lopsided ellipsoid, and its triangles joined to polygons: prism sides."""
    turns, heights = 2 * np.pi * np.arange(7) / 7, (-0.03, 0.01, 0.04)
    radii = 0.04 + 0.01 * np.cos(3 * turns) + 0.004 * np.sin(turns)
    rings = [np.column_stack([radii * np.cos(turns), radii * np.sin(turns), np.full(7, z)]) for z in heights]
    vertices = np.round(np.concatenate([*rings, [[0, 0, -0.035], [0, 0, 0.05]]]), 4) + (0.3, -0.2, 0.1)
    polygons = []
    for ring in (0, 7):
        for i in range(7):
            j = (i + 1) % 7
            polygons.append([ring + i, ring + j, ring + 7 + j, ring + 7 + i])
    polygons += [[21, (i + 1) % 7, i] for i in range(7)] + [[22, 14 + i, 14 + (i + 1) % 7] for i in range(7)]
    triangles = np.array([[p[0], p[k], p[k + 1]] for p in polygons for k in range(1, len(p) - 1)])
    return np.round(vertices, 4), triangles, polygons


VERTICES, TRIANGLES, POLYGONS = body()
CLOUD = cloud()


# Meshes


def obj_text(vertices=VERTICES, faces=TRIANGLES, *, vertex_end="", relative=False, corner="{}"):
    """Text of an .obj file."""
    lines = ["v {:.9g} {:.9g} {:.9g}{}".format(*v, vertex_end) for v in vertices]
    for face in faces:
        numbers = [i - len(vertices) if relative else i + 1 for i in face]
        lines.append("f " + " ".join(corner.format(i) for i in numbers))
    return "\n".join(lines) + "\n"


def off_text(vertices=VERTICES, faces=TRIANGLES, head="OFF\n"):
    """Text of an .off file."""
    lines = [f"{len(vertices)} {len(faces)} 0", *("{:.9g} {:.9g} {:.9g}".format(*v) for v in vertices)]
    return head + "\n".join([*lines, *(f"{len(f)} " + " ".join(map(str, f)) for f in faces)]) + "\n"


def stl_bytes(vertices=VERTICES, faces=TRIANGLES, header=b"binary"):
    """A binary .stl file."""
    out = [header.ljust(80, b"\0"), struct.pack("<I", len(faces))]
    for face in faces:
        out.append(struct.pack("<12fH", 0, 0, 0, *np.asarray(vertices)[list(face)].ravel(), 0))
    return b"".join(out)


def stl_text(vertices=VERTICES, faces=TRIANGLES):
    """An .stl file in ASCII."""
    lines = ["solid body"]
    for face in faces:
        corners = ["vertex {:.9g} {:.9g} {:.9g}".format(*vertices[i]) for i in face]
        lines += ["facet normal 0 0 0", "outer loop", *corners, "endloop", "endfacet"]
    return "\n".join([*lines, "endsolid body"]) + "\n"


def ply_bytes(form, points=VERTICES, faces=TRIANGLES, kind="float", axes="xyz", extra=0):
    """A .ply file: form is ascii, binary_little_endian or binary_big_endian; `axes` is the order of the columns."""
    head = ["ply", f"format {form} 1.0", f"element vertex {len(points)}"]
    head += [f"property {kind} {axis}" for axis in axes] + [f"property uchar c{i}" for i in range(extra)]
    if faces is not None:
        head += [f"element face {len(faces)}", "property list uchar int vertex_indices"]
    columns = [np.asarray(points, float)[:, "xyz".index(axis)] for axis in axes]
    if form == "ascii":
        rows = [" ".join(f"{x:.9g}" for x in row) + " 7" * extra for row in zip(*columns)]
        rows += [f"{len(f)} " + " ".join(map(str, f)) for f in ([] if faces is None else faces)]
        return ("\n".join([*head, "end_header", *rows]) + "\n").encode()
    order = "<" if "little" in form else ">"
    letter = "d" if kind == "double" else "f"
    out = [("\n".join([*head, "end_header"]) + "\n").encode()]
    out += [struct.pack(f"{order}3{letter}{extra}B", *row, *[7] * extra) for row in zip(*columns)]
    out += [struct.pack(f"{order}B{len(f)}i", len(f), *f) for f in ([] if faces is None else faces)]
    return b"".join(out)


def gltf_parts(vertices=VERTICES, faces=TRIANGLES, translation=None):
    """The JSON and the buffer of a glTF scene with one node."""
    corners = np.asarray(vertices, "<f4").tobytes()
    indices = np.asarray(faces, "<u2").tobytes()
    node = {"mesh": 0} | ({} if translation is None else {"translation": list(translation)})
    scene = {
        "asset": {"version": "2.0"}, "scene": 0, "scenes": [{"nodes": [0]}], "nodes": [node],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0}, "indices": 1}]}],
        "accessors": [
            {"bufferView": 0, "componentType": 5126, "count": len(vertices), "type": "VEC3",
             "min": np.min(vertices, axis=0).tolist(), "max": np.max(vertices, axis=0).tolist()},
            {"bufferView": 1, "componentType": 5123, "count": 3 * len(faces), "type": "SCALAR"},
        ],
        "bufferViews": [
            {"buffer": 0, "byteOffset": 0, "byteLength": len(corners)},
            {"buffer": 0, "byteOffset": len(corners), "byteLength": len(indices)},
        ],
        "buffers": [{"byteLength": len(corners) + len(indices)}],
    }  # fmt: skip
    return scene, corners + indices


def glb_bytes(scene, buffer):
    """A .glb file."""
    text = json.dumps(scene).encode()
    text += b" " * (-len(text) % 4)
    buffer += b"\0" * (-len(buffer) % 4)
    chunks = struct.pack("<II", len(text), 0x4E4F534A) + text + struct.pack("<II", len(buffer), 0x004E4942) + buffer
    return struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks


def gltf_text(scene, buffer):
    """A .gltf file with its buffer inside."""
    uri = "data:application/octet-stream;base64," + base64.b64encode(buffer).decode()
    return json.dumps(scene | {"buffers": [{"byteLength": len(buffer), "uri": uri}]}).encode()


# Clouds


def text_cloud(points=CLOUD, separator=" ", head="", end="\n", decimal=".", columns=()):
    """A cloud as text, with further columns behind the coordinates."""
    rows = []
    for number, row in enumerate(points):
        cells = [*(f"{x:.4f}" for x in row), *(column(number) for column in columns)]
        rows.append(separator.join(cell.replace(".", decimal) for cell in cells))
    return head + end.join(rows) + end


def pcd_bytes(data, points=CLOUD, fields="xyz", with_points=True):
    """A .pcd file: data is ascii, binary or binary_compressed; `fields` is the order of the columns."""
    columns = [np.asarray(points, "<f4")[:, "xyz".index(field)] for field in fields]
    lines = ["# .PCD v0.7", "VERSION 0.7", "FIELDS " + " ".join(fields), "SIZE 4 4 4", "TYPE F F F", "COUNT 1 1 1"]
    lines += [f"WIDTH {len(points)}", "HEIGHT 1", "VIEWPOINT 0 0 0 1 0 0 0"]
    lines += [f"POINTS {len(points)}"] * with_points + [f"DATA {data}"]
    head = ("\n".join(lines) + "\n").encode()
    if data == "ascii":
        return head + "".join("{:.9g} {:.9g} {:.9g}\n".format(*row) for row in zip(*columns)).encode()
    if data == "binary":
        return head + np.stack(columns, axis=1).tobytes()
    raw = b"".join(column.tobytes() for column in columns)
    pieces = [raw[i : i + 32] for i in range(0, len(raw), 32)]
    packed = b"".join(bytes([len(piece) - 1]) + piece for piece in pieces)  # LZF, literals only
    return head + struct.pack("<II", len(packed), len(raw)) + packed


def npy_bytes(array):
    """An .npy file."""
    stream = io.BytesIO()
    np.save(stream, array, allow_pickle=True)
    return stream.getvalue()


def npz_bytes(**arrays):
    """An .npz file."""
    stream = io.BytesIO()
    np.savez(stream, **arrays)
    return stream.getvalue()


# Trajectories and demonstrations


def tum_text(wxyz_xyz, order=(4, 5, 6, 1, 2, 3, 0), separator=" ", head=""):
    """A .tum file."""
    rows = [separator.join([str(i), *(f"{x:.9g}" for x in row[list(order)])]) for i, row in enumerate(wxyz_xyz)]
    return head + "\n".join(rows) + "\n"


COLUMNS = {"qw": 0, "qx": 1, "qy": 2, "qz": 3, "x": 4, "y": 5, "z": 6}


def csv_text(wxyz_xyz, names=tuple(COLUMNS), separator=","):
    """A .csv file with a column for each name; an unknown name has zeros."""
    rows = [separator.join(f"{row[COLUMNS[n]] if n in COLUMNS else 0:.9g}" for n in names) for row in wxyz_xyz]
    return "\n".join([separator.join(names), *rows]) + "\n"


def demonstration_arrays():
    """The arrays of a demonstration file, with a grasp and a release that are not the defaults."""
    return {
        "points": CLOUD, "wxyz_xyz": poses(), "query": query(),
        "grasp": np.int64(1), "release": np.int64(2), "schema": np.int64(2),
    }  # fmt: skip


class World:
    """Objects that the library makes of the undamaged files, made when they are first used."""

    def __init__(self, folder: Path):
        self.folder = folder
        folder.mkdir(parents=True, exist_ok=True)

    @cached_property
    def tdf(self):
        """The library."""
        import tdf_jax

        return tdf_jax

    @cached_property
    def model(self):
        """A random network of few channels, which knows the sizes of its objects."""
        from flax.traverse_util import unflatten_dict

        from tdf_jax.networks.occupancy import parameter_shapes

        config, rng = self.tdf.NetworkConfig(**TINY_NETWORK), np.random.default_rng(0)
        tensors = {
            name: (rng.normal(size=shape) / np.sqrt(shape[0])).astype(np.float32)
            for name, shape in parameter_shapes(config).items()
        }
        info = self.tdf.ModelInfo("small", "a test", smallest_diagonal=0.08, largest_diagonal=0.5)
        return self.tdf.Model(unflatten_dict(tensors, sep="."), config, info)

    @cached_property
    def weights(self):
        """Bytes of the network's file."""
        path = self.folder / "small.safetensors"
        self.tdf.save_model(self.model, path)
        return path.read_bytes()

    @cached_property
    def demonstration(self):
        """One demonstration."""
        return self.tdf.Demonstration(CLOUD, self.tdf.Trajectory(poses()), query())

    @cached_property
    def reference(self):
        """What the demonstration looks like to the network."""
        return self.tdf.describe(self.model, self.demonstration)

    @cached_property
    def field(self):
        """The field of another object."""
        return self.tdf.encode(self.model, cloud(3))

    @cached_property
    def landscape(self):
        """A landscape of numbers."""
        rng = np.random.default_rng(4)
        grid = self.tdf.plane_grid(0.1, 5, (0.3, -0.2, 0.1))
        values = rng.uniform(0.001, 0.01, (POSES, 5, 5)).astype(np.float32)
        turned = rng.integers(0, 2, (POSES, 5, 5))
        rotations = np.stack([np.eye(3), np.diag([1.0, -1, -1])])
        return self.tdf.Landscape(grid, values, poses()[:, 4:], rotations, turned)

    @cached_property
    def landscape_arrays(self):
        """The arrays of the landscape's file."""
        path = self.folder / "landscape.npz"
        self.tdf.save_landscape(path, self.landscape, {"who": "a test"})
        with np.load(path) as arrays:
            return dict(arrays)

    @cached_property
    def checkpoint(self):
        """Bytes of a PyTorch checkpoint."""
        return (FIXTURES / "ndf_latent32.pth").read_bytes()

    @cached_property
    def data_set(self):
        """Files of a small data set by name."""
        from tdf_jax.training.dataset import Recipe, build

        folder = self.folder / "data"
        if not (folder / "validation-0000.npz").exists():
            build(Recipe(objects=2, validation=2, points=100, queries=100, cameras=4), folder, progress=False)
        return {path.name: path.read_bytes() for path in folder.iterdir()}

    @cached_property
    def mesh_folder(self):
        """Files of a folder of meshes with their sidecar."""
        import trimesh

        bottle = trimesh.creation.cylinder(0.03, 0.2, sections=24)
        text = obj_text(np.round(bottle.vertices, 6), bottle.faces).encode()
        return {"bottle.obj": text, "meshes.json": json.dumps({"bottle.obj": SIDECAR_ENTRY}).encode()}


def leaves(value):
    """All arrays and numbers of a result."""
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        value = [getattr(value, field.name) for field in dataclasses.fields(value)]
    if isinstance(value, dict):
        value = list(value.values())
    if hasattr(value, "triangles") and hasattr(value, "vertices"):  # a mesh
        value = [np.asarray(value.triangles)]
    if isinstance(value, list) and value and all(isinstance(row, list) for row in value):  # an array as it was given
        value = np.asarray(value)
    if isinstance(value, list | tuple):
        return [leaf for item in value for leaf in leaves(item)]
    if value is None or isinstance(value, str | bool) or callable(value):
        return []
    array = np.asarray(value)
    return [array] if array.dtype.kind in "fiuc" else []
