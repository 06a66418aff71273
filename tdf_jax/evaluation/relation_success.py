"""Whether an object is placed on its target: gap, penetration, orientation, support, by the exact solids of both."""

import dataclasses
from typing import cast

import numpy as np
from jaxtyping import Float
from scipy.spatial import ConvexHull, QhullError

from tdf_jax.evaluation.relation_tasks import Pair
from tdf_jax.evaluation.tabletop import moved
from tdf_jax.geometry import se3
from tdf_jax.geometry.sampling import sample_surface
from tdf_jax.geometry.winding import libigl
from tdf_jax.shapes import Mug, Rack, Shape

TOLERANCES = (0.002, 0.005)  # metres, largest gap and penetration; the first is the criterion
UPRIGHT = 15.0  # degrees, largest tilt of a bowl or bottle, as in R-NDF
SAMPLES = 5000  # surface points of each object
BEARING = 0.01  # metres above the target from which an object bears once it has settled
TOUCH = 3e-4  # metres, depth of a surface point that counts as touching
FREED_BY = (0.001, 0.002, 0.003, 0.005, 0.010)  # metres, tested displacements
STEEPEST = np.cos(np.radians(45))  # of the direction from object to target where it bears, from straight down


@dataclasses.dataclass(frozen=True)
class Placed:
    """How an object is placed on its upright target; lengths in metres.

    Attributes:
        gap: distance of the two surfaces; 0 if they overlap.
        penetration: the shortest of the tested displacements (`FREED_BY`, in 26 directions) after which no surface
            point of either is inside the other; infinite if there is none. Walls are thin, so that a point in the
            middle of one is never deep in it, however far the objects overlap.
        tilt: angle of the object's axis from its angle in the true pose, degrees; NaN where any is right.
        hung: whether a peg's axis crosses the finger hole, before and after the mug swings freely about the contact;
            True of other objects.
        supported: whether the centre of mass is over the support polygon; of a mug, whether it is below the contact,
            and the contact along the peg.
    """

    gap: float
    penetration: float
    tilt: float
    hung: bool
    supported: bool

    def holds(self, tolerance: float = TOLERANCES[0]) -> bool:
        """Whether the placement is a success.

        Args:
            tolerance: largest gap and penetration, metres.
        """
        near = self.gap <= tolerance and self.penetration <= tolerance
        return near and not self.tilt > UPRIGHT and self.hung and self.supported


def judge(pair: Pair, T_target_object: Float[np.ndarray, "4 4"], samples: int = SAMPLES) -> Placed:
    """Judge a pose of the object on the upright target.

    Args:
        pair: the object and the target.
        T_target_object: pose of the object in the target's frame, 4x4.
        samples: number of surface points of each.

    Raises:
        InputError: libigl is not installed.
    """
    one, target = pair.object, pair.target
    rng = np.random.default_rng(0)
    # Corners too: they are what touches first.
    surface = np.concatenate([sample_surface(one.mesh, samples, rng), one.mesh.vertices])
    other = np.concatenate([sample_surface(target.mesh, samples, rng), target.mesh.vertices])
    surface = moved(surface, T_target_object)
    distances, nearest = signed_distances(target, surface)
    back, _ = signed_distances(one, moved(other, np.linalg.inv(T_target_object)))
    lowest = min(distances.min(), back.min())
    penetration = 0.0 if lowest >= -TOUCH else _penetration(one, target, T_target_object, surface, other)
    tilt = np.degrees(np.arccos(np.clip(T_target_object[2, 2], -1, 1))) if one.category != "mug" else np.nan
    centre = moved(one.mesh.center_mass[None], T_target_object)[0]
    # The contact: on the target, nearest to the object.
    contact = nearest[np.argmin(distances)] if distances.min() <= back.min() else other[np.argmin(back)]
    if target.category == "rack":
        hung, supported = _hangs(cast(Mug, one), cast(Rack, target), T_target_object, contact, centre)
    else:
        hung, supported = True, _stands(surface, nearest, distances, centre)
    return Placed(float(max(0.0, lowest)), penetration, float(tilt), hung, supported)


def signed_distances(
    shape: Shape, points: Float[np.ndarray, "points 3"]
) -> tuple[Float[np.ndarray, " points"], Float[np.ndarray, "points 3"]]:
    """Distances of points from an object's surface, negative inside, and the nearest points of the surface.

    Args:
        shape: the object.
        points: points, (points, 3), metres, object frame.

    Raises:
        InputError: libigl is not installed.
    """
    igl = libigl("signed_distances()")
    vertices, faces = np.asarray(shape.mesh.vertices, float), np.asarray(shape.mesh.faces, np.int64)
    squared, _, nearest = igl.point_mesh_squared_distance(np.ascontiguousarray(points, float), vertices, faces)
    return np.sqrt(squared) * np.where(shape.contains(points), -1.0, 1.0), np.asarray(nearest)


def _penetration(one: Shape, target: Shape, T_target_object, surface, other) -> float:
    directions = np.stack(np.meshgrid(*[[0.0, 1.0, -1.0]] * 3, indexing="ij"), axis=-1).reshape(-1, 3)[1:]
    directions = directions[np.lexsort((-directions[:, 2], np.abs(directions).sum(axis=1)))]  # up is most often right
    directions = directions / np.linalg.norm(directions, axis=1, keepdims=True)
    for length in FREED_BY:
        for direction in directions:
            raised = T_target_object.copy()
            raised[:3, 3] += length * direction
            if _free(target, surface + length * direction) and _free(one, moved(other, np.linalg.inv(raised))):
                return length
    return np.inf


def _free(shape: Shape, points) -> bool:
    inside = points[shape.contains(points)]
    return len(inside) == 0 or bool(signed_distances(shape, inside)[0].min() >= -TOUCH)


def _stands(surface, nearest, distances, centre) -> bool:
    """Whether the centre of mass is over the convex hull of the points where the object bears on the target."""
    down = (surface - nearest)[:, 2] / np.maximum(np.abs(distances), 1e-9)
    bearing = surface[(distances < BEARING) & ((down > STEEPEST) | (np.abs(distances) < TOUCH))][:, :2]
    try:
        sides = ConvexHull(bearing).equations
    except (QhullError, ValueError):  # fewer than three points, or all on a line
        return False
    return bool((sides[:, :2] @ centre[:2] + sides[:, 2] <= 0).all())


def _hangs(mug: Mug, rack: Rack, T_rack_mug, contact, centre) -> tuple[bool, bool]:
    """Whether one peg's axis crosses the finger hole before and after the swing, and whether the mug hangs from it."""
    arm = centre - contact
    swing = np.eye(4)
    swing[:3, :3] = _turned_down(arm / max(np.linalg.norm(arm), 1e-9))
    swing[:3, 3] = contact - swing[:3, :3] @ contact
    hung = [
        hole_is_crossed(mug, line, T_rack_mug) and hole_is_crossed(mug, line, swing @ T_rack_mug)
        for line in rack.peg_lines
    ]
    if not any(hung):
        return False, False
    root, tip = rack.peg_lines[hung.index(True)]
    along = (contact - root) @ (tip - root) / np.sum((tip - root) ** 2)
    return True, bool(arm[2] < 0 and 0 < along < 1)


def _turned_down(direction: np.ndarray) -> np.ndarray:
    """The smallest rotation that turns a unit vector straight down."""
    axis = np.cross(direction, [0.0, 0.0, -1.0])
    sine = np.linalg.norm(axis)
    angle = np.arctan2(sine, -direction[2])
    axis = axis / sine if sine > 1e-9 else np.array([1.0, 0.0, 0.0])
    return np.asarray(se3.exp(angle * axis), float)


def hole_is_crossed(mug: Mug, line: Float[np.ndarray, "2 3"], T_target_mug: Float[np.ndarray, "4 4"]) -> bool:
    """Whether a line from one point to another, such as a peg's axis, goes through a mug's finger hole.

    Args:
        mug: the mug.
        line: the two points, (2, 3), metres, in the target's frame.
        T_target_mug: pose of the mug in that frame, 4x4.
    """
    return _crosses(mug, moved(line, np.linalg.inv(T_target_mug)))


def _crosses(mug: Mug, line: Float[np.ndarray, "2 3"]) -> bool:
    """Whether a line from one point to another, in the mug's frame, goes through its finger hole."""
    (_, y0, _), (_, y1, _) = line
    if y0 * y1 >= 0:
        return False
    x, _, z = line[0] + y0 / (y0 - y1) * (line[1] - line[0])
    corners = mug.finger_hole - [x, z]
    angles = np.unwrap(np.arctan2(*np.concatenate([corners, corners[:1]]).T))
    return bool(abs(angles[-1] - angles[0]) > np.pi)  # once around, or not at all
