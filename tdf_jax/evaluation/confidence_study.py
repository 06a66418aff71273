"""Reliability of the confidence of picks, by weights, category and place, and the fit of its curve.

The clouds of the new objects are in turn complete, seen by one camera and by two, of 300 noisy points, and of one depth
image on a table; objects have their own sizes in half of the rounds. With --hidden come cases whose place one depth
image does not show. A pick is right within 2 cm and 20 degrees of the truth. What is measured is kept in a folder, so
that an interrupted run goes on.

    python -m tdf_jax.evaluation.confidence_study --weights mug --place handle --picks 1000 --seed 0 --out picks
"""

import json
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Float
from tqdm.auto import tqdm

from tdf_jax._internal.cache import kept
from tdf_jax._internal.errors import InputError, TdfWarning
from tdf_jax.evaluation.cases import QUERIES, QUERY_SIZE, Case, generated_case
from tdf_jax.evaluation.pick_transfer import place_errors, place_reference
from tdf_jax.evaluation.statistics import SUCCESS
from tdf_jax.evaluation.study_command import at_least, study_parser
from tdf_jax.evaluation.tables import markdown, percent
from tdf_jax.evaluation.tabletop import SEEN_POINTS
from tdf_jax.geometry.query import box_query
from tdf_jax.imitation import imitate
from tdf_jax.networks.checkpoint import load_model
from tdf_jax.networks.model import Model, fingerprint
from tdf_jax.shapes import FAMILIES
from tdf_jax.uncertainty.calibration import INTERCEPT, SLOPE, calibration_error, confidence, fit, ranking

FORMAT = 2  # format number; raise it when the cases or what is measured change
CLOUDS = ("full", "views1", "views2", "noise", "camera1")
HIDDEN_OF = 100  # pairs that are looked at for one whose place is hidden; of handles, every sixth is
BINS = 10  # of equal numbers of picks
LEAST_OF_FIT = 10  # right and wrong picks that a curve needs at least


class Pick(NamedTuple):
    """What was measured of one pick.

    Attributes:
        clouds: condition of the cloud, one of `CLOUDS`.
        residual: `result.residual`.
        distance, angle: errors, metres and degrees.
        seen: points of the cloud at the place, of 1500; NaN where no camera is modelled.
    """

    clouds: str
    residual: float
    distance: float
    angle: float
    seen: float

    @property
    def right(self) -> bool:
        """Whether the pick is right."""
        return bool(SUCCESS.holds(self.distance, self.angle))


def measure(model: Model, category: str, place: str | None, seed: int, number: int, hidden: bool = False) -> Pick:
    """Pick once.

    Args:
        model: the network.
        category: category of the objects.
        place: name of a frame of the category; None for the one at which demonstrations pick.
        seed: seed of the objects.
        number: number of the pair of objects.
        hidden: take the first of some pairs whose place one depth image does not show, instead of the conditions of
            the cloud in turn.
    """
    if hidden:
        case, number = _hidden_case(category, place, seed, number)
    else:
        clouds, natural = CLOUDS[number % len(CLOUDS)], number // len(CLOUDS) % 2 == 1
        case = generated_case(category, seed, number, place=place, clouds=clouds, natural=natural)
    reference = place_reference(model, case, box_query(jax.random.key(seed), QUERIES, QUERY_SIZE * case.scale))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", TdfWarning)
        result = imitate(model, reference, case.points_b, key=jax.random.key(number), fix_last=False)
    distance, angle = place_errors(np.asarray(result.trajectory.wxyz_xyz[:1]), [case])
    seen = np.nan if case.seen is None else float(case.seen)
    return Pick(case.clouds, float(result.residual), float(distance[0]), float(angle[0]), seen)


def _hidden_case(category: str, place: str | None, seed: int, number: int) -> tuple[Case, int]:
    """The first of pairs number * HIDDEN_OF to (number + 1) * HIDDEN_OF - 1 whose place is hidden, and its number."""
    for index in range(number * HIDDEN_OF, (number + 1) * HIDDEN_OF):
        natural = index % 2 == 1
        case = generated_case(category, seed, index, place=place, clouds="camera1", natural=natural)
        if case.seen is not None and case.seen < SEEN_POINTS:
            return case, index
    raise InputError(
        f"confidence_study: none of {HIDDEN_OF} depth images hides the {place or 'picked place'} of a {category}; "
        "expected a place that can be hidden. Leave out --hidden"
    )


def reliability(
    predicted: Float[np.ndarray, " picks"], right: Float[np.ndarray, " picks"]
) -> list[dict[str, float | int]]:
    """How many picks are right in bins of equal numbers of picks, by rising confidence.

    Args:
        predicted: confidences, (picks,).
        right: 1 for each right pick and 0 for each wrong one, (picks,).

    Returns:
        Of each bin the number of picks, the mean confidence and the share of right picks, as
        `tdf_jax.uncertainty.calibration.calibration_error` takes them.
    """
    parts = np.array_split(np.argsort(predicted, kind="stable"), min(BINS, len(predicted)))
    return [
        {"picks": len(part), "predicted": float(predicted[part].mean()), "right": float(right[part].mean())}
        for part in parts
    ]


def report(picks: Sequence[Pick], curve: tuple[float, float]) -> str:
    """The reliability of a curve on some picks, as Markdown.

    Args:
        picks: the picks.
        curve: intercept and slope, see `tdf_jax.confidence`.
    """
    known = [one for one in picks if np.isfinite(one.residual)]
    predicted = np.array([confidence(one.residual, *curve) for one in known], float)
    right = np.array([one.right for one in known], float)
    rows = reliability(predicted, right)
    table = markdown(
        ["confidence", "picks", "right"],
        [[f"{row['predicted']:.3f}", str(row["picks"]), percent(float(row["right"]))] for row in rows],
    )
    area = ranking(predicted, right)
    lines = [
        f"curve: intercept {curve[0]:.2f}, slope {curve[1]:.2f}",
        f"picks: {len(picks)}, of which {len(picks) - len(known)} found nothing; right: {percent(float(right.mean()))}",
        f"expected calibration error: {calibration_error(rows):.3f}",
        f"a right pick has a higher confidence than a wrong one in {'-' if area is None else percent(area)} of pairs",
    ]
    hidden = np.array([one.seen < SEEN_POINTS for one in known])
    for words, chosen in (("hidden", hidden), ("hidden, wrong", hidden & (right == 0))):
        if chosen.any():
            share = percent(float((predicted[chosen] < 0.5).mean()))
            lines.append(f"place {words}: {int(chosen.sum())} picks, confidence below 0.5 in {share}")
    return "\n".join([*lines, "", table])


def main(arguments: Sequence[str] | None = None) -> None:
    """Measure all picks, and print the reliability.

    Args:
        arguments: words of the command line; by default those of the process.
    """
    parser = study_parser(
        "tdf_jax.evaluation.confidence_study", __doc__, "picks", 1000, "number of picks", "the objects"
    )
    parser.add_argument("--weights", default="mug", help="name or file of the weights (default: mug)")
    parser.add_argument("--category", choices=sorted(FAMILIES), help="category (default: the name of the weights)")
    parser.add_argument("--place", help="frame of the category (default: where demonstrations pick)")
    parser.add_argument(
        "--hidden",
        type=at_least(0),
        default=0,
        help="number of picks more whose place one depth image hides (default: 0)",
    )
    parser.add_argument("--fit", action="store_true", help="fit a curve to these picks, and print its reliability too")
    parser.add_argument("--out", type=Path, required=True, help="folder that keeps the picks")
    settings = parser.parse_args(arguments)
    category = settings.category or settings.weights
    if category not in FAMILIES:
        parser.error(f"--category is not given, and {category!r} is none; expected one of {', '.join(FAMILIES)}")
    try:
        settings.out.mkdir(parents=True, exist_ok=True)
        model = load_model(settings.weights)
        about = ["confidence", FORMAT, fingerprint(model), category, settings.place, settings.seed]
        numbers = [(number, False) for number in range(settings.picks)]
        numbers += [(number, True) for number in range(settings.hidden)]
        picks = [
            kept(
                "confidence_study",
                settings.out,
                [*about, *one],
                lambda one=one: measure(model, category, settings.place, settings.seed, *one)._asdict(),
                lambda arrays: Pick(arrays["clouds"].item(), *(float(arrays[name]) for name in Pick._fields[1:])),
            )
            for one in tqdm(numbers, desc=f"{category}, {settings.place or 'picked place'}")
        ]
    except (InputError, OSError) as error:
        parser.error(str(error))
    if not any(np.isfinite(one.residual) for one in picks):
        parser.error(f"none of the {len(picks)} picks found anything; check --weights and --category")
    print(report(picks[: settings.picks], (INTERCEPT, SLOPE)))
    if settings.hidden:
        print(f"\nplaces that one depth image hides:\n\n{report(picks[settings.picks :], (INTERCEPT, SLOPE))}")
    if settings.fit:
        finite = [one for one in picks if np.isfinite(one.residual)]
        right = np.array([one.right for one in finite], float)
        if min(right.sum(), len(right) - right.sum()) < LEAST_OF_FIT:
            parser.error(f"{int(right.sum())} of {len(right)} picks are right; a fit needs {LEAST_OF_FIT} of each")
        curve = fit(np.array([one.residual for one in finite]), right)
        print(f"\nfitted to these picks, and so no test of it:\n\n{report(picks, curve)}")
        print(json.dumps({"intercept": curve[0], "slope": curve[1]}))


if __name__ == "__main__":
    main()
