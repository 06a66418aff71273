"""A demonstration and the object to imitate it on, in one world frame."""

import dataclasses
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Array, Float

from tdf_jax.evaluation.cases import Case
from tdf_jax.evaluation.metrics import expected_trajectory, nearest_place
from tdf_jax.geometry.demonstration import Demonstration
from tdf_jax.geometry.paths import PATHS, SHAPES
from tdf_jax.geometry.trajectory import Trajectory

if TYPE_CHECKING:
    import trimesh

PLACE = (0.0, 0.24, 0.18)  # metres from the pick: 0.30 m away, to the side and up
LIFT = (0.0, 0.0, 1.0)  # a semicircle and a wave leave the straight line upwards first


@dataclasses.dataclass(frozen=True)
class Scene:
    """A demonstration, and the object to imitate it on.

    Attributes:
        demonstration: as given or generated.
        points: the target's cloud, (points, 3), metres, world frame.
        T_world_target: how the file's frame, or the generated object's, lies in the world, 4x4.
        T_world_places: frames of the picked place, such as a mug's handle, on both objects, 4x4; None unless both are
            generated.
        meshes: of both objects, world frame, where they have one.
        fold: symmetry of a generated target about the z axis of its frame, see `tdf_jax.symmetry`.
    """

    demonstration: Demonstration
    points: Float[np.ndarray, "points 3"]
    T_world_target: Float[np.ndarray, "4 4"]
    T_world_places: tuple[Float[np.ndarray, "4 4"], Float[np.ndarray, "4 4"]] | None
    meshes: "tuple[trimesh.Trimesh | None, trimesh.Trimesh | None]"
    fold: int = 1

    def expected(self, goal: Float[Array, "7"], pick: Float[Array, "7"] | None = None) -> Trajectory | None:
        """The true trajectory on the target for a goal; None where it is not known.

        Args:
            goal: last pose, T_world_query.
            pick: first pose that was found: of a symmetric target's true picks, the one nearest to it begins the
                trajectory.
        """
        if self.T_world_places is None:
            return None
        shown, (place_a, place_b) = self.demonstration.trajectory, self.T_world_places
        if pick is not None:
            found = Trajectory(np.asarray(pick)[None]).matrices[0] @ np.linalg.inv(shown.matrices[0]) @ place_a
            place_b = nearest_place(self.T_world_target, found, place_b, self.fold)
        return expected_trajectory(shown, place_a, place_b, goal)


def place_demonstration(case: Case, path: str, poses: int, query: Float[Array, "queries 3"]) -> Demonstration:
    """A trajectory shown on a case's first object, from its place (a mug's handle) to `PLACE` away from there.

    Args:
        case: with the object and the place on it.
        path: one of `tdf_jax.geometry.paths.PATHS`.
        poses: of the trajectory.
        query: points in the query frame, metres.
    """
    pick = case.T_world_place_a
    start, bow = pick[:3, 3], {"bulge": LIFT} if path in SHAPES and path != "line" else {}
    trajectory = PATHS[path](poses, start, start + np.multiply(PLACE, case.scale), rotation=pick[:3, :3], **bow)
    return Demonstration(case.points_a, trajectory, query)
