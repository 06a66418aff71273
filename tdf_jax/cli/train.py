"""`tdf train`: training of a network on labelled objects."""

import dataclasses
import os
from pathlib import Path
from typing import Annotated

import tyro

from tdf_jax._internal import checks
from tdf_jax._internal.errors import InputError
from tdf_jax.cli.dataset import MOST_WORKERS
from tdf_jax.cli.pictures import Pictures
from tdf_jax.networks.checkpoint import SUFFIX, load_model, save_model
from tdf_jax.networks.model import Model, ModelInfo
from tdf_jax.training.batch import DIAGONALS
from tdf_jax.training.config import TrainConfig
from tdf_jax.training.dataset import Recipe, build, joined, load
from tdf_jax.training.loop import steps_within, train as run
from tdf_jax.training.prefetch import usual_workers
from tdf_jax.training.run_folder import metrics, settings_of


def train(
    out: Annotated[Path, tyro.conf.arg(metavar="DIR")],
    data: Annotated[
        tuple[Path, ...],
        tyro.conf.arg(metavar="DIR [DIR ...]", help_behavior_hint="(default: generated mugs, in OUT/data)"),
    ] = (),
    start_from: Annotated[
        str | None, tyro.conf.arg(metavar="WEIGHTS", help_behavior_hint="(default: random weights)")
    ] = None,
    minutes: Annotated[float | None, tyro.conf.arg(help_behavior_hint="(default: as --steps says)")] = None,
    weights: Annotated[
        Path | None, tyro.conf.arg(metavar="FILE", help_behavior_hint=f"(default: OUT/weights{SUFFIX})")
    ] = None,
    workers: Annotated[
        int, tyro.conf.arg(help_behavior_hint="(default: a thread on a CPU, one for every core beside an accelerator)")
    ] = 0,
    config: Annotated[TrainConfig, tyro.conf.arg(name="")] = TrainConfig(),
) -> None:
    """Train a network on labelled objects, or resume the run in a folder.

    Args:
        out: folder of the run, for its settings, metrics, curves and checkpoint.
        data: folder from tdf dataset; several folders give one network of several categories.
        start_from: name of shipped weights or .safetensors file to start from. Their symmetry-breaking offset applies
            unless --network.symmetry-breaking-offset is not 0. Use --learning-rate 0.003.
        minutes: choose --steps so that the run takes about so long on this machine.
        weights: .safetensors file to write at the end.
        workers: processes that draw the samples of the next steps.
        config: settings of the run.
    """
    if minutes is not None:
        checks.positive("tdf train", "--minutes", minutes)
    if not 0 <= workers <= MOST_WORKERS:
        raise InputError(
            f"tdf train: --workers is {workers}; expected 1 or more, or 0 for as many as suit this "
            f"machine, and at most {MOST_WORKERS}"
        )
    workers = workers or usual_workers()
    target = _target(out, weights)
    model = None if start_from is None else load_model(start_from)
    if model is not None:
        # The symmetry-breaking offset is not a size: a network can be trained further with another one, and keeps its
        # own by default.
        offset = config.network.symmetry_breaking_offset
        network = dataclasses.replace(model.config, symmetry_breaking_offset=offset)
        if network != config.network:
            raise InputError(
                f"tdf train: --start-from {start_from} is a network of other sizes ({model.config}); "
                f"expected {config.network}"
            )
        config = dataclasses.replace(config, network=network if offset else model.config)
    if not data:
        data = (out / "data",)
        build(Recipe(seed=config.seed), data[0], os.cpu_count() or 1)
    objects, validation = (joined(sets) for sets in zip(*(load(folder) for folder in data)))
    before = settings_of(out)
    if minutes is not None:
        # A resumed run keeps its number of steps, on which its learning rate depends.
        steps = steps_within(minutes, config, objects, workers) if before is None else before["steps"]
        config = dataclasses.replace(config, steps=steps)
    params = run(config, objects, validation, out, initial=None if model is None else model.params, workers=workers)
    origin = "" if start_from is None else f" from {start_from}"
    source = f"tdf train, {config.steps} steps{origin}, seed {config.seed}"
    smallest, largest = DIAGONALS
    info = ModelInfo(
        target.stem, source, cloud_points=config.points, smallest_diagonal=smallest, largest_diagonal=largest
    )
    save_model(Model(params, config.network, info), target)
    print(f"saved {target}")
    pictures = Pictures("tdf train")
    with pictures.drawing(out / "training.png") as path:
        from tdf_jax.viz.style import save_figure
        from tdf_jax.viz.training import training_figure

        save_figure(path, training_figure(metrics(out)))
    pictures.check()


def _target(out: Path, weights: Path | None) -> Path:
    """Path of the weights; a path that cannot be written is refused before the training and not after hours."""
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"tdf train: cannot make the folder {out} ({error}); expected a writable place") from None
    target = out / f"weights{SUFFIX}" if weights is None else weights
    if target.suffix != SUFFIX or not target.parent.is_dir():
        raise InputError(f"tdf train: --weights is {target}; expected a {SUFFIX} file in an existing folder")
    return target
