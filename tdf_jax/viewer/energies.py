"""An energy landscape on the screen."""

from pathlib import Path
from typing import Any

import numpy as np

from tdf_jax._internal.errors import InputError
from tdf_jax.landscape.storage import Landscape
from tdf_jax.viewer import handles
from tdf_jax.viewer.solving import Problem
from tdf_jax.viz.landscapes import LEVELS, SURFACES, isosurface
from tdf_jax.viz.style import PALE, TRUTH

NEAR = 0.02  # metres between the first waypoints of an imitation and its landscape, whose clouds may be other samples


def check_landscape_of(problem: Problem, landscape: Landscape, folder: Path) -> None:
    """Check that a landscape is of an imitation's demonstration and object, where the object was.

    Args:
        problem: the imitation.
        landscape: the landscape.
        folder: its folder, for the error message.

    Raises:
        InputError: its first waypoint is not where the demonstrated pick is when it is moved with the centroid.
    """
    expected = np.asarray(problem.reference.trajectory.translations[0] + problem.field.origin)
    away = float(np.linalg.norm(landscape.waypoints[0] - expected))
    if away > NEAR:
        raise InputError(
            f"tdf view: the landscape {folder} has its first waypoint {100 * away:.1f} cm from that of the imitation; "
            f"expected at most {100 * NEAR:g} cm: a landscape of the same demonstration and of the same object in the "
            f"same pose. See it alone with `tdf view {folder}`"
        )


def show_landscape(server: Any, landscape: Landscape, opacity: float = 1.0) -> None:
    """Add an energy landscape: a plane, or the slices and the surfaces of a volume, with its waypoints and minimisers.

    Args:
        server: the `viser.ViserServer`.
        landscape: landscape of a grid with two or three axes, in one orientation or the best of several.
        opacity: of the plane, from 0 to 1.
    """
    energy, points, gui = landscape.combined, landscape.grid.points, server.gui
    if energy.ndim not in (2, 3) or energy.shape != landscape.grid.shape:
        raise InputError(
            f"tdf view: the landscape has energies {energy.shape}; expected a grid with two or three axes in one "
            "orientation, or the best of several"
        )
    low, high = float(np.nanmin(energy)), float(np.nanmax(energy))
    marks = {
        "demonstration, moved with the centroid": handles.add_path(
            server, "/landscape/waypoints", landscape.waypoints, PALE, 2 * handles.LINE
        ),
        "minimum of each waypoint": handles.add_crosses(server, "/landscape/minimisers", landscape.minimisers, TRUTH),
    }
    nodes: dict[str, Any] = {}

    def slice_at(number: int) -> None:
        visible = nodes["slice"].visible if nodes else True
        where, values = points[..., number, :], energy[..., number]
        plane = handles.add_map(server, "/landscape/slice", where, values, (low, high), opacity)
        plane.visible = visible
        nodes["slice"] = plane

    with gui.add_folder("Landscape"):
        gui.add_markdown(
            f"Energy from {low:.4f} (dark) to {high:.4f} (light); red: the minimum of each waypoint; "
            "grey: the demonstration, moved with the centroid."
        )
        if energy.ndim == 2:
            nodes["slice"] = handles.add_map(server, "/landscape/slice", points, energy, (low, high), opacity)
        else:
            count = energy.shape[2]
            chosen = gui.add_slider("slice", 0, count - 1, 1, count // 2)
            chosen.on_update(lambda event: slice_at(int(event.target.value)))
            slice_at(count // 2)
            for share, colour in zip(LEVELS, SURFACES):
                try:
                    triangles = isosurface(landscape, share)
                except InputError as error:  # libigl is an extra
                    gui.add_markdown(f"There are no surfaces of equal energy: {error}.")
                    break
                node = handles.add_triangles(server, f"/landscape/surface{share}", triangles, colour, 0.35)
                _switch(gui, f"surface of the least {100 * share:.0f} %", node)
        shown = gui.add_checkbox("plane", True)
        shown.on_update(lambda event: setattr(nodes["slice"], "visible", event.target.value))
        for name, node in marks.items():
            _switch(gui, name, node)


def _switch(gui: Any, name: str, node: Any) -> None:
    box = gui.add_checkbox(name, True)
    box.on_update(lambda event: setattr(node, "visible", event.target.value))
