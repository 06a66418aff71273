"""Cases with ground truth: a demonstration on one object, and another object with the true pose of the same place."""

import dataclasses
import zlib
from typing import cast

import jax
import numpy as np
from jaxtyping import Array, Float

from tdf_jax._internal import checks
from tdf_jax.evaluation.annotated_meshes import AnnotatedMesh
from tdf_jax.evaluation.conditions import CONDITIONS, SCALES, observed
from tdf_jax.evaluation.tabletop import (
    CAMERAS,
    CLEAN,
    CLUTTER,
    CLUTTERED,
    NEIGHBOURS,
    STANDS,
    build_tabletop,
    camera_cloud,
    complete_cloud,
    moved,
    place_points,
    standing,
)
from tdf_jax.geometry import se3
from tdf_jax.geometry.demonstration import Demonstration
from tdf_jax.geometry.paths import PATHS, SHAPES
from tdf_jax.geometry.sampling import sample_surface
from tdf_jax.shapes import FAMILIES, Mug, Shape, scaled

QUERIES = 128
QUERY_SIZE = 0.06  # metres, edge of the box of query points: it holds the handle and the wall behind it
PLACE = (0.0, 0.24, 0.18)  # metres from the pick to the goal: to the side and up
LIFT = (0.0, 0.0, 1.0)  # a semicircle and a wave leave the straight line upwards first
# Evaluation objects are drawn from [SEED_SPACE, seed, index] and training objects from [seed, index], so no object is
# in both.
SEED_SPACE = 7_000_001
# This number is folded into the key of random poses. Start m of a seed is drawn from fold_in(key(seed), m), and must
# not be the true rotation.
POSE_STREAM = 0x7D05E
CLOUDS = (*CONDITIONS, *CAMERAS)
BESIDE = ("mug", "bowl", "bottle")  # categories of an object of another category that stands beside the object


@dataclasses.dataclass(frozen=True)
class Transfer:
    """A pose that is demonstrated on object a and is to be estimated on object b.

    Attributes:
        points_a: cloud of the demonstrated object, (points, 3), metres, world frame; its canonical frame is the world
            frame.
        points_b: cloud of the new object in a random pose, (seen, 3), metres, world frame.
        T_world_place_a: semantic place on object a, 4x4.
        T_world_place_b: the same place on object b, 4x4: the ground truth, or one of several that the symmetry of
            object b makes equal.
        T_world_b: pose of the canonical frame of object b, 4x4.
        fold: symmetry of object b about the z axis of that frame, see `tdf_jax.geometry.symmetry`.
        scale: size of both objects over a common size; it scales the query points too.
        others: poses T_world_place_b, 4x4, of places of object b that are as right without a symmetry, such as the
            second of two unlike pegs.
    """

    points_a: Float[np.ndarray, "points 3"]
    points_b: Float[np.ndarray, "seen 3"]
    T_world_place_a: Float[np.ndarray, "4 4"]
    T_world_place_b: Float[np.ndarray, "4 4"]
    T_world_b: Float[np.ndarray, "4 4"]
    fold: int
    scale: float
    others: tuple[Float[np.ndarray, "4 4"], ...] = dataclasses.field(default=(), kw_only=True)


@dataclasses.dataclass(frozen=True)
class Case(Transfer):
    """A transfer between objects whose shapes are known.

    Attributes:
        object_a, object_b: the objects, in their canonical frames.
        instance: name of object b; cases of one object in several poses share it.
        clouds: condition of `points_b`, one of `CLOUDS`.
        clutter: what else `points_b` shows, one of `tdf_jax.evaluation.tabletop.CLUTTER`.
        stand: how object b stands on the table, one of `tdf_jax.evaluation.tabletop.STANDS`; empty where there is no
            table, and its rotation is uniform.
        own: number of points of `points_b` that are the object's, which come first.
        seen: how many of 1500 of these are in the box of query points at the place, see
            `tdf_jax.evaluation.tabletop.place_points`; None where no camera is modelled.
    """

    object_a: Shape
    object_b: Shape | AnnotatedMesh
    instance: str
    clouds: str
    clutter: str = dataclasses.field(default=CLEAN, kw_only=True)
    stand: str = dataclasses.field(default="", kw_only=True)
    own: int | None = dataclasses.field(default=None, kw_only=True)
    seen: int | None = dataclasses.field(default=None, kw_only=True)

    @property
    def diagonal(self) -> float:
        """Diagonal of the bounding box of object b, metres."""
        return float(np.linalg.norm(self.object_b.mesh.extents))


def size_of(one: Shape | AnnotatedMesh) -> float:
    """The length by which objects of a category are compared, metres.

    It is the height of a mug, and the diagonal of other objects, which may be shallow or deep.
    """
    return one.height if one.category == "mug" else float(np.linalg.norm(one.mesh.extents))


def object_of(category: str, seed: int, index: int, size: float | None, fold: int | None = None) -> Shape:
    """A generated object that no training run has.

    Args:
        category: family of the object.
        seed: seed of the objects.
        index: number of the object.
        size: size, see `size_of`, metres; None for the object's own, as it was drawn.
        fold: symmetry of the object; any by default.
    """
    family, rng = FAMILIES[category], np.random.default_rng([SEED_SPACE, seed, index])
    parameters = family.sample(rng)
    while fold not in (None, parameters.fold):
        parameters = family.sample(rng)
    one = family.build(parameters)
    return one if size is None else scaled(one, size / size_of(one))


def mug_of(seed: int, index: int, height: float) -> Mug:
    """A generated mug that no training run has, scaled to a height in metres."""
    return cast(Mug, object_of("mug", seed, index, height))


def random_pose(seed: int, index: int, reach: float = 0.3) -> Float[np.ndarray, "4 4"]:
    """A random pose, 4x4: uniform on SO(3), and uniform in a cube whose half edge is `reach`, metres."""
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
    natural: bool = False,
    clutter: str = CLEAN,
    stand: str = "upright",
) -> Case:
    """Pair `index` of a seed: two unseen generated objects of one size and symmetry, the second in a random pose.

    Args:
        category: a category of `tdf_jax.shapes.FAMILIES`, such as "mug".
        seed: seed of the pairs.
        index: number of the pair.
        size: size of both objects before a condition of size, see `size_of`, metres; by default the common size of the
            category.
        points: number of points of each complete cloud, uniform by area.
        place: name of a frame of the category; by default the frame at which demonstrations pick.
        clouds: condition of the second object's cloud; objects do not depend on it, and poses only by whether there
            is a table: with cameras or clutter.
        natural: each object keeps its own size, as it was drawn, instead of `size` and conditions of size.
        clutter: what else the cloud shows; not of all conditions.
        stand: how the second object stands, if there is a table.

    Raises:
        InputError: there is no such condition, clutter, stand or place.
    """
    scale = _scale("generated_case", clouds, clutter, stand)
    size = None if natural else (FAMILIES[category].size if size is None else size) * scale
    a = object_of(category, seed, 2 * index, size)
    b = object_of(category, seed, 2 * index + 1, size, fold=a.fold)
    return _case("generated_case()", a, b, seed, index, points, place, clouds, f"{category} {index}", clutter, stand)


def mug_case(
    seed: int, index: int, *, height: float = 0.12, points: int = 1500, place: str = "handle", clouds: str = "full"
) -> Case:
    """`generated_case` of mugs of a height, metres."""
    return generated_case("mug", seed, index, size=height, points=points, place=place, clouds=clouds)


def mesh_case(
    seed: int,
    pose: int,
    target: AnnotatedMesh,
    *,
    points: int = 1500,
    place: str | None = None,
    clouds: str = "full",
    clutter: str = CLEAN,
    stand: str = "upright",
) -> Case:
    """A real mesh at its own size in a random pose, with a demonstration on an unseen generated object.

    The generated object has the category, the size and the symmetry of the mesh.

    Args:
        seed: seed of the poses and the generated objects. Both depend on the name of the mesh too, but not on other
            meshes.
        pose: number of the pose.
        target: the mesh.
        points: number of points of each complete cloud, uniform by area.
        place: name of a frame of the category; by default the frame at which demonstrations pick.
        clouds: condition of the mesh's cloud; the generated object does not depend on it, and poses only by whether
            there is a table: with cameras or clutter.
        clutter: what else the cloud shows; not of all conditions.
        stand: how the mesh stands, if there is a table.

    Raises:
        InputError: there is no such condition, clutter, stand or place.
    """
    scale = _scale("mesh_case", clouds, clutter, stand)
    number = zlib.crc32(f"{target.name}/{pose}".encode())
    b = target if scale == 1 else target.scaled(scale)
    a = object_of(b.category, seed, number, size_of(b), b.fold)
    return _case("mesh_case()", a, b, seed, number, points, place, clouds, target.name, clutter, stand)


def place_demonstration(
    case: Case,
    path: str,
    num_poses: int,
    query: Float[Array, "queries 3"],
    goal_offset: tuple[float, float, float] = PLACE,
    bulge: tuple[float, float, float] | None = LIFT,
) -> Demonstration:
    """A demonstrated trajectory on the first object of a case, from its place (such as the handle) to a goal.

    Args:
        case: the case.
        path: name of the path, one of `tdf_jax.geometry.paths.PATHS`.
        num_poses: number of poses of the trajectory.
        query: query points, (queries, 3), metres, query frame.
        goal_offset: translation from the first pose to the last, (3,), metres, world frame; it scales with the case.
        bulge: side to which a semicircle and a wave leave the straight line, (3,); None for the default of the path.
    """
    pick = case.T_world_place_a
    start, end = pick[:3, 3], pick[:3, 3] + np.multiply(goal_offset, case.scale)
    bow = {} if bulge is None or path not in SHAPES or path == "line" else {"bulge": bulge}
    trajectory = PATHS[path](num_poses, start, end, rotation=pick[:3, :3], **bow)
    return Demonstration(jax.device_put(case.points_a), trajectory, query)


def _scale(function: str, clouds: str, clutter: str, stand: str) -> float:
    checks.choice(f"{function}()", "clouds", clouds, CLOUDS)
    checks.choice(f"{function}()", "clutter", clutter, CLUTTER)
    checks.choice(f"{function}()", "stand", stand, STANDS)
    if clutter != CLEAN:
        checks.choice(f"{function}()", "clouds, with clutter,", clouds, CLUTTERED)
    return SCALES.get(clouds, 1.0)


def _case(
    function: str,
    a: Shape,
    b: Shape | AnnotatedMesh,
    seed: int,
    number: int,
    points: int,
    place: str | None,
    clouds: str,
    instance: str,
    clutter: str,
    stand: str,
) -> Case:
    places = FAMILIES[a.category].places
    place = places[0] if place is None else place
    checks.choice(function, f"place of a {a.category}", place, places)
    rng = np.random.default_rng([SEED_SPACE, seed, number, 1])
    cloud_a, cloud_b = (sample_surface(one.mesh, points, rng) for one in (a, b))
    others = b.others(place) if isinstance(b, Shape) else ()
    table = clouds in CAMERAS or clutter != CLEAN
    if table:
        points_b, T_world_b, own = _on_table(b, seed, number, clouds, clutter, stand, cloud_b)
    else:
        # All conditions share this random stream, so that they differ by the condition and not by chance.
        seen = observed(b.mesh, clouds, cloud_b, np.random.default_rng([SEED_SPACE, seed, number, 2]))
        T_world_b = random_pose(seed, number)
        points_b, own = moved(seen, T_world_b), len(seen)
    at_place = None
    if clouds in CAMERAS:
        local = moved(points_b[:own], np.linalg.inv(T_world_b))
        at_place = place_points(local, [b.frames[place], *others], b.fold, QUERY_SIZE)
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
        others=tuple(T_world_b @ T for T in others),
        clutter=clutter,
        stand=stand if table else "",
        own=own,
        seen=at_place,
    )


def _on_table(b, seed, number, clouds, clutter, stand, cloud):
    """The cloud of an object on a table, its pose, and the number of the object's points, which come first."""
    # Every part has a random stream of its own, so that conditions differ by the condition and not by chance.
    streams = (np.random.default_rng([SEED_SPACE, seed, number, stream]) for stream in (8, 9, 10, 11))
    of_pose, of_scene, of_neighbour, of_cloud = streams
    T_world_b = standing(b.mesh, stand, of_pose)
    neighbour = None
    if clutter in NEIGHBOURS:
        others = [category for category in BESIDE if category != b.category]
        category = b.category if clutter.endswith("same") else str(of_neighbour.choice(others))
        # Its size is the object's if it is of the same category, and common otherwise.
        size = size_of(b) if category == b.category else FAMILIES[category].size
        drawn = FAMILIES[category].build(FAMILIES[category].sample(of_neighbour))
        neighbour = scaled(drawn, size / size_of(drawn)).mesh
    scene = build_tabletop(b.mesh, T_world_b, CAMERAS.get(clouds, 0), of_scene, neighbour, NEIGHBOURS.get(clutter, 0.0))
    if clouds in CAMERAS:
        points, own = camera_cloud(scene, clutter, of_cloud)
    else:
        points, own = complete_cloud(scene, clutter, cloud, of_cloud)
    return points, T_world_b, own
