"""The frames of a film of an imitation: demonstration and imitation side by side, while the object is carried."""

from collections.abc import Iterator

import matplotlib
import numpy as np
from jaxtyping import UInt8
from matplotlib.backends.backend_agg import FigureCanvasAgg

from tdf_jax.solvers.imitation_scene import ImitationScene
from tdf_jax.viz import polygons3d
from tdf_jax.viz.motion import Motion, motion_of
from tdf_jax.viz.scene3d import bounds, frame, thinned, triangles_of
from tdf_jax.viz.style import CENTIMETRES, CLOUD, COLOURS, INK, LIGHT, STYLE, add_axes3d, blank_figure

WIDTH, HEIGHT, DPI = 6.4, 3.6, 100  # inches, and pixels of an inch
FRAMES, RATE = 48, 12.0  # of a film, and shown a second
HOLD = 10  # frames that the last one stays
MARGIN = 1.06  # length of the axes, in that of their contents


def film_frames(scene: ImitationScene, frames: int = FRAMES) -> Iterator[UInt8[np.ndarray, "height width 3"]]:
    """Draw the frames one after the other.

    Args:
        scene: the imitation.
        frames: number of frames from the first pose to the last.

    Yields:
        Pictures, (height, width, 3), red, green and blue from 0 to 255.
    """
    demonstration, result = scene.demonstration, scene.result
    box = bounds(np.asarray(demonstration.query))
    shown, found = np.asarray(demonstration.trajectory.wxyz_xyz), np.asarray(result.trajectory.wxyz_xyz)
    share = np.linspace(0, 1, frames)
    target = demonstration.target
    stands = None if target is None else np.asarray(target.points)
    sides = [
        (
            "demonstration",
            motion_of(shown, demonstration.grasp, demonstration.release, share * (len(shown) - 1)),
            (np.asarray(demonstration.points), triangles_of(scene.meshes[0]), stands, shown),
        ),
        (
            "imitation",
            motion_of(found, result.grasp, result.release, share * (len(found) - 1)),
            (
                scene.points,
                triangles_of(scene.meshes[1]),
                stands if scene.target_points is None else np.asarray(scene.target_points),
                found,
            ),
        ),
    ]
    contents = [_content(motion, parts, box) for _, motion, parts in sides]
    sizes = [MARGIN * np.ptp(content, axis=0) for content in contents]
    if target is None:  # a way of a metre to a target is drawn as large as possible
        sizes = [np.max(sizes, axis=0)] * 2
    for number in range(frames):
        with matplotlib.rc_context(STYLE):
            figure = blank_figure(WIDTH, HEIGHT)
            for column, (name, motion, parts) in enumerate(sides):
                axes = add_axes3d(figure, (0.5 * column + 0.01, 0.04, 0.45, 0.86))
                _draw(axes, motion, number, parts, box)
                frame(axes, contents[column], sizes[column])
                axes.set_title(name, y=0.99)
        canvas = FigureCanvasAgg(figure)
        figure.set_dpi(DPI)
        canvas.draw()
        picture = np.asarray(canvas.buffer_rgba())[..., :3].copy()
        yield from [picture] * (1 if number < frames - 1 else HOLD)


def _content(motion: Motion, parts: tuple, box: np.ndarray) -> np.ndarray:
    """All that is shown in any frame, (points, 3), metres."""
    points, _, target, path = parts
    moved = np.einsum("fij,nj->fni", motion.object_rotations, thinned(points)) + motion.object_translations[:, None]
    boxes = np.einsum("fij,nj->fni", motion.rotations, box) + motion.translations[:, None]
    found = [moved.reshape(-1, 3), boxes.reshape(-1, 3), path[:, 4:]]
    return np.concatenate(found if target is None else [*found, target])


def _draw(axes, motion: Motion, number: int, parts: tuple, box: np.ndarray) -> None:
    points, triangles, target, path = parts
    R, t = motion.object_rotations[number], motion.object_translations[number]
    axes.computed_zorder = False
    pieces = polygons3d.Pieces([], [], [])
    if triangles is None:
        axes.scatter(*(CENTIMETRES * (thinned(points) @ R.T + t).T), s=2.0, color=COLOURS(0.0), linewidths=0)
    else:
        pieces += polygons3d.surface(CENTIMETRES * (triangles @ R.T + t), LIGHT)
    if target is not None:
        axes.scatter(*(CENTIMETRES * thinned(target).T), s=2.0, color=CLOUD, linewidths=0)
    corners = box @ motion.rotations[number].T + motion.translations[number]
    pieces += polygons3d.box(CENTIMETRES * corners, COLOURS(0.35))
    axes.add_collection3d(pieces.collection(), autolim=False)
    axes.plot(*(CENTIMETRES * path[:, 4:].T), color=INK, lw=1.0, marker="o", ms=2.0, zorder=6)
