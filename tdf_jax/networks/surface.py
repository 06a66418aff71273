"""The surface of occupancy 1/2 of a field, as triangles."""

import jax
import numpy as np
from jaxtyping import Float

from tdf_jax.geometry.winding import libigl
from tdf_jax.networks.field import DescriptorField

# along the diagonal of the box that is searched: 1.7 mm on a common mug; coarser ones tear its wall into stripes
CELLS = 120
CHUNK = 20_000  # points evaluated at a time


def reconstructed(
    field: DescriptorField, T_world_object: Float[np.ndarray, "4 4"], bounds: Float[np.ndarray, "2 3"]
) -> Float[np.ndarray, "faces 3 3"]:
    """The surface of occupancy 0.5, by marching cubes.

    Args:
        field: of an object in the world.
        T_world_object: how the object's frame lies there, 4x4.
        bounds: lowest and highest corner of the object, in its frame, metres; 5 % of the diagonal beyond are searched
            too.

    Returns:
        Triangles in the object's frame, metres; none if the occupancy is nowhere above 0.5.

    Raises:
        InputError: libigl is not installed.
    """
    igl = libigl("reconstructed()")
    pad = 0.05 * np.linalg.norm(bounds[1] - bounds[0])
    low, high = bounds[0] - pad, bounds[1] + pad
    counts = np.maximum(2, np.ceil((high - low) / np.linalg.norm(high - low) * CELLS).astype(int) + 1)
    z, y, x = np.meshgrid(*(np.linspace(low[i], high[i], counts[i]) for i in (2, 1, 0)), indexing="ij")
    grid = np.stack([x, y, z], axis=-1).reshape(-1, 3)  # x runs fastest
    world = grid @ T_world_object[:3, :3].T + T_world_object[:3, 3]
    padded = np.zeros((-(-len(world) // CHUNK) * CHUNK, 3), np.float32)  # one shape for all objects: compiled once
    padded[: len(world)] = world
    values = np.concatenate([_logits(field, chunk) for chunk in padded.reshape(-1, CHUNK, 3)])[: len(world)]
    vertices, faces, _ = igl.marching_cubes(values.astype(float), grid, *map(int, counts), 0.0)
    return np.asarray(vertices)[np.asarray(faces)].reshape(-1, 3, 3)


@jax.jit
def _logits(field, x):
    # Interpolated between grid points, probabilities that jump from 0 to 1 would give stairs.
    p = jax.numpy.clip(field.occupancy(x), 1e-6, 1 - 1e-6)
    return jax.numpy.log(p) - jax.numpy.log1p(-p)
