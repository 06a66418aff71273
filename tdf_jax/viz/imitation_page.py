"""The page of an imitation: demonstration and imitation side by side, to turn and to play in a browser."""

import math
import os
from typing import Any

import jax.numpy as jnp
import matplotlib.colors
import numpy as np
from jaxtyping import Float

from tdf_jax.solvers.imitation_scene import ImitationScene
from tdf_jax.uncertainty.modes import Mode, cluster_poses
from tdf_jax.viz import polygons3d
from tdf_jax.viz.motion import motion_of
from tdf_jax.viz.page import Page, camera, listed, page_of, pages, scene_axes
from tdf_jax.viz.scene3d import MOST_TRIANGLES, bounds, thinned
from tdf_jax.viz.sides import Side, sides_of, sizes_of
from tdf_jax.viz.style import CENTIMETRES, CLOUD, COLOURS, CONTACT, INK, TRUTH, VIEW

RATE = 12  # frames a second
DISTANCE = 2.6  # of the camera, in the size of the scene
PICK, OTHERS = 0.35, (0.6, 0.95)  # places in the colour map: the pick, and the other distinct picks by rising energy
CLOUD_NAME = "cloud of the object"
SHOWN_MODES = 4  # distinct picks besides the best


def save_imitation_page(path: str | os.PathLike, scene: ImitationScene, title: str = "") -> None:
    """Write an imitation as an .html page that opens without a network: to turn, with a time slider and play.

    The legend lists the other distinct picks with their energies; a click on one shows it.

    Args:
        path: the file, in an existing folder; it appears only once it is complete.
        scene: the imitation.
        title: title of the page.

    Raises:
        InputError: plotly is not installed, the page would be too large to pass on, no candidate is finite, or the
            file cannot be written.
    """
    imitation_page("save_imitation_page()", scene, title).save(path)


def imitation_page(function: str, scene: ImitationScene, title: str = "") -> Page:
    """The page of an imitation; see `save_imitation_page`.

    Args:
        function: name that error messages begin with.
        scene: the imitation.
        title: title of the page.

    Raises:
        InputError: plotly is not installed, the page would be too large to pass on, or no candidate is finite.
    """
    plotly = pages(function)
    demonstration, result = scene.demonstration, scene.result
    box = bounds(np.asarray(demonstration.query))
    poses = len(result.trajectory.wxyz_xyz)
    index = np.linspace(0, 1, 6 * (max(demonstration.trajectory.num_poses, poses) - 1) + 1)
    panels = dict(zip(("scene", "scene2"), sides_of(scene, index)))
    drawn: list[Any] = []
    moving: list[dict] = []
    for name, panel in panels.items():
        _draw(plotly, drawn, moving, name, panel, box)
    if scene.expected is not None:
        _add_expected(plotly, drawn, np.asarray(scene.expected.wxyz_xyz), box, result.grasp)
    if len(result.target_trajectories):
        _add_contact_regions(plotly, drawn, scene)
    modes = distinct_picks(scene)
    for number, mode in enumerate(modes[1 : 1 + SHOWN_MODES], 2):
        share = np.interp(number, (2, 1 + SHOWN_MODES), OTHERS)
        corners = _lines(_placed(box, mode.pose))
        words = f"pick {number}: {_energy_name(scene)} {mode.energy:.5f}, {above(mode, modes[0])}"
        look = {"visible": "legendonly", "line": {"color": matplotlib.colors.to_hex(COLOURS(share)), "width": 4}}
        drawn.append(_line(plotly, corners, "scene2", words, **look))
    last = poses - 1
    motion = {
        "labels": [f"pose {last * share:.1f} of {last}, {_phase(last * share, result, last)}" for share in index],
        "rate": RATE,
        "moving": moving,
    }
    figure = plotly.Figure(drawn)
    # Ranges of all frames: otherwise the axes would move while it plays.
    contents = [CENTIMETRES * panel.content(box) for panel in panels.values()]
    sizes = sizes_of(scene, contents)
    layout: dict[str, Any] = {}
    for column, (name, content, size) in enumerate(zip(panels, contents, sizes)):
        middle = (content.min(axis=0) + content.max(axis=0)) / 2
        place = {"camera": camera(VIEW, DISTANCE), "domain": {"x": [0.5 * column, 0.5 * column + 0.49]}}
        layout[name] = scene_axes(middle - size / 2, middle + size / 2) | place
    titles = [
        {"text": text, "x": 0.245 + 0.5 * column, "y": 1.0, "xref": "paper", "yref": "paper", "showarrow": False}
        for column, text in enumerate(panel.name for panel in panels.values())
    ]
    legend = {"orientation": "h", "x": 0, "y": 0, "yanchor": "top", "itemsizing": "constant"}
    figure.update_layout(
        annotations=titles,
        legend=legend,
        margin={"l": 0, "r": 0, "b": 0, "t": 24},
        font={"color": INK, "size": 13},
        **layout,
    )
    return page_of(function, figure, title or "Imitation", _lead(scene, modes), motion)


def distinct_picks(scene: ImitationScene) -> list[Mode]:
    """The distinct picks of an imitation by rising energy; see `cluster_poses`."""
    return cluster_poses(jnp.asarray(scene.result.picks), jnp.asarray(scene.result.energies))


def above(mode: Mode, best: Mode) -> str:
    """How much higher the energy of a pick is than that of the best, in words."""
    if not best.energy > 0:
        return f"{mode.energy - best.energy:.5f} above the best"
    return f"{mode.energy / best.energy - 1:.0%} above the best".replace("%", " %")


def _draw(plotly, drawn: list, moving: list[dict], name: str, panel: Side, box: Float[np.ndarray, "8 3"]) -> None:
    first = name == "scene"
    motion = panel.motion
    if panel.target is not None:
        look = {"size": 1.6, "color": CLOUD}
        shares = {"scene": name, "name": "target", "legendgroup": "target", "showlegend": first}
        drawn.append(plotly.Scatter3d(**_axes(thinned(panel.target)), mode="markers", marker=look, **shares))
    shares = {"scene": name, "name": "object", "legendgroup": "object", "showlegend": first, "hoverinfo": "skip"}
    points = thinned(panel.points)
    marks = {"mode": "markers", "marker": {"size": 1.8, "color": matplotlib.colors.to_hex(COLOURS(0.0))}}
    mesh = panel.mesh if panel.mesh is not None and len(panel.mesh.faces) <= MOST_TRIANGLES else None
    if mesh is not None:
        vertices = np.asarray(mesh.vertices, float)
        i, j, k = np.asarray(mesh.faces).T
        colour = matplotlib.colors.to_hex(tuple(polygons3d.SURFACE_COLOUR))
        lighting = {"ambient": 0.55, "diffuse": 0.7, "specular": 0.1}
        drawn.append(plotly.Mesh3d(**_axes(vertices), i=i, j=j, k=k, color=colour, lighting=lighting, **shares))
        moving.append(_moving(drawn, vertices, motion.object_rotations, motion.object_translations))
    else:
        drawn.append(plotly.Scatter3d(**_axes(points), **marks, **shares))
        moving.append(_moving(drawn, points, motion.object_rotations, motion.object_translations))
    words = {"legendgroup": "path", "showlegend": first, "line": {"color": INK, "width": 4}}
    line = {"mode": "lines+markers", "marker": {"size": 2.5, "color": INK}}
    drawn.append(_line(plotly, panel.path[:, 4:], name, "path of the query frame", **words, **line))
    edges = _lines(box)
    start = edges @ motion.rotations[0].T + motion.translations[0]
    colour = matplotlib.colors.to_hex(COLOURS(PICK))
    words = {"legendgroup": "box", "showlegend": first, "line": {"color": colour, "width": 6}}
    drawn.append(_line(plotly, start, name, "box of query points", **words))
    moving.append(_moving(drawn, edges, motion.rotations, motion.translations))
    if mesh is not None:  # what the network was given: a camera sees one side
        others = [one.name for one in drawn]
        shares |= {"name": CLOUD_NAME, "legendgroup": "cloud", "showlegend": CLOUD_NAME not in others}
        drawn.append(plotly.Scatter3d(**_axes(points), **marks, **shares, visible="legendonly"))
        moving.append(_moving(drawn, points, motion.object_rotations, motion.object_translations))


def _add_expected(plotly, drawn: list, wxyz_xyz: np.ndarray, box: np.ndarray, grasp: int) -> None:
    look = {"line": {"color": TRUTH, "width": 4, "dash": "dash"}, "legendgroup": "truth"}
    drawn.append(_line(plotly, wxyz_xyz[:, 4:], "scene2", "true trajectory and pick", **look))
    drawn.append(_line(plotly, _lines(_placed(box, wxyz_xyz[grasp])), "scene2", "truth", showlegend=False, **look))


def _add_contact_regions(plotly, drawn: list, scene: ImitationScene) -> None:
    """Boxes of the contact query points on the demonstrated and on the new target, which do not move."""
    target = scene.demonstration.target
    assert target is not None  # there would be no contact poses
    box = bounds(np.asarray(target.query))
    poses = (target.T_world_contact, scene.result.target_trajectories[scene.result.best, 0])
    for panel, pose in zip(("scene", "scene2"), poses):
        look = {"line": {"color": CONTACT, "width": 5}, "legendgroup": "contact", "showlegend": panel == "scene"}
        drawn.append(_line(plotly, _lines(_placed(box, np.asarray(pose))), panel, "contact region", **look))


def _energy_name(scene: ImitationScene) -> str:
    """What the energies of candidates are: with a target, those of the contact regions are added."""
    return "energy of pick and contact" if len(scene.result.target_trajectories) else "energy"


def _moving(drawn: list, points: np.ndarray, rotations: np.ndarray, translations: np.ndarray) -> dict:
    """The trace that was drawn last, with its points and motions in the unit of the page."""
    shown = [[None if np.isnan(value) else value for value in row] for row in listed(CENTIMETRES * points.T)]
    motions = [[listed(R, 5), listed(CENTIMETRES * t)] for R, t in zip(rotations, translations)]
    return {"trace": len(drawn) - 1, "points": shown, "motions": motions}


def _line(plotly, points: np.ndarray, scene: str, name: str, **look) -> Any:
    return plotly.Scatter3d(**_axes(points), scene=scene, name=name, **({"mode": "lines"} | look))


def _axes(points: np.ndarray) -> dict[str, list]:
    """Coordinates of plotly, centimetres; a row of NaN interrupts a line."""
    rows = CENTIMETRES * np.asarray(points, float).T
    return dict(zip("xyz", ([None if np.isnan(value) else value for value in listed(row)] for row in rows)))


def _lines(corners: Float[np.ndarray, "8 3"]) -> np.ndarray:
    """The twelve edges of a box as one line with interruptions, (36, 3)."""
    gap = np.full(3, np.nan)
    return np.concatenate([np.stack([corners[a], corners[b], gap]) for a, b in polygons3d.EDGES])


def _placed(corners: np.ndarray, wxyz_xyz: np.ndarray) -> np.ndarray:
    one = motion_of(np.asarray(wxyz_xyz)[None], 0, 0)
    return corners @ one.rotations[0].T + one.translations[0]


def _phase(place: float, result, last: int) -> str:
    release = result.release % (last + 1)
    return "approach" if place < result.grasp else "retreat" if place > release else "object held"


def _lead(scene: ImitationScene, modes: list[Mode]) -> str:
    result = scene.result
    confidence, recognised = float(result.confidence), float(result.recognised)
    parts = [f"{len(modes)} distinct pick{'s' if len(modes) != 1 else ''} of {len(result.energies)} candidates"]
    parts.append(f"the best has {_energy_name(scene)} {modes[0].energy:.5f}")
    if len(modes) > 1:
        parts.append(f"the second {modes[1].energy:.5f}, {above(modes[1], modes[0])}")
    lines = ["; ".join(parts) + "."]
    known = [f"confidence {confidence:.2f} that the pick is right to 2 cm and 20 degrees"] * math.isfinite(confidence)
    known += [f"recognised {recognised:.2f} as the demonstration's category"] * math.isfinite(recognised)
    if known:
        lines.append(". ".join(_sentence(part) for part in ("; ".join(known), result.advice) if part) + ".")
    lines.append("Drag to turn, scroll to zoom; a click in the legend shows or hides.")
    return "\n".join(lines)


def _sentence(words: str) -> str:
    return words[0].upper() + words[1:]
