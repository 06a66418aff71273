"""Contact sheet: many objects side by side, at one scale."""

from collections.abc import Sequence
from typing import TYPE_CHECKING

import matplotlib
import numpy as np
from matplotlib.figure import Figure

from tdf_jax.viz.polygons3d import surface
from tdf_jax.viz.style import LIGHT, STYLE, blank_figure, set_view

if TYPE_CHECKING:
    import trimesh

ELEVATION, AZIMUTH = 25, -60  # of the viewer, degrees
PIECE = 0.05  # longest edge of a drawn triangle, share of the object's diagonal, because long ones occlude wrongly
AWAY = 0.2  # cosine by which a hidden face faces away from the viewer, who is not infinitely far


def contact_sheet(objects: "Sequence[tuple[str, trimesh.Trimesh]]", columns: int = 8) -> Figure:
    """Draw meshes in rows, all at one scale and seen obliquely from above.

    Args:
        objects: titles and meshes, metres.
        columns: number of columns.
    """
    half = max(float(np.max(mesh.extents)) for _, mesh in objects) / 2
    lines = -(-len(objects) // columns)
    with matplotlib.rc_context(STYLE):
        figure = blank_figure(1.2 * columns, 1.4 * lines)
        for number, (title, mesh) in enumerate(objects):
            axes = figure.add_subplot(lines, columns, number + 1, projection="3d")
            triangles = _drawn(mesh) - mesh.bounds.mean(axis=0)
            axes.add_collection3d(surface(triangles, LIGHT).collection())
            axes.set(xlim=(-half, half), ylim=(-half, half), zlim=(-half, half))
            set_view(axes, (1, 1, 1), 1.45, {"elev": ELEVATION, "azim": AZIMUTH})
            axes.set_axis_off()
            axes.set_title(title, y=-0.12, va="top", fontsize=6)
        figure.subplots_adjust(left=0, right=1, bottom=0.07, top=1, wspace=0, hspace=0.12)
    return figure


def _drawn(mesh) -> np.ndarray:
    """Triangles (faces, 3, 3) of a mesh: the large ones split, and of a closed mesh those that face the viewer."""
    from trimesh.remesh import subdivide_to_size

    faces, vertices = mesh.faces, mesh.vertices
    if mesh.is_watertight:
        elevation, azimuth = np.radians(ELEVATION), np.radians(AZIMUTH)
        out = np.cos(elevation)
        to_viewer = np.array([out * np.cos(azimuth), out * np.sin(azimuth), np.sin(elevation)])
        faces = faces[mesh.face_normals @ to_viewer > -AWAY]
    longest = PIECE * float(np.linalg.norm(mesh.extents))
    if mesh.edges_unique_length.max() > longest:
        vertices, faces = subdivide_to_size(vertices, faces, longest, max_iter=20)[:2]
    return np.asarray(vertices)[faces]
