"""`tdf train`: weights from labelled objects."""

import dataclasses
import os
from pathlib import Path
from typing import Annotated

import tyro

from tdf_jax._internal.errors import InputError
from tdf_jax.networks.checkpoint import SUFFIX, load_model, save_model
from tdf_jax.networks.model import Model, ModelInfo
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
    """Train a network on labelled objects, or go on where the run in a folder stands.

    Args:
        out: folder of the run: its settings, metrics, curves and checkpoint.
        data: folder made by tdf dataset; several for one network of several categories.
        start_from: a name of shipped weights or a .safetensors file to go on from, with their asymmetry unless
            --network.asymmetry is another one than 0; --learning-rate 0.003 suits it.
        minutes: choose --steps so that the run takes about so long on this machine.
        weights: .safetensors file to write at the end.
        workers: processes that draw the samples of the steps to come.
        config: settings of the run.
    """
    from tdf_jax.viz.style import save_figure
    from tdf_jax.viz.training import training_figure

    if minutes is not None and not 0 < minutes < float("inf"):
        raise InputError(f"tdf train: --minutes is {minutes}; expected a positive number")
    if workers < 0:
        raise InputError(
            f"tdf train: --workers is {workers}; expected 1 or more, or 0 for as many as suit this machine"
        )
    workers = workers or usual_workers()
    target = _target(out, weights)
    model = None if start_from is None else load_model(start_from)
    if model is not None:
        # Asymmetry is no size: a network may go on with another, and keeps its own where none is asked for.
        network = dataclasses.replace(model.config, asymmetry=config.network.asymmetry)
        if network != config.network:
            raise InputError(
                f"tdf train: --start-from {start_from} is a network of other sizes ({model.config}); expected {config.network}"
            )
        config = dataclasses.replace(config, network=network if network.asymmetry else model.config)
    if not data:
        data = (out / "data",)
        build(Recipe(seed=config.seed), data[0], os.cpu_count() or 1)
    objects, validation = (joined(sets) for sets in zip(*(load(folder) for folder in data)))
    before = settings_of(out)
    if minutes is not None:
        # A run that stands keeps its steps: they are what its learning rate follows.
        steps = steps_within(minutes, config, objects, workers) if before is None else before["steps"]
        config = dataclasses.replace(config, steps=steps)
    params = run(config, objects, validation, out, initial=None if model is None else model.params, workers=workers)
    save_figure(out / "training.png", training_figure(metrics(out)))
    origin = "" if start_from is None else f" from {start_from}"
    source = f"tdf train, {config.steps} steps{origin}, seed {config.seed}"
    info = ModelInfo(name=target.stem, source=source, cloud_points=config.points)
    save_model(Model(params, config.network, info), target)
    print(f"saved {target}")


def _target(out: Path, weights: Path | None) -> Path:
    """Where the weights go; what would fail after hours of training is refused before them."""
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"tdf train: cannot make the folder {out} ({error}); expected a writable place") from None
    target = out / f"weights{SUFFIX}" if weights is None else weights
    if target.suffix != SUFFIX or not target.parent.is_dir():
        raise InputError(f"tdf train: --weights is {target}; expected a {SUFFIX} file in an existing folder")
    return target
