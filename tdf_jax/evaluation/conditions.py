"""Conditions of the new object's cloud: complete, seen by cameras, sparse, noisy, or of another size."""

from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float

from tdf_jax.geometry.sampling import sample_surface
from tdf_jax.geometry.views import cameras, visible

if TYPE_CHECKING:
    import trimesh

VIEWS = {"views1": 1, "views2": 2, "views3": 3, "views4": 4}
SPARSE = {"points300": 300, "points1000": 1000, "points3000": 3000, "noise": 300}
SCALES = {"half": 0.5, "double": 2.0}
CONDITIONS = ("full", *VIEWS, *SPARSE, *SCALES)
NOISE = 0.002  # metres, standard deviation along each axis
SURFACE = 12_000  # surface points that cameras may see; one camera sees an eighth of them or more


def observed(
    mesh: "trimesh.Trimesh", condition: str, full: Float[np.ndarray, "points 3"], rng: np.random.Generator
) -> Float[np.ndarray, "seen 3"]:
    """The cloud of an object under a condition.

    Args:
        mesh: mesh of the object, metres, object frame; for "half" and "double" it already has that size.
        condition: one of `CONDITIONS`.
        full: complete cloud, (points, 3), metres, object frame; returned unchanged for conditions of size.
        rng: generator of the cameras, points and noise.

    Returns:
        Points, (seen, 3), metres, object frame; at most as many as `full` has if cameras see the object.
    """
    if condition in VIEWS:
        surface = sample_surface(mesh, SURFACE, rng)
        seen = visible(mesh, surface, cameras(VIEWS[condition], rng), rng).any(axis=0)
        return surface[seen][: len(full)]
    if condition in SPARSE:
        points = sample_surface(mesh, SPARSE[condition], rng)
        return points + NOISE * rng.standard_normal(points.shape) if condition == "noise" else points
    return full
