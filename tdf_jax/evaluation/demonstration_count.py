"""Picks from several demonstrations, each on another mug: their errors against the number of demonstrations."""

import dataclasses
import functools
from collections.abc import Callable, Sequence
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from tqdm.auto import tqdm

from tdf_jax._internal.cache import kept
from tdf_jax._internal.version import __version__
from tdf_jax.energy.reference import COMBINATIONS, Reference, describe
from tdf_jax.evaluation.cases import mug_of
from tdf_jax.evaluation.metrics import pose_error
from tdf_jax.evaluation.path_methods import EVERY, STREAM
from tdf_jax.evaluation.path_tasks import Task
from tdf_jax.geometry import se3
from tdf_jax.geometry.demonstration import Demonstration
from tdf_jax.geometry.sampling import sample_surface
from tdf_jax.geometry.trajectory import Trajectory
from tdf_jax.networks.encoding import encode
from tdf_jax.networks.model import Model, fingerprint
from tdf_jax.solvers.pick import carry

FORMAT = 2  # format number of the stored results
# Number of the first demonstrated mug, so that no task has it; and the most demonstrated mugs of a task.
MUGS, MOST = 1_000_000_000, 100
POINTS = 1500


@dataclasses.dataclass(frozen=True)
class CountErrors:
    """Errors of picks from a number of demonstrations.

    Attributes:
        clouds: condition of the targets' clouds.
        count: number of demonstrations.
        way: how they are combined, one of `tdf_jax.energy.reference.COMBINATIONS`.
        distances: position errors, (tasks,), metres.
        angles: rotation errors, (tasks,), degrees.
    """

    clouds: str
    count: int
    way: str
    distances: list[float]
    angles: list[float]


def count_errors(
    makers: Sequence[Callable[[], Task]],
    model: Model,
    counts: Sequence[int],
    folder: Path,
    *,
    seed: int = 0,
    progress: bool = True,
) -> list[CountErrors]:
    """Pick on the targets of every fifth task, from demonstrations at the handles of other mugs of the same height.

    Args:
        makers: functions that make one task each; its target, query points and ground truth are used.
        model: the network.
        counts: numbers of demonstrations, up to `MOST`.
        folder: existing folder that keeps the picks.
        seed: seed of the demonstrated mugs and the starts.
        progress: show a progress bar.
    """
    groups: dict[tuple, list] = {}
    counts = tuple(dict.fromkeys(counts))
    about = [FORMAT, __version__, jax.default_backend(), fingerprint(model), seed]
    for make in tqdm(makers if counts else (), desc="demonstrations", unit="task", disable=not (progress and counts)):
        task = make()
        if task.index % EVERY:
            continue
        demonstrations = functools.cache(functools.partial(_demonstrations, task, seed, max(counts)))
        for count in counts:
            for way in COMBINATIONS if count > 1 else COMBINATIONS[:1]:
                what = [*about, *task.identity, count, way]

                def arrays(task=task, demonstrations=demonstrations, count=count, way=way):
                    return _pick(task, model, demonstrations()[:count], way, seed)

                errors = kept("tdf benchmark", folder, what, arrays, _errors)
                groups.setdefault((task.case.clouds, count, way), []).append(errors)
    return [CountErrors(*group, *map(list, zip(*errors))) for group, errors in groups.items()]


def _demonstrations(task, seed, count) -> list[Demonstration]:
    """One pose at the handle, on each of several mugs."""
    demonstrations, parameters = [], task.case.object_a.parameters
    for number in range(count):
        mug = mug_of(seed, MUGS + MOST * task.index + number, parameters.height)
        pose = se3.pose(
            *(jnp.asarray(part, jnp.float32) for part in (mug.handle_frame[:3, :3], mug.handle_frame[:3, 3]))
        )
        points = sample_surface(mug.mesh, POINTS, number).astype(np.float32)
        demonstrations.append(Demonstration(jax.device_put(points), Trajectory(pose[None]), task.demonstration.query))
    return demonstrations


def _pick(task, model, demonstrations, way, seed) -> dict:
    key = jax.random.fold_in(jax.random.fold_in(jax.random.key(seed), STREAM), task.index)
    reference: Reference = describe(model, demonstrations, combine=way)
    result = carry(encode(model, jax.device_put(task.case.points_b)), reference, key, fix_last=False)
    distance, angle = pose_error(result.trajectory.wxyz_xyz[0], task.expected.wxyz_xyz[0])
    return {"distance": distance, "angle": np.degrees(angle)}


def _errors(arrays) -> tuple[float, float]:
    return float(arrays["distance"]), float(arrays["angle"])
