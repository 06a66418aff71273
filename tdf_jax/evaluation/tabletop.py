"""Clouds of an object on a table: as depth cameras see it, and with points of other things in it."""

import dataclasses
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

from tdf_jax.evaluation.depth_images import TABLE, DepthImage, camera_poses, depth_image
from tdf_jax.geometry.sampling import sample_surface
from tdf_jax.geometry.symmetry import ROUND, about_z
from tdf_jax.perception.clusters import separate_objects
from tdf_jax.perception.depth import flying_pixels, points_from_depth

if TYPE_CHECKING:
    import trimesh

CAMERAS = {"camera1": 1, "camera2": 2, "camera3": 3}
STANDS = ("upright", "tilt60")  # poses of an object on a table
TILT = np.radians(60)  # largest roll and pitch of "tilt60", as if a fixture held the object
REACH = 0.3  # metres: objects stand at most this far from the origin along x and y
CLEAN = "none"
NEIGHBOURS = {
    "neighbour-same": 0.03,
    "neighbour-other": 0.03,
    "touching-same": 0.002,
    "touching-other": 0.002,
}  # gap, m
CLUTTER = (CLEAN, "table", *NEIGHBOURS, "outliers")
CLUTTERED = ("full", *CAMERAS)  # clouds that clutter can be added to
SHARE = 0.2  # of a cluttered cloud: points that are not the object's
OWN = 1  # label of the object's pixels
WORKSPACE = 0.3, 0.05, 0.6  # metres: half its edge about the object, its depth below and its height above the table
GAP_SAMPLES = 10_000  # surface points of each of two objects whose gap is measured
# Radians between the direction of the neighbour and that of the first camera, from the object: beside it, not before.
ASIDE = np.pi / 3, 2 * np.pi / 3
NEAREST_REACH = 0.12  # metres around the object's bounding box in which the nearest points of others are looked for
NEAREST_OF = 4000  # points of the object from which they are measured
NEAR_OUTLIERS, FAR_OUTLIERS = 0.05, (0.3, 1.0)  # metres: around the object's bounding box, and from its middle
SEEN_POINTS, SEEN_OF = 20, 1500  # a place is seen if so many of so many points of the object are in its box
TURNS = 36  # of a round object, at which its equivalent places are looked for


@dataclasses.dataclass(frozen=True, eq=False)
class Tabletop:
    """An object on a table, perhaps with another one beside it.

    Attributes:
        mesh: mesh of the object, metres, object frame.
        T_world_object: its pose, (4, 4); the table is z = 0.
        T_world_cameras: poses of depth cameras around it, (cameras, 4, 4).
        neighbour: mesh of the other object in the world, metres; None if it stands alone.
    """

    mesh: "trimesh.Trimesh"
    T_world_object: Float[np.ndarray, "4 4"]
    T_world_cameras: Float[np.ndarray, "cameras 4 4"]
    neighbour: "trimesh.Trimesh | None" = None


def standing(mesh: "trimesh.Trimesh", stand: str, rng: np.random.Generator) -> Float[np.ndarray, "4 4"]:
    """A random pose on a table: the lowest point of the object touches z = 0.

    Args:
        mesh: mesh of the object, metres; z is up.
        stand: "upright" with a random yaw; "tilt60" with roll and pitch within 60 degrees too.
        rng: random generator; both use as many numbers of it.

    Returns:
        T_world_object, (4, 4), metres.
    """
    yaw, roll, pitch = rng.uniform(-np.pi, np.pi), *rng.uniform(-TILT, TILT, 2)
    T = np.eye(4)
    T[:3, :3] = Rotation.from_euler("ZYX", (yaw, pitch, roll) if stand == "tilt60" else (yaw, 0, 0)).as_matrix()
    T[:3, 3] = *rng.uniform(-REACH, REACH, 2), -(mesh.vertices @ T[2, :3]).min()
    return T


def build_tabletop(
    mesh: "trimesh.Trimesh",
    T_world_object: Float[np.ndarray, "4 4"],
    count: int,
    rng: np.random.Generator,
    neighbour: "trimesh.Trimesh | None" = None,
    gap: float = 0.0,
) -> Tabletop:
    """An object on a table with cameras around it, and another object that stands upright beside it.

    Args:
        mesh: mesh of the object, metres, object frame.
        T_world_object: its pose on the table, (4, 4).
        count: number of cameras, see `camera_poses`.
        rng: generator of the cameras, and of the neighbour's yaw and direction.
        neighbour: mesh of the other object, metres; z is up.
        gap: distance between the two, metres.
    """
    corners = moved(mesh.vertices, T_world_object)
    middle = (corners.min(axis=0) + corners.max(axis=0)) / 2
    # The cameras have a generator of their own, so that a neighbour or one camera more does not move the first.
    cameras = camera_poses(max(count, 1), middle, np.random.default_rng(rng.integers(2**63)))
    if neighbour is None:
        return Tabletop(mesh, T_world_object, cameras)
    towards = cameras[0, :2, 3] - middle[:2]
    angle = np.arctan2(towards[1], towards[0]) + rng.choice([-1, 1]) * rng.uniform(*ASIDE)
    T = about_z(rng.uniform(-np.pi, np.pi))
    T[:3, 3] = *T_world_object[:2, 3], -neighbour.bounds[0, 2]
    other = neighbour.copy().apply_transform(T)
    tree = KDTree(moved(sample_surface(mesh, GAP_SAMPLES, rng), T_world_object))
    surface = sample_surface(other, GAP_SAMPLES, rng)
    direction = np.array([np.cos(angle), np.sin(angle), 0.0])
    near, far = 0.0, float(np.linalg.norm(mesh.extents) + np.linalg.norm(other.extents)) + gap
    while far - near > 1e-4:
        between = (near + far) / 2
        if np.isinf(tree.query(surface + between * direction, distance_upper_bound=gap)[0]).all():
            far = between
        else:
            near = between
    return Tabletop(mesh, T_world_object, cameras, other.apply_translation(far * direction))


def complete_cloud(
    table: Tabletop, clutter: str, own: Float[np.ndarray, "points 3"], rng: np.random.Generator
) -> tuple[Float[np.ndarray, "all 3"], int]:
    """The complete cloud of an object with foreign points, which are as dense as its own.

    Args:
        table: the object on the table.
        clutter: one of `CLUTTER`.
        own: complete cloud of the object, (points, 3), metres, object frame.
        rng: generator of the foreign points.

    Returns:
        Points, (all, 3), metres, world frame, the object's first; and the number of the object's.
    """
    points = moved(own, table.T_world_object)
    density = len(own) / table.mesh.area
    others = np.zeros((0, 3))
    if clutter in NEIGHBOURS and table.neighbour is not None:
        others = sample_surface(table.neighbour, round(density * table.neighbour.area), rng)
    elif clutter == "table":
        low, high = points[:, :2].min(axis=0) - WORKSPACE[0], points[:, :2].max(axis=0) + WORKSPACE[0]
        others = np.pad(rng.uniform(low, high, (round(density * np.prod(high - low)), 2)), ((0, 0), (0, 1)))
        others = others[~_under(others, points, 2 / np.sqrt(density))]
    return _with_foreign(points, clutter, others, rng)


def camera_cloud(table: Tabletop, clutter: str, rng: np.random.Generator) -> tuple[Float[np.ndarray, "all 3"], int]:
    """The cloud of an object from depth images, perhaps with foreign points of the same images.

    The images become points by `points_from_depth`; `separate_objects` removes the table from each and finds clusters.
    The cluster with most of the object's points is taken. With clutter, its points of anything but the object are
    replaced.

    Args:
        table: the object on the table, and the cameras.
        clutter: one of `CLUTTER`.
        rng: generator of the noise and of outliers.

    Returns:
        Points, (all, 3), metres, world frame, the object's first; and the number of the object's.

    Raises:
        InputError: no object is found in the images.
    """
    views, labels = zip(*(image_points(image) for image in images(table, rng)))
    points, labels = np.concatenate(views), np.concatenate(labels)
    cluster = segmented(table, list(views), labels)
    own, rest = points[cluster & (labels == OWN)], points[cluster & (labels != OWN)]
    if clutter == CLEAN:
        return np.concatenate([own, rest]), len(own)
    others = points[labels == (TABLE if clutter == "table" else OWN + 1)]
    return _with_foreign(own, clutter, others, rng)


def images(table: Tabletop, rng: np.random.Generator) -> list[DepthImage]:
    """The depth image of every camera.

    Args:
        table: the objects on the table, and the cameras.
        rng: generator of the noise.
    """
    T = table.T_world_object
    triangles = [moved(table.mesh.triangles.reshape(-1, 3), T).reshape(-1, 3, 3)]
    if table.neighbour is not None:
        triangles.append(np.asarray(table.neighbour.triangles))
    return [depth_image(triangles, camera, rng) for camera in table.T_world_cameras]


def image_points(image: DepthImage) -> tuple[Float[np.ndarray, "points 3"], Int[np.ndarray, " points"]]:
    """Points of a depth image, (points, 3), metres, world frame; and the label of each, (points,)."""
    points = points_from_depth(image.depth, image.K, image.T_world_camera)
    metres = np.where(image.depth > 0, image.depth, np.nan)
    kept = (image.depth > 0) & ~flying_pixels(metres, image.K)  # in the order of `points_from_depth`
    return points, image.labels[kept]


def segmented(
    table: Tabletop, views: list[Float[np.ndarray, "_ 3"]], labels: Int[np.ndarray, " points"]
) -> Bool[np.ndarray, " points"]:
    """Which points of a scene are in the cluster that has most of the object's.

    Args:
        table: the object on the table, and the cameras.
        views: points of the image of each camera, metres, world frame.
        labels: what the points of all views are of, (points,).

    Raises:
        InputError: no object is found.
    """
    centre = moved(table.mesh.bounds.mean(axis=0)[None], table.T_world_object)[0, :2]
    half, below, above = WORKSPACE
    box = np.array([[*(centre - half), -below], [*(centre + half), above]])
    positions = table.T_world_cameras[:, :3, 3]
    clusters = separate_objects(views, box, camera=positions)
    points = np.concatenate(views)
    chosen = [rows_of(points, cluster) for cluster in clusters]
    return max(chosen, key=lambda one: np.count_nonzero(labels[one] == OWN))


def place_points(
    own: Float[np.ndarray, "points 3"], T_object_places: list[Float[np.ndarray, "4 4"]], fold: int, size: float
) -> int:
    """How many of 1500 points of an object are at a place, or at one that is equivalent to it.

    Args:
        own: points of the object, (points, 3), metres, object frame.
        T_object_places: the place, and others that are as right, (4, 4) each.
        fold: symmetry of the object, see `tdf_jax.geometry.symmetry`.
        size: edge of the box in which points are at the place, in its frame, metres.

    Returns:
        The number, scaled from the number of points to 1500.
    """
    turns = [about_z(2 * np.pi * turn / (fold or TURNS)) for turn in range(TURNS if fold == ROUND else fold)]
    places = [turn @ T for turn in turns for T in T_object_places]
    most = max(np.count_nonzero((np.abs(moved(own, np.linalg.inv(T))) < size / 2).all(axis=1)) for T in places)
    return round(most * SEEN_OF / len(own))


def moved(points: Float[np.ndarray, "points 3"], T: Float[np.ndarray, "4 4"]) -> Float[np.ndarray, "points 3"]:
    """Points, (points, 3), after a motion, (4, 4); metres."""
    return points @ T[:3, :3].T + T[:3, 3]


def _with_foreign(own, clutter, others, rng):
    """The object's points and at most `SHARE` foreign ones: outliers, or those of the others that are nearest."""
    count = round(len(own) * SHARE / (1 - SHARE))
    if clutter == "outliers":
        near = count // 2
        low, high = own.min(axis=0) - NEAR_OUTLIERS, own.max(axis=0) + NEAR_OUTLIERS
        away = rng.standard_normal((count - near, 3))
        away *= rng.uniform(*FAR_OUTLIERS, (count - near, 1)) / np.linalg.norm(away, axis=1, keepdims=True)
        foreign = np.concatenate([rng.uniform(low, high, (near, 3)), (low + high) / 2 + away])
    else:
        low, high = own.min(axis=0) - NEAREST_REACH, own.max(axis=0) + NEAREST_REACH
        others = others[((others >= low) & (others <= high)).all(axis=1)]
        some = own[:: max(1, len(own) // NEAREST_OF)]
        foreign = others[np.argsort(KDTree(some).query(others)[0], kind="stable")[:count]]
    return np.concatenate([own, foreign]), len(own)


def _under(points, own, reach):
    """Which points of the table are under the object, and seen by nobody."""
    from scipy.spatial import Delaunay

    foot = own[own[:, 2] < own[:, 2].min() + max(reach, 0.01), :2]
    if len(foot) < 3:
        return np.zeros(len(points), bool)
    return Delaunay(foot).find_simplex(points[:, :2]) >= 0


def rows_of(points, cluster):
    """Which points are in a cluster of some of them."""
    row = np.dtype([("", points.dtype)] * 3)
    return np.isin(np.ascontiguousarray(points).view(row)[:, 0], np.ascontiguousarray(cluster).view(row)[:, 0])
