"""One object as training sees it: surface points, labelled query points, what cameras see, and its places."""

from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

if TYPE_CHECKING:
    import trimesh

from tdf_jax._internal.errors import InputError
from tdf_jax.geometry import views
from tdf_jax.geometry.sampling import sample_surface
from tdf_jax.geometry.winding import inside, winding_number
from tdf_jax.io.meshes import file_axes, load_mesh
from tdf_jax.shapes import FAMILIES

UNIFORM_SHARE = 0.5  # of the query points: uniform in the padded bounding box; the rest lie near the surface
BOX_PADDING = 0.10  # of the diagonal, on every side
# Half of the points near the surface lie within a wall's thickness of it (2 mm on a real mug), half further out.
NEAR_SPREADS = (0.012, 0.05)  # standard deviations, of the diagonal
LEAST_INSIDE = 0.002  # of the uniform query points; real mugs have 0.07 to 0.09, a thin bowl 0.008


class Labelled(NamedTuple):
    """An object in its canonical frame (up +z, front, handle or long side +x), scaled to unit diagonal.

    Attributes:
        surface: uniform by area.
        queries: the first half uniform in the padded bounding box, the rest near the surface.
        inside: which queries are.
        visible: which surface points each of some cameras all around sees.
        places: T_object_place of places that mean the same on every object.
        diagonal: metres, of the object before it was scaled.
        fold: its symmetry about z, see `tdf_jax.symmetry`.
    """

    surface: Float[np.ndarray, "points 3"]
    queries: Float[np.ndarray, "queries 3"]
    inside: Bool[np.ndarray, " queries"]
    visible: Bool[np.ndarray, "cameras points"]
    places: Float[np.ndarray, "places 4 4"]
    diagonal: Float[np.ndarray, ""]
    fold: Int[np.ndarray, ""]


def generated_object(category: str, rng: np.random.Generator, points: int, queries: int, cameras: int) -> Labelled:
    """An object of one of the library's own families with its family's places."""
    family = FAMILIES[category]
    shape = family.build(family.sample(rng))
    places = np.stack([shape.frames[name] for name in family.places])
    return _labelled(shape.mesh, shape.contains, places, shape.fold, rng, points, queries, cameras)


def scanned_object(
    mesh: "trimesh.Trimesh",
    rng: np.random.Generator,
    points: int,
    queries: int,
    cameras: int,
    stretch: float,
    fold: int = 1,
) -> Labelled:
    """A user's mesh, watertight or not, labelled by the generalised winding number.

    Its places are the middle of the bounding box and of its six faces, axes as the object's.

    Args:
        mesh: from `canonical_mesh`.
        rng: source of chance.
        points, queries, cameras: how many.
        stretch: every axis is scaled by up to e to this, at random; 0 leaves the mesh as it is.
        fold: symmetry of the mesh; of one that looks the same after quarter turns or any, x and y are stretched alike,
            so that it stays so.
    """
    mesh, factors = mesh.copy(), np.exp(rng.uniform(-stretch, stretch, 3))
    mesh.apply_scale(factors if fold in (1, 2) else factors[[0, 0, 2]])
    mesh.apply_translation(-mesh.bounds.mean(axis=0))
    middles = np.concatenate([np.zeros((1, 3)), np.diag(mesh.extents / 2), -np.diag(mesh.extents / 2)])
    places = np.tile(np.eye(4), (len(middles), 1, 1))
    places[:, :3, 3] = middles
    return _labelled(mesh, lambda x: np.abs(winding_number(mesh, x)) > 0.5, places, fold, rng, points, queries, cameras)


def _labelled(mesh, contains, places, fold, rng, points, queries, cameras):
    low, high = mesh.bounds
    diagonal = float(np.linalg.norm(high - low))
    uniform = int(queries * UNIFORM_SHARE)
    pad = BOX_PADDING * diagonal
    box = rng.uniform(low - pad, high + pad, (uniform, 3))
    spreads = np.resize(NEAR_SPREADS, queries - uniform)[:, None] * diagonal
    near = sample_surface(mesh, queries - uniform, rng) + rng.normal(size=(queries - uniform, 3)) * spreads
    x = np.concatenate([box, near])
    surface = sample_surface(mesh, points, rng)
    visible = views.visible(mesh, surface, views.cameras(cameras, rng), rng)
    places = places.copy()
    places[:, :3, 3] /= diagonal
    surface_unit, x_unit, places = (array.astype(np.float32) for array in (surface / diagonal, x / diagonal, places))
    return Labelled(surface_unit, x_unit, contains(x), visible, places, np.float32(diagonal), np.int8(fold))


def canonical_mesh(path, unit: float, up: str, front: str) -> "trimesh.Trimesh":
    """A mesh file in metres, up +z, front +x, checked to enclose a volume.

    Args:
        path: .obj, .stl, .ply, .off, .glb.
        unit: metres per unit of the file.
        up, front: axes of the file, such as "+z" and "-x".

    Raises:
        InputError: the file is no mesh, or encloses nothing, or has holes too large to tell inside from outside.
    """
    mesh = load_mesh(path, scale=unit)
    mesh.vertices = mesh.vertices @ file_axes(up, front)
    mesh.apply_translation(-mesh.bounds.mean(axis=0))
    pad = BOX_PADDING * np.linalg.norm(mesh.extents)
    x = np.random.default_rng(0).uniform(mesh.bounds[0] - pad, mesh.bounds[1] + pad, (4000, 3))
    enclosed = inside(mesh, x)
    if enclosed is None or enclosed.mean() < LEAST_INSIDE:
        got = (
            "is open: much of its bounding box is neither inside nor outside"
            if enclosed is None
            else "encloses next to nothing"
        )
        raise InputError(
            f"canonical_mesh(): {path} {got}; expected a closed surface, or one with small holes, of a solid with walls: "
            "give it thickness, or leave it out"
        )
    return mesh
