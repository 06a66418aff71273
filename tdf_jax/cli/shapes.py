"""`tdf shapes`: a picture of generated objects, beside meshes of real ones."""

from pathlib import Path
from typing import Annotated

import tyro

from tdf_jax.cli.options import Category


def shapes(
    category: Category,
    out: Annotated[Path, tyro.conf.arg(metavar="FILE")],
    count: int = 24,
    seed: int = 0,
    meshes: Annotated[Path | None, tyro.conf.arg(metavar="DIR", help_behavior_hint="(default: none)")] = None,
    recursive: bool = False,
) -> None:
    """Draw a contact sheet of generated objects, each with its symmetry.

    Args:
        category: category of the objects.
        out: .png file to write.
        count: number of generated objects.
        seed: seed of their dimensions; training and evaluation draw others.
        meshes: folder of real objects with a meshes.json, drawn after the generated ones; see docs/guide/evaluation.md.
        recursive: use the meshes in subfolders of that folder too.
    """
    import numpy as np

    from tdf_jax._internal import checks
    from tdf_jax._internal.errors import InputError
    from tdf_jax.cli.pictures import Pictures
    from tdf_jax.evaluation.annotated_meshes import load_annotated
    from tdf_jax.geometry.symmetry import FOLDS
    from tdf_jax.shapes import FAMILIES

    checks.count("tdf shapes", "--count", count)
    checks.seed("tdf shapes", seed, "--seed")
    if out.suffix != ".png" or not out.parent.is_dir():
        raise InputError(f"tdf shapes: --out is {out}; expected a .png in an existing folder")
    family = FAMILIES[category]
    real = [] if meshes is None else [one for one in load_annotated(meshes, recursive) if one.category == category]
    generated = [family.build(family.sample(np.random.default_rng([seed, index]))) for index in range(count)]
    fold = FOLDS | {1: ""}  # no symmetry needs no word
    named = [(fold[one.fold], one.mesh) for one in generated] + [
        (f"{one.name}\n{fold[one.fold]}".strip(), one.mesh) for one in real
    ]
    pictures = Pictures("tdf shapes")
    with pictures.drawing(out):
        from tdf_jax.viz.contact_sheet import contact_sheet
        from tdf_jax.viz.style import save_figure

        save_figure(out, contact_sheet(named))
        print(f"saved {out}")
    pictures.check()
