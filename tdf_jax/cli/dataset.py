"""`tdf dataset`: labelled objects for training, generated or from a folder of meshes."""

import os
from pathlib import Path
from typing import Annotated

import tyro

from tdf_jax._internal.errors import InputError
from tdf_jax.training.dataset import Recipe, build, load

MOST_WORKERS = 1024


def dataset(
    out: Annotated[Path, tyro.conf.arg(metavar="DIR")],
    workers: Annotated[int, tyro.conf.arg(help_behavior_hint="(default: one for every core)")] = 0,
    recipe: Annotated[Recipe, tyro.conf.arg(name="")] = Recipe(),
) -> None:
    """Label generated objects, or your own meshes, for `tdf train`, or resume an interrupted call.

    Args:
        out: folder of the data set.
        workers: number of processes.
        recipe: settings of the data set.
    """
    if not 0 <= workers <= MOST_WORKERS:
        raise InputError(
            f"tdf dataset: --workers is {workers}; expected 1 or more, or 0 for one for every core, and "
            f"at most {MOST_WORKERS}"
        )
    build(recipe, out, workers or os.cpu_count() or 1)
    parts = load(out)
    for name, data in zip(("training", "validation"), parts):
        box, near = data.inside[:, data.uniform].mean(), data.inside[:, data.uniform.stop :].mean()
        seen = data.visible.mean()
        print(
            f"{name}: {len(data.surface)} objects; inside: {box:.1%} of the uniform queries, "
            f"{near:.1%} of those near the surface; a camera sees {seen:.0%} of a surface"
        )
    print(f"saved {out}")
