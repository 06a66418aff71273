"""One labelled object: surface points, query points inside and outside, points that cameras see, and places."""

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

UNIFORM_SHARE = 0.5  # share of query points that are uniform in the padded box; the others lie near the surface
BOX_PADDING = 0.10  # padding on every side, share of the diagonal
# Half of the points near the surface lie within the thickness of a wall (2 mm on a real mug), half further away.
NEAR_SPREADS = (0.012, 0.05)  # standard deviations, shares of the diagonal
MIN_INSIDE = 0.002  # share of the uniform query points; real mugs have 0.07 to 0.09, a thin bowl 0.008


class Labelled(NamedTuple):
    """An object in its canonical frame (up +z; front, handle or long side +x), scaled to a diagonal of 1.

    Attributes:
        surface: surface points, uniform by area, (points, 3).
        queries: query points, (queries, 3); the first half is uniform in the padded bounding box, the others are near
            the surface.
        inside: whether each query point is inside, (queries,).
        visible: whether each camera sees each surface point, (cameras, points).
        places: poses T_object_place of places that correspond on all objects, (places, 4, 4).
        diagonal: diagonal of the object before it was scaled, metres.
        fold: symmetry about z, see `tdf_jax.geometry.symmetry`.
    """

    surface: Float[np.ndarray, "points 3"]
    queries: Float[np.ndarray, "queries 3"]
    inside: Bool[np.ndarray, " queries"]
    visible: Bool[np.ndarray, "cameras points"]
    places: Float[np.ndarray, "places 4 4"]
    diagonal: Float[np.ndarray, ""]
    fold: Int[np.ndarray, ""]


def generated_object(category: str, rng: np.random.Generator, points: int, queries: int, cameras: int) -> Labelled:
    """A generated object of a category of `tdf_jax.shapes`, with the places of its family."""
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

    Its places are the centres of the bounding box and of its six faces, with the axes of the object.

    Args:
        mesh: mesh from `canonical_mesh`, metres.
        rng: random generator.
        points: number of surface points.
        queries: number of query points.
        cameras: number of cameras.
        stretch: every axis is scaled by a random factor of up to e to this; 0 does not scale.
        fold: symmetry of the mesh. If quarter turns or all turns leave it unchanged, x and y are scaled alike, so that
            the symmetry remains.
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
    return Labelled(
        surface_unit, x_unit, contains(x), visible, places, np.asarray(diagonal, np.float32), np.asarray(fold, np.int8)
    )


def canonical_mesh(path, unit: float, up: str, front: str) -> "trimesh.Trimesh":
    """Read a mesh file, in metres, with up +z and front +x, and check that it encloses a volume.

    Args:
        path: .obj, .stl, .ply, .glb, .gltf or .off file.
        unit: metres per unit of the file.
        up: axis of the file that points up, such as "+z".
        front: axis of the file that points to the front, such as "-x".

    Raises:
        InputError: the file is not a mesh, encloses nothing, or has holes too large to distinguish inside and outside.
    """
    mesh = load_mesh(path, scale=unit)
    mesh.vertices = mesh.vertices @ file_axes(up, front)
    mesh.apply_translation(-mesh.bounds.mean(axis=0))
    pad = BOX_PADDING * np.linalg.norm(mesh.extents)
    x = np.random.default_rng(0).uniform(mesh.bounds[0] - pad, mesh.bounds[1] + pad, (4000, 3))
    enclosed = inside(mesh, x)
    if enclosed is None or enclosed.mean() < MIN_INSIDE:
        got = (
            "is open: much of its bounding box is neither inside nor outside"
            if enclosed is None
            else "encloses almost no volume"
        )
        raise InputError(
            f"canonical_mesh(): {path} {got}; expected a closed surface, or one with small holes, of a solid "
            "with walls. Give it thickness, or leave it out"
        )
    return mesh
