"""`tdf imitate`: the main job, from files or a pair of generated mugs to a folder of results."""

import contextlib
import dataclasses
import json
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Literal

import jax
import numpy as np
import tyro
from tqdm import tqdm

from tdf_jax.checkpoint import load_model
from tdf_jax.cli import report, scene
from tdf_jax.demonstration import Demonstration, describe
from tdf_jax.energy import EnergyWeights
from tdf_jax.errors import InputError
from tdf_jax.evaluation.cases import mug_case
from tdf_jax.evaluation.truth import expected_trajectory
from tdf_jax.files import replace_file, replace_folder
from tdf_jax.imitation import imitate as imitate_on
from tdf_jax.optimize import OptimizeConfig, Result
from tdf_jax.recording import load_demonstration
from tdf_jax.trajectory import Trajectory, resample, save_trajectory

MUG_HEIGHT = 0.12  # metres, of generated mugs
SEEDS = 2**32  # a larger one would be cut to 32 bits by jax without a word
# Folded into the seed, so that no start is drawn from the key that the random pose of a generated mug is drawn from.
STREAM = 0x1D317A7E


@dataclasses.dataclass(frozen=True)
class Settings:
    """What to imitate, on what, and how.

    Attributes:
        target: mesh or point cloud of the new object; by default a generated mug.
        scale: metres per unit of the target file: 0.01 for centimetres.
        target_pose: how the target lies; by default as given in its file, and a generated mug at random.
        demonstration: .npz with points (N, 3), wxyz_xyz (n, 7) and query (Q, 3), metres; by default one on another
            generated mug.
        trajectory: shape of the generated demonstration, from the handle to a place 0.30 m away; by default wave.
        goal_offset: metres in the world, added to where the last pose goes.
        k: weight of the correlation term; the paper's best is 0.02.
        inits: random starts.
        poses: of the trajectory; by default 7, or those of the demonstration file (another number resamples them).
        queries: query points of the generated demonstration; by default 128.
        iterations: optimisation steps.
        points: drawn from a mesh, or from a larger cloud.
        seed: of every draw.
        weights: name of shipped weights, or a .safetensors file.
        out: folder to write; an earlier result there is replaced.
        plots: draw imitation.png and loss.png.
        json: print result.json instead of the table.
    """

    target: Path | None = None
    scale: float = 1.0
    target_pose: Literal["given", "random"] | None = None
    demonstration: Path | None = None
    trajectory: Literal["line", "semicircle", "wave"] | None = None
    goal_offset: tuple[float, float, float] = (0.0, 0.0, 0.0)
    k: float = 0.02
    inits: int = 10
    poses: int | None = None
    queries: int | None = None
    iterations: int = 100
    points: int = 1500
    seed: int = 0
    weights: str = "mug"
    out: Path = Path("imitation")
    plots: bool = True
    json: bool = False


def imitate(settings: Annotated[Settings, tyro.conf.arg(name="")] = Settings()) -> None:
    """Imitate a demonstrated trajectory on a new object; by default a generated mug in a random pose.

    Writes a folder with result.json, trajectory.npz, trajectory.tum, imitation.png and loss.png.
    """
    settings = _resolved(settings)
    with replace_folder("tdf imitate", settings.out, report.RESULT, report.NAMES) as folder:
        record = _run(settings, folder)
    print(json.dumps(record, indent=1) if settings.json else report.table(record, settings.out))


def _resolved(settings: Settings) -> Settings:
    """The settings with their dependent defaults filled in; options that contradict each other are refused."""
    if not 0 <= settings.seed < SEEDS:
        raise InputError(f"tdf imitate: --seed is {settings.seed}; expected 0 to {SEEDS - 1}")
    if not 0 <= settings.k < np.inf:
        raise InputError(f"tdf imitate: --k is {settings.k}; expected a weight of 0 or more")
    if not np.isfinite(settings.goal_offset).all():
        raise InputError(f"tdf imitate: --goal-offset is {settings.goal_offset}; expected three finite numbers, metres")
    if settings.target is None and settings.scale != 1.0:
        raise InputError("tdf imitate: --scale is of the --target file, and there is none; give one, or leave --scale out")
    pose = settings.target_pose or ("random" if settings.target is None else "given")
    if settings.demonstration is None:
        return dataclasses.replace(
            settings,
            target_pose=pose,
            trajectory=settings.trajectory or "wave",
            poses=7 if settings.poses is None else settings.poses,
            queries=128 if settings.queries is None else settings.queries,
        )
    for name in ("trajectory", "queries"):
        if getattr(settings, name) is not None:
            raise InputError(f"tdf imitate: --{name} is of generated demonstrations, and --demonstration has its own; drop one")
    return dataclasses.replace(settings, target_pose=pose)


def _run(settings: Settings, folder: Path) -> dict:
    timings = {}
    query_key, start_key = jax.random.split(jax.random.fold_in(jax.random.key(settings.seed), STREAM))
    with _timed(timings, "load"):
        energy = EnergyWeights(settings.k)
        config = OptimizeConfig(inits=settings.inits, iterations=settings.iterations)
        model = load_model(settings.weights)
        demonstration, target, T_world_handle = _scene(settings, query_key)
    with _timed(timings, "encode"):
        reference = jax.block_until_ready(describe(model, demonstration))
    with _timed(timings, "optimise"), tqdm(total=settings.iterations, desc="imitating", unit="step") as bar:

        def progress(done, energies):
            bar.update(done - bar.n)
            bar.set_postfix(loss=f"{np.nanmin(energies):.5f}")

        result = imitate_on(
            model, reference, target.points, key=start_key, goal_offset=settings.goal_offset, energy=energy,
            config=config, progress=progress,
        )  # fmt: skip
        trajectory = jax.block_until_ready(result.trajectory)
    expected = None
    if T_world_handle is not None and target.T_world_handle is not None:
        goal = trajectory.wxyz_xyz[-1]  # it is fixed
        expected = expected_trajectory(demonstration.trajectory, T_world_handle, target.T_world_handle, goal)
    errors = report.errors(trajectory, expected)
    save_trajectory(folder / "trajectory.npz", trajectory)
    save_trajectory(folder / "trajectory.tum", trajectory)
    if settings.plots:
        with _timed(timings, "plots"):
            _draw(folder, demonstration, target, result, expected, errors)
