"""Inside and outside of a mesh, by its generalised winding number."""

from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Bool, Float

from tdf_jax._internal.errors import InputError

if TYPE_CHECKING:
    import trimesh


MOST_UNDECIDED = 0.2  # of the points not clearly outside; a mug whose handle is open at its ends has none


def inside(mesh: "trimesh.Trimesh", x: Float[np.ndarray, "points 3"]) -> Bool[np.ndarray, " points"] | None:
    """Tell which points a mesh encloses, by its winding number; small holes do not matter, nor which way the faces look.

    Args:
        mesh: the surface.
        x: spread over the mesh's bounding box and about it, in its unit.

    Returns:
        True inside; None for an open surface: of the points not clearly outside, more than `MOST_UNDECIDED` are not
        clearly inside.

    Raises:
        InputError: libigl is not installed.
    """
    winding = np.abs(winding_number(mesh, x))
    undecided = np.sum((winding > 0.25) & (winding < 0.75))
    return None if undecided > MOST_UNDECIDED * np.sum(winding > 0.25) else winding > 0.5


def winding_number(mesh: "trimesh.Trimesh", x: Float[np.ndarray, "points 3"]) -> Float[np.ndarray, " points"]:
    """The generalised winding number of points: 1 inside, 0 outside, in between where a surface is open.

    Raises:
        InputError: libigl is not installed.

    Source:
        Barill, Dickson, Schmidt, Levin, Jacobson, Fast winding numbers for soups and clouds, SIGGRAPH 2018.
    """
    igl = libigl("winding_number()")
    return igl.fast_winding_number(
        np.asarray(mesh.vertices, float), np.asarray(mesh.faces, np.int64), np.asarray(x, float)
    )


def libigl(function: str):
    """The module of libigl, of the extra "mesh".

    Raises:
        InputError: it is not installed.
    """
    try:
        import igl
    except ImportError:
        raise InputError(
            f"{function}: libigl is not installed; expected the extra 'mesh'; run: pip install 'tdf_jax[mesh]'"
        ) from None
    return igl
