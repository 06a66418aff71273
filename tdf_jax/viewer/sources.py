"""What `tdf view` is given to show: a folder of results, or one of their files."""

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from tdf_jax._internal.errors import InputError
from tdf_jax.sim.playback import FOLDER
from tdf_jax.solvers.imitation_scene import SCENE

IMITATION, LANDSCAPE, EPISODES, JOINTS = "imitation", "landscape", "episodes", "joints"
LANDSCAPE_FILE = "landscape.npz"
COMMANDS = "`tdf imitate`, `tdf landscape` or `tdf simulate`"
# What a file is, by arrays that no other file has; the first that fits.
FILES = (
    (IMITATION, {"header", "demonstration_points"}),
    (LANDSCAPE, {"header", "values", "waypoints"}),
    (EPISODES, {"header", "poses", "solid_bodies"}),
    (JOINTS, {"joint_names", "positions"}),
)
# Files that cannot be shown alone, and what to do.
NOT_ALONE = (
    ({"solid_bodies"}, "the robot of simulated episodes; expected the folder of `tdf simulate` that it is in"),
    (
        {"points", "wxyz_xyz", "query"},
        "a demonstration; expected a folder of results: imitate it first, with `tdf imitate --demonstration FILE`. In "
        "a notebook, tdf.load_demonstration shows it",
    ),
    ({"wxyz_xyz"}, f"a trajectory without its object; expected the folder of `tdf imitate`, with {SCENE}"),
)


class Source(NamedTuple):
    """What is shown.

    Attributes:
        kind: one of IMITATION, LANDSCAPE, EPISODES and JOINTS.
        path: folder or file of an imitation; file of a landscape or of joints; folder of `tdf simulate`.
        episode: file of the episode that is shown first; None for the first of all, and of other kinds.
    """

    kind: str
    path: Path
    episode: Path | None = None


def source_of(path: Path) -> Source:
    """Find out what a folder or a file holds.

    Args:
        path: folder of `tdf imitate`, `tdf landscape`, `tdf simulate` or `tdf benchmark --simulation`, its folder of
            episodes, one of the .npz files in them, or a file of `JointTrajectory.save`.

    Raises:
        InputError: there is nothing at the path, or nothing that can be shown.
    """
    if path.is_file():
        return _of_file(path)
    if path.name == FOLDER and any(path.glob("*.npz")):
        return Source(EPISODES, path.parent)
    simulated = next((one for one in (path, path / "runs") if (one / FOLDER).is_dir()), None)
    if simulated is not None:
        return Source(EPISODES, simulated)
    if path.is_dir() and not (path / SCENE).is_file():
        if (path / LANDSCAPE_FILE).is_file():
            return Source(LANDSCAPE, path / LANDSCAPE_FILE)
        if any(path.iterdir()):
            raise InputError(
                f"tdf view: {path} has no {SCENE}, {LANDSCAPE_FILE} or {FOLDER}; expected a folder of {COMMANDS} of "
                "this version. Of other commands, see the pictures"
            )
    return Source(IMITATION, path)


def _of_file(path: Path) -> Source:
    suffix = path.suffix.lower()
    if suffix == ".csv":
        return Source(JOINTS, path)
    if suffix != ".npz":
        raise InputError(
            f"tdf view: {path} is a file; expected a folder of {COMMANDS}. To make a demonstration on an object, add "
            "--demonstrate FILE"
        )
    names = set(_arrays(path))
    kind = next((kind for kind, required in FILES if required <= names), None)
    if kind == EPISODES:
        return Source(EPISODES, path.resolve().parent.parent, path.resolve())
    if kind is not None:
        return Source(kind, path)
    what = next((what for required, what in NOT_ALONE if required <= names), None)
    if what is None:
        listed = ", ".join(sorted(names)[:6]) or "nothing"
        what = f"the arrays {listed}; expected a folder of {COMMANDS}, or a file of theirs"
    raise InputError(f"tdf view: {path} holds {what}")


def _arrays(path: Path) -> Sequence[str]:
    """Names of the arrays of an .npz file; none are read."""
    try:
        with path.open("rb") as file, np.lib.npyio.NpzFile(file, allow_pickle=False) as archive:
            return archive.files
    except Exception as error:  # damaged archives raise errors of many kinds
        raise InputError(
            f"tdf view: cannot read {path} ({type(error).__name__}: {str(error)[:200]}); expected a whole .npz file: "
            "run the command that wrote it again"
        ) from None
