"""How likely a pick is right, from how much of the demonstration's descriptors it leaves unmatched."""

from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from tdf_jax._internal.errors import InputError
from tdf_jax.networks.field import DescriptorField

# Logistic in log(residual), fitted on 288 picks whose truth is known, 9 of them wrong: `tdf benchmark --seed 61 --pairs
# 72 --methods tdf_jax --clouds full views1 views2 noise`, mugs of 0.12 m. Right picks had residuals of 0.08 to 0.53
# (all but 5 % on either side, by condition), wrong ones 0.44 to 0.83. docs/results/uncertainty.md has the reliability on others.
INTERCEPT, SLOPE = -3.39, 6.55
FITTED_ON = 61  # seed
CALIBRATED = ("mug",)  # shipped weights that it was fitted for
MOST = 0.99  # none of the 250 surest was wrong, and no more than that can be known from so many


def confidence(residual: float, intercept: float = INTERCEPT, slope: float = SLOPE) -> float | None:
    """Probability that a pick with a residual is within 2 cm and 20 degrees of the truth.

    By default it is calibrated for the shipped mug weights, demonstrations at the handle with query points in a box of
    6 cm, and mugs of 0.12 m, complete, noisy or seen by one camera or more. Elsewhere it still falls as the match gets
    worse, but is no probability; `tdf_jax.uncertainty.calibration.fit` fits the two numbers anew.

    Args:
        residual: of the pick, such as `result.residual`.
        intercept, slope: of the logistic curve in -log(residual).

    Returns:
        A number in [0, 0.99]; None for a residual that is not finite.
    """
    if not np.isfinite(residual):
        return None
    return min(MOST, float(1 / (1 + np.exp(slope * np.log(max(residual, 1e-9)) - intercept))))


EDGES = 0.0, 0.25, 0.5, 0.75, 0.9, 0.98, 1.0  # of bins: most picks are sure


def bins(predicted: Float[np.ndarray, " picks"], right: Float[np.ndarray, " picks"]) -> list[dict]:
    """Picks in bins of `EDGES`, by rising confidence.

    Args:
        predicted: confidences.
        right: 1 where the pick was, else 0.

    Returns:
        For each bin that is not empty the number of picks, the mean confidence, the share that was right and its 95 %
        interval (Wilson).
    """
    number = np.searchsorted(EDGES[1:-1], predicted, side="right")
    rows = []
    for chosen in (number == one for one in range(len(EDGES) - 1)):
        n, z = int(chosen.sum()), 1.96
        if n == 0:
            continue
        rate = float(right[chosen].mean())
        middle, half = rate + z**2 / (2 * n), z * np.sqrt(rate * (1 - rate) / n + z**2 / (4 * n**2))
        low, high = ((middle + sign * half) / (1 + z**2 / n) for sign in (-1, 1))
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
    """Mean difference of confidence and share of right picks over bins, weighted by their numbers (expected calibration error)."""
    total = sum(row["picks"] for row in rows)
    return float(sum(row["picks"] * abs(row["predicted"] - row["right"]) for row in rows) / total)


def ranking(predicted: Float[np.ndarray, " picks"], right: Float[np.ndarray, " picks"]) -> float | None:
    """Share of pairs of a right and a wrong pick of which the right one has the higher confidence (area under the ROC); None without both kinds."""
    good, bad = predicted[right == 1], predicted[right == 0]
    if not len(good) or not len(bad):
        return None
    return float(np.mean((good[:, None] > bad) + 0.5 * (good[:, None] == bad)))


def logistic(
    features: Float[np.ndarray, "cases features"], right: Float[np.ndarray, " cases"]
) -> Float[np.ndarray, " 1+features"]:
    """Intercept and slopes of the logistic curve of maximal likelihood, by Newton's method.

    Args:
        features: of each case.
        right: 1 or 0.
    """
    x = np.column_stack([np.ones(len(features)), features])
    weights = np.zeros(x.shape[1])
    for _ in range(100):
        p = 1 / (1 + np.exp(-x @ weights))
        # A faint pull to zero keeps it finite where right and wrong do not overlap.
        step = np.linalg.solve(
            x.T @ (x * (p * (1 - p))[:, None]) + 1e-3 * np.eye(len(weights)), x.T @ (right - p) - 1e-3 * weights
        )
        weights += step
        if np.abs(step).max() < 1e-9:
            break
    return weights


def fit(residual: Float[np.ndarray, " picks"], right: Float[np.ndarray, " picks"]) -> tuple[float, float]:
    """Intercept and slope of `tdf_jax.confidence` of maximal likelihood.

    Args:
        residual: of picks.
        right: 1 where the pick was, else 0.

    Raises:
        InputError: a residual that is not above 0, or picks that are all right or all wrong.
    """
    residual, right = np.asarray(residual, float), np.asarray(right, float)
    if not (np.isfinite(residual) & (residual > 0)).all() or len(set(right)) != 2:
        raise InputError("fit(): expected residuals above 0, some of picks that were right and some of others")
    intercept, slope = logistic(-np.log(residual)[:, None], right)
    return float(intercept), float(slope)


POINTS = 1500  # of the cloud that are looked at: one size, so that clouds of all sizes run one program
CUT = 3.0  # occupancy logits beyond it count no further: a few stray points must not decide


# Logistic in (-log residual, surface logit), by name of shipped weights: intercept and two slopes, fitted on right and
# wrong cases of seed 61 by `python -m tdf_jax.evaluation.recognition_study --fit`: 40 of each for mugs, 32 for bowls and for bottles, 48
# for all three. Tried on others: docs/results/uncertainty.md.
CURVES = {
    "mug": (-2.77, 6.25, 4.76),
    "bowl": (-28.5, 16.9, -2.35),
    "bottle": (-20.1, 16.7, 1.18),
    "multi": (-5.40, 5.28, -0.01),
}


def surface_logit(field: DescriptorField, points: Float[Array, "points 3"]) -> float:
    """Mean logit of the occupancy at an object's own points, each cut to [-3, 3].

    Points of an object that the network knows lie on its surface of occupancy 1/2, logit 0; of others they come to lie
    outside.

    Args:
        field: the object's.
        points: its cloud, metres, world frame; of more than 1500, as many drawn by a fixed seed are used.
    """
    points = np.asarray(points, np.float32)
    if len(points) > POINTS:
        points = points[np.random.default_rng(0).permutation(len(points))[:POINTS]]
    return float(np.mean(_logits(field, np.resize(points, (POINTS, 3)))[: len(points)]))


@jax.jit
def _logits(field, x):
    occupancy = field.occupancy(x)
    return jnp.clip(jnp.log(occupancy) - jnp.log1p(-occupancy), -CUT, CUT)


def recognition(
    residual: float, surface_logit: float, curve: tuple[float, float, float] = CURVES["mug"]
) -> float | None:
    """Probability that an object is of the category of a demonstration, if both were equally likely before.

    By default it is fitted for the shipped mug weights: mugs against bowls and bottles, demonstrated at the handle with
    query points in a box of 6 cm, complete, noisy or seen by one camera or more.

    Args:
        residual: what the pick leaves unmatched, see `tdf_jax.confidence`.
        surface_logit: see there.
        curve: intercept of the logistic curve, and its slopes in -log(residual) and in the surface logit.

    Returns:
        A number in [0, 1]; None for evidence that is not finite.

    Raises:
        InputError: the curve is not three finite numbers.
    """
    if np.shape(curve) != (3,) or not np.isfinite(curve).all():
        raise InputError(
            f"recognition(): curve is {curve!r}; expected three finite numbers, such as those of tdf_jax.uncertainty.calibration.CURVES"
        )
    if not np.isfinite([residual, surface_logit]).all():
        return None
    exponent = np.dot(curve, (1.0, -np.log(max(residual, 1e-9)), surface_logit))
    return float(1 / (1 + np.exp(-np.clip(exponent, -50, 50))))
