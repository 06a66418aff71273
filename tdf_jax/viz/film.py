"""The frames of a film of an imitation: demonstration and imitation side by side, while the object is carried."""

from collections.abc import Iterator

import matplotlib
import numpy as np
from jaxtyping import UInt8
from matplotlib.backends.backend_agg import FigureCanvasAgg

from tdf_jax.solvers.imitation_scene import ImitationScene
from tdf_jax.viz import polygons3d
from tdf_jax.viz.scene3d import bounds, frame, thinned, triangles_of
from tdf_jax.viz.sides import Side, sides_of, sizes_of
from tdf_jax.viz.style import CENTIMETRES, CLOUD, COLOURS, INK, LIGHT, STYLE, add_axes3d, blank_figure

WIDTH, HEIGHT, DPI = 6.4, 3.6, 100  # inches, and pixels of an inch
FRAMES, RATE = 48, 12.0  # of a film, and shown a second
HOLD = 10  # frames that the last one stays


def film_frames(scene: ImitationScene, frames: int = FRAMES) -> Iterator[UInt8[np.ndarray, "height width 3"]]:
    """Draw the frames one after the other.

    Args:
        scene: the imitation.
        frames: number of frames from the first pose to the last.

    Yields:
        Pictures, (height, width, 3), red, green and blue from 0 to 255.
    """
    box = bounds(np.asarray(scene.demonstration.query))
    sides = sides_of(scene, np.linspace(0, 1, frames))
    triangles = [triangles_of(side.mesh) for side in sides]
    contents = [side.content(box) for side in sides]
    sizes = sizes_of(scene, contents)
    for number in range(frames):
        with matplotlib.rc_context(STYLE):
            figure = blank_figure(WIDTH, HEIGHT)
            for column, side in enumerate(sides):
                axes = add_axes3d(figure, (0.5 * column + 0.01, 0.04, 0.45, 0.86))
                _draw(axes, side, number, triangles[column], box)
                frame(axes, contents[column], sizes[column])
                axes.set_title(side.name, y=0.99)
        canvas = FigureCanvasAgg(figure)
        figure.set_dpi(DPI)
        canvas.draw()
        picture = np.asarray(canvas.buffer_rgba())[..., :3].copy()
        yield from [picture] * (1 if number < frames - 1 else HOLD)


def _draw(axes, side: Side, number: int, triangles: np.ndarray | None, box: np.ndarray) -> None:
    motion = side.motion
    R, t = motion.object_rotations[number], motion.object_translations[number]
    axes.computed_zorder = False
    pieces = polygons3d.Pieces([], [], [])
    if triangles is None:
        axes.scatter(*(CENTIMETRES * (thinned(side.points) @ R.T + t).T), s=2.0, color=COLOURS(0.0), linewidths=0)
    else:
        pieces += polygons3d.surface(CENTIMETRES * (triangles @ R.T + t), LIGHT)
    if side.target is not None:
        axes.scatter(*(CENTIMETRES * thinned(side.target).T), s=2.0, color=CLOUD, linewidths=0)
    corners = box @ motion.rotations[number].T + motion.translations[number]
    pieces += polygons3d.box(CENTIMETRES * corners, COLOURS(0.35))
    axes.add_collection3d(pieces.collection(), autolim=False)
    axes.plot(*(CENTIMETRES * side.path[:, 4:].T), color=INK, lw=1.0, marker="o", ms=2.0, zorder=6)
