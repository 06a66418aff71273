"""What depth cameras around an object see of its surface, by a depth buffer over many surface points."""

import math
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Bool, Float
from scipy.spatial.transform import Rotation

if TYPE_CHECKING:
    import trimesh

from tdf_jax.pointcloud import sample_surface

PIXELS = 160  # across twice the object's radius: 1.3 mm on a real mug
OCCLUDERS = 100_000  # points that fill the depth buffer: about 8 for every pixel a mug covers from the side
TOLERANCE = 0.012  # of the diagonal: a point this far behind the nearest one is hidden; thinner than most walls, 2 mm on a real mug
DISTANCE = 3.0  # diagonals from the object's middle to the camera


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

    A perspective camera `DISTANCE` diagonals from the middle of the bounding box looks at it. Points in a pixel deeper than its
    nearest surface point by more than `TOLERANCE` are hidden; no normals are needed, so open meshes will do.

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
