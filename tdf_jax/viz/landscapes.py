"""Pictures of energy landscapes: maps of planes, and surfaces of equal energy and animated slices of volumes."""

import dataclasses
import io
import os
from typing import TYPE_CHECKING, Any, cast

import matplotlib
import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from PIL import Image

from tdf_jax._internal.errors import InputError
from tdf_jax._internal.files import replace_file
from tdf_jax.geometry.winding import libigl
from tdf_jax.landscape.storage import Landscape
from tdf_jax.viz import polygons3d
from tdf_jax.viz.scene3d import thinned
from tdf_jax.viz.style import (
    CENTIMETRES,
    CLOUD,
    COLOURS,
    INK,
    LIGHT,
    MARKED,
    STYLE,
    TRUTH,
    VIEW,
    WAYPOINTS,
    add_axes3d,
    blank_figure,
    legend_of,
    set_view,
)

if TYPE_CHECKING:
    import trimesh

COLUMNS = 4
PANEL = 1.75  # edge of a panel, inches
CONTOURS = 12
NEAR = 1.5  # steps of the grid; points of an object within this distance of the plane are drawn on a map
LEVELS = (0.02, 0.10)  # shares of a volume inside its surfaces of equal energy
SURFACES = COLOURS(0.15), COLOURS(0.75)
SEE_THROUGH = 0.30
MAX_PANELS = 24  # waypoints on a map; more waypoints are subsampled evenly
FRAMES_A_SECOND = 8
GIF_DPI = 100


@dataclasses.dataclass(frozen=True)
class Marks:
    """Marks on a landscape, metres, world frame.

    Attributes:
        points: cloud of the object, (points, 3).
        mesh: surface of the object, if known; volumes show it instead of the points.
        expected: true waypoints, (poses, 3), if known.
        path: lowest-cost path, (corners, 3), if there is one.
    """

    points: Float[np.ndarray, "points 3"]
    mesh: "trimesh.Trimesh | None" = None
    expected: Float[np.ndarray, "poses 3"] | None = None
    path: Float[np.ndarray, "corners 3"] | None = None


def map_figure(landscape: Landscape, marks: Marks, title: str = "") -> Figure:
    """A plane: the combined energy and that of every waypoint, with contours, minimisers and paths.

    Args:
        landscape: landscape of a grid with two axes, in one orientation or the best of several.
        marks: marks on the landscape.
        title: title above the picture.

    Raises:
        InputError: the grid has one or three axes, or the landscape keeps every rotation.
    """
    check_landscape("map_figure", landscape, axes=2)
    shown = np.unique(np.linspace(0, len(landscape.values) - 1, MAX_PANELS).round().astype(int))
    panels = {"all waypoints": landscape.combined} | {f"waypoint {index}": landscape.values[index] for index in shown}
    columns = min(COLUMNS, len(panels))
    rows = -(-len(panels) // columns)
    first, second = (CENTIMETRES * steps for steps in landscape.grid.coordinates)
    height = PANEL * (np.ptp(second) / np.ptp(first))
    low, high = np.nanmin(landscape.values), np.nanquantile(landscape.values, 0.99)
    with matplotlib.rc_context(STYLE):
        figure = blank_figure(PANEL * columns + 0.6, (height + 0.1) * rows + 0.9, layout="constrained")
        grid = figure.subplots(rows, columns, sharex=True, sharey=True, squeeze=False)
        for axes in grid.flat[len(panels) :]:
            axes.remove()
        for index, (axes, (name, energy)) in enumerate(zip(grid.flat, panels.items())):
            picture = _map(axes, first, second, energy, low, high)
            chosen = slice(None) if index == 0 else shown[index - 1 : index]
            _mark(axes, landscape, marks, chosen, whole=index == 0)
            axes.set_title(name)
        names = [_axis_name(direction) for direction in landscape.grid.directions]
        for index in range(len(panels)):
            if index + columns >= len(panels):
                grid.flat[index].set_xlabel(f"{names[0]} from the middle (cm)")
            if index % columns == 0:
                grid.flat[index].set_ylabel(f"{names[1]} from the middle (cm)")
        figure.colorbar(picture, ax=list(grid.flat[: len(panels)]), label="energy (no unit)", shrink=0.8, pad=0.01)
        legend = legend_of(grid[0, 0])
        figure.legend(
            legend.values(),
            legend.keys(),
            loc="outside lower center",
            ncols=4,
            facecolor=COLOURS(0.45),
            labelcolor="white",
        )
        figure.suptitle(title)
    return figure


def map_panel(axes: Axes, landscape: Landscape, marks: Marks) -> None:
    """Draw the combined energy on given axes: of a plane, or of the middle slice of a volume along its last axis.

    Args:
        axes: plane axes of matplotlib.
        landscape: landscape of a grid with two or three axes, in one orientation or the best of several.
        marks: marks on the landscape; on a slice of a volume, there are none.
    """
    shape = landscape.grid.shape
    check_landscape("map_panel", landscape, axes=3 if len(shape) == 3 else 2)
    energy = landscape.combined if len(shape) == 2 else landscape.combined[..., shape[2] // 2]
    first, second = (CENTIMETRES * steps for steps in landscape.grid.coordinates[:2])
    low, high = np.nanmin(energy), np.nanquantile(energy, 0.99)
    picture = _map(axes, first, second, energy, low, high)
    if len(shape) == 2:
        _mark(axes, landscape, marks, slice(None), whole=True)
    names = [_axis_name(direction) for direction in landscape.grid.directions]
    axes.set(xlabel=f"{names[0]} from the middle (cm)", ylabel=f"{names[1]} from the middle (cm)")
    axes.figure.colorbar(picture, ax=axes, label="energy (no unit)", shrink=0.8)


def isosurface_figure(landscape: Landscape, marks: Marks, title: str = "") -> Figure:
    """A volume: surfaces around the lowest 2 % and 10 % of the combined energy, with the object and the paths.

    Args:
        landscape: landscape of a grid with three axes, in one orientation or the best of several.
        marks: marks on the landscape.
        title: title above the picture.

    Raises:
        InputError: the grid has one or two axes, the landscape keeps every rotation, or libigl is not installed.
    """
    check_landscape("isosurface_figure", landscape, axes=3)
    with matplotlib.rc_context(STYLE):
        figure = blank_figure(6.5, 5.6)
        axes = add_axes3d(figure, (0.0, 0.12, 1.0, 0.84))
        pieces = polygons3d.Pieces([], [], [])
        if marks.mesh is not None:
            pieces += polygons3d.surface(CENTIMETRES * np.asarray(marks.mesh.triangles), LIGHT)
        else:
            cloud, size = thinned(marks.points), cast(Any, 1.5)
            axes.scatter(*(CENTIMETRES * cloud.T), s=size, color=CLOUD, linewidths=0)
        for share, colour in zip(LEVELS, SURFACES):
            triangles = CENTIMETRES * isosurface(landscape, share)
            count = len(triangles)
            pieces += polygons3d.Pieces(
                list(triangles), [(*colour[:3], SEE_THROUGH)] * count, [(*colour[:3], 0.0)] * count
            )
            axes.plot(
                [], [], [], color=colour, lw=6, alpha=2 * SEE_THROUGH, label=f"least {100 * share:.0f} % of the volume"
            )
        axes.add_collection3d(pieces.collection())
        for points, style in path_lines(landscape, marks, CLOUD):
            axes.plot(*(CENTIMETRES * points.T), zorder=10, **style)
        first, second, third = (slice(None, None, count - 1) for count in landscape.grid.shape)
        corners = CENTIMETRES * landscape.grid.points[first, second, third]
        low, high = corners.reshape(-1, 3).min(axis=0), corners.reshape(-1, 3).max(axis=0)
        axes.set(
            xlim=(low[0], high[0]),
            ylim=(low[1], high[1]),
            zlim=(low[2], high[2]),
            xlabel="x (cm)",
            ylabel="y (cm)",
            zlabel="z (cm)",
        )
        set_view(axes, high - low, 1.1, VIEW)
        legend = legend_of(axes)
        figure.legend(legend.values(), legend.keys(), loc="lower center", ncols=3, frameon=False)
        figure.suptitle(title)
    return figure


def isosurface(landscape: Landscape, share: float) -> Float[np.ndarray, "faces 3 3"]:
    """A surface of equal combined energy, by marching cubes.

    Args:
        landscape: landscape of a volume.
        share: share of the points of the grid inside the surface; points outside the grid's mask do not count.

    Returns:
        Triangles, (faces, 3, 3), metres, world frame.
    """
    igl = libigl("isosurface()")
    energy = landscape.combined
    level = float(np.nanquantile(energy, share))
    # Points outside the mask get the highest energy, so that no surface is drawn there.
    values = np.nan_to_num(energy, nan=np.nanmax(energy)).astype(float)
    points = landscape.grid.points.transpose(2, 1, 0, 3).reshape(-1, 3)  # the first axis is the fastest for libigl
    nx, ny, nz = (int(count) for count in landscape.grid.shape)
    vertices, faces, _ = igl.marching_cubes(values.transpose(2, 1, 0).ravel(), points, nx, ny, nz, level)
    return np.asarray(vertices)[np.asarray(faces)].reshape(-1, 3, 3)


def save_slices(path: str | os.PathLike, landscape: Landscape, marks: Marks) -> None:
    """Write an animated .gif: the combined energy of a volume, slice by slice along its third axis.

    Args:
        path: the file, in an existing folder; it appears only once it is complete.
        landscape: landscape of a grid with three axes, in one orientation or the best of several.
        marks: marks on the landscape; each slice shows the points of the object near it.

    Raises:
        InputError: the grid has one or two axes, the landscape keeps every rotation, or the file cannot be written.
    """
    check_landscape("save_slices", landscape, axes=3)
    grid, energy = landscape.grid, landscape.combined
    first, second, heights = (CENTIMETRES * steps for steps in grid.coordinates)
    local = CENTIMETRES * (marks.points - grid.origin) @ grid.directions.T
    low, high = np.nanmin(energy), np.nanquantile(energy, 0.99)
    names = [_axis_name(direction) for direction in grid.directions]
    with matplotlib.rc_context(STYLE):
        figure = blank_figure(4.6, 4.2, layout="constrained")
        axes = figure.subplots()
        figure.colorbar(
            ScalarMappable(Normalize(low, high), COLOURS),
            ax=axes,
            label="energy (no unit)",
        )

        def draw(index):
            axes.clear()
            _map(axes, first, second, energy[:, :, index], low, high)
            near = np.abs(local[:, 2] - heights[index]) < NEAR * (heights[1] - heights[0])
            axes.scatter(*local[near, :2].T, s=3, color="white", linewidths=0)
            for points, style in path_lines(landscape, marks):
                place = CENTIMETRES * (points - grid.origin) @ grid.directions.T
                here = np.abs(place[:, 2] - heights[index]) < NEAR * (heights[1] - heights[0])
                axes.plot(*place[here, :2].T, **(style | {"ls": "", "marker": style.get("marker", ".")}))
            axes.set(
                xlabel=f"{names[0]} from the middle (cm)",
                ylabel=f"{names[1]} from the middle (cm)",
                title=f"{names[2]} {heights[index]:+.1f} cm from the middle",
            )

        frames = []
        for index in range(len(heights)):
            draw(index)
            figure.savefig(frame := io.BytesIO(), format="png", dpi=GIF_DPI)
            frames.append(Image.open(frame).convert("RGB"))
    show = {"save_all": True, "append_images": frames[1:], "duration": 1000 // FRAMES_A_SECOND, "loop": 0}
    replace_file("save_slices()", path, lambda file: frames[0].save(file, format="GIF", **show))


def check_landscape(function: str, landscape: Landscape, axes: int) -> None:
    """Check that a landscape can be drawn.

    Args:
        function: name that the error message begins with.
        landscape: the landscape.
        axes: number of axes that its grid must have.

    Raises:
        InputError: the grid has another number of axes, or the landscape keeps every rotation.
    """
    if len(landscape.grid.shape) != axes:
        raise InputError(f"{function}(): the grid has {len(landscape.grid.shape)} axes; expected {axes}")
    if landscape.turned is None:
        raise InputError(
            f"{function}(): the landscape keeps the energies of every rotation; expected those of the best, or of one"
        )


def _map(axes, first, second, energy, low, high):
    picture = axes.pcolormesh(
        first, second, energy.T, cmap=COLOURS, vmin=low, vmax=high, shading="nearest", rasterized=True
    )
    if np.isfinite(energy).any() and np.nanmax(energy) > low:
        axes.contour(
            first,
            second,
            energy.T,
            levels=np.linspace(low, high, CONTOURS + 1),
            colors="white",
            linewidths=0.3,
            alpha=0.7,
        )
    axes.set_aspect("equal")
    axes.set(xlim=(first[0], first[-1]), ylim=(second[0], second[-1]))
    return picture


def _mark(axes, landscape, marks, chosen, whole):
    """Draw the points of the object near the plane, the paths and the minimisers, projected onto the plane."""
    grid = landscape.grid

    def flat(points):
        return CENTIMETRES * ((points - grid.origin) @ grid.directions.T).T

    offsets = marks.points - grid.origin
    off = np.linalg.norm(offsets - (offsets @ grid.directions.T) @ grid.directions, axis=1)
    near = marks.points[off < max(NEAR * grid.steps.max(), 0.1 * off.max(initial=0.0))]
    axes.scatter(*flat(near), s=0.8, color="white", alpha=0.7, linewidths=0)
    if whole:
        if len(marks.points):
            axes.plot([], [], ".", color="white", ms=3, label="object's points near the plane")
        for points, style in path_lines(landscape, marks)[:-1]:
            axes.plot(*flat(points), **({"lw": 1.0, "ms": 3, "mec": INK, "mew": 0.4} | style))
    axes.plot(*flat(landscape.minimisers[chosen]), **({"ms": 5, "mew": 1.3} | _MINIMISERS))


_MINIMISERS: dict[str, Any] = {"ls": "", "marker": "x", "color": TRUTH, "label": "waypoints' minimisers"}


def path_lines(landscape: Landscape, marks: Marks, colour: str = "white") -> list[tuple[np.ndarray, dict[str, Any]]]:
    """The points and the line style of every path; the last one is that of the minimisers.

    Args:
        landscape: the landscape.
        marks: marks on the landscape.
        colour: colour of the demonstration.
    """
    lines: list[tuple[np.ndarray, dict[str, Any]]] = [
        (
            landscape.waypoints,
            {"color": colour, "marker": "o", "mec": INK, "label": "demonstration, moved with the centroid"},
        )
    ]
    if marks.expected is not None:
        lines.append((marks.expected, {"color": WAYPOINTS, "marker": "o", "mec": INK, "label": "true waypoints"}))
    if marks.path is not None:
        lines.append((marks.path, {"color": MARKED, "label": "lowest-cost path"}))
    return [*lines, (landscape.minimisers, _MINIMISERS)]


def _axis_name(direction):
    """The name of a direction: "x" or "-y" for an axis of the world, and "along (...)" for others."""
    axis = int(np.abs(direction).argmax())
    if np.isclose(abs(direction[axis]), 1, atol=1e-6):
        return ("-" if direction[axis] < 0 else "") + "xyz"[axis]
    return "along (" + ", ".join(f"{part:.2f}" for part in direction) + ")"
