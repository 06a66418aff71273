"""Statistics of errors over many cases: the success thresholds, and bootstrap intervals over objects."""

from collections.abc import Hashable, Sequence
from typing import Literal, NamedTuple

import numpy as np
from jaxtyping import Bool, Float

RESAMPLES = 2000  # number of resamples of the bootstrap
INTERVAL = (2.5, 97.5)  # percentiles of a 95 % interval


class Threshold(NamedTuple):
    """A pose succeeds if both of its errors are within the bounds.

    Attributes:
        metres: largest position error.
        degrees: largest rotation error.
    """

    metres: float
    degrees: float

    def holds(self, distance, angle) -> Bool[np.ndarray, "..."]:
        """Whether errors are within the bounds.

        Args:
            distance: position errors, any shape, metres.
            angle: rotation errors, same shape, degrees.
        """
        return np.logical_and(np.asarray(distance) <= self.metres, np.asarray(angle) <= self.degrees)

    def label(self, degree: str = " deg") -> str:
        """The bounds in words, such as "2 cm, 20 deg"."""
        length = f"{1000 * self.metres:g} mm" if self.metres < 0.01 else f"{100 * self.metres:g} cm"
        return f"{length}, {self.degrees:g}{degree}"


THRESHOLDS = {
    "5mm_5deg": Threshold(0.005, 5.0),
    "1cm_10deg": Threshold(0.01, 10.0),
    "2cm_20deg": Threshold(0.02, 20.0),
    "5cm_30deg": Threshold(0.05, 30.0),
}
FINE = THRESHOLDS["1cm_10deg"]
SUCCESS = THRESHOLDS["2cm_20deg"]  # a pick beyond these bounds counts as a failure


def percentiles(name: str, values: Float[np.ndarray, " cases"], unit: str) -> dict[str, float]:
    """The median and the 90th percentile of errors, by the names that records use.

    Args:
        name: what the errors are of, the first part of the names.
        values: errors, (cases,).
        unit: their unit, the last part of the names.
    """
    return {
        f"{name}_median_{unit}": float(np.median(values)),
        f"{name}_p90_{unit}": float(np.percentile(values, 90)),
    }


def success_rates(
    distance: Float[np.ndarray, " cases"],
    angle: Float[np.ndarray, " cases"],
    objects: Sequence[Hashable],
    seed: int = 0,
) -> dict[str, float | list[float] | None]:
    """Success rates at all `THRESHOLDS`, with their 95 % bootstrap intervals over objects.

    Args:
        distance: position errors, (cases,), metres.
        angle: rotation errors, (cases,), degrees.
        objects: the object of every case, (cases,).
        seed: seed of the bootstrap.

    Returns:
        By "success_" and the threshold's name the rate, by "interval_" and that name the interval.
    """
    row: dict[str, float | list[float] | None] = {}
    for name, threshold in THRESHOLDS.items():
        hits = threshold.holds(distance, angle)
        row[f"success_{name}"] = float(hits.mean())
        row[f"interval_{name}"] = bootstrap_interval(hits.astype(float), objects, seed=seed)
    return row


def bootstrap_interval(
    values: Float[np.ndarray, " cases"],
    objects: Sequence[Hashable],
    statistic: Literal["mean", "median"] = "mean",
    seed: int = 0,
) -> list[float] | None:
    """95 % bootstrap interval of a mean or a median over objects.

    Cases of one object are not independent. Therefore each resample draws whole objects, with all of their cases.

    Args:
        values: one number of every case, (cases,).
        objects: the object of every case, (cases,).
        statistic: what the interval is of.
        seed: seed of the resamples.

    Returns:
        The lower and the upper end; None for a single object.
    """
    names = list(dict.fromkeys(objects))
    if len(names) < 2:
        return None
    number = {name: index for index, name in enumerate(names)}
    member, values = np.array([number[one] for one in objects]), np.asarray(values, float)
    drawn = np.random.default_rng(seed).choice(len(names), (RESAMPLES, len(names)))
    weights = np.zeros(drawn.shape, int)  # how often each resample has each object
    np.add.at(weights, (np.arange(RESAMPLES)[:, None], drawn), 1)
    if statistic == "mean":
        resampled = (weights @ np.bincount(member, values)) / (weights @ np.bincount(member))
    else:
        resampled = _weighted_medians(values, weights[:, member])
    return [float(end) for end in np.percentile(resampled, INTERVAL)]


def _weighted_medians(values, weights):
    """Medians of values repeated as often as the integer weights say, a row a resample, without repeating them."""
    order = np.argsort(values, kind="stable")
    values, ranks = values[order], np.cumsum(weights[:, order], axis=1)
    total = ranks[:, -1:]
    low, high = (values[np.argmax(ranks > middle, axis=1)] for middle in ((total - 1) // 2, total // 2))
    return (low + high) / 2
