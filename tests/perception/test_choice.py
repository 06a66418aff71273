"""The object among several clouds: the one that the demonstration matches, or, without one, by size."""

import dataclasses

import jax
import numpy as np
import pytest
from conftest import CARRY, POINTS, carried, random_cloud, random_poses

import tdf_jax as tdf
from tdf_jax.perception.choice import pick_object

KEY = jax.random.key(3)
SEARCH = dataclasses.replace(CARRY, num_starts=48, coarse_steps=6, prune_steps=8, polish_steps=20)


def others():
    return [random_cloud(seed).astype(np.float32) for seed in (11, 12)]


@pytest.fixture(scope="module")
def moved(demonstration):
    """The demonstrated object in another pose."""
    return carried(random_poses(5, 1)[0], np.asarray(demonstration.points)).astype(np.float32)


@pytest.fixture(scope="module")
def related(demonstration):
    """The demonstration with a target, which is a cloud of its own."""
    poses = np.asarray(demonstration.trajectory.wxyz_xyz)
    target = random_cloud(21).astype(np.float32) - random_cloud(21).mean(axis=0) + poses[-1, 4:] + np.float32(0.05)
    query = np.asarray(demonstration.query) + poses[-1, 4:]
    return dataclasses.replace(demonstration, target=tdf.Target(target.astype(np.float32), query))


def test_the_residual_decides(small_model, demonstration, reference, moved):
    clouds = [*others(), moved]
    keywords = {"key": KEY, "config": SEARCH}
    picked, choice = pick_object(small_model, clouds, demonstration, return_choice=True, **keywords)
    assert picked is moved and (choice.object, choice.target) == (2, None)
    assert np.isnan(choice.target_residuals).all()
    alone = tdf.carry(tdf.encode(small_model, moved), reference, KEY, fix_last=False, config=SEARCH)
    assert choice.residuals[2] == float(alone.residual) < 0.5 * choice.residuals[:2].min()
    assert pick_object(small_model, clouds[::-1], reference, **keywords) is moved


@pytest.mark.slow
def test_object_and_target_are_two_clouds(small_model, related, moved):
    target = carried(random_poses(6, 1)[0], np.asarray(related.target.points)).astype(np.float32)
    keywords = {"key": KEY, "config": SEARCH}
    (one, other), choice = pick_object(small_model, [target, *others(), moved], related, return_choice=True, **keywords)
    assert one is moved and other is target
    assert (choice.object, choice.target) == (3, 0)
    reference = tdf.describe(small_model, related, target_model=small_model)
    # One cloud fits both: it is not given twice.
    one, other = pick_object(small_model, [moved, others()[0]], reference, **keywords)
    assert one is not other
    with pytest.raises(tdf.InputError, match="there is one cloud, and the demonstration has an object and a target"):
        pick_object(small_model, [moved], related)
    with pytest.raises(tdf.InputError, match="reference does not have the target's descriptors"):
        pick_object(small_model, [moved, target], tdf.describe(small_model, related))


def test_without_a_demonstration_the_size_and_then_the_points_decide(small_model):
    cloud = random_cloud(1, 4 * POINTS)
    clouds = [cloud[:POINTS], 20 * cloud, cloud[: 2 * POINTS], 0.1 * cloud[: 3 * POINTS]]
    diagonal = float(np.linalg.norm(np.ptp(cloud, axis=0)))
    info = dataclasses.replace(small_model.info, smallest_diagonal=0.8 * diagonal, largest_diagonal=1.2 * diagonal)
    known = dataclasses.replace(small_model, info=info)
    picked, choice = pick_object(known, clouds, return_choice=True)
    assert picked is clouds[2] and choice.object == 2 and np.isnan(choice.residuals).all()
    assert pick_object(small_model, clouds) is clouds[1]  # sizes are not known
    assert pick_object(known, [clouds[3], clouds[1]]) is clouds[1]  # none has a known size


@pytest.mark.parametrize(
    ("keywords", "words"),
    [
        ({"clouds": []}, "there are no clouds"),
        ({"clouds": random_cloud(1)}, r"a list of clouds.*of one cloud, \[points\]"),
        ({"clouds": [random_cloud(1), random_cloud(2)[:5]]}, r"clouds\[1\] has 5 points"),
        ({"model": "mug"}, "model is 'mug'"),
        ({"config": tdf.SolveConfig()}, "expected a CarryConfig"),
        ({"return_choice": 1}, "return_choice is 1"),
        ({"key": 0}, "key is 0"),
    ],
    ids=str,
)
def test_bad_input_is_refused(small_model, keywords, words):
    with pytest.raises(tdf.InputError, match=rf"pick_object\(\): .*{words}"):
        pick_object(**({"model": small_model, "clouds": [random_cloud(1)]} | keywords))


def test_a_targets_network_needs_a_target(small_model, demonstration):
    with pytest.raises(tdf.InputError, match="there is a target_model, and the demonstration has no target"):
        pick_object(small_model, [random_cloud(1)], demonstration, target_model=small_model)
