"""Recognition of objects of another category: how often `CategoryWarning` is right, and how its curve is fitted.

Every case has a demonstration at the usual place of an unseen generated object. The target of a right case is another
object of that category; the target of a wrong case is of another category. The clouds of the targets are in turn
complete, seen by one camera, seen by two, and 300 noisy points. In half of the cases, four by four, both objects have
the common size of their category; in the others each has its own, as it was drawn.

    python -m tdf_jax.evaluation.recognition_study --weights mug --seed 15

With `--task` the targets of a relation are recognised instead: the evidence is the residual of the contact region and
the surface logit of the target.

    python -m tdf_jax.evaluation.recognition_study --task bowl_on_mug --seed 15
"""

import argparse
import functools
import json
import warnings
from collections.abc import Callable, Sequence

import jax
import numpy as np
from jaxtyping import Float, Int

from tdf_jax._internal.errors import TdfWarning
from tdf_jax.energy.reference import Reference, describe
from tdf_jax.energy.residual import pick_residual
from tdf_jax.evaluation.cases import QUERIES, QUERY_SIZE, generated_case, place_demonstration
from tdf_jax.evaluation.records import header, write_record
from tdf_jax.evaluation.relation_scores import DEMONSTRATIONS, FIRST_DEMONSTRATION
from tdf_jax.evaluation.relation_tasks import RELATIONS, demonstrate, draw_pair
from tdf_jax.evaluation.study_command import at_least, file_to_write
from tdf_jax.geometry.query import box_query
from tdf_jax.imitation import imitate
from tdf_jax.networks.checkpoint import load_model
from tdf_jax.networks.encoding import encode
from tdf_jax.networks.model import Model
from tdf_jax.relation.regions import distinct_contacts
from tdf_jax.shapes import FAMILIES
from tdf_jax.solvers.pick import CarryConfig
from tdf_jax.uncertainty.calibration import CURVES, TARGET_CURVES, logistic, ranking, recognition, surface_logit

# Categories of the weights whose curves are fitted; the objects of another category are drawn from them.
CATEGORIES = ("mug", "bowl", "bottle")
CLOUDS = ("full", "views1", "views2", "noise")
LEVELS = (0.05, 0.25, 0.5, 0.75, 0.95)  # probabilities below which an object counts as of another category


def has_natural_size(index: int) -> bool:
    """Whether the objects of a case have their own sizes.

    Args:
        index: number of the case.
    """
    return index // len(CLOUDS) % 2 == 1


def evidence(model: Model, category: str, seed: int, index: int, right: bool) -> tuple[float, float]:
    """Residual and surface logit of one case.

    Args:
        model: the network.
        category: category of the demonstration.
        seed: seed of the cases.
        index: number of the case.
        right: whether the target is of that category.
    """
    clouds, natural = CLOUDS[index % len(CLOUDS)], has_natural_size(index)
    others = [name for name in CATEGORIES if name != category]
    other = category if right else others[index // (2 * len(CLOUDS)) % len(others)]
    case, target = (generated_case(name, seed, index, clouds=clouds, natural=natural) for name in (category, other))
    demonstration = place_demonstration(case, "line", 2, box_query(jax.random.key(seed), QUERIES, QUERY_SIZE))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", TdfWarning)
        points = jax.device_put(target.points_b)
        result = imitate(model, demonstration, points, key=jax.random.key(index), fix_last=False)
    return float(result.residual), surface_logit(encode(model, points), points)


@functools.cache
def _described(task: str, number: int, seed: int, object_model: Model, target_model: Model) -> Reference:
    pair = draw_pair(task, seed, FIRST_DEMONSTRATION + number)
    return describe(object_model, demonstrate(pair, seed), target_model=target_model)


def target_evidence(models: tuple[Model, Model], task: str, seed: int, index: int, right: bool) -> tuple[float, float]:
    """Residual of the contact region and surface logit of one target.

    Args:
        models: networks of the object and of the target.
        task: name in `RELATIONS`.
        seed: seed of the cases.
        index: number of the case.
        right: whether the target is of the category of the task's targets.
    """
    category, clouds = RELATIONS[task].target, CLOUDS[index % len(CLOUDS)]
    others = [name for name in FAMILIES if name != category]
    name = category if right else others[index // len(CLOUDS) % len(others)]
    points = jax.device_put(generated_case(name, seed, index, clouds=clouds, natural=True).points_b)
    contact = _described(task, index % DEMONSTRATIONS, seed, *models).contact
    assert contact is not None and contact.target_descriptors is not None and contact.T_target_contact is not None
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", TdfWarning)
        field = encode(models[1], points)
    key = jax.random.key(index)
    region = contact.target_descriptors, contact.T_target_contact, contact
    _, energies = distinct_contacts("recognition_study", "target", field, *region, key, CarryConfig())
    return pick_residual(float(energies[0]), contact.target_descriptors), surface_logit(field, points)


def collected(
    case: Callable[[int, bool], tuple[float, float]], name: str, count: int
) -> tuple[Float[np.ndarray, "cases 2"], Float[np.ndarray, " cases"], Int[np.ndarray, " cases"]]:
    """Evidence of right and wrong cases.

    Args:
        case: the evidence of a case, from its number and whether it is a right one.
        name: name of the cases, which is printed.
        count: number of right cases, and of wrong ones.

    Returns:
        Residuals and surface logits, (cases, 2); 1 for right cases, (cases,); numbers of the cases, (cases,).
    """
    rows, right = [], []
    for index in range(count):
        for is_right in (True, False):
            rows.append(case(index, is_right))
            right.append(float(is_right))
        print(f"{name}: {index + 1} of {count}", end="\r", flush=True)
    print()
    return np.array(rows), np.array(right), np.arange(len(right)) // 2


def features(rows: Float[np.ndarray, "cases 2"]) -> Float[np.ndarray, "cases 2"]:
    """Features of the logistic curve: -log(residual) and the surface logit."""
    return np.column_stack([-np.log(rows[:, 0]), rows[:, 1]])


def summary(
    rows: Float[np.ndarray, "cases 2"],
    right: Float[np.ndarray, " cases"],
    numbers: Int[np.ndarray, " cases"],
    curve: Float[np.ndarray, "3"],
    by_size: bool = True,
) -> dict:
    """The area under the ROC of a curve and of the residual alone, and rates at all `LEVELS`, by size too.

    Args:
        rows: residuals and surface logits, (cases, 2).
        right: 1 for right cases, (cases,).
        numbers: numbers of the cases, (cases,).
        curve: intercept and both slopes, (3,).
        by_size: whether half of the objects have the common size of their category.
    """
    intercept, slope, logit_slope = map(float, curve)
    predicted = np.array(
        [recognition(float(residual), float(logit), (intercept, slope, logit_slope)) for residual, logit in rows]
    )
    natural = np.array([has_natural_size(int(number)) for number in numbers])
    areas = {"area": ranking(predicted, right), "area_of_the_residual_alone": ranking(-rows[:, 0], right)}
    kinds = numbers % len(CLOUDS)
    by_cloud = {name: ranking(predicted[kinds == kind], right[kinds == kind]) for kind, name in enumerate(CLOUDS)}
    sizes = {"common": ~natural, "natural": natural}
    record = {"cases": len(right), **areas, "area_by_cloud": by_cloud, "thresholds": _rates(predicted, right)}
    if by_size:
        rates = {name: _rates(predicted[these], right[these]) for name, these in sizes.items() if these.any()}
        record["thresholds_by_size"] = rates
    return record


def _rates(predicted: np.ndarray, right: np.ndarray) -> dict:
    return {
        str(level): {
            "wrong_doubted": float(np.mean(predicted[right == 0] < level)),
            "right_doubted": float(np.mean(predicted[right == 1] < level)),
        }
        for level in LEVELS
    }


def main(arguments: Sequence[str] | None = None) -> None:
    """Collect evidence, evaluate or fit the curve, and print the record.

    Args:
        arguments: words of the command line; by default those of the process.
    """
    parser = argparse.ArgumentParser(
        prog="python -m tdf_jax.evaluation.recognition_study",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument(
        "--weights", default=None, help="a name of shipped weights, or a .safetensors file (default: mug)"
    )
    parser.add_argument(
        "--category",
        choices=list(FAMILIES),
        nargs="+",
        default=None,
        help="categories of the demonstrations (default: mug)",
    )
    parser.add_argument(
        "--task", choices=list(RELATIONS), help="recognise the targets of a relation; the weights are those of the task"
    )
    parser.add_argument("--seed", type=at_least(0), default=0, help="seed of the cases")
    parser.add_argument(
        "--count", type=at_least(1), default=100, help="right cases, and as many wrong ones, of each category"
    )
    parser.add_argument(
        "--fit", action="store_true", help="fit the curve to these cases, instead of evaluating that of the weights"
    )
    parser.add_argument("--out", type=file_to_write, help="JSON file for the record")
    options = parser.parse_args(arguments)
    if options.task is not None and (options.weights is not None or options.category is not None):
        parser.error("--task has weights and categories of its own; drop --weights and --category")
    if options.task is None:
        model, curves, names = load_model(options.weights or "mug"), CURVES, options.category or ["mug"]
        cases = [functools.partial(evidence, model, name, options.seed) for name in names]
    else:
        relation, curves, names = RELATIONS[options.task], TARGET_CURVES, [options.task]
        models = load_model(relation.object), load_model(relation.target)
        model, cases = models[1], [functools.partial(target_evidence, models, options.task, options.seed)]
    if not options.fit and model.info.name not in curves:
        parser.error(f"the weights {model.info.name} have no curve; expected one of {', '.join(curves)}, or --fit")
    parts = [collected(case, name, options.count) for case, name in zip(cases, names, strict=True)]
    rows, right, numbers = (np.concatenate(column) for column in zip(*parts))
    curve = logistic(features(rows), right) if options.fit else np.array(curves[model.info.name])
    settings = {name: value for name, value in vars(options).items() if name != "out"}
    record = (
        header(settings, model)
        | {"curve": [float(x) for x in curve]}
        | summary(rows, right, numbers, curve, options.task is None)
    )
    record["categories"] = {name: summary(*part, curve, options.task is None) for name, part in zip(names, parts)}
    print(json.dumps(record, indent=1))
    if options.out is not None:
        write_record("recognition_study", options.out, record)


if __name__ == "__main__":
    main()
