"""`tdf convert`: conversion of a PyTorch NDF checkpoint to weights for `--weights` and `load_model`."""

from pathlib import Path
from typing import Annotated

import tyro

from tdf_jax.networks.checkpoint import save_model
from tdf_jax.networks.ndf_checkpoint import convert_checkpoint
from tdf_jax.networks.occupancy import parameter_count


def convert(
    source: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="IN.pth")],
    target: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="OUT.safetensors")],
    prefix: Annotated[str | None, tyro.conf.arg(help_behavior_hint="(default: the only one)")] = None,
) -> None:
    """Convert a published Neural Descriptor Fields checkpoint; nothing in it is executed.

    Args:
        source: PyTorch file, such as `.pth` or `.ckpt`, or safetensors with PyTorch's names.
        target: file to write, `.safetensors`.
        prefix: prefix of the network's names, such as ema.module; for files with several networks.
    """
    model = convert_checkpoint(source, prefix=prefix)
    save_model(model, target)
    print(f"parameters   {parameter_count(model.config):,}")
    print(f"latent size  {model.config.latent}")
    print(f"saved        {target}")
