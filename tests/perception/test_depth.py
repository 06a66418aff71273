"""Points of a depth image: the pinhole against OpenCV's formula, invalid and flying pixels, and refused input."""

import numpy as np
import pytest

import tdf_jax as tdf
from tdf_jax.perception.depth import DepthCounts, points_from_depth

K = np.array([[300.0, 0, 80.2], [0, 310.0, 59.1], [0, 0, 1]])
SHAPE = (120, 160)


def image(depth=0.7):
    """A plane that faces the camera, tilted a little so that no two depths are equal."""
    rows, columns = np.mgrid[: SHAPE[0], : SHAPE[1]]
    return depth + 1e-4 * rows + 1e-5 * columns


def pose():
    """A camera above the origin that looks down."""
    T = np.diag([1.0, -1, -1, 1])
    T[:3, 3] = 0.1, 0.2, 0.9
    return T


def test_points_project_back_onto_their_pixels():
    depth = image()
    points = points_from_depth(depth, K)
    x, y, z = points.T
    np.testing.assert_allclose(z.reshape(SHAPE), depth, rtol=1e-12)
    np.testing.assert_allclose((300 * x / z + 80.2).reshape(SHAPE)[5], np.arange(160), atol=1e-9)
    np.testing.assert_allclose((310 * y / z + 59.1).reshape(SHAPE)[:, 7], np.arange(120), atol=1e-9)


def test_four_numbers_are_the_matrix():
    np.testing.assert_array_equal(points_from_depth(image(), (300, 310, 80.2, 59.1)), points_from_depth(image(), K))


def test_the_pose_moves_points_to_the_world():
    T, seen = pose(), points_from_depth(image(), K)
    expected = (T @ np.column_stack([seen, np.ones(len(seen))]).T).T[:, :3]
    np.testing.assert_allclose(points_from_depth(image(), K, T), expected, atol=1e-12)


def test_whole_numbers_are_scaled():
    millimetres = np.round(1000 * image()).astype(np.uint16)
    points = points_from_depth(millimetres, K, depth_scale=0.001)
    np.testing.assert_allclose(points, points_from_depth(image(), K), atol=6e-4)


def test_a_mask_selects_pixels_of_either_type():
    mask = np.zeros(SHAPE, np.uint8)
    mask[10:20, 30:50] = 255
    points, counts = points_from_depth(image(), K, mask=mask, return_counts=True)
    assert counts == DepthCounts(pixels=19200, masked=19000, invalid=0, flying=0, points=200)
    np.testing.assert_array_equal(points, points_from_depth(image(), K, mask=mask > 0))
    assert points[:, 2] == pytest.approx(image()[10:20, 30:50].ravel())


@pytest.mark.parametrize("invalid", [0.0, np.nan, np.inf, -np.inf, -0.5])
def test_pixels_without_a_measurement_are_dropped_and_counted(invalid):
    depth = image()
    depth[3, 4:9] = invalid
    points, counts = points_from_depth(depth, K, return_counts=True)
    assert (counts.invalid, counts.flying, counts.points) == (5, 0, 19195)
    assert np.isfinite(points).all() and len(points) == 19195


def test_the_largest_whole_number_is_no_measurement():
    depth = np.full(SHAPE, 700, np.uint16)
    depth[3, 4:9] = 65535
    assert points_from_depth(depth, K, depth_scale=1e-3, return_counts=True)[1].invalid == 5


def scene():
    """A strip 3 pixels wide in front of a background, with a pixel in between on both of its sides."""
    depth = image(1.0)
    depth[:, 60:63] = 0.6
    depth[:, [59, 63]] = np.linspace(0.7, 0.9, SHAPE[0])[:, None]
    return depth


def test_flying_pixels_are_removed_and_thin_objects_stay():
    points, counts = points_from_depth(scene(), K, return_counts=True)
    assert (counts.flying, counts.invalid) == (240, 0)
    assert (np.abs(points[:, 2] - 0.6) < 1e-9).sum() == 3 * SHAPE[0]
    assert not ((points[:, 2] > 0.61) & (points[:, 2] < 0.99)).any()


def test_wires_of_one_pixel_stay_and_lone_pixels_go():
    depth = image(1.0)
    depth[20] = 0.6
    depth[60, 60] = 0.5
    points, counts = points_from_depth(depth, K, return_counts=True)
    assert counts.flying == 1
    assert (points[:, 2] < 0.7).sum() == SHAPE[1]


def test_steep_surfaces_stay():
    """A plane that is seen at 80 degrees from its normal has steps of 1 cm from one row to the next, and no edges."""
    rows = np.arange(SHAPE[0])[:, None]
    depth = np.broadcast_to(0.5 / (1 - np.tan(np.radians(80)) * (rows - 59.1) / 310 * 0.4), SHAPE)
    assert np.abs(np.diff(depth, axis=0)).max() > 0.007
    assert points_from_depth(depth, K, return_counts=True)[1].flying == 0


def test_clouds_of_several_images_merge_in_the_world():
    """Two cameras see one plane, z = 0 of the world."""
    T, other = pose(), pose()
    other[:3, 3] = 0.15, 0.2, 0.6
    flat, closer = np.full(SHAPE, 0.9), np.full(SHAPE, 0.6)
    merged = np.concatenate([points_from_depth(flat, K, T), points_from_depth(closer, K, other)])
    assert np.abs(merged[:, 2]).max() < 1e-12 and len(merged) == 2 * 19200


MILLIMETRES = (1000 * image()).astype(np.uint16)
SCALED = pose()
SCALED[:3, :3] *= 1000
MIRRORED = np.diag([1.0, 1, -1, 1])
FAR = pose()
FAR[:3, 3] *= 1000
HALF = (150.0, 155.0, 39.6, 29.3)


@pytest.mark.parametrize(
    ("keywords", "words"),
    [
        ({"depth": MILLIMETRES}, "depth_scale is 1 and the image has whole numbers; .*0.001"),
        ({"depth": MILLIMETRES, "depth_scale": 1000.0}, "Open3D's depth_scale of 1000 is the inverse"),
        ({"depth": 1000 * image()}, "median depth is 70.* millimetres, pass depth_scale=0.001"),
        ({"depth_scale": 0.001}, "median depth is 0.000.* metres already"),
        ({"depth": image().astype(np.uint8)}, "8 bits"),
        ({"depth": np.stack([image()] * 3, axis=-1)}, r"shape \(120, 160, 3\)"),
        ({"depth": image()[..., None]}, r"depth\[..., 0\]"),
        ({"depth": image() > 0}, "type bool"),
        ({"depth": np.zeros(SHAPE)}, "no pixel has a measured depth"),
        ({"depth_scale": -1.0}, "depth_scale is -1.0; expected a positive number"),
        ({"mask": np.ones((60, 80), bool)}, r"mask has shape \(60, 80\) and depth \(120, 160\)"),
        ({"mask": np.zeros(SHAPE, bool)}, "mask has no pixel"),
        ({"mask": np.arange(120 * 160).reshape(SHAPE) % 4}, "4 different values.* mask == label"),
        ({"mask": np.where(image() > 0, "a", "b")}, "mask has type"),
        ({"intrinsics": (600.0, 620.0, 160.4, 118.2)}, "principal point is .* another resolution"),
        ({"intrinsics": HALF}, "principal point is .* another resolution"),
        ({"intrinsics": (300.0, 80.2, 310.0, 59.1)}, "order fx, fy, cx, cy"),
        ({"intrinsics": K.T}, "transpose it"),
        ({"intrinsics": K.ravel()}, "reshape"),
        ({"intrinsics": (0.0, 310.0, 80.2, 59.1)}, "focal lengths are 0 and 310"),
        ({"intrinsics": (np.nan, 310.0, 80.2, 59.1)}, "check the order"),
        ({"intrinsics": "K"}, "expected real numbers"),
        ({"T_world_camera": SCALED}, "rotation of T_world_camera is not orthonormal"),
        ({"T_world_camera": MIRRORED}, "determinant 1"),
        ({"T_world_camera": pose().T}, r"Transpose it: T\.T"),
        ({"T_world_camera": FAR}, "position in T_world_camera .* millimetres"),
        ({"T_world_camera": [1.0, 0, 0, 0, 0, 0, 1]}, "matrix of wxyz_xyz"),
        ({"T_world_camera": np.full((4, 4), np.nan)}, "finite pose"),
        ({"return_counts": 1}, "return_counts is 1; expected True or False"),
    ],
    ids=str,
)
def test_what_would_give_a_wrong_cloud_is_refused(keywords, words):
    given = {"depth": image(), "intrinsics": K} | keywords
    with pytest.raises(tdf.InputError, match=rf"(?i)^points_from_depth\(\): .*{words}"):
        points_from_depth(**given)


def test_a_mask_without_a_measurement_is_refused():
    depth, mask = image(), np.zeros(SHAPE, bool)
    depth[:20] = 0
    mask[:10] = True
    with pytest.raises(tdf.InputError, match="no pixel in the mask's 1600 pixels has a measured depth"):
        points_from_depth(depth, K, mask=mask)
