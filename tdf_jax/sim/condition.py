"""What a row of episodes is measured under, and what its episodes share."""

import dataclasses
from pathlib import Path
from typing import NamedTuple

from tdf_jax._internal import checks
from tdf_jax._internal.errors import InputError
from tdf_jax.sim.episode import MODES
from tdf_jax.sim.tasks import POSES, TASKS

DEMONSTRATIONS = 10  # episodes that demonstrate; with one demonstration, each is that of a tenth of the episodes
GENERATED, MESHES = OBJECTS = ("generated", "meshes")
CLOUDS = ("full", "views3", "views1")
TARGETS = ("known", "found")
SEGMENTED, SIMULATOR = MASKS = ("segmented", "simulator")
LIBRARY, UNCENTRED, TRUTH, REPLAY, ICP = "tdf_jax", "uncentred", "truth", "rigid replay", "ICP"
EVEN, PAPER = "even blending", "paper"
METHODS = (LIBRARY, UNCENTRED, TRUTH, REPLAY, ICP, EVEN, PAPER)
NETWORKS = (LIBRARY, UNCENTRED, EVEN, PAPER)  # those that imitate by the networks


class Condition(NamedTuple):
    """What a row is measured under.

    Attributes:
        task: name of `tdf_jax.sim.tasks.TASKS`.
        target: "known" if the demonstrated target stands where it stood, "found" if another one is found.
        poses: how objects start.
        mode: "execute" or "teleport".
        clouds: "full", or what three cameras or one see.
        demonstrations: number of demonstrations, 1 or 10.
        method: one of `METHODS`.
        mass: mass of the object, kg; 0 for that by its volume.
        objects: "generated", or "meshes" for those of users, with demonstrations on generated ones.
        mask: how points of cameras are known to be the object's: by our own segmentation, or by the simulator's mask.
            Of complete clouds it is "segmented", and means nothing.
    """

    task: str
    target: str
    poses: str
    mode: str
    clouds: str = "full"
    demonstrations: int = 1
    method: str = LIBRARY
    mass: float = 0.0
    objects: str = GENERATED
    mask: str = SEGMENTED

    @property
    def inputs(self) -> str:
        """The clouds and the mask, in words."""
        return self.clouds + ", simulator's mask" * (self.mask == SIMULATOR)


@dataclasses.dataclass(frozen=True)
class Settings:
    """What the episodes of a campaign share; it is sent to every process.

    Attributes:
        condition: what they are measured under.
        object_weights, target_weights: names or files of the networks; the latter None if there is none.
        seed: seed of everything.
        folder: existing folder that keeps outcomes.
        robot, site: MJCF of another robot and the site of its gripper's frame; see `load_robot`.
        meshes: folder of the objects with a meshes.json, for a condition of "meshes"; episode n has mesh n, modulo
            their number. See `tdf_jax.evaluation.annotated_meshes`.
        recursive: read the meshes in subfolders too.
        playbacks: keep the motion of every episode in the folder too, to look at; outcomes do not depend on it.
    """

    condition: Condition
    object_weights: str
    target_weights: str | None
    seed: int
    folder: Path
    robot: Path | None = None
    site: str | None = None
    meshes: Path | None = None
    recursive: bool = False
    playbacks: bool = True


def check_condition(condition: Condition) -> None:
    """Raise InputError unless a condition can be measured."""
    function = "tdf simulate"
    for name, choices in (
        ("task", TASKS),
        ("target", TARGETS),
        ("poses", POSES),
        ("mode", MODES),
        ("clouds", CLOUDS),
        ("method", METHODS),
        ("mask", MASKS),
        ("objects", OBJECTS),
    ):
        checks.choice(function, name, getattr(condition, name), choices)
    if condition.demonstrations not in (1, DEMONSTRATIONS):
        raise InputError(f"{function}: demonstrations is {condition.demonstrations}; expected 1 or {DEMONSTRATIONS}")
    if condition.clouds == "full" and condition.mask != SEGMENTED:
        raise InputError(
            f"{function}: mask is {condition.mask!r}, and complete clouds need none; expected --clouds of cameras"
        )
    if TASKS[condition.task].target == "board" and condition.target == "found":
        raise InputError(f"{function}: the shelf of {condition.task} is known; expected --target known")
    if condition.demonstrations > 1 and condition.target == "known":
        raise InputError(
            f"{function}: a known target stands where it stood in one demonstration; expected --target found, or "
            "--demonstrations 1"
        )
    if condition.demonstrations > 1 and condition.method != LIBRARY:
        raise InputError(f"{function}: {condition.method} has one demonstration; expected --demonstrations 1")


def check_settings(settings: Settings) -> None:
    """Raise InputError unless the condition of a campaign can be measured with the rest of its settings."""
    condition, function = settings.condition, "tdf simulate"
    check_condition(condition)
    if condition.target == "found" and settings.target_weights is None and condition.method in NETWORKS:
        raise InputError(
            f"{function}: there are no weights of a {TASKS[condition.task].target}, which is to be found; expected "
            "--target known, or --target-weights FILE of a network from tdf train"
        )
    if (condition.objects == MESHES) != (settings.meshes is not None):
        raise InputError(
            f"{function}: objects is {condition.objects!r} and meshes is {settings.meshes}; expected a folder for "
            f"{MESHES!r} alone"
        )
