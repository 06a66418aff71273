"""A demonstration and the target object of its imitation, in one world frame."""

import dataclasses
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Array, Float

from tdf_jax.evaluation.metrics import expected_trajectory, nearest_place
from tdf_jax.geometry import se3
from tdf_jax.geometry.demonstration import Demonstration
from tdf_jax.geometry.trajectory import Trajectory

if TYPE_CHECKING:
    import trimesh


@dataclasses.dataclass(frozen=True)
class Scene:
    """A demonstration, and the target object of its imitation.

    Attributes:
        demonstration: the demonstration, from a file or generated.
        points: cloud of the target, (points, 3), metres, world frame.
        T_world_target: pose of the frame of the target's file, or of the generated object, 4x4.
        T_world_places: frames of the picked place, such as a mug's handle, on both objects, 4x4; None unless both are
            generated.
        meshes: meshes of both objects, metres, world frame; None where there is none.
        fold: symmetry of a generated target about the z axis of its frame, see `tdf_jax.geometry.symmetry`.
        others: frames of places of a generated target that are as right as the picked one, 4x4, world frame.
    """

    demonstration: Demonstration
    points: Float[np.ndarray, "points 3"]
    T_world_target: Float[np.ndarray, "4 4"]
    T_world_places: tuple[Float[np.ndarray, "4 4"], Float[np.ndarray, "4 4"]] | None
    meshes: "tuple[trimesh.Trimesh | None, trimesh.Trimesh | None]"
    fold: int = 1
    others: tuple[Float[np.ndarray, "4 4"], ...] = ()

    def expected(self, goal: Float[Array, "7"], pick: Float[Array, "7"] | None = None) -> Trajectory | None:
        """The true trajectory on the target for a goal; None where it is not known.

        Args:
            goal: last pose, T_world_query, `wxyz_xyz`.
            pick: estimated first pose, `wxyz_xyz`. A symmetric target, or one with `others`, has several true picks,
                and the trajectory begins at the one nearest to the estimate.
        """
        if self.T_world_places is None:
            return None
        demonstrated, (place_a, place_b) = self.demonstration.trajectory, self.T_world_places
        if pick is not None and (self.fold != 1 or self.others):
            T_world_demonstrated, T_world_pick = np.asarray(
                se3.matrix(np.stack([demonstrated.wxyz_xyz[0], pick]).astype(demonstrated.wxyz_xyz.dtype))
            )
            estimate = T_world_pick @ np.linalg.inv(T_world_demonstrated) @ place_a
            place_b = nearest_place(self.T_world_target, estimate, place_b, self.fold, self.others)
        return expected_trajectory(demonstrated, place_a, place_b, goal)
