"""Tasks that place one object on another: bowl on mug, mug on rack, bottle in container, with the true seated pose.

The tasks are those of Relational Neural Descriptor Fields (Simeonov et al., CoRL 2022), on generated objects.
"""

import dataclasses
from collections.abc import Callable
from typing import NamedTuple, cast

import jax
import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from tdf_jax._internal import checks
from tdf_jax._internal.errors import InputError
from tdf_jax.evaluation.cases import QUERIES, QUERY_SIZE, SEED_SPACE
from tdf_jax.evaluation.conditions import CONDITIONS, SCALES, observed
from tdf_jax.evaluation.tabletop import moved
from tdf_jax.geometry import se3
from tdf_jax.geometry.demonstration import Demonstration
from tdf_jax.geometry.paths import hang_on_rack, lift_over
from tdf_jax.geometry.query import box_query
from tdf_jax.geometry.sampling import sample_surface
from tdf_jax.geometry.target import Target
from tdf_jax.shapes import FAMILIES, Mug, Rack, Shape, build_container, sample_container

POSES = ("upright", "tilt60", "uniform")
REACH = 0.3  # metres, half edge of the cube of the objects' translations
APART = 0.6  # metres from the middle of the objects' cube to that of the targets'
TABLE = np.array([0.45, 0.0, 0.0])  # where the demonstrated object stands; the target stands at the origin
TILT = np.radians(60)  # largest roll and pitch of "tilt60", which NDF and R-NDF call arbitrary
APPROACH = 0.12  # metres along a peg, or down, at the end of a demonstrated path
CLEARANCE = 0.05  # metres, height of a lift over the target's top
NUM_POSES = 24
DEEPEST = 1e-4  # metres, penetration at which a placed object counts as seated
FROM_TIP = (0.025, 0.020, 0.016, 0.012)  # metres from a peg's tip to the middle of a handle, the first that fits
SAMPLES = 5000  # surface points of the tests of placements
CONTACT_QUERIES, CONTACT_SIZE = 128, 0.10  # contact points, and the edge of their box, metres
MOST_DRAWS = 1000


class Relation(NamedTuple):
    """A task that places an object on a target.

    Attributes:
        object, target: categories.
        grasp: place of the object at which the demonstration picks.
        seat: from an object and a target, the seated pose T_target_object and the frame of the contact region
            T_target_contact, 4x4 each; None if the two cannot fit.
    """

    object: str
    target: str
    grasp: str
    seat: Callable[[Shape, Shape], tuple[np.ndarray, np.ndarray] | None]


@dataclasses.dataclass(frozen=True, eq=False)
class Pair:
    """An object and a target that fit, with a true placement.

    Attributes:
        task: name in `RELATIONS`.
        number: number of the pair.
        object, target: the two, in their canonical frames.
        T_target_object: a seated pose of the object on the upright target, 4x4.
        T_target_contact: frame of the region where the two meet, 4x4.
        redrawn: number of pairs drawn before that cannot fit by construction.
    """

    task: str
    number: int
    object: Shape
    target: Shape
    T_target_object: Float[np.ndarray, "4 4"]
    T_target_contact: Float[np.ndarray, "4 4"]
    redrawn: int


@dataclasses.dataclass(frozen=True, eq=False)
class Placement:
    """A pair in the world, as a method sees it: two clouds.

    Attributes:
        pair: the pair.
        poses: one of `POSES`.
        clouds: condition of both clouds, one of `tdf_jax.evaluation.conditions.CONDITIONS`.
        points: cloud of the object in its initial pose, (points, 3), metres, world frame.
        target_points: cloud of the target, (points, 3).
        T_world_object, T_world_target: poses of their canonical frames, 4x4.
    """

    pair: Pair
    poses: str
    clouds: str
    points: Float[np.ndarray, "points 3"]
    target_points: Float[np.ndarray, "target_points 3"]
    T_world_object: Float[np.ndarray, "4 4"]
    T_world_target: Float[np.ndarray, "4 4"]

    @property
    def motion(self) -> Float[np.ndarray, "4 4"]:
        """A true motion M of the object, 4x4: a point x of it ends at M x."""
        return self.T_world_target @ self.pair.T_target_object @ np.linalg.inv(self.T_world_object)

    def placed(self, motion: Float[np.ndarray, "4 4"]) -> Float[np.ndarray, "4 4"]:
        """The pose of the object on the upright target after a motion, 4x4, in the target's frame."""
        return np.linalg.inv(self.T_world_target) @ motion @ self.T_world_object


def draw_pair(task: str, seed: int, number: int, given: Shape | None = None) -> Pair:
    """Pair `number` of a seed: two objects of natural size that no training run has, and that fit.

    Args:
        task: one of `RELATIONS`.
        seed: seed of the pairs.
        number: number of the pair.
        given: the object, if only the target is drawn.

    Raises:
        InputError: there is no such task, or no pair of the seed fits.
    """
    checks.choice("draw_pair()", "task", task, RELATIONS)
    relation = RELATIONS[task]
    rng = np.random.default_rng([SEED_SPACE, seed, number, 3])
    for redrawn in range(MOST_DRAWS):
        one = _natural(relation.object, rng) if given is None else given
        if relation.target == "container":
            target: Shape = build_container(
                sample_container(rng, width=float(one.mesh.extents[:2].max()), height=one.height)
            )
        else:
            target = _natural(relation.target, rng)
        found = relation.seat(one, target)
        if found is not None:
            return Pair(task, number, one, target, *found, redrawn)
    raise InputError(f"draw_pair(): no {task} pair fits in {MOST_DRAWS} draws of seed {seed}; choose another seed")


def place_pair(pair: Pair, seed: int, poses: str = "upright", clouds: str = "full", points: int = 1500) -> Placement:
    """Put a pair into the world, both objects in random poses, and take their clouds.

    Args:
        pair: the pair.
        seed: seed of poses and clouds.
        poses: "upright" with a random yaw; "tilt60" with roll and pitch within 60 degrees too; or "uniform".
        clouds: condition of both clouds.
        points: number of points of each complete cloud.

    Raises:
        InputError: there are no such poses or clouds.
    """
    checks.choice("place_pair()", "poses", poses, POSES)
    checks.choice("place_pair()", "clouds", clouds, [name for name in CONDITIONS if name not in SCALES])
    # Objects, poses and points have streams of their own, so that conditions differ by the condition and not by chance.
    rng = np.random.default_rng([SEED_SPACE, seed, pair.number, 4])
    T_world_object, T_world_target = (_random_pose(poses, rng, x) for x in (APART, -APART))
    seen = np.random.default_rng([SEED_SPACE, seed, pair.number, 5])
    points_object, points_target = (
        moved(observed(one.mesh, clouds, sample_surface(one.mesh, points, seen), seen), T).astype(np.float32)
        for one, T in ((pair.object, T_world_object), (pair.target, T_world_target))
    )
    return Placement(pair, poses, clouds, points_object, points_target, T_world_object, T_world_target)


def demonstrate(pair: Pair, seed: int, points: int = 1500) -> Demonstration:
    """A demonstration on a pair: the object stands on the table, and is placed on the target, which is upright too.

    Args:
        pair: the pair.
        seed: seed of the clouds. Query points are the same for all pairs and seeds, so that demonstrations combine.
        points: number of points of each cloud.
    """
    relation, one, target = RELATIONS[pair.task], pair.object, pair.target
    rng = np.random.default_rng([SEED_SPACE, seed, pair.number, 6])
    T_world_target, T_world_object = np.eye(4), np.eye(4)
    T_world_target[2, 3] = -target.mesh.bounds[0, 2]
    T_world_object[:3, 3] = TABLE - [0, 0, one.mesh.bounds[0, 2]]
    T_world_contact = T_world_target @ pair.T_target_contact
    grasp = T_world_object @ one.frames[relation.grasp]
    release = T_world_target @ pair.T_target_object @ one.frames[relation.grasp]
    ends = {"rotation": grasp[:3, :3], "end_rotation": release[:3, :3]}
    if pair.task == "mug_on_rack":
        path = hang_on_rack(
            NUM_POSES, grasp[:3, 3], release[:3, 3], approach=-APPROACH * T_world_contact[:3, 0], **ends
        )
    else:
        height = float(target.mesh.extents[2]) + CLEARANCE
        path = lift_over(NUM_POSES, grasp[:3, 3], release[:3, 3], height=height, **ends)
    key = jax.random.key(0)
    return Demonstration(
        points=moved(sample_surface(one.mesh, points, rng), T_world_object).astype(np.float32),
        trajectory=path,
        query=box_query(key, QUERIES, QUERY_SIZE),
        target=Target(
            points=moved(sample_surface(target.mesh, points, rng), T_world_target).astype(np.float32),
            query=box_query(jax.random.fold_in(key, 1), CONTACT_QUERIES, CONTACT_SIZE),
            T_world_contact=np.asarray(se3.pose(T_world_contact[:3, :3], T_world_contact[:3, 3])),
        ),
    )


def overlap(one: Shape, target: Shape, T_target_object: np.ndarray, count: int = SAMPLES) -> bool:
    """Whether surface points of either are inside the other, more than `DEEPEST` below its surface along their normal.

    Args:
        one: the object.
        target: the target.
        T_target_object: pose of the object in the target's frame, 4x4.
        count: number of surface points of each, besides the corners of their meshes.
    """
    return _buried(one, target, T_target_object, count) or _buried(target, one, np.linalg.inv(T_target_object), count)


def _buried(one: Shape, other: Shape, T_other_one, count: int) -> bool:
    import trimesh

    points, faces = trimesh.sample.sample_surface(one.mesh, count, seed=0)[:2]
    points = np.concatenate([points, one.mesh.vertices])
    normals = np.concatenate([one.mesh.face_normals[faces], one.mesh.vertex_normals])
    return bool(other.contains(moved(points - DEEPEST * normals, T_other_one)).any())  # so that surfaces may touch


def _natural(category: str, rng: np.random.Generator) -> Shape:
    family = FAMILIES[category]
    return family.build(family.sample(rng))


def _random_pose(poses: str, rng: np.random.Generator, x: float) -> np.ndarray:
    T = np.eye(4)
    T[:3, 3] = rng.uniform(-REACH, REACH, 3) + [x, 0, 0]
    yaw, roll, pitch = rng.uniform(-np.pi, np.pi), rng.uniform(-TILT, TILT), rng.uniform(-TILT, TILT)
    anywhere = Rotation.random(rng=rng)
    turns = {"upright": (yaw, 0.0, 0.0), "tilt60": (yaw, pitch, roll)}
    T[:3, :3] = (anywhere if poses == "uniform" else Rotation.from_euler("ZYX", turns[poses])).as_matrix()
    return T


def _bowl_on_mug(bowl: Shape, mug: Shape) -> tuple[np.ndarray, np.ndarray] | None:
    """The bowl's base on the mug's rim, both upright and on one axis."""
    base, rim = (one.mesh.vertices for one in (bowl, mug))
    base = base[base[:, 2] < bowl.mesh.bounds[0, 2] + 1e-3]
    rim = rim[rim[:, 2] > mug.mesh.bounds[1, 2] - 1e-3]
    if np.linalg.norm(base[:, :2], axis=1).max() < np.linalg.norm(rim[:, :2], axis=1).max() + 0.002:
        return None  # it would stand in the opening, or fall into it
    T_target_object, T_target_contact = np.eye(4), np.eye(4)
    T_target_contact[2, 3] = mug.mesh.bounds[1, 2]
    T_target_object[2, 3] = T_target_contact[2, 3] - bowl.mesh.bounds[0, 2]
    # A wide foot goes around a narrow rim, until the bottom inside the foot rests on it.
    standing = _lowered(bowl, mug, T_target_object, np.array([0.0, 0.0, 1.0]), -0.02)
    return None if standing is None else (standing, T_target_contact)


def _bottle_in_container(bottle: Shape, container: Shape) -> tuple[np.ndarray, np.ndarray] | None:
    """The bottle upright in the middle of the floor of a container that is open above."""
    if container.parameters.style == "shelf":
        return None  # a path from above, as of the other containers, would go through its ceiling
    T_target_contact = container.frames["floor"].copy()
    T_target_object = T_target_contact.copy()
    T_target_object[2, 3] -= bottle.mesh.bounds[0, 2]
    return None if overlap(bottle, container, T_target_object) else (T_target_object, T_target_contact)


def _mug_on_rack(mug: Shape, rack: Shape) -> tuple[np.ndarray, np.ndarray] | None:
    """The handle on the first peg, near its tip: the peg along the mug's y axis, the handle's bar on top of it."""
    mug, rack = cast(Mug, mug), cast(Rack, rack)
    seat, (root, tip) = rack.peg_frames[0], rack.peg_lines[0]
    length = np.linalg.norm(tip - root)
    handle = mug.handle_frame[:3, 3] - [mug.parameters.handle_thickness / 2, 0, 0]  # the bar's side to the finger hole
    T_target_object = np.eye(4)
    # The mug's x axis, out of the handle, is up, so that the bar rests on the peg; its y axis is along the peg.
    T_target_object[:3, :3] = np.stack([seat[:3, 2], seat[:3, 0], seat[:3, 1]], axis=1)
    for distance in FROM_TIP:
        contact = seat.copy()
        contact[:3, 3] += (length / 2 - distance) * seat[:3, 0]
        T_target_object[:3, 3] = contact[:3, 3] - T_target_object[:3, :3] @ handle
        hanging = _lowered(mug, rack, T_target_object, seat[:3, 2])
        if hanging is not None and (moved(mug.mesh.vertices, hanging)[:, 2] > rack.mesh.bounds[0, 2]).all():
            return hanging, contact
    return None


def _lowered(
    one: Shape, target: Shape, T_target_object: np.ndarray, up: np.ndarray, low: float = -0.003, high: float = 0.003
) -> np.ndarray | None:
    """The lowest pose along a direction, from `low` to `high` metres, above which the two do not overlap."""
    raised = T_target_object.copy()
    raised[:3, 3] = T_target_object[:3, 3] + high * up
    if overlap(one, target, raised):
        return None
    for _ in range(8):
        middle = (low + high) / 2
        raised[:3, 3] = T_target_object[:3, 3] + middle * up
        low, high = (middle, high) if overlap(one, target, raised) else (low, middle)
    raised[:3, 3] = T_target_object[:3, 3] + high * up
    return raised


RELATIONS = {
    "bowl_on_mug": Relation("bowl", "mug", "rim", _bowl_on_mug),
    "mug_on_rack": Relation("mug", "rack", "rim", _mug_on_rack),
    "bottle_in_container": Relation("bottle", "container", "neck", _bottle_in_container),
}
