"""The interactive page of an energy landscape."""

import os
from typing import Any

import matplotlib.colors
import numpy as np

from tdf_jax.landscape.storage import Landscape
from tdf_jax.viz import polygons3d
from tdf_jax.viz.landscapes import LEVELS, SEE_THROUGH, SURFACES, Marks, check_landscape, isosurface, path_lines
from tdf_jax.viz.page import Page, camera, page_of, pages, scene_axes
from tdf_jax.viz.scene3d import thinned
from tdf_jax.viz.style import CENTIMETRES, CLOUD, INK, VIEW

DISTANCE = 2.2  # of the camera, in the size of the scene


def save_landscape_page(path: str | os.PathLike, landscape: Landscape, marks: Marks, title: str = "") -> None:
    """Write an interactive .html page of a landscape that opens without a network.

    A plane is drawn as a surface of energies, a volume as surfaces of equal energy.

    Args:
        path: the file, in an existing folder; it appears only once it is complete.
        landscape: landscape of a grid with two or three axes, in one orientation or the best of several.
        marks: marks on the landscape.
        title: title of the page.

    Raises:
        InputError: the grid has one axis, the landscape keeps every rotation, plotly (or, for a volume, libigl) is not
            installed, the page would be too large to pass on, or the file cannot be written.
    """
    landscape_page("save_landscape_page()", landscape, marks, title).save(path)


def landscape_page(function: str, landscape: Landscape, marks: Marks, title: str = "") -> Page:
    """The page of a landscape; see `save_landscape_page`.

    Args:
        function: name that error messages begin with.
        landscape: landscape of a grid with two or three axes, in one orientation or the best of several.
        marks: marks on the landscape.
        title: title of the page.

    Raises:
        InputError: the grid has one axis, the landscape keeps every rotation, plotly (or, for a volume, libigl) is not
            installed, or the page would be too large to pass on.
    """
    plotly = pages(function)
    grid = landscape.grid
    check_landscape(function.removesuffix("()"), landscape, axes=len(grid.shape) if len(grid.shape) > 1 else 2)
    energy, points = landscape.combined, CENTIMETRES * grid.points
    scale = {"colorscale": "Viridis", "colorbar": {"title": "energy"}}
    if energy.ndim == 2:
        x, y, z = np.moveaxis(points, -1, 0)
        drawn: list[Any] = [plotly.Surface(x=x, y=y, z=z, surfacecolor=energy, opacity=0.85, name="energy", **scale)]
    else:
        drawn = []
        # plotly draws surfaces of equal energy for grids along its own axes only.
        for share, colour in zip(LEVELS, SURFACES):
            x, y, z = CENTIMETRES * isosurface(landscape, share).reshape(-1, 3).T
            i, j, k = np.arange(len(x)).reshape(-1, 3).T
            name = f"energy {np.nanquantile(energy, share):.4f}: least {100 * share:.0f} %"
            look = {"color": matplotlib.colors.to_hex(colour), "opacity": SEE_THROUGH, "name": name, "showlegend": True}
            drawn.append(plotly.Mesh3d(x=x, y=y, z=z, i=i, j=j, k=k, **look))
    if marks.mesh is not None:
        x, y, z = CENTIMETRES * np.asarray(marks.mesh.vertices).T
        i, j, k = np.asarray(marks.mesh.faces).T
        drawn.append(
            plotly.Mesh3d(
                x=x,
                y=y,
                z=z,
                i=i,
                j=j,
                k=k,
                color=matplotlib.colors.to_hex(tuple(polygons3d.SURFACE_COLOUR)),
                name="object",
                showlegend=True,
            )
        )
    else:
        x, y, z = CENTIMETRES * thinned(marks.points).T
        drawn.append(
            plotly.Scatter3d(x=x, y=y, z=z, mode="markers", marker={"size": 1.5, "color": CLOUD}, name="object")
        )
    for line, style in path_lines(landscape, marks, CLOUD):
        x, y, z = CENTIMETRES * line.T
        mode = "markers" if style.get("ls") == "" else "lines+markers"
        look = {"line": {"color": style["color"], "width": 5}, "marker": {"size": 3, "color": style["color"]}}
        drawn.append(plotly.Scatter3d(x=x, y=y, z=z, mode=mode, name=style["label"], **look))
    figure = plotly.Figure(drawn)
    content = marks.points if marks.mesh is None else marks.mesh.vertices
    lines = [CENTIMETRES * line for line, _ in path_lines(landscape, marks, CLOUD)]
    shown = np.concatenate([points.reshape(-1, 3), CENTIMETRES * np.asarray(content), *lines])
    margin = 0.03 * np.ptp(shown, axis=0)  # plotly cuts what lies on the end of an axis
    scene = scene_axes(shown.min(axis=0) - margin, shown.max(axis=0) + margin) | {"camera": camera(VIEW, DISTANCE)}
    legend = {"orientation": "h", "x": 0, "y": 0, "yanchor": "top", "itemsizing": "constant"}
    font = {"color": INK, "size": 13}
    figure.update_layout(scene=scene, legend=legend, font=font, margin={"l": 0, "r": 0, "b": 0, "t": 0})
    return page_of(function, figure, title)
