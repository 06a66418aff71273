"""What cameras see of an object: of a cloud by hidden point removal, of a mesh by a depth buffer over many surface points."""

import math
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Bool, Float
from scipy.spatial.transform import Rotation

if TYPE_CHECKING:
    import trimesh

from tdf_jax._internal.errors import InputError
from tdf_jax.geometry.sampling import sample_surface

PIXELS = 160  # across twice the object's radius: 1.3 mm on a real mug
OCCLUDERS = 100_000  # points that fill the depth buffer; too few leave gaps through which hidden points show
# of the diagonal: a point this far behind the nearest one is hidden; thinner than most walls, 2 mm on a real mug
TOLERANCE = 0.012
DISTANCE = 3.0  # diagonals from the object's middle to the camera


def single_view(
    points: Float[np.ndarray, "points 3"], camera: Float[np.ndarray, "3"], reach: float = 100.0
) -> Float[np.ndarray, "visible 3"]:
    """The points a camera sees: hidden point removal by spherical flipping.

    Points are mirrored outwards through a large sphere around the camera; those on the convex hull of the mirrored
    points and the camera are visible. With the default reach, on 1500 points of a real mug seen from 0.6 m, 81-92 %
    of the points returned are truly visible, and 81-96 % of those visible are returned.

    Args:
        points: Points of an object, metres.
        camera: Position of the camera, metres, the same frame.
        reach: Radius of the sphere over the distance of the farthest point, above 1. Larger returns more points:
            a small one misses surfaces at grazing angles, a large one sees through sparse surfaces.

    Returns:
        The points seen, in their order.

    Raises:
        InputError: If the shapes are wrong, the camera is at a point, or points and camera lie in one plane.

    Source:
        Katz, Tal and Basri, Direct visibility of point sets, SIGGRAPH 2007.
    """
    return merge_views(points, np.asarray(camera)[None], reach)


def merge_views(
    points: Float[np.ndarray, "points 3"], cameras: Float[np.ndarray, "cameras 3"], reach: float = 100.0
) -> Float[np.ndarray, "visible 3"]:
    """The points that at least one of several cameras sees, in their order; see `single_view`."""
    points, cameras = np.asarray(points), np.asarray(cameras)
    if points.ndim != 2 or points.shape[1] != 3 or cameras.ndim != 2 or cameras.shape[1] != 3 or len(cameras) == 0:
        raise InputError(
            f"merge_views(): points have shape {points.shape} and cameras {cameras.shape}; "
            "expected (points, 3) and (cameras, 3) with at least one camera."
        )
    if not reach > 1:
        raise InputError(f"merge_views(): reach is {reach}; expected more than 1.")
    return points[np.unique(np.concatenate([_on_hull(points, camera, reach) for camera in cameras]))]


def _on_hull(points: np.ndarray, camera: np.ndarray, reach: float) -> np.ndarray:
    from scipy.spatial import ConvexHull, QhullError

    from_camera = points.astype(np.float64) - camera
    distance = np.linalg.norm(from_camera, axis=1, keepdims=True)
    if not distance.all():
        raise InputError(f"merge_views(): the camera {camera.tolist()} is at one of the points; move it away.")
    flipped = from_camera * (2 * reach * distance.max(initial=0) / distance - 1)
    try:
        hull = ConvexHull(np.concatenate([flipped, np.zeros((1, 3))]))
    except (QhullError, ValueError) as error:
        raise InputError(
            f"merge_views(): the {len(points)} points and the camera {camera.tolist()} lie in one plane or are not "
            "finite; expected at least 3 finite points and a camera outside their plane."
        ) from error
    return hull.vertices[hull.vertices < len(points)]


def cameras(count: int, rng: np.random.Generator) -> Float[np.ndarray, "cameras 3"]:
    """Directions spread evenly over the sphere (a Fibonacci spiral), randomly turned."""
    height = 1 - (2 * np.arange(count) + 1) / count
    angle = np.arange(count) * math.pi * (3 - math.sqrt(5))
    radius = np.sqrt(1 - height**2)
    spiral = np.stack([radius * np.cos(angle), radius * np.sin(angle), height], axis=1)
    return spiral @ Rotation.random(random_state=rng).as_matrix().T


def visible(
    mesh: "trimesh.Trimesh",
    points: Float[np.ndarray, "points 3"],
    directions: Float[np.ndarray, "cameras 3"],
    rng: np.random.Generator,
) -> Bool[np.ndarray, "cameras points"]:
    """Which points of a mesh's surface each camera sees.

    A perspective camera `DISTANCE` diagonals from the middle of the bounding box looks at it. Points in a pixel deeper
    than its nearest surface point by more than `TOLERANCE` are hidden; no normals are needed, so open meshes will do.

    Args:
        mesh: the object.
        points: on its surface.
        directions: unit vectors from the object towards the cameras.
        rng: draws the surface points of the depth buffer.
    """
    middle, diagonal = mesh.bounds.mean(axis=0), float(np.linalg.norm(mesh.extents))
    occluders = np.concatenate([sample_surface(mesh, OCCLUDERS, rng), points]) - middle
    rows = []
    for direction in directions:
        pixel, depth = _project(occluders / diagonal, direction)
        nearest = np.full(PIXELS**2, np.inf)
        np.minimum.at(nearest, pixel, depth)
        seen = depth <= nearest[pixel] + TOLERANCE
        rows.append(seen[OCCLUDERS:])
    return np.stack(rows)


def _project(points, direction):
    """Pixel index and depth of points, in diagonals, about the object's middle."""
    # Any two axes normal to the direction will do.
    across = np.cross(direction, np.eye(3)[np.argmin(np.abs(direction))])
    across /= np.linalg.norm(across)
    depth = DISTANCE - points @ direction
    flat = np.stack([points @ across, points @ np.cross(direction, across)], axis=1) * (DISTANCE / depth)[:, None]
    reach = 0.6  # the object's half diagonal, a little enlarged by perspective
    column, row = np.clip(((flat / reach + 1) / 2 * PIXELS).astype(int), 0, PIXELS - 1).T
    return column * PIXELS + row, depth
