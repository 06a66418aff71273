"""Baselines of simulated episodes: where their paths begin and end, and how they go between, by scipy."""

import types

import jax
import numpy as np
import pytest
from conftest import carried, random_poses
from scipy.spatial.transform import Rotation, Slerp

import tdf_jax as tdf
from tdf_jax._internal.errors import InputError
from tdf_jax.sim import replay

MOVED, TARGET_MOVED = (
    np.array([*Rotation.from_rotvec(turn).as_quat(scalar_first=True), *shift])
    for turn, shift in (((0.1, -0.2, 0.4), (0.1, 0.05, -0.02)), ((-0.2, 0.1, 0.3), (-0.1, 0.2, 0.05)))
)


def matrix(pose):
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = Rotation.from_quat(pose[:4], scalar_first=True).as_matrix(), pose[4:]
    return T


def rods(seed, count):
    """A cloud of three rods of different length along the axes, which ICP registers from most starts."""
    rng = np.random.default_rng(seed)
    along = np.eye(3)[rng.integers(3, size=count)] * (0.15, 0.1, 0.06)
    return along * rng.uniform(size=(count, 1)) + rng.normal(0, 0.002, (count, 3))


@pytest.fixture(scope="module")
def demonstration():
    """A demonstration whose recording begins before the grasp."""
    points, target_points = rods(0, 80), rods(1, 90)
    poses = random_poses(2, 6, 0.05)
    poses[:, 4:] += points.mean(axis=0)
    motion = matrix(poses[-1]) @ np.linalg.inv(matrix(poses[1]))
    middle = motion[:3, :3] @ points.mean(axis=0) + motion[:3, 3]
    target_points += middle - target_points.mean(axis=0)
    contact = np.array([1, 0, 0, 0, *middle])
    target = tdf.Target(points=target_points, query=np.zeros((4, 3)), T_world_contact=contact)
    trajectory = tdf.Trajectory(np.asarray(poses, np.float32))
    return tdf.Demonstration(points, trajectory, np.zeros((4, 3)), grasp=1, target=target)


def blended(path, first, last):
    """What the docstring of `carry_trajectory` says, by scipy: motions of both ends, blended over the index."""
    A, G = first @ np.linalg.inv(path[0]), last @ np.linalg.inv(path[-1])
    s = np.linspace(0, 1, len(path))
    R = Slerp([0, 1], Rotation.from_matrix(np.stack([A[:3, :3], G[:3, :3]])))(s).as_matrix()
    made = np.tile(np.eye(4), (len(path), 1, 1))
    made[:, :3, :3] = R @ path[:, :3, :3]
    from_start, from_end = ((T[:3, :3] @ path[:, :3, 3:])[..., 0] + T[:3, 3] for T in (A, G))
    made[:, :3, 3] = (1 - s)[:, None] * from_start + s[:, None] * from_end
    return made


def check(found, demonstration, ours, theirs):
    """The ends move with the clouds, and the path between is blended evenly."""
    path = np.array([matrix(pose) for pose in np.asarray(demonstration.trajectory.wxyz_xyz, float)[1:]])
    motion = theirs @ path[-1] @ np.linalg.inv(path[0]) @ np.linalg.inv(ours)
    np.testing.assert_allclose(found.motion, motion, atol=2e-6)
    np.testing.assert_allclose(found.paths, [blended(path, ours @ path[0], motion @ ours @ path[0])], atol=2e-6)


@pytest.mark.parametrize("found", [False, True], ids=["target known", "target found"])
def test_registration_follows_both_clouds(demonstration, found):
    points = carried(MOVED, demonstration.points)
    target_points = carried(TARGET_MOVED, demonstration.target.points) if found else None
    made = replay.replay_by_registration(demonstration, points, target_points, key=jax.random.key(1))
    check(made, demonstration, matrix(MOVED), matrix(TARGET_MOVED) if found else np.eye(4))


@pytest.mark.parametrize("found", [False, True], ids=["target known", "target found"])
def test_centroids_follow_translations_alone(demonstration, found):
    ours, theirs = np.eye(4), np.eye(4)
    points = carried(MOVED, demonstration.points)
    ours[:3, 3] = points.mean(axis=0) - np.mean(demonstration.points, axis=0, dtype=float)
    target_points = None
    if found:
        target_points = carried(TARGET_MOVED, demonstration.target.points)
        theirs[:3, 3] = target_points.mean(axis=0) - np.mean(demonstration.target.points, axis=0, dtype=float)
    check(replay.replay_by_centroids(demonstration, points, target_points), demonstration, ours, theirs)


def test_a_found_target_needs_a_demonstrated_one(demonstration):
    alone = tdf.Demonstration(demonstration.points, demonstration.trajectory, demonstration.query)
    with pytest.raises(InputError, match="the demonstration has no target"):
        replay.replay_by_centroids(alone, alone.points, alone.points)


@pytest.fixture(scope="module")
def result():
    """Four candidates with an approach and a retreat, of which the third became non-finite, the last the best."""
    trajectories = np.stack([random_poses(seed, 7) for seed in range(4)])
    trajectories[2, 3] = np.nan
    return types.SimpleNamespace(
        trajectories=trajectories,
        energies=np.array([3.0, 2.0, np.nan, 1.0]),
        finite=np.array([True, True, False, True]),
        object_motion=MOVED,
        status="1 of 4 candidates became non-finite: 2",
        grasp=1,
        release=-2,
    )


def test_candidates_come_in_the_order_of_their_energies(result):
    found = replay.replay_candidates(result)
    expected = [[matrix(pose) for pose in result.trajectories[row, 1:6]] for row in (3, 1, 0)]
    np.testing.assert_allclose(found.paths, expected, atol=1e-6)
    np.testing.assert_allclose(found.motion, matrix(MOVED), atol=1e-6)


def test_even_blending_has_the_ends_of_the_candidates(demonstration, result):
    found = replay.blend_evenly(demonstration, result)
    path = np.array([matrix(pose) for pose in np.asarray(demonstration.trajectory.wxyz_xyz, float)[1:]])
    ends = [(matrix(result.trajectories[row, 1]), matrix(result.trajectories[row, 5])) for row in (3, 1, 0)]
    np.testing.assert_allclose(found.paths, [blended(path, *two) for two in ends], atol=2e-6)
    np.testing.assert_allclose(found.motion, matrix(MOVED), atol=1e-6)


def test_no_finite_candidate_is_refused(demonstration, result):
    lost = types.SimpleNamespace(**{**vars(result), "finite": np.zeros(4, bool), "status": "4 of 4 candidates"})
    for go in (replay.replay_candidates, lambda one: replay.blend_evenly(demonstration, one)):
        with pytest.raises(InputError, match="no candidate is finite: 4 of 4 candidates"):
            go(lost)


def test_the_paper_minimises_its_energy_with_the_goal_that_it_is_given(demonstration, result, monkeypatch):
    given = {}

    def imitate(*arguments, **keywords):
        given.update(keywords, arguments=arguments)
        return result

    monkeypatch.setattr(replay, "imitate", imitate)
    monkeypatch.setattr(replay, "describe", lambda model, one: one)
    reference = replay.describe_without_target("network", demonstration)
    assert reference.target is None and reference.grasp == 1
    found = replay.replay_by_energy("network", reference, demonstration.points, MOVED, key="key")
    assert given["arguments"] == ("network", reference, demonstration.points) and given["key"] == "key"
    assert given["energy"] == tdf.EnergyWeights(0.02) and given["config"] == tdf.SolveConfig()
    np.testing.assert_allclose(given["goal"], MOVED, atol=1e-6)
    assert len(found.paths) == 3
