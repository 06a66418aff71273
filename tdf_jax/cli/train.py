"""`tdf train`: weights from generated objects."""

from pathlib import Path
from typing import Annotated

import tyro

from tdf_jax.checkpoint import SUFFIX, save_model
from tdf_jax.errors import InputError
from tdf_jax.model import Model, ModelInfo
from tdf_jax.training.loop import TrainConfig, train as run


def train(
    out: Annotated[Path, tyro.conf.arg(metavar="DIR")],
    weights: Annotated[
        Path | None, tyro.conf.arg(metavar="FILE", help_behavior_hint=f"(default: DIR/weights{SUFFIX})")
    ] = None,
    config: Annotated[TrainConfig, tyro.conf.arg(name="")] = TrainConfig(),
) -> None:
    """Train a network on generated mugs, or go on where the run in a folder stands.

    Args:
        out: folder of the run: its settings, metrics and checkpoint.
        weights: .safetensors file to write at the end.
        config: settings of the run.
    """
    target = _target(out, weights)
    params = run(config, out)
    source = f"tdf train, {config.steps} steps, seed {config.seed}"
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
