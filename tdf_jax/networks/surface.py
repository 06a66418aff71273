"""Surface of a descriptor field: where its occupancy is 1/2, as triangles."""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from tdf_jax.geometry.winding import libigl
from tdf_jax.networks.field import DescriptorField

CELLS = 120  # cells along the box's diagonal: 1.7 mm on a common mug; coarser cells tear its wall into stripes
CHUNK_POINTS = 20_000  # points evaluated at a time


def surface_triangles(
    field: DescriptorField, T_world_object: Float[np.ndarray, "4 4"], bounds: Float[np.ndarray, "2 3"]
) -> Float[np.ndarray, "faces 3 3"]:
    """The surface of occupancy 0.5, by marching cubes.

    Args:
        field: descriptor field of the object, in the world frame.
        T_world_object: pose of the object's frame, (4, 4), metres.
        bounds: lowest and highest corner of the object, (2, 3), metres, object frame; a margin of 5 % of the diagonal
            is searched too.

    Returns:
        Triangles, (faces, 3, 3), metres, object frame; none if the occupancy is nowhere above 0.5.

    Raises:
        InputError: libigl is not installed.
    """
    igl = libigl("surface_triangles()")
    pad = 0.05 * np.linalg.norm(bounds[1] - bounds[0])
    low, high = bounds[0] - pad, bounds[1] + pad
    counts = np.maximum(2, np.ceil((high - low) / np.linalg.norm(high - low) * CELLS).astype(int) + 1)
    z, y, x = np.meshgrid(*(np.linspace(low[i], high[i], counts[i]) for i in (2, 1, 0)), indexing="ij")
    grid = np.stack([x, y, z], axis=-1).reshape(-1, 3)  # x runs fastest
    world = grid @ T_world_object[:3, :3].T + T_world_object[:3, 3]
    # One shape for all objects compiles once.
    padded = np.zeros((-(-len(world) // CHUNK_POINTS) * CHUNK_POINTS, 3), np.float32)
    padded[: len(world)] = world
    values = np.concatenate([_logits(field, chunk) for chunk in padded.reshape(-1, CHUNK_POINTS, 3)])[: len(world)]
    nx, ny, nz = map(int, counts)
    vertices, faces, _ = igl.marching_cubes(values.astype(float), grid, nx, ny, nz, 0.0)
    return np.asarray(vertices)[np.asarray(faces)].reshape(-1, 3, 3)


@jax.jit
def _logits(field, x):
    # Marching cubes interpolates between grid points: probabilities, which jump from 0 to 1, would give stairs.
    p = jnp.clip(field.occupancy(x), 1e-6, 1 - 1e-6)
    return jnp.log(p) - jnp.log1p(-p)
