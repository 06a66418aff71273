"""Transfer of one pose at a semantic place: by a network and by baselines, with errors and reconstruction overlaps."""

import dataclasses
import warnings
from collections.abc import Mapping, Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int
from tqdm.auto import tqdm

from tdf_jax._internal import checks
from tdf_jax._internal.errors import CategoryWarning, ConfidenceWarning, ForeignPointsWarning, InputError
from tdf_jax.energy.descriptors import pose_descriptor
from tdf_jax.energy.losses import EnergyWeights
from tdf_jax.energy.reference import Reference
from tdf_jax.evaluation.baselines import METHODS, aligned
from tdf_jax.evaluation.cases import QUERIES, QUERY_SIZE, Case, Transfer
from tdf_jax.evaluation.metrics import FLIP_DEGREES, nearest_place, pose_error
from tdf_jax.evaluation.statistics import SUCCESS, THRESHOLDS, percentiles, success_rates
from tdf_jax.evaluation.tabletop import SEEN_POINTS, moved
from tdf_jax.geometry import se3
from tdf_jax.geometry.query import box_query
from tdf_jax.geometry.symmetry import FOLDS
from tdf_jax.geometry.trajectory import Trajectory
from tdf_jax.imitation import imitate
from tdf_jax.networks.encoding import encode
from tdf_jax.networks.model import Model
from tdf_jax.networks.occupancy import initialise
from tdf_jax.networks.refinement import refine
from tdf_jax.solvers.adam import OptimizeConfig, optimize
from tdf_jax.uncertainty.doubt import DOUBT

OVERLAPS = ("iou", "iou_refined")
UNTRAINED = "random weights"
BASELINES = (UNTRAINED, *METHODS)
ADAM, CARRY = "adam", "carry"
SOLVERS = (ADAM, CARRY)
SIGHTS = ("seen", "hidden")  # parts of a row: the place is seen, or it is not


def transferred(
    model: Model,
    cases: Sequence[Transfer],
    *,
    seed: int = 0,
    config: OptimizeConfig = OptimizeConfig(),
    progress: bool = True,
) -> Float[np.ndarray, "cases 7"]:
    """Transfer the pose at the place in every case; of the starts, the one with the lowest loss counts.

    Args:
        model: the network.
        cases: the transfers.
        seed: seed of the query points and the starts.
        config: settings of the optimiser.
        progress: show a progress bar.

    Returns:
        Estimated poses `wxyz_xyz` of the place on object b, (cases, 7), world frame.
    """
    query_key, start_key = jax.random.split(jax.random.key(seed))
    estimates = []
    for index, case in enumerate(tqdm(cases, desc="transferring", disable=not progress)):
        reference = place_reference(model, case, box_query(query_key, count=QUERIES, size=QUERY_SIZE * case.scale))
        field = encode(model, jax.device_put(case.points_b))
        key = jax.random.fold_in(start_key, index)
        result = optimize(field, reference, key, fix_last=False, energy=EnergyWeights(0.0), config=config)
        estimates.append(result.trajectory.wxyz_xyz[0])
    return np.stack(estimates)


def imitated(
    model: Model, cases: Sequence[Transfer], *, seed: int = 0, progress: bool = True
) -> tuple[Float[np.ndarray, "cases 7"], Float[np.ndarray, " cases"], Int[np.ndarray, " cases"]]:
    """Transfer the pose at the place in every case by `imitate`, with its default settings.

    Args:
        model: the network.
        cases: the transfers.
        seed: seed of the query points and the starts.
        progress: show a progress bar.

    Returns:
        Estimated poses `wxyz_xyz` of the place on object b, (cases, 7), world frame; `result.confidence`, (cases,), NaN
        with weights for which it is not calibrated; and the number of foreign points that were removed, (cases,).
    """
    query_key, start_key = jax.random.split(jax.random.key(seed))
    estimates, confidences, removed = [], [], []
    for index, case in enumerate(tqdm(cases, desc="imitating", disable=not progress)):
        reference = place_reference(model, case, box_query(query_key, count=QUERIES, size=QUERY_SIZE * case.scale))
        with warnings.catch_warnings():  # the record has the numbers
            for kind in (CategoryWarning, ConfidenceWarning, ForeignPointsWarning):
                warnings.simplefilter("ignore", kind)
            result = imitate(model, reference, case.points_b, key=jax.random.fold_in(start_key, index), fix_last=False)
        estimates.append(np.asarray(result.trajectory.wxyz_xyz[0]))
        confidences.append(float(result.confidence))
        removed.append(int(result.foreign_points))
    return np.stack(estimates), np.array(confidences), np.array(removed)


def place_errors(
    estimates: Float[np.ndarray, "cases 7"], cases: Sequence[Transfer]
) -> tuple[Float[np.ndarray, " cases"], Float[np.ndarray, " cases"]]:
    """Errors of estimated poses, from the nearest of the true poses, which are several on a symmetric object.

    Args:
        estimates: poses `wxyz_xyz`, (cases, 7), metres, world frame.
        cases: the transfers.

    Returns:
        Position errors, metres, and rotation errors, degrees, both (cases,).
    """
    truth = _truths(np.asarray(Trajectory(jnp.asarray(estimates)).matrices, float), cases).astype(np.float32)
    distance, angle = pose_error(estimates, se3.pose(truth[:, :3, :3], truth[:, :3, 3]))
    return distance, np.degrees(angle)


def tilts(estimates: Float[np.ndarray, "cases 7"], cases: Sequence[Transfer]) -> Float[np.ndarray, " cases"]:
    """Angles between the z axis of the place as estimated and as it is, (cases,), degrees.

    Args:
        estimates: poses `wxyz_xyz`, (cases, 7), metres, world frame.
        cases: the transfers.
    """
    T_world_estimate = np.asarray(Trajectory(jnp.asarray(estimates)).matrices, float)
    up, true = T_world_estimate[:, :3, 2], _truths(T_world_estimate, cases)[:, :3, 2]
    return np.degrees(np.arctan2(np.linalg.norm(np.cross(up, true), axis=1), np.sum(up * true, axis=1)))


def _truths(T_world_estimate, cases):
    """The true pose of every case that is nearest to its estimate, (cases, 4, 4)."""
    several = zip(T_world_estimate, cases, strict=True)
    return np.stack(
        [nearest_place(case.T_world_b, T, case.T_world_place_b, case.fold, case.others) for T, case in several]
    )


def place_reference(model: Model, case: Transfer, query: Float[Array, "queries 3"]) -> Reference:
    """The demonstration of one pose: the query frame at the place on object a.

    Args:
        model: the network.
        case: the transfer.
        query: query points, (queries, 3), metres, query frame.
    """
    field = encode(model, jax.device_put(case.points_a))
    place = jnp.asarray(case.T_world_place_a, jnp.float32)
    T_world_query = se3.pose(place[:3, :3], place[:3, 3])
    demonstrated = Trajectory(T_world_query[None]).shifted(-field.origin)
    return Reference(_describe(field, T_world_query, query)[None], demonstrated, query)


def overlaps(
    model: Model, cases: Sequence[Case], samples: int = 20_000, seed: int = 0
) -> dict[str, list[float | None]]:
    """Intersection over union of the reconstructed and the true object b, at occupancy 0.5, in every case.

    Args:
        model: the network.
        cases: cases whose objects b are reconstructed, in their world poses.
        samples: number of points, uniform in the bounding box padded by a tenth of the diagonal.
        seed: seed of the points.

    Returns:
        One number for each case as the field was encoded, "iou", and one after `refine`, "iou_refined"; None where the
        mesh of object b is not closed and has no volume.
    """
    rng = np.random.default_rng(seed)
    ious = no_overlaps([])
    for case in cases:
        low, high = case.object_b.mesh.bounds
        pad = 0.1 * case.diagonal
        x = rng.uniform(low - pad, high + pad, (samples, 3))
        true = case.object_b.contains(x)
        measured: dict[str, float | None] = dict.fromkeys(OVERLAPS)
        if true is not None:
            world = moved(x, case.T_world_b).astype(np.float32)
            points = jax.device_put(case.points_b)
            field = encode(model, points)
            for name, shape in zip(OVERLAPS, (field, refine(model, field, points))):
                measured[name] = _overlap(np.asarray(_occupancy(shape, world)) > 0.5, true)
        for name, iou in measured.items():
            ious[name].append(iou)
    return ious


def no_overlaps(cases: Sequence[Case]) -> dict[str, list[float | None]]:
    """What `overlaps` returns for a method that reconstructs nothing."""
    return {name: [None] * len(cases) for name in OVERLAPS}


@dataclasses.dataclass(frozen=True)
class Outcome:
    """Result of one method on some cases.

    Attributes:
        method: name of the method.
        cases: the cases.
        estimates: poses `wxyz_xyz` of the place, (cases, 7), metres, world frame.
        distance: position errors, (cases,), metres.
        angle: rotation errors, (cases,), degrees.
        ious: reconstruction overlaps, see `overlaps`.
        summary: statistics of the errors, see `summary`.
        confidence: `result.confidence`, (cases,); NaN where it is not calibrated, and with other solvers than `carry`.
        removed: number of points that were removed from each cloud as foreign, (cases,); None with other solvers.
    """

    method: str
    cases: Sequence[Case]
    estimates: Float[np.ndarray, "cases 7"]
    distance: Float[np.ndarray, " cases"]
    angle: Float[np.ndarray, " cases"]
    ious: Mapping[str, Sequence[float | None]]
    summary: dict
    confidence: Float[np.ndarray, " cases"]
    removed: Int[np.ndarray, " cases"] | None


def compare(
    cases: Sequence[Case],
    model: Model,
    baselines: Sequence[str] = (),
    *,
    seed: int = 0,
    config: OptimizeConfig = OptimizeConfig(),
    progress: bool = True,
    solver: str = ADAM,
    reconstruct: bool = True,
) -> list[Outcome]:
    """Run a network and baselines on the same cases, each from as many starts.

    Args:
        cases: the transfers.
        model: the network.
        baselines: names of `BASELINES`; their reconstructions, if any, are not measured.
        seed: seed of the query points, the starts and the bootstrap.
        config: settings of the optimiser, and the number of starts of the baselines.
        progress: show progress bars.
        solver: "adam", the optimiser; or "carry", the default of `imitate`, with its own settings.
        reconstruct: measure the reconstructions of the network, too.

    Raises:
        InputError: there is no such baseline or solver.
    """
    checks.choice("compare()", "solver", solver, SOLVERS)
    for method in baselines:
        if method not in BASELINES:
            raise InputError(f"compare(): baselines has {method!r}; expected some of {', '.join(BASELINES)}")

    def found(network):
        if solver == CARRY:
            return imitated(network, cases, seed=seed, progress=progress)
        return transferred(network, cases, seed=seed, config=config, progress=progress), None, None

    ious = overlaps(model, cases) if reconstruct else no_overlaps(cases)
    outcomes = [_outcome(model.info.name, cases, *found(model), ious, seed)]
    for method in baselines:
        if method == UNTRAINED:
            estimates = found(random_weights(model, seed))[0]
        else:
            estimates = aligned(method, cases, seed=seed, num_starts=config.num_starts, progress=progress)
        outcomes.append(_outcome(method, cases, estimates, None, None, no_overlaps(cases), seed))
    return outcomes


def random_weights(model: Model, seed: int) -> Model:
    """A network of the same sizes with random weights.

    Args:
        model: the network whose sizes are used.
        seed: seed of the weights.
    """
    return dataclasses.replace(model, params=initialise(jax.random.key(seed), model.config))


def summary(
    distance: Float[np.ndarray, " cases"],
    angle: Float[np.ndarray, " cases"],
    ious: Mapping[str, Sequence[float | None]],
    cases: Sequence[Case],
    seed: int = 0,
    tilt: Float[np.ndarray, " cases"] | None = None,
    confidence: Float[np.ndarray, " cases"] | None = None,
) -> dict:
    """Medians, 90th percentiles, success rates with 95 % bootstrap intervals over objects, and flips.

    Args:
        distance: position errors, (cases,), metres.
        angle: rotation errors, (cases,), degrees.
        ious: overlaps by name, each (cases,); None where there is none.
        cases: the cases that the errors are of.
        seed: seed of the bootstrap.
        tilt: errors of the upright axis of the place, (cases,), degrees. They separate objects that stand upright but
            are rotated about their axis from the other failures.
        confidence: confidences of the picks, (cases,); NaN where there is none.

    Returns:
        Plain numbers by name; None for an IoU that no case has, and for the intervals of a single object. The key
        "by_symmetry" holds success rates and IoUs of the objects of each symmetry; "by_sight", if cameras are modelled,
        success rates of the cases in which the place is seen and hidden, and the share with a confidence below 0.5.
    """
    diagonals = distance / [case.diagonal for case in cases]
    known = {name: [iou for iou in several if iou is not None] for name, several in ious.items()}
    objects = [case.instance for case in cases]
    return {
        "cases": len(cases),
        "objects": len(set(objects)),
        **{name: float(np.mean(several)) if several else None for name, several in known.items()},
        "iou_cases": max(map(len, known.values())),
        **percentiles("position", 100 * distance, "cm"),
        **percentiles("position", diagonals, "diagonals"),
        **percentiles("rotation", angle, "deg"),
        "flips": int(np.sum(angle > FLIP_DEGREES)),
        **success_rates(distance, angle, objects, seed),
        "by_symmetry": _by_symmetry(distance, angle, ious, cases, tilt),
        "by_sight": _by_sight(distance, angle, cases, seed, confidence),
    }


def _by_symmetry(distance, angle, ious, cases, tilt) -> dict:
    """Success rates and IoUs of the objects of each symmetry, by its name."""
    folds, parts = np.array([case.fold for case in cases]), {}
    for fold, name in FOLDS.items():
        chosen = folds == fold
        if not chosen.any():
            continue
        part: dict[str, float | None] = {"cases": int(chosen.sum())}
        parts[name] = part
        for key, several in ious.items():
            known = [iou for iou, of_fold in zip(several, chosen) if of_fold and iou is not None]
            part[key] = float(np.mean(known)) if known else None
        for key, threshold in THRESHOLDS.items():
            part[f"success_{key}"] = float(np.mean(threshold.holds(distance[chosen], angle[chosen])))
        upright = None if tilt is None else float(np.mean(SUCCESS.holds(distance[chosen], tilt[chosen])))
        part["success_axis_2cm_20deg"] = upright
    return parts


def _by_sight(distance, angle, cases, seed, confidence) -> dict:
    """Success rates of the cases in which cameras see the place, and of those in which they do not."""
    if any(case.seen is None for case in cases):
        return {}
    seen, parts = np.array([case.seen >= SEEN_POINTS for case in cases]), {}
    for name, chosen in zip(SIGHTS, (seen, ~seen)):
        if not chosen.any():
            continue
        objects = [case.instance for case, is_chosen in zip(cases, chosen) if is_chosen]
        known = None if confidence is None or np.isnan(confidence).any() else confidence[chosen]
        parts[name] = {
            "cases": int(chosen.sum()),
            **success_rates(distance[chosen], angle[chosen], objects, seed),
            "doubted": None if known is None else float(np.mean(known < DOUBT)),
        }
    return parts


def _outcome(method, cases, estimates, confidence, removed, ious, seed) -> Outcome:
    distance, angle = place_errors(estimates, cases)
    row = summary(distance, angle, ious, cases, seed, tilts(estimates, cases), confidence)
    known = np.full(len(cases), np.nan) if confidence is None else confidence
    return Outcome(method, cases, estimates, distance, angle, ious, row, known, removed)


def _overlap(estimate, truth):
    return float(np.sum(estimate & truth) / np.sum(estimate | truth))


_describe = jax.jit(pose_descriptor)
_occupancy = jax.jit(lambda field, x: field.occupancy(x))
