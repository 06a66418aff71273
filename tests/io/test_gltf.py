"""glTF files as exporters write them: boxes 1 x 2 x 3 whose vertices are known, and known poses."""

import base64
import copy
import json

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from tdf_jax._internal.errors import InputError
from tdf_jax.io.meshes import load_mesh
from tdf_jax.io.pointclouds import load_points

BOX = trimesh.creation.box((1, 2, 3))
VERTICES, FACES = np.asarray(BOX.vertices), np.asarray(BOX.faces)
BYTE, UBYTE, SHORT, USHORT, UINT, FLOAT = 5120, 5121, 5122, 5123, 5125, 5126
TYPES = {BYTE: "<i1", UBYTE: "<u1", SHORT: "<i2", USHORT: "<u2", UINT: "<u4", FLOAT: "<f4"}
IDENTITY = np.eye(4)
KINDS = {1: "SCALAR", 2: "VEC2", 3: "VEC3", 4: "VEC4"}


class Builder:
    """A document and its buffer, to which arrays are added."""

    def __init__(self):
        self.document = {
            "asset": {"version": "2.0"},
            "scene": 0,
            "scenes": [{"nodes": [0]}],
            "nodes": [{"mesh": 0}],
            "meshes": [],
            "accessors": [],
            "bufferViews": [],
            "buffers": [{"byteLength": 0}],
        }
        self.data = b""

    def view(self, data, **extra):
        self.data = self.data.ljust(-len(self.data) % 4 + len(self.data), b"\0")
        self.document["bufferViews"].append(
            {"buffer": 0, "byteOffset": len(self.data), "byteLength": len(data), **extra}
        )
        self.data += data
        return len(self.document["bufferViews"]) - 1

    def accessor(self, rows, component=FLOAT, **extra):
        rows = np.asarray(rows).reshape(len(rows), -1)
        entry = {"componentType": component, "count": len(rows), "type": KINDS[rows.shape[1]], **extra}
        if "bufferView" not in entry:
            entry["bufferView"] = self.view(rows.astype(TYPES[component]).tobytes())
        self.document["accessors"].append(entry)
        return len(self.document["accessors"]) - 1

    def mesh(self, *primitives, **extra):
        self.document["meshes"].append({"primitives": list(primitives), **extra})
        return self

    def glb(self, data=None):
        document = copy.deepcopy(self.document)
        document["buffers"][0]["byteLength"] = len(self.data)
        text = json.dumps(document).encode()
        text, data = text.ljust(-len(text) % 4 + len(text)), self.data if data is None else data
        data = data.ljust(-len(data) % 4 + len(data), b"\0")
        chunks = len(text).to_bytes(4, "little") + b"JSON" + text + len(data).to_bytes(4, "little") + b"BIN\0" + data
        return b"glTF" + (2).to_bytes(4, "little") + (12 + len(chunks)).to_bytes(4, "little") + chunks


def box(component=FLOAT, index=USHORT, faces=FACES, vertices=VERTICES):
    """A builder with one mesh, a box, and its primitive."""
    builder = Builder()
    primitive = {
        "attributes": {"POSITION": builder.accessor(vertices, component)},
        "indices": builder.accessor(faces.reshape(-1, 1), index),
    }
    return builder.mesh(primitive), primitive


def save(path, builder):
    path.write_bytes(builder.glb())
    return path


def check(mesh, T=IDENTITY, scale=1.0):
    """Check that a mesh is the box at a pose."""
    assert mesh.is_watertight
    assert mesh.volume == pytest.approx(6 * scale**3, rel=1e-4) and mesh.area == pytest.approx(22 * scale**2, rel=1e-4)
    expected = VERTICES * scale @ T[:3, :3].T + T[:3, 3]
    distances = np.linalg.norm(np.asarray(mesh.vertices)[:, None] - expected, axis=-1)
    assert distances.min(axis=0).max() < 1e-4 * scale


def plain():
    return box()[0]


def without_indices():
    builder = Builder()
    return builder.mesh({"attributes": {"POSITION": builder.accessor(VERTICES[FACES].reshape(-1, 3))}})


def interleaved():
    builder = Builder()
    rows = np.hstack([BOX.vertex_normals, VERTICES, np.zeros((8, 2))]).astype("<f4")
    view = builder.view(rows.tobytes(), byteStride=32)
    normal = builder.accessor(VERTICES, bufferView=view)
    position = builder.accessor(VERTICES, bufferView=view, byteOffset=12)
    index = builder.accessor(FACES.reshape(-1, 1), UBYTE)
    return builder.mesh({"attributes": {"POSITION": position, "NORMAL": normal}, "indices": index})


def sparse(base=True):
    """Three rows are changed; without a base all others are zero."""
    wrong = VERTICES.copy()
    wrong[[1, 4, 6]] = 99
    builder, primitive = box(vertices=wrong if base else np.zeros((8, 3)))
    rows = [1, 4, 6] if base else list(range(8))
    indices, values = (
        builder.view(np.array(rows, "<u1").tobytes()),
        builder.view(VERTICES[rows].astype("<f4").tobytes()),
    )
    entry = builder.document["accessors"][primitive["attributes"]["POSITION"]]
    entry["sparse"] = {
        "count": len(rows),
        "indices": {"bufferView": indices, "componentType": UBYTE},
        "values": {"bufferView": values},
    }
    if not base:
        del entry["bufferView"]
    return builder


def sparse_alone():
    return sparse(base=False)


def several_primitives():
    builder = Builder()
    position = builder.accessor(VERTICES)
    parts = [{"attributes": {"POSITION": position}, "indices": builder.accessor(f.reshape(-1, 1), UINT)} for f in FACES]
    lines = {"attributes": {"POSITION": position}, "mode": 1}
    return builder.mesh(*parts, lines, {**lines, "mode": 0}, {"attributes": {}})


def fans():
    """Each side a fan; the box's faces in pairs."""
    builder = Builder()
    position = builder.accessor(VERTICES)
    parts = []
    for axis in range(3):
        for side in (-1, 1):
            corners = np.flatnonzero(np.sign(VERTICES[:, axis]) == side)
            around = np.arctan2(*(VERTICES[corners][:, [(axis + 2) % 3, (axis + 1) % 3]].T))
            order = corners[np.argsort(around)][::side]
            parts.append(
                {
                    "attributes": {"POSITION": position},
                    "indices": builder.accessor(order.reshape(-1, 1), USHORT),
                    "mode": 6,
                }
            )
    return builder.mesh(*parts)


def strip():
    builder = Builder()
    corners = [[x - 0.5, 2 * y - 1, 3 * z - 1.5] for z in (0, 1) for y in (0, 1) for x in (0, 1)]
    order = np.array([[i] for i in (0, 2, 1, 3, 7, 2, 6, 0, 4, 1, 5, 7, 4, 6)])
    position, index = builder.accessor(corners), builder.accessor(order, USHORT)
    return builder.mesh({"attributes": {"POSITION": position}, "indices": index, "mode": 5})


def morphed():
    """The default weight of a target moves the vertices into place."""
    builder, primitive = box(vertices=VERTICES - 4)
    primitive["targets"] = [
        {"POSITION": builder.accessor(np.full((8, 3), 9.0))},
        {"POSITION": builder.accessor(np.full((8, 3), 8.0))},
    ]
    builder.document["meshes"][0]["weights"] = [0.0, 0.5]
    return builder


def morphed_by_its_node():
    builder = morphed()
    builder.document["meshes"][0]["weights"] = [1.0, 1.0]
    builder.document["nodes"][0]["weights"] = [0, 0.5]
    return builder


def no_scene():
    builder = plain()
    del builder.document["scenes"], builder.document["scene"]
    return builder


def no_nodes():
    builder = no_scene()
    del builder.document["nodes"]
    return builder


def second_scene():
    """Only what the default scene shows is there."""
    builder = plain()
    builder.document["scenes"] = [{"nodes": [1]}, {"nodes": [0]}]
    builder.document["scene"] = 1
    builder.document["nodes"].append({"mesh": 0, "scale": [50, 50, 50]})
    return builder


def hidden_node():
    builder = plain()
    hidden = {"children": [2], "extensions": {"KHR_node_visibility": {"visible": False}}}
    builder.document["nodes"] += [hidden, {"mesh": 0, "scale": [50, 50, 50]}]
    builder.document["scenes"][0]["nodes"].append(1)
    builder.document["extensionsRequired"] = ["KHR_node_visibility"]
    return builder


def materials_and_lights():
    builder, primitive = box()
    primitive["material"] = 0
    primitive["extensions"] = {"KHR_materials_variants": {"mappings": []}}
    builder.document["nodes"][0]["extensions"] = {"KHR_lights_punctual": {"light": 0}, "MOZ_hubs_components": {}}
    builder.document["scenes"][0]["extensions"] = {"KHR_xmp_json_ld": {"packet": 0}, "KHR_audio_emitter": {}}
    builder.document["extensions"] = {
        "KHR_lights_punctual": {"lights": []},
        "KHR_materials_variants": {},
        "VRMC_vrm": {},
    }
    builder.document["materials"] = [{"extensions": {"KHR_materials_unlit": {}}}]
    builder.document["extensionsRequired"] = ["KHR_materials_unlit", "KHR_texture_transform"]
    builder.document["extensionsUsed"] = [*builder.document["extensionsRequired"], "KHR_draco_mesh_compression"]
    return builder


def draco_with_a_fallback():
    builder, primitive = box()
    primitive["extensions"] = {"KHR_draco_mesh_compression": {"bufferView": 0, "attributes": {"POSITION": 0}}}
    return builder


SAME = [
    *(plain, without_indices, interleaved, sparse, sparse_alone, several_primitives, fans, strip, morphed),
    *(morphed_by_its_node, no_scene, no_nodes, second_scene, hidden_node, materials_and_lights, draco_with_a_fallback),
]


@pytest.mark.parametrize("build", SAME, ids=lambda build: build.__name__)
def test_a_box_is_read_in_every_layout(tmp_path, build):
    check(load_mesh(save(tmp_path / "box.glb", build())))


@pytest.mark.parametrize("component", [BYTE, UBYTE, SHORT, USHORT])
@pytest.mark.parametrize("normalized", [False, True])
def test_whole_numbers_are_positions_as_they_are_or_normalised(tmp_path, component, normalized):
    """As KHR_mesh_quantization writes them, with the node's scale and translation that undo it."""
    limits = np.iinfo(TYPES[component])
    low = -limits.max if limits.min < 0 else 0
    unit = (VERTICES - VERTICES.min(axis=0)) / np.ptp(VERTICES, axis=0)
    builder, primitive = box()
    numbers = np.rint(low + unit * (limits.max - low))
    entry = builder.accessor(numbers, component, **({"normalized": True} if normalized else {}))
    primitive["attributes"]["POSITION"] = entry
    size, start = ((limits.max - low) / limits.max, low / limits.max) if normalized else (limits.max - low, low)
    scale = np.ptp(VERTICES, axis=0) / size
    translation = VERTICES.min(axis=0) - scale * start
    builder.document["nodes"][0] |= {"scale": scale.tolist(), "translation": translation.tolist()}
    builder.document["extensionsRequired"] = ["KHR_mesh_quantization"]
    check(load_mesh(save(tmp_path / "box.glb", builder)))


def test_the_least_normalised_number_is_minus_one(tmp_path):
    builder, primitive = box(vertices=np.zeros((8, 3)))
    primitive["attributes"]["POSITION"] = builder.accessor(np.where(VERTICES > 0, 127, -128), BYTE, normalized=True)
    mesh = load_mesh(save(tmp_path / "box.glb", builder))
    np.testing.assert_array_equal(mesh.bounds, [[-1, -1, -1], [1, 1, 1]])


def pose(R, t, scale=1.0):
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = R.as_matrix() * scale, t
    return T


def test_nodes_place_their_meshes(tmp_path):
    """A translation, rotation and scale below a matrix, which is stored by columns."""
    R = Rotation.random(2, np.random.default_rng(0))
    builder = plain()
    builder.document["nodes"] = [
        {"children": [2], "matrix": pose(R[0], (1, 2, 3)).T.ravel().tolist()},
        {},
        {"children": [3], "rotation": R[1].as_quat().tolist(), "translation": [4, 5, 6], "scale": [2, 2, 2]},
        {"mesh": 0},
    ]
    expected = pose(R[0], (1, 2, 3)) @ pose(R[1], (4, 5, 6))
    check(load_mesh(save(tmp_path / "box.glb", builder)), expected, 2.0)
    theirs = trimesh.load(tmp_path / "box.glb", force="mesh")
    np.testing.assert_allclose(load_mesh(tmp_path / "box.glb").triangles, theirs.triangles, atol=1e-5)


def test_a_reflection_keeps_the_outside_outside(tmp_path):
    builder = plain()
    builder.document["nodes"][0]["scale"] = [-1, 1, 1]
    check(load_mesh(save(tmp_path / "box.glb", builder)))


def test_scales_apply_before_rotations(tmp_path):
    builder = plain()
    builder.document["nodes"][0] |= {"scale": [3, 1, 1], "rotation": [0, 0, np.sqrt(0.5), np.sqrt(0.5)]}
    mesh = load_mesh(save(tmp_path / "box.glb", builder))
    np.testing.assert_allclose(mesh.bounds[1], [1, 1.5, 1.5], atol=1e-6)


def test_meshes_of_several_nodes_are_copies(tmp_path):
    builder = plain()
    builder.document["nodes"] = [{"children": [1, 2]}, {"mesh": 0}, {"mesh": 0, "translation": [10, 0, 0]}]
    mesh = load_mesh(save(tmp_path / "boxes.glb", builder), scale=0.1)
    assert mesh.is_watertight and mesh.volume == pytest.approx(0.012)
    np.testing.assert_allclose(mesh.bounds, [[-0.05, -0.1, -0.15], [1.05, 0.1, 0.15]])


def test_instances_are_copies(tmp_path):
    """EXT_mesh_gpu_instancing below a node's own pose, rotations as normalised whole numbers."""
    builder = plain()
    quarter = np.rint(np.array([[0, 0, 0, 1], [0, 0, np.sqrt(0.5), np.sqrt(0.5)]]) * 32767)
    attributes = {
        "TRANSLATION": builder.accessor([[0, 0, 0], [10, 0, 0]]),
        "ROTATION": builder.accessor(quarter, SHORT, normalized=True),
        "SCALE": builder.accessor([[1, 1, 1], [2, 2, 2]]),
        "_ID": builder.accessor([[1], [2]]),
    }
    builder.document["nodes"][0] |= {
        "translation": [0, 0, 100],
        "extensions": {"EXT_mesh_gpu_instancing": {"attributes": attributes}},
    }
    builder.document["extensionsRequired"] = ["EXT_mesh_gpu_instancing"]
    mesh = load_mesh(save(tmp_path / "boxes.glb", builder))
    assert mesh.volume == pytest.approx(6 + 48, rel=1e-4)
    np.testing.assert_allclose(mesh.bounds, [[-0.5, -1, 97], [12, 1, 103]], atol=1e-3)


@pytest.mark.parametrize("where", ["data URI", "file", "file with a blank", "chunk"])
def test_buffers_may_be_in_other_places(tmp_path, where):
    """A .gltf, and a .glb that names a file as well."""
    builder = plain()
    builder.document["buffers"][0] = {"byteLength": len(builder.data)}
    buffer, suffix = builder.document["buffers"][0], "gltf"
    match where:
        case "data URI":
            buffer["uri"] = "data:application/octet-stream;base64," + base64.b64encode(builder.data).decode()
        case "file":
            buffer["uri"] = "box.bin"
            (tmp_path / "box.bin").write_bytes(builder.data)
        case "file with a blank":
            buffer["uri"] = "a%20box.bin"
            (tmp_path / "a box.bin").write_bytes(builder.data + b"\0")
        case "chunk":
            suffix = "glb"
    path = tmp_path / f"box.{suffix}"
    path.write_bytes(builder.glb() if suffix == "glb" else json.dumps(builder.document).encode("utf-8-sig"))
    check(load_mesh(path))


def test_points_are_a_cloud(tmp_path):
    points = np.random.default_rng(0).normal(size=(30, 3)).astype(np.float32)
    builder = Builder()
    builder.mesh({"attributes": {"POSITION": builder.accessor(points)}, "mode": 0})
    builder.document["nodes"][0]["translation"] = [1, 2, 3]
    save(tmp_path / "cloud.glb", builder)
    np.testing.assert_allclose(load_points(tmp_path / "cloud.glb"), points + [1, 2, 3], rtol=1e-6, atol=1e-6)
    with pytest.raises(InputError, match="cloud.glb has no faces"):
        load_mesh(tmp_path / "cloud.glb")


def compressed(name, where="primitive", required=True):
    builder, primitive = box()
    places = {
        "primitive": primitive,
        "bufferView": builder.document["bufferViews"][0],
        "accessor": builder.document["accessors"][0],
        "mesh": builder.document["meshes"][0],
        "buffer": builder.document["buffers"][0],
        "document": builder.document,
        "scene": builder.document["scenes"][0],
        "node": builder.document["nodes"][0],
    }
    places[where]["extensions"] = {name: {}}
    if name == "KHR_draco_mesh_compression":
        for accessor in builder.document["accessors"]:
            del accessor["bufferView"]
    builder.document["extensionsUsed"] = [name]
    if required:
        builder.document["extensionsRequired"] = [name]
    return builder


def edited(edit):
    builder, primitive = box()
    edit(builder.document, primitive)
    return builder


def one_part_compressed():
    """The second of two parts; a reader that leaves it out would return half of the object."""
    builder, primitive = box()
    part = copy.deepcopy(primitive)
    part["attributes"]["POSITION"] = builder.accessor(VERTICES)
    del builder.document["accessors"][-1]["bufferView"]
    part["extensions"] = {"KHR_draco_mesh_compression": {"bufferView": 0, "attributes": {"POSITION": 0}}}
    builder.document["meshes"][0]["primitives"].append(part)
    return builder


DRACO = "KHR_draco_mesh_compression"
UNSUPPORTED = {
    "Draco, required": (
        compressed(DRACO),
        f"requires the extensions {DRACO}; expected none of them; export it without compr",
    ),
    "Draco, one part": (
        one_part_compressed(),
        f"uses the extension {DRACO} in primitive 1 of mesh 0; .* without compression",
    ),
    "meshopt, required": (compressed("EXT_meshopt_compression"), "requires the extensions EXT_meshopt_compression"),
    "meshopt": (
        compressed("EXT_meshopt_compression", "bufferView", False),
        "uses the extension EXT_meshopt_compr.* in buffer view 0",
    ),
    "its new name": (
        compressed("KHR_meshopt_compression", "bufferView", False),
        "uses the extension KHR_meshopt_compression in",
    ),
    "unknown, required": (
        compressed("XYZ_voxels", "document"),
        "requires the extensions XYZ_voxels; .* export it without them",
    ),
    "unknown, of a primitive": (
        compressed("XYZ_voxels", required=False),
        "uses the extension XYZ_voxels in primitive 0 of mesh 0",
    ),
    "unknown, of an accessor": (compressed("XYZ_a", "accessor", False), "uses the extension XYZ_a in accessor 0"),
    "unknown, of a mesh": (compressed("XYZ_a", "mesh", False), "uses the extension XYZ_a in mesh 0"),
    "unknown, of a buffer": (compressed("XYZ_a", "buffer", False), "uses the extension XYZ_a in buffer 0"),
    "unknown, of a node": (compressed("XYZ_a", "node", False), "uses the extension XYZ_a in node 0"),
    "unknown, of a scene": (compressed("XYZ_a", "scene", False), "uses the extension XYZ_a in scene 0"),
    "center of Cesium": (
        compressed("CESIUM_RTC", "document", False),
        "uses the extension CESIUM_RTC in the document; expected none that changes geometry; export it without",
    ),
    "skin": (
        edited(lambda d, p: d["nodes"][0].update(skin=0)),
        "has a mesh that a skeleton bends .skin of node 0.; expected rigid",
    ),
    "version 1": (edited(lambda d, p: d["asset"].update(version="1.0")), "is glTF of version 1.0; expected 2.0"),
    "double": (
        edited(lambda d, p: d["accessors"][0].update(componentType=5130)),
        "has numbers of component type 5130 .* in accessor 0",
    ),
    "address": (
        edited(lambda d, p: d["buffers"][0].update(uri="https://a.b/c.bin")),
        "has data at https://a.b/c.bin; expected a file",
    ),
    "missing file": (
        edited(lambda d, p: d["buffers"][0].update(uri="none.bin")),
        "has its data in .*none.bin, which is missing; put",
    ),
}
DAMAGED = {
    "no whole triangles": (
        edited(lambda d, p: d["accessors"][1].update(count=35)),
        "35 indices, which is no whole number of tri",
    ),
    "view behind the buffer": (
        edited(lambda d, p: d["bufferViews"][1].update(byteLength=999)),
        "buffer view 1 ends after the end of the data",
    ),
    "accessor behind the view": (
        edited(lambda d, p: d["accessors"][0].update(count=9)),
        "is shorter than the 9 rows of 12 bytes",
    ),
    "rows without data": (
        edited(lambda d, p: d.update(accessors=[{"componentType": FLOAT, "type": "VEC3", "count": 10**12}])),
        "accessor 0 has 1000000000000 rows and no data",
    ),
    "negative offset": (
        edited(lambda d, p: d["accessors"][0].update(byteOffset=-4)),
        "offsets, lengths or strides that are not",
    ),
    "stride below the row": (
        edited(lambda d, p: d["bufferViews"][0].update(byteStride=4)),
        "strides that are not possible",
    ),
    "mode": (edited(lambda d, p: p.update(mode=9)), "primitive 0 of mesh 0 has mode 9"),
    "accessor that is none": (edited(lambda d, p: p.update(indices=7)), "it names number 7 of its 2 accessors"),
    "mesh that is none": (edited(lambda d, p: d["nodes"][0].update(mesh=-1)), "it names number -1 of its 1 meshes"),
    "two numbers a position": (
        edited(lambda d, p: d["accessors"][0].update(type="VEC2")),
        "positions have 2 components",
    ),
    "node below itself": (
        edited(lambda d, p: d["nodes"][0].update(children=[0])),
        "node 0 is in the scene twice, or below itself",
    ),
    "rotation": (
        edited(lambda d, p: d["nodes"][0].update(rotation=[1, 1, 0, 0])),
        "the rotation of node 0 has norm 1.41421",
    ),
    "matrix": (edited(lambda d, p: d["nodes"][0].update(matrix=[1.0] * 16)), "the matrix of node 0 has the last row"),
    "vertex that is none": (box(faces=FACES + 1)[0], "a face has vertex 8, counted from 0; there are 8"),
    "float indices": (edited(lambda d, p: p.update(indices=0)), "indices that are no whole numbers"),
    "no asset": (edited(lambda d, p: d.pop("asset")), "it has no property asset"),
    "no data": (
        edited(lambda d, p: d["buffers"].append({"byteLength": 4}) or d["bufferViews"][0].update(buffer=1)),
        "buffer 1 has no",
    ),
    "base64": (edited(lambda d, p: d["buffers"][0].update(uri="data:;base64,?")), "a data URI is not base64"),
}


@pytest.mark.parametrize("name", UNSUPPORTED)
def test_features_that_are_not_read_are_named(tmp_path, name):
    builder, message = UNSUPPORTED[name]
    path = save(tmp_path / "box.glb", builder)
    for load in (load_mesh, load_points):
        with pytest.raises(InputError, match=f"{load.__name__}.*box.glb {message}") as error:
            load(path)
        assert "save it again" not in str(error.value)


@pytest.mark.parametrize("name", DAMAGED)
def test_damaged_documents_say_where(tmp_path, name):
    builder, message = DAMAGED[name]
    with pytest.raises(InputError, match=rf"box.glb cannot be read as .glb \(.*{message}"):
        load_mesh(save(tmp_path / "box.glb", builder))


def test_damaged_containers_say_how(tmp_path):
    whole = plain().glb()
    older = whole[:4] + (1).to_bytes(4, "little") + whole[8:]
    damaged = {
        "truncated: its header promises": whole[:-7],
        "too long: its header promises": whole + b"more",
        "a header alone has 20": whole[:15],
        "a chunk of .* bytes ends after the end of the file": whole[:12] + b"\xff\xff\xff\x0f" + whole[16:],
        "has no chunk JSON": whole.replace(b"JSON", b"JUNK"),
        "is binary glTF of version 1; expected 2": older,
        "Expecting|utf-8|delimiter": whole.replace(b'"scene"', b'scene""'),
    }
    for message, content in damaged.items():
        (tmp_path / "box.glb").write_bytes(content)
        with pytest.raises(InputError, match=message):
            load_mesh(tmp_path / "box.glb")
    (tmp_path / "box.glb").write_bytes(whole + b"\0\0")  # some exporters pad
    check(load_mesh(tmp_path / "box.glb"))


def test_a_second_reader_agrees(tmp_path):
    """trimesh writes and reads a scene of turned, scaled and reflected copies."""
    scene, rng = trimesh.Scene(), np.random.default_rng(0)
    for i in range(4):
        T = pose(Rotation.random(rng=rng), rng.normal(size=3), (0.5, 1, 2, 3)[i])
        scene.add_geometry(trimesh.creation.icosphere(1) if i % 2 else BOX, transform=T)
    scene.export(tmp_path / "scene.glb")
    theirs = trimesh.load(tmp_path / "scene.glb", force="mesh")
    ours = load_mesh(tmp_path / "scene.glb")
    assert ours.volume == pytest.approx(theirs.volume)
    np.testing.assert_allclose(ours.bounds, theirs.bounds, atol=1e-5)
    assert len(ours.faces) == len(theirs.faces)
