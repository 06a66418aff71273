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
            axes.add_collection3d(surface(np.asarray(mesh.triangles) - mesh.bounds.mean(axis=0), LIGHT).collection())
            axes.set(xlim=(-half, half), ylim=(-half, half), zlim=(-half, half))
            set_view(axes, (1, 1, 1), 1.45, {"elev": 25, "azim": -60})
            axes.set_axis_off()
            axes.set_title(title, y=-0.12, va="top", fontsize=6)
        figure.subplots_adjust(left=0, right=1, bottom=0.07, top=1, wspace=0, hspace=0.12)
    return figure
