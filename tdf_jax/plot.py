"""Pictures of imitations, landscapes and fields as figures of matplotlib: `tdf.plot.imitation(...)`.

Every function but `page` returns the figure. With `ax=` it draws on axes of yours, such as a panel of a larger figure,
and returns their figure. Lengths are drawn in centimetres, energies have no unit. `figure.savefig(file)` writes it.
"""

from typing import TYPE_CHECKING, Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from tdf_jax._internal import checks
from tdf_jax._internal.boundary import host
from tdf_jax._internal.errors import InputError
from tdf_jax.geometry.demonstration import Demonstration
from tdf_jax.geometry.trajectory import Trajectory
from tdf_jax.landscape.storage import Landscape
from tdf_jax.networks.field import DescriptorField
from tdf_jax.networks.surface import surface_triangles
from tdf_jax.solvers.imitation_scene import ImitationScene
from tdf_jax.solvers.result import Result
from tdf_jax.uncertainty.modes import cluster_poses

if TYPE_CHECKING:
    import trimesh
    from matplotlib.figure import Figure

    from tdf_jax.viz.page import Page

__all__ = ["candidates", "imitation", "landscape", "losses", "page", "reconstruction"]


@host
def imitation(
    demonstration: Demonstration,
    points: Float[Array | np.ndarray, "points 3"],
    result: Result,
    *,
    target_points: Float[Array | np.ndarray, "target_points 3"] | None = None,
    expected: Trajectory | None = None,
    meshes: "tuple[trimesh.Trimesh | None, trimesh.Trimesh | None]" = (None, None),
    candidate: int | None = None,
    title: str = "",
    ax: Any | None = None,
) -> "Figure":
    """Draw a demonstration and its imitation side by side; with a target, also close-ups of the placed object.

    Args:
        demonstration: the demonstration.
        points: cloud of the new object, (points, 3), metres, world frame.
        result: result of `imitate`.
        target_points: cloud of the new target, (target_points, 3), metres, world frame; None if there is none, or if it
            has not moved.
        expected: ground truth, T_world_query, drawn dashed.
        meshes: meshes of the demonstrated and of the new object, metres, world frame; drawn instead of the points.
        candidate: index of the candidate that is drawn; by default the best.
        title: title above the picture.
        ax: three-dimensional axes, on which the imitation alone is drawn.

    Returns:
        The figure.

    Raises:
        InputError: no candidate is finite, the result is a batch, there is no such candidate, or the axes are not
            three-dimensional.
    """
    cloud = np.asarray(checks.points("plot.imitation()", points))
    trajectory = _one("plot.imitation()", result).trajectory
    if candidate is not None:
        checks.count("plot.imitation()", "candidate", candidate, 0, len(result.energies) - 1)
        trajectory = Trajectory(jnp.asarray(np.asarray(result.trajectories)[candidate]))
    if ax is None:
        from tdf_jax.viz.imitation import imitation_figure
        from tdf_jax.viz.relations import relation_figure

        if demonstration.target is not None:
            placed = None if target_points is None else np.asarray(checks.points("plot.imitation()", target_points))
            return relation_figure(demonstration, cloud, result, placed, candidate=candidate, title=title)
        return imitation_figure(demonstration, cloud, trajectory, expected, meshes, title)
    from tdf_jax.viz.single import axes3d, styled, trajectory_panel

    with styled():
        figure, axes = axes3d("plot.imitation()", ax)
        trajectory_panel(axes, trajectory, np.asarray(demonstration.query), cloud, meshes[1], expected)
        axes.set_title(title)
    return figure


@host
def losses(result: Result, *, ax: Any | None = None) -> "Figure":
    """Draw the energy of every candidate against the solver's steps, the best bold.

    Args:
        result: result of a solver.
        ax: plane axes to draw on.

    Returns:
        The figure.

    Raises:
        InputError: no candidate is finite, the result is a batch, or the axes are not plane axes.
    """
    best = int(_one("plot.losses()", result).best)
    from tdf_jax.viz.single import axes2d, losses_panel, styled

    history = np.asarray(result.candidate_history)
    if not len(result.target_trajectories):  # with a target, the energies are sums with those of the contact regions
        history = np.column_stack([history, np.asarray(result.energies)])
    with styled():
        figure, axes = axes2d("plot.losses()", ax)
        losses_panel(axes, history, best)
    return figure


@host
def candidates(
    result: Result,
    points: Float[Array | np.ndarray, "points 3"],
    query: Float[Array | np.ndarray, "queries 3"],
    *,
    ax: Any | None = None,
) -> "Figure":
    """Draw the object with a box of query points at every distinct pick, coloured by its energy.

    Args:
        result: result of `imitate` or `carry`.
        points: cloud of the object, (points, 3), metres, world frame.
        query: query points, (queries, 3), metres, query frame.
        ax: three-dimensional axes to draw on.

    Returns:
        The figure.

    Raises:
        InputError: no candidate is finite, the result is a batch, or the axes are not three-dimensional.
    """
    cloud = np.asarray(checks.points("plot.candidates()", points))
    box = np.asarray(checks.query("plot.candidates()", query))
    modes = cluster_poses(jnp.asarray(_one("plot.candidates()", result).picks), jnp.asarray(result.energies))
    from tdf_jax.viz.single import axes3d, candidates_panel, styled

    with styled():
        figure, axes = axes3d("plot.candidates()", ax)
        candidates_panel(axes, modes, cloud, box)
    return figure


@host
def landscape(
    energies: Landscape,
    points: Float[Array | np.ndarray, "points 3"],
    *,
    mesh: "trimesh.Trimesh | None" = None,
    expected: Float[Array | np.ndarray, "poses 3"] | None = None,
    path: Float[Array | np.ndarray, "corners 3"] | None = None,
    title: str = "",
    ax: Any | None = None,
) -> "Figure":
    """Draw an energy landscape: maps of a plane, or surfaces of equal energy of a volume.

    Args:
        energies: the landscape, in one orientation or the best of several.
        points: cloud of the object, (points, 3), metres, world frame.
        mesh: mesh of the object, metres, world frame; volumes show it instead of the points.
        expected: true waypoints, (poses, 3), metres, world frame.
        path: lowest-cost path, (corners, 3), metres, world frame.
        title: title above the picture.
        ax: plane axes, on which the combined energy of a plane is drawn.

    Returns:
        The figure.

    Raises:
        InputError: the grid has one axis, the landscape keeps every rotation, libigl is not installed (for a volume),
            or axes are given for a volume.
    """
    from tdf_jax.viz.landscapes import Marks, isosurface_figure, map_figure, map_panel

    known = {name: None if value is None else np.asarray(value) for name, value in (("e", expected), ("p", path))}
    marks = Marks(np.asarray(checks.points("plot.landscape()", points)), mesh, known["e"], known["p"])
    if len(energies.grid.shape) != 2:
        if ax is not None:
            raise InputError(
                f"plot.landscape(): ax is given, and the grid has {len(energies.grid.shape)} axes; expected a plane "
                "for axes, or no ax"
            )
        return isosurface_figure(energies, marks, title)
    if ax is None:
        return map_figure(energies, marks, title)
    from tdf_jax.viz.single import axes2d, styled

    with styled():
        figure, axes = axes2d("plot.landscape()", ax)
        map_panel(axes, energies, marks)
        axes.set_title(title)
    return figure


@host
def reconstruction(
    field: DescriptorField, points: Float[Array | np.ndarray, "points 3"], *, title: str = "", ax: Any | None = None
) -> "Figure":
    """Draw the surface that a network sees in a cloud: where the occupancy of its field is 1/2.

    Args:
        field: field of the cloud, from `encode`.
        points: the cloud, (points, 3), metres, world frame.
        title: title above the picture.
        ax: three-dimensional axes to draw on.

    Returns:
        The figure.

    Raises:
        InputError: libigl is not installed, or the axes are not three-dimensional.
    """
    cloud = np.asarray(checks.points("plot.reconstruction()", points))
    triangles = surface_triangles(field, np.eye(4), np.stack([cloud.min(axis=0), cloud.max(axis=0)]))
    from tdf_jax.viz.single import axes3d, styled, surface_panel

    with styled():
        figure, axes = axes3d("plot.reconstruction()", ax)
        surface_panel(axes, triangles, cloud)
        axes.set_title(title)
    return figure


@host
def page(
    what: ImitationScene | Landscape,
    *,
    points: Float[Array | np.ndarray, "points 3"] | None = None,
    mesh: "trimesh.Trimesh | None" = None,
    title: str = "",
) -> "Page":
    """Draw an imitation or a landscape to turn and to play, in a cell of a notebook or as an .html file.

    The page needs neither a server nor a network, and stays in the notebook when it is saved; it has 2 to 5 MB.

    Args:
        what: an imitation with all that its picture needs, see `ImitationScene` and `load_imitation`; or a landscape in
            one orientation or the best of several.
        points: of a landscape, cloud of the object, (points, 3), metres, world frame; not drawn by default.
        mesh: of a landscape, mesh of the object, metres, world frame, drawn instead of the points.
        title: title above the picture.

    Returns:
        The page. The last expression of a cell shows itself; `save("imitation.html")` writes it.

    Raises:
        InputError: plotly (or, for a volume, libigl) is not installed, the page would be too large to pass on, no
            candidate is finite, the landscape cannot be drawn, or points or a mesh are given for an imitation.
    """
    if isinstance(what, ImitationScene):
        if points is not None or mesh is not None:
            raise InputError("plot.page(): points or a mesh are given; an ImitationScene has its own: drop them")
        from tdf_jax.viz.imitation_page import imitation_page

        return imitation_page("plot.page()", what, title)
    if not isinstance(what, Landscape):
        raise InputError(f"plot.page(): got a {type(what).__name__}; expected an ImitationScene or a Landscape")
    cloud = np.zeros((0, 3)) if points is None else np.asarray(checks.points("plot.page()", points))
    from tdf_jax.viz.landscape_page import landscape_page
    from tdf_jax.viz.landscapes import Marks

    return landscape_page("plot.page()", what, Marks(cloud, mesh), title or "Energy landscape")


def _one(function: str, result: Result) -> Result:
    if not isinstance(result, Result):
        raise InputError(f"{function}: result is a {type(result).__name__}; expected the Result of a solver")
    if np.ndim(result.energies) != 1:
        raise InputError(
            f"{function}: the result is a batch of shape {np.shape(result.energies)}; expected one. Take one with "
            "jax.tree.map(lambda x: x[i], result)"
        )
    return result
