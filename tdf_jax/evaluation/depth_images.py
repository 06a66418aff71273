"""Depth images of meshes on a table, with a ray through every pixel: no renderer and no simulator is needed."""

import dataclasses
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float, Int

from tdf_jax.geometry.pinhole import camera_matrix, looking_at

WIDTH, HEIGHT, FOVY = 640, 480, 45.0  # pixels and degrees
DISTANCES, ELEVATIONS = (0.4, 1.0), (20.0, 70.0)  # metres from the object, and degrees above the horizontal
# Metres: standard deviation of a depth at a distance. It grows with the distance squared, as that of stereo cameras.
NOISE, NOISE_DISTANCE = 0.001, 0.7
TABLE_REACH = 0.25  # metres, half an edge of the square table
NOTHING, TABLE = -1, 0  # labels of what a pixel shows; the first mesh is 1
CHUNK = 2_000_000  # most rays that are tested at a time


@dataclasses.dataclass(frozen=True, eq=False)
class DepthImage:
    """What a depth camera sees of a table.

    Attributes:
        depth: distance along the camera's z axis, (height, width), metres; 0 where nothing is measured.
        labels: what a pixel shows, (height, width): `NOTHING`, `TABLE`, or 1 and more for the meshes. Of a pixel
            between two surfaces, the mesh.
        K: matrix of the camera, (3, 3), pixels; whole pixel coordinates are the centres of pixels.
        T_world_camera: pose of the camera, (4, 4), metres, world frame; x to the right of the image, y down, z forward.
    """

    depth: Float[np.ndarray, "height width"]
    labels: Int[np.ndarray, "height width"]
    K: Float[np.ndarray, "3 3"]
    T_world_camera: Float[np.ndarray, "4 4"]


def camera_poses(
    count: int, target: Float[np.ndarray, "3"], rng: np.random.Generator
) -> Float[np.ndarray, "cameras 4 4"]:
    """Poses of cameras around a point: the first from a random side, the others evenly around it.

    Args:
        count: number of cameras.
        target: point that they look at, (3,), metres, world frame.
        rng: generator of the first direction, and of each camera's distance and elevation, which are uniform in
            `DISTANCES` and `ELEVATIONS`.

    Returns:
        T_world_camera of each, (cameras, 4, 4), metres. The first is the same for every number of cameras.
    """
    around, poses = rng.uniform(0, 2 * np.pi), []
    for index in range(count):
        distance, up = rng.uniform(*DISTANCES), np.radians(rng.uniform(*ELEVATIONS))
        angle = around + 2 * np.pi * index / count
        away = np.array([np.cos(up) * np.cos(angle), np.cos(up) * np.sin(angle), np.sin(up)])
        poses.append(looking_at(target + distance * away, target))
    return np.stack(poses)


def depth_image(
    triangles: Sequence[Float[np.ndarray, "_ 3 3"]],
    T_world_camera: Float[np.ndarray, "4 4"],
    rng: np.random.Generator,
    *,
    noise: float = NOISE,
    width: int = WIDTH,
    height: int = HEIGHT,
) -> DepthImage:
    """What a depth camera sees of meshes on a table, z = 0.

    A pixel is the mean of four rays, so that pixels at edges lie between two surfaces. It is not measured if one of
    its rays hits nothing.

    Args:
        triangles: corners of the triangles of each mesh, (triangles, 3, 3), metres, world frame; all of them before the
            camera. The first mesh is in the middle of the table.
        T_world_camera: pose of the camera, (4, 4), metres, world frame.
        rng: generator of the noise.
        noise: standard deviation of a depth of `NOISE_DISTANCE`, metres; it grows with the depth squared.
        width: width of the image, pixels.
        height: height of the image, pixels.
    """
    K = camera_matrix(FOVY, width, height)
    R, t = T_world_camera[:3, :3], T_world_camera[:3, 3]
    middle = triangles[0].reshape(-1, 3).mean(axis=0)
    corners = np.array([[x, y, 0.0] for x in (-1, 1) for y in (-1, 1)]) * TABLE_REACH + [*middle[:2], 0.0]
    seen = [(one.reshape(-1, 3) - t) @ R for one in (corners, *triangles)]  # in the camera's frame
    top, bottom, left, right = _window(np.concatenate(seen), K, width, height)
    # The rays of a pixel are those of an image with twice as many rows and columns, of which only the window is cast.
    fine = K * [[2], [2], [1]]
    fine[:2, 2] += 0.5 - 2 * np.array([left, top])
    shape = 2 * (bottom - top), 2 * (right - left)
    nearest = _table(fine, T_world_camera, middle[:2], shape)
    shown = np.where(np.isfinite(nearest), TABLE, NOTHING)
    for number, one in enumerate(seen[1:]):
        hit = cast(one.reshape(-1, 3, 3), fine, shape)
        nearer = hit < nearest
        nearest[nearer], shown[nearer] = hit[nearer], number + 1
    rays, shown = four_rays(nearest), four_rays(shown)
    measured = np.isfinite(rays).all(axis=-1)
    values = np.where(measured, rays.mean(axis=-1), 0.0)
    depth, labels = np.zeros((height, width)), np.full((height, width), NOTHING)
    depth[top:bottom, left:right] = values
    labels[top:bottom, left:right] = np.where(measured, shown.max(axis=-1), NOTHING)
    depth += noise * (depth / NOISE_DISTANCE) ** 2 * rng.standard_normal(depth.shape)
    return DepthImage(depth, labels, K, T_world_camera)


def cast(
    triangles: Float[np.ndarray, "triangles 3 3"], K: Float[np.ndarray, "3 3"], shape: tuple[int, int]
) -> Float[np.ndarray, "height width"]:
    """Depth of the nearest triangle on the ray through the centre of every pixel.

    Every triangle is tested against the rays through the rectangle of pixels around it.

    Args:
        triangles: corners, (triangles, 3, 3), metres, camera frame, all before the camera; either side is seen.
        K: matrix of the camera, (3, 3), pixels.
        shape: height and width of the image, pixels.

    Returns:
        Depths along the z axis, (height, width), metres; infinite where no triangle is hit.
    """
    height, width = shape
    focal, centre = np.array([K[0, 0], K[1, 1]]), K[:2, 2]
    image = triangles[..., :2] / triangles[..., 2:] * focal + centre
    low = np.maximum(np.ceil(image.min(axis=1)).astype(int), 0)
    high = np.minimum(np.floor(image.max(axis=1)).astype(int), (width - 1, height - 1))
    extent = np.maximum(high - low + 1, 0)  # columns and rows of pixels around a triangle
    counts = extent.prod(axis=1)
    a, b, c = np.swapaxes(triangles, 0, 1)
    normal = np.cross(b - a, c - a)
    offset, edges = np.sum(normal * a, axis=1), np.stack([np.cross(a, b), np.cross(b, c), np.cross(c, a)])
    nearest = np.full(height * width, np.inf)
    chunk = np.cumsum(counts) // CHUNK
    for part in (np.flatnonzero((chunk == number) & (counts > 0)) for number in np.unique(chunk)):
        index = np.repeat(part, counts[part])
        within = np.arange(len(index)) - np.repeat(np.cumsum(counts[part]) - counts[part], counts[part])
        column, row = low[index, 0] + within % extent[index, 0], low[index, 1] + within // extent[index, 0]
        ray = np.column_stack([(np.column_stack([column, row]) - centre) / focal, np.ones(len(index))])
        sides = np.einsum("ekc,kc->ek", edges[:, index], ray)  # the ray is inside if it is on one side of all edges
        inside = (sides >= 0).all(axis=0) | (sides <= 0).all(axis=0)
        across = np.einsum("kc,kc->k", normal[index[inside]], ray[inside])
        hit = across != 0
        depth = offset[index[inside]][hit] / across[hit]
        np.minimum.at(nearest, (row * width + column)[inside][hit], depth)
    return nearest.reshape(shape)


def _window(points, K, width, height):
    """Rows and columns of the image in which points of the camera's frame are: the first, and one after the last."""
    image = points[:, :2] / points[:, 2:] * [K[0, 0], K[1, 1]] + K[:2, 2]
    low, high = np.floor(image.min(axis=0)).astype(int) - 1, np.ceil(image.max(axis=0)).astype(int) + 2
    return max(low[1], 0), min(high[1], height), max(low[0], 0), min(high[0], width)


def _table(K, T_world_camera, middle, shape):
    """Depth of the square table, z = 0, about a point on it, on the ray through every pixel; infinite beside it."""
    rows, columns = np.mgrid[: shape[0], : shape[1]]
    rays = np.stack([(columns - K[0, 2]) / K[0, 0], (rows - K[1, 2]) / K[1, 1], np.ones(shape)], axis=-1)
    rays = rays @ T_world_camera[:3, :3].T  # of depth 1, in the world
    position = T_world_camera[:3, 3]
    with np.errstate(divide="ignore"):
        depth = np.where(rays[..., 2] < 0, -position[2] / rays[..., 2], np.inf)
    with np.errstate(invalid="ignore"):  # infinite times zero
        place = position[:2] + depth[..., None] * rays[..., :2] - middle
        return np.where((np.abs(place) <= TABLE_REACH).all(axis=-1), depth, np.inf)


def four_rays(values):
    """The four rays of every pixel, (height, width, 4)."""
    return np.stack([values[::2, ::2], values[1::2, ::2], values[::2, 1::2], values[1::2, 1::2]], axis=-1)
