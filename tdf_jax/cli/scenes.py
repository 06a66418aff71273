"""The scene of `tdf imitate` and `tdf landscape`: both objects and the demonstration, read from files or generated."""

import functools
from typing import cast

import numpy as np
from jaxtyping import Float, PRNGKeyArray

from tdf_jax._internal.errors import InputError
from tdf_jax.cli.options import SceneSettings
from tdf_jax.evaluation.cases import QUERY_SIZE, Case, generated_case, place_demonstration, random_pose
from tdf_jax.evaluation.scene import Scene
from tdf_jax.geometry.demonstration import Demonstration
from tdf_jax.geometry.query import box_query
from tdf_jax.io.demonstrations import load_demonstration
from tdf_jax.io.meshes import load_mesh
from tdf_jax.io.pointclouds import load_points


def make_scene(settings: SceneSettings, key: PRNGKeyArray, seen: Float[np.ndarray, "points 3"] | None = None) -> Scene:
    """Read or generate both objects.

    Args:
        settings: settings from `resolved`.
        key: random key of the query points.
        seen: cloud of the new object, (points, 3), metres, that depth images show; None for that of `settings`.

    Raises:
        InputError: a file that cannot be used, or a number that makes no trajectory.
    """

    @functools.cache  # generated after both files were read, so that an error in a file is reported at once
    def pair() -> Case:
        return generated_case(cast(str, settings.category), settings.seed, 0, points=settings.points)

    demonstration = _read_demonstration(settings)
    target = _read_target(settings) if seen is None else (seen, None)
    demonstrated_mesh, places, fold, others = None, None, 1, ()
    T_world_target = np.eye(4) if settings.target_pose == "given" else random_pose(settings.seed, 0)
    if target is None:
        T_object_world = np.linalg.inv(pair().T_world_b)
        target = _moved(pair().points_b, T_object_world), pair().object_b.mesh
        if demonstration is None:
            places = (pair().T_world_place_a, T_world_target @ T_object_world @ pair().T_world_place_b)
            fold = pair().fold
            others = tuple(T_world_target @ T_object_world @ T for T in pair().others)
    if demonstration is None:
        demonstration, demonstrated_mesh = _generated(settings, pair(), key), pair().object_a.mesh
    points, mesh = target
    return Scene(
        demonstration=demonstration,
        points=_moved(points, T_world_target),
        T_world_target=T_world_target,
        T_world_places=places,
        meshes=(demonstrated_mesh, None if mesh is None else mesh.copy().apply_transform(T_world_target)),
        fold=fold,
        others=others,
    )


def _read_demonstration(settings: SceneSettings) -> Demonstration | None:
    if settings.demonstration is None:
        return None
    demonstration = load_demonstration(settings.demonstration)
    if settings.num_poses is None or settings.num_poses == demonstration.transfer.num_poses:
        return demonstration
    return demonstration.resampled(settings.num_poses)


def _read_target(settings: SceneSettings):
    """Points and, if the file has faces, the mesh."""
    if settings.target is None:
        return None
    points = load_points(
        settings.target, settings.points, settings.scale, settings.seed, drop_invalid=settings.drop_invalid
    )
    try:
        return points, load_mesh(settings.target, settings.scale)
    except InputError:  # the file has no faces; it has just been read as a cloud
        return points, None


def _generated(settings: SceneSettings, pair: Case, key: PRNGKeyArray) -> Demonstration:
    trajectory, num_poses = cast(str, settings.trajectory), cast(int, settings.num_poses)
    return place_demonstration(pair, trajectory, num_poses, box_query(key, cast(int, settings.queries), QUERY_SIZE))


def _moved(points, T):
    return (points @ T[:3, :3].T + T[:3, 3]).astype(points.dtype)  # float64 where float32 would round far points
