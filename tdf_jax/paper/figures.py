"""Data of figures 1, 3, 4 and 5: runs at chosen settings."""

import dataclasses
from collections.abc import Callable, Sequence

import numpy as np
from jaxtyping import Float

from tdf_jax.geometry import se3
from tdf_jax.paper.runs import Run
from tdf_jax.paper.setting import SHAPES, Setting

Runner = Callable[[Setting], Run]

DISPLACED = (-0.2, 0.1, 0.3)  # figure 4's endpoint
DISTANCES = (0.15, 0.25, 0.5, 0.75, 1.0, 1.5, 2.0)  # from the cloud's centre; the paper shows 0.5, 1 and 2
PAPER_DISTANCES = (0.5, 1.0, 2.0)
DISTANCE_SEEDS = 2


def figure1(base: Setting) -> dict[str, Setting]:
    """After l_t only and after l_t + l_c, from the same starts, the last pose free: after l_t only it misses the place."""
    free = dataclasses.replace(base, fix_last=False)
    return {"l_t": dataclasses.replace(free, k=0.0), "l_t + l_c": free}


def figure3(base: Setting, distances: Sequence[float] = DISTANCES, seeds: int = DISTANCE_SEEDS) -> dict[tuple, Setting]:
    """A line whose query points start at some distance from the cloud's centre, with and without l_c: (k, distance, seed) -> setting."""
    return {
        (k, distance, seed): dataclasses.replace(base, trajectory="line", distance=distance, k=k, seed=base.seed + seed)
        for k in (base.k, 0.0)
        for distance in distances
        for seed in range(seeds)
    }


def figure4(base: Setting) -> dict[tuple, Setting]:
    """Test against reference: (trajectory, displacement) -> setting."""
    return {
        (shape, displacement): dataclasses.replace(base, trajectory=shape, displacement=displacement)
        for displacement in ((0.0, 0.0, 0.0), DISPLACED)
        for shape in SHAPES
    }


def figure5(base: Setting) -> dict[str, Setting]:
    """Loss against iteration, one setting a shape."""
    return {shape: dataclasses.replace(base, trajectory=shape) for shape in SHAPES}


def collected(run: Runner, settings: dict) -> dict:
    """The runs of a figure's settings."""
    return {name: run(setting) for name, setting in settings.items()}


def turned(path: Float[np.ndarray, "poses 7"], reference: Float[np.ndarray, "poses 7"]) -> Float[np.ndarray, " poses"]:
    """Angle of each pose from the demonstration's, degrees: how the query frame turns along the path."""
    return np.degrees(np.asarray(se3.rotation_distance(se3.rotation(path), se3.rotation(reference))))


def mean_over_seeds(runs: dict[tuple, Run], value: Callable[[Run], float]) -> dict[float, dict[float, float]]:
    """Of figure 3's runs: k -> distance -> mean of a run's property."""
    found: dict = {}
    for (k, distance, _), run in runs.items():
        found.setdefault(k, {}).setdefault(distance, []).append(value(run))
    return {k: {distance: float(np.mean(values)) for distance, values in row.items()} for k, row in found.items()}
