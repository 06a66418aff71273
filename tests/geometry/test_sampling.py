"""Rows that are no measurements are counted, refused, or removed; ordinary duplicates stay."""

import jax
import numpy as np
import pytest
from conftest import random_cloud

import tdf_jax as tdf
from tdf_jax._internal import checks
from tdf_jax._internal.errors import InputError
from tdf_jax.geometry import sampling

CLOUD = random_cloud(0, 600)


def with_rows(value, count):
    return np.insert(CLOUD, np.linspace(0, len(CLOUD), count).astype(int), value, axis=0)


CAMERAS = np.array([[0.3, 0.2, 0.3], [0.3, 0.1, 0.3], [0.3, -0.1, 0.3], [0.3, -0.2, 0.3], [0, 0, 0], [1, 1, 1]])


@pytest.mark.parametrize("share", [0.016, 0.1, 0.5])
def test_the_sentinels_of_several_cameras_are_refused_and_removed(share):
    """Each camera writes its own origin, which is another point of the world."""
    cloud = np.concatenate([CLOUD, np.repeat(CAMERAS, int(np.ceil(share * len(CLOUD))), axis=0)])
    with pytest.raises(InputError) as refusal:
        checks.points("f()", cloud)
    assert all(str(camera.tolist()) in str(refusal.value) for camera in CAMERAS)
    with pytest.warns(tdf.InvalidPointsWarning, match=f"removed {len(cloud) - len(CLOUD)} of {len(cloud)} points"):
        np.testing.assert_array_equal(tdf.drop_invalid(cloud), CLOUD)


def test_the_origin_far_from_the_cloud_is_a_sentinel_whatever_else_is_repeated():
    cloud = np.concatenate([np.repeat(CLOUD[:40], 4, axis=0), CLOUD[40:], np.zeros((2, 3))])
    with pytest.raises(InputError, match=r"2 are \[0.0, 0.0, 0.0\]"):
        checks.points("f()", cloud)


@pytest.mark.parametrize(
    ("value", "count"), [((0, 0, 0), 2), ((0, 0, -0.0), 300), ((0, 0, 10), 13), ((-1, -1, -1), 200), ((9, 9, 9), 600)]
)
def test_sentinels_are_refused_with_their_count_and_removed(value, count):
    cloud = with_rows(value, count)
    with pytest.raises(InputError, match=rf"of the {len(cloud)} points of points, {count} are .*drop_invalid"):
        checks.points("f()", cloud)
    with pytest.warns(tdf.InvalidPointsWarning, match=f"removed {count} of {len(cloud)} points: {count} are"):
        kept = tdf.drop_invalid(cloud)
    np.testing.assert_array_equal(kept, CLOUD)


def test_several_sentinels_and_nan_rows_of_an_organised_cloud_are_removed():
    cloud = np.concatenate([with_rows((0, 0, 0), 50), np.full((30, 3), 7.0), np.full((20, 3), np.nan)]).reshape(
        -1, 20, 3
    )
    with pytest.warns(tdf.InvalidPointsWarning, match=r"removed 100 of 700 points: 20 are NaN or infinite, 50 .*, 30"):
        kept = tdf.drop_invalid(cloud)
    np.testing.assert_array_equal(kept, CLOUD)


CORNERS = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)], float)
ORDINARY = {
    "one point at the origin": with_rows((0, 0, 0), 1),
    "a few duplicates": with_rows(CLOUD[0], 4),
    "two merged copies": np.tile(CLOUD, (2, 1)),
    "quantised": np.round(CLOUD, 2),
    "coarsely quantised": 0.02 * np.round(CLOUD / 0.02),
    "corners of triangles, one at the origin": np.repeat(CORNERS, [4, 5, 5, 4, 5, 4, 4, 5], axis=0),
}


@pytest.mark.parametrize("kind", ORDINARY)
def test_ordinary_duplicates_stay(kind):
    cloud = ORDINARY[kind]
    np.testing.assert_array_equal(checks.points("f()", cloud), cloud)
    np.testing.assert_array_equal(tdf.drop_invalid(cloud), cloud)


@pytest.mark.parametrize("points", [np.zeros((5, 2)), np.zeros(3), np.full((5, 3), np.nan), [["a"] * 3] * 5])
def test_what_is_no_cloud_is_refused(points):
    with pytest.raises(InputError, match=r"^drop_invalid\(\): "):
        tdf.drop_invalid(points)


def test_clouds_of_other_shapes_are_refused_with_the_fix():
    for shape, fix in (((3, 50), "points.T"), ((5, 10, 3), r"reshape\(-1, 3\)"), ((50, 6), r"points\[:, :3\]")):
        with pytest.raises(InputError, match=fix):
            checks.points("f()", np.ones(shape))


@pytest.mark.parametrize("seed", range(3))
def test_the_same_points_of_a_traced_cloud_are_chosen(seed):
    cloud = random_cloud(seed, 600).astype(np.float32)
    cloud[300:320] = cloud[:20]  # coincident points
    found = jax.jit(sampling.traced_farthest_point_indices, static_argnums=1)(cloud, 200)
    np.testing.assert_array_equal(found, sampling.farthest_point_indices(cloud, 200))


def test_subsamples_of_a_traced_cloud_are_those_of_a_known_one():
    cloud = random_cloud(0, 600).astype(np.float32)
    found = jax.jit(lambda points: sampling.subsamples(points, 40, 3))(cloud)
    np.testing.assert_array_equal(found, sampling.subsamples(cloud, 40, 3))
