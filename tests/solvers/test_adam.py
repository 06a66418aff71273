"""The optimiser: its gradient, the bookkeeping of many starts, what it recompiles and holds, that it finds a pose."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import SMALL, carried, compilations, composed, random_cloud, random_poses
from flax.traverse_util import unflatten_dict
from scipy.spatial.transform import Rotation

import tdf_jax as tdf
from tdf_jax._internal.errors import InputError
from tdf_jax.energy.reference import Reference
from tdf_jax.geometry import se3
from tdf_jax.networks.field import DescriptorField
from tdf_jax.networks.occupancy import condition, parameter_shapes
from tdf_jax.solvers.adam import _begin, _run
from tdf_jax.solvers.initial import default_goal, random_starts

CONFIG = tdf.OptimizeConfig(num_starts=3, iterations=5)
WEIGHTS = tdf.EnergyWeights(correlation=0.3, compensator=0.1, rotation_scale=0.2)
KEY = jax.random.key(0)
SLOW = pytest.mark.slow


def run(field, reference, key=KEY, config=CONFIG, energy=WEIGHTS, **settings):
    return tdf.optimize(field, reference, key, config=config, energy=energy, **settings)


@pytest.fixture(scope="module")
def result(field, reference):
    return run(field, reference)


@pytest.fixture(scope="module")
def energies(field, reference):
    """Every trajectory's energy, and its gradient with respect to turns and to the places of the query centroid."""

    def energy(variables, rotations):
        turns, places = variables
        R = se3.exp(turns) @ rotations
        t = places - R @ jnp.mean(reference.query, axis=0)
        return tdf.trajectory_energy(tdf.Trajectory(se3.pose(R, t)), field, reference, WEIGHTS)

    each = jax.jit(jax.vmap(jax.value_and_grad(energy)))

    def of(trajectories):
        rotations = se3.rotation(trajectories)
        places = se3.transform(trajectories, jnp.mean(reference.query, axis=0)[None])[..., 0, :]
        return each((jnp.zeros_like(places), places), rotations)

    return of


# ---- the gradient ----


@pytest.mark.parametrize(
    ("fix_last", "chunk"), [(True, 2), pytest.param(True, 64, marks=SLOW), pytest.param(False, 64, marks=SLOW)]
)
def test_the_chunked_gradient_is_that_of_the_energy(field, reference, energies, fix_last, chunk):
    """After one step, Adam's first moments are a tenth of the gradient. 9 or 12 poses: with and without a remainder."""
    starts = random_starts(KEY, field, reference, 3, "scattered", 0.1)
    state = _begin(starts, reference.query)
    weights = jax.tree.map(jnp.float32, WEIGHTS)
    rates = jnp.array([0.1, 0.01, 0.05, 5.0])
    (_, adam, _), losses = _run(state, starts, field, reference, weights, rates, 1, fix_last=fix_last, chunk=chunk)
    values, gradients = energies(starts)
    np.testing.assert_allclose(losses[:, 0], values, rtol=1e-5)
    for moment, gradient in zip(adam.mu, gradients, strict=True):
        expected = gradient.at[:, -1].set(0.0) if fix_last else gradient
        np.testing.assert_allclose(10 * moment, expected, atol=2e-4 * np.abs(gradient).max())


@pytest.mark.slow
def test_the_result_does_not_depend_on_the_chunk(field, reference):
    one_step = dataclasses.replace(CONFIG, iterations=1)
    whole, parts = (run(field, reference, config=dataclasses.replace(one_step, chunk_poses=chunk)) for chunk in (64, 2))
    np.testing.assert_allclose(parts.trajectories, whole.trajectories, rtol=1e-6, atol=1e-7)
    np.testing.assert_allclose(parts.candidate_history, whole.candidate_history, rtol=1e-6)


def test_the_first_step_has_the_rates_of_the_settings(field, reference):
    """Adam's first step is the sign of the gradient times the rate."""
    config = dataclasses.replace(CONFIG, iterations=1, rotation_rate=0.02, translation_rate=0.003)
    result = run(field, reference, config=config)
    centre = jnp.mean(reference.query, axis=0)[None]
    moved = se3.transform(result.trajectories, centre) - se3.transform(result.initial_trajectories, centre)
    np.testing.assert_allclose(np.abs(moved[:, :-1]), 0.003, rtol=0.01)
    turned = se3.rotation_distance(se3.rotation(result.trajectories), se3.rotation(result.initial_trajectories))
    np.testing.assert_allclose(turned[:, :-1], 0.02 * np.sqrt(3), rtol=0.01)


def test_rates_fall_as_a_cosine(field, reference):
    """Far from a goal that pulls alone, the gradient keeps its direction, and Adam's steps are as long as the rate."""
    config = dataclasses.replace(CONFIG, iterations=25, translation_rate=0.004, final_rate=0.1)
    away = random_poses(0, 4) * [1, 1, 1, 1, 0, 0, 0] + [0, 0, 0, 0, 9, 9, 9]
    far = jnp.asarray(np.tile(away, (3, 1, 1)), jnp.float32)
    result = run(field, reference, config=config, energy=tdf.EnergyWeights(1e3, rotation_scale=0.0), starts=far)
    decay = 0.1 + 0.9 * (1 + np.cos(np.pi * np.arange(25) / 25)) / 2
    centre = jnp.mean(reference.query, axis=0)[None]
    moved = se3.transform(result.trajectories, centre) - se3.transform(result.initial_trajectories, centre)
    np.testing.assert_allclose(moved[:, :-1], -0.004 * decay.sum(), rtol=0.02)


# ---- bookkeeping ----


def test_losses_begin_at_the_starts_and_energies_are_of_the_result(result, energies):
    assert result.candidate_history.shape == (3, 5)
    np.testing.assert_allclose(result.candidate_history[:, 0], energies(result.initial_trajectories)[0], rtol=1e-5)
    np.testing.assert_allclose(result.energies, energies(result.trajectories)[0], rtol=1e-5)
    assert (result.energies < result.candidate_history[:, 0]).all()


def test_the_best_is_the_least_energy(result):
    best = int(np.argmin(result.energies))
    assert result.best == best and result.loss == result.energies[best]
    np.testing.assert_array_equal(result.trajectory.wxyz_xyz, result.trajectories[best])
    assert result.finite.all() and result.status == "all 3 starts finite"


def test_iterations_run_in_blocks_of_one_program(field, reference, result):
    """45 iterations are three blocks, the last one short; a block's end shows neither in losses nor in what follows."""
    calls = []
    with compilations() as compiled:
        long = run(
            field,
            reference,
            config=dataclasses.replace(CONFIG, iterations=45),
            progress=lambda done, energies: calls.append((done, energies)),
        )
    assert "jit(_run)" not in compiled
    assert [done for done, _ in calls] == [20, 40, 45]
    assert long.candidate_history.shape == (3, 45)
    for done, energies in calls:
        np.testing.assert_array_equal(energies, long.candidate_history[:, done - 1])
    np.testing.assert_array_equal(long.candidate_history[:, 0], result.candidate_history[:, 0])
    assert (long.candidate_history > 0).all()
    jumps = np.abs(np.diff(long.candidate_history, axis=1))
    assert jumps[:, [19, 39]].max() <= jumps.max(axis=1).max()
    assert (long.energies < long.candidate_history[:, 0]).all()


def test_progress_can_cancel(field, reference):
    def cancel(done, energies):
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        run(field, reference, progress=cancel)
    assert run(field, reference).finite.all()


def test_results_are_a_function_of_the_key(field, reference, result):
    again, other = run(field, reference), run(field, reference, key=jax.random.key(1))
    for name in ("trajectories", "energies", "candidate_history", "initial_trajectories"):
        np.testing.assert_array_equal(getattr(again, name), getattr(result, name))
    assert np.abs(other.initial_trajectories - result.initial_trajectories)[:, :-1].max() > 0.01


@pytest.mark.parametrize("start", ["carried", "scattered"])
def test_a_start_does_not_depend_on_how_many_there_are(field, reference, start):
    few, many = (random_starts(KEY, field, reference, count, start, 0.1) for count in (3, 5))
    np.testing.assert_allclose(many[:3], few, atol=1e-6)
    assert np.abs(np.diff(many, axis=0)).max(axis=(1, 2)).min() > 0.01


def test_carried_starts_turn_the_demonstration_about_the_object(field, reference):
    starts = np.array(random_starts(KEY, field, reference, 5, "carried", 0.1), np.float64)
    demonstrated = np.array(reference.trajectory.wxyz_xyz, np.float64)
    R_demonstrated = Rotation.from_quat(demonstrated[:, :4], scalar_first=True)
    for start in starts:
        turns = Rotation.from_quat(start[:, :4], scalar_first=True) * R_demonstrated.inv()
        assert (turns[0].inv() * turns).magnitude().max() < 1e-5  # the same for every pose
        np.testing.assert_allclose(start[:, 4:] - field.origin, turns[0].apply(demonstrated[:, 4:]), atol=1e-6)


def test_scattered_starts_lie_about_the_object(field, reference):
    starts = random_starts(KEY, field, reference, 64, "scattered", 0.1)
    centres = se3.transform(starts, jnp.mean(reference.query, axis=0)[None])[..., 0, :]
    distances = np.linalg.norm(centres - field.origin, axis=-1)
    assert distances.max() < 0.1 + 1e-6
    assert 0.07 < distances.mean() < 0.08  # uniform in the ball: three quarters of the radius
    assert np.abs(np.diff(starts[..., :4], axis=1)).max(axis=-1).min() > 1e-3  # every pose has a turn of its own


def test_the_last_pose_is_fixed_at_the_goal_exactly(field, reference, result):
    goal = default_goal(field, reference)
    np.testing.assert_allclose(goal[4:], reference.trajectory.wxyz_xyz[-1, 4:] + field.origin, atol=1e-6)
    np.testing.assert_array_equal(result.trajectories[:, -1], np.tile(goal, (3, 1)))
    goal = jnp.asarray(random_poses(9, 1)[0], jnp.float32)
    other = run(field, reference, goal=goal)
    np.testing.assert_array_equal(other.trajectories[:, -1], np.tile(goal, (3, 1)))
    np.testing.assert_array_equal(other.initial_trajectories[:, :-1], result.initial_trajectories[:, :-1])


def test_a_free_last_pose_starts_at_the_goal_given_or_at_random_and_moves(field, reference):
    goal = default_goal(field, reference)
    sent = run(field, reference, goal=goal, fix_last=False)
    np.testing.assert_array_equal(sent.initial_trajectories[:, -1], np.tile(goal, (3, 1)))
    free = run(field, reference, fix_last=False)
    np.testing.assert_array_equal(free.initial_trajectories, random_starts(KEY, field, reference, 3, "carried", 0.1))
    for result in (sent, free):
        assert np.abs(result.trajectories[:, -1] - result.initial_trajectories[:, -1]).max(axis=-1).min() > 1e-3


def test_given_starts_are_used_and_may_end_apart(field, reference, energies):
    starts = jnp.asarray(np.stack([random_poses(seed, 4) for seed in range(3)]), jnp.float32)
    kept = run(field, reference, starts=starts)
    np.testing.assert_array_equal(kept.initial_trajectories, starts)
    np.testing.assert_array_equal(kept.trajectories[:, -1], starts[:, -1])
    np.testing.assert_allclose(kept.candidate_history[:, 0], energies(starts)[0], rtol=1e-5)
    np.testing.assert_allclose(kept.energies, energies(kept.trajectories)[0], rtol=1e-5)
    goal = jnp.asarray(random_poses(9, 1)[0], jnp.float32)
    sent = run(field, reference, starts=starts, goal=goal)
    np.testing.assert_array_equal(sent.initial_trajectories, starts.at[:, -1].set(goal))


def test_a_start_that_becomes_non_finite_is_reported_and_the_others_are_unaffected(field, reference, result):
    with jax.debug_nans(False):
        far = run(field, reference, starts=result.initial_trajectories.at[1, 0, 4].set(1e30))  # its square is infinite
        assert far.finite.tolist() == [True, False, True]
        assert far.status == "1 of 3 starts became non-finite: 1"
        assert far.best in (0, 2) and np.isfinite(far.loss)
        np.testing.assert_array_equal(far.trajectories[::2], result.trajectories[::2])
        np.testing.assert_array_equal(far.candidate_history[::2], result.candidate_history[::2])
        lost = run(field, reference, starts=result.initial_trajectories.at[:, 0, 4].set(1e30))
        with pytest.raises(
            InputError,
            match="3 of 3 starts became non-finite: 0, 1, 2; check the weights and the query points, or, with Adam, "
            "lower rotation_rate and translation_rate",
        ):
            _ = lost.trajectory


@pytest.mark.slow
def test_mixed_precisions_promote(field, reference, result):
    """A float32 trajectory from a file, with the float64 query points that jax draws where it may."""
    with jax.enable_x64(True):
        mixed = dataclasses.replace(reference, query=jnp.asarray(reference.query, jnp.float64))
        double = run(field, mixed, starts=result.initial_trajectories)
        assert {x.dtype for x in jax.tree.leaves(double) if x.ndim and x.size} == {jnp.dtype("float64")}
        np.testing.assert_allclose(double.candidate_history[:, 0], result.candidate_history[:, 0], rtol=1e-4)


# ---- finding a pose ----


@pytest.mark.slow
def test_a_known_pose_is_found_on_the_same_object(golden, quick_compilation):
    """From 40 degrees and 3 cm away, the demonstrated grasp is found on the moved object to 1 degree and 1 mm."""
    points = golden.arrays["point_cloud"][0] + (0.3, -0.2, 0.1)
    demonstrated = random_poses(1, 2, 0.05) + [0, 0, 0, 0, 0.3, -0.2, 0.1]
    query = tdf.box_query(jax.random.key(0), count=64, size=0.08, centre=(0.05, 0.02, 0.0))
    trajectory = tdf.Trajectory(jnp.asarray(demonstrated, jnp.float32))
    reference = tdf.describe(golden.model, tdf.Demonstration(points.astype(np.float32), trajectory, query))
    motion = random_poses(5, 1, 0.3)[0]
    truth = composed(motion, demonstrated)
    field = tdf.encode(golden.model, carried(motion, points).astype(np.float32))

    rng = np.random.default_rng(0)
    axes, ways = (v / np.linalg.norm(v, axis=-1, keepdims=True) for v in rng.normal(size=(2, 4, 3)))
    R_truth = Rotation.from_quat(truth[0, :4], scalar_first=True)
    starts = np.tile(truth, (4, 1, 1))
    starts[:, 0, :4] = (Rotation.from_rotvec(np.radians(40) * axes) * R_truth).as_quat(scalar_first=True)
    starts[:, 0, 4:] += 0.03 * ways
    result = tdf.optimize(
        field,
        reference,
        KEY,
        goal=jnp.asarray(truth[-1], jnp.float32),
        energy=tdf.EnergyWeights(correlation=0.0),
        starts=jnp.asarray(starts, jnp.float32),
    )
    picks = np.array(result.trajectories[:, 0], np.float64)
    turns = Rotation.from_quat(picks[:, :4], scalar_first=True) * R_truth.inv()
    assert np.degrees(turns.magnitude()).max() < 1
    assert np.linalg.norm(picks[:, 4:] - truth[0, 4:], axis=1).max() < 1e-3
    assert result.energies.max() < 0.05 * result.candidate_history[:, 0].min()


# ---- compiling and memory ----


def test_what_is_traced_does_not_compile_again(small_model, demonstration, field, reference):
    run(field, reference)
    goal = jnp.asarray(random_poses(9, 1)[0], jnp.float32)
    rates = {"rotation_rate": 0.05, "translation_rate": 0.02, "final_rate": 0.5, "start_radius": 0.3}
    with compilations() as compiled:
        other = tdf.encode(small_model, jnp.asarray(random_cloud(30), jnp.float32))
        elsewhere = tdf.Demonstration(
            jnp.asarray(random_cloud(31), jnp.float32),
            tdf.Trajectory(jnp.asarray(random_poses(32, 4), jnp.float32)),
            demonstration.query + 0.01,
        )
        run(other, tdf.describe(small_model, elsewhere), key=jax.random.key(5), goal=goal)
        for weight in (0, 0.5, np.float32(0.1), jnp.array(0.1)):
            run(
                field,
                reference,
                energy=tdf.EnergyWeights(correlation=weight, compensator=weight, rotation_scale=weight),
            )
        run(field, reference, config=dataclasses.replace(CONFIG, **rates))
        run(field, reference, config=dataclasses.replace(CONFIG, iterations=7))
    programs = {"_run", "_begin", "_trajectories", "_random_starts", "_encode", "trajectory_descriptor"}
    assert not programs & {name.removeprefix("jit(").removesuffix(")") for name in compiled}


@pytest.mark.slow
def test_memory_does_not_grow_with_the_number_of_starts(quick_compilation):
    """64 starts of 7 poses and 64 query points have 37 MB of descriptors in this network; a chunk has 0.7."""
    config = dataclasses.replace(SMALL, latent=64, decoder_width=64)

    def array(*shape):
        return jax.ShapeDtypeStruct(shape, jnp.float32)

    def temporary_bytes(num_starts):
        params = unflatten_dict({name: array(*shape) for name, shape in parameter_shapes(config).items()}, sep=".")
        conditioned = jax.eval_shape(lambda params, z: condition(params, config, z), params, array(64, 3))
        reference = Reference(array(7, 64, config.channels), tdf.Trajectory(array(7, 7)), array(64, 3))
        starts = array(num_starts, 7, 7)
        state = jax.eval_shape(_begin, starts, reference.query)
        weights = jax.tree.map(lambda _: array(), WEIGHTS)
        steps = jax.ShapeDtypeStruct((), jnp.int32)
        lowered = _run.lower(
            *(state, starts, DescriptorField(conditioned, array(3)), reference, weights, array(4), steps),
            fix_last=True,
            chunk=8,
        )
        return lowered.compile().memory_analysis().temp_size_in_bytes

    few, many = temporary_bytes(4), temporary_bytes(64)
    assert few < 5e6
    assert many - few < 0.3e6  # Adam's own numbers: 64 x 7 x 6 floats are 11 kB


# ---- bad input ----


@pytest.mark.parametrize(
    ("settings", "name"),
    [
        ({"num_starts": 0}, "num_starts"),
        ({"num_starts": 2.5}, "num_starts"),
        ({"num_starts": True}, "num_starts"),
        ({"iterations": 0}, "iterations"),
        ({"chunk_poses": 0}, "chunk_poses"),
        ({"rotation_rate": 0.0}, "rotation_rate"),
        ({"translation_rate": np.nan}, "translation_rate"),
        ({"final_rate": -1.0}, "final_rate"),
        ({"start_radius": np.inf}, "start_radius"),
        ({"start": "middle"}, "expected one of carried, scattered"),
    ],
)
def test_bad_settings_are_refused(settings, name):
    with pytest.raises(InputError, match=rf"OptimizeConfig\(\).*{name}"):
        tdf.OptimizeConfig(**settings)


@pytest.mark.parametrize(
    "goal",
    [np.zeros(6), np.zeros((1, 7)), np.zeros(7), np.array([1, 0, 0, 0, np.nan, 0, 0]), np.array([1] + [np.inf] * 6)],
    ids=["short", "batch", "no-turn", "nan", "infinite"],
)
def test_bad_goals_are_refused(field, reference, goal):
    found = r"goal (has shape .*|is .*|has a quaternion of norm 0; )expected (one (finite )?pose )?wxyz_xyz"
    with pytest.raises(InputError, match=rf"optimize\(\): {found}"):
        run(field, reference, goal=goal)


def test_bad_starts_are_refused(field, reference, result):
    for starts in (
        result.initial_trajectories[0],
        result.initial_trajectories[:, :3],
        result.initial_trajectories[..., :6],
    ):
        with pytest.raises(InputError, match=r"optimize\(\): starts have shape .* expected \(starts, 4, 7\)"):
            run(field, reference, starts=starts)
    with jax.debug_nans(False):
        with pytest.raises(InputError, match="NaN or infinite"):
            run(field, reference, starts=result.initial_trajectories.at[0, 1, 5].set(np.nan))
    with pytest.raises(InputError, match="quaternion"):
        run(field, reference, starts=result.initial_trajectories.at[2, 1, :4].set(0.0))


def test_a_reference_of_another_network_is_refused(field, reference):
    narrower = dataclasses.replace(reference, descriptors=reference.descriptors[..., :-1])
    with pytest.raises(InputError, match="the reference has 32 channels and the field 33; expected both from the same"):
        run(field, narrower)


@pytest.mark.parametrize("value", [-0.1, np.nan, np.inf])
@pytest.mark.parametrize("name", ["correlation", "compensator", "rotation_scale"])
def test_bad_weights_given_as_arrays_are_refused(field, reference, name, value):
    with pytest.raises(InputError, match=rf"optimize\(\): energy.{name} is"):
        run(field, reference, energy=dataclasses.replace(tdf.EnergyWeights(), **{name: jnp.float32(value)}))
