"""Opaque surfaces and boxes in matplotlib's 3-D axes, as small polygons of one collection.

Matplotlib has no depth buffer: it paints the polygons of a collection from far to near by their mean depth, and one
collection after the other. A mug, boxes and lines therefore occlude each other correctly only as small polygons of one
collection.
"""

import dataclasses

import numpy as np
from jaxtyping import Float
from matplotlib.colors import to_rgb
from mpl_toolkits.mplot3d.art3d import Poly3DCollection

SURFACE_COLOUR = np.array([0.93, 0.90, 0.86])
SHADE = 0.5  # brightness of a face parallel to the light
WIDTH = 0.7  # width of all edges, typographic points
CUTS = 8  # pieces along a box's edge
CORNERS = np.array([(x, y, z) for x in (0, 1) for y in (0, 1) for z in (0, 1)], float)
EDGES = [(i, i + step) for step in (4, 2, 1) for i in range(8) if not i & step]  # edges along x, y and z
FRONT = (4, 5, 7, 6)  # the face towards +x


@dataclasses.dataclass(frozen=True)
class Pieces:
    """Polygons (corners, 3), each with a face colour and an edge colour; two corners make a line."""

    polygons: list
    faces: list
    edges: list

    def __add__(self, other: "Pieces") -> "Pieces":
        return Pieces(*(getattr(self, f.name) + getattr(other, f.name) for f in dataclasses.fields(self)))

    def collection(self) -> Poly3DCollection:
        """The collection for `axes.add_collection3d`."""
        # All have one width because matplotlib sorts the colours with the polygons, but not the widths.
        return Poly3DCollection(self.polygons, facecolors=self.faces, edgecolors=self.edges, linewidths=WIDTH)


def surface(triangles: Float[np.ndarray, "faces 3 3"], light: Float[np.ndarray, "3"]) -> Pieces:
    """An opaque surface, shaded on both sides by a distant light.

    Args:
        triangles: corners of the triangles, (faces, 3, 3).
        light: unit vector towards the light, (3,).
    """
    u, v = triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0]
    normals = np.cross(u, v)
    lengths = np.linalg.norm(normals, axis=1)
    kept = lengths > 0
    brightness = SHADE + (1 - SHADE) * np.abs(normals[kept] @ light / lengths[kept])
    colours = [(*colour, 1.0) for colour in brightness[:, None] * SURFACE_COLOUR]
    return Pieces(list(triangles[kept]), colours, colours)  # edges in the colour of the face close the seams


def box(corners: Float[np.ndarray, "8 3"], colour, *, filled: bool = True, dashed: bool = False) -> Pieces:
    """The edges of a box and its face towards +x, transparent.

    Args:
        corners: corners of the box in the order of `CORNERS`, (8, 3).
        colour: colour of edges and face.
        filled: whether to draw the face.
        dashed: whether to omit every other piece of an edge.
    """
    colour = to_rgb(colour)
    cuts = np.linspace(0, 1, CUTS + 1)[:, None]
    lines = []
    for i, j in EDGES:
        points = corners[i] + cuts * (corners[j] - corners[i])
        lines += [points[k : k + 2] for k in range(0, CUTS, 2 if dashed else 1)]
    count = len(lines)
    pieces = Pieces(lines, [(*colour, 0.0)] * count, [(*colour, 1.0)] * count)
    return pieces + _face(corners[list(FRONT)], colour) if filled else pieces


def _face(loop, colour):
    """A quadrilateral as a grid of patches."""
    a, b, d = loop[0], loop[1] - loop[0], loop[3] - loop[0]
    s = np.linspace(0, 1, CUTS // 2 + 1)
    grid = a + s[:, None, None] * b + s[None, :, None] * d
    patches = [
        np.array([grid[i, j], grid[i + 1, j], grid[i + 1, j + 1], grid[i, j + 1]])
        for i in range(CUTS // 2)
        for j in range(CUTS // 2)
    ]
    count = len(patches)
    return Pieces(patches, [(*colour, 0.35)] * count, [(*colour, 0.0)] * count)
