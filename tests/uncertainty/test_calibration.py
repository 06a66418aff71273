"""Recognition of the demonstration's category: its evidence, its curve, and the warning."""

import dataclasses
import warnings

import jax
import numpy as np
import pytest
from conftest import CARRY, random_cloud

import tdf_jax as tdf
from tdf_jax.evaluation.cases import QUERY_SIZE, generated_case, place_demonstration
from tdf_jax.uncertainty.calibration import logistic

KEY = jax.random.key(0)
CURVE = (-1.0, 2.0, 3.0)


class Ball:
    """A field that is a ball of 1 m: the logit of its occupancy falls by ten a metre outwards."""

    def occupancy(self, x):
        return jax.nn.sigmoid(-10 * (jax.numpy.linalg.norm(x, axis=-1) - 1))


jax.tree_util.register_pytree_node(Ball, lambda ball: ((), None), lambda *about: Ball())


def sphere(radius, count):
    points = np.random.default_rng(1).normal(size=(count, 3))
    return radius * points / np.linalg.norm(points, axis=1, keepdims=True)


@pytest.mark.parametrize("count", [40, 1500, 4000])
def test_the_surface_logit_is_zero_on_the_surface_and_falls_outside(count):
    for radius, logit in ((1.0, 0.0), (1.1, -1.0), (0.9, 1.0), (2.0, -3.0), (0.2, 3.0)):  # cut at three
        assert tdf.surface_logit(Ball(), sphere(radius, count)) == pytest.approx(logit, abs=1e-4)


def test_the_logit_of_a_stray_point_is_clipped():
    points = np.concatenate([sphere(1.0, 99), [[0.0, 0.0, 50.0]]])
    assert tdf.surface_logit(Ball(), points) == pytest.approx(-3 / 100, abs=1e-4)


def test_the_curve_is_logistic_in_residual_and_logit():
    for residual, logit in ((0.2, 0.0), (0.9, -1.0), (1.0, 0.5)):
        odds = np.exp(-1 - 2 * np.log(residual) + 3 * logit)
        assert tdf.recognition(residual, logit, CURVE) == pytest.approx(odds / (1 + odds))
    assert tdf.recognition(float("nan"), 0.0) is None and tdf.recognition(0.5, float("-inf")) is None
    assert tdf.recognition(0.0, 0.0) == pytest.approx(1.0)  # a perfect match, of the demonstration's own object


@pytest.mark.parametrize("curve", [(1.0, 2.0), (1.0, 2.0, float("nan")), 3.0])
def test_a_curve_is_three_finite_numbers(curve):
    with pytest.raises(tdf.InputError, match=r"recognition\(\): curve is .*; expected three finite numbers"):
        tdf.recognition(0.5, 0.0, curve)


def test_a_fit_recovers_the_curve_of_simulated_cases():
    rng = np.random.default_rng(0)
    features = rng.normal(size=(20_000, 2))
    right = (rng.uniform(size=20_000) < 1 / (1 + np.exp(-(CURVE[0] + features @ CURVE[1:])))).astype(float)
    np.testing.assert_allclose(logistic(features, right), CURVE, atol=0.12)


@pytest.mark.slow
def test_shipped_weights_judge_the_object_and_others_do_not(small_model, monkeypatch):
    cloud, other = (random_cloud(seed).astype(np.float32) for seed in (3, 4))
    demonstration = tdf.Demonstration(cloud, tdf.line(num_poses=2), tdf.box_query(KEY, 8))

    def imitated(name, curve):
        monkeypatch.setattr("tdf_jax.imitation.CURVES", {"mug": curve})
        model = dataclasses.replace(small_model, info=dataclasses.replace(small_model.info, name=name))
        return model, tdf.imitate(model, demonstration, other, key=KEY, config=CARRY)

    with warnings.catch_warnings():
        warnings.simplefilter("error")
        warnings.simplefilter("ignore", tdf.ConfidenceWarning)  # the random network is never sure
        assert np.isnan(imitated("mine", (0.0, 0.0, 0.0))[1].recognised)
        assert imitated("mug", (2.0, 0.0, 0.0))[1].recognised == pytest.approx(1 / (1 + np.exp(-2)))
    with pytest.warns(
        tdf.CategoryWarning,
        match=r"does not look like one of the demonstration's category to the weights 'mug' \(probability 0.12\)",
    ):
        imitated("mug", (-2.0, 0.0, 0.0))
    with pytest.warns(tdf.ConfidenceWarning, match=r"the pick is right with a probability of 0\.\d+ only"):
        model, result = imitated("mug", (0.3, 0.1, 0.1))
    evidence = result.residual, tdf.surface_logit(tdf.encode(model, other), other)
    assert result.recognised == pytest.approx(tdf.recognition(*evidence, (0.3, 0.1, 0.1)))


@pytest.mark.slow
@pytest.mark.parametrize(("weights", "shown", "category", "doubted"), [
    ("mug", "mug", "mug", False),
    ("mug", "mug", "bottle", True),
    ("multi", "bottle", "bottle", False),
    ("multi", "bottle", "mug", True),  # it knows both
])  # fmt: skip
def test_imitate_warns_of_another_category(weights, shown, category, doubted):
    case, target = generated_case(shown, 0, 1), generated_case(category, 0, 1)
    demonstration = place_demonstration(case, "line", 2, tdf.box_query(KEY, 128, QUERY_SIZE))
    with warnings.catch_warnings(record=True) as issued:
        warnings.simplefilter("always", tdf.CategoryWarning)
        result = tdf.imitate(tdf.load_model(weights), demonstration, target.points_b, key=KEY, fix_last=False)
    assert (result.recognised < 0.05) if doubted else (result.recognised > 0.8)
    assert len(issued) == doubted
