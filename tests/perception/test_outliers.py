"""Outliers: those that were added go, the surface stays, whatever the order and however far one point is."""

import numpy as np
import pytest
from scipy.spatial.distance import cdist

import tdf_jax as tdf
from tdf_jax.perception.outliers import outliers_of, remove_outliers


@pytest.fixture(scope="module")
def surface():
    return tdf.sample_surface(tdf.build_mug().mesh, 1500, 0)


@pytest.fixture(scope="module")
def outliers(surface):
    """A fifth of the points, in a box around, nowhere near the surface."""
    drawn = np.random.default_rng(1).uniform(-0.25, 0.25, size=(600, 3))
    return drawn[cdist(drawn, surface).min(axis=1) > 0.03][:375]


def rows(points):
    return {tuple(point) for point in points}


def test_outliers_go_and_the_surface_stays(surface, outliers):
    kept = remove_outliers(np.concatenate([surface, outliers]))
    assert len(outliers) == 375
    assert rows(surface) <= rows(kept)
    assert len(rows(kept) & rows(outliers)) <= 4


def test_a_clean_cloud_loses_no_point_and_keeps_its_type(surface):
    kept = remove_outliers(surface.astype(np.float32))
    np.testing.assert_array_equal(kept, surface.astype(np.float32))
    assert kept.dtype == np.float32


def test_one_point_at_3_metres_goes_and_changes_nothing_else(surface, outliers):
    cloud = np.concatenate([surface, outliers])
    found = outliers_of(np.vstack([cloud, [3.0, 0, 0]]))
    assert found[-1]
    np.testing.assert_array_equal(found[:-1], outliers_of(cloud))


def test_the_order_does_not_matter(surface, outliers):
    cloud = np.concatenate([surface, outliers])
    mixed = np.random.default_rng(2).permutation(len(cloud))
    np.testing.assert_array_equal(outliers_of(cloud[mixed]), outliers_of(cloud)[mixed])


def test_the_measure_is_the_mean_distance_of_the_neighbours():
    """Points of a line 1 apart, and one that is 3.4 times as far from its two neighbours as the median, 1."""
    line = np.column_stack([np.arange(30.0), np.zeros(30), np.zeros(30)])
    found = outliers_of(np.vstack([line, [-3.2, 0, 0], [31.5, 0, 0]]), neighbours=2)
    assert np.flatnonzero(found).tolist() == [30]


@pytest.mark.parametrize(
    ("keywords", "words"),
    [
        ({"points": np.zeros((5, 3))}, "5 points"),
        ({"neighbours": 1500}, "neighbours is 1500; expected a whole number from 1 to 1499"),
        ({"deviations": 0}, "deviations is 0"),
    ],
)
def test_bad_input_is_refused(surface, keywords, words):
    with pytest.raises(tdf.InputError, match=rf"remove_outliers\(\): .*{words}"):
        remove_outliers(**({"points": surface} | keywords))
