"""The solver: its quadratic model, what passes from stage to stage, that it finds what `optimize` finds."""

import dataclasses
import functools
import operator
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import carried, compilations, composed, random_cloud, random_poses, trajectory_energy
from scipy.spatial.transform import Rotation

import tdf_jax as tdf
from tdf_jax._internal.errors import InputError
from tdf_jax.energy.losses import pose_energy, waypoint_loss
from tdf_jax.geometry import se3
from tdf_jax.solvers import gauss_newton, stages
from tdf_jax.solvers.initial import default_goal, random_starts
from tdf_jax.solvers.multistart import SolveConfig
from tdf_jax.solvers.stages import Candidates

solve = sys.modules["tdf_jax.solvers.multistart"]  # `tdf_jax.solve` is the function

CONFIG = SolveConfig(
    num_trajectory_starts=3,
    num_starts=8,
    num_coarse_queries=3,
    coarse_steps=2,
    prune_steps=1,
    search_steps=3,
    propagate_steps=2,
    refine_steps=2,
    polish_steps=3,
    tolerance=0.0,
)
STEPS = tuple(f"{stage}_steps" for stage in ("coarse", "prune", "search", "propagate", "refine", "polish"))
LONG = dict(zip(STEPS, (2, 1, 3, 2, 2, 30)))
WEIGHTS = tdf.EnergyWeights(correlation=0.3, rotation_scale=0.2)
KEY = jax.random.key(0)
SLOW = pytest.mark.slow


def run(field, reference, key=KEY, config=CONFIG, energy=WEIGHTS, **settings):
    return tdf.solve(field, reference, key, config=config, energy=energy, **settings)


@pytest.fixture(scope="module")
def result(field, reference):
    return run(field, reference)


def energy_of(trajectories, field, reference, weights=WEIGHTS):
    return np.array(
        [trajectory_energy(tdf.Trajectory(wxyz_xyz), field, reference, weights) for wxyz_xyz in trajectories]
    )


# ---- the quadratic model ----


evaluate = jax.jit(gauss_newton._evaluate, static_argnums=8)


def moved(R, place, step):
    return se3.exp(step[:3]) @ R, place + step[3:]


@pytest.mark.parametrize(
    "pose_norm",
    ["frobenius", pytest.param("metres_radians", marks=SLOW), pytest.param("mean_absolute", marks=SLOW)],
)
def test_energies_and_gradients_are_those_of_the_energy(field, reference, pose_norm):
    """All 8 query points, in blocks of 3: the last block is filled up with a point that must not count."""
    weights = tdf.EnergyWeights(0.3, 0.0, 0.2, pose_norm)
    problem = solve._problem(KEY, reference, size=3)
    assert problem.query.shape == (3, 3, 3) and problem.weights.sum() == 8
    starts = random_starts(KEY, field, reference, 5, "scattered", 0.1)
    drawn = stages.candidates_of(np, starts, problem)
    R, place = drawn.R.reshape(-1, 3, 3), drawn.centroid.reshape(-1, 3)
    waypoint = np.tile(np.arange(4), 5)
    some = np.arange(20) % 3 != 1  # 13 poses, not one after the other
    values = evaluate(R, place, waypoint, some, 3, field, problem, weights, 128)
    values = [part[some] for part in values]

    def energy(step, R, place, index):
        R, place = moved(R, place, step)
        t = place - R @ problem.centre
        one = jax.tree.map(lambda part: part[index][None], reference.trajectory)
        prior = pose_energy(R[None], t[None], field.origin, dataclasses.replace(reference, trajectory=one), weights)
        return waypoint_loss(R, t, field, reference.query, reference.descriptors[index]) + prior

    each = jax.jit(jax.vmap(jax.value_and_grad(energy), (None, 0, 0, 0)))
    expected, gradient = each(jnp.zeros(6), R, place, waypoint)
    np.testing.assert_allclose(values[0], expected[some], rtol=1e-5)
    np.testing.assert_allclose(values[1], gradient[some], atol=1e-4 * np.abs(gradient).max())


@pytest.mark.parametrize("pose_norm", ["metres_radians", "mean_absolute"])
def test_differences_of_poses_and_their_gradients_are_those_of_the_energy(reference, pose_norm):
    """The part of the test above that depends on the norm, for one pose."""
    weights = tdf.EnergyWeights(0.3, 0.0, 0.2, pose_norm)
    one = dataclasses.replace(reference, trajectory=jax.tree.map(lambda part: part[:1], reference.trajectory))
    R, t, origin = (
        se3.rotation(jnp.asarray(random_poses(1, 1), jnp.float32))[0],
        jnp.array([0.1, -0.2, 0.3]),
        jnp.array([0.0, 0.1, 0.0]),
    )
    centre = jnp.array([0.02, 0.01, -0.03])

    def energy(step):
        turned, place = moved(R, R @ centre + t, step)
        return pose_energy(turned[None], (place - turned @ centre)[None], origin, one, weights)

    loss, gradient, _ = jax.jit(gauss_newton._prior)(
        R, R @ centre + t, one.trajectory.wxyz_xyz[0], origin, centre, weights
    )
    expected, slope = jax.jit(jax.value_and_grad(energy))(jnp.zeros(6))
    np.testing.assert_allclose(loss, expected, rtol=1e-5)
    np.testing.assert_allclose(gradient, slope, atol=1e-5)


def test_the_curvature_is_that_of_reweighted_squares(field, reference):
    problem = solve._problem(KEY, reference, size=8)
    R, place = (
        jnp.asarray(part[0, :1])
        for part in stages.candidates_of(np, random_starts(KEY, field, reference, 1, "scattered", 0.1), problem)[:2]
    )
    shown = problem.descriptors[:1, 0]

    @jax.jit
    def residual(step):
        turned, centre = moved(R[0], place[0], step)
        return field.descriptors(problem.query[0] @ turned.T + centre) - shown[0]

    value, jacobian = (
        np.asarray(part, np.float64) for part in (residual(jnp.zeros(6)), jax.jit(jax.jacfwd(residual))(jnp.zeros(6)))
    )
    size = np.abs(value)
    weights = 1 / np.maximum(size, size.mean(axis=-1, keepdims=True)) / value.size
    expected = np.einsum("qca,qc,qcb->ab", jacobian, weights, jacobian)
    _, _, hessian = jax.jit(gauss_newton._match)(R, place, field, problem.query[0], problem.weights[0] / 8, shown)
    np.testing.assert_allclose(hessian[0], expected, atol=1e-4 * np.abs(expected).max())


def test_a_step_solves_the_damped_system_and_is_bounded():
    rng = np.random.default_rng(0)
    half = rng.normal(size=(4, 6, 6))
    hessian, gradient = half @ half.swapaxes(1, 2) + np.eye(6), 1e-3 * rng.normal(size=(4, 6))
    state = gauss_newton._State(
        jnp.zeros((4, 3, 3)), jnp.zeros((4, 3)), jnp.ones(4), jnp.float32(gradient), jnp.float32(hessian)
    )
    damping = jnp.array([0.1, 1.0, 0.0, 10.0])
    step, promise = gauss_newton._step(state, damping)
    damped = hessian + np.asarray(damping)[:, None, None] * hessian * np.eye(6)
    expected = -np.linalg.solve(damped, gradient[..., None])[..., 0]
    np.testing.assert_allclose(step, expected, rtol=1e-3, atol=1e-7)
    fall = -(gradient * expected).sum(axis=1) - np.einsum("ca,cab,cb->c", expected, hessian, expected) / 2
    np.testing.assert_allclose(promise, fall, rtol=1e-3)
    long, _ = gauss_newton._step(state._replace(gradient=1e4 * state.gradient), damping)
    assert np.linalg.norm(long[:, :3], axis=1).max() <= gauss_newton.LARGEST_ROTATION * (1 + 1e-6)
    assert np.linalg.norm(long[:, 3:], axis=1).max() <= gauss_newton.LARGEST_TRANSLATION * (1 + 1e-6)
    cosine = (long * expected).sum(axis=1) / np.linalg.norm(long, axis=1) / np.linalg.norm(expected, axis=1)
    np.testing.assert_allclose(cosine, 1, atol=1e-4)


def descended(field, reference, bounds, tolerance):
    """Energies of 8 poses at the start and after each of 6 steps."""
    problem = solve._problem(KEY, reference, size=8)
    drawn = stages.candidates_of(np, random_starts(KEY, field, reference, 2, "carried", 0.1), problem)
    # A program of its own, because tests change a constant of it.
    program = jax.jit(functools.partial(gauss_newton._steps, length=7, chunk=128, axes=()))
    _, _, values = program(
        drawn.R.reshape(-1, 3, 3),
        drawn.centroid.reshape(-1, 3),
        np.tile(np.arange(4), 2),
        np.array(bounds, np.int32),
        *(np.float32(0.3), np.float32(tolerance), field, problem, WEIGHTS),
    )
    return np.asarray(values)


def test_after_half_of_the_steps_only_the_best_poses_go_on(field, reference):
    every, some = (descended(field, reference, [8, 8, 1, 6, kept], 0.0) for kept in (8, 3))
    np.testing.assert_array_equal(some[:, :4], every[:, :4])
    best = np.argsort(np.argsort(every[:, 3])) < 3
    np.testing.assert_array_equal(some[best], every[best])
    np.testing.assert_array_equal(some[~best, 4:], np.repeat(every[~best, 3:4], 3, axis=1))
    assert (every[~best, 6] < every[~best, 3]).any()


@pytest.mark.slow
def test_a_pose_that_promises_hardly_anything_leaves(field, reference, monkeypatch):
    """Poses are independent, so one takes the steps that it takes alone, until it leaves."""
    every = descended(field, reference, [8, 8, 1, 6, 8], 0.0)
    monkeypatch.setattr(gauss_newton, "LEAVES", 1.0)
    some = descended(field, reference, [8, 8, 1, 6, 8], 0.02)
    # The first step that a pose does not take.
    steps = np.array([np.flatnonzero(one != other)[:1].sum() or 7 for one, other in zip(every, some)])
    assert steps.min() < steps.max()
    for one, other, step in zip(every, some, steps):
        np.testing.assert_array_equal(one[:step], other[:step])
        assert (other[step:] == other[step - 1]).all()


@pytest.mark.slow
def test_chunks_do_not_show(field, reference):
    problem = solve._problem(KEY, reference, size=3)
    drawn = stages.candidates_of(np, random_starts(KEY, field, reference, 2, "carried", 0.1), problem)
    settings = (
        drawn.R.reshape(-1, 3, 3),
        drawn.centroid.reshape(-1, 3),
        np.tile(np.arange(4), 2),
        *(np.full(8, True), 3, field, problem, WEIGHTS),
    )
    # 24 pairs of a pose and a block: 3 at a time, 5 at a time, where the last chunk has fewer, and all at once.
    whole = evaluate(*settings, 128)
    for chunk in (9, 15):
        for part, expected in zip(evaluate(*settings, chunk), whole, strict=True):
            np.testing.assert_allclose(part, expected, rtol=1e-4, atol=1e-6)


@pytest.mark.slow
def test_poses_beyond_those_that_count_have_no_part_in_the_energy(field, reference):
    problem = solve._problem(KEY, reference, size=3)
    drawn = stages.candidates_of(np, random_starts(KEY, field, reference, 2, "carried", 0.1), problem)
    poses = drawn.R.reshape(-1, 3, 3), drawn.centroid.reshape(-1, 3), np.tile(np.arange(4), 2)
    whole = evaluate(*poses, np.arange(8) < 8, 3, field, problem, WEIGHTS, 9)
    first = evaluate(*poses, np.arange(8) < 5, 3, field, problem, WEIGHTS, 9)
    for part, expected in zip(first, whole, strict=True):
        np.testing.assert_allclose(part[:5], expected[:5], rtol=1e-4, atol=1e-6)


# ---- from stage to stage ----


@pytest.mark.parametrize("xp", [np, jnp], ids=["numpy", "traced"])
def test_carried_candidates_are_rigid_motions_of_the_demonstration(field, reference, xp):
    problem = solve._problem(KEY, reference, size=8)
    starts = random_starts(KEY, field, reference, 4, "scattered", 0.1)
    drawn = stages.candidates_of(np, starts, problem)
    energy = np.random.default_rng(0).uniform(size=(4, 3))
    found = Candidates(*map(xp.asarray, (drawn.R[:, :3], drawn.centroid[:, :3], energy)))
    picked = Candidates(*map(xp.asarray, (drawn.R[2:, 1:2], drawn.centroid[2:, 1:2])))
    shown_candidates = stages.candidates_of(np, reference.trajectory.wxyz_xyz, problem)
    propagated = stages.propagated(xp, found, picked, 1, shown_candidates, xp.asarray(field.origin))
    new = np.array(stages.poses_of(xp, propagated, problem), np.float64)
    assert new.shape == (6, 3, 7)
    shown = np.array(reference.trajectory.shifted(field.origin).wxyz_xyz[:3], np.float64)
    for index, (row, waypoint) in enumerate(
        [*((row, waypoint) for waypoint, row in enumerate(energy.argmin(axis=0))), (2, 1), (3, 1)]
    ):
        best = np.array(starts[row, waypoint], np.float64)
        turn = (
            Rotation.from_quat(best[:4], scalar_first=True)
            * Rotation.from_quat(shown[waypoint, :4], scalar_first=True).inv()
        )
        motion = np.concatenate([turn.as_quat(scalar_first=True), best[4:] - turn.apply(shown[waypoint, 4:])])
        expected = composed(motion, shown)
        expected *= np.where(np.arange(7) < 4, np.sign((expected[:, :4] * new[index, :, :4]).sum(axis=1))[:, None], 1)
        np.testing.assert_allclose(new[index], expected, atol=2e-6)
    np.testing.assert_allclose(np.abs(new[5]), np.abs(shown), atol=2e-6)


@pytest.mark.parametrize("xp", [np, jnp], ids=["numpy", "traced"])
def test_distinct_candidates_are_the_best_of_each_waypoint(xp):
    turns = Rotation.from_rotvec([[0, 0, 0], [0.05, 0, 0], [0.5, 0, 0], [0, 0, 0]]).as_matrix()
    turns = np.float32(turns)
    R = np.stack([turns, turns], axis=1)
    place = np.zeros((4, 2, 3), np.float32)
    place[3, :, 0] = 0.05
    energy = np.array([[0.2, 0.4], [0.1, 0.3], [0.4, 0.2], [0.3, 0.1]])
    found = Candidates(*map(xp.asarray, (R, place, energy)))
    best, rows = stages.distinct(xp, found, 3)
    # Candidates 0 and 1 are 3 degrees apart and count as one.
    for waypoint, expected in enumerate([[1, 3, 2], [3, 2, 1]]):
        np.testing.assert_array_equal(best.R[:, waypoint], turns[expected])
        np.testing.assert_array_equal(best.centroid[:, waypoint], place[expected, waypoint])
        np.testing.assert_array_equal(rows[:, waypoint], expected)
    most, _ = stages.distinct(xp, found, 4)
    np.testing.assert_array_equal(most.R[3, 0], turns[0])  # none distinct is left


# ---- the result ----


def test_energies_are_those_of_the_trajectories_and_the_first_is_the_best(result, field, reference):
    assert result.trajectories.shape == (2, 4, 7) and result.candidate_history.shape == (2, 10)
    np.testing.assert_allclose(result.energies, energy_of(result.trajectories, field, reference), rtol=1e-5)
    assert result.best == 0 and result.energies[0] <= result.energies[1]
    # energies of one set of query points do not rise
    for stage in (slice(0, 3), slice(3, 5), slice(5, 7), slice(7, 10)):
        assert (np.diff(result.candidate_history[:, stage], axis=1) <= 1e-7).all()
    assert (result.energies <= result.candidate_history[:, -1] + 1e-7).all()


@pytest.mark.slow
def test_the_history_of_a_start_begins_at_its_energy_and_ends_where_it_is_dropped(field, reference):
    """With all query points in every stage, energies of poses are those of the history."""
    one = dataclasses.replace(
        reference, descriptors=reference.descriptors[:1], trajectory=tdf.Trajectory(reference.trajectory.wxyz_xyz[:1])
    )
    config = dataclasses.replace(CONFIG, num_starts=8, num_coarse_queries=8, tolerance=0.0)
    result = run(field, one, fix_last=False, config=config)
    assert result.initial_trajectories.shape == (8, 1, 7) and result.history.shape == (
        8,
        result.candidate_history.shape[1],
    )
    initial = energy_of(result.initial_trajectories, field, one)
    np.testing.assert_allclose(result.history[:, 0], initial, rtol=1e-5)
    followed = np.isfinite(result.history)
    assert (np.diff(followed.astype(int), axis=1) <= 0).all()  # a dropped start does not come back
    assert followed[:, : config.coarse_steps].all()
    np.testing.assert_array_equal(followed[:, config.coarse_steps :].sum(axis=0), config.num_candidates)
    best = np.sort(np.asarray(result.history)[followed[:, -1], -1])
    np.testing.assert_allclose(best, np.sort(result.candidate_history[:, -1]), rtol=1e-6)


def test_whole_trajectories_are_followed_in_the_search_only(result):
    assert (
        result.initial_trajectories.shape[0]
        == result.history.shape[0]
        == max(CONFIG.num_starts, CONFIG.num_trajectory_starts)
    )
    followed = np.isfinite(result.history)
    expected = np.zeros_like(followed)
    expected[: CONFIG.num_trajectory_starts, : CONFIG.search_steps] = True
    np.testing.assert_array_equal(followed, expected)


def test_the_last_pose_is_fixed_at_the_goal_exactly(field, reference, result):
    np.testing.assert_array_equal(result.trajectories[:, -1], np.tile(default_goal(field, reference), (2, 1)))
    goal = jnp.asarray(random_poses(9, 1)[0], jnp.float32)
    np.testing.assert_array_equal(run(field, reference, goal=goal).trajectories[:, -1], np.tile(goal, (2, 1)))


def test_a_free_last_pose_moves_and_energies_are_of_all_poses(field, reference):
    weights = tdf.EnergyWeights(0.0)  # at the goal, eq. 3 alone is least
    free, fixed = (
        run(field, reference, config=SolveConfig(num_coarse_queries=8), energy=weights, fix_last=fix_last)
        for fix_last in (False, True)
    )
    np.testing.assert_allclose(free.energies, energy_of(free.trajectories, field, reference, weights), rtol=1e-5)
    assert np.abs(free.trajectories[0, -1] - fixed.trajectories[0, -1]).max() > 1e-3
    assert free.loss < fixed.loss


@pytest.mark.slow
def test_it_reaches_what_adam_reaches(field, reference):
    """On random networks minima are many: 20 starts each, of both kinds."""
    for start in ("carried", "scattered"):
        starts = random_starts(KEY, field, reference, 20, start, 0.1)
        adam = tdf.optimize(
            field,
            reference,
            KEY,
            energy=WEIGHTS,
            config=tdf.OptimizeConfig(20, 100),
            starts=starts,
            goal=default_goal(field, reference),
        )
        found = run(
            field,
            reference,
            starts=starts,
            goal=default_goal(field, reference),
            config=SolveConfig(num_coarse_queries=8, **dict.fromkeys(STEPS, 30), tolerance=0.0),
        )
        assert found.loss < 1.02 * adam.loss


def test_a_known_pose_is_found_on_the_same_object(golden, quick_compilation):
    """The demonstrated grasp on the moved object, from random starts, to 1 degree and 1 mm."""
    points = golden.arrays["point_cloud"][0] + (0.3, -0.2, 0.1)
    demonstrated = random_poses(1, 2, 0.05) + [0, 0, 0, 0, 0.3, -0.2, 0.1]
    query = tdf.box_query(jax.random.key(0), count=64, size=0.08, centre=(0.05, 0.02, 0.0))
    trajectory = tdf.Trajectory(jnp.asarray(demonstrated, jnp.float32))
    reference = tdf.describe(golden.model, tdf.Demonstration(points.astype(np.float32), trajectory, query))
    motion = random_poses(5, 1, 0.3)[0]
    truth = composed(motion, demonstrated)
    field = tdf.encode(golden.model, carried(motion, points).astype(np.float32))
    result = tdf.solve(
        field,
        reference,
        KEY,
        goal=jnp.asarray(truth[-1], jnp.float32),
        energy=tdf.EnergyWeights(correlation=0.0),
        config=SolveConfig(),
    )
    pick = np.array(result.trajectory.wxyz_xyz[0], np.float64)
    turn = Rotation.from_quat(pick[:4], scalar_first=True) * Rotation.from_quat(truth[0, :4], scalar_first=True).inv()
    assert np.degrees(turn.magnitude()) < 1
    assert np.linalg.norm(pick[4:] - truth[0, 4:]) < 1e-3


def test_results_are_a_function_of_the_key(field, reference, result):
    again, other = run(field, reference), run(field, reference, key=jax.random.key(1))
    for name in ("trajectories", "energies", "candidate_history", "initial_trajectories", "history"):
        np.testing.assert_array_equal(getattr(again, name), getattr(result, name))
    assert np.abs(other.trajectories - result.trajectories)[:, :-1].max() > 1e-3


@pytest.mark.slow
def test_a_stage_ends_when_no_step_promises_enough(field, reference):
    result = run(field, reference, config=dataclasses.replace(CONFIG, **LONG, tolerance=0.5))
    np.testing.assert_array_equal(result.candidate_history[:, -29:], np.tile(result.candidate_history[:, -1:], 29))
    thorough = run(field, reference, config=dataclasses.replace(CONFIG, **LONG))
    assert thorough.loss < result.loss


def test_a_start_that_is_not_finite_does_not_spoil_the_others(field, reference):
    starts = random_starts(KEY, field, reference, 3, "carried", 0.1).at[:, -1].set(default_goal(field, reference))
    with jax.debug_nans(False):
        far = run(field, reference, starts=starts.at[1, 0, 4].set(1e30))
    assert far.finite.all() and far.loss <= run(field, reference, starts=starts[jnp.array([0, 2])]).loss * 1.2


def test_progress_follows_the_stages_and_can_cancel(field, reference, result):
    calls = []
    run(field, reference, progress=lambda done, energies: calls.append((done, energies)))
    assert [done for done, _ in calls] == [2, 3, 6, 8, 10, 13] and all(len(energies) == 2 for _, energies in calls)

    def cancel(done, energies):
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        run(field, reference, progress=cancel)


def test_stages_and_what_is_traced_share_one_program(small_model, field, reference, result):
    with compilations() as compiled:
        other = tdf.encode(small_model, jnp.asarray(random_cloud(30), jnp.float32))
        for weight in (0, 0.5, jnp.array(0.1)):
            run(
                other,
                reference,
                key=jax.random.key(5),
                energy=tdf.EnergyWeights(correlation=weight, rotation_scale=weight),
            )
        run(field, reference, config=dataclasses.replace(CONFIG, tolerance=0.1))
    assert not {"jit(descend)", "jit(_problem)", "jit(_random_starts)"} & set(compiled)


# ---- inside of functions that are traced ----


NAMES = ("trajectories", "energies", "candidate_history", "initial_trajectories")


def parts(result):
    """Arrays of a result; where a start is not followed, its history is infinite, as that of a traced call is."""
    known = isinstance(result.history, np.ndarray)
    history = np.where(np.isnan(result.history), np.inf, result.history) if known else result.history
    return *(getattr(result, name) for name in NAMES), history


def assert_equal_parts(found, expected):
    for one, other, name in zip(found, expected, (*NAMES, "history"), strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-4, atol=2e-5, err_msg=name)


@pytest.fixture(scope="module")
def worlds(small_model, demonstration):
    """Fields of two objects and references of two demonstrations, stacked."""
    fields = [tdf.encode(small_model, jnp.asarray(random_cloud(seed), jnp.float32)) for seed in (3, 30)]
    shown = [
        tdf.describe(small_model, dataclasses.replace(demonstration, query=demonstration.query + offset))
        for offset in (0.0, 0.01)
    ]
    return [jax.tree.map(lambda *leaves: jnp.stack(leaves), *pair) for pair in (fields, shown)]


def test_a_batch_over_anything_is_that_of_single_calls_and_is_traced_once(worlds):
    fields, references = worlds
    traces = []

    @jax.jit
    @jax.vmap
    def batch(field, reference, key, goal, weight):
        traces.append(None)
        energy = tdf.EnergyWeights(correlation=weight, rotation_scale=0.2)
        return parts(run(field, reference, key=key, goal=goal, energy=energy))

    for seed in (0, 1):
        keys = jax.random.split(jax.random.key(seed), 2)
        goals = jnp.asarray(random_poses(seed, 2), jnp.float32)
        weights = jnp.array([0.3, 0.2]) + 0.1 * seed
        with compilations() as compiled:
            found = batch(fields, references, keys, goals, weights)
        for index in range(2):
            field, reference = (jax.tree.map(operator.itemgetter(index), tree) for tree in worlds)
            energy = tdf.EnergyWeights(correlation=weights[index], rotation_scale=0.2)
            expected = parts(run(field, reference, key=keys[index], goal=goals[index], energy=energy))
            assert_equal_parts([part[index] for part in found], expected)
    assert traces == [None] and compiled == []


def test_a_batch_in_which_only_keys_differ(field, reference):
    keys = jax.random.split(KEY, 2)
    found = jax.vmap(lambda key: parts(run(field, reference, key=key)))(keys)
    for index, key in enumerate(keys):
        assert_equal_parts([part[index] for part in found], parts(run(field, reference, key=key)))


@pytest.mark.slow
def test_a_batch_on_an_accelerator_is_computed_together(monkeypatch, field, reference):
    """There `devices.mapped` leaves the batch to `jax.vmap`."""
    monkeypatch.setattr("tdf_jax._internal.devices.one_at_a_time", lambda: False)
    config = dataclasses.replace(CONFIG, chunk_queries=64)  # a program of its own
    keys = jax.random.split(KEY, 2)
    found = jax.jit(jax.vmap(lambda key: parts(run(field, reference, key=key, config=config))))(keys)
    for index, key in enumerate(keys):
        expected = parts(run(field, reference, key=key, config=config))
        assert_equal_parts([part[index] for part in found], expected)


@pytest.mark.slow
def test_known_numbers_and_starts_inside_of_a_traced_function(field, reference, result):
    starts = random_starts(KEY, field, reference, 3, "carried", 0.1).at[:, -1].set(default_goal(field, reference))
    inside = jax.jit(lambda: (parts(run(field, reference)), parts(run(field, reference, starts=starts))))()
    assert_equal_parts(inside[0], parts(result))
    assert_equal_parts(inside[1], parts(run(field, reference, starts=starts)))


def test_what_a_traced_call_cannot_do_is_refused(field, reference):
    def refused(match, **settings):
        with pytest.raises(InputError, match=match):
            jax.jit(lambda key: run(field, reference, key=key, **settings).energies)(KEY)

    refused(r"solve\(\): there is a progress, and the call is traced", progress=print)
    device_mesh = jax.make_mesh((1,), ("starts",))
    refused(r"solve\(\): there is a device_mesh, and the call is traced", device_mesh=device_mesh)
    with pytest.raises(InputError, match=r"energy.compensator is traced; expected 0"):
        jax.jit(lambda energy: run(field, reference, energy=energy).energies)(tdf.EnergyWeights())


# ---- bad input ----


@pytest.mark.parametrize(
    ("settings", "name"),
    [
        ({"num_trajectory_starts": 0}, "num_trajectory_starts"),
        ({"num_coarse_queries": 2.5}, "num_coarse_queries"),
        ({"num_starts": True}, "num_starts"),
        ({"coarse_steps": 5.0}, "coarse_steps"),
        ({"polish_steps": 0}, "polish_steps"),
        ({"num_candidates": 0}, "num_candidates"),
        ({"chunk_queries": 0}, "chunk_queries"),
        ({"tolerance": -0.1}, "tolerance"),
        ({"tolerance": np.nan}, "tolerance"),
        ({"start_radius": np.inf}, "start_radius"),
        ({"start": "middle"}, "expected one of carried, scattered"),
    ],
)
def test_bad_settings_are_refused(settings, name):
    with pytest.raises(InputError, match=rf"SolveConfig\(\).*{name}"):
        SolveConfig(**settings)


def test_what_couples_waypoints_is_refused(field, reference):
    with pytest.raises(InputError, match=r"solve\(\): energy.compensator is 0.1; expected 0.*Use optimize"):
        run(field, reference, energy=tdf.EnergyWeights(0.02, 0.1))
    starts = jnp.asarray(np.stack([random_poses(seed, 4) for seed in range(3)]), jnp.float32)
    with pytest.raises(InputError, match="the last poses of the starts differ"):
        run(field, reference, starts=starts)
    one = dataclasses.replace(
        reference, descriptors=reference.descriptors[:1], trajectory=tdf.Trajectory(reference.trajectory.wxyz_xyz[:1])
    )
    with pytest.raises(InputError, match="expected fix_last=False"):
        run(field, one)
    with pytest.raises(InputError, match=r"solve\(\): key is 0"):
        run(field, reference, key=0, starts=starts)
    with pytest.raises(InputError, match=r"solve\(\): starts have shape"):
        run(field, reference, starts=starts[0])


def test_one_pose_alone_is_found(field, reference):
    one = dataclasses.replace(
        reference, descriptors=reference.descriptors[:1], trajectory=tdf.Trajectory(reference.trajectory.wxyz_xyz[:1])
    )
    result = run(field, one, fix_last=False)
    assert result.trajectories.shape == (2, 1, 7)
    np.testing.assert_allclose(result.energies, energy_of(result.trajectories, field, one), rtol=1e-5)
