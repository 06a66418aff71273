"""`tdf evaluate`: how well weights transfer a pose to unseen generated mugs and to real meshes, beside baselines."""

from pathlib import Path
from typing import Annotated, Literal

import tyro

_NONE = "(default: none)"
Cloud = Literal["full", "views1", "views2", "views4", "points300", "points1000", "points3000", "noise", "half", "double", "all"]


def evaluate(
    weights: str = "mug",
    pairs: int = 50,
    seed: int = 0,
    height: float = 0.12,
    place: str = "handle",
    inits: int = 10,
    iterations: int = 100,
    clouds: tuple[Cloud, ...] = ("full",),
    baselines: bool = False,
    meshes: Annotated[Path | None, tyro.conf.arg(metavar="DIR", help_behavior_hint=_NONE)] = None,
    poses: int = 5,
    json: Annotated[Path | None, tyro.conf.arg(metavar="FILE", help_behavior_hint=_NONE)] = None,
    card: Annotated[Path | None, tyro.conf.arg(metavar="FILE", help_behavior_hint=_NONE)] = None,
    figures: Annotated[Path | None, tyro.conf.arg(metavar="DIR", help_behavior_hint=_NONE)] = None,
) -> None:
    """Transfer one pose between unseen mugs, the target under a uniform random rotation, and print the errors.

    Args:
        weights: a name of shipped weights, or a .safetensors file.
        pairs: generated mug pairs; 0 for none, beside --meshes.
        seed: of the mugs, poses, query points and starts.
        height: of generated mugs, metres; a real mug keeps its size, and is demonstrated on a generated one of its height.
        place: handle, rim or base.
        inits: random starts of each transfer; the one with the least loss counts.
        iterations: Adam steps.
        clouds: the new object's cloud: full; from 1, 2 or 4 cameras; of 300 to 3000 points; 300 with 2 mm noise; half or
            double size.
        baselines: also random weights, alignment of principal axes and ICP, on the same cases with as many starts.
        meshes: folder of real mugs and their meshes.json; see docs/evaluation.md.
        poses: random poses of each real mug.
        json: write every number to this file.
        card: write a model card in Markdown.
        figures: draw reconstructions and transfers into this folder; needs the extra "mesh".
    """
    import functools
    import sys

    from tdf_jax.checkpoint import load_model
    from tdf_jax.cli import card as cards, scores
    from tdf_jax.evaluation.annotated import load_annotated
    from tdf_jax.evaluation.cases import mesh_case, mug_case
    from tdf_jax.evaluation.clouds import CONDITIONS
    from tdf_jax.evaluation.comparison import BASELINES, compare
    from tdf_jax.meshes import libigl
    from tdf_jax.optimize import OptimizeConfig

    _check_numbers(pairs, seed, height, place, clouds, meshes, poses)
    _check_outputs(json, card, figures)
    if meshes is not None or figures is not None:
        libigl("tdf evaluate")
    config = OptimizeConfig(inits=inits, iterations=iterations)
    settings = {
        "weights": weights, "pairs": pairs, "seed": seed, "height": height, "place": place, "inits": inits, "iterations": iterations,
        "meshes": None if meshes is None else str(meshes), "poses": poses, "clouds": clouds,
    }  # fmt: skip
    targets = [] if meshes is None else load_annotated(meshes)
    model = load_model(weights)
    makers = {
        scores.GENERATED: [functools.partial(mug_case, seed, index, height=height) for index in range(pairs)],
        scores.REAL: [functools.partial(mesh_case, seed, pose, target) for target in targets for pose in range(poses)],
    }
    outcomes = {}
    for objects, several in makers.items():
        for condition in (CONDITIONS if "all" in clouds else dict.fromkeys(clouds)) if several else ():
            print(f"{objects}, cloud {condition}", file=sys.stderr)
            cases = [make(place=place, clouds=condition) for make in several]
            outcomes[objects, condition] = compare(cases, model, BASELINES if baselines else (), seed=seed, config=config)
            if json is not None:  # as far as it goes: all of it can take hours
                scores.write(json, scores.record(outcomes, settings, model))
    print(scores.table(outcomes, settings))
    sys.stdout.flush()
    if card is not None:
        cards.write(card, cards.card(model, outcomes, settings))
    if figures is not None:
        from tdf_jax.cli.pictures import draw

        draw(figures, model, outcomes)


def _check_numbers(pairs, seed, height, place, clouds, meshes, poses) -> None:
    from tdf_jax.errors import InputError

    if pairs < 1 and (meshes is None or pairs < 0):
        raise InputError(f"tdf evaluate: --pairs is {pairs}; expected at least 1, or 0 with --meshes")
    if poses < 1:
        raise InputError(f"tdf evaluate: --poses is {poses}; expected at least 1")
    if not 0 <= seed < 2**32:
        raise InputError(f"tdf evaluate: --seed is {seed}; expected 0 to {2**32 - 1}")
    if not 0.01 <= height <= 1.0:
        raise InputError(f"tdf evaluate: --height is {height}; expected metres between 0.01 and 1")
    if place not in ("handle", "rim", "base"):
        raise InputError(f"tdf evaluate: --place is {place!r}; expected handle, rim or base")
    if not clouds:
        raise InputError("tdf evaluate: --clouds is empty; expected at least one condition, such as full")


def _check_outputs(json: Path | None, card: Path | None, figures: Path | None) -> None:
    """Refuse now what could not be written in an hour."""
    from tdf_jax.errors import InputError

    for name, path in (("json", json), ("card", card)):
        if path is not None and (path.is_dir() or not path.parent.is_dir()):
            raise InputError(f"tdf evaluate: --{name} is {path}; expected a file in an existing folder")
    if figures is not None and not (figures.is_dir() or (figures.parent.is_dir() and not figures.exists())):
        raise InputError(f"tdf evaluate: --figures is {figures}; expected a folder, or a new name in an existing one")
