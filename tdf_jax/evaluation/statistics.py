"""What errors over many cases amount to: medians, success rates and how sure they are."""

from collections.abc import Mapping, Sequence

import numpy as np
from jaxtyping import Float

from tdf_jax.evaluation.cases import Case
from tdf_jax.evaluation.metrics import FLIP_DEGREES
from tdf_jax.geometry.symmetry import FOLDS

THRESHOLDS = {"5mm_5deg": (0.005, 5.0), "1cm_10deg": (0.01, 10.0), "2cm_20deg": (0.02, 20.0)}  # metres, degrees
RESAMPLES = 2000  # of the bootstrap


def summary(
    distance: Float[np.ndarray, " cases"],
    angle: Float[np.ndarray, " cases"],
    ious: Mapping[str, Sequence[float | None]],
    cases: Sequence[Case],
    seed: int = 0,
    tilt: Float[np.ndarray, " cases"] | None = None,
) -> dict:
    """Medians, 90th percentiles, success rates with 95 % bootstrap intervals over objects, and flips.

    Poses of one object are not independent: whole objects are drawn, each with all of its poses.

    Args:
        distance: position errors, metres.
        angle: rotation errors, degrees.
        ious: by name; None where there is none.
        cases: what the errors are of.
        seed: of the bootstrap.
        tilt: of the place's upright axis, degrees; of symmetric objects an error of this alone tells who stands right
            but turned.

    Returns:
        Plain numbers by name; None for an IoU where no case has one, and for the intervals of a single object. Under
        "by_symmetry" success rates and IoUs of the objects of each symmetry.
    """
    share = distance / [case.diagonal for case in cases]
    known = {name: [iou for iou in several if iou is not None] for name, several in ious.items()}
    names = list(dict.fromkeys(case.instance for case in cases))
    member = np.array([names.index(case.instance) for case in cases])
    drawn = np.random.default_rng(seed).choice(len(names), (RESAMPLES, len(names)))
    row = {
        "cases": len(cases),
        "objects": len(names),
        **{name: float(np.mean(several)) if several else None for name, several in known.items()},
        "iou_cases": max(map(len, known.values())),
        "position_median_cm": 100 * float(np.median(distance)),
        "position_p90_cm": 100 * float(np.percentile(distance, 90)),
        "position_median_diagonals": float(np.median(share)),
        "position_p90_diagonals": float(np.percentile(share, 90)),
        "rotation_median_deg": float(np.median(angle)),
        "rotation_p90_deg": float(np.percentile(angle, 90)),
        "flips": int(np.sum(angle > FLIP_DEGREES)),
    }
    for name, (metres, degrees) in THRESHOLDS.items():
        hit = (distance <= metres) & (angle <= degrees)
        hits, tries = np.bincount(member, hit), np.bincount(member)
        rates = hits[drawn].sum(axis=1) / tries[drawn].sum(axis=1)
        row[f"success_{name}"] = float(hit.mean())
        row[f"interval_{name}"] = [float(x) for x in np.percentile(rates, (2.5, 97.5))] if len(names) > 1 else None
    return row | {"by_symmetry": _by_symmetry(distance, angle, ious, cases, tilt)}


def _by_symmetry(distance, angle, ious, cases, tilt) -> dict:
    """The rates and IoUs of objects of each symmetry alone, by its name."""
    folds, parts = np.array([case.fold for case in cases]), {}
    for fold, name in FOLDS.items():
        chosen = folds == fold
        if not chosen.any():
            continue
        known = {
            key: [iou for iou, kept in zip(several, chosen) if kept and iou is not None]
            for key, several in ious.items()
        }
        parts[name] = {"cases": int(chosen.sum())} | {
            key: float(np.mean(several)) if several else None for key, several in known.items()
        }
        for threshold, (metres, degrees) in THRESHOLDS.items():
            parts[name][f"success_{threshold}"] = float(
                np.mean((distance[chosen] <= metres) & (angle[chosen] <= degrees))
            )
        metres, degrees = THRESHOLDS["2cm_20deg"]
        upright = None if tilt is None else float(np.mean((distance[chosen] <= metres) & (tilt[chosen] <= degrees)))
        parts[name]["success_axis_2cm_20deg"] = upright
    return parts
