"""glTF 2.0, as .glb and .gltf: the meshes of the scene, each at its node's pose."""

import base64
import binascii
import json
from pathlib import Path
from urllib.parse import unquote, unquote_to_bytes

import numpy as np
from jaxtyping import Float, Int

from tdf_jax.io.content import UnsupportedError
from tdf_jax.io.polygons import strip_triangles, triangulate

_COMPONENTS = {5120: "<i1", 5121: "<u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
_WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4}
_POINTS, _LINES, _TRIANGLES, _STRIP, _FAN = 0, (1, 2, 3), 4, 5, 6
# Extensions that are honoured, and those that leave the geometry as it is.
_HONOURED = {"KHR_mesh_quantization", "EXT_mesh_gpu_instancing", "KHR_node_visibility"}
_HARMLESS = (
    *("KHR_materials", "KHR_texture", "KHR_lights", "KHR_xmp", "KHR_techniques_webgl", "KHR_animation", "KHR_audio"),
    *("EXT_texture", "EXT_lights", "EXT_mesh_features", "EXT_instance_features", "EXT_structural_metadata"),
    *("EXT_feature_metadata", "EXT_mesh_manifold", "CESIUM_primitive_outline", "FB_geometry_metadata"),
    *("MSFT_texture", "MSFT_lod", "MSFT_packing", "ADOBE_materials", "NV_materials"),
    # Of documents, scenes and nodes: metadata, sounds, physics, behaviour and what editors note for themselves.
    *("MOZ_hubs", "MOZ_lightmap", "MSFT_audio", "MSFT_physics", "OMI_audio", "OMI_physics", "OMI_collider", "OMI_seat"),
    *("OMI_spawn_point", "OMI_link", "OMI_personality", "KHR_physics", "KHR_collision", "KHR_interactivity"),
    *("KHR_node_hover", "KHR_node_select", "KHR_environment", "AGI_stk_metadata", "GODOT_", "NEEDLE_", "VRMC_vrm"),
    *("VRMC_materials", "VRMC_springBone", "3DTILES_metadata", "EXT_property"),
)
_MOST_ZEROS = 10**7  # rows of an accessor without data, whose number nothing in the file bounds
_COMPRESSED = "export it without compression of meshes"


def read_gltf(data: bytes, folder: Path) -> tuple[Float[np.ndarray, "vertices 3"], Int[np.ndarray, "faces 3"]]:
    """Read the surface of the scene that a glTF file shows, in the frame of the scene.

    The poses are those of the nodes, not of an animation; morph targets have the weights that the file gives.

    Args:
        data: content of the .glb or .gltf file.
        folder: folder of other files that it names.

    Returns:
        vertices, (vertices, 3), in the unit of the file, which should be metres.
        faces, (faces, 3). If the scene has none, the vertices are those of its points. Lines are left out, and
        points beside faces.

    Raises:
        ValueError: the file is damaged.
        UnsupportedError: an extension or a skin changes the geometry in a way that is not honoured.
    """
    document, binary = _container(data)
    if not isinstance(document, dict) or not isinstance(document.get("asset"), dict):
        raise ValueError("it has no property asset")
    version = str(document["asset"].get("version"))
    if version.split(".")[0] != "2":
        raise UnsupportedError(f"is glTF of version {version}; expected 2.0; export it as glTF 2.0")
    unknown = [name for name in document.get("extensionsRequired", []) if not _known(name)]
    if unknown:
        fix = _COMPRESSED if any("compression" in name for name in unknown) else "export it without them"
        raise UnsupportedError(f"requires the extensions {', '.join(unknown)}; expected none of them; {fix}")
    return _Asset(document, binary, folder).geometry()


def _known(name):
    return name in _HONOURED or name.startswith(_HARMLESS)


def _container(data):
    """The JSON document and the binary chunk, which is None if there is none."""
    if not data.startswith(b"glTF"):
        return json.loads(data.decode("utf-8-sig")), None
    if len(data) < 20:
        raise ValueError(f"it is truncated: it has {len(data)} bytes, and a header alone has 20")
    version, length = (int.from_bytes(data[start : start + 4], "little") for start in (4, 8))
    if version != 2:
        raise UnsupportedError(f"is binary glTF of version {version}; expected 2; export it as glTF 2.0")
    if len(data) != length and (len(data) < length or data[length:].strip(b"\0 \r\n")):
        kind = "truncated" if len(data) < length else "too long"
        raise ValueError(f"it is {kind}: its header promises {length} bytes, and it has {len(data)}")
    chunks, start = {}, 12
    while start + 8 <= length:
        size = int.from_bytes(data[start : start + 4], "little")
        kind, start = data[start + 4 : start + 8], start + 8
        if start + size > length:
            raise ValueError(f"it is truncated: a chunk of {size} bytes ends after the end of the file")
        chunks.setdefault(kind, data[start : start + size])
        start += size
    if b"JSON" not in chunks:
        raise ValueError("it has no chunk JSON")
    return json.loads(chunks[b"JSON"].rstrip(b"\0").decode("utf-8-sig")), chunks.get(b"BIN\0")


class _Asset:
    def __init__(self, document, binary, folder):
        self.document, self.binary, self.folder = document, binary, folder
        self.buffers = {}

    def geometry(self):
        """Vertices and faces of the scene."""
        surfaces, clouds = [], []
        self.check(self.document, "the document")
        for matrix, mesh, weights in self.instances():
            for points, faces in self.primitives(mesh, weights):
                points = points @ matrix[:3, :3].T + matrix[:3, 3]
                if faces is None:
                    clouds.append(points)
                else:  # a reflection turns triangles over, which glTF undoes
                    surfaces.append((points, faces if np.linalg.det(matrix[:3, :3]) >= 0 else faces[:, ::-1]))
        if not any(len(faces) for _, faces in surfaces):
            return np.concatenate([np.zeros((0, 3)), *clouds]), np.zeros((0, 3), dtype=np.int64)
        starts = np.cumsum([0, *(len(points) for points, _ in surfaces)])
        faces = [faces + start for (_, faces), start in zip(surfaces, starts)]
        return np.concatenate([points for points, _ in surfaces]), np.concatenate(faces)

    def item(self, kind, index):
        """One entry of a list of the document."""
        entries = self.document.get(kind, [])
        if not isinstance(index, int) or not 0 <= index < len(entries):
            raise ValueError(f"it names number {index} of its {len(entries)} {kind}")
        return entries[index]

    def instances(self):
        """Every mesh that the scene shows: T_scene_mesh, number of the mesh, weights of morph targets or None."""
        scenes, nodes = self.document.get("scenes", []), self.document.get("nodes", [])
        if scenes:
            scene = self.document.get("scene", 0)
            self.check(self.item("scenes", scene), f"scene {scene}")
            roots = self.item("scenes", scene).get("nodes", [])
        elif nodes:
            children = {child for node in nodes for child in node.get("children", [])}
            roots = [index for index in range(len(nodes)) if index not in children]
        else:
            for index in range(len(self.document.get("meshes", []))):
                yield np.eye(4), index, None
            return
        waiting, seen = [(index, np.eye(4)) for index in reversed(roots)], set()
        while waiting:
            index, T_scene_parent = waiting.pop()
            node = self.item("nodes", index)
            if index in seen:
                raise ValueError(f"node {index} is in the scene twice, or below itself; nodes form a tree")
            seen.add(index)
            extensions = node.get("extensions", {})
            if not extensions.get("KHR_node_visibility", {}).get("visible", True):
                continue
            self.check(node, f"node {index}")
            T_scene_node = T_scene_parent @ _local(node, f"node {index}")
            if "mesh" in node:
                if "skin" in node:
                    raise UnsupportedError(
                        f"has a mesh that a skeleton bends (skin of node {index}); expected rigid meshes; apply the "
                        "pose and export the mesh without its armature"
                    )
                for instance in self.copies(extensions.get("EXT_mesh_gpu_instancing")):
                    yield T_scene_node @ instance, node["mesh"], node.get("weights")
            waiting.extend((child, T_scene_node) for child in reversed(node.get("children", [])))

    def copies(self, extension):
        """Poses of the copies that EXT_mesh_gpu_instancing makes of a node; one of itself without it."""
        if extension is None:
            return np.eye(4)[None]
        columns = {name: self.accessor(index) for name, index in extension["attributes"].items() if name[0] != "_"}
        counts = {len(column) for column in columns.values()}
        if len(counts) != 1:
            raise ValueError("its EXT_mesh_gpu_instancing has attributes of different lengths, or none")
        names = {"TRANSLATION": "translation", "ROTATION": "rotation", "SCALE": "scale"}
        rows = [
            {names[name]: column[i] for name, column in columns.items() if name in names} for i in range(counts.pop())
        ]
        return np.array([_local(row, f"instance {i}") for i, row in enumerate(rows)]).reshape(-1, 4, 4)

    def primitives(self, mesh, weights):
        """Points and faces of each primitive of a mesh; no faces for points."""
        entry = self.item("meshes", mesh)
        self.check(entry, f"mesh {mesh}")
        weights = entry.get("weights", []) if weights is None else weights
        for number, primitive in enumerate(entry["primitives"]):
            where = f"primitive {number} of mesh {mesh}"
            attributes, mode = primitive.get("attributes", {}), primitive.get("mode", _TRIANGLES)
            self.check(primitive, where, [attributes.get("POSITION"), primitive.get("indices")])
            if "POSITION" not in attributes or mode in _LINES:
                continue
            points = self.positions(attributes["POSITION"])
            for weight, target in zip(weights, primitive.get("targets", [])):
                if weight and "POSITION" in target:
                    points = points + weight * self.positions(target["POSITION"])
            corners = self.accessor(primitive["indices"]).ravel() if "indices" in primitive else np.arange(len(points))
            if corners.dtype.kind == "f":
                raise ValueError(f"{where} has indices that are no whole numbers")
            yield points, None if mode == _POINTS else _faces(points, corners.astype(np.int64), mode, where)

    def positions(self, index):
        values = self.accessor(index)
        if values.shape[1] != 3:
            raise ValueError(f"positions have {values.shape[1]} components, in accessor {index}; expected 3")
        return values.astype(np.float64)

    def check(self, entry, where, accessors=()):
        """Refuse extensions of what holds or places geometry, unless they leave it as it is."""
        for name in entry.get("extensions", {}):
            if _known(name):
                continue
            if name == "KHR_draco_mesh_compression":
                used = [self.item("accessors", index) for index in accessors if index is not None]
                if used and all("bufferView" in accessor for accessor in used):
                    continue  # the file also holds the mesh uncompressed, for readers like this one
            fix = _COMPRESSED if "compression" in name else "export it without the extension"
            raise UnsupportedError(f"uses the extension {name} in {where}; expected none that changes geometry; {fix}")

    def accessor(self, index):
        """Values of an accessor, (count, components); normalised whole numbers as floats from -1 to 1."""
        entry = self.item("accessors", index)
        self.check(entry, f"accessor {index}")
        if entry.get("componentType") not in _COMPONENTS or entry.get("type") not in _WIDTHS:
            raise UnsupportedError(
                f"has numbers of component type {entry.get('componentType')} and type {entry.get('type')} in accessor "
                f"{index}; expected one of {', '.join(map(str, _COMPONENTS))} and of {', '.join(_WIDTHS)}"
            )
        kind, width, count = np.dtype(_COMPONENTS[entry["componentType"]]), _WIDTHS[entry["type"]], entry["count"]
        if "bufferView" in entry:
            values = self.rows(entry["bufferView"], entry.get("byteOffset", 0), kind, width, count)
        elif not 0 <= count <= _MOST_ZEROS:
            raise ValueError(f"accessor {index} has {count} rows and no data")
        else:
            values = np.zeros((count, width), kind)
        if "sparse" in entry:
            sparse, values = entry["sparse"], values.copy()
            where, what = sparse["indices"], sparse["values"]
            changed = np.dtype(_COMPONENTS[where["componentType"]])
            rows = self.rows(where["bufferView"], where.get("byteOffset", 0), changed, 1, sparse["count"]).ravel()
            if len(rows) and not 0 <= rows.min() <= rows.max() < count:
                raise ValueError(f"accessor {index} changes rows that it does not have")
            values[rows.astype(np.int64)] = self.rows(
                what["bufferView"], what.get("byteOffset", 0), kind, width, sparse["count"]
            )
        if entry.get("normalized") and kind.kind in "iu":
            return np.maximum(values / np.iinfo(kind).max, -1.0)
        return values

    def rows(self, view, offset, kind, width, count):
        """Rows of a buffer view, (count, width)."""
        entry = self.item("bufferViews", view)
        self.check(entry, f"buffer view {view}")
        start, length = entry.get("byteOffset", 0), entry["byteLength"]
        data, size = self.buffer(entry["buffer"]), width * kind.itemsize
        stride = entry.get("byteStride", size)
        numbers = (start, length, offset, count, stride)
        if not all(isinstance(number, int) and number >= 0 for number in numbers) or stride < size:
            raise ValueError(f"buffer view {view} has offsets, lengths or strides that are not possible")
        if start + length > len(data) or (count and offset + stride * (count - 1) + size > length):
            raise ValueError(
                f"buffer view {view} ends after the end of the data, {len(data)} bytes in buffer {entry['buffer']}, or "
                f"is shorter than the {count} rows of {size} bytes in it"
            )
        return (
            np.ndarray((count, width), kind, data, start + offset, (stride, kind.itemsize))
            if count
            else (np.zeros((0, width), kind))
        )

    def buffer(self, index):
        """Bytes of a buffer: of the file itself, of a data URI or of another file."""
        if index not in self.buffers:
            entry = self.item("buffers", index)
            self.check(entry, f"buffer {index}")
            uri = entry.get("uri")
            if uri is None:
                if index != 0 or self.binary is None:
                    raise ValueError(f"buffer {index} has no data")
                data = self.binary
            elif uri.startswith("data:"):
                data = _data_uri(uri)
            elif "://" in uri or uri.startswith(("/", "\\")):
                raise UnsupportedError(f"has data at {uri[:80]}; expected a file in its folder; save it as .glb")
            else:
                path = self.folder / unquote(uri)
                if not path.is_file():
                    raise UnsupportedError(f"has its data in {path}, which is missing; put the file there")
                data = path.read_bytes()
            if len(data) < entry["byteLength"]:
                raise ValueError(f"buffer {index} is truncated: {len(data)} of {entry['byteLength']} bytes")
            self.buffers[index] = data
        return self.buffers[index]


def _faces(points, corners, mode, where):
    """Triangles of a primitive, its indices checked."""
    if mode == _TRIANGLES:
        if len(corners) % 3:
            raise ValueError(f"{where} has {len(corners)} indices, which is no whole number of triangles")
        faces = corners.reshape(-1, 3)
    elif mode == _STRIP:
        faces = strip_triangles(corners)
    elif mode == _FAN:
        edges = np.stack([corners[1:-1], corners[2:]], axis=1)
        faces = np.insert(edges, 0, corners[:1] if len(edges) else 0, axis=1)
    else:
        raise ValueError(f"{where} has mode {mode}")
    return triangulate(points, faces.ravel(), np.full(len(faces), 3))


def _data_uri(uri):
    head, comma, text = uri.partition(",")
    if not comma:
        raise ValueError("a data URI has no comma")
    if not head.endswith(";base64"):
        return unquote_to_bytes(text)
    try:
        return base64.b64decode(unquote(text), validate=True)
    except binascii.Error as error:
        raise ValueError(f"a data URI is not base64: {error}") from None


def _local(node, where):
    """T_parent_node of a matrix, or of a translation, a rotation xyzw and a scale."""
    if "matrix" in node:
        matrix = np.array(node["matrix"], dtype=np.float64).reshape(4, 4).T  # columns come first in the file
        if not np.allclose(matrix[3], [0, 0, 0, 1]):
            raise ValueError(f"the matrix of {where} has the last row {matrix[3].tolist()}")
        return matrix
    x, y, z, w = np.array(node.get("rotation", (0, 0, 0, 1)), dtype=np.float64)
    norm = np.sqrt(x * x + y * y + z * z + w * w)
    if not abs(norm - 1) < 1e-2:  # quantised rotations are off by up to 1e-2
        raise ValueError(f"the rotation of {where} has norm {norm:g}; expected a unit quaternion")
    x, y, z, w = x / norm, y / norm, z / norm, w / norm
    R = np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )
    matrix = np.eye(4)
    matrix[:3, :3] = R * np.array(node.get("scale", (1, 1, 1)), dtype=np.float64)
    matrix[:3, 3] = node.get("translation", (0, 0, 0))
    return matrix
