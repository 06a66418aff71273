"""Points of a depth image: a pinhole camera, what it did not measure, and pixels between two surfaces."""

from typing import Literal, NamedTuple, overload

import numpy as np
from jaxtyping import Bool, Float, Num
from numpy.typing import ArrayLike

from tdf_jax._internal import checks
from tdf_jax._internal.boundary import host
from tdf_jax._internal.errors import InputError

# Metres. Depth cameras measure from a few centimetres to some tens of metres. In millimetres, the nearest of them would
# already be 100 m away.
NEAREST, FARTHEST = 0.02, 50.0
# Largest distance of the principal point from the middle of the image, as a share of half its size. Real cameras have
# up to 0.15; intrinsics of another resolution differ by more than a quarter, as of 640 and 848 columns.
OFF_CENTRE = 0.25
# Degrees between a surface's normal and the ray. Cameras measure nothing on steeper surfaces, so that a pixel whose
# depth differs more from both sides is between two surfaces.
GRAZING = 85.0
SMALLEST_STEP = 0.005  # metres: smaller steps are noise
DIRECTIONS = ((0, 1), (1, 0), (1, 1), (1, -1))  # from a pixel to its neighbours and, in reverse, to the opposite ones


class DepthCounts(NamedTuple):
    """What became of the pixels of a depth image.

    Attributes:
        pixels: number of pixels of the image.
        masked: number of pixels outside the mask.
        invalid: number of pixels in the mask without a measurement: 0, negative, NaN, infinite, or the largest number
            of an integer type.
        flying: number of pixels in the mask that are between a near and a far surface.
        points: number of points: the other pixels.
    """

    pixels: int
    masked: int
    invalid: int
    flying: int
    points: int


@overload
def points_from_depth(
    depth: Num[np.ndarray, "height width"],
    intrinsics: ArrayLike,
    T_world_camera: ArrayLike | None = None,
    mask: ArrayLike | None = None,
    depth_scale: float = 1.0,
    *,
    return_counts: Literal[False] = False,
) -> Float[np.ndarray, "points 3"]: ...
@overload
def points_from_depth(
    depth: Num[np.ndarray, "height width"],
    intrinsics: ArrayLike,
    T_world_camera: ArrayLike | None = None,
    mask: ArrayLike | None = None,
    depth_scale: float = 1.0,
    *,
    return_counts: Literal[True],
) -> tuple[Float[np.ndarray, "points 3"], DepthCounts]: ...
@host
def points_from_depth(
    depth: Num[np.ndarray, "height width"],
    intrinsics: ArrayLike,
    T_world_camera: ArrayLike | None = None,
    mask: ArrayLike | None = None,
    depth_scale: float = 1.0,
    *,
    return_counts: bool = False,
) -> Float[np.ndarray, "points 3"] | tuple[Float[np.ndarray, "points 3"], DepthCounts]:
    """Compute the points of a depth image of a pinhole camera, without distortion.

    Pixels without a measurement are left out, and so are flying pixels: those between a near and a far surface, where a
    camera measures a mixture of both. Points of several images in one world frame are merged by `np.concatenate`.

    Args:
        depth: distance along the camera's z axis, (height, width): floating point metres, or whole numbers in units of
            `depth_scale`.
        intrinsics: focal lengths and principal point (fx, fy, cx, cy), pixels, or the matrix K, (3, 3), as in OpenCV:
            whole pixel coordinates are the centres of pixels.
        T_world_camera: pose of the camera, (4, 4), metres, world frame; x to the right of the image, y down, z forward.
            Without it the points are in the camera's frame.
        mask: pixels of the object, (height, width), True or a positive number inside; by default all.
        depth_scale: metres per unit of the depth, such as 0.001 for millimetres; whole numbers need it.
        return_counts: also return what became of the pixels.

    Returns:
        Points, (points, 3), metres, world frame, row by row; with `return_counts`, and their `DepthCounts`.

    Raises:
        InputError: depths that are not metres after scaling, a mask of another size, intrinsics of another resolution,
            a pose that is not rigid, or no pixel with a measurement.
    """
    function = "points_from_depth()"
    checks.boolean(function, "return_counts", return_counts)
    metres = _metres(function, depth, depth_scale)
    K = camera_matrix(function, intrinsics, metres.shape)
    T = np.eye(4) if T_world_camera is None else rigid_pose(function, T_world_camera)
    inside = np.ones(metres.shape, bool) if mask is None else _mask(function, mask, metres.shape)
    measured = np.isfinite(metres)
    if not (measured & inside).any():
        where = "" if mask is None else f" in the mask's {np.count_nonzero(inside)} pixels"
        raise InputError(
            f"{function}: no pixel{where} has a measured depth: all are 0, negative, NaN or infinite; expected depths "
            "of an object. Check the image, the mask and the camera's range"
        )
    _check_range(function, float(np.median(metres[measured & inside])), depth_scale)
    flying = flying_pixels(metres, K)
    kept = measured & inside & ~flying
    if not kept.any():
        raise InputError(
            f"{function}: all {np.count_nonzero(measured & inside)} measured pixels lie between two surfaces; expected "
            "some that belong to a surface. Check the mask, which is perhaps a contour, and the depths"
        )
    rows, columns = np.nonzero(kept)
    rays = np.stack([columns, rows, np.ones(len(rows))], axis=1) @ np.linalg.inv(K).T
    points = (rays * metres[rows, columns][:, None]) @ T[:3, :3].T + T[:3, 3]
    if not return_counts:
        return points
    counts = DepthCounts(
        pixels=metres.size,
        masked=int(np.count_nonzero(~inside)),
        invalid=int(np.count_nonzero(inside & ~measured)),
        flying=int(np.count_nonzero(inside & flying)),
        points=len(points),
    )
    return points, counts


def flying_pixels(
    depth: Float[np.ndarray, "height width"], K: Float[np.ndarray, "3 3"]
) -> Bool[np.ndarray, "height width"]:
    """Find pixels that are on no surface: in some direction, both neighbours' depths differ and one of them is nearer.

    A thin object before a far background has two farther neighbours, and stays. Depths differ if the surface between
    them would be steeper than `GRAZING`.

    Args:
        depth: depths, (height, width), metres; NaN where nothing is measured.
        K: the camera's matrix, (3, 3), pixels.
    """
    step = np.maximum(SMALLEST_STEP, np.tan(np.radians(GRAZING)) * depth / min(K[0, 0], K[1, 1]))
    padded = np.pad(depth, 1, mode="edge")
    height, width = depth.shape
    flying, alone = np.zeros(depth.shape, bool), np.ones(depth.shape, bool)
    for down, right in DIRECTIONS:
        length = np.hypot(down, right)
        near, far, joined = np.zeros(depth.shape, int), np.zeros(depth.shape, int), np.zeros(depth.shape, bool)
        for sign in (1, -1):
            top, left = 1 + sign * down, 1 + sign * right
            other = padded[top : top + height, left : left + width]
            with np.errstate(invalid="ignore"):
                joined |= np.abs(other - depth) <= length * step
                near += other < depth
                far += ~(other < depth)  # farther, or nothing is measured there
        alone &= ~joined
        flying |= ~joined & (near > 0)
    return np.isfinite(depth) & (flying | alone)


def camera_matrix(function: str, intrinsics: ArrayLike, shape: tuple[int, ...]) -> Float[np.ndarray, "3 3"]:
    """Check that intrinsics are those of a pinhole camera and of an image of this size.

    Args:
        function: name that error messages begin with.
        intrinsics: (fx, fy, cx, cy) or a matrix, (3, 3), pixels.
        shape: height and width of the image, pixels.

    Returns:
        The matrix K, (3, 3), pixels.

    Raises:
        InputError: they are neither, or the principal point is far from the middle of the image.
    """
    K = checks.numbers(function, "intrinsics", intrinsics)
    if K.shape == (4,):
        fx, fy, cx, cy = K
        K = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1.0]])
    if K.shape != (3, 3):
        fix = ". Reshape camera_info.k: np.reshape(k, (3, 3))" if K.shape == (9,) else ""
        raise InputError(f"{function}: intrinsics have shape {K.shape}; expected (fx, fy, cx, cy) or (3, 3){fix}")
    if not np.isfinite(K).all() or (K[2] != (0, 0, 1)).any() or K[1, 0] != 0:
        fix = "transpose it: K.T" if (K[:, 2] == (0, 0, 1)).all() else "check the order of its numbers"
        raise InputError(
            f"{function}: intrinsics are {K.tolist()}; expected [[fx, 0, cx], [0, fy, cy], [0, 0, 1]]; {fix}"
        )
    height, width = shape
    if not min(K[0, 0], K[1, 1]) > 0:
        raise InputError(f"{function}: focal lengths are {K[0, 0]:g} and {K[1, 1]:g}; expected positive, pixels")
    middle = np.array([width - 1, height - 1]) / 2
    if (np.abs(K[:2, 2] - middle) > OFF_CENTRE * np.maximum(middle, 1)).any():
        raise InputError(
            f"{function}: the principal point is ({K[0, 2]:g}, {K[1, 2]:g}) and the image has {width} x {height} "
            f"pixels; expected it near the middle, ({middle[0]:g}, {middle[1]:g}). Are these the intrinsics of another "
            "resolution, or of the colour camera? Scale fx and cx by the ratio of the widths, fy and cy by that of the "
            "heights; take the order fx, fy, cx, cy; and use a mask instead of cropping the image"
        )
    return K


def rigid_pose(function: str, T_world_camera: ArrayLike) -> Float[np.ndarray, "4 4"]:
    """Check that a camera's pose is one rigid transformation, metres; return it as float64.

    Args:
        function: name that error messages begin with.
        T_world_camera: the pose, (4, 4), metres, world frame.

    Raises:
        InputError: it is not.
    """
    T = checks.numbers(function, "T_world_camera", T_world_camera)
    if T.shape != (4, 4):
        fix = "; tdf.Trajectory(pose[None]).matrices[0] is the matrix of wxyz_xyz" if T.shape == (7,) else ""
        raise InputError(f"{function}: T_world_camera has shape {T.shape}; expected one pose, (4, 4){fix}")
    if not np.isfinite(T).all() or not np.allclose(T[3], (0, 0, 0, 1)):
        fix = ". Transpose it: T.T" if np.allclose(T[:, 3], (0, 0, 0, 1)) and T[3, :3].any() else ""
        raise InputError(
            f"{function}: T_world_camera is {T.tolist()}; expected a finite pose with the last row 0 0 0 1{fix}"
        )
    checks.rotations(function, "the rotation of T_world_camera", T[:3, :3])
    checks.near(function, "the position in T_world_camera", T[None, :3, 3])
    return T


def _metres(function: str, depth, depth_scale) -> Float[np.ndarray, "height width"]:
    """Depths in metres, NaN where nothing is measured."""
    given = checks.plain_array(function, "depth", depth)
    if given.ndim != 2 or not given.size or given.dtype.kind not in "fiu":
        fix = ". Take one channel: depth[..., 0]" if given.ndim == 3 and given.shape[2] == 1 else ""
        raise InputError(
            f"{function}: depth has shape {given.shape} and type {given.dtype}; expected one number a pixel, (height, "
            f"width), metres, or whole numbers with their depth_scale{fix}"
        )
    if given.dtype.itemsize == 1:
        raise InputError(
            f"{function}: depth has 8 bits; expected 16 bits or floating point. A picture of a depth image is no depth "
            "image: save it as 16-bit PNG or .npy"
        )
    scale = float(checks.positive(function, "depth_scale", depth_scale, "metres per unit"))
    whole = given.dtype.kind in "iu"
    if scale > 1 or (whole and scale == 1):
        reason = "the image has whole numbers" if whole else "the image has floating point numbers"
        raise InputError(
            f"{function}: depth_scale is {scale:g} and {reason}; expected metres per unit, such as depth_scale=0.001 "
            "for millimetres. Open3D's depth_scale of 1000 is the inverse"
        )
    values = given.astype(np.float64)
    measured = np.isfinite(values) & (values > 0)
    if whole:
        measured &= given != np.iinfo(given.dtype).max
    values[~measured] = np.nan
    return values * scale


def _check_range(function: str, median: float, scale: float) -> None:
    if NEAREST <= median <= FARTHEST:
        return
    fix = (
        "If the depths are millimetres, pass depth_scale=0.001"
        if median > FARTHEST
        else "If the depths are metres already, leave depth_scale out; otherwise check it"
    )
    raise InputError(
        f"{function}: the median depth is {median:.4g} m with depth_scale={scale:g}; expected {NEAREST:g} to "
        f"{FARTHEST:g} m. {fix}"
    )


def _mask(function: str, mask, shape: tuple[int, ...]) -> Bool[np.ndarray, "height width"]:
    given = checks.plain_array(function, "mask", mask)
    if given.shape != shape:
        raise InputError(
            f"{function}: mask has shape {given.shape} and depth {shape}; expected the same. Align the mask with the "
            "depth image, and resize it without interpolation"
        )
    values = given if given.dtype.kind == "b" else np.unique(given)
    if given.dtype.kind not in "biuf" or (given.dtype.kind != "b" and (len(values) > 2 or not (values >= 0).all())):
        raise InputError(
            f"{function}: mask has type {given.dtype} and {len(np.unique(given))} different values; expected True "
            "inside and False outside. Of an image of labels, take one: mask == label"
        )
    inside = given > 0
    if not inside.any():
        raise InputError(f"{function}: mask has no pixel; expected True on the object")
    return inside
