"""Settings and data of figures 1, 3, 4 and 5."""

import dataclasses
from collections.abc import Callable, Sequence

import numpy as np
from jaxtyping import Float

from tdf_jax.evaluation.metrics import pose_error
from tdf_jax.paper.runs import Run
from tdf_jax.paper.setting import SHAPES, Setting

Runner = Callable[[Setting], Run]

DISPLACED = (-0.2, 0.1, 0.3)  # displacement of the endpoint in figure 4
DISTANCES = (0.15, 0.25, 0.5, 0.75, 1.0, 1.5, 2.0)  # distances from the centroid of the cloud
PAPER_DISTANCES = (0.5, 1.0, 2.0)
DISTANCE_SEEDS = 2


def figure1(base: Setting) -> dict[str, Setting]:
    """l_t alone and l_t + l_c from the same starts, with the last pose free: l_t alone misses the goal."""
    free = dataclasses.replace(base, fix_last=False)
    return {"l_t": dataclasses.replace(free, k=0.0), "l_t + l_c": free}


def figure3(base: Setting, distances: Sequence[float] = DISTANCES, seeds: int = DISTANCE_SEEDS) -> dict[tuple, Setting]:
    """Settings by (k, distance, seed): a line that begins at a distance from the centroid, with and without l_c.

    Args:
        base: all other numbers.
        distances: distances of the first pose from the centroid of the cloud, in the paper's unit.
        seeds: number of seeds.
    """
    return {
        (k, distance, seed): dataclasses.replace(base, trajectory="line", distance=distance, k=k, seed=base.seed + seed)
        for k in (base.k, 0.0)
        for distance in distances
        for seed in range(seeds)
    }


def figure4(base: Setting) -> dict[tuple, Setting]:
    """Settings by (trajectory, displacement): test against reference."""
    return {
        (shape, displacement): dataclasses.replace(base, trajectory=shape, displacement=displacement)
        for displacement in ((0.0, 0.0, 0.0), DISPLACED)
        for shape in SHAPES
    }


def figure5(base: Setting) -> dict[str, Setting]:
    """Settings by shape: loss against iteration."""
    return {shape: dataclasses.replace(base, trajectory=shape) for shape in SHAPES}


def collected(run: Runner, settings: dict) -> dict:
    """The runs of settings, by the same keys."""
    return {name: run(setting) for name, setting in settings.items()}


def turned(path: Float[np.ndarray, "poses 7"], reference: Float[np.ndarray, "poses 7"]) -> Float[np.ndarray, " poses"]:
    """Rotation of the query frame from the demonstration along a path, (poses,), degrees.

    Args:
        path: poses `wxyz_xyz`, (poses, 7).
        reference: demonstrated poses `wxyz_xyz`, (poses, 7).
    """
    return np.degrees(pose_error(path, reference)[1])


def mean_over_seeds(runs: dict[tuple, Run], value: Callable[[Run], float]) -> dict[float, dict[float, float]]:
    """Mean over the seeds of a property of the runs of figure 3, by k and by distance.

    Args:
        runs: runs by (k, distance, seed).
        value: the property.
    """
    rows: dict = {}
    for (k, distance, _), run in runs.items():
        rows.setdefault(k, {}).setdefault(distance, []).append(value(run))
    return {k: {distance: float(np.mean(values)) for distance, values in row.items()} for k, row in rows.items()}
