import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tdf_jax.geometry.registration import refine_region, region_distance, register_region


def _peg(rng, count=400):
    """Points on a peg along x that ends at x = 0.03, and on a wall far from it."""
    angle, along = rng.uniform(0, 2 * np.pi, count), rng.uniform(-0.06, 0.03, count)
    peg = np.stack([along, 0.005 * np.cos(angle), 0.005 * np.sin(angle)], axis=1)
    tip = np.concatenate([np.full((40, 1), 0.03), rng.uniform(-0.003, 0.003, (40, 2))], axis=1)
    return np.concatenate([peg, tip, rng.uniform(-0.1, 0.1, (300, 3)) + [0, 0, 0.5]])


@pytest.mark.parametrize("seed", range(3))
def test_a_peg_is_found_beside_the_pose_to_start_from(seed):
    rng = np.random.default_rng(seed)
    demonstrated, other = _peg(rng), _peg(rng)
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = Rotation.random(rng=rng).as_matrix(), rng.normal(size=3)
    points = other @ T[:3, :3].T + T[:3, 3]
    wrong = np.eye(4)
    wrong[:3, :3], wrong[:3, 3] = Rotation.from_rotvec([0.0, 0.25, 0.0]).as_matrix(), [0.008, 0.0, 0.012]

    error = np.linalg.inv(T) @ register_region(demonstrated, points, T @ wrong, 0.04)

    assert np.abs(error[:3, 3]).max() < 0.003
    assert np.degrees(np.arccos(error[0, 0])) < 4  # the given orientation has a weight


def test_too_few_points_leave_the_pose():
    rng = np.random.default_rng(0)
    start = np.eye(4)
    start[:3, 3] = [0.0, 0.0, 0.3]
    assert np.array_equal(register_region(_peg(rng), _peg(rng), start, 0.04), start)


def test_the_distance_is_of_the_region_in_both_directions():
    rng = np.random.default_rng(2)
    cloud = _peg(rng)
    assert region_distance(cloud, cloud, np.eye(4), 0.04) == 0
    beside = np.eye(4)
    beside[2, 3] = 0.1  # where the cloud has no points
    assert region_distance(cloud, cloud, beside, 0.04) == np.inf
    assert 0.001 < region_distance(cloud, cloud + [0.0, 0.02, 0.0], np.eye(4), 0.04) < 0.02


def _poses(*translations):
    poses = np.tile(np.eye(4), (len(translations), 1, 1))
    poses[:, :3, 3] = translations
    return poses


def _cup(rng, radius, count=1500):
    """Points on the wall and the floor of a cup whose opening is at z = 0."""
    angle, depth = rng.uniform(0, 2 * np.pi, count), rng.uniform(-0.08, 0.0, count)
    wall = np.stack([radius * np.cos(angle), radius * np.sin(angle), depth], axis=1)
    return np.concatenate([wall, wall[:300] * [0.7, 0.7, 0] + [0, 0, -0.08]])


def test_a_pose_beside_the_region_gives_way_to_one_that_fits():
    rng = np.random.default_rng(3)
    demonstrated, points = _peg(rng), _peg(rng)
    given = _poses([0.0, 0.0, 0.045], [-0.02, 0.0, 0.3])  # no point near the second at all
    assert region_distance(demonstrated, points, register_region(demonstrated, points, given[0], 0.03), 0.03) > 0.02
    found = [refine_region(demonstrated, points, pose, 0.03) for pose in given]
    assert np.linalg.norm(found[0][0, :3, 3]) < 0.003
    np.testing.assert_array_equal(found[1], given[1:])


def test_a_pose_that_fits_stays_where_it_is():
    rng = np.random.default_rng(4)
    demonstrated, points = _peg(rng), _peg(rng)
    found = refine_region(demonstrated, points, _poses([0.006, 0.0, 0.004])[0], 0.03)
    assert np.linalg.norm(found[0, :3, 3]) < 0.002


def test_the_given_orientation_decides_where_the_region_is_free():
    """A peg is the same after a turn about its axis: it keeps the given one, and its axis is still corrected."""
    rng = np.random.default_rng(6)
    demonstrated, points = _peg(rng), _peg(rng)
    for degrees in (0, 40, 160):
        given = _poses([0.004, 0.002, 0.012])
        given[0, :3, :3] = Rotation.from_euler("xy", [degrees, 15], degrees=True).as_matrix()
        found = refine_region(demonstrated, points, given[0], 0.03)[0]
        turned = Rotation.from_matrix(given[0, :3, :3].T @ found[:3, :3]).as_rotvec(degrees=True)
        assert abs(turned @ given[0, :3, :3].T[:, 0]) < 6
        assert np.degrees(np.arccos(found[0, 0])) < 5
        assert np.linalg.norm(found[:3, 3]) < 0.004


def test_no_pose_is_turned_far():
    """Points of another side of the region may fit as well; descriptors know the orientation better."""
    rng = np.random.default_rng(7)
    demonstrated, points = _peg(rng), _peg(rng)
    given = _poses([0.0, 0.0, 0.0])
    given[0, :3, :3] = Rotation.from_euler("y", 120, degrees=True).as_matrix()
    np.testing.assert_array_equal(refine_region(demonstrated, points, given[0], 0.03), given)


def test_a_region_of_another_size_stays_where_it_is():
    rng = np.random.default_rng(5)
    demonstrated, points = _cup(rng, 0.045), _cup(rng, 0.03)
    for given in _poses([0.0, 0.0, 0.0], [0.01, 0.0, 0.0]):
        np.testing.assert_array_equal(refine_region(demonstrated, points, given, 0.03), given[None])


def test_places_along_a_peg_are_all_returned():
    """From the middle of a long peg neither end is in the region, so that it fits in many places."""
    rng = np.random.default_rng(8)

    def rod():
        angle, along = rng.uniform(0, 2 * np.pi, 900), rng.uniform(-0.1, 0.1, 900)
        return np.stack([along, 0.005 * np.cos(angle), 0.005 * np.sin(angle)], axis=1)

    found = refine_region(rod(), rod(), _poses([0.0, 0.0, 0.015])[0], 0.03)
    assert len(found) > 2
    assert np.abs(found[:, 1:3, 3]).max() < 0.003
    assert np.ptp(found[:, 0, 3]) > 0.02
    assert abs(found[0, 0, 3]) < 0.01  # the nearest is the first


# What a refined pose must reach to be taken. All lengths are in half edges of the region.


def _jack():
    """Three unequal arms, which fit in one pose alone."""
    arms = np.eye(3)[:, None] * np.arange(0.0, 1.5, 0.02)[:, None]
    return np.concatenate([arms[0] - [0.7, 0, 0], arms[1, :38] + [0.2, 0, 0], arms[2, :25] - [0.4, 0, 0]])


def _rough(cloud, height, seed=0):
    """Two points for each of a cloud, on both sides of it: the higher, the worse they fit."""
    sides = np.random.default_rng(seed).normal(size=cloud.shape)
    sides *= height / np.linalg.norm(sides, axis=1, keepdims=True)
    return np.concatenate([cloud + sides, cloud - sides])


def _taken(demonstrated, points):
    """Translation and number of the refined poses; None if the given one stays."""
    found = refine_region(demonstrated, points, np.eye(4), 1.0)
    return None if np.array_equal(found, np.eye(4)[None]) else (found[0, :3, 3], len(found))


JACK = _jack()
DIAGONAL = np.array([1.0, 2.0, 2.0]) / 3
UP = np.array([0.0, 1.0, 1.0]) / np.sqrt(2)
CLUTTER = np.random.default_rng(1).uniform(-0.06, 0.06, (12, 3))
CORNER = CLUTTER + [0.9, -0.9, -0.9]


@pytest.mark.parametrize(
    ("shift", "height", "others", "is_taken"),
    [
        (0.60 * DIAGONAL, 0.40, None, True),  # 0.56 of the distance before, 0.20
        (0.40 * DIAGONAL, 0.30, None, False),  # 0.65, 0.16
        (0.80 * DIAGONAL, 0.50, None, False),  # 0.52, but 0.23
        (1.10 * DIAGONAL, 0.50, None, True),  # 0.37, 0.23
        (1.58 * UP, 0.75, CORNER, False),  # 0.37, but 0.32
        (0.25 * DIAGONAL, 0.20, None, True),  # 0.67, 0.11: a short way needs less
        (0.15 * DIAGONAL, 0.15, None, False),  # 0.80, 0.08
    ],
)
def test_a_pose_is_taken_that_fits_far_better_and_well(shift, height, others, is_taken):
    points = np.concatenate([_rough(JACK, height) + shift, np.empty((0, 3)) if others is None else others])
    found = _taken(JACK, points)
    assert (found is not None) == is_taken
    if found is not None:
        assert np.linalg.norm(found[0] - shift) < 0.2


@pytest.mark.parametrize(("way", "is_taken"), [(0.5, True), (0.9, False)])
def test_what_fits_a_little_better_is_taken_nearby_alone(way, is_taken):
    """Along a rod with a flag, which alone says where the region is."""
    rod, flag = np.arange(-4.0, 4.0, 0.02)[:, None] * [1, 0, 0], np.arange(0.1, 0.6, 0.02)[:, None] * [0, 0, 1]
    points = np.concatenate([_rough(rod, 0.14), _rough(flag, 0.14, 1) + [way, 0, 0]])
    found = _taken(np.concatenate([rod, flag]), points)
    assert (found is not None) == is_taken
    if found is not None:
        assert np.abs(found[0] - [way, 0, 0]).max() < 0.05


@pytest.mark.parametrize(
    ("way", "others", "is_taken"),
    [
        (1.2, CLUTTER - [0.9, 0, 0], True),
        (2.0, CLUTTER - [0.9, 0, 0], False),
        (2.0, np.empty((0, 3)), True),  # with nothing around, any place may be the right one
    ],
)
def test_a_place_far_away_is_taken_where_nothing_is_around_the_given_one(way, others, is_taken):
    found = _taken(JACK, np.concatenate([JACK + [0, way, 0], others]))
    assert (found is not None) == is_taken
    if found is not None:
        np.testing.assert_allclose(found[0], [0, way, 0], atol=0.02)


@pytest.mark.parametrize(("beside", "is_taken"), [(1.2, False), (2.0, True)])
def test_what_is_close_around_the_region_counts_as_around(beside, is_taken):
    lines = np.linspace(-1, 1, 12)[:, None] * [[[0, 1, 1]], [[0, 1, -1]]]
    lines = np.concatenate([lines[0] - [beside, 0, 0], lines[1] + [beside, 0, 0]])
    found = _taken(JACK, np.concatenate([JACK + [0, 2.2, 0], lines]))
    assert (found is not None) == is_taken


@pytest.mark.parametrize(("degrees", "is_taken"), [(30, True), (50, False)])
def test_a_pose_is_turned_by_less_than_35_degrees(degrees, is_taken):
    """A part of the turn stays, because the given orientation has a weight."""
    turned = JACK @ Rotation.from_euler("z", degrees, degrees=True).as_matrix().T
    found = refine_region(JACK, turned, np.eye(4), 1.0)
    angle = np.degrees(np.arccos(np.clip((np.trace(found[0, :3, :3]) - 1) / 2, -1, 1)))
    assert (20 < angle < 30) if is_taken else angle == 0


@pytest.mark.parametrize(("height", "expected"), [(0.106, [-0.15, -0.1, -0.35]), (0.16, [0, 0, 1.3])])
def test_the_nearest_of_places_that_fit_as_well_is_taken(height, expected):
    """Two copies: the nearer one fits 1.05 or 1.5 times worse."""
    points = np.concatenate([_rough(JACK, height) - [0.15, 0.1, 0.35], _rough(JACK, 0.1, 1) + [0, 0, 1.3]])
    found = _taken(JACK, points)
    assert found is not None and np.abs(found[0] - expected).max() < 0.05


def test_places_along_a_rod_are_returned_and_none_beside_it():
    """On the rod others fit as well; beside it, 0.15 half edges away, three times worse."""
    rod = np.arange(-4.0, 4.0, 0.02)[:, None] * [1, 0, 0]
    found = refine_region(rod, _rough(rod, 0.06) + [0, 0, 0.4], np.eye(4), 1.0)
    assert len(found) == 9
    assert np.abs(found[:, 1:3, 3] - [0, 0.4]).max() < 0.01
