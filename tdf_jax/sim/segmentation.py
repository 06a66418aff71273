"""The cloud of one body as a user has it: depth images of the whole scene, from which all else is removed."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import Bool, Float
from numpy.typing import ArrayLike

from tdf_jax._internal import checks
from tdf_jax._internal.errors import InputError
from tdf_jax.perception.clusters import separate_objects
from tdf_jax.perception.depth import points_from_depth
from tdf_jax.sim.cameras import EDGE, NOISE, Camera, depth_image
from tdf_jax.sim.workcell import TABLE, TABLE_NAME, Workcell

HEIGHTS = (-0.05, 0.60)  # metres, lower and upper end of the workspace above the table
# Metres by which a pixel may be nearer than the robot's surface where it is computed to be, and pixels by which its
# outline is widened: noise, mixed depths, and the errors of joints and of a calibration.
BEHIND, WIDENED = 0.01, 3


def segmented_points(
    cell: Workcell,
    data: Any,
    cameras: Sequence[Camera],
    centre: ArrayLike,
    noise: float = NOISE,
    rng: np.random.Generator | int = 0,
    own: tuple[Workcell, Any] | None = None,
) -> Float[np.ndarray, "points 3"]:
    """Points of the object that cameras look at, without the simulator's mask.

    Depths have normal noise, and those at edges are mixtures of two surfaces. The robot is masked by its forward
    kinematics. Table, walls and other objects are removed by `separate_objects`, and the cluster nearest to where the
    cameras look is taken.

    Args:
        cell: the cell.
        data: its state.
        cameras: cameras whose points are merged.
        centre: where they look, (3,), metres, world frame.
        noise: standard deviation of the normal error of a depth, metres.
        rng: generator of the noise, or its seed.
        own: a cell with the robot alone and its state, at the joints that the robot measures; None if no robot is in
            sight.

    Returns:
        Points, (points, 3), metres, world frame.

    Raises:
        InputError: there are no cameras, or nothing is left of what they see.
    """
    function = "segmented_points()"
    checks.number(function, "noise", noise, 0.0, unit="metres")
    middle, random = np.asarray(checks.vector(function, "centre", centre)), np.random.default_rng(rng)
    if not len(cameras):
        raise InputError(f"{function}: cameras is empty; expected at least one, see camera_ring()")
    clouds = []
    for camera in cameras:
        depth = mixed_depths(depth_image(cell.model, data, camera).depth, random)
        depth = np.where(depth > 0, depth + noise * random.normal(size=depth.shape), 0.0)
        free = None if own is None else ~robot_mask(*own, camera, depth)
        clouds.append(points_from_depth(depth, camera.intrinsics, camera.T_world_camera, free))
    (x, y, top), (half_x, half_y, half) = TABLE
    low, high = np.array([x - half_x, y - half_y, top + half]), np.array([x + half_x, y + half_y, top + half])
    box = np.stack([low + (0, 0, HEIGHTS[0]), high + (0, 0, HEIGHTS[1])])
    found = separate_objects(clouds, box, camera=[camera.T_world_camera[:3, 3] for camera in cameras])
    return min(found, key=lambda points: float(np.linalg.norm(points - middle, axis=1).min()))


def mixed_depths(
    depth: Float[np.ndarray, "height width"], rng: np.random.Generator
) -> Float[np.ndarray, "height width"]:
    """Depths of which those at an edge are between both sides, as those of a pixel that sees two surfaces.

    Args:
        depth: exact depths, (height, width), metres; 0 where nothing is hit.
        rng: generator of the shares of both sides.
    """
    mixed = depth.copy()
    share = rng.uniform(size=depth.shape)
    for axis in (0, 1):
        first, second = (np.take(depth, range(start, depth.shape[axis] - 1 + start), axis) for start in (0, 1))
        edge = (first > 0) & (second > 0) & (np.abs(first - second) > EDGE)
        # One of the two pixels at an edge sees both surfaces; which one it is, its share says.
        part = np.take(share, range(depth.shape[axis] - 1), axis)
        own = np.where(edge & (part < 0.5), first + 2 * part * (second - first), np.nan)
        other = np.where(edge & (part >= 0.5), first + (2 * part - 1) * (second - first), np.nan)
        before, after = ([slice(None)] * 2 for _ in range(2))
        before[axis], after[axis] = slice(None, -1), slice(1, None)
        for place, values in ((before, own), (after, other)):
            mixed[tuple(place)] = np.where(np.isnan(values), mixed[tuple(place)], values)
    return mixed


def robot_mask(
    own: Workcell, data: Any, camera: Camera, depth: Float[np.ndarray, "height width"]
) -> Bool[np.ndarray, "height width"]:
    """Pixels that show a robot, or what it hides, by its forward kinematics.

    Args:
        own: a cell with the robot alone.
        data: its state, at the measured joints.
        camera: the camera.
        depth: depths that it measures, (height, width), metres.
    """
    from scipy.ndimage import minimum_filter

    image = depth_image(own.model, data, camera)
    robot = (image.geoms >= 0) & (image.geoms != own.model.geom(TABLE_NAME).id)
    surface = minimum_filter(np.where(robot, image.depth, np.inf), size=2 * WIDENED + 1)
    return depth > surface - BEHIND
