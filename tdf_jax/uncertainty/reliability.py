"""Whether confidences are what they say: of picks with a confidence of 0.8, eight in ten ought to be right."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from tdf_jax._internal.errors import InputError

EDGES = 0.0, 0.25, 0.5, 0.75, 0.9, 0.98, 1.0  # of bins: most picks are sure


def bins(predicted: Float[np.ndarray, " picks"], right: Float[np.ndarray, " picks"]) -> list[dict]:
    """Picks in bins of `EDGES`, by rising confidence.

    Args:
        predicted: confidences.
        right: 1 where the pick was, else 0.

    Returns:
        For each bin that is not empty the number of picks, the mean confidence, the share that was right and its 95 % interval (Wilson).
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
        rows.append({"picks": n, "predicted": float(predicted[chosen].mean()), "right": rate, "interval": [float(min(low, rate)), float(max(high, rate))]})
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


def logistic(features: Float[np.ndarray, "cases features"], right: Float[np.ndarray, " cases"]) -> Float[np.ndarray, "1+features"]:
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
        step = np.linalg.solve(x.T @ (x * (p * (1 - p))[:, None]) + 1e-3 * np.eye(len(weights)), x.T @ (right - p) - 1e-3 * weights)
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
