"""`tdf imitate`: the main job, from files or a pair of generated mugs to a folder of results."""

import contextlib
import json
import sys
import time
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated

import jax
import numpy as np
import tyro
from tqdm import tqdm

from tdf_jax.solvers.pick import CarryConfig
from tdf_jax.networks.checkpoint import load_model
from tdf_jax.cli import report
from tdf_jax.cli.scene import make_scene
from tdf_jax.cli.options import Settings, resolved
from tdf_jax.energy.reference import describe
from tdf_jax.energy.losses import EnergyWeights
from tdf_jax._internal.errors import CategoryWarning, InputError
from tdf_jax.evaluation.scene import Scene
from tdf_jax._internal.files import replace_file, replace_folder
from tdf_jax.imitation import imitate as imitate_scene
from tdf_jax.solvers.adam import OptimizeConfig, Result
from tdf_jax.solvers.multistart import SolveConfig
from tdf_jax.geometry.trajectory import save_trajectory

# Folded into the seed's key: `random_pose` draws a generated mug's rotation from the key of the same seed, and a start
# drawn from that one would be the answer.
STREAM = 0x1D317A7E


def imitate(settings: Annotated[Settings, tyro.conf.arg(name="")] = Settings()) -> None:
    """Imitate a demonstrated trajectory on a new object; by default on a generated mug in a random pose.

    Writes a folder with result.json, trajectory.npz, trajectory.tum, imitation.png and loss.png.
    """
    settings = resolved(settings)
    with replace_folder("tdf imitate", settings.out, report.RESULT, report.NAMES) as folder:
        record = _run(settings, folder)
    print(json.dumps(record, indent=1) if settings.json else report.table(record, settings.out))


def _run(settings: Settings, folder: Path) -> dict:
    """Do the work, fill the folder, return the record."""
    seconds = {}
    began = time.perf_counter()
    query_key, start_key = jax.random.split(jax.random.fold_in(jax.random.key(settings.seed), STREAM))
    with _timed(seconds, "load"):
        config = _config(settings)
        energy = None
        if not isinstance(config, CarryConfig):
            energy = EnergyWeights() if settings.k is None else EnergyWeights(settings.k)
        model = load_model(settings.weights)
        scene = make_scene(settings, query_key)
    with _timed(seconds, "encode"):
        reference = jax.block_until_ready(describe(model, scene.demonstration))
    with _timed(seconds, "optimise"), _progress(_steps(config)) as progress:
        with warnings.catch_warnings(record=True) as doubts:
            warnings.simplefilter("always", CategoryWarning)
            result = imitate_scene(
                model,
                reference,
                scene.points,
                key=start_key,
                goal_offset=np.array(settings.goal_offset),
                energy=energy,
                config=config,
                progress=progress,
            )
        trajectory = jax.block_until_ready(result.trajectory)
    save_trajectory(folder / "trajectory.npz", trajectory)
    save_trajectory(folder / "trajectory.tum", trajectory)
    if not settings.no_plots:
        with _timed(seconds, "plots"):
            _draw(folder, scene, result, "start" if isinstance(config, OptimizeConfig) else "candidate")
    for doubt in doubts:
        print(f"tdf: warning: {doubt.message}", file=sys.stderr)
    seconds["total"] = time.perf_counter() - began
    record = report.record(settings, model, scene, energy, config, result, seconds)
    replace_file("tdf imitate", folder / report.RESULT, json.dumps(record, indent=1).encode())
    return record


def _config(settings: Settings) -> CarryConfig | SolveConfig | OptimizeConfig:
    starts = {} if settings.inits is None else {"inits": settings.inits}
    if settings.method == "adam":
        return OptimizeConfig(**starts, **({} if settings.iterations is None else {"iterations": settings.iterations}))
    if settings.iterations is not None:
        raise InputError("tdf imitate: --iterations is for --method adam; drop one or add the other")
    if settings.method == "gauss-newton":
        return SolveConfig(**starts)
    return CarryConfig() if settings.inits is None else CarryConfig(scouts=settings.inits)


def _steps(config: CarryConfig | SolveConfig | OptimizeConfig) -> int:
    if isinstance(config, OptimizeConfig):
        return config.iterations
    return sum((config.solver if isinstance(config, CarryConfig) else config).steps)


def _draw(folder: Path, scene: Scene, result: Result, rows: str) -> None:
    from tdf_jax.viz.imitation import imitation_figure, loss_figure
    from tdf_jax.viz.style import save_figure

    trajectory = result.trajectory
    expected = scene.expected(trajectory.wxyz_xyz[-1], trajectory.wxyz_xyz[0])
    title = report.title(result.loss, report.errors(trajectory, expected))
    figure = imitation_figure(scene.demonstration, scene.points, trajectory, expected, scene.meshes, title)
    save_figure(folder / "imitation.png", figure)
    history = np.column_stack([result.losses, result.energies])
    save_figure(folder / "loss.png", loss_figure(history, result.best, rows=rows))


@contextlib.contextmanager
def _timed(seconds: dict[str, float], name: str) -> Iterator[None]:
    began = time.perf_counter()
    yield
    seconds[name] = time.perf_counter() - began


@contextlib.contextmanager
def _progress(iterations: int) -> Iterator:
    """A bar on stderr, and the function that `optimize` calls to move it."""
    with tqdm(total=iterations, desc="imitating", unit="step") as bar:

        def move(done, energies):
            bar.set_postfix(loss=f"{np.min(energies):.5f}", refresh=False)
            bar.update(done - bar.n)

        yield move
