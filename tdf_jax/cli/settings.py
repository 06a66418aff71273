"""Options of `tdf imitate`."""

import dataclasses
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
import tyro

from tdf_jax.errors import InputError

SEEDS = 2**32  # jax cuts a larger one to 32 bits without a word


def _option(metavar: str | None = None, default: str | None = None):
    """How the help names a value and a default that is not one."""
    return tyro.conf.arg(metavar=metavar, help_behavior_hint=None if default is None else f"(default: {default})")


@dataclasses.dataclass(frozen=True)
class Settings:
    """What to imitate, on what, and how.

    Attributes:
        target: mesh or point cloud of the new object.
        scale: metres per unit of the target file: 0.01 for centimetres.
        target_pose: how the target lies in the world: as its file says, or moved by a random rotation and translation.
        demonstration: .npz with points (N, 3), wxyz_xyz (n, 7) and query (Q, 3), in metres.
        trajectory: shape of a generated demonstration, from the handle to a place 0.30 m away.
        goal_offset: metres in the world, added to where the last pose goes.
        k: weight of the correlation term; the paper's best is 0.02.
        inits: random starts.
        poses: of the trajectory; a demonstration file is resampled to another number.
        queries: query points of a generated demonstration.
        iterations: optimisation steps.
        points: drawn from a mesh, or from a larger cloud.
        seed: of every draw.
        weights: a name of shipped weights, or a .safetensors file.
        out: folder to write; an earlier result there is replaced.
        no_plots: leave out imitation.png and loss.png.
        json: print result.json instead of the table.
    """

    target: Annotated[Path | None, _option("FILE", "a generated mug")] = None
    scale: float = 1.0
    target_pose: Annotated[
        Literal["given", "random"] | None, _option(default="given for a file, random for a generated mug")
    ] = None
    demonstration: Annotated[Path | None, _option("FILE", "one on another generated mug")] = None
    trajectory: Annotated[Literal["line", "semicircle", "wave"] | None, _option(default="wave")] = None
    goal_offset: Annotated[tuple[float, float, float], _option("X Y Z")] = (0.0, 0.0, 0.0)
    k: float = 0.02
    inits: int = 10
    poses: Annotated[int | None, _option("INT", "7, or those of the demonstration file")] = None
    queries: Annotated[int | None, _option("INT", "128")] = None
    iterations: int = 100
    points: int = 1500
    seed: int = 0
    weights: Annotated[str, _option("NAME|FILE")] = "mug"
    out: Annotated[Path, _option("DIR")] = Path("imitation")
    no_plots: bool = False
    json: bool = False


def resolved(settings: Settings) -> Settings:
    """The settings with the defaults filled in that depend on others.

    Raises:
        InputError: a bad number, or options that contradict each other.
    """
    _check_numbers(settings)
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
            raise InputError(f"tdf imitate: --{name} is for a generated demonstration, and there is a file; drop one")
    return dataclasses.replace(settings, target_pose=pose)


def _check_numbers(settings: Settings) -> None:
    if not 0 <= settings.seed < SEEDS:
        raise InputError(f"tdf imitate: --seed is {settings.seed}; expected 0 to {SEEDS - 1}")
    if not 0 <= settings.k < np.inf:
        raise InputError(f"tdf imitate: --k is {settings.k}; expected a weight of 0 or more")
    if not np.isfinite(settings.goal_offset).all():
        raise InputError(f"tdf imitate: --goal-offset is {settings.goal_offset}; expected three finite numbers, metres")
    if settings.target is None and settings.scale != 1:
        raise InputError("tdf imitate: --scale is for a --target file; give one, or drop --scale")
