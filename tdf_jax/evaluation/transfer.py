"""Transfer of one pose at a semantic place: errors over cases, and what they amount to."""

from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np
from tqdm import tqdm

from tdf_jax import poses
from tdf_jax.demonstration import Reference, thinned
from tdf_jax.descriptor import pose_descriptor
from tdf_jax.energy import EnergyWeights
from tdf_jax.evaluation.cases import Case
from tdf_jax.evaluation.truth import FLIP_DEGREES, pose_error
from tdf_jax.model import Model, encode
from tdf_jax.optimize import OptimizeConfig, optimize, random_starts
from tdf_jax.query import box_query
from tdf_jax.trajectory import Trajectory

QUERIES = 128
QUERY_SIZE = 0.06  # metres, of the box around the place: the handle and the wall behind it
THRESHOLDS = ((0.01, 10.0), (0.02, 20.0))  # metres, degrees
RESAMPLES = 2000  # of the bootstrap


def transfer_errors(
    model: Model, cases: Sequence[Case], *, seed: int = 0, config: OptimizeConfig = OptimizeConfig(), progress: bool = True
) -> tuple[np.ndarray, np.ndarray]:
    """Transfer the place's pose in every case; of the starts, the one with the least loss counts.

    Args:
        model: the network.
        cases: what to transfer.
        seed: of the query points and the starts.
        config: settings of the optimiser.
        progress: show a progress bar.

    Returns:
        Position errors, metres, and rotation errors, degrees, one a case.
    """
    query_key, start_key = jax.random.split(jax.random.key(seed))
    query = box_query(query_key, count=QUERIES, size=QUERY_SIZE)
    errors = []
    for index, case in enumerate(tqdm(cases, desc="transferring", disable=not progress)):
        reference = place_reference(model, case, query)
        field = encode(model, thinned(model, case.points_b))
        key = jax.random.fold_in(start_key, index)
        # Given as they are: drawn inside, every start's last pose, here its only one, would be set to the goal.
        starts = random_starts(key, field, reference, config.inits, config.start, config.start_radius)
        result = optimize(field, reference, key, fix_last=False, energy=EnergyWeights(0.0), config=config, starts=starts)
        truth = case.T_world_place_b
        errors.append(pose_error(result.trajectory.wxyz_xyz[0], poses.pose(jnp.asarray(truth[:3, :3]), jnp.asarray(truth[:3, 3]))))
    distance, angle = np.array(errors).T
    return distance, np.degrees(angle)


def place_reference(model: Model, case: Case, query) -> Reference:
    """The demonstration of one pose: the query frame at the place on object a."""
    field = encode(model, thinned(model, case.points_a))
    place = jnp.asarray(case.T_world_place_a, jnp.float32)
    T_world_query = poses.pose(place[:3, :3], place[:3, 3])
    shown = Trajectory(T_world_query[None]).shifted(-field.origin)
    return Reference(jax.jit(pose_descriptor)(field, T_world_query, query)[None], shown, query)


def summary(distance: np.ndarray, angle: np.ndarray, seed: int = 0) -> dict:
    """Medians, 90th percentiles, success rates with 95 % bootstrap intervals over cases, and flips.

    Args:
        distance: metres, one a case.
        angle: degrees.
        seed: of the bootstrap.
    """
    rng = np.random.default_rng(seed)
    row = {
        "cases": len(distance),
        "position_median_cm": 100 * float(np.median(distance)),
        "position_p90_cm": 100 * float(np.percentile(distance, 90)),
        "rotation_median_deg": float(np.median(angle)),
        "rotation_p90_deg": float(np.percentile(angle, 90)),
        "flips": int(np.sum(angle > FLIP_DEGREES)),
    }
    for metres, degrees in THRESHOLDS:
        hit = (distance <= metres) & (angle <= degrees)
        means = rng.choice(hit, (RESAMPLES, len(hit))).mean(axis=1)
        row[f"success_{100 * metres:.0f}cm_{degrees:.0f}deg"] = float(hit.mean())
        row[f"interval_{100 * metres:.0f}cm_{degrees:.0f}deg"] = [float(x) for x in np.percentile(means, (2.5, 97.5))]
    return row


def mean_iou(model: Model, cases: Sequence[Case], samples: int = 20_000, seed: int = 0) -> float:
    """Mean intersection over union of the reconstructed and the true object b, at occupancy 0.5.

    Args:
        model: the network.
        cases: whose objects b are reconstructed, in their world poses.
        samples: points uniform in the bounding box padded by a tenth of the diagonal.
        seed: of the points.
    """
    rng = np.random.default_rng(seed)
    ious = []
    for case in cases:
        field = encode(model, thinned(model, case.points_b))
        low, high = case.object_b.mesh.bounds
        pad = 0.1 * np.linalg.norm(high - low)
        x = rng.uniform(low - pad, high + pad, (samples, 3))
        world = (x @ case.T_world_b[:3, :3].T + case.T_world_b[:3, 3]).astype(np.float32)
        found, true = np.asarray(_occupancy(field, world)) > 0.5, case.object_b.contains(x)
        ious.append(np.sum(found & true) / np.sum(found | true))
    return float(np.mean(ious))


_occupancy = jax.jit(lambda field, x: field.occupancy(x))
