"""Convex parts of users' meshes, by CoACD, and the bodies that they make; generated objects have exact parts."""

import importlib.metadata
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float

from tdf_jax._internal import checks
from tdf_jax._internal.cache import digest, kept
from tdf_jax._internal.compiled import user_cache
from tdf_jax._internal.errors import InputError
from tdf_jax.geometry.winding import inside, libigl
from tdf_jax.sim.bodies import Body
from tdf_jax.sim.physics import extra, object_mass

if TYPE_CHECKING:
    import trimesh

TOLERANCE = 0.0015  # metres
SIZES = (0.005, 2.0)  # metres, longest edge of a mesh's box: others are in another unit
SIMPLIFIED = 0.1  # of the tolerance, by which a mesh is simplified before: half the faces, and half the time
STEP, MOST_CELLS = 0.6, 200  # of the tolerance, and along the longest edge: the grid on which open meshes are closed
# Of the search for a cut, less than CoACD's defaults (150, 20 and 2000): half the time for a mug, equally good parts.
SEARCH = {"mcts_iterations": 60, "mcts_nodes": 10, "resolution": 1000}
MOST_PARTS = 200
LEAST_VOLUME = 1e-11  # m3 of a part, a hundredth of a cubic millimetre: thinner ones are no bodies
VERSION = 1  # of what is in the cache


def convex_decomposition(
    mesh: "trimesh.Trimesh",
    *,
    tolerance: float = TOLERANCE,
    seed: int = 0,
    folder: str | Path | None = None,
) -> list[Float[np.ndarray, "_ 3"]]:
    """Split a mesh into convex parts, whose union is about its material, by CoACD.

    The hollow and the finger hole of a scanned mug stay open. The first time takes up to minutes for a mesh; the parts
    are kept on disk. A mesh with small holes, or with faces turned either way, is closed first (libigl, the extra
    "mesh"); walls thinner than a tolerance may be lost then.

    Args:
        mesh: mesh of a solid, metres.
        tolerance: concavity of a part that is accepted, metres: how far its hull may be from the surface. Smaller ones
            take longer and give more parts, up to `MOST_PARTS`.
        seed: seed of the search.
        folder: folder of the results; by default `tdf_jax/decompositions` in the user's cache, `$XDG_CACHE_HOME` or
            `~/.cache`. It is made if it does not exist.

    Returns:
        Corners of every part, (corners, 3), metres, in the mesh's frame; a part is their convex hull.

    Raises:
        InputError: the mesh has no faces, is not finite or not in metres, encloses no solid, CoACD (or, for a mesh
            that is not closed, libigl) is not installed, or the folder cannot be written.
    """
    name = "convex_decomposition()"
    vertices, faces = _checked(name, mesh)
    checks.number(name, "tolerance", tolerance, 1e-4, 0.1, "metres")
    checks.seed(name, seed)
    coacd = extra(name, "coacd")
    about = [
        *("convex parts", VERSION, importlib.metadata.version("coacd"), digest(vertices, faces)),
        *(float(tolerance), int(seed), SIMPLIFIED, STEP, MOST_CELLS, SEARCH, MOST_PARTS),
    ]

    def compute():
        parts = _decomposed(coacd, mesh, vertices, faces, tolerance, seed)
        if not parts:
            raise InputError(f"{name}: the mesh has no part with a volume; expected the surface of a solid")
        return {f"part{number:04}": part for number, part in enumerate(parts)}

    return kept(name, _folder(name, folder), about, compute, lambda parts: [parts[one] for one in sorted(parts)])


def mesh_body(
    mesh: "trimesh.Trimesh",
    mass: float | None = None,
    *,
    tolerance: float = TOLERANCE,
    folder: str | Path | None = None,
) -> Body:
    """The body of a user's mesh: material of even density.

    Args:
        mesh: mesh of a solid, metres.
        mass: mass, kg; by default by its volume, see `tdf_jax.sim.physics.object_mass`.
        tolerance: see `convex_decomposition`.
        folder: see `convex_decomposition`.

    Returns:
        The body. Its centre of mass and inertia are those of the mesh, or of the parts if the mesh is not closed.

    Raises:
        InputError: see `convex_decomposition`.
    """
    if mass is not None:
        checks.positive("mesh_body()", "mass", mass, "kg")
    parts = convex_decomposition(mesh, tolerance=tolerance, folder=folder)
    if _is_solid(mesh):
        volume, centre, inertia = float(mesh.volume), np.asarray(mesh.center_mass, float), mesh.moment_inertia
        inertia = np.asarray(inertia, float) / float(mesh.density)
    else:
        volume, centre, inertia = _properties(parts)
    used = object_mass(volume) if mass is None else float(mass)
    return Body(parts=parts, mass=used, centre=centre, inertia=inertia * (used / volume), mesh=mesh)


def _checked(function: str, mesh) -> tuple[np.ndarray, np.ndarray]:
    """Vertices and faces."""
    try:
        vertices, faces = np.asarray(mesh.vertices, float), np.asarray(mesh.faces, np.int64)
    except (AttributeError, TypeError, ValueError):
        raise InputError(f"{function}: got {type(mesh).__name__}; expected a trimesh.Trimesh") from None
    if len(faces) < 4 or not np.isfinite(vertices).all():
        raise InputError(
            f"{function}: the mesh has {len(faces)} faces, or vertices that are not finite; expected the surface of a "
            "solid"
        )
    size = float(np.ptp(vertices[faces.ravel()], axis=0).max())
    if not SIZES[0] <= size <= SIZES[1]:
        raise InputError(
            f"{function}: the mesh is {size:.4g} long; expected {SIZES[0]:g} to {SIZES[1]:g} metres. Scale it, as with "
            "mesh.apply_scale(0.001) from millimetres"
        )
    return vertices, faces


def _is_solid(mesh) -> bool:
    """Whether a mesh is closed and its faces are turned outwards."""
    return bool(mesh.is_watertight and mesh.is_winding_consistent and mesh.volume > 0)


def _folder(function: str, given: str | Path | None) -> Path:
    if given is None:
        folder = user_cache("decompositions")
    else:
        folder = checks.path(function, given, "folder")
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(
            f"{function}: cannot make the folder {folder} ({error.strerror or error}); name another one (folder), or "
            "set XDG_CACHE_HOME"
        ) from None
    return folder


def _decomposed(coacd, mesh, vertices, faces, tolerance: float, seed: int) -> list[np.ndarray]:
    import manifold3d

    if not _is_solid(mesh):
        vertices, faces = _closed("convex_decomposition()", mesh, vertices, faces, tolerance)
    given = manifold3d.Mesh(vertices.astype(np.float32), faces.astype(np.uint32))
    solid, mode = manifold3d.Manifold(given), "auto"  # which mends it if need be
    if solid.status() == manifold3d.Error.NoError and not solid.is_empty():
        simple = solid.simplify(SIMPLIFIED * tolerance).to_mesh()
        vertices, faces = np.asarray(simple.vert_properties[:, :3], float), np.asarray(simple.tri_verts, np.int64)
        mode = "off"
    coacd.set_log_level("error")
    found = coacd.run_coacd(
        coacd.Mesh(vertices, faces),
        threshold=float(tolerance),
        real_metric=True,
        max_convex_hull=MOST_PARTS,
        preprocess_mode=mode,
        seed=int(seed),
        **SEARCH,
    )
    parts = [_hull(np.asarray(corners, float)) for corners, _ in found]
    return [part for part in parts if part is not None]


def _closed(function: str, mesh, vertices, faces, tolerance: float) -> tuple[np.ndarray, np.ndarray]:
    """The closed surface of what a mesh with small holes, or faces turned either way, encloses."""
    from scipy.ndimage import binary_dilation, binary_erosion

    igl = libigl(function)
    low, high = (bound(vertices[faces.ravel()], axis=0) for bound in (np.min, np.max))
    step = max(STEP * tolerance, float((high - low).max()) / MOST_CELLS)
    nx, ny, nz = counts = (np.ceil((high - low) / step).astype(int) + 7).tolist()
    # From an odd place: points on a face are neither inside nor outside.
    z, y, x = np.meshgrid(*(low[i] + step * (np.arange(counts[i]) - 3.39) for i in (2, 1, 0)), indexing="ij")
    grid = np.stack([x, y, z], axis=-1).reshape(-1, 3)  # x runs fastest
    enclosed = inside(mesh, grid)
    if enclosed is None or not enclosed.any():
        raise InputError(
            f"{function}: the mesh is open, and encloses no solid; expected the surface of a solid, with walls that "
            "have two sides. Close it, or give a sheet a thickness"
        )
    solid = enclosed.reshape(nz, ny, nx)
    near = (binary_dilation(solid, iterations=2) != binary_erosion(solid, iterations=2)).ravel()
    distances = np.full(len(grid), 2 * step)
    distances[near] = np.sqrt(igl.point_mesh_squared_distance(grid[near], vertices, faces)[0])
    values = np.where(enclosed, distances, -distances)
    vertices, faces, _ = igl.marching_cubes(values, grid, nx, ny, nz, 0.0)
    vertices, faces = np.asarray(vertices, float), np.asarray(faces, np.int64)
    corners = vertices[faces]
    outwards = np.einsum("fi,fi->", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])) > 0
    return vertices, faces if outwards else faces[:, ::-1]


def _hull(points: np.ndarray) -> np.ndarray | None:
    """Those of the points that are corners of their hull; None if it is flat."""
    from scipy.spatial import ConvexHull, QhullError

    try:
        hull = ConvexHull(points)
    except QhullError:
        return None
    return points[np.sort(hull.vertices)] if hull.volume > LEAST_VOLUME else None


def _properties(parts: list[np.ndarray]) -> tuple[float, np.ndarray, np.ndarray]:
    """Volume, centre and inertia at density 1 of parts together, as if they did not overlap."""
    import trimesh

    hulls = [trimesh.convex.convex_hull(part) for part in parts]
    volumes = np.array([hull.volume for hull in hulls])
    centres = np.array([hull.center_mass for hull in hulls])
    centre = volumes @ centres / volumes.sum()
    inertia = np.zeros((3, 3))
    for hull, volume, away in zip(hulls, volumes, centres - centre):
        inertia += np.asarray(hull.moment_inertia) + volume * (away @ away * np.eye(3) - np.outer(away, away))
    return float(volumes.sum()), centre, inertia
