"""Query points: where they lie, how they are spread, and what is refused."""

import jax
import numpy as np
import pytest
from scipy.stats import kstest

from tdf_jax._internal.errors import InputError
from tdf_jax.geometry.query import box_query, gaussian_query, gripper_query, lattice_query, snapped_query

KEY = jax.random.key(0)
DRAWN = [box_query, gaussian_query, gripper_query]


def test_boxes_are_filled_evenly():
    points = np.array(box_query(KEY, 4000, (0.1, 0.2, 0.4), centre=(1, -2, 3)))
    places = (points - [1, -2, 3]) / [0.1, 0.2, 0.4] + 0.5
    for coordinate in places.T:
        assert kstest(coordinate, "uniform").pvalue > 0.01
    assert (np.abs(np.corrcoef(places.T) - np.eye(3)) < 0.05).all()


def test_one_size_is_a_cube():
    cube, box = box_query(KEY, 50, 0.3), box_query(KEY, 50, (0.3, 0.3, 0.3))
    np.testing.assert_array_equal(cube, box)
    assert 0.12 < np.abs(cube).max() <= 0.15
    assert box_query(KEY).shape == (500, 3)
    assert 0.038 < np.abs(box_query(KEY)).max() <= 0.04


def test_gaussians_have_their_spread_and_centre():
    points = np.array(gaussian_query(KEY, 4000, centre=(1, -2, 3)))
    for coordinate in (points - [1, -2, 3]).T:
        assert kstest(coordinate, "norm", args=(0, 0.025)).pvalue > 0.01
    wide = np.array(gaussian_query(KEY, 4000, sigma=0.5)).std(axis=0)
    np.testing.assert_allclose(wide, 0.5, rtol=0.05)


def test_the_gripper_is_two_fingers_and_a_palm_by_volume():
    x, y, z = np.array(gripper_query(KEY, 6000, opening=0.1, finger=(0.02, 0.01, 0.05), palm=0.04)).T
    palm, left, right = z < -0.05, (z >= -0.05) & (y < 0), (z >= -0.05) & (y >= 0)
    # Volumes: a finger 0.02 * 0.01 * 0.05, the palm 0.02 * 0.12 * 0.04 = 9.6 fingers.
    np.testing.assert_allclose([palm.mean(), left.mean(), right.mean()], np.array([9.6, 1, 1]) / 11.6, atol=0.02)
    spans = {"palm": (palm, (-0.06, 0.06), (-0.09, -0.05)), "left": (left, (-0.06, -0.05), (-0.05, 0))}
    spans["right"] = (right, (0.05, 0.06), (-0.05, 0))
    for part, *limits in spans.values():
        for values, (low, high) in zip((x, y, z), ((-0.01, 0.01), *limits), strict=True):
            assert kstest((values[part] - low) / (high - low), "uniform").pvalue > 0.001


def test_nothing_lies_between_the_fingers():
    points = np.array(gripper_query(KEY))
    assert points.shape == (500, 3)
    assert (np.abs(points[points[:, 2] > -0.045, 1]) >= 0.04 - 1e-6).all()


def test_lattices_by_hand():
    points = lattice_query((2, 1, 3), 0.1, centre=(0, 5, 0))
    expected = [[x, 5, z] for x in (-0.05, 0.05) for z in (-0.1, 0, 0.1)]
    np.testing.assert_allclose(points, expected, atol=1e-6)
    default = np.array(lattice_query())
    assert default.shape == (252, 3)
    np.testing.assert_allclose(default.mean(axis=0), 0, atol=1e-8)
    np.testing.assert_allclose(np.ptp(default, axis=0), [0.06, 0.06, 0.072], atol=1e-7)


@pytest.mark.parametrize("query", DRAWN)
def test_draws_follow_the_key(query):
    first = query(KEY, 20)
    assert first.shape == (20, 3)
    assert first.dtype == np.float32
    np.testing.assert_array_equal(first, query(KEY, 20))
    assert not np.allclose(first, query(jax.random.key(1), 20), atol=1e-3)
    with jax.enable_x64(True):
        assert query(KEY, 20).dtype == np.float64


@pytest.mark.parametrize("query", DRAWN)
def test_counts_below_one_are_refused(query):
    for count in (0, -1, 2.5):
        with pytest.raises(InputError, match=rf"{query.__name__}\(\): count is {count}; expected a whole number of at"):
            query(KEY, count)
    assert query(KEY, 1).shape == (1, 3)


def test_centres_are_three_finite_numbers():
    for query, arguments in ((box_query, [KEY]), (gaussian_query, [KEY]), (lattice_query, [])):
        for centre in ((0, 0), 0.0, (0, np.nan, 0)):
            with pytest.raises(InputError, match=rf"{query.__name__}\(\): centre is .*; expected three finite numbers"):
                query(*arguments, centre=centre)


@pytest.mark.parametrize("bad", [0, -0.1, np.nan, np.inf])
def test_lengths_are_above_zero(bad):
    for call, name in [
        (lambda: box_query(KEY, size=bad), "size"),
        (lambda: box_query(KEY, size=(0.1, bad, 0.1)), "size"),
        (lambda: gaussian_query(KEY, sigma=bad), "sigma"),
        (lambda: gripper_query(KEY, opening=bad), "opening"),
        (lambda: gripper_query(KEY, palm=bad), "palm"),
        (lambda: gripper_query(KEY, finger=(0.02, 0.01, bad)), "finger"),
        (lambda: lattice_query(pitch=bad), "pitch"),
    ]:
        with pytest.raises(
            InputError, match=rf"{name} is .*; expected (a positive number|three lengths above 0), metres"
        ):
            call()


def test_sizes_of_wrong_shape_are_refused():
    for call in (
        lambda: box_query(KEY, size=(0.1, 0.1)),
        lambda: gripper_query(KEY, finger=(0.1, 0.1)),
        lambda: gripper_query(KEY, finger=0.1),
        lambda: gaussian_query(KEY, sigma=(0.1, 0.1, 0.1)),
    ):
        with pytest.raises(InputError, match="expected (a positive number|three lengths above 0), metres"):
            call()
    for shape in ((6, 6), (6, 6, 0), (6, 6, 1.5), 6):
        with pytest.raises(InputError, match="shape is .*; expected three whole numbers of at least 1"):
            lattice_query(shape)


def test_snapped_points_lie_on_the_lattice_next_to_where_they_were():
    query = gaussian_query(KEY, 50)
    snapped = np.asarray(snapped_query(query, 0.01, centre=(0.001, 0.002, 0.003)))
    nodes = (snapped - [0.001, 0.002, 0.003]) / 0.01
    np.testing.assert_allclose(nodes, np.round(nodes), atol=1e-4)
    assert np.abs(snapped - np.asarray(query)).max() <= 0.005 + 1e-7
    regular = lattice_query((3, 3, 3), 0.01)
    np.testing.assert_allclose(snapped_query(regular, 0.01), regular, atol=1e-8)


def test_snapping_to_no_lattice_is_refused():
    with pytest.raises(InputError, match="pitch is 0.0"):
        snapped_query(np.zeros((2, 3)), 0.0)
    with pytest.raises(InputError, match=r"shape \(3,\)"):
        snapped_query(np.zeros(3), 0.01)


def test_traced_arguments_are_taken():
    def points(size, centre):
        return snapped_query(box_query(KEY, 5, size, centre), 0.01) + gaussian_query(KEY, 5, size, centre)

    np.testing.assert_allclose(jax.jit(points)(0.1, np.ones(3)), points(0.1, np.ones(3)), atol=1e-6)
