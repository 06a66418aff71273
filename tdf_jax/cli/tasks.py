"""Scenes of `tdf imitate --task`: a demonstration on a generated object and target, and another pair to imitate it."""

import dataclasses
from typing import cast

import numpy as np
from jaxtyping import Array, Float

from tdf_jax._internal.errors import InputError
from tdf_jax.cli.options import Settings
from tdf_jax.evaluation.relation_success import judge
from tdf_jax.evaluation.relation_tasks import (
    MOST_DRAWS,
    RELATIONS,
    Pair,
    Placement,
    demonstrate,
    draw_pair,
    place_pair,
)
from tdf_jax.evaluation.scene import Scene
from tdf_jax.geometry.trajectory import Trajectory
from tdf_jax.geometry.winding import libigl

POSES = {"random": "uniform", "given": "upright"}  # --target-pose, in the words of `place_pair`


@dataclasses.dataclass(frozen=True, eq=False)
class TaskScene:
    """A demonstrated pair, and the object and target of its imitation.

    Attributes:
        scene: the demonstration and the new object.
        placement: the new object and its target in the world.
        target_points: cloud of the new target, (points, 3), metres, world frame; None if the demonstrated target has
            not moved.
    """

    scene: Scene
    placement: Placement
    target_points: Float[np.ndarray, "target_points 3"] | None

    def judged(self, object_motion: Float[Array, "7"]) -> dict:
        """Judge a placement against the exact solids: lengths in metres, the tilt in degrees.

        Args:
            object_motion: motion M of the object, `wxyz_xyz`, (7,), metres, world frame.

        Returns:
            Gap, penetration, tilt, hung, supported and success; all None where libigl is not installed.
        """
        motion = np.asarray(Trajectory(object_motion[None]).matrices[0], float)
        try:
            libigl("tdf imitate")
        except InputError:  # the extra "mesh" has it
            return not_judged()
        placed = judge(self.placement.pair, self.placement.placed(motion))
        return dataclasses.asdict(placed) | {"success": placed.holds()}


def not_judged() -> dict:
    """The record of a placement whose truth is not known."""
    return dict.fromkeys(("gap", "penetration", "tilt", "hung", "supported", "success"))


def make_task(settings: Settings) -> TaskScene:
    """Generate both pairs of a task and the demonstration.

    Pair 0 of the seed is demonstrated. A target that is found is that of pair 1, with its object. A known target is the
    demonstrated one where it stood, and the object is that of the first pair after 0 that fits it.

    Args:
        settings: settings from `resolved`, with a task.

    Raises:
        InputError: a number of points that makes no cloud.
    """
    task, seed = cast(str, settings.task), settings.seed
    shown = draw_pair(task, seed, 0)
    demonstration = demonstrate(shown, seed, settings.points)
    known = str(settings.target) == "known"
    pair = _fitting(shown, seed) if known else draw_pair(task, seed, 1)
    placement = place_pair(pair, seed, POSES[cast(str, settings.target_pose)], points=settings.points)
    if known and demonstration.target is not None:
        T_world_target = np.eye(4)
        T_world_target[2, 3] = -shown.target.mesh.bounds[0, 2]  # it stands at the origin, as in `demonstrate`
        placement = dataclasses.replace(
            placement, T_world_target=T_world_target, target_points=np.asarray(demonstration.target.points)
        )
    one, T_world_object, place = pair.object, placement.T_world_object, RELATIONS[task].grasp
    scene = Scene(
        demonstration=demonstration,
        points=placement.points,
        T_world_target=T_world_object,
        # The demonstrated gripper has the pose of the place that it picks.
        T_world_places=(np.asarray(demonstration.trajectory.matrices[0]), T_world_object @ one.frames[place]),
        meshes=(None, None),
        fold=one.fold,
        others=tuple(T_world_object @ T for T in one.others(place)),
    )
    return TaskScene(scene, placement, None if known else placement.target_points)


def _fitting(shown: Pair, seed: int) -> Pair:
    """Another object that fits the demonstrated target."""
    for number in range(1, MOST_DRAWS):
        one = draw_pair(shown.task, seed, number).object
        found = RELATIONS[shown.task].seat(one, shown.target)
        if found is not None:
            return Pair(shown.task, number, one, shown.target, *found, number - 1)
    raise InputError(
        f"tdf imitate: no object fits the demonstrated target in {MOST_DRAWS} draws; choose another --seed"
    )
