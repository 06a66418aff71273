"""`tdf convert`: a PyTorch NDF checkpoint -> weights that `--weights` and `load_model` take."""

from pathlib import Path
from typing import Annotated

import tyro

from tdf_jax.networks.checkpoint import save_model
from tdf_jax.networks.ndf_checkpoint import convert_checkpoint
from tdf_jax.networks.occupancy import parameter_count


def convert(
    source: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="IN.pth")],
    target: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="OUT.safetensors")],
) -> None:
    """Convert a published Neural Descriptor Fields checkpoint; nothing in it is executed.

    Args:
        source: the PyTorch file, `.pth`.
        target: the file to write, `.safetensors`.
    """
    model = convert_checkpoint(source)
    save_model(model, target)
    print(f"parameters   {parameter_count(model.config):,}")
    print(f"latent size  {model.config.latent}")
    print(f"saved        {target}")
