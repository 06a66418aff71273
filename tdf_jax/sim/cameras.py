"""Depth cameras around a cell: depth images, masks, and point clouds of what they see.

Images are cast, one ray through the centre of every pixel, by `mujoco.mj_multiRay`. The renderer gives the same depths
and masks, but needs off-screen rendering (EGL); rays need nothing, and their bits do not depend on a driver.
"""

import dataclasses
from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import Float, Int
from numpy.typing import ArrayLike

from tdf_jax._internal import checks
from tdf_jax._internal.errors import InputError
from tdf_jax.geometry.pinhole import camera_matrix, looking_at
from tdf_jax.sim.physics import extra

# A frame of 640 x 480 of a cell with 131 geoms costs 0.25 s by rays on one core, a tenth for the window of a mug, and
# 0.08 s by the renderer without a GPU (depth and mask). Depths differ by less than 6e-6 m, masks by one pixel of 9900.
FOVY, WIDTH, HEIGHT = 45.0, 640, 480  # degrees and pixels
DISTANCE, ELEVATIONS = 0.7, (35.0, 55.0)  # metres and degrees, of a ring of cameras
NOISE = 0.001  # metres, standard deviation of a depth
EDGE = 0.01  # metres between the depths of neighbours: a camera measures neither there, but something in between
DRAWN = np.array([1, 1, 1, 0, 0, 0], np.uint8)  # groups of geoms that are drawn; collision geoms of robots are others


@dataclasses.dataclass(frozen=True, eq=False)
class Camera:
    """A pinhole camera.

    Attributes:
        T_world_camera: its pose, 4x4, metres, world frame; x to the right of the image, y down, z forward.
        fovy: vertical field of view, degrees.
        width, height: size of the image, pixels.
    """

    T_world_camera: Float[np.ndarray, "4 4"]
    fovy: float = FOVY
    width: int = WIDTH
    height: int = HEIGHT

    def __post_init__(self):
        """Check the values."""
        T = checks.numbers("Camera", "T_world_camera", self.T_world_camera)
        if T.shape != (4, 4) or not np.isfinite(T).all() or not np.allclose(T[3], (0, 0, 0, 1)):
            raise InputError(f"Camera: T_world_camera is {T.tolist()}; expected one finite pose, 4x4")
        checks.rotations("Camera", "the rotation of T_world_camera", T[:3, :3])
        object.__setattr__(self, "T_world_camera", T)
        for name in ("width", "height"):
            checks.count("Camera", name, getattr(self, name))
        checks.number("Camera", "fovy", self.fovy, 1.0, below=180.0, unit="degrees")

    @property
    def focal_length(self) -> float:
        """Focal length, pixels, in both directions."""
        return float(self.intrinsics[0, 0])

    @property
    def intrinsics(self) -> Float[np.ndarray, "3 3"]:
        """Matrix K, pixels; see `tdf_jax.geometry.pinhole.camera_matrix`."""
        return camera_matrix(self.fovy, self.width, self.height)


@dataclasses.dataclass(frozen=True, eq=False)
class DepthImage:
    """What a camera sees.

    Attributes:
        depth: distance along the camera's z axis, (height, width), metres; 0 where nothing is hit.
        geoms: numbers of the geoms that are seen, (height, width); -1 where nothing is hit.
    """

    depth: Float[np.ndarray, "height width"]
    geoms: Int[np.ndarray, "height width"]

    def mask(self, model: Any, name: str) -> np.ndarray:
        """Pixels that show a body, (height, width).

        Args:
            model: the `mujoco.MjModel`.
            name: name of the body.

        Raises:
            InputError: the model has no such body.
        """
        bodies = np.append(model.geom_bodyid, -1)  # for what hits nothing, geom -1
        return bodies[self.geoms] == _body("DepthImage.mask()", model, name)


def look_at(
    position: ArrayLike, target: ArrayLike, fovy: float = FOVY, width: int = WIDTH, height: int = HEIGHT
) -> Camera:
    """A camera that looks at a point, the world's z axis up in the image.

    Args:
        position: where the camera is, (3,), metres, world frame.
        target: point in the middle of the image, (3,), metres, world frame.
        fovy: vertical field of view, degrees.
        width: width of the image, pixels.
        height: height of the image, pixels.

    Raises:
        InputError: the two are the same point, or a value is out of range.
    """
    start, end = (np.asarray(checks.vector("look_at()", *one)) for one in (("position", position), ("target", target)))
    if not np.linalg.norm(end - start) > 1e-6:
        raise InputError(f"look_at(): position and target are both {end.tolist()}; expected two different points")
    return Camera(looking_at(start, end), fovy, width, height)


def camera_ring(
    count: int,
    centre: ArrayLike,
    *,
    distance: float = DISTANCE,
    elevations: tuple[float, float] = ELEVATIONS,
    azimuth: float = 0.0,
    fovy: float = FOVY,
    width: int = WIDTH,
    height: int = HEIGHT,
) -> tuple[Camera, ...]:
    """Cameras evenly around a point, all looking at it.

    Args:
        count: number of cameras.
        centre: point that they look at, (3,), metres, world frame.
        distance: distance from it, metres.
        elevations: angles above the horizontal of the first and of the last camera, degrees, evenly spaced in between;
            one camera has their mean.
        azimuth: direction of the first camera from the point, degrees about z from x; 0 is opposite the robot.
        fovy: vertical field of view, degrees.
        width: width of the images, pixels.
        height: height of the images, pixels.

    Raises:
        InputError: a value is out of range.
    """
    checks.count("camera_ring()", "count", count)
    middle = np.asarray(checks.vector("camera_ring()", "centre", centre))
    checks.positive("camera_ring()", "distance", distance, "metres")
    checks.number("camera_ring()", "azimuth", azimuth, unit="degrees")
    for elevation in checks.vector("camera_ring()", "elevations", elevations, 2, "degrees"):
        checks.number("camera_ring()", "elevations", float(elevation), -90.0, 90.0, "degrees")
    angles = np.linspace(*elevations, count) if count > 1 else [sum(elevations) / 2]
    cameras = []
    for number, up in enumerate(np.radians(angles)):
        around = np.radians(azimuth + 360 * number / count)
        away = np.array([np.cos(up) * np.cos(around), np.cos(up) * np.sin(around), np.sin(up)])
        cameras.append(look_at(middle + distance * away, middle, fovy, width, height))
    return tuple(cameras)


def depth_image(model: Any, data: Any, camera: Camera) -> DepthImage:
    """What a camera sees of a cell: exact depths, without noise.

    Args:
        model: the `mujoco.MjModel`.
        data: its state, with positions of geoms (after `mujoco.mj_forward` or a step).
        camera: the camera.
    """
    return _cast(model, data, camera, (0, camera.height, 0, camera.width))


def observed_points(
    model: Any,
    data: Any,
    cameras: Camera | Sequence[Camera],
    name: str,
    noise: float = NOISE,
    rng: np.random.Generator | int = 0,
) -> Float[np.ndarray, "points 3"]:
    """Points of one body as depth cameras see them, in the world frame.

    The mask is the simulator's. Pixels at edges of the depth are left out, as flying pixels are from a real camera's
    cloud.

    Args:
        model: the `mujoco.MjModel`.
        data: its state.
        cameras: one camera, or several, whose points are merged.
        name: name of the body.
        noise: standard deviation of the normal error of a depth, metres.
        rng: generator of the noise, or its seed.

    Returns:
        Points, (points, 3), metres, world frame, camera by camera and row by row.

    Raises:
        InputError: no camera sees the body, or the model has no such body.
    """
    checks.number("observed_points()", "noise", noise, 0.0, unit="metres")
    random = np.random.default_rng(rng)
    body = _body("observed_points()", model, name)
    several = (cameras,) if isinstance(cameras, Camera) else tuple(cameras)
    if not several:
        raise InputError("observed_points(): cameras is empty; expected at least one, see camera_ring()")
    clouds = []
    for camera in several:
        top, bottom, left, right = window = _window(model, data, camera, body)
        if bottom <= top or right <= left:
            continue
        image = _cast(model, data, camera, window)
        rows, columns = np.nonzero(image.mask(model, name) & ~_edges(image.depth))
        depth = image.depth[rows, columns]
        depth = depth + noise * random.normal(size=len(depth))
        pixels = np.stack([columns + left, rows + top, np.ones(len(rows))], axis=1)
        T = camera.T_world_camera
        clouds.append((pixels @ np.linalg.inv(camera.intrinsics).T * depth[:, None]) @ T[:3, :3].T + T[:3, 3])
    points = np.concatenate([np.zeros((0, 3)), *clouds])
    if not len(points):
        raise InputError(
            f"observed_points(): none of {len(several)} cameras sees the body {name!r}; point one at it (look_at()), "
            "or see what hides it (depth_image())"
        )
    return points


def _body(function: str, model, name: str) -> int:
    names = [model.body(number).name for number in range(model.nbody)]
    if name not in names:
        raise InputError(f"{function}: the cell has no body {name!r}; it has {', '.join(filter(None, names))}")
    return names.index(name)


def _cast(model, data, camera: Camera, window: tuple[int, int, int, int]) -> DepthImage:
    """Rays through the pixels of a window: rows from the first to before the second, columns likewise."""
    mujoco = extra("depth_image()", "mujoco")
    top, bottom, left, right = window
    rows, columns = np.mgrid[top:bottom, left:right]
    pixels = np.stack([columns, rows, np.ones_like(rows)], axis=-1).reshape(-1, 3)
    rays = pixels @ np.linalg.inv(camera.intrinsics).T  # of depth 1
    lengths = np.linalg.norm(rays, axis=1)
    directions = (rays / lengths[:, None]) @ camera.T_world_camera[:3, :3].T
    geoms, distances = np.full(len(rays), -1, np.int32), np.zeros(len(rays))
    mujoco.mj_multiRay(
        model,
        data,
        camera.T_world_camera[:3, 3],
        np.ascontiguousarray(directions).ravel(),
        DRAWN,
        True,
        -1,
        geoms,
        distances,
        None,
        len(rays),
        mujoco.mjMAXVAL,
    )
    depths = np.where(geoms >= 0, distances / lengths, 0.0)
    return DepthImage(depths.reshape(rows.shape), geoms.reshape(rows.shape).astype(int))


def _window(model, data, camera: Camera, body: int) -> tuple[int, int, int, int]:
    """Rows and columns of the image in which a body can be, and one more on every side for its edges."""
    T = camera.T_world_camera
    geoms = np.flatnonzero(model.geom_bodyid == body)
    if not len(geoms):
        return 0, 0, 0, 0
    centres, radii = (data.geom_xpos[geoms] - T[:3, 3]) @ T[:3, :3], model.geom_rbound[geoms]
    if (radii == 0).any() or (centres[:, 2] <= radii + 1e-3).any():  # a plane, or at the camera
        return 0, camera.height, 0, camera.width
    signs = np.array(np.meshgrid([-1, 1], [-1, 1], [-1, 1])).reshape(3, -1).T
    corners = (centres[:, None] + radii[:, None, None] * signs).reshape(-1, 3)
    pixels = (corners / corners[:, 2:]) @ camera.intrinsics.T
    low = (np.floor(pixels.min(axis=0)).astype(int) - 1).tolist()
    high = (np.ceil(pixels.max(axis=0)).astype(int) + 2).tolist()
    return max(low[1], 0), min(high[1], camera.height), max(low[0], 0), min(high[0], camera.width)


def _edges(depth: Float[np.ndarray, "height width"]) -> np.ndarray:
    """Pixels beside a neighbour, in the row or in the column, that is nearer or farther by more than `EDGE`."""
    far = np.where(depth > 0, depth, np.inf)
    edges = np.zeros(depth.shape, bool)
    with np.errstate(invalid="ignore"):  # inf - inf: two that see nothing
        down, across = np.abs(np.diff(far, axis=0)) > EDGE, np.abs(np.diff(far, axis=1)) > EDGE
    edges[1:] |= down
    edges[:-1] |= down
    edges[:, 1:] |= across
    edges[:, :-1] |= across
    return edges
