"""Pairs of objects with a demonstrated pose on one and the true pose on the other."""

import dataclasses

import jax
import numpy as np
from jaxtyping import Float

from tdf_jax import poses
from tdf_jax.pointcloud import sample_surface
from tdf_jax.shapes import Mug, build_mug, sample_mug, scaled

SEED_SPACE = 7_000_001  # keeps evaluation objects apart from training's, which are drawn from [seed, index]
# Folded into the key of random poses: start m of a seed is drawn from fold_in(key(seed), m), and must not be the true rotation.
POSE_STREAM = 0x7D05E


@dataclasses.dataclass(frozen=True)
class Case:
    """One transfer between two objects, in the world.

    Attributes:
        points_a: cloud of the demonstration's object, which lies in its canonical frame, (points, 3), metres.
        points_b: cloud of the new object, in a random pose.
        T_world_place_a: the semantic place on object a, 4x4.
        T_world_place_b: the same place on object b: the truth.
        object_a, object_b: the objects, in their canonical frames.
        T_world_b: pose of object b's canonical frame, 4x4.
    """

    points_a: Float[np.ndarray, "points 3"]
    points_b: Float[np.ndarray, "points 3"]
    T_world_place_a: Float[np.ndarray, "4 4"]
    T_world_place_b: Float[np.ndarray, "4 4"]
    object_a: Mug
    object_b: Mug
    T_world_b: Float[np.ndarray, "4 4"]


def mug_of(seed: int, index: int, height: float) -> Mug:
    """A generated mug no training run saw, scaled to a height in metres."""
    mug = build_mug(sample_mug(np.random.default_rng([SEED_SPACE, seed, index])))
    return scaled(mug, height / mug.parameters.height)


def random_pose(seed: int, index: int, reach: float = 0.3) -> Float[np.ndarray, "4 4"]:
    """A rotation uniform on SO(3) and a translation uniform in a cube of half side `reach`, metres."""
    rotation_key, place_key = jax.random.split(jax.random.fold_in(jax.random.fold_in(jax.random.key(seed), POSE_STREAM), index))
    T = np.eye(4)
    T[:3, :3] = poses.uniform_rotations(rotation_key, 1)[0]
    T[:3, 3] = jax.random.uniform(place_key, (3,), minval=-reach, maxval=reach)
    return T


def mug_case(seed: int, index: int, *, height: float = 0.12, points: int = 1500, place: str = "handle") -> Case:
    """Pair `index` of a seed: two unseen generated mugs of one height, the second under a random pose.

    Args:
        seed, index: which pair.
        height: of both mugs, metres.
        points: of each cloud, uniform by area.
        place: "handle", "rim" or "base".
    """
    a, b = (mug_of(seed, 2 * index + which, height) for which in range(2))
    rng = np.random.default_rng([SEED_SPACE, seed, index, 1])
    cloud_a, cloud_b = (sample_surface(mug.mesh, points, rng) for mug in (a, b))
    T_world_b = random_pose(seed, index)
    points_b = cloud_b @ T_world_b[:3, :3].T + T_world_b[:3, 3]
    return Case(
        points_a=cloud_a.astype(np.float32),
        points_b=points_b.astype(np.float32),
        T_world_place_a=a.frames[place],
        T_world_place_b=T_world_b @ b.frames[place],
        object_a=a,
        object_b=b,
        T_world_b=T_world_b,
    )
