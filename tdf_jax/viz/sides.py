"""The two sides of a moving picture of an imitation: the demonstration, and the imitation on the new object."""

import dataclasses
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float

from tdf_jax.solvers.imitation_scene import ImitationScene
from tdf_jax.viz.motion import Motion, motion_of
from tdf_jax.viz.scene3d import MARGIN, thinned

if TYPE_CHECKING:
    import trimesh


@dataclasses.dataclass(frozen=True, eq=False)
class Side:
    """What one side shows, metres, world frame.

    Attributes:
        name: its title.
        motion: where the query frame and the object are in every frame.
        points: cloud of the object before the grasp, (points, 3).
        mesh: mesh of the object; None if there is none.
        target: cloud of the target, (points, 3); None if there is none.
        path: poses T_world_query, (poses, 7).
    """

    name: str
    motion: Motion
    points: Float[np.ndarray, "points 3"]
    mesh: "trimesh.Trimesh | None"
    target: Float[np.ndarray, "target_points 3"] | None
    path: Float[np.ndarray, "poses 7"]

    def content(self, box: Float[np.ndarray, "8 3"]) -> Float[np.ndarray, "_ 3"]:
        """All that is shown in any frame, (points, 3), metres.

        Args:
            box: corners of the box of query points, (8, 3), metres, query frame.
        """
        motion, cloud = self.motion, thinned(self.points)
        objects = np.einsum("fij,nj->fni", motion.object_rotations, cloud) + motion.object_translations[:, None]
        boxes = np.einsum("fij,nj->fni", motion.rotations, box) + motion.translations[:, None]
        parts = [objects.reshape(-1, 3), boxes.reshape(-1, 3), self.path[:, 4:]]
        return np.concatenate(parts if self.target is None else [*parts, self.target])


def sides_of(scene: ImitationScene, share: Float[np.ndarray, " frames"]) -> tuple[Side, Side]:
    """Demonstration and imitation.

    Args:
        scene: the imitation.
        share: places on both trajectories, (frames,), from 0 at their first pose to 1 at their last.
    """
    demonstration, result = scene.demonstration, scene.result
    stood = None if demonstration.target is None else np.asarray(demonstration.target.points)
    stands = stood if scene.target_points is None else np.asarray(scene.target_points)
    shown, found = np.asarray(demonstration.trajectory.wxyz_xyz), np.asarray(result.trajectory.wxyz_xyz)
    first, second = (
        motion_of(path, one.grasp, one.release, share * (len(path) - 1))
        for path, one in ((shown, demonstration), (found, result))
    )
    return (
        Side("demonstration", first, np.asarray(demonstration.points), scene.meshes[0], stood, shown),
        Side("imitation", second, np.asarray(scene.points), scene.meshes[1], stands, found),
    )


def sizes_of(scene: ImitationScene, contents: list[Float[np.ndarray, "_ 3"]]) -> list[Float[np.ndarray, "3"]]:
    """Lengths of the axes of both sides, (3,) each, in the unit of the contents.

    Both have one scale; but a way of a metre to a target is drawn as large as possible.

    Args:
        scene: the imitation.
        contents: all that each side shows in any frame, (points, 3) each.
    """
    sizes = [MARGIN * np.ptp(content, axis=0) for content in contents]
    return sizes if scene.demonstration.target is not None else [np.max(sizes, axis=0)] * 2
