"""Pictures of `tdf evaluate`: reconstructed shapes, and estimated poses of places."""

import dataclasses
from collections.abc import Sequence

import matplotlib
import numpy as np
from jaxtyping import Float
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from mpl_toolkits.mplot3d.axes3d import Axes3D

from tdf_jax.viz import polygons3d
from tdf_jax.viz.style import CENTIMETRES, ESTIMATE, INK, LIGHT, STYLE, TRUTH, add_axes3d, blank_figure, set_view

VIEW = {"elev": 28.0, "azim": -55.0}  # shows the inside of a cup, and its handle to the right
PIECES = 25  # longest edge of a drawn triangle, as a part of the diagonal; see `solid`
COLUMNS = 5
PANEL, WORDS, MARGIN = 1.7, 0.45, 0.35  # inches: edge of a panel, height of the words above it, and around all
ZOOM = 1.6814  # an orthographic panel of this zoom shows exactly the span of the axes' limits
BAR = 0.05  # metres, the scale bar


@dataclasses.dataclass(frozen=True)
class Panel:
    """One object to draw, in its canonical frame.

    Attributes:
        name: name of the object.
        overlap: words about the reconstruction.
        error: words about the estimated place.
        triangles: true surface, (faces, 3, 3), metres.
        reconstructed: reconstructed surface, (others, 3, 3), metres; it may have no triangle.
        T_object_true: true frame of the place, 4x4.
        T_object_estimate: estimated frame of the place, 4x4.
        size: edge of the box of query points, metres.
    """

    name: str
    overlap: str
    error: str
    triangles: Float[np.ndarray, "faces 3 3"]
    reconstructed: Float[np.ndarray, "others 3 3"]
    T_object_true: Float[np.ndarray, "4 4"]
    T_object_estimate: Float[np.ndarray, "4 4"]
    size: float


def reconstruction_figure(panels: Sequence[Panel], title: str = "") -> Figure:
    """The true surface of every object above its reconstruction, all at one scale.

    Args:
        panels: the objects.
        title: title above the panels.
    """
    contents = [np.concatenate([panel.triangles, panel.reconstructed]).reshape(-1, 3) for panel in panels]
    edge = _edge(contents)
    with matplotlib.rc_context(STYLE):
        figure = _figure(len(panels), 2, title, edge)
        for index, (panel, content) in enumerate(zip(panels, contents)):
            for row, (label, triangles) in enumerate(
                {"true": panel.triangles, "reconstructed": panel.reconstructed}.items()
            ):
                axes = _axes(figure, index, 2, row, label)
                _draw(axes, _surface(triangles), content, edge)
                if not len(triangles):
                    axes.text2D(0.5, 0.5, "empty", ha="center", transform=axes.transAxes)
            _name(figure, index, 2, f"{panel.name}\n{panel.overlap}")
    return figure


def transfer_figure(panels: Sequence[Panel], title: str = "") -> Figure:
    """Every object with the box of query points at the true place, dashed, and at the estimated place, at one scale.

    Args:
        panels: the objects.
        title: title above the panels.
    """
    true = [_corners(panel.T_object_true, panel.size) for panel in panels]
    estimated = [_corners(panel.T_object_estimate, panel.size) for panel in panels]
    contents = []
    for panel, *boxes in zip(panels, true, estimated):
        low, high = panel.triangles.min(axis=(0, 1)), panel.triangles.max(axis=(0, 1))
        reach = (high - low).max()  # a box beyond this is cut off, so that it does not make the other objects small
        contents.append(
            np.concatenate([panel.triangles.reshape(-1, 3), np.clip(np.concatenate(boxes), low - reach, high + reach)])
        )
    edge = _edge(contents)
    with matplotlib.rc_context(STYLE):
        figure = _figure(len(panels), 1, title, edge)
        for index, panel in enumerate(panels):
            pieces = _surface(panel.triangles)
            pieces += polygons3d.box(CENTIMETRES * true[index], TRUTH, filled=False, dashed=True)
            pieces += polygons3d.box(CENTIMETRES * estimated[index], ESTIMATE)
            _draw(_axes(figure, index, 1, 0, ""), pieces, contents[index], edge)
            _name(figure, index, 1, f"{panel.name}\n{panel.error}")
        lines = [Line2D([], [], color=TRUTH, ls=(0, (3, 2))), Line2D([], [], color=ESTIMATE)]
        words = ["true query box", "estimated; the filled face is +x"]
        figure.legend(lines, words, loc="lower right", ncols=2, frameon=False, bbox_to_anchor=(1.0, 0.0))
    return figure


def _figure(count: int, rows: int, title: str, edge: float) -> Figure:
    """An empty figure for blocks of `COLUMNS` objects below each other, with a title and a scale bar."""
    blocks = -(-count // COLUMNS)
    width = max(2 * MARGIN + min(COLUMNS, count) * PANEL, 5.2)
    height = 2 * MARGIN + blocks * (WORDS + rows * PANEL)
    figure = blank_figure(width, height)
    figure.suptitle(title, y=1 - 0.1 / height, va="top")
    x, y, length = 0.2 / width, 0.17 / height, BAR / edge * PANEL / width
    figure.add_artist(Line2D([x, x + length], [y, y], color=INK, lw=2, solid_capstyle="butt"))
    figure.text(x + length + 0.08 / width, y, f"{CENTIMETRES * BAR:.0f} cm", va="center")
    return figure


def _corner(figure: Figure, index: int, rows: int) -> tuple[float, float]:
    """The left and upper edge of the panels of an object, inches from the lower left."""
    block, column = divmod(index, COLUMNS)
    return MARGIN + column * PANEL, figure.get_figheight() - MARGIN - WORDS - block * (WORDS + rows * PANEL)


def _name(figure: Figure, index: int, rows: int, words: str) -> None:
    x, y = _corner(figure, index, rows)
    figure.text(
        (x + PANEL / 2) / figure.get_figwidth(), (y + 0.04) / figure.get_figheight(), words, ha="center", va="bottom"
    )


def _axes(figure: Figure, index: int, rows: int, row: int, label: str) -> Axes3D:
    x, y = _corner(figure, index, rows)
    y -= (row + 1) * PANEL
    width, height = figure.get_figwidth(), figure.get_figheight()
    if label and index % COLUMNS == 0:
        figure.text((x - 0.12) / width, (y + PANEL / 2) / height, label, rotation=90, va="center", ha="center")
    return add_axes3d(figure, (x / width, y / height, PANEL / width, PANEL / height))


def _surface(triangles) -> polygons3d.Pieces:
    """Shaded pieces, in centimetres, cut small enough that matplotlib paints them in the right order."""
    from trimesh.remesh import subdivide_to_size

    if not len(triangles):
        return polygons3d.Pieces([], [], [])
    corners = triangles.reshape(-1, 3)
    longest = np.linalg.norm(np.ptp(corners, axis=0)) / PIECES
    vertices, faces = subdivide_to_size(corners, np.arange(len(corners)).reshape(-1, 3), longest, max_iter=20)[:2]
    return polygons3d.surface(CENTIMETRES * vertices[faces], LIGHT)


def _corners(T, size):
    return size * (polygons3d.CORNERS - 0.5) @ T[:3, :3].T + T[:3, 3]


def _across() -> np.ndarray:
    """The directions to the right and up in the view, (2, 3)."""
    up, around = np.radians(VIEW["elev"]), np.radians(VIEW["azim"])
    return np.array([
        [-np.sin(around), np.cos(around), 0.0],
        [-np.sin(up) * np.cos(around), -np.sin(up) * np.sin(around), np.cos(up)],
    ])  # fmt: skip


def _edge(contents) -> float:
    """Edge of the square that the largest content fills, metres."""
    return 1.04 * max(float(np.ptp(content @ _across().T, axis=0).max()) for content in contents)


def _draw(axes: Axes3D, pieces: polygons3d.Pieces, content, edge: float) -> None:
    if pieces.polygons:
        axes.add_collection3d(pieces.collection(), autolim=False)
    seen = content @ _across().T
    middle = (seen.min(axis=0) + seen.max(axis=0)) / 2 @ _across()
    for name, at in zip("xyz", middle):
        getattr(axes, f"set_{name}lim")(CENTIMETRES * (at - edge / 2), CENTIMETRES * (at + edge / 2))
    axes.set_proj_type("ortho")
    set_view(axes, (1, 1, 1), ZOOM, VIEW)
    axes.set_axis_off()
    axes.patch.set_visible(False)
