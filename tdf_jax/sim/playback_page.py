"""The page of an episode: the robot, the object and the target as they moved, to turn and to play in a browser."""

import os
from typing import Any

import matplotlib.colors
import numpy as np
from jaxtyping import Float

from tdf_jax.sim.playback import RATE, Playback
from tdf_jax.sim.solids import Solid
from tdf_jax.sim.workcell import OBJECT, TABLE_NAME, TARGET
from tdf_jax.viz.page import Page, camera, listed, page_of, pages, scene_axes
from tdf_jax.viz.style import CENTIMETRES, COLOURS, INK, VIEW

EVERY = 2  # of the frames that are kept, one is on the page
MOST_FRAMES = 400
LOWEST = -0.2  # metres, below which nothing is shown: an object may fall from the table
DISTANCE = 2.15  # of the camera, in the size of the scene


def save_playback_page(path: str | os.PathLike, playback: Playback) -> None:
    """Write an episode as an .html page that opens without a network: to turn, with a time slider and play.

    Args:
        path: the file, in an existing folder; it appears only once it is complete.
        playback: the episode.

    Raises:
        InputError: plotly is not installed, the page would be too large to pass on, or the file cannot be written.
    """
    episode_page("save_playback_page()", playback).save(path)


def episode_page(function: str, playback: Playback) -> Page:
    """The page of an episode; see `save_playback_page`.

    Args:
        function: name that error messages begin with.
        playback: the episode.

    Raises:
        InputError: plotly is not installed, or the page would be too large to pass on.
    """
    plotly = pages(function)
    every = max(EVERY, -(-len(playback.times) // MOST_FRAMES))
    frames = np.unique([*range(0, len(playback.times), every), len(playback.times) - 1])
    poses = playback.wxyz_xyz[frames]
    drawn: list[Any] = []
    moving: list[dict] = []
    for name, solids in _groups(playback.solids).items():
        parts = [_part(one, poses[:, playback.bodies.index(one.body)]) for one in solids]
        corners = np.concatenate([_placed(part, 0) for part in parts])
        offsets = np.cumsum([0, *(len(one.vertices) for one in solids)])
        i, j, k = np.concatenate([one.faces + first for one, first in zip(solids, offsets)]).T
        label = name if name in (OBJECT, TARGET, TABLE_NAME) else "robot"
        first = label not in [one.name for one in drawn]
        look = {"color": matplotlib.colors.to_hex(solids[0].colour), "hoverinfo": "skip"}
        look |= {
            "lighting": {"ambient": 0.55, "diffuse": 0.7, "specular": 0.1},
            "flatshading": all(one.angular for one in solids),
        }
        shares = {"name": label, "legendgroup": label, "showlegend": first}
        drawn.append(plotly.Mesh3d(**_axes(corners), i=i, j=j, k=k, **look, **shares))
        if any(len(np.unique(part["poses"], axis=0)) > 1 for part in parts):
            moving.append({"trace": len(drawn) - 1, "parts": [_moving(part) for part in parts]})
    if len(playback.points):
        marker = {"size": 1.8, "color": matplotlib.colors.to_hex(COLOURS(0.0))}
        shares = {"name": "cloud of the object at the start", "visible": "legendonly"}
        drawn.append(plotly.Scatter3d(**_axes(playback.points), mode="markers", marker=marker, **shares))
    if len(playback.path):
        look = {"mode": "lines", "line": {"color": INK, "width": 4}}
        drawn.append(plotly.Scatter3d(**_axes(playback.path[:, 4:]), name="imitated path of the gripper", **look))
    figure = plotly.Figure(drawn)
    low, high = _room(playback)
    legend = {"orientation": "h", "x": 0, "y": 0, "yanchor": "top", "itemsizing": "constant"}
    figure.update_layout(
        scene=scene_axes(CENTIMETRES * low, CENTIMETRES * high) | {"camera": camera(VIEW, DISTANCE)},
        legend=legend,
        margin={"l": 0, "r": 0, "b": 0, "t": 0},
        font={"color": INK, "size": 13},
    )
    motion = {
        "labels": [f"{playback.times[frame]:.1f} s, {playback.phase(int(frame))}" for frame in frames],
        "rate": RATE / every,
        "moving": moving,
    }
    return page_of(function, figure, playback.title, _lead(playback), motion)


def _groups(solids: tuple[Solid, ...]) -> dict[str, list[Solid]]:
    """Surfaces of one colour together, those of the robot by their colour: a trace each takes long to move."""
    groups: dict[str, list[Solid]] = {}
    for one in solids:
        name = one.body if one.body in (OBJECT, TARGET, TABLE_NAME) else matplotlib.colors.to_hex(one.colour)
        groups.setdefault(name, []).append(one)
    return groups


def _part(solid: Solid, poses: Float[np.ndarray, "frames 7"]) -> dict[str, np.ndarray]:
    """Points of a surface in its body's frame, metres, and for each frame its rotation and translation.

    What is not there shrinks to the point where it is first.
    """
    from scipy.spatial.transform import Rotation

    there = np.asarray(np.isfinite(poses).all(axis=1))
    R = np.zeros((len(poses), 3, 3))
    if there.any():
        R[there] = Rotation.from_quat(poses[there, :4], scalar_first=True).as_matrix()
    t = np.where(there[:, None], poses[:, 4:], poses[np.argmax(there), 4:] if there.any() else 0.0)
    return {"points": solid.vertices, "R": R, "t": t, "poses": np.nan_to_num(poses, nan=9.0)}


def _placed(part: dict[str, np.ndarray], frame: int) -> np.ndarray:
    return part["points"] @ part["R"][frame].T + part["t"][frame]


def _moving(part: dict[str, np.ndarray]) -> dict:
    """A part in the types and the unit of the page."""
    motions = [[listed(R, 4), listed(CENTIMETRES * t, 2)] for R, t in zip(part["R"], part["t"])]
    return {"points": listed(CENTIMETRES * part["points"].T, 2), "motions": motions}


def _axes(points: np.ndarray) -> dict[str, list]:
    return dict(zip("xyz", listed(CENTIMETRES * np.asarray(points, float).T, 2)))


def _room(playback: Playback) -> tuple[np.ndarray, np.ndarray]:
    """The least and the largest coordinates of what is shown in any frame, metres."""
    found = []
    for one in playback.solids:
        poses = playback.wxyz_xyz[:, playback.bodies.index(one.body)]
        poses = poses[np.isfinite(poses).all(axis=1)]
        part = _part(Solid(one.body, one.vertices[::7], one.faces, one.colour), poses[:: max(1, len(poses) // 40)])
        found += [_placed(part, frame) for frame in range(len(part["t"]))]
    points = np.concatenate(found)
    points = points[points[:, 2] > LOWEST]
    return points.min(axis=0) - 0.02, points.max(axis=0) + 0.02


def _lead(playback: Playback) -> str:
    about = playback.about
    lines = [
        f"{about['method']}, {about['clouds']} clouds, target {about['target']}, starts {about['poses']}. "
        f"{playback.verdict[0].upper()}{playback.verdict[1:]}."
    ]
    lines.append("Drag to turn, scroll to zoom; a click in the legend shows or hides.")
    return "\n".join(lines)
