"""Visible points of an object.

Hidden point removal finds the visible points of a point cloud; a depth buffer of surface points finds those of a mesh.
"""

import math
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Bool, Float
from scipy.spatial.transform import Rotation

from tdf_jax._internal import checks
from tdf_jax._internal.errors import InputError
from tdf_jax.geometry.sampling import sample_surface

if TYPE_CHECKING:
    import trimesh

PIXELS = 160  # pixels along a side of the depth buffer; a pixel is 1.3 mm wide on a real mug
OCCLUDERS = (
    100_000  # surface points that fill the depth buffer; hidden points are visible through gaps if it is smaller
)
# A point is hidden if it is farther behind the nearest one than this fraction of the object's diagonal. That is 2 mm on
# a real mug, less than most walls.
TOLERANCE = 0.012
DISTANCE = 3.0  # distance of the camera from the object's centre, in diagonals of the object


def single_view(
    points: Float[np.ndarray, "points 3"], camera: Float[np.ndarray, "3"], reach: float = 100.0
) -> Float[np.ndarray, "visible 3"]:
    """Select the points that a camera sees: hidden point removal by spherical flipping.

    Points are reflected in a large sphere around the camera. The points on the convex hull of their images and the
    camera are visible. docs/results/code_notes.md lists the accuracy.

    Args:
        points: object point cloud, (points, 3), metres.
        camera: position of the camera, (3,), metres, in the frame of the points.
        reach: radius of the sphere divided by the distance of the farthest point, above 1. A larger sphere returns more
            points: a small one misses surfaces at grazing angles, a large one sees through sparse surfaces.

    Returns:
        The visible points, (visible, 3), in their order.

    Raises:
        InputError: a shape is wrong, the camera is at a point, or the points and the camera are in one plane.

    References:
        Katz, Tal and Basri, "Direct visibility of point sets", SIGGRAPH 2007.
    """
    return merge_views(points, np.asarray(camera)[None], reach)


def merge_views(
    points: Float[np.ndarray, "points 3"], cameras: Float[np.ndarray, "cameras 3"], reach: float = 100.0
) -> Float[np.ndarray, "visible 3"]:
    """Select the points that at least one of several cameras sees, as `single_view` does for one.

    Args:
        points: object point cloud, (points, 3), metres.
        cameras: positions of the cameras, (cameras, 3), metres, in the frame of the points.
        reach: radius of the sphere divided by the distance of the farthest point, above 1.

    Returns:
        The visible points, (visible, 3), in their order.

    Raises:
        InputError: a shape is wrong, a camera is at a point, or the points and a camera are in one plane.
    """
    points = np.asarray(checks.coordinates("merge_views()", "points", points))
    cameras = np.asarray(checks.coordinates("merge_views()", "cameras", cameras, "cameras"))
    if not reach > 1:
        raise InputError(f"merge_views(): reach is {reach}; expected a number above 1")
    return points[np.unique(np.concatenate([_on_hull(points, camera, reach) for camera in cameras]))]


def _on_hull(points: np.ndarray, camera: np.ndarray, reach: float) -> np.ndarray:
    from scipy.spatial import ConvexHull, QhullError

    from_camera = points.astype(np.float64) - camera
    distance = np.linalg.norm(from_camera, axis=1, keepdims=True)
    if not distance.all():
        raise InputError(
            f"merge_views(): the camera {camera.tolist()} is at one of the points; expected a distance above 0"
        )
    reflected = from_camera * (2 * reach * distance.max(initial=0) / distance - 1)
    try:
        hull = ConvexHull(np.concatenate([reflected, np.zeros((1, 3))]))
    except (QhullError, ValueError) as error:
        raise InputError(
            f"merge_views(): the {len(points)} points and the camera {camera.tolist()} are in one plane; "
            "expected at least 3 points and a camera outside their plane"
        ) from error
    return hull.vertices[hull.vertices < len(points)]


def cameras(count: int, rng: np.random.Generator) -> Float[np.ndarray, "cameras 3"]:
    """Spread directions evenly over the sphere: a Fibonacci spiral after a random rotation.

    Args:
        count: number of directions, at least 1.
        rng: random generator of the rotation.

    Returns:
        Unit vectors, (count, 3).
    """
    height = 1 - (2 * np.arange(count) + 1) / count
    angle = np.arange(count) * math.pi * (3 - math.sqrt(5))
    radius = np.sqrt(1 - height**2)
    spiral = np.stack([radius * np.cos(angle), radius * np.sin(angle), height], axis=1)
    return spiral @ Rotation.random(None, rng).as_matrix().T


def visible(
    mesh: "trimesh.Trimesh",
    points: Float[np.ndarray, "points 3"],
    directions: Float[np.ndarray, "cameras 3"],
    rng: np.random.Generator,
) -> Bool[np.ndarray, "cameras points"]:
    """Find the points of a mesh's surface that each camera sees.

    Each perspective camera looks at the centre of the bounding box from a distance of `DISTANCE` diagonals. A point is
    hidden if it is deeper than the nearest surface point in its pixel by more than `TOLERANCE`. Normals are not used,
    so the mesh may be open.

    Args:
        mesh: surface of the object.
        points: points on the surface, (points, 3), in the unit and frame of the mesh.
        directions: unit vectors from the object to the cameras, (cameras, 3), in the frame of the mesh.
        rng: random generator that samples the surface points of the depth buffer.

    Returns:
        Whether each camera sees each point, (cameras, points).
    """
    centre, diagonal = mesh.bounds.mean(axis=0), float(np.linalg.norm(mesh.extents))
    occluders = np.concatenate([sample_surface(mesh, OCCLUDERS, rng), points]) - centre
    rows = []
    for direction in directions:
        pixel, depth = _project(occluders / diagonal, direction)
        nearest = np.full(PIXELS**2, np.inf)
        np.minimum.at(nearest, pixel, depth)
        rows.append((depth <= nearest[pixel] + TOLERANCE)[OCCLUDERS:])
    return np.stack(rows)


def _project(points, direction):
    """Project points, in diagonals of the object about its centre, to indices of pixels and depths."""
    # The image may have any rotation about the direction of view.
    across = np.cross(direction, np.eye(3)[np.argmin(np.abs(direction))])
    across /= np.linalg.norm(across)
    depth = DISTANCE - points @ direction
    image = np.stack([points @ across, points @ np.cross(direction, across)], axis=1) * (DISTANCE / depth)[:, None]
    half_width = 0.6  # half a diagonal of the object, enlarged by perspective
    column, row = np.clip(((image / half_width + 1) / 2 * PIXELS).astype(int), 0, PIXELS - 1).T
    return column * PIXELS + row, depth
