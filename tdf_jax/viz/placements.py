"""Placed objects, cut open: where an object was put on its target, above where it belongs."""

import textwrap
from collections.abc import Sequence
from typing import TYPE_CHECKING, NamedTuple

import matplotlib
import numpy as np
from jaxtyping import Float
from matplotlib.figure import Figure

from tdf_jax.viz.polygons3d import Pieces, surface
from tdf_jax.viz.style import COLOURS, LIGHT, STYLE, blank_figure, set_view

if TYPE_CHECKING:
    import manifold3d
    import trimesh

VIEW = {"elev": 12.0, "azim": -75.0}  # of the viewer, degrees: a little aside of the cut
PIECE = 0.04  # longest edge of a drawn triangle, share of half a panel's edge, because long ones occlude wrongly
COLUMN, ROW = 1.5, 1.5  # inches
TITLE = 22  # characters of a line of a panel's title
AROUND = 1.25  # edge of a panel, in that of the object; what is farther from it is cut away
OBJECT_COLOUR = np.array(COLOURS(0.62)[:3])


class PlacedMeshes(NamedTuple):
    """An object on its target, in the frame of the target.

    Attributes:
        title: text above the pictures.
        object, target: their meshes, metres.
        found, true: the pose of the object that was found, and a right one, T_target_object, 4x4.
        T_target_contact: frame where the two should meet, 4x4; the cut goes through its origin along its x and z axes.
    """

    title: str
    object: "trimesh.Trimesh"
    target: "trimesh.Trimesh"
    found: Float[np.ndarray, "4 4"]
    true: Float[np.ndarray, "4 4"]
    T_target_contact: Float[np.ndarray, "4 4"]


def placements_figure(placements: Sequence[PlacedMeshes]) -> Figure:
    """Draw placements side by side, each above the right one, with the half in front of the contact cut away.

    Args:
        placements: the placements, at least one.
    """
    with matplotlib.rc_context(STYLE):
        figure = blank_figure(COLUMN * len(placements) + 0.2, 2 * ROW + 0.55)
        for column, one in enumerate(placements):
            solids = {"found": one.found, "right": one.true}
            solids = {name: _behind(_solid(one.object, _upright(one) @ T)) for name, T in solids.items()}
            corners = np.concatenate([solid.to_mesh().vert_properties[:, :3] for solid in solids.values()])
            middle, half = (corners.min(axis=0) + corners.max(axis=0)) / 2, AROUND * np.ptp(corners, axis=0).max() / 2
            target = _near(_behind(_solid(one.target, _upright(one))), middle, half)
            for row, solid in enumerate(solids.values()):
                axes = figure.add_subplot(2, len(placements), row * len(placements) + column + 1, projection="3d")
                parts = [_triangles(part, PIECE * half) - middle for part in (target, solid)]
                axes.add_collection3d((surface(parts[0], LIGHT) + _coloured(parts[1])).collection())
                axes.set(xlim=(-half, half), ylim=(-half, half), zlim=(-half, half))
                set_view(axes, (1, 1, 1), 1.75, VIEW)
                axes.set_axis_off()
                if row == 0:
                    lines = [textwrap.fill(line, TITLE) for line in one.title.splitlines()]
                    axes.set_title("\n".join(lines), y=0.98, fontsize=6)
        figure.text(0.005, 0.72, "found", rotation=90, va="center", fontsize=7)
        figure.text(0.005, 0.26, "right", rotation=90, va="center", fontsize=7)
        figure.subplots_adjust(left=0.02, right=1, bottom=0.01, top=0.87, wspace=0, hspace=0)
    return figure


def _upright(one: PlacedMeshes) -> np.ndarray:
    """T_picture_target: z up, x along the horizontal part of the contact's x axis, origin at the contact."""
    along = one.T_target_contact[:2, 0]
    length = float(np.linalg.norm(along))
    along = along / length if length > 1e-6 else np.array([1.0, 0.0])
    T = np.eye(4)
    T[:2, :2] = [along, [-along[1], along[0]]]
    T[:3, 3] = -T[:3, :3] @ one.T_target_contact[:3, 3]
    return T


def _solid(mesh: "trimesh.Trimesh", T: np.ndarray) -> "manifold3d.Manifold":
    import manifold3d

    vertices = (mesh.vertices @ T[:3, :3].T + T[:3, 3]).astype(np.float32)
    return manifold3d.Manifold(manifold3d.Mesh(vertices, mesh.faces.astype(np.uint32)))


def _behind(solid: "manifold3d.Manifold") -> "manifold3d.Manifold":
    """The half of a solid behind the contact."""
    return solid.trim_by_plane((0.0, 1.0, 0.0), 0.0)


def _near(solid: "manifold3d.Manifold", middle: np.ndarray, half: float) -> "manifold3d.Manifold":
    """The part of a solid in a cube, because matplotlib does not clip what is outside of the axes."""
    for axis in np.eye(3):
        for side in (axis, -axis):
            solid = solid.trim_by_plane(tuple(side), float(side @ middle - half))
    return solid


def _triangles(solid: "manifold3d.Manifold", longest: float) -> np.ndarray:
    """Small triangles (faces, 3, 3) of a solid."""
    from trimesh.remesh import subdivide_to_size

    mesh = solid.to_mesh()
    if not len(mesh.tri_verts):
        return np.zeros((0, 3, 3))
    vertices, faces = subdivide_to_size(mesh.vert_properties[:, :3], mesh.tri_verts, longest, max_iter=20)[:2]
    return np.asarray(vertices)[faces]


def _coloured(triangles: np.ndarray) -> Pieces:
    """A surface in the object's colour."""
    grey = surface(triangles, LIGHT)
    brightness = np.array([face[0] for face in grey.faces]) if grey.faces else np.zeros(0)
    colours = [(*(light * OBJECT_COLOUR), 1.0) for light in brightness]
    return Pieces(grey.polygons, colours, colours)
