"""Points inside and outside of a mesh, by its generalised winding number."""

from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Bool, Float

from tdf_jax._internal.extras import from_extra

if TYPE_CHECKING:
    import trimesh

# Largest fraction of undecided points among those not clearly outside. A mug whose handle is open at its ends has none.
MAX_UNDECIDED = 0.2


def inside(mesh: "trimesh.Trimesh", x: Float[np.ndarray, "points 3"]) -> Bool[np.ndarray, " points"] | None:
    """Find the points that a mesh encloses, by its winding number.

    Small holes do not matter, nor does the orientation of the faces.

    Args:
        mesh: surface.
        x: points spread over the mesh's bounding box and around it, (points, 3), in the unit and frame of the mesh.

    Returns:
        Whether each point is inside, (points,). None if the surface is open: of the points not clearly outside, more
        than the fraction `MAX_UNDECIDED` is not clearly inside either.

    Raises:
        InputError: libigl is not installed.
    """
    winding = np.abs(winding_number(mesh, x))
    undecided = np.sum((winding > 0.25) & (winding < 0.75))
    return None if undecided > MAX_UNDECIDED * np.sum(winding > 0.25) else winding > 0.5


def winding_number(mesh: "trimesh.Trimesh", x: Float[np.ndarray, "points 3"]) -> Float[np.ndarray, " points"]:
    """Compute the generalised winding number: 1 inside, 0 outside, in between where a surface is open.

    Args:
        mesh: surface.
        x: points, (points, 3), in the unit and frame of the mesh.

    Returns:
        Winding number of each point, (points,).

    Raises:
        InputError: libigl is not installed.

    References:
        Barill, Dickson, Schmidt, Levin, Jacobson, "Fast winding numbers for soups and clouds", SIGGRAPH 2018.
    """
    igl = libigl("winding_number()")
    vertices, faces = np.asarray(mesh.vertices, float), np.asarray(mesh.faces, np.int64)
    return np.asarray(igl.fast_winding_number(vertices, faces, np.asarray(x, float)))


def libigl(function: str):
    """Import libigl, which the extra "mesh" installs.

    Args:
        function: name that the error message begins with, such as "inside()".

    Returns:
        The module igl.

    Raises:
        InputError: libigl is not installed.
    """
    return from_extra(function, "igl", "mesh", "libigl")
