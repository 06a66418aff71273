"""A demonstration and the object to imitate it on, in one world frame."""

import dataclasses
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Array, Float

from tdf_jax.demonstration import Demonstration
from tdf_jax.evaluation.truth import expected_trajectory
from tdf_jax.trajectory import Trajectory

if TYPE_CHECKING:
    import trimesh


@dataclasses.dataclass(frozen=True)
class Scene:
    """A demonstration, and the object to imitate it on.

    Attributes:
        demonstration: as given or generated.
        points: the target's cloud, (points, 3), metres, world frame.
        T_world_target: how the file's frame, or the generated mug's, lies in the world, 4x4.
        T_world_handles: frames of the handle on both objects, 4x4; None unless both are generated.
        meshes: of both objects, world frame, where they have one.
    """

    demonstration: Demonstration
    points: Float[np.ndarray, "points 3"]
    T_world_target: Float[np.ndarray, "4 4"]
    T_world_handles: tuple[Float[np.ndarray, "4 4"], Float[np.ndarray, "4 4"]] | None
    meshes: "tuple[trimesh.Trimesh | None, trimesh.Trimesh | None]"

    def expected(self, goal: Float[Array, "7"]) -> Trajectory | None:
        """The true trajectory on the target for a goal; None where it is not known."""
        if self.T_world_handles is None:
            return None
        return expected_trajectory(self.demonstration.trajectory, *self.T_world_handles, goal)
