"""Descriptors of poses and trajectories are the field's, at the carried query points."""

import jax.numpy as jnp
import numpy as np
import pytest
from conftest import SMALL, carried, random_poses

import tdf_jax as tdf
from tdf_jax._internal.errors import InputError

QUERY = np.random.default_rng(0).normal(size=(8, 3)).astype(np.float32) * 0.05


def test_a_pose_descriptor_is_that_of_the_carried_points(field, values):
    pose = random_poses(0, 1)[0]
    found = tdf.pose_descriptor(field, jnp.asarray(pose, jnp.float32), QUERY)
    assert found.shape == (8, SMALL.channels)
    np.testing.assert_allclose(found, values(field, carried(pose, QUERY).astype(np.float32))[0], atol=1e-5)


def test_a_trajectory_descriptor_stacks_those_of_its_poses(field, values):
    poses = random_poses(1, 4)
    found = tdf.trajectory_descriptor(field, tdf.Trajectory(jnp.asarray(poses, jnp.float32)), QUERY)
    assert found.shape == (4, 8, SMALL.channels)
    expected = [values(field, carried(pose, QUERY).astype(np.float32))[0] for pose in poses]
    np.testing.assert_allclose(found, expected, atol=1e-5)


@pytest.mark.parametrize("array", [np.asarray, jnp.asarray])
@pytest.mark.parametrize(
    "query",
    [QUERY[:, :2], QUERY[0], QUERY[:0], QUERY[None], QUERY * np.inf],
    ids=["plane", "one", "none", "batch", "infinite"],
)
def test_bad_query_points_are_refused(field, query, array):
    """jax clamps an index beyond the end: (queries, 2) would be taken for (queries, 3) with z = y."""
    with np.errstate(invalid="ignore"):
        with pytest.raises(InputError, match=r"pose_descriptor\(\): .*query points"):
            tdf.pose_descriptor(field, jnp.asarray(random_poses(0, 1)[0], jnp.float32), array(query))
