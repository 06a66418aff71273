"""An object that is placed on a target: the demonstration and its imitation, as in figure 4 of the paper."""

import dataclasses
import textwrap
from typing import Any

import jax.numpy as jnp
import matplotlib
import numpy as np
from jaxtyping import Array, Float
from matplotlib.colors import to_rgba
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from mpl_toolkits.mplot3d.axes3d import Axes3D

from tdf_jax._internal import checks
from tdf_jax._internal.errors import InputError
from tdf_jax.geometry import se3
from tdf_jax.geometry.demonstration import Demonstration
from tdf_jax.geometry.trajectory import Trajectory
from tdf_jax.solvers.result import Result
from tdf_jax.viz import polygons3d
from tdf_jax.viz.scene3d import MARGIN, WIDTH, bounds, frame, thinned
from tdf_jax.viz.style import CENTIMETRES, CLOUD, COLOURS, CONTACT, INK, STYLE, VIEW, add_axes3d, blank_figure, set_view

BEFORE, AFTER, TARGET = COLOURS(0.0), COLOURS(0.62), CLOUD
HEIGHT = 7.2  # inches
TITLE = 95  # characters of a line of the title
SIZE = 2.4  # of a square point, typographic points squared
ZOOM = 1.03, 0.93  # of the overviews, whose long boxes leave room, and of the close-ups
LABEL = -3.5  # points between ticks and the names of axes, which otherwise meet titles and the legend
CLOSE_UPS = {
    "demonstration": "demonstration, at the release",
    "imitation": "imitation, at the release, rotated as demonstrated",
}


@dataclasses.dataclass(frozen=True)
class _Side:
    """A demonstration or an imitation, metres, world frame.

    Attributes:
        before, after: cloud of the object in its initial pose and at the release, (points, 3).
        target: cloud of the target, (target_points, 3).
        path: poses from the pick to the release.
        contact_before, contact: contact points on the object in its initial pose, and at the release, (queries, 3).
    """

    before: np.ndarray
    after: np.ndarray
    target: np.ndarray
    path: Trajectory
    contact_before: np.ndarray
    contact: np.ndarray


def relation_figure(
    demonstration: Demonstration,
    points: Float[np.ndarray, "points 3"],
    result: Result,
    target_points: Float[np.ndarray, "target_points 3"] | None = None,
    *,
    candidate: int | None = None,
    title: str = "",
) -> Figure:
    """Demonstration and imitation side by side, above close-ups of the released object on its target.

    Both close-ups have the axes of the demonstration: the new target is rotated so that its contact region has the
    demonstrated orientation.

    Args:
        demonstration: the demonstration, with a target.
        points: cloud of the new object in its initial pose, (points, 3), metres, world frame.
        result: result of `imitate` on a target.
        target_points: cloud of the new target, (target_points, 3), metres, world frame; None if the demonstrated one
            has not moved.
        candidate: number of the candidate that is drawn; by default the best.
        title: title above the picture.

    Returns:
        The figure; its axes are those of the demonstration, the imitation, and their close-ups.

    Raises:
        InputError: the demonstration or the result has no target, or there is no such candidate.
    """
    target = demonstration.target
    if target is None or not len(result.target_trajectories):
        raise InputError(
            "relation_figure(): the demonstration or the result has no target; expected both with one, or "
            "imitation_figure"
        )
    best = int(result.best) if candidate is None else candidate
    number = checks.count("relation_figure()", "candidate", best, 0, len(result.energies) - 1)
    shown = _side(demonstration.points, target.points, demonstration.transfer, target.T_world_contact, target.query)
    poses = np.asarray(result.trajectories)[number, result.grasp : len(result.trajectories[0]) + result.release + 1]
    T_world_contact = np.asarray(result.target_trajectories)[number, 0]
    stands = target.points if target_points is None else target_points
    new = _side(points, stands, Trajectory(jnp.asarray(poses)), T_world_contact, target.query)
    # The close-up of the imitation is turned back to the demonstrated target.
    back = se3.compose(jnp.asarray(target.T_world_contact), se3.inverse(jnp.asarray(T_world_contact)))
    sides = {"demonstration": shown, "imitation": new}
    close = {"demonstration": shown, "imitation": _turned(new, back)}
    box = bounds(np.asarray(demonstration.query))
    with matplotlib.rc_context(STYLE):
        figure = blank_figure(WIDTH, HEIGHT)
        _row(figure, sides, (0.54, 0.395), box)
        _row(figure, close, (0.12, 0.355), None)
        _legend(figure)
        figure.suptitle(textwrap.fill(title, TITLE), y=0.995)
    return figure


def _side(points, target_points, path: Trajectory, T_world_contact, query) -> _Side:
    poses = jnp.asarray(path.wxyz_xyz)
    motion = se3.compose(poses[-1], se3.inverse(poses[0]))
    contact = se3.transform(jnp.asarray(T_world_contact), jnp.asarray(query))
    points = jnp.asarray(np.asarray(points))
    parts = (points, se3.transform(motion, points), target_points)
    before, after, target = (np.asarray(part) for part in parts)
    return _Side(
        before, after, target, path, np.asarray(se3.transform(se3.inverse(motion), contact)), np.asarray(contact)
    )


def _turned(side: _Side, motion: Float[Array, "7"]) -> _Side:
    moved = {
        name: np.asarray(se3.transform(motion, jnp.asarray(getattr(side, name))))
        for name in ("after", "target", "contact")
    }
    return dataclasses.replace(side, **moved)


def _row(figure: Figure, sides: dict[str, _Side], band: tuple[float, float], box: np.ndarray | None) -> None:
    """A panel for each side; close-ups have one scale, and no box of query points, no path and no initial pose."""
    contents = [_content(side, box) for side in sides.values()]
    sizes = [MARGIN * np.ptp(one, axis=0) for one in contents]
    for column, ((name, side), content, size) in enumerate(zip(sides.items(), contents, sizes)):
        axes = add_axes3d(figure, (0.5 * column + 0.02, band[0], 0.44, band[1]))
        _draw(axes, side, box)
        # A way of a metre between objects of a decimetre: each overview has a scale of its own, as large as possible.
        size = size if box is not None else np.max(sizes, axis=0)
        frame(axes, content, size, LABEL)
        set_view(axes, tuple(size), ZOOM[0] if box is not None else ZOOM[1], VIEW)
        words = name if box is not None else CLOSE_UPS[name]
        figure.text(0.5 * column + 0.24, band[0] + band[1] + 0.005, words, ha="center", va="bottom", fontsize=9)


def _content(side: _Side, box: np.ndarray | None) -> np.ndarray:
    if box is None:
        return np.concatenate([side.after, side.target])
    return np.concatenate([side.before, side.after, side.target, *_boxes(side.path, box), side.path.translations])


def _boxes(path: Trajectory, box: np.ndarray) -> list[np.ndarray]:
    """Corners of the box of query points at the pick and at the release."""
    return [np.asarray(se3.transform(pose, jnp.asarray(box))) for pose in path.wxyz_xyz[jnp.array([0, -1])]]


def _draw(axes: Axes3D, side: _Side, box: np.ndarray | None) -> None:
    parts = [(side.target, TARGET), (side.after, AFTER), (side.contact, CONTACT)]
    if box is not None:
        parts += [(side.before, BEFORE), (side.contact_before, CONTACT)]
    # One collection, because matplotlib paints the points of a collection from far to near, and one after the other.
    shown = [thinned(part) for part, _ in parts]
    colours = np.repeat([to_rgba(colour) for _, colour in parts], [len(one) for one in shown], axis=0)
    size: Any = SIZE if box is not None else 1.6 * SIZE
    axes.computed_zorder = False
    axes.scatter(*(CENTIMETRES * np.concatenate(shown).T), s=size, c=colours, linewidths=0, depthshade=False)
    if box is None:
        return
    pieces = polygons3d.Pieces([], [], [])
    for corners, colour in zip(_boxes(side.path, box), (BEFORE, AFTER)):
        pieces += polygons3d.box(CENTIMETRES * corners, colour)
    axes.add_collection3d(pieces.collection(), autolim=False)  # `frame` sets the limits
    path = CENTIMETRES * np.asarray(side.path.translations)
    axes.plot(*path.T, color=INK, lw=1.2, marker="o", ms=1.6, zorder=6)


def _legend(figure: Figure) -> None:
    def dots(colour, label):
        return Line2D([], [], color=colour, marker="s", ls="", ms=4, label=label)

    handles = [
        dots(BEFORE, "object in its initial pose, box of query points at the pick"),
        dots(AFTER, "object at the release, box of query points there"),
        dots(TARGET, "target"),
        dots(CONTACT, "contact points, on the object and on the target"),
        Line2D([], [], color=INK, lw=1.2, marker="o", ms=1.6, label="path of the query frame"),
    ]
    figure.legend(handles=handles, loc="lower center", ncols=2, frameon=False)
