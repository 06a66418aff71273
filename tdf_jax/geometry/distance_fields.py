"""What a motion keeps clear of: signed distances to boxes, meshes, clouds and the object itself, in metres, by JAX.

An obstacle is a frozen dataclass, a pytree of arrays, with a method `distance(x)`: points (..., 3) of the world ->
signed distances (...), negative inside. Any class of that kind can be one. Boxes are exact; meshes, clouds and fields
are tabulated once on a grid, so that in an optimisation a point costs eight table entries, whatever the shape is.
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
from tdf_jax._internal.errors import InputError
from tdf_jax.geometry import se3
from tdf_jax.geometry.winding import libigl, winding_number

if TYPE_CHECKING:
    import trimesh

MOST_NODES = 4_000_000  # of a grid: 16 MB of float32, and a minute or less of distances


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Box:
    """A solid box; see `box_obstacle`.

    Attributes:
        T_world_box: pose `wxyz_xyz` of its centre.
        size: lengths of its edges, metres.
    """

    T_world_box: Float[Array, "7"]
    size: Float[Array, "3"]

    def distance(self, x: Float[Array, "*batch 3"]) -> Float[Array, "*batch"]:
        """Exact signed distances, metres.

        Args:
            x: points, metres, world frame.
        """
        # R^T (x - t), written out as in `poses.rotate`.
        R, away = se3.rotation(self.T_world_box), x - self.T_world_box[4:]
        place = jnp.stack([sum(R[i, axis] * away[..., i] for i in range(3)) for axis in range(3)], axis=-1)
        # jax's derivative of abs at 0 is 1: a point in the middle of a wall leaves by one side
        over = jnp.abs(place) - self.size / 2
        deepest = jnp.max(over, axis=-1)
        inside = deepest <= 0
        square = jnp.sum(jnp.maximum(over, 0) ** 2, axis=-1)
        return jnp.where(inside, deepest, jnp.sqrt(jnp.where(inside, 1.0, square)))


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class DistanceGrid:
    """Signed distances at the nodes of a regular grid along the world's axes; see `mesh_obstacle`, `cloud_obstacle` and `field_obstacle`.

    Attributes:
        origin: place of the first node, metres, world frame.
        pitch: distance between neighbours, metres.
        values: signed distances at the nodes, metres; at least two along each axis.
    """

    origin: Float[Array, "3"]
    pitch: Float[Array, ""]
    values: Float[Array, "x y z"]

    def distance(self, x: Float[Array, "*batch 3"]) -> Float[Array, "*batch"]:
        """Signed distances, metres, interpolated between the eight nodes around a point.

        Outside of the grid: the value at its nearest point and the way to it. That is continuous and no less than the
        true distance.

        Args:
            x: points, metres, world frame.
        """
        shape = self.values.shape
        last = jnp.array(shape) - 1
        place = (x - self.origin) / self.pitch
        nearest = jnp.clip(place, 0, last)
        corner = jnp.clip(jnp.floor(nearest), 0, last - 1).astype(jnp.int32)
        part = nearest - corner
        i = (corner[..., 0] * shape[1] + corner[..., 1]) * shape[2] + corner[..., 2]
        values, found = self.values.ravel(), 0.0
        for a in (0, 1):
            for b in (0, 1):
                for c in (0, 1):
                    weight = 1.0
                    for axis, side in enumerate((a, b, c)):
                        weight = weight * (part[..., axis] if side else 1 - part[..., axis])
                    found = found + weight * values[i + (a * shape[1] + b) * shape[2] + c]
        square = jnp.sum((place - nearest) ** 2, axis=-1)
        within = square == 0
        return found + self.pitch * jnp.where(within, 0.0, jnp.sqrt(jnp.where(within, 1.0, square)))


def box_obstacle(centre: ArrayLike, size: ArrayLike, rotation: ArrayLike | None = None) -> Box:
    """A box to keep clear of: a table, a wall, a shelf's board.

    Args:
        centre: of the box, metres, world frame.
        size: Lengths of its edges, three numbers above 0, metres.
        rotation: Of the box, 3x3 or wxyz; by default its edges lie along the world's axes.

    Returns:
        The obstacle.

    Raises:
        InputError: An argument has a wrong shape or value.
    """
    centre, size = checks.vector("box_obstacle()", "centre", centre), checks.vector("box_obstacle()", "size", size)
    if not (size > 0).all():
        raise InputError(
            f"box_obstacle(): size is {size.tolist()}; expected three lengths above 0, metres; give a sheet its thickness"
        )
    R = np.asarray(np.eye(3) if rotation is None else rotation, dtype=float)
    if R.shape == (4,):
        if not (np.isfinite(R).all() and R.any()):
            raise InputError(
                f"box_obstacle(): rotation wxyz is {R.tolist()}; expected a finite quaternion that is not zero"
            )
        wxyz = R / np.linalg.norm(R)
    elif R.shape == (3, 3):
        checks.rotations("box_obstacle()", "rotation", R)
        wxyz = se3.wxyz_from_matrix(jnp.asarray(R))
    else:
        raise InputError(f"box_obstacle(): rotation has shape {R.shape}; expected (3, 3), or (4,) as wxyz")
    return Box(jnp.concatenate([jnp.asarray(wxyz), jnp.asarray(centre)]), jnp.asarray(size))


def mesh_obstacle(mesh: "trimesh.Trimesh", pitch: float = 0.01, pad: float = 0.05) -> DistanceGrid:
    """A mesh to keep clear of, closed or open.

    Inside is where the winding number is above a half either way, so small holes do not matter, nor which way the faces
    look; a single sheet has no inside, and a bowl of one sheet holds the part of its hollow that sees less than half of
    the sky. Between nodes the distance is at most 0.87 pitches too large, in the middle of a sheet or of a wall thinner
    than a pitch half a pitch.

    Args:
        mesh: The surface, metres, world frame.
        pitch: Of the grid, metres; a half or less of the thinnest wall that matters, or of the margin that is kept from
            it.
        pad: How far the grid reaches beyond the mesh, metres; more than the margin that is kept.

    Returns:
        The obstacle.

    Raises:
        InputError: The mesh has no faces or is not finite, pitch or pad is not above 0, the grid has more than 4
            million nodes, or libigl is not installed.
    """
    igl = libigl("mesh_obstacle()")
    if not (hasattr(mesh, "vertices") and hasattr(mesh, "faces")):
        raise InputError(
            f"mesh_obstacle(): mesh is a {type(mesh).__name__}; expected a trimesh.Trimesh, such as tdf.load_mesh(path)"
        )
    vertices, faces = np.asarray(mesh.vertices, float), np.asarray(mesh.faces, np.int64)
    if len(faces) == 0 or not np.isfinite(vertices).all():
        raise InputError(
            f"mesh_obstacle(): the mesh has {len(faces)} faces, or vertices that are not finite; expected a surface"
        )

    def signed(x):
        distance = np.sqrt(igl.point_mesh_squared_distance(x, vertices, faces)[0])
        return np.where(np.abs(winding_number(mesh, x)) > 0.5, -distance, distance)

    return tabulated("mesh_obstacle", vertices[faces].reshape(-1, 3), pitch, pad, signed)


def cloud_obstacle(
    points: Float[Array, "points 3"], radius: float = 0.005, pitch: float = 0.005, pad: float = 0.05
) -> DistanceGrid:
    """A cloud to keep clear of: a ball about each of its points, all of them counted however many there are.

    The space behind a seen surface is free, as far as a cloud tells. Between nodes the distance is at most 0.87 pitches
    too large, so with a radius of one pitch, as by default, no point of the cloud is outside.

    Args:
        points: Metres, world frame; at least 21, as for `encode`.
        radius: Of the balls, metres; half of the distance between neighbouring points or more closes a surface. May be
            0.
        pitch: Of the grid, metres.
        pad: How far the grid reaches beyond the points, metres; more than the margin that is kept and the radius.

    Returns:
        The obstacle.

    Raises:
        InputError: The points are not a cloud, radius is negative, pitch or pad not above 0, or the grid has more than
            4 million nodes.
    """
    from scipy.spatial import cKDTree

    points = np.asarray(checks.points("cloud_obstacle()", points), float)
    if not (np.ndim(radius) == 0 and 0 <= radius < np.inf):
        raise InputError(f"cloud_obstacle(): radius is {radius}; expected a length of 0 or more, metres")
    tree = cKDTree(points)
    return tabulated("cloud_obstacle", points, pitch, pad, lambda x: tree.query(x)[0] - radius)


def check_lengths(function: str, pitch: float, pad: float) -> None:
    for name, value in (("pitch", pitch), ("pad", pad)):
        if not (np.ndim(value) == 0 and 0 < value < np.inf):
            raise InputError(f"{function}(): {name} is {value}; expected a length above 0, metres")


def grid_nodes(function: str, points: np.ndarray, pitch: float, pad: float) -> Float[np.ndarray, "x y z 3"]:
    low, high = points.min(axis=0) - pad, points.max(axis=0) + pad
    counts = np.ceil((high - low) / pitch - 1e-6).astype(int) + 1
    if np.prod(counts, dtype=float) > MOST_NODES:
        raise InputError(
            f"{function}(): a grid of {' x '.join(map(str, counts))} nodes at a pitch of {pitch} m; expected at most {MOST_NODES} nodes; "
            "raise pitch, or cut away what is out of reach"
        )
    return np.stack(np.meshgrid(*(low[i] + pitch * np.arange(counts[i]) for i in range(3)), indexing="ij"), axis=-1)


def tabulated(
    function: str, points: np.ndarray, pitch: float, pad: float, signed: Callable[[np.ndarray], np.ndarray]
) -> DistanceGrid:
    check_lengths(function, pitch, pad)
    x = grid_nodes(function, points, pitch, pad)
    values = signed(x.reshape(-1, 3)).reshape(x.shape[:3])
    return DistanceGrid(jnp.asarray(x[0, 0, 0]), jnp.asarray(pitch, float), jnp.asarray(values))
