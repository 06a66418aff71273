"""Obstacles: differentiable signed distances to boxes, meshes and clouds.

An obstacle is a frozen dataclass, a pytree of arrays, with a method `distance(x)` that maps points (..., 3), metres,
world frame, to signed distances (...), metres, negative inside. Any such class is an obstacle. Distances to boxes are
exact. Distances to meshes, clouds and fields are tabulated once on a grid, so that in an optimisation every point reads
eight table entries, whatever the shape.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from numpy.typing import ArrayLike

from tdf_jax._internal import checks
from tdf_jax._internal.boundary import public
from tdf_jax._internal.errors import InputError
from tdf_jax.geometry import se3
from tdf_jax.geometry.winding import libigl, winding_number

if TYPE_CHECKING:
    import trimesh

MAX_NODES = 4_000_000  # nodes of a grid: 16 MB of float32, and at most a minute to compute their distances


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Box:
    """A solid box, made by `box_obstacle`.

    Attributes:
        T_world_box: pose `wxyz_xyz` of the box's centre, (7,), metres, world frame.
        size: lengths of the edges, (3,), metres.
    """

    T_world_box: Float[Array, "7"]
    size: Float[Array, "3"]

    @public
    def distance(self, x: Float[Array, "*batch 3"]) -> Float[Array, "*batch"]:
        """Compute exact signed distances.

        Args:
            x: points, (..., 3), metres, world frame.

        Returns:
            Signed distances, (...), metres.
        """
        # R^T (x - t), with written-out components as in `se3.rotate`
        R, offset = se3.rotation(self.T_world_box), x - self.T_world_box[4:]
        local = jnp.stack(
            [
                R[0, axis] * offset[..., 0] + R[1, axis] * offset[..., 1] + R[2, axis] * offset[..., 2]
                for axis in range(3)
            ],
            axis=-1,
        )
        # JAX's derivative of abs at 0 is 1, so a point in the middle of a wall is pushed to one side
        outside = jnp.abs(local) - self.size / 2
        nearest_face = jnp.max(outside, axis=-1)
        inside = nearest_face <= 0
        square = jnp.sum(jnp.maximum(outside, 0) ** 2, axis=-1)
        return jnp.where(inside, nearest_face, jnp.sqrt(jnp.where(inside, 1.0, square)))


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class DistanceGrid:
    """Signed distances at the nodes of a regular grid along the world's axes.

    `mesh_obstacle`, `cloud_obstacle` and `field_obstacle` make such grids.

    Attributes:
        origin: position of the first node, (3,), metres, world frame.
        pitch: distance between neighbouring nodes, metres.
        values: signed distances at the nodes, (x, y, z), metres; at least two nodes along each axis.
    """

    origin: Float[Array, "3"]
    pitch: Float[Array, ""]
    values: Float[Array, "x y z"]

    @public
    def distance(self, x: Float[Array, "*batch 3"]) -> Float[Array, "*batch"]:
        """Interpolate signed distances between the eight nodes around a point.

        Outside the grid the distance is the value at the nearest point of the grid plus the distance from that point.
        It is continuous and at least the true distance.

        Args:
            x: points, (..., 3), metres, world frame.

        Returns:
            Signed distances, (...), metres.
        """
        # `jax.scipy.ndimage.map_coordinates` has the same values, but its gradient is zero at nodes on the upper faces,
        # and values with gradients take longer.
        shape = self.values.shape
        last = jnp.array(shape) - 1
        coordinates = (x - self.origin) / self.pitch
        nearest = jnp.clip(coordinates, 0, last)
        corner = jnp.clip(jnp.floor(nearest), 0, last - 1).astype(jnp.int32)
        fraction = nearest - corner
        i = (corner[..., 0] * shape[1] + corner[..., 1]) * shape[2] + corner[..., 2]
        values, interpolated = self.values.ravel(), jnp.zeros((), self.values.dtype)
        for a in (0, 1):
            for b in (0, 1):
                for c in (0, 1):
                    weight = 1.0
                    for axis, side in enumerate((a, b, c)):
                        weight = weight * (fraction[..., axis] if side else 1 - fraction[..., axis])
                    interpolated = interpolated + weight * values[i + (a * shape[1] + b) * shape[2] + c]
        square = jnp.sum((coordinates - nearest) ** 2, axis=-1)
        within = square == 0
        return interpolated + self.pitch * jnp.where(within, 0.0, jnp.sqrt(jnp.where(within, 1.0, square)))


@public
def box_obstacle(centre: ArrayLike, size: ArrayLike, rotation: ArrayLike | None = None) -> Box:
    """Make an obstacle of a box, such as a table, a wall or a board of a shelf.

    Args:
        centre: centre of the box, (3,), metres, world frame.
        size: lengths of the edges, (3,), above 0, metres; a sheet needs a thickness.
        rotation: orientation of the box, (3, 3) or (4,) as wxyz, world frame; by default the edges are along the
            world's axes.

    Returns:
        The obstacle.

    Raises:
        InputError: an argument has a wrong shape or value.
    """
    middle = jnp.asarray(checks.vector("box_obstacle()", "centre", centre))
    edges = jnp.asarray(checks.lengths("box_obstacle()", "size", size))
    R = checks.orientation("box_obstacle()", "rotation", np.eye(3) if rotation is None else rotation)
    wxyz = jnp.asarray(R / np.linalg.norm(R)) if R.shape == (4,) else se3.wxyz_from_matrix(jnp.asarray(R))
    return Box(jnp.concatenate([wxyz, middle]), edges)


@public
def mesh_obstacle(mesh: "trimesh.Trimesh", pitch: float = 0.01, pad: float = 0.05) -> DistanceGrid:
    """Make an obstacle of a mesh, closed or open.

    A point is inside if the absolute winding number is above a half, so small holes do not matter, nor does the
    orientation of the faces. A single sheet has no inside. The inside of a bowl made of one sheet is the part of its
    hollow from which less than half of all directions are free. Between nodes the distance is at most 0.87 pitches
    (half a cell's diagonal) too large; in the middle of a sheet, or of a wall thinner than a pitch, half a pitch.

    Args:
        mesh: surface, metres, world frame.
        pitch: distance between neighbouring nodes of the grid, metres; at most half of the thinnest wall that matters,
            or of the margin to keep from it.
        pad: distance by which the grid extends beyond the mesh, metres; more than the margin to keep.

    Returns:
        The obstacle.

    Raises:
        InputError: the mesh has no faces or is not finite, pitch or pad is not above 0, the grid has more than
            `MAX_NODES` nodes, or libigl is not installed.
    """
    igl = libigl("mesh_obstacle()")
    if not (hasattr(mesh, "vertices") and hasattr(mesh, "faces")):
        raise InputError(
            f"mesh_obstacle(): mesh is a {type(mesh).__name__}; expected a trimesh.Trimesh, such as tdf.load_mesh(path)"
        )
    vertices, faces = np.asarray(mesh.vertices, float), np.asarray(mesh.faces, np.int64)
    if len(faces) == 0 or not np.isfinite(vertices).all():
        raise InputError(
            f"mesh_obstacle(): the mesh has {len(faces)} faces, or vertices that are not finite; "
            "expected a finite surface"
        )

    def signed(x):
        distance = np.sqrt(igl.point_mesh_squared_distance(x, vertices, faces)[0])
        return np.where(np.abs(winding_number(mesh, x)) > 0.5, -distance, distance)

    return tabulated("mesh_obstacle()", vertices[faces].reshape(-1, 3), pitch, pad, signed)


@public
def cloud_obstacle(
    points: Float[Array, "points 3"], radius: float = 0.005, pitch: float = 0.005, pad: float = 0.05
) -> DistanceGrid:
    """Make an obstacle of a point cloud: a ball around each of its points.

    Every point counts. The space behind a visible surface is free, because the cloud does not describe it. Between
    nodes the distance is at most 0.87 pitches (half a cell's diagonal) too large, so with a radius of one pitch, the
    default, no point of the cloud is outside.

    Args:
        points: point cloud, (points, 3), metres, world frame; at least 21 points, as for `encode`.
        radius: radius of the balls, 0 or more, metres; half of the distance between neighbouring points closes a
            surface.
        pitch: distance between neighbouring nodes of the grid, metres.
        pad: distance by which the grid extends beyond the points, metres; more than the margin to keep plus the radius.

    Returns:
        The obstacle.

    Raises:
        InputError: the points are not a point cloud, radius is negative, pitch or pad is not above 0, or the grid has
            more than `MAX_NODES` nodes.
    """
    from scipy.spatial import KDTree

    centres = np.asarray(checks.points("cloud_obstacle()", points), float)
    checks.number("cloud_obstacle()", "radius", radius, least=0, unit="metres")
    tree = KDTree(centres)
    return tabulated("cloud_obstacle()", centres, pitch, pad, lambda x: np.asarray(tree.query(x)[0]) - radius)


def grid_nodes(function: str, points: np.ndarray, pitch: float, pad: float) -> Float[np.ndarray, "x y z 3"]:
    """Place the nodes of a regular grid along the world's axes over the bounding box of some points.

    Args:
        function: name that error messages begin with.
        points: points, (points, 3), metres, world frame.
        pitch: distance between neighbouring nodes, metres.
        pad: distance by which the grid extends beyond the bounding box, metres.

    Returns:
        Positions of the nodes, (x, y, z, 3), metres, world frame.

    Raises:
        InputError: pitch or pad is not above 0, or the grid has more than `MAX_NODES` nodes.
    """
    checks.positive(function, "pitch", pitch, "metres")
    checks.positive(function, "pad", pad, "metres")
    low, high = points.min(axis=0) - pad, points.max(axis=0) + pad
    counts = np.ceil((high - low) / pitch - 1e-6) + 1
    if not np.prod(counts) <= MAX_NODES:  # before it is an integer, which may be too small for it
        raise InputError(
            f"{function}: the grid has {' x '.join(f'{count:.0f}' for count in counts)} nodes at a pitch of {pitch} m; "
            f"expected at most {MAX_NODES} nodes; raise pitch, or remove distant points"
        )
    counts = counts.astype(int)
    return np.stack(np.meshgrid(*(low[i] + pitch * np.arange(counts[i]) for i in range(3)), indexing="ij"), axis=-1)


def tabulated(
    function: str, points: np.ndarray, pitch: float, pad: float, signed: Callable[[np.ndarray], np.ndarray]
) -> DistanceGrid:
    """Tabulate signed distances on a grid.

    Args:
        function: name that error messages begin with.
        points: points whose bounding box the grid covers, (points, 3), metres, world frame.
        pitch: distance between neighbouring nodes, metres.
        pad: distance by which the grid extends beyond the bounding box, metres.
        signed: function from nodes (nodes, 3) to their signed distances (nodes,), metres.

    Returns:
        The grid of distances.

    Raises:
        InputError: pitch or pad is not above 0, or the grid has more than `MAX_NODES` nodes.
    """
    x = grid_nodes(function, points, pitch, pad)
    values = signed(x.reshape(-1, 3)).reshape(x.shape[:3])
    return DistanceGrid(jnp.asarray(x[0, 0, 0]), jnp.asarray(pitch, float), jnp.asarray(values))
