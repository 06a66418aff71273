"""Confidence of a pick and recognition of its object: logistic curves, their fit and their reliability."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Array, Float

from tdf_jax._internal import checks
from tdf_jax._internal.boundary import public
from tdf_jax._internal.errors import InputError
from tdf_jax.energy.residual import surface_logits
from tdf_jax.networks.field import DescriptorField

# Logistic curve in log(residual), fitted on 288 picks with ground truth, 9 of them wrong: `tdf benchmark --seed 61
# --pairs 72 --methods tdf_jax --clouds full views1 views2 noise`, mugs of 0.12 m. Right picks had residuals of 0.08 to
# 0.53 (the 5 % and 95 % quantiles, by condition), wrong picks 0.44 to 0.83. docs/results/uncertainty.md has the
# reliability on other mugs.
INTERCEPT, SLOPE = -3.39, 6.55
FITTED_ON = 61  # seed of the picks
CALIBRATED = ("mug",)  # shipped weights for which the curve is fitted
MAX_CONFIDENCE = 0.99  # none of the 250 surest picks was wrong, which supports no higher probability
EDGES = 0.0, 0.25, 0.5, 0.75, 0.9, 0.98, 1.0  # edges of the bins, which are narrow near 1 because most picks are sure

# Logistic curves in (-log residual, surface logit) by the name of shipped weights: the intercept and two slopes, fitted
# on right and wrong cases of seed 61 by `python -m tdf_jax.evaluation.recognition_study --fit`: 40 of each for mugs, 32
# for bowls and for bottles, 48 for all three; those of mugs and of all three before half of the cases had objects of
# their own sizes. docs/results/uncertainty.md has the results on other cases.
CURVES = {
    "mug": (-2.77, 6.25, 4.76),
    "bowl": (-2.82, 2.91, 2.20),
    "bottle": (-4.99, 5.60, 1.47),
    "multi": (-5.40, 5.28, -0.01),
}
# The same for the contact region on a target, see `tdf_jax.relation`: by the name of the target's weights, fitted by
# `python -m tdf_jax.evaluation.recognition_study --task TASK --fit`, seed 61.
TARGET_CURVES = {"mug": (-1.88, 7.97, 4.80)}
# Logistic curves in the mean logit and the mean absolute logit at the points of a demonstrated target, by the weights
# of the object where they describe the target too: the intercept and two slopes. Fitted on 20 objects of each of the
# five generated categories, seed 820, complete ones and, for mugs, as cameras see them too; all categories but that of
# the weights together weigh as much as it. docs/guide/targets.md has the rates on other objects.
ONE_NETWORK_CURVES = {"mug": (1.38, 4.93, 2.18), "bowl": (15.41, 3.97, -11.32), "bottle": (2.76, 3.21, -1.60)}


@public
def confidence(residual: float, intercept: float = INTERCEPT, slope: float = SLOPE) -> float | None:
    """Probability that a pick is within 2 cm and 20 degrees of the ground truth.

    The default curve is calibrated for the shipped mug weights, demonstrations at the handle with query points in a box
    of 6 cm, and mugs of 0.12 m, complete, noisy or seen by one camera or more. In other cases the value still falls as
    the match gets worse, but it is not a probability; `tdf_jax.uncertainty.calibration.fit` fits another curve.

    Args:
        residual: residual of the pick, such as `result.residual`, without a unit.
        intercept: intercept of the logistic curve in -log(residual).
        slope: slope of the logistic curve in -log(residual).

    Returns:
        The probability, in [0, 0.99]; None if the residual is not finite.

    Raises:
        InputError: an argument is not one number, or the curve is not finite.
    """
    residual = checks.real("confidence()", "residual", residual)
    checks.number("confidence()", "intercept", intercept)
    checks.number("confidence()", "slope", slope)
    if not np.isfinite(residual):
        return None
    return min(MAX_CONFIDENCE, float(1 / (1 + np.exp(slope * np.log(max(residual, 1e-9)) - intercept))))


def confidence_by(weights: str, residual: float) -> float | None:
    """Confidence of a pick where the curve is calibrated for the weights.

    Args:
        weights: name of the weights, `model.info.name`.
        residual: residual of the pick, without a unit.

    Returns:
        The probability, in [0, 0.99]; None if there is no curve for the weights or the residual is not finite.
    """
    return confidence(residual) if weights in CALIBRATED else None


def bins(predicted: Float[np.ndarray, " picks"], right: Float[np.ndarray, " picks"]) -> list[dict]:
    """Reliability of confidences: how many picks are right in each bin of `EDGES`.

    Args:
        predicted: confidences of the picks, (picks,).
        right: 1 for each right pick and 0 for each wrong one, (picks,).

    Returns:
        For each bin that is not empty, by rising confidence: the number of picks, the mean confidence, the share of
        right picks and its 95 % interval (Wilson).
    """
    number = np.searchsorted(EDGES[1:-1], predicted, side="right")
    rows = []
    for chosen in (number == one for one in range(len(EDGES) - 1)):
        n, z = int(chosen.sum()), 1.96
        if n == 0:
            continue
        rate = float(right[chosen].mean())
        centre, half = rate + z**2 / (2 * n), z * np.sqrt(rate * (1 - rate) / n + z**2 / (4 * n**2))
        low, high = ((centre + sign * half) / (1 + z**2 / n) for sign in (-1, 1))
        rows.append(
            {
                "picks": n,
                "predicted": float(predicted[chosen].mean()),
                "right": rate,
                "interval": [float(min(low, rate)), float(max(high, rate))],
            }
        )
    return rows


def calibration_error(rows: Sequence[dict]) -> float:
    """Expected calibration error: mean difference of confidence and share of right picks.

    Args:
        rows: bins from `bins`; each one is weighted by its number of picks.

    Returns:
        The error, in [0, 1].
    """
    total = sum(row["picks"] for row in rows)
    return float(sum(row["picks"] * abs(row["predicted"] - row["right"]) for row in rows) / total)


def ranking(predicted: Float[np.ndarray, " picks"], right: Float[np.ndarray, " picks"]) -> float | None:
    """Area under the ROC curve: share of pairs in which a right pick has a higher confidence than a wrong one.

    Args:
        predicted: confidences of the picks, (picks,).
        right: 1 for each right pick and 0 for each wrong one, (picks,).

    Returns:
        The area, in [0, 1]; None without both a right and a wrong pick.
    """
    good, bad = predicted[right == 1], predicted[right == 0]
    if not len(good) or not len(bad):
        return None
    return float(np.mean((good[:, None] > bad) + 0.5 * (good[:, None] == bad)))


def logistic(
    features: Float[np.ndarray, "cases features"], right: Float[np.ndarray, " cases"]
) -> Float[np.ndarray, " 1+features"]:
    """Fit a logistic curve by maximum likelihood, with Newton's method.

    Args:
        features: features of each case, (cases, features).
        right: 1 or 0 for each case, (cases,).

    Returns:
        The intercept and the slopes, (1 + features,).
    """
    x = np.column_stack([np.ones(len(features)), features])
    weights = np.zeros(x.shape[1])
    for _ in range(100):
        p = 1 / (1 + np.exp(-x @ weights))
        # A weak L2 penalty makes the solution finite if a line separates right from wrong cases.
        step = np.linalg.solve(
            x.T @ (x * (p * (1 - p))[:, None]) + 1e-3 * np.eye(len(weights)), x.T @ (right - p) - 1e-3 * weights
        )
        weights += step
        if np.abs(step).max() < 1e-9:
            break
    return weights


def fit(residual: Float[np.ndarray, " picks"], right: Float[np.ndarray, " picks"]) -> tuple[float, float]:
    """Fit the curve of `tdf_jax.confidence` by maximum likelihood.

    Args:
        residual: residuals of the picks, (picks,), without a unit.
        right: 1 for each right pick and 0 for each wrong one, (picks,).

    Returns:
        The intercept and the slope.

    Raises:
        InputError: a residual is not above 0, or the picks are all right or all wrong.
    """
    residual, right = np.asarray(residual, float), np.asarray(right, float)
    if not (np.isfinite(residual) & (residual > 0)).all() or len(set(right)) != 2:
        raise InputError(
            f"fit(): got {residual.size} residuals and labels {sorted(set(right.ravel().tolist()))}; expected finite "
            "residuals above 0, and labels 0 and 1, both of them"
        )
    intercept, slope = logistic(-np.log(residual)[:, None], right)
    return float(intercept), float(slope)


@public
def surface_logit(field: DescriptorField, points: Float[Array, "points 3"]) -> float:
    """Mean logit of the occupancy at an object's own points, each clipped to [-3, 3].

    For an object of a category that the network knows, the points lie on the predicted surface of occupancy 1/2, logit
    0. For other objects they lie outside of it.

    Args:
        field: descriptor field of the object.
        points: object point cloud, (points, 3), metres, world frame; 1500 points, drawn with a fixed seed, are used of
            a larger one.

    Returns:
        The mean logit, in [-3, 3].
    """
    return float(np.mean(surface_logits(field, points)))


@public
def recognition(
    residual: float, surface_logit: float, curve: tuple[float, float, float] = CURVES["mug"]
) -> float | None:
    """Probability that an object is of the demonstration's category, with a prior probability of one half.

    The default curve is fitted for the shipped mug weights: mugs against bowls and bottles, demonstrated at the handle
    with query points in a box of 6 cm, complete, noisy or seen by one camera or more.

    Args:
        residual: residual of the pick, such as `result.residual`, without a unit.
        surface_logit: mean occupancy logit at the object's points, from `tdf_jax.surface_logit`.
        curve: intercept of the logistic curve, and its slopes in -log(residual) and in the surface logit, (3,).

    Returns:
        The probability, in [0, 1]; None if the residual or the logit is not finite.

    Raises:
        InputError: the residual or the logit is not one number, or the curve is not three finite numbers.
    """
    coefficients = checks.vector("recognition()", "curve", curve, unit="")
    residual = checks.real("recognition()", "residual", residual)
    surface_logit = checks.real("recognition()", "surface_logit", surface_logit)
    if not np.isfinite([residual, surface_logit]).all():
        return None
    exponent = np.dot(coefficients, (1.0, -np.log(max(residual, 1e-9)), surface_logit))
    return float(1 / (1 + np.exp(-np.clip(exponent, -50, 50))))
