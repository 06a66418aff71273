"""Placements of every method on pairs of an object and a target, kept between runs, and how they are judged."""

import dataclasses
import functools
import time
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float
from tqdm.auto import tqdm

from tdf_jax._internal import checks
from tdf_jax._internal.cache import kept
from tdf_jax._internal.version import __version__
from tdf_jax.energy.reference import Reference, describe
from tdf_jax.evaluation.baselines import iterative_closest_points
from tdf_jax.evaluation.relation_success import Placed, judge
from tdf_jax.evaluation.relation_tasks import Placement, demonstrate, draw_pair, place_pair
from tdf_jax.evaluation.tabletop import moved
from tdf_jax.geometry import se3
from tdf_jax.geometry.demonstration import Demonstration
from tdf_jax.geometry.trajectory import Trajectory
from tdf_jax.networks.encoding import encode
from tdf_jax.networks.model import Model, fingerprint
from tdf_jax.relation.object_motion import Relations, find_relations
from tdf_jax.relation.two_objects import Objects, kept_points
from tdf_jax.solvers.pick import CarryConfig

FORMAT = 12  # format number; raise it when the computation of a placement or of its verdict changes
LIBRARY, UNSEATED = "tdf_jax", "unseated"
METHODS = (LIBRARY, UNSEATED, "ICP", "centroids")
DEMONSTRATIONS = 10  # pairs that demonstrate; with one demonstration, each is that of a tenth of the tests
FIRST_DEMONSTRATION = 1_000_000  # their numbers begin here, so that no test shares their objects
ICP_STARTS = 10


class Networks(NamedTuple):
    """The networks of a task.

    Attributes:
        object: network of the object.
        target: network of the target.
    """

    object: Model
    target: Model


class Condition(NamedTuple):
    """What a row of the table is measured under.

    Attributes:
        task: name of the task.
        poses: poses of both objects.
        clouds: condition of both clouds.
        demonstrations: number of demonstrations, 1 or 10.
    """

    task: str
    poses: str
    clouds: str
    demonstrations: int


@dataclasses.dataclass(frozen=True)
class Score:
    """A placement and its verdict.

    Attributes:
        method: name of the method.
        condition: what it is measured under.
        number: number of the pair.
        demonstrated: number of the demonstration, or -1 where all are used.
        placed: the verdict.
        seconds: time of the placement, both encodings included; the first of a run compiles.
        motion: motion M of the object, 4x4, metres, world frame.
    """

    method: str
    condition: Condition
    number: int
    demonstrated: int
    placed: Placed
    seconds: float
    motion: Float[np.ndarray, "4 4"]


def run(
    conditions: Sequence[Condition],
    networks: Mapping[str, Networks],
    methods: Sequence[str],
    folder: Path,
    *,
    pairs: int,
    seed: int = 0,
    progress: bool = True,
) -> Iterator[Score]:
    """Place objects by every method under every condition; an interrupted run continues where it stopped.

    Args:
        conditions: the conditions.
        networks: networks of every task.
        methods: names of `METHODS`.
        folder: existing folder that keeps the placements.
        pairs: number of pairs of each condition.
        seed: seed of pairs, poses, clouds and starts.
        progress: show a progress bar.

    Raises:
        InputError: there is no such method, task, poses or clouds, a kept file is damaged, or libigl is not installed.
    """
    for method in methods:
        checks.choice("run()", "methods", method, METHODS)
    demonstrators = {task: _Demonstrators(task, networks[task], seed) for task in networks}
    bar = tqdm(total=len(conditions) * pairs, desc="relations", unit="pair", disable=not progress)
    for condition in conditions:
        models = networks[condition.task]
        names = fingerprint(models.object), fingerprint(models.target)
        for number in range(pairs):
            shown = number % DEMONSTRATIONS if condition.demonstrations == 1 else -1
            attempts = _Attempts(condition, number, shown, models, demonstrators[condition.task], seed)
            for method in methods:
                if shown < 0 and method not in (LIBRARY, UNSEATED):
                    continue  # a baseline has one demonstration
                about = [FORMAT, __version__, jax.default_backend(), *names, *condition, number, shown, seed]
                result = kept("tdf benchmark", folder, [*about, method], functools.partial(attempts.of, method))
                verdict = Placed(**{field.name: result[field.name].item() for field in dataclasses.fields(Placed)})
                motion = np.asarray(result["motion"], float)
                yield Score(method, condition, number, shown, verdict, float(result["seconds"]), motion)
            bar.update()
    bar.close()


def success(scores: Sequence[Score], tolerance: float) -> Float[np.ndarray, " scores"]:
    """Which placements succeed, 1 or 0.

    Args:
        scores: the placements.
        tolerance: largest gap and penetration, metres.
    """
    return np.array([one.placed.holds(tolerance) for one in scores], float)


class _Demonstrators:
    """Demonstrations of a task and their descriptors, made when they are first needed."""

    def __init__(self, task: str, networks: Networks, seed: int):
        self._task, self._networks, self._seed = task, networks, seed
        self._shown: dict[int, Demonstration] = {}
        self._described: dict[int, Reference] = {}

    def shown(self, number: int) -> Demonstration:
        if number not in self._shown:
            pair = draw_pair(self._task, self._seed, FIRST_DEMONSTRATION + number)
            self._shown[number] = demonstrate(pair, self._seed)
        return self._shown[number]

    def reference(self, number: int) -> Reference:
        if number not in self._described:
            several = range(DEMONSTRATIONS) if number < 0 else (number,)
            self._described[number] = describe(
                self._networks.object, [self.shown(one) for one in several], target_model=self._networks.target
            )
        return self._described[number]


class _Attempts:
    """Placements of one pair; what several methods share is computed once, when it is first needed."""

    def __init__(self, condition: Condition, number: int, shown: int, networks: Networks, demonstrators, seed: int):
        self._condition, self._number, self._shown, self._seed = condition, number, shown, seed
        self._networks, self._demonstrators = networks, demonstrators

    @functools.cached_property
    def _placement(self) -> Placement:
        pair = draw_pair(self._condition.task, self._seed, self._number)
        return place_pair(pair, self._seed, self._condition.poses, self._condition.clouds)

    @functools.cached_property
    def _found(self) -> tuple[Relations, float]:
        reference, placement = self._demonstrators.reference(self._shown), self._placement
        began = time.perf_counter()
        field, kept = encode(self._networks.object, placement.points, return_kept=True)
        target, kept_of_target = encode(self._networks.target, placement.target_points, return_kept=True)
        points = kept_points(placement.points, kept), kept_points(placement.target_points, kept_of_target)
        objects = Objects(*points, field, target)
        key = jax.random.fold_in(jax.random.key(self._seed), self._number)
        found = find_relations("tdf benchmark", objects, reference, key, CarryConfig(), seat=True)
        return found, time.perf_counter() - began

    def of(self, method: str) -> dict:
        """The motion of the object by a method, 4x4, the seconds that it took, and the verdict."""
        motion, seconds = self._library(method) if method in (LIBRARY, UNSEATED) else self._baseline(method)
        verdict = judge(self._placement.pair, self._placement.placed(motion))
        return {"motion": motion, "seconds": seconds, **dataclasses.asdict(verdict)}

    def _library(self, method: str) -> tuple[np.ndarray, float]:
        found, seconds = self._found
        if method == UNSEATED:  # the seconds are those of both, because they are one search
            found = dataclasses.replace(found, seatings=np.zeros_like(found.seatings))
        return np.asarray(Trajectory(found.motions[:1]).matrices[0], float), seconds

    def _baseline(self, method: str) -> tuple[np.ndarray, float]:
        demonstration, placement = self._demonstrators.shown(max(self._shown, 0)), self._placement
        target = demonstration.target
        points, target_points = np.asarray(demonstration.points, float), np.asarray(target.points, float)
        demonstrated = np.asarray(Trajectory(jnp.asarray(demonstration.object_motion)[None]).matrices[0], float)
        began = time.perf_counter()
        if method == "centroids":
            # The demonstrated offset of the centroids, in the world's axes, and no turn.
            motion = np.eye(4)
            offset = moved(points, demonstrated).mean(axis=0) - target_points.mean(axis=0)
            motion[:3, 3] = placement.target_points.mean(axis=0) + offset - placement.points.mean(axis=0)
        else:
            key = jax.random.fold_in(jax.random.key(self._seed), self._number)
            rotations = np.asarray(se3.uniform_rotations(key, ICP_STARTS), float)
            of_object = iterative_closest_points(points, placement.points, rotations)
            of_target = iterative_closest_points(target_points, placement.target_points, rotations)
            motion = of_target @ demonstrated @ np.linalg.inv(of_object)
        return motion, time.perf_counter() - began
