"""Polygons of meshes, cut into triangles."""

import numpy as np
from jaxtyping import Float, Int


def triangulate(
    vertices: Float[np.ndarray, "vertices 3"], corners: Int[np.ndarray, " corners"], sizes: Int[np.ndarray, " polygons"]
) -> Int[np.ndarray, "faces 3"]:
    """Cut polygons into triangles of the same orientation, concave ones so that nothing outside is filled.

    Convex polygons become fans. A polygon need not be flat: it is cut as its projection along its mean normal is. One
    that crosses itself has no inside, and becomes a fan.

    Args:
        vertices: vertices, (vertices, 3).
        corners: indices of the corners of all polygons, one polygon after the other, (corners,).
        sizes: number of corners of each polygon, (polygons,). Those of 1 and 2 corners are points and lines, which have
            no area, and are left out.

    Returns:
        Triangles in the order of the polygons, (faces, 3).

    Raises:
        ValueError: a corner is none of the vertices.
    """
    if len(corners) and not (0 <= corners.min() and corners.max() < len(vertices)):
        wrong = corners[(corners < 0) | (corners >= len(vertices))][0]
        raise ValueError(f"a face has vertex {wrong}, counted from 0; there are {len(vertices)} vertices")
    starts = np.cumsum(sizes) - sizes
    triangles, owners = [np.zeros((0, 3), dtype=np.int64)], [np.zeros(0, dtype=np.int64)]
    for size in np.unique(sizes[sizes >= 3]):
        owner = np.flatnonzero(sizes == size)
        polygons = corners[starts[owner][:, None] + np.arange(size)]
        local = np.stack([np.zeros(size - 2), np.arange(1, size - 1), np.arange(2, size)], axis=1).astype(np.int64)
        cuts = np.repeat(local[None], len(polygons), axis=0)
        if size > 3:
            with np.errstate(invalid="ignore", over="ignore"):  # vertices that are not finite are refused later
                flat = _projected(vertices[polygons])
                for index in np.flatnonzero(_overlaps(flat, cuts)):
                    cuts[index] = _cut(flat[index], cuts[index])
        triangles.append(polygons[np.arange(len(polygons))[:, None, None], cuts].reshape(-1, 3))
        owners.append(np.repeat(owner, size - 2))
    order = np.argsort(np.concatenate(owners), kind="stable")
    return np.concatenate(triangles)[order]


def strip_triangles(strip: Int[np.ndarray, " corners"]) -> Int[np.ndarray, "faces 3"]:
    """Cut a triangle strip into its triangles, all of the orientation of the first.

    Args:
        strip: indices of vertices, (corners,).

    Returns:
        Triangles, without those that have a vertex twice, (faces, 3).
    """
    faces = np.stack([strip[:-2], strip[1:-1], strip[2:]], axis=1) if len(strip) > 2 else np.zeros((0, 3), np.int64)
    faces[1::2] = faces[1::2, [1, 0, 2]]
    return faces[(faces != np.roll(faces, 1, axis=1)).all(axis=1)]


def _projected(polygons):
    """Corners in the coordinate plane next to that of each polygon, counter-clockwise: (polygons, corners, 2)."""
    p = polygons - polygons[:, :1]
    normal = np.cross(p, np.roll(p, -1, axis=1)).sum(axis=1)
    axis = np.argmax(np.abs(np.nan_to_num(normal)), axis=1)
    rows = np.arange(len(p))
    u, v = p[rows, :, (axis + 1) % 3], p[rows, :, (axis + 2) % 3]
    mirrored = (normal[rows, axis] < 0)[:, None]
    return np.stack([np.where(mirrored, v, u), np.where(mirrored, u, v)], axis=-1)


def _areas(flat, cuts):
    """Signed areas of the triangles of each polygon, (polygons, triangles)."""
    a, b, c = np.moveaxis(flat[np.arange(len(flat))[:, None, None], cuts], 2, 0)
    return 0.5 * ((b - a)[..., 0] * (c - a)[..., 1] - (b - a)[..., 1] * (c - a)[..., 0])


def _overlaps(flat, cuts):
    """Whether triangles of a polygon overlap: then one of them is turned over."""
    extent = np.ptp(flat, axis=1).max(axis=1)
    return (_areas(flat, cuts) < -1e-12 * extent[:, None] ** 2).any(axis=1)


def _cut(flat, fan):
    """Triangles of one polygon that do not overlap; the fan if there are none."""
    if not np.isfinite(flat).all():
        return fan
    if len(flat) == 4:
        other = np.array([[1, 2, 3], [1, 3, 0]])
    else:
        import manifold3d

        other = np.asarray(manifold3d.triangulate([flat]), dtype=np.int64)
    return fan if other.shape != fan.shape or _overlaps(flat[None], other[None])[0] else other
