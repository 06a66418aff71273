"""What the viewer draws: clouds, meshes, boxes and paths as nodes of viser, metres, world frame; and its camera."""

from typing import Any

import numpy as np
from jaxtyping import Array, Float
from matplotlib.colors import to_rgb

from tdf_jax.viz import polygons3d
from tdf_jax.viz.scene3d import MOST_TRIANGLES, bounds, thinned
from tdf_jax.viz.style import COLOURS, VIEW

POINT, LINE = 0.0022, 0.0016  # metres: edge of a point, thickness of a line
ARM = 0.005  # metres, from the middle of a cross
FIELD_OF_VIEW = 45.0  # degrees
AMBIENT = 1.2  # light from everywhere, in viser's unit, so that no side is black
CELL = 0.05  # metres, cells of the floor
MOST_POINTS = 20_000  # of a cloud; more are thinned, and first paint stays quick


def rgb(colour: Any) -> tuple[int, int, int]:
    """A colour as viser has it: red, green and blue from 0 to 255."""
    red, green, blue = (round(255 * part) for part in to_rgb(colour))
    return red, green, blue


def energy_colour(energy: float, low: float, high: float) -> tuple[int, int, int]:
    """Colour of an energy: dark at the lowest, light at the highest.

    Args:
        energy: the energy.
        low: lowest energy of the scale.
        high: highest energy of the scale.
    """
    share = 0.0 if high <= low else float(np.clip((energy - low) / (high - low), 0, 1))
    return rgb(COLOURS(0.1 + 0.8 * share))


def add_cloud(server: Any, name: str, points: Float[np.ndarray, "points 3"], colour: Any) -> Any:
    """Add a point cloud.

    Args:
        server: the `viser.ViserServer`.
        name: name of the node.
        points: the points, (points, 3).
        colour: their colour.
    """
    shown = thinned(points, MOST_POINTS).astype(np.float32)
    return server.scene.add_point_cloud(
        name, shown, rgb(colour), point_size=POINT, point_shape="circle", precision="float32", point_shading="flat"
    )


def add_triangles(
    server: Any, name: str, triangles: Float[np.ndarray, "faces 3 3"], colour: Any, opacity: float | None = None
) -> Any:
    """Add a surface whose vertices are merged, so that it is shaded smoothly.

    Args:
        server: the `viser.ViserServer`.
        name: name of the node.
        triangles: corners, (faces, 3, 3).
        colour: its colour.
        opacity: from 0 to 1; None for an opaque surface.
    """
    corners = np.asarray(triangles, np.float32).reshape(-1, 3)
    vertices, faces = np.unique(np.round(corners, 6), axis=0, return_inverse=True)
    return server.scene.add_mesh_simple(
        name, vertices, faces.reshape(-1, 3), color=rgb(colour), opacity=opacity, side="double"
    )


def add_mesh(server: Any, name: str, mesh: Any) -> Any | None:
    """Add the mesh of an object; None if there is none, or if it has too many triangles to send.

    Args:
        server: the `viser.ViserServer`.
        name: name of the node.
        mesh: the `trimesh.Trimesh`, or None.
    """
    if mesh is None or len(mesh.faces) > MOST_TRIANGLES:
        return None
    colour = rgb(tuple(polygons3d.SURFACE_COLOUR))
    return server.scene.add_mesh_simple(name, mesh.vertices, mesh.faces, color=colour, side="double")


def add_box(
    server: Any, name: str, query: Float[Array | np.ndarray, "queries 3"], colour: Any, thickness: float = LINE
) -> Any:
    """Add the box of query points, in the query frame, with its face towards +x crossed.

    Args:
        server: the `viser.ViserServer`.
        name: name of the node.
        query: query points, (queries, 3), query frame.
        colour: its colour.
        thickness: thickness of its edges, metres.
    """
    corners = bounds(np.asarray(query))
    front = polygons3d.FRONT
    edges = [*polygons3d.EDGES, (front[0], front[2]), (front[1], front[3])]
    segments = np.array([[corners[a], corners[b]] for a, b in edges])
    return server.scene.add_line_segments(name, segments, rgb(colour), thickness=thickness)


def path_segments(xyz: Float[np.ndarray, "poses 3"]) -> Float[np.ndarray, "segments 2 3"]:
    """The lines from pose to pose, (segments, 2, 3); of one pose, a line of no length."""
    if len(xyz) == 1:
        return np.stack([xyz, xyz], axis=1)
    return np.stack([xyz[:-1], xyz[1:]], axis=1)


def add_path(server: Any, name: str, xyz: Float[np.ndarray, "poses 3"], colour: Any, thickness: float = LINE) -> Any:
    """Add the path of the query frame's origin.

    Args:
        server: the `viser.ViserServer`.
        name: name of the node.
        xyz: positions, (poses, 3).
        colour: its colour.
        thickness: thickness of its lines, metres.
    """
    return server.scene.add_line_segments(name, path_segments(np.asarray(xyz)), rgb(colour), thickness=thickness)


def add_crosses(server: Any, name: str, xyz: Float[np.ndarray, "points 3"], colour: Any) -> Any:
    """Add a cross of three lines at every point, which a plane through the point does not hide.

    Args:
        server: the `viser.ViserServer`.
        name: name of the node.
        xyz: the points, (points, 3).
        colour: their colour.
    """
    arms = np.stack([-ARM * np.eye(3), ARM * np.eye(3)], axis=1)
    segments = (np.asarray(xyz)[:, None, None] + arms).reshape(-1, 2, 3)
    return server.scene.add_line_segments(name, segments, rgb(colour), thickness=LINE)


def add_map(
    server: Any,
    name: str,
    points: Float[np.ndarray, "rows columns 3"],
    energies: Float[np.ndarray, "rows columns"],
    limits: tuple[float, float],
    opacity: float = 1.0,
) -> Any:
    """Add a plane of a landscape, coloured by its energies; points without an energy are left out.

    Args:
        server: the `viser.ViserServer`.
        name: name of the node.
        points: points of the plane, (rows, columns, 3).
        energies: their energies, (rows, columns).
        limits: lowest and highest energy of the colours.
        opacity: from 0 to 1; below 1 what is behind the plane shows through.
    """
    import trimesh
    from trimesh.visual import TextureVisuals
    from trimesh.visual.material import PBRMaterial

    rows, columns = energies.shape
    first = (np.arange(rows - 1)[:, None] * columns + np.arange(columns - 1)).ravel()
    faces = np.concatenate(
        [
            np.stack([first, first + 1, first + columns], 1),
            np.stack([first + 1, first + columns + 1, first + columns], 1),
        ]
    )
    flat = energies.ravel()
    faces = faces[np.isfinite(flat[faces]).all(axis=1)]
    low, high = limits
    share = np.nan_to_num((flat - low) / max(high - low, 1e-12))
    colours = (255 * COLOURS(share)).astype(np.uint8)
    both = np.concatenate([faces, faces[:, ::-1]])  # the plane is seen from both sides
    # Colours of vertices alone have no material, and without one viser draws them as opaque metal.
    material = PBRMaterial(
        baseColorFactor=(255, 255, 255, round(255 * opacity)),
        metallicFactor=0.0,
        roughnessFactor=1.0,
        alphaMode="OPAQUE" if opacity == 1 else "BLEND",
    )
    look = TextureVisuals(material=material)
    look.vertex_attributes["color"] = colours
    mesh = trimesh.Trimesh(points.reshape(-1, 3), both, visual=look, process=False)
    return server.scene.add_mesh_trimesh(name, mesh, cast_shadow=False, receive_shadow=False)


def place(node: Any, wxyz: Float[np.ndarray, "4"], xyz: Float[np.ndarray, "3"]) -> None:
    """Move a node to a pose of its frame."""
    node.wxyz, node.position = np.asarray(wxyz, float), np.asarray(xyz, float)


def look(server: Any, contents: Float[np.ndarray, "points 3"]) -> None:
    """Place the camera before what is shown, as in the pictures, and a floor of 5 cm cells under it.

    Args:
        server: the `viser.ViserServer`.
        contents: points of all that is shown, (points, 3), metres, world frame.
    """
    azimuth, height = np.radians(VIEW["azim"]), np.radians(VIEW["elev"])
    towards = np.array([np.cos(azimuth) * np.cos(height), np.sin(azimuth) * np.cos(height), np.sin(height)])
    low, high = contents.min(axis=0), contents.max(axis=0)
    middle, size = (low + high) / 2, high - low

    def from_where(aspect: float) -> np.ndarray:
        """Position from which the smaller of both fields of view has all in it, for a width in that of the height."""
        half = np.tan(np.radians(FIELD_OF_VIEW) / 2) * min(1.0, aspect)
        return middle + 0.58 * np.linalg.norm(size) / half * towards

    def fit(client: Any) -> None:
        """Step back in a narrow canvas, which the panel makes narrower, until the user moves the camera."""
        placed = [from_where(1.0)]

        def step_back(camera: Any) -> None:
            wanted = from_where(camera.aspect)
            if np.allclose(camera.position, placed[0], atol=1e-3) and not np.allclose(wanted, placed[0], atol=1e-3):
                placed[0] = wanted
                camera.position = wanted
                camera.look_at = middle

        client.camera.on_update(step_back)
        step_back(client.camera)

    server.on_client_connect(fit)
    server.scene.set_up_direction("+z")
    # Reflections of surroundings take ten times as long where the processor draws, as on a remote desktop.
    server.scene.configure_environment_map(None)
    server.scene.configure_default_lights(True, cast_shadow=False)
    server.scene.add_light_ambient("/light", intensity=AMBIENT)
    camera = server.initial_camera
    camera.position, camera.look_at = from_where(1.0), middle
    camera.fov, camera.near = np.radians(FIELD_OF_VIEW), 0.005
    cells = np.ceil((size[:2] + 4 * CELL) / CELL) * CELL
    server.scene.add_grid(
        "/floor",
        width=cells[0],
        height=cells[1],
        plane="xy",
        cell_size=CELL,
        section_size=2 * CELL,
        cell_color=(225, 225, 225),
        section_color=(205, 205, 205),
        position=(middle[0], middle[1], low[2] - CELL),
    )
    words = f"cells of {100 * CELL:g} cm"
    near = (middle[0] + 0.25 * cells[0], middle[1] - 0.25 * cells[1], low[2] - CELL)
    server.scene.add_label("/floor_name", words, position=near)
