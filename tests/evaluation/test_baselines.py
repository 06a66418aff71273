"""Baselines recover motions of one cloud, and are carried to the place."""

import jax
import numpy as np
import pytest
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from tdf_jax._internal.errors import InputError
from tdf_jax.evaluation.baselines import (
    aligned,
    chamfer_distance,
    every_registration,
    iterative_closest_points,
    principal_axes,
    rigid_motion,
)
from tdf_jax.evaluation.cases import mug_case
from tdf_jax.evaluation.pick_transfer import place_errors
from tdf_jax.geometry import se3


def motion(seed):
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = Rotation.random(random_state=seed).as_matrix(), np.random.default_rng(seed).normal(size=3)
    return T


def moved(T, points):
    return points @ T[:3, :3].T + T[:3, 3]


@pytest.fixture(scope="module")
def cloud():
    """A mug's: lopsided, so only one motion fits."""
    return mug_case(0, 0, points=400).points_a.astype(float)


@pytest.mark.parametrize("seed", range(4))
def test_principal_axes_find_any_motion(cloud, seed):
    """Every seed needs another choice of signs; a reflection would fit the axes too."""
    T = motion(seed)
    np.testing.assert_allclose(principal_axes(cloud, moved(T, cloud)[::-1]), T, atol=1e-9)


def test_icp_finds_the_motion_from_one_of_several_starts(cloud):
    T = motion(1)
    off = Rotation.from_rotvec([0.2, 0.1, -0.2]).as_matrix()
    starts = np.stack([Rotation.from_rotvec([2.5, 0, 0]).as_matrix() @ T[:3, :3], off @ T[:3, :3], np.eye(3)])
    np.testing.assert_allclose(iterative_closest_points(cloud, moved(T, cloud), starts), T, atol=1e-3)
    alone = iterative_closest_points(cloud, moved(T, cloud), starts[:1])
    assert np.abs(alone - T).max() > 0.1  # so the choice among starts matters


def test_icp_tells_where_every_start_settles(cloud):
    T = motion(1)
    starts = np.stack([Rotation.from_rotvec([2.5, 0, 0]).as_matrix() @ T[:3, :3], T[:3, :3]])
    motions, costs = every_registration(cloud, moved(T, cloud), starts)
    np.testing.assert_allclose(motions[1], T, atol=1e-6)
    assert costs[1] < 1e-12 < costs[0]
    nearest = cKDTree(moved(motions[0], cloud)).query(moved(T, cloud))[0]
    np.testing.assert_allclose(costs[0], np.mean(nearest**2), rtol=0.01)  # of the last step but one


def test_points_that_correspond_give_their_motion(cloud):
    T = motion(3)
    np.testing.assert_allclose(rigid_motion(cloud[:4], moved(T, cloud[:4])), T, atol=1e-9)
    mirrored = rigid_motion(cloud, cloud * [-1, 1, 1])
    assert np.linalg.det(mirrored[:3, :3]) == pytest.approx(1)


def test_icp_matches_a_part_with_the_whole(cloud):
    T = motion(2)
    part = moved(T, cloud)[cloud[:, 1] > -0.01]  # its centroid is not the whole's
    start = Rotation.from_rotvec([0.1, 0.1, 0.1]).as_matrix() @ T[:3, :3]
    np.testing.assert_allclose(iterative_closest_points(cloud, part, start[None]), T, atol=5e-3)


def test_chamfer_distance_by_hand():
    a, b = np.zeros((1, 3)), np.array([[3.0, 0, 0], [0, 5.0, 0]])
    assert chamfer_distance(a, b) == pytest.approx((3 + 4) / 2)


@pytest.mark.parametrize("method", ["PCA", "ICP"])
def test_the_place_is_carried_with_the_object(monkeypatch, method):
    """Given the true motion between equal objects, the place is found exactly."""
    case = mug_case(3, 0, points=50)
    T_b_a = case.T_world_place_b @ np.linalg.inv(case.T_world_place_a)
    monkeypatch.setattr("tdf_jax.evaluation.baselines.principal_axes", lambda a, b: T_b_a)
    seen = []
    monkeypatch.setattr(
        "tdf_jax.evaluation.baselines.iterative_closest_points", lambda a, b, rotations: seen.append(rotations) or T_b_a
    )
    found = aligned(method, [case, case], seed=3, num_starts=4, progress=False)
    distance, angle = place_errors(found, [case, case])
    assert distance.max() < 1e-6 and angle.max() < 0.1
    if method == "ICP":
        assert len(seen[0]) == 4 and np.abs(seen[0] - seen[1]).max() > 0.1
        turns = se3.rotation_distance(
            jax.numpy.asarray(seen[0], "float32"), jax.numpy.asarray(case.T_world_b[:3, :3], "float32")
        )
        assert turns.min() > 0.01  # no start is the answer


def test_an_unknown_method():
    with pytest.raises(InputError, match="method is 'RANSAC'; expected one of PCA, ICP"):
        aligned("RANSAC", [])
