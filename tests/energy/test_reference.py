"""Demonstrations and the reference made of them."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest
from conftest import SMALL, random_cloud, random_poses

import tdf_jax as tdf
from tdf_jax._internal.errors import InputError
from tdf_jax.geometry.sampling import thin


@pytest.fixture(scope="module")
def other(demonstration):
    """A second demonstration, on another object."""
    return dataclasses.replace(
        demonstration,
        points=jnp.asarray(random_cloud(7), jnp.float32),
        trajectory=tdf.Trajectory(jnp.asarray(random_poses(8, 4), jnp.float32)),
    )


def test_a_reference_is_the_demonstration_described(small_model, demonstration, reference):
    field = tdf.encode(small_model, demonstration.points)
    expected = tdf.trajectory_descriptor(field, demonstration.trajectory, demonstration.query)
    assert reference.descriptors.shape == (4, 8, SMALL.channels)
    np.testing.assert_allclose(reference.descriptors, expected, atol=1e-6)
    np.testing.assert_array_equal(reference.query, demonstration.query)


def test_the_references_trajectory_is_relative_to_the_centroid_with_world_axes(demonstration, reference):
    expected = np.array(demonstration.trajectory.wxyz_xyz)
    expected[:, 4:] -= random_cloud(0).mean(axis=0)
    np.testing.assert_allclose(reference.trajectory.wxyz_xyz, expected, atol=1e-6)


def test_several_demonstrations_give_the_mean_of_their_descriptors(small_model, demonstration, other, reference):
    both = tdf.describe(small_model, [demonstration, other])
    second = tdf.describe(small_model, other)
    np.testing.assert_allclose(both.descriptors, (reference.descriptors + second.descriptors) / 2, atol=1e-6)
    assert np.linalg.norm(both.descriptors, axis=-1).min() < 0.99  # not made of unit length again
    np.testing.assert_array_equal(both.trajectory.wxyz_xyz, reference.trajectory.wxyz_xyz)
    # The same twice is the same as once, from any iterable.
    twice = tdf.describe(small_model, (demonstration for _ in range(2)))
    np.testing.assert_allclose(twice.descriptors, reference.descriptors, atol=1e-7)


def test_several_demonstrations_give_the_median_if_asked(small_model, demonstration, other, reference):
    third = dataclasses.replace(other, points=jnp.asarray(random_cloud(9), jnp.float32))
    found = tdf.describe(small_model, [demonstration, other, third], combine="median")
    alone = [reference, tdf.describe(small_model, other), tdf.describe(small_model, third)]
    expected = np.median([one.descriptors for one in alone], axis=0)
    np.testing.assert_allclose(found.descriptors, expected, atol=1e-6)
    # The least sum of the absolute differences that eq. 2 counts: the mean's is more.
    mean = tdf.describe(small_model, [demonstration, other, third])
    sums = [sum(np.abs(one.descriptors - centre.descriptors).sum() for one in alone) for centre in (found, mean)]
    assert sums[0] < 0.999 * sums[1]
    np.testing.assert_array_equal(
        tdf.describe(small_model, demonstration, combine="median").descriptors, reference.descriptors
    )


def test_an_unknown_combination_is_refused(small_model, demonstration):
    with pytest.raises(InputError, match="combine is 'best'; expected one of mean, median"):
        tdf.describe(small_model, demonstration, combine="best")


def test_clouds_are_subsampled_to_the_networks_density(small_model, demonstration, reference):
    dense = np.concatenate([random_cloud(0), random_cloud(0) + 1e-3]).astype(np.float32)
    assert thin(dense, 40).shape == (40, 3)
    model = dataclasses.replace(small_model, info=tdf.ModelInfo("small", "random numbers", cloud_points=40))
    found = tdf.describe(model, dataclasses.replace(demonstration, points=dense))
    expected = tdf.describe(small_model, dataclasses.replace(demonstration, points=thin(dense, 40)))
    np.testing.assert_allclose(found.descriptors, expected.descriptors, atol=1e-6)
    sparse = tdf.describe(model, demonstration)  # no more points than that: all are used
    np.testing.assert_allclose(sparse.descriptors, reference.descriptors, atol=1e-6)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"points": np.zeros((5, 3))}, r"Demonstration\(\): points has 5 points"),
        ({"points": np.full((40, 3), np.nan)}, "NaN or infinite"),
        ({"trajectory": np.zeros((4, 7))}, "trajectory is a ndarray; expected a Trajectory"),
        ({"trajectory": tdf.Trajectory(jnp.zeros((4, 7)))}, "quaternion"),
        ({"trajectory": tdf.Trajectory(jnp.ones((0, 7)))}, "no pose"),
        ({"query": np.zeros((8, 2))}, r"Demonstration\(\): query points have shape \(8, 2\)"),
        ({"query": np.zeros((0, 3))}, r"expected \(queries, 3\)"),
        ({"query": np.full((8, 3), np.inf)}, "finite metres"),
    ],
)
def test_bad_demonstrations_are_refused(demonstration, change, message):
    with pytest.raises(InputError, match=message):
        dataclasses.replace(demonstration, **change)


def test_demonstrations_that_do_not_fit_together_are_refused(small_model, demonstration):
    longer = dataclasses.replace(demonstration, trajectory=tdf.wave(num_poses=5))
    elsewhere = dataclasses.replace(demonstration, query=demonstration.query + 0.01)
    for second in (longer, elsewhere):
        with pytest.raises(InputError, match="differ in their query points or number of poses"):
            tdf.describe(small_model, [demonstration, second])


def test_what_is_no_demonstration_is_refused(small_model, demonstration):
    for things, kinds in [([], "nothing"), (random_cloud(0), "ndarray"), ([demonstration, 1], "Demonstration, int")]:
        with pytest.raises(InputError, match=rf"describe\(\): got {kinds}; expected one or more of tdf.Demonstration"):
            tdf.describe(small_model, things)
