"""The pick on an object that moved: beside `carry`, what is lost, and what is refused."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import CARRY, carried, compilations, composed, random_cloud, random_poses, trajectory_energy
from scipy.spatial.transform import Rotation

import tdf_jax as tdf
from tdf_jax._internal.errors import InputError
from tdf_jax.solvers import tracking

KEY = jax.random.key(0)
CONFIG = tdf.TrackConfig(num_rotations=4, num_coarse_queries=3, refine_steps=3, polish_steps=8, tolerance=1e-4)
CLOUD = random_cloud(3)
TURNED = np.array([*Rotation.from_rotvec([0.3, -0.2, 0.35]).as_quat(scalar_first=True), 0.03, -0.02, 0.03])


@pytest.fixture(scope="module")
def first(field, reference):
    """At a minimum: the small network has flat ones, which `carry` does not reach in a few steps."""
    result = tdf.carry(field, reference, KEY, config=CARRY)
    for _ in range(4):
        result = tdf.track(field, reference, result, config=CONFIG)
    return dataclasses.replace(result, first_residual=result.residual)


@pytest.fixture(scope="module")
def moved(small_model):
    return tdf.encode(small_model, carried(TURNED, CLOUD).astype(np.float32))


@pytest.fixture(scope="module")
def tracked(moved, reference, first):
    return tdf.track(moved, reference, first, config=CONFIG)


def apart(pose, other):
    """Metres and radians, by scipy."""
    pose, other = np.array(pose, float), np.array(other, float)
    turns = [Rotation.from_quat(one[:4], scalar_first=True) for one in (pose, other)]
    return np.linalg.norm(pose[4:] - other[4:]), (turns[0] * turns[1].inv()).magnitude()


def test_the_pick_moves_with_the_object(tracked, first, moved, reference):
    """A cloud that moves rigidly: the pick moves as it does, and has the energy that it had."""
    distance, angle = apart(tracked.pick, composed(TURNED, np.asarray(first.pick)[None])[0])
    assert distance < 1e-3 and angle < np.radians(1)
    assert not tracked.lost and tracked.loss <= first.loss * 1.01
    assert tracked.residual == pytest.approx(first.residual, rel=0.02)
    alone = tracking.pick_of(reference)
    energy = trajectory_energy(tdf.Trajectory(tracked.pick[None]), moved, alone, tdf.EnergyWeights(0.0))
    np.testing.assert_allclose(tracked.loss, energy, rtol=1e-4)


def test_the_path_is_that_of_carry(tracked, moved, reference):
    goal = np.array(reference.trajectory.wxyz_xyz[-1])
    goal[4:] += moved.origin
    expected = tdf.carry_trajectory(reference.trajectory, tracked.pick, jnp.asarray(goal))
    np.testing.assert_allclose(tracked.trajectory.wxyz_xyz, expected.wxyz_xyz, atol=1e-5)


def test_a_goal_is_kept_and_without_one_the_demonstration_moves_rigidly(moved, reference, first):
    kept = tdf.track(moved, reference, first, goal=first.goal, config=CONFIG)
    np.testing.assert_allclose(kept.goal, first.goal, atol=1e-5)
    free = tdf.track(moved, reference, first, fix_last=False, config=CONFIG)
    np.testing.assert_allclose(free.pick, kept.pick, atol=1e-5)
    expected = tdf.carry_trajectory(reference.trajectory, free.pick, None)
    np.testing.assert_allclose(free.trajectory.wxyz_xyz, expected.wxyz_xyz, atol=1e-5)


def test_the_history_follows_what_is_refined(tracked):
    starts, steps = 2 + CONFIG.num_rotations, CONFIG.refine_steps + CONFIG.polish_steps
    assert tracked.history.shape == (starts, steps) and tracked.candidate_history.shape == (1, steps)
    assert tracked.initial_trajectories.shape[0] == starts
    assert np.isfinite(tracked.history[:, 0]).all()
    followed = np.isfinite(tracked.history[:, 1])
    assert followed.sum() == CONFIG.num_candidates and np.isfinite(tracked.history[:, -1]).sum() == 1
    best = int(np.argmax(np.isfinite(tracked.history[:, -1])))
    np.testing.assert_array_equal(tracked.candidate_history[0], tracked.history[best])
    for part in np.split(np.asarray(tracked.candidate_history[0]), [CONFIG.refine_steps]):
        assert (np.diff(part) <= 0).all()


def test_starts_are_the_last_pick_and_near_where_the_object_went(tracked, first):
    """By scipy; the rotation between the clouds is that of their latents."""
    picks = np.asarray(tracked.initial_trajectories[:, 0], float)
    np.testing.assert_allclose(picks[0], first.pick, atol=1e-5)
    at_object = composed(TURNED, np.asarray(first.pick)[None])[0]
    assert apart(picks[1], at_object)[1] < 1e-3
    angles = [apart(pose, picks[1])[1] for pose in picks[2:]]
    assert max(angles) == pytest.approx(CONFIG.rotation, rel=1e-3) and np.std(angles) > 0


def test_it_goes_on_from_its_own_result(tracked, first, small_model, reference):
    """The energy is compared with that of `carry`, so that it cannot rise little by little."""
    motion = random_poses(4, 1, reach=0.03)[0]
    cloud = carried(motion, carried(TURNED, CLOUD)).astype(np.float32)
    second = tdf.track(tdf.encode(small_model, cloud), reference, tracked, config=CONFIG)
    assert not second.lost and second.first_residual == first.residual
    distance, angle = apart(second.pick, composed(motion, np.asarray(tracked.pick)[None])[0])
    assert distance < 2e-3 and angle < np.radians(3)


def test_a_lost_pick_is_no_pick(moved, reference, first):
    """Of an object that is no longer there: the energy is far above the first one."""
    before = dataclasses.replace(first, first_residual=first.residual / 100)
    found = tdf.track(moved, reference, before, config=CONFIG)
    assert found.lost and found.status.startswith("the pick is lost: the energy is 1")
    for name in ("best", "trajectory", "pick", "goal", "loss", "object_motion"):
        with pytest.raises(InputError, match=r"Result.best: the pick is lost: .* Call carry\(\)"):
            getattr(found, name)
    assert "the pick is lost" in repr(found) and "xyz" not in repr(found)
    assert found.trajectories.shape == (1, reference.trajectory.num_poses, 7)
    with pytest.raises(InputError, match=r"the last result is lost.*carry\(\)"):
        tdf.track(moved, reference, found, config=CONFIG)


def test_a_field_without_finite_energies_is_lost(moved, reference, first):
    far = dataclasses.replace(moved, origin=jnp.full(3, jnp.inf))
    with jax.debug_nans(False):
        assert tdf.track(far, reference, first, goal=first.goal, config=CONFIG).lost


def parts(field, reference, result):
    found = tdf.track(field, reference, result, config=CONFIG)
    return found.trajectories, found.energies, found.lost, found.candidate_history, found.residual


def test_a_batch_is_traced_once(small_model, reference, first):
    traces = []

    @jax.jit
    @jax.vmap
    def batch(points, scale):
        traces.append(None)
        before = dataclasses.replace(first, first_residual=first.residual * scale)
        return parts(tdf.encode(small_model, points), reference, before)

    scales = jnp.array([1.0, 0.01])
    for seed in (0, 1):
        motions = random_poses(seed, 2, reach=0.03)
        clouds = np.stack([carried(motion, CLOUD) for motion in motions]).astype(np.float32)
        found = batch(clouds, scales)
        np.testing.assert_array_equal(found[2], [False, True])
        for index in range(2):
            before = dataclasses.replace(first, first_residual=first.residual * np.float32(scales[index]))
            expected = parts(tdf.encode(small_model, clouds[index]), reference, before)
            for one, other in zip(found, expected, strict=True):
                np.testing.assert_allclose(one[index], other, rtol=2e-3, atol=2e-4)
    assert traces == [None]


def test_numbers_of_the_settings_compile_nothing(moved, reference, first, tracked):
    with compilations() as names:
        other = dataclasses.replace(CONFIG, rotation=0.2, tolerance=1e-3, largest_energy=2.0)
        tdf.track(moved, reference, first, config=other)
    assert "_tracked" not in " ".join(names)


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({"num_candidates": 0}, r"^TrackConfig\(\): num_candidates is 0"),
        ({"num_candidates": 19}, "at most the number of starts, 18"),
        ({"rotation": 4.0}, r"^TrackConfig\(\): rotation is 4.0"),
        ({"tolerance": -1}, r"^TrackConfig\(\): tolerance"),
        ({"largest_energy": 0.9}, r"^TrackConfig\(\): largest_energy is 0.9"),
    ],
)
def test_settings_are_checked(settings, words):
    with pytest.raises(InputError, match=words):
        tdf.TrackConfig(**settings)


def test_what_cannot_be_tracked_is_refused(moved, reference, first):
    longer = dataclasses.replace(first, trajectories=jnp.concatenate([first.trajectories] * 2, axis=1))
    batch = jax.tree.map(lambda part: np.asarray(part)[None], first)
    solved = dataclasses.replace(first, latent=np.zeros((0, 3), np.float32))
    unknown = dataclasses.replace(first, first_residual=np.float32(np.nan))
    for result, words in (
        (longer, r"expected \(candidates, 4, 7\)"),
        (batch, "For a batch use jax.vmap"),
        (solved, "with the same model"),
        (unknown, "two query points"),
        (first.trajectory, "expected the Result of"),
    ):
        with pytest.raises(InputError, match=words):
            tdf.track(moved, reference, result, config=CONFIG)
    for settings, words in (
        ({"config": CARRY}, "expected a TrackConfig"),
        ({"goal": first.goal, "fix_last": False}, "does not keep it"),
        ({"goal": np.zeros(7)}, "a quaternion of norm 0"),
    ):
        with pytest.raises(InputError, match=words):
            tdf.track(moved, reference, first, **{"config": CONFIG} | settings)


def test_a_target_needs_a_goal(small_model, demonstration, moved, first):
    cloud = np.asarray(demonstration.points)
    motion = np.asarray(demonstration.trajectory.wxyz_xyz)[[0, -1], 4:]
    placed = cloud + motion[1] - motion[0]
    target = tdf.Target(placed + np.float32(0.05), np.asarray(demonstration.query) + placed.mean(axis=0))
    reference = tdf.describe(small_model, dataclasses.replace(demonstration, target=target))
    with pytest.raises(InputError, match="Pass goal=result.goal"):
        tdf.track(moved, reference, first, config=CONFIG)
    found = tdf.track(moved, reference, first, goal=first.goal, config=CONFIG)
    np.testing.assert_allclose(found.goal, first.goal, atol=1e-5)
