"""What `tdf imitate` and `tdf landscape` work on: a demonstration and a target, from the user's files or a pair of generated objects."""

import dataclasses

import numpy as np
from jaxtyping import PRNGKeyArray

from tdf_jax.cli.options import SceneSettings
from tdf_jax.energy.reference import Demonstration
from tdf_jax._internal.errors import InputError
from tdf_jax.evaluation.cases import Case, generated_case, random_pose
from tdf_jax.evaluation.scene import Scene, place_demonstration
from tdf_jax.evaluation.pick_transfer import QUERY_SIZE
from tdf_jax.io.meshes import load_mesh
from tdf_jax.io.pointclouds import load_points
from tdf_jax.geometry.query import box_query
from tdf_jax.io.demonstrations import load_demonstration
from tdf_jax.geometry.trajectory import resample


def make_scene(settings: SceneSettings, key: PRNGKeyArray) -> Scene:
    """Read or generate both objects.

    Args:
        settings: resolved.
        key: of the query points.

    Raises:
        InputError: a file that cannot be used, or a number that makes no trajectory.
    """
    shown, found = _read_demonstration(settings), _read_target(settings)
    pair, shown_mesh, places = None, None, None
    T_world_target = np.eye(4) if settings.target_pose == "given" else random_pose(settings.seed, 0)
    if shown is None or found is None:  # after the files: a bad one is told at once
        pair = generated_case(settings.category, settings.seed, 0, points=settings.points)
    if found is None:
        T_object_world = np.linalg.inv(pair.T_world_b)
        found = _moved(pair.points_b, T_object_world), pair.object_b.mesh
        if shown is None:
            places = (pair.T_world_place_a, T_world_target @ T_object_world @ pair.T_world_place_b)
    if shown is None:
        shown, shown_mesh = _generated(settings, pair, key), pair.object_a.mesh
    points, mesh = found
    return Scene(
        demonstration=shown,
        points=_moved(points, T_world_target),
        T_world_target=T_world_target,
        T_world_places=places,
        meshes=(shown_mesh, None if mesh is None else mesh.copy().apply_transform(T_world_target)),
        fold=1 if places is None else pair.fold,
    )


def _read_demonstration(settings: SceneSettings) -> Demonstration | None:
    if settings.demonstration is None:
        return None
    shown = load_demonstration(settings.demonstration)
    if settings.poses in (None, shown.trajectory.poses):
        return shown
    return dataclasses.replace(shown, trajectory=resample(shown.trajectory, settings.poses))


def _read_target(settings: SceneSettings):
    """Points and, if it has faces, the mesh."""
    if settings.target is None:
        return None
    points = load_points(settings.target, settings.points, settings.scale, settings.seed)
    try:
        return points, load_mesh(settings.target, settings.scale)
    except InputError:  # not a mesh, then: it has just been read as a cloud
        return points, None


def _generated(settings: SceneSettings, pair: Case, key: PRNGKeyArray) -> Demonstration:
    return place_demonstration(pair, settings.trajectory, settings.poses, box_query(key, settings.queries, QUERY_SIZE))


def _moved(points, T):
    return (points @ T[:3, :3].T + T[:3, 3]).astype(np.float32)
