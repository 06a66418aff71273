"""Transfer of one pose at a semantic place by a network, and how well it knows the objects' shapes."""

from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from tqdm import tqdm

from tdf_jax.energy.descriptors import pose_descriptor
from tdf_jax.energy.losses import EnergyWeights
from tdf_jax.energy.reference import Reference
from tdf_jax.evaluation.cases import Case, Transfer
from tdf_jax.evaluation.metrics import nearest_place, pose_error
from tdf_jax.geometry import se3
from tdf_jax.geometry.query import box_query
from tdf_jax.geometry.trajectory import Trajectory
from tdf_jax.networks.encoding import encode
from tdf_jax.networks.model import Model
from tdf_jax.networks.refinement import refine
from tdf_jax.solvers.adam import OptimizeConfig, optimize

OVERLAPS = ("iou", "iou_refined")
QUERIES = 128
QUERY_SIZE = 0.06  # metres, of the box around the place: the handle and the wall behind it


def transferred(
    model: Model,
    cases: Sequence[Transfer],
    *,
    seed: int = 0,
    config: OptimizeConfig = OptimizeConfig(),
    progress: bool = True,
) -> Float[np.ndarray, "cases 7"]:
    """Transfer the place's pose in every case; of the starts, the one with the least loss counts.

    Args:
        model: the network.
        cases: what to transfer.
        seed: of the query points and the starts.
        config: settings of the optimiser.
        progress: show a progress bar.

    Returns:
        Poses `wxyz_xyz` of the place, as found on object b, world frame.
    """
    query_key, start_key = jax.random.split(jax.random.key(seed))
    found = []
    for index, case in enumerate(tqdm(cases, desc="transferring", disable=not progress)):
        reference = place_reference(model, case, box_query(query_key, count=QUERIES, size=QUERY_SIZE * case.scale))
        field = encode(model, case.points_b)
        key = jax.random.fold_in(start_key, index)
        result = optimize(field, reference, key, fix_last=False, energy=EnergyWeights(0.0), config=config)
        found.append(result.trajectory.wxyz_xyz[0])
    return np.stack(found)


def place_errors(
    found: Float[np.ndarray, "cases 7"], cases: Sequence[Transfer]
) -> tuple[Float[np.ndarray, " cases"], Float[np.ndarray, " cases"]]:
    """Position errors, metres, and rotation errors, degrees, of poses found for cases: from the nearest of a symmetric object's true poses."""
    T_world_found = np.asarray(Trajectory(jnp.asarray(found)).matrices, float)
    truth = np.stack(
        [
            nearest_place(case.T_world_b, T, case.T_world_place_b, case.fold)
            for T, case in zip(T_world_found, cases, strict=True)
        ]
    ).astype(np.float32)
    distance, angle = pose_error(found, se3.pose(truth[:, :3, :3], truth[:, :3, 3]))
    return distance, np.degrees(angle)


def tilts(found: Float[np.ndarray, "cases 7"], cases: Sequence[Transfer]) -> Float[np.ndarray, " cases"]:
    """How far poses found for cases are from upright on their object, degrees: the angle between the place's z axis as found and in truth."""
    up = np.asarray(Trajectory(jnp.asarray(found)).matrices, float)[:, :3, 2]
    true = np.stack([case.T_world_place_b[:3, 2] for case in cases])
    return np.degrees(np.arctan2(np.linalg.norm(np.cross(up, true), axis=1), np.sum(up * true, axis=1)))


def place_reference(model: Model, case: Transfer, query: Float[Array, "queries 3"]) -> Reference:
    """The demonstration of one pose: the query frame at the place on object a."""
    field = encode(model, case.points_a)
    place = jnp.asarray(case.T_world_place_a, jnp.float32)
    T_world_query = se3.pose(place[:3, :3], place[:3, 3])
    shown = Trajectory(T_world_query[None]).shifted(-field.origin)
    return Reference(_describe(field, T_world_query, query)[None], shown, query)


def overlaps(
    model: Model, cases: Sequence[Case], samples: int = 20_000, seed: int = 0
) -> dict[str, list[float | None]]:
    """Intersection over union of the reconstructed and the true object b, at occupancy 0.5, in every case.

    Args:
        model: the network.
        cases: whose objects b are reconstructed, in their world poses.
        samples: points uniform in the bounding box padded by a tenth of the diagonal.
        seed: of the points.

    Returns:
        One number a case as the field was encoded, "iou", and one after `refine`, "iou_refined"; None where object b's
        mesh is not closed and has no volume.
    """
    rng = np.random.default_rng(seed)
    ious = no_overlaps([])
    for case in cases:
        low, high = case.object_b.mesh.bounds
        pad = 0.1 * case.diagonal
        x = rng.uniform(low - pad, high + pad, (samples, 3))
        true = case.object_b.contains(x)
        if true is None:
            measured = dict.fromkeys(OVERLAPS)
        else:
            world = (x @ case.T_world_b[:3, :3].T + case.T_world_b[:3, 3]).astype(np.float32)
            field = encode(model, case.points_b)
            measured = {
                name: _overlap(np.asarray(_occupancy(shape, world)) > 0.5, true)
                for name, shape in zip(OVERLAPS, (field, refine(model, field, case.points_b)))
            }
        for name, iou in measured.items():
            ious[name].append(iou)
    return ious


def no_overlaps(cases: Sequence[Case]) -> dict[str, list[None]]:
    """What `overlaps` returns of a method that reconstructs nothing."""
    return {name: [None] * len(cases) for name in OVERLAPS}


def _overlap(found, true):
    return float(np.sum(found & true) / np.sum(found | true))


_describe = jax.jit(pose_descriptor)
_occupancy = jax.jit(lambda field, x: field.occupancy(x))
