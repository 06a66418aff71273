"""Pairs of objects with a demonstrated pose on one and the true pose on the other."""

import dataclasses
import zlib

import jax
import numpy as np
from jaxtyping import Float

from tdf_jax._internal.errors import InputError
from tdf_jax.evaluation.annotated_meshes import AnnotatedMesh
from tdf_jax.evaluation.conditions import CONDITIONS, SCALES, observed
from tdf_jax.geometry import se3
from tdf_jax.geometry.sampling import sample_surface
from tdf_jax.shapes import FAMILIES, Mug, Shape, scaled

SEED_SPACE = 7_000_001  # keeps evaluation objects apart from training's, which are drawn from [seed, index]
# Folded into the key of random poses: start m of a seed is drawn from fold_in(key(seed), m), and must not be the true
# rotation.
POSE_STREAM = 0x7D05E


@dataclasses.dataclass(frozen=True)
class Transfer:
    """A pose demonstrated on one object, to be found on another, in the world.

    Attributes:
        points_a: cloud of the demonstration's object, which lies in its canonical frame, (points, 3), metres.
        points_b: cloud of the new object, in a random pose.
        T_world_place_a: the semantic place on object a, 4x4.
        T_world_place_b: the same place on object b: the truth, or one of several that object b's symmetry makes equal.
        T_world_b: pose of object b's canonical frame, 4x4.
        fold: object b's symmetry about the z axis of that frame, see `tdf_jax.symmetry`.
        scale: of both objects, and so of the query, over a common size.
    """

    points_a: Float[np.ndarray, "points 3"]
    points_b: Float[np.ndarray, "seen 3"]
    T_world_place_a: Float[np.ndarray, "4 4"]
    T_world_place_b: Float[np.ndarray, "4 4"]
    T_world_b: Float[np.ndarray, "4 4"]
    fold: int
    scale: float


@dataclasses.dataclass(frozen=True)
class Case(Transfer):
    """A transfer between objects whose shapes are known; `points_b` is as `clouds` says.

    Attributes:
        object_a, object_b: the objects, in their canonical frames.
        instance: name of object b; cases of one object in several poses share it.
        clouds: the condition of `points_b`, one of `tdf_jax.evaluation.conditions.CONDITIONS`.
    """

    object_a: Shape
    object_b: Shape | AnnotatedMesh
    instance: str
    clouds: str

    @property
    def diagonal(self) -> float:
        """Of object b's bounding box, metres."""
        return float(np.linalg.norm(self.object_b.mesh.extents))


def size_of(one: Shape | AnnotatedMesh) -> float:
    """What objects of a category are compared by, metres: a mug's height, the diagonal of others, which may be shallow or deep."""
    return one.height if one.category == "mug" else float(np.linalg.norm(one.mesh.extents))


def object_of(category: str, seed: int, index: int, size: float, fold: int | None = None) -> Shape:
    """A generated object no training run saw.

    Args:
        category: its family.
        seed, index: which.
        size: see `size_of`, metres.
        fold: its symmetry; any by default.
    """
    family, rng = FAMILIES[category], np.random.default_rng([SEED_SPACE, seed, index])
    parameters = family.sample(rng)
    while fold not in (None, parameters.fold):
        parameters = family.sample(rng)
    one = family.build(parameters)
    return scaled(one, size / size_of(one))


def mug_of(seed: int, index: int, height: float) -> Mug:
    """A generated mug no training run saw, scaled to a height in metres."""
    return object_of("mug", seed, index, height)


def random_pose(seed: int, index: int, reach: float = 0.3) -> Float[np.ndarray, "4 4"]:
    """A rotation uniform on SO(3) and a translation uniform in a cube of half side `reach`, metres."""
    rotation_key, place_key = jax.random.split(
        jax.random.fold_in(jax.random.fold_in(jax.random.key(seed), POSE_STREAM), index)
    )
    T = np.eye(4)
    T[:3, :3] = se3.uniform_rotations(rotation_key, 1)[0]
    T[:3, 3] = jax.random.uniform(place_key, (3,), minval=-reach, maxval=reach)
    return T


def generated_case(
    category: str,
    seed: int,
    index: int,
    *,
    size: float | None = None,
    points: int = 1500,
    place: str | None = None,
    clouds: str = "full",
) -> Case:
    """Pair `index` of a seed: two unseen generated objects of one size and symmetry, the second under a random pose.

    Args:
        category: "mug", "bowl" or "bottle".
        seed, index: which pair.
        size: of both objects before a condition of size, see `size_of`; by default a common one's.
        points: of each complete cloud, uniform by area.
        place: name of a frame of the category; by default the one where demonstrations pick it.
        clouds: the condition of the second object's cloud; objects and poses do not depend on it.

    Raises:
        InputError: there is no such condition or place.
    """
    scale = _scale("generated_case", clouds)
    size = (FAMILIES[category].size if size is None else size) * scale
    a = object_of(category, seed, 2 * index, size)
    b = object_of(category, seed, 2 * index + 1, size, fold=a.fold)
    return _case(a, b, seed, index, points, place, clouds, f"{category} {index}")


def mug_case(
    seed: int, index: int, *, height: float = 0.12, points: int = 1500, place: str = "handle", clouds: str = "full"
) -> Case:
    """`generated_case` of mugs of a height, metres."""
    return generated_case("mug", seed, index, size=height, points=points, place=place, clouds=clouds)


def mesh_case(
    seed: int, pose: int, target: AnnotatedMesh, *, points: int = 1500, place: str | None = None, clouds: str = "full"
) -> Case:
    """Random pose `pose` of a real mesh at its own size, demonstrated on an unseen generated object of its category, size and symmetry.

    Args:
        seed, pose: which object and pose; they depend on the mesh's name too, but not on other meshes.
        target: the mesh.
        points, place, clouds: see `generated_case`.

    Raises:
        InputError: there is no such condition or place.
    """
    scale = _scale("mesh_case", clouds)
    number = zlib.crc32(f"{target.name}/{pose}".encode())
    b = target if scale == 1 else target.scaled(scale)
    a = object_of(b.category, seed, number, size_of(b), b.fold)
    return _case(a, b, seed, number, points, place, clouds, target.name)


def _scale(function: str, clouds: str) -> float:
    if clouds not in CONDITIONS:
        raise InputError(f"{function}(): clouds is {clouds!r}; expected one of {', '.join(CONDITIONS)}")
    return SCALES.get(clouds, 1.0)


def _case(
    a: Shape,
    b: Shape | AnnotatedMesh,
    seed: int,
    number: int,
    points: int,
    place: str | None,
    clouds: str,
    instance: str,
) -> Case:
    places = FAMILIES[a.category].places
    place = places[0] if place is None else place
    if place not in places:
        raise InputError(f"generated_case(): place is {place!r}; expected one of a {a.category}'s: {', '.join(places)}")
    rng = np.random.default_rng([SEED_SPACE, seed, number, 1])
    cloud_a, cloud_b = (sample_surface(one.mesh, points, rng) for one in (a, b))
    # A stream of its own, the same for all conditions: they differ by the condition, not by chance.
    seen = observed(b.mesh, clouds, cloud_b, np.random.default_rng([SEED_SPACE, seed, number, 2]))
    T_world_b = random_pose(seed, number)
    points_b = seen @ T_world_b[:3, :3].T + T_world_b[:3, 3]
    return Case(
        points_a=cloud_a.astype(np.float32),
        points_b=points_b.astype(np.float32),
        T_world_place_a=a.frames[place],
        T_world_place_b=T_world_b @ b.frames[place],
        object_a=a,
        object_b=b,
        T_world_b=T_world_b,
        fold=b.fold,
        instance=instance,
        clouds=clouds,
        scale=SCALES.get(clouds, 1.0),
    )
