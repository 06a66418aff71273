"""Picks learnt from several demonstrations, each on another mug: success against their number."""

import dataclasses
import functools
from collections.abc import Callable, Sequence
from importlib.metadata import version
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from tqdm import tqdm

from tdf_jax._internal.files import kept
from tdf_jax.energy.reference import COMBINATIONS, Reference, describe
from tdf_jax.evaluation.cases import mug_of
from tdf_jax.evaluation.methods import EVERY, STREAM
from tdf_jax.evaluation.metrics import pose_error
from tdf_jax.evaluation.path_tasks import Task
from tdf_jax.geometry import se3
from tdf_jax.geometry.demonstration import Demonstration
from tdf_jax.geometry.sampling import sample_surface
from tdf_jax.geometry.trajectory import Trajectory
from tdf_jax.networks.encoding import encode
from tdf_jax.networks.model import Model, fingerprint
from tdf_jax.solvers.pick import carry

FORMAT = 1  # of what is kept
# demonstrated mugs are numbered from here, apart from those of the tasks; so many a task
MUGS, MOST = 1_000_000_000, 100
POINTS = 1500


@dataclasses.dataclass(frozen=True)
class Learnt:
    """Picks learnt from `count` demonstrations combined in a `way`, on targets seen as `clouds`: errors in metres and degrees."""

    clouds: str
    count: int
    way: str
    distances: list[float]
    angles: list[float]


def learnt(
    makers: Sequence[Callable[[], Task]],
    model: Model,
    counts: Sequence[int],
    folder: Path,
    *,
    seed: int = 0,
    progress: bool = True,
) -> list[Learnt]:
    """Picks on the targets of every fifth task, learnt from 1, 3, ... demonstrations at the place of other mugs of the same height.

    Args:
        makers: each makes a task; its target, its query points and its truth are used.
        model: the network.
        counts: numbers of demonstrations, up to `MOST`.
        folder: keeps the picks; it exists.
        seed: of the demonstrated mugs and the starts.
        progress: show a progress bar.
    """
    groups: dict[tuple, list] = {}
    counts = tuple(dict.fromkeys(counts))
    about = [FORMAT, version("tdf_jax"), jax.default_backend(), fingerprint(model), seed]
    for make in tqdm(makers if counts else (), desc="demonstrations", unit="task", disable=not (progress and counts)):
        task = make()
        if task.index % EVERY:
            continue
        shown = functools.cache(functools.partial(_demonstrations, task, seed, max(counts)))
        for count in counts:
            for way in COMBINATIONS if count > 1 else COMBINATIONS[:1]:
                what = [*about, *task.identity, count, way]
                found = kept(
                    "tdf benchmark",
                    folder,
                    what,
                    lambda count=count, way=way: _pick(task, model, shown()[:count], way, seed),
                    _errors,
                )
                groups.setdefault((task.case.clouds, count, way), []).append(found)
    return [Learnt(*name, *map(list, zip(*found))) for name, found in groups.items()]


def _demonstrations(task, seed, count) -> list[Demonstration]:
    """One pose at the handle of each of `count` mugs of the target's height."""
    shown = []
    parameters = task.case.object_a.parameters
    for number in range(count):
        mug = mug_of(seed, MUGS + MOST * task.index + number, parameters.height)
        pose = se3.pose(
            *(jnp.asarray(part, jnp.float32) for part in (mug.handle_frame[:3, :3], mug.handle_frame[:3, 3]))
        )
        points = sample_surface(mug.mesh, POINTS, number).astype(np.float32)
        shown.append(Demonstration(points, Trajectory(pose[None]), task.demonstration.query))
    return shown


def _pick(task, model, shown, way, seed) -> dict:
    key = jax.random.fold_in(jax.random.fold_in(jax.random.key(seed), STREAM), task.index)
    reference: Reference = describe(model, shown, combine=way)
    result = carry(encode(model, task.case.points_b), reference, key, fix_last=False)
    distance, angle = pose_error(result.trajectory.wxyz_xyz[0], task.expected.wxyz_xyz[0])
    return {"distance": distance, "angle": np.degrees(angle)}


def _errors(arrays) -> tuple[float, float]:
    return float(arrays["distance"]), float(arrays["angle"])
