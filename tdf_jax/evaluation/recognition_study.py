"""Whether objects of a wrong category are noticed: python -m tdf_jax.evaluation.recognition_study --weights mug.

Every case has a demonstration at the usual place of an unseen generated object. A right one is imitated on another
object of that category, a wrong one on an object of another; the target is seen in turn complete, by one camera, by
two, and as 300 noisy points.
"""

import argparse
import json
import warnings
from pathlib import Path

import jax
import numpy as np

from tdf_jax._internal.errors import CategoryWarning
from tdf_jax.evaluation.cases import generated_case
from tdf_jax.evaluation.pick_transfer import QUERIES, QUERY_SIZE
from tdf_jax.evaluation.scene import place_demonstration
from tdf_jax.geometry.query import box_query
from tdf_jax.imitation import imitate
from tdf_jax.networks.checkpoint import load_model
from tdf_jax.networks.encoding import encode
from tdf_jax.networks.model import Model
from tdf_jax.shapes import FAMILIES
from tdf_jax.uncertainty.calibration import CURVES, logistic, ranking, recognition, surface_logit

CLOUDS = ("full", "views1", "views2", "noise")
THRESHOLDS = (0.05, 0.25, 0.5, 0.75, 0.95)


def evidence(model: Model, category: str, seed: int, index: int, right: bool) -> tuple[float, float]:
    """Residual and surface logit of one case."""
    clouds, others = CLOUDS[index % len(CLOUDS)], [name for name in FAMILIES if name != category]
    shown = generated_case(category, seed, index, clouds=clouds)
    target = shown if right else generated_case(others[index // len(CLOUDS) % len(others)], seed, index, clouds=clouds)
    demonstration = place_demonstration(shown, "line", 2, box_query(jax.random.key(seed), QUERIES, QUERY_SIZE))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", CategoryWarning)
        result = imitate(model, demonstration, target.points_b, key=jax.random.key(index), fix_last=False)
    return result.residual, surface_logit(encode(model, target.points_b), target.points_b)


def collected(model: Model, category: str, seed: int, count: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Evidence (2 count, 2), whether the object was of the category, and the number of its cloud in `CLOUDS`, both (2 count,)."""
    rows, right = [], []
    for index in range(count):
        for is_right in (True, False):
            rows.append(evidence(model, category, seed, index, is_right))
            right.append(float(is_right))
        print(f"{category}, seed {seed}: {index + 1} of {count}", end="\r", flush=True)
    print()
    return np.array(rows), np.array(right), np.arange(len(right)) // 2 % len(CLOUDS)


def features(rows: np.ndarray) -> np.ndarray:
    return np.column_stack([-np.log(rows[:, 0]), rows[:, 1]])


def report(rows: np.ndarray, right: np.ndarray, seen: np.ndarray, curve) -> dict:
    """The area under the ROC and points of it, of the curve and of the residual alone."""
    predicted = np.array([recognition(*row, tuple(curve)) for row in rows])
    points = {
        str(one): {
            "wrong_noticed": float(np.mean(predicted[right == 0] < one)),
            "right_doubted": float(np.mean(predicted[right == 1] < one)),
        }
        for one in THRESHOLDS
    }
    areas = {"area": ranking(predicted, right), "area_of_the_residual_alone": ranking(-rows[:, 0], right)}
    by_cloud = {name: ranking(predicted[seen == kind], right[seen == kind]) for kind, name in enumerate(CLOUDS)}
    return {"cases": len(right), **areas, "area_by_cloud": by_cloud, "thresholds": points}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--weights", default="mug")
    parser.add_argument("--category", choices=list(FAMILIES), nargs="+", default=["mug"])
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--count", type=int, default=100, help="right cases, and as many wrong ones, of each category")
    parser.add_argument(
        "--fit", action="store_true", help="fit the curve to these cases, instead of trying that of the weights"
    )
    parser.add_argument("--out", type=Path, help="JSON file")
    settings = parser.parse_args()
    if settings.count < 1:
        parser.error(f"--count is {settings.count}; expected at least 1")
    model = load_model(settings.weights)
    if not settings.fit and model.info.name not in CURVES:
        parser.error(
            f"--weights is {settings.weights}, which has no curve; expected one of {', '.join(CURVES)}, or --fit"
        )
    parts = [collected(model, category, settings.seed, settings.count) for category in settings.category]
    rows, right, seen = (np.concatenate(column) for column in zip(*parts))
    curve = logistic(features(rows), right) if settings.fit else CURVES[model.info.name]
    found = {"weights": model.info.name, "seed": settings.seed, "curve": [float(x) for x in curve]} | report(
        rows, right, seen, curve
    )
    found["categories"] = {category: report(*part, curve) for category, part in zip(settings.category, parts)}
    print(json.dumps(found, indent=1))
    if settings.out is not None:
        settings.out.write_text(json.dumps(found, indent=1) + "\n")


if __name__ == "__main__":
    main()
