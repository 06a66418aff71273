"""Many episodes: imitations of one demonstration in physics, in several processes, kept between runs."""

import concurrent.futures
import contextlib
import dataclasses
import functools
import math
import multiprocessing
import os
import time
from collections.abc import Iterator, Sequence
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from jaxtyping import Float
from tqdm import tqdm

from tdf_jax._internal import checks, workers
from tdf_jax._internal.cache import digest, kept
from tdf_jax._internal.errors import InputError
from tdf_jax.sim.episode import MODES, NOT_DRAWN, NOT_FOUND, Outcome
from tdf_jax.sim.tasks import POSES, TASKS, Episode, NotDrawn

if TYPE_CHECKING:
    from tdf_jax.energy.reference import Reference
    from tdf_jax.geometry.demonstration import Demonstration
    from tdf_jax.sim.replay import Replay
    from tdf_jax.sim.robot import Robot
    from tdf_jax.sim.scans import Scan

FORMAT = 7  # format number; raise it when what an episode computes changes
DEMONSTRATIONS = 10  # episodes that demonstrate; with one demonstration, each is that of a tenth of the episodes
FIRST_DEMONSTRATION = 1_000_000  # their numbers begin here, so that no episode shares their objects
MOST_PROCESSES = 1024  # more are a mistake
GENERATED, MESHES = OBJECTS = ("generated", "meshes")
CLOUDS = ("full", "views3", "views1")
TARGETS = ("known", "found")
LIBRARY, UNCENTRED, TRUTH, REPLAY, ICP = "tdf_jax", "uncentred", "truth", "rigid replay", "ICP"
EVEN, PAPER = "even blending", "paper"
METHODS = (LIBRARY, UNCENTRED, TRUTH, REPLAY, ICP, EVEN, PAPER)
NETWORKS = (LIBRARY, UNCENTRED, EVEN, PAPER)  # those that imitate by the networks
POINTS = 1500  # of a complete cloud
VIEWED = 4000  # most points of a cloud of cameras: the field takes a subsample


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


@dataclasses.dataclass(frozen=True)
class Run:
    """An episode and what became of it.

    Attributes:
        condition: what it was measured under.
        number: number of the episode.
        outcome: what became of it; that it was not drawn, if no start is within reach.
        rejected, redrawn: starts and pairs drawn before it; see `tdf_jax.sim.tasks.Episode`.
        seconds: times of the imitation, and of planning and physics together, with what each compiled; they differ
            from run to run.
        planning: time of the planning alone; NaN if it is not known.
        instance: name of the user's mesh; empty for a generated object, of which every episode has its own.
    """

    condition: Condition
    number: int
    outcome: Outcome
    rejected: int
    redrawn: int
    seconds: tuple[float, float]
    planning: float = math.nan
    instance: str = ""

    @property
    def object(self) -> str | int:
        """What intervals are over: the mesh, or the number of the episode."""
        return self.instance or self.number


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
        ("objects", OBJECTS),
    ):
        checks.choice(function, name, getattr(condition, name), choices)
    if condition.demonstrations not in (1, DEMONSTRATIONS):
        raise InputError(f"{function}: demonstrations is {condition.demonstrations}; expected 1 or {DEMONSTRATIONS}")
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


def check_counts(function: str, episodes: int, processes: int | None, dashes: str) -> None:
    """Raise InputError unless so many episodes can run in so many processes.

    Args:
        function: begins the message.
        episodes: number of episodes.
        processes: number of processes; None for one for every core.
        dashes: what stands before both names in the message.
    """
    checks.count(function, f"{dashes}episodes", episodes, 1, FIRST_DEMONSTRATION)
    if processes is not None:
        checks.count(function, f"{dashes}processes", processes, 1, MOST_PROCESSES)


def run_campaign(
    settings: Settings, episodes: int, processes: int | None = None, progress: bool = True, view: bool = False
) -> Iterator[Run]:
    """Run episodes 0 to `episodes` - 1 in several processes; an interrupted run continues where it stopped.

    The outcomes are the same for any number of processes.

    Args:
        settings: what the episodes share.
        episodes: number of episodes. One of which no start is within reach is said to be not drawn.
        processes: number of processes; by default one for every core.
        progress: show a progress bar.
        view: show the first episode in MuJoCo's viewer while it runs, also if its outcome is kept; see `Viewer`.

    Yields:
        The episodes, in order.

    Raises:
        InputError: the condition cannot be measured, a number is out of range, or a mesh cannot be used.
    """
    check_settings(settings)
    check_counts("run_campaign()", episodes, processes, "")
    for scan in load_objects(settings)[:episodes]:
        _ = scan.body  # split into convex parts once, and not in every process
    count = min(episodes, processes or len(os.sched_getaffinity(0)))
    bar = tqdm(
        total=episodes,
        desc=f"{settings.condition.task}, {settings.condition.mode}",
        unit="episode",
        disable=not progress,
    )
    with process_pool(count) as pool:
        pending = [pool.submit(run_one, settings, number, view and number == 0) for number in range(episodes)]
        try:
            for one in pending:
                yield one.result()
                bar.update()
        finally:
            for one in pending:
                one.cancel()
            bar.close()


def load_objects(settings: Settings) -> "list[Scan]":
    """The users' meshes of the task's category, in the order of their names; none if objects are generated.

    Args:
        settings: what the episodes share.

    Raises:
        InputError: a mesh cannot be used, or there is none.
    """
    if settings.meshes is None:
        return []
    from tdf_jax.sim.scans import load_scans

    category = TASKS[settings.condition.task].object
    return load_scans("tdf simulate", settings.meshes, settings.recursive, category)


@contextlib.contextmanager
def process_pool(count: int):
    """Processes in which a product of matrices uses one core: the order of its sums is the same in all."""
    flag, name = "--xla_cpu_multi_thread_eigen=false", "XLA_FLAGS"
    before = os.environ.get(name)
    os.environ[name] = f"{before} {flag}" if before else flag
    try:
        context = multiprocessing.get_context("spawn")
        with concurrent.futures.ProcessPoolExecutor(count, context, initializer=workers.begin) as pool:
            yield pool
    finally:
        if before is None:
            del os.environ[name]
        else:
            os.environ[name] = before


def run_one(settings: Settings, number: int, view: bool = False) -> Run:
    """Run one episode, or read what became of it.

    Args:
        settings: what the episodes share; the mode of a viewed one is execute.
        number: number of the episode.
        view: run it, and show it in MuJoCo's viewer. Its outcome is the same.
    """
    result = _kept(settings, number, view)
    fields = {field.name: result[field.name].item() for field in dataclasses.fields(Outcome)}
    imitation, executed, planning = map(float, result["seconds"])
    drawn, instance = (int(result["rejected"]), int(result["redrawn"])), result["instance"].item()
    return Run(settings.condition, number, Outcome(**fields), *drawn, (imitation, executed), planning, instance)


def _kept(settings: Settings, number: int, view: bool = False) -> dict[str, np.ndarray]:
    """The arrays of an episode: kept, or computed and kept."""
    bench = _bench(settings)
    scan = bench.scan(number)
    about = [
        *(FORMAT, version("tdf_jax"), *bench.fingerprints, *bench.robot_content, *settings.condition),
        *(settings.seed, number, None if scan is None else [scan.name, scan.digest]),
    ]
    # A viewed episode runs, also if its outcome is kept.
    viewed = bench.run(number, view=True) if view else None
    return kept("tdf simulate", settings.folder, about, lambda: bench.run(number) if viewed is None else viewed)


def found_in(settings: Settings, number: int) -> tuple[Episode, "Robot", Float[np.ndarray, "_ _ 4 4"], np.ndarray]:
    """What an episode is, and what was imitated in it: kept, or computed and kept.

    Args:
        settings: what the episodes share.
        number: number of the episode.

    Returns:
        The episode, the robot, trajectories of the gripper from the pick to the release, (paths, poses, 4, 4), metres,
        world frame, the best first, and the motion M of the object, 4x4.

    Raises:
        InputError: nothing is drawn or imitated.
    """
    result = _kept(settings, number)
    if not len(result["paths"]):
        raise InputError(f"tdf simulate: episode {number} has no motion: {result['detail'].item()}")
    bench = _bench(settings)
    return bench.episode(number)[0], bench.robot, result["paths"], result["motion"]


def film(settings: Settings, number: int, path: Path) -> Outcome:
    """Execute an episode again, and film it.

    Args:
        settings: what the episodes share; the mode is execute.
        number: number of the episode.
        path: .gif or .mp4 file.

    Returns:
        The outcome, the same as of the campaign.

    Raises:
        InputError: nothing can be rendered here, the ending is another one, or the episode has no motion.
    """
    # In a process as those of the campaign: in this one, sums of products may have another order.
    with process_pool(1) as pool:
        return pool.submit(film_one, settings, number, path).result()


def film_one(settings: Settings, number: int, path: Path) -> Outcome:
    """As `film`, in this process."""
    from tdf_jax.sim.episode import run_episode
    from tdf_jax.sim.recording import Recorder

    episode, robot, paths, _ = found_in(settings, number)
    with _watched(Recorder) as (watch, recorders):
        outcome = run_episode(episode, robot, list(paths), watch=watch)
        if not recorders:
            raise InputError(f"tdf simulate: episode {number} has no motion to film: {outcome.detail}")
        recorders[0].save(path)
    return outcome


@contextlib.contextmanager
def _watched(kind):
    """What `run_episode` calls, and the one `Recorder` or `Viewer` that it makes of the cell at the first step."""
    made: list = []

    def watch(cell, data, phase):
        if not made:
            made.append(kind(cell.model))
        made[0].watch(data, phase=phase)

    try:
        yield watch, made
    finally:
        for one in made:
            one.close()


def centred_path(
    path: Float[np.ndarray, "poses 4 4"], points: Float[np.ndarray, "points 3"], opening: float, robot: "Robot"
) -> Float[np.ndarray, "poses 4 4"]:
    """A path whose pick is centred on the cloud; see `tdf_jax.sim.centring`. The object moves as before.

    Args:
        path: poses of the gripper's frame from the pick to the release, (poses, 4, 4).
        points: cloud of the object at the pick, (points, 3), metres, world frame.
        opening: opening of the fingers before they close, metres.
        robot: the robot.
    """
    from tdf_jax.sim.centring import centred

    return path @ (np.linalg.inv(path[0]) @ centred(path[0], points, opening, robot.fingers))


@functools.lru_cache(maxsize=1)
def _bench(settings: Settings) -> "_Bench":
    return _Bench(settings)


class _Bench:
    """What one process needs for the episodes of a campaign: networks, demonstrations and the robot."""

    def __init__(self, settings: Settings):
        from tdf_jax.networks.checkpoint import load_model
        from tdf_jax.networks.model import fingerprint
        from tdf_jax.sim.robot import load_robot

        self.settings, self.condition = settings, settings.condition
        self.robot = load_robot(settings.robot, settings.site)
        self.model = load_model(settings.object_weights)
        self.target_model = None if settings.target_weights is None else load_model(settings.target_weights)
        self.fingerprints = [
            fingerprint(self.model), None if self.target_model is None else fingerprint(self.target_model)
        ]  # fmt: skip
        # Of the package's robot nothing: its version is pinned.
        self.robot_content = [] if settings.robot is None else [digest(settings.robot.read_bytes()), settings.site]
        self.scans = load_objects(settings)
        self._shown: dict[int, tuple[Episode, Demonstration] | NotDrawn] = {}
        self._described: dict[int, Reference] = {}
        self._paper: dict[int, Reference] = {}

    def scan(self, number: int) -> "Scan | None":
        """The user's mesh that an episode has; None if its object is generated."""
        return self.scans[number % len(self.scans)] if self.scans else None

    def shown(self, number: int) -> "tuple[Episode, Demonstration]":
        """The demonstrated episode and the demonstration.

        Raises:
            NotDrawn: nothing within reach is drawn.
        """
        from tdf_jax.sim.tasks import demonstrate_episode, draw_episode

        if number not in self._shown:
            try:
                episode = draw_episode(
                    self.condition.task, self.robot, self.settings.seed, FIRST_DEMONSTRATION + number, "upright"
                )
                self._shown[number] = episode, demonstrate_episode(episode, self.settings.seed)
            except NotDrawn as error:  # so that it is not tried again for every episode
                self._shown[number] = error
        found = self._shown[number]
        if isinstance(found, NotDrawn):
            raise NotDrawn(f"{found} (of the demonstrations)")
        return found

    def reference(self, number: int) -> "Reference":
        """The descriptors of a demonstration, or of all."""
        from tdf_jax.energy.reference import describe

        if number not in self._described:
            several = range(DEMONSTRATIONS) if number < 0 else (number,)
            demonstrations = [self.shown(one)[1] for one in several]
            self._described[number] = describe(self.model, demonstrations, target_model=self.target_model)
        return self._described[number]

    def paper_reference(self, number: int) -> "Reference":
        """The descriptors of a demonstration for the paper's method."""
        from tdf_jax.sim.replay import describe_without_target

        if number not in self._paper:
            self._paper[number] = describe_without_target(self.model, self.shown(number)[1])
        return self._paper[number]

    def episode(self, number: int):
        """An episode, and the number of the demonstration that it imitates; -1 for all of them."""
        from tdf_jax.sim.tasks import draw_episode

        condition, seed = self.condition, self.settings.seed
        shown = -1 if condition.demonstrations > 1 else number % DEMONSTRATIONS
        known = self.shown(shown)[0] if condition.target == "known" else None
        episode = draw_episode(condition.task, self.robot, seed, number, condition.poses, known, self.scan(number))
        if condition.mass:
            body = dataclasses.replace(
                episode.object_body,
                mass=condition.mass,
                inertia=episode.object_body.inertia * (condition.mass / episode.object_body.mass),
            )
            episode.__dict__["object_body"] = body
        return episode, shown

    def run(self, number: int, view: bool = False) -> dict:
        """Imitate and run one episode: arrays to keep."""
        from tdf_jax.sim.episode import run_episode, teleport
        from tdf_jax.sim.viewer import Viewer

        condition, scan = self.condition, self.scan(number)
        instance = "" if scan is None else scan.name
        try:
            episode, shown = self.episode(number)
            began = time.perf_counter()
            found = self.found(episode, shown)
        except NotDrawn as error:
            return {
                **dataclasses.asdict(Outcome.failure(NOT_DRAWN, str(error))),
                **{"rejected": error.rejected, "redrawn": error.redrawn, "seconds": (0.0, 0.0, 0.0)},
                **{"instance": instance, "paths": np.zeros((0, 0, 4, 4)), "motion": np.eye(4)},
            }
        imitated = planned = time.perf_counter()

        def plan_ends():
            nonlocal planned
            planned = time.perf_counter()

        if isinstance(found, Outcome):
            outcome = found
        elif condition.mode == "execute":
            with _watched(Viewer) as (watch, _):
                outcome = run_episode(episode, self.robot, found[0], watch=watch if view else None, planned=plan_ends)
        else:
            outcome = teleport(episode, self.robot, found[0][0][0], found[1])
        seconds = imitated - began, time.perf_counter() - imitated, planned - imitated
        return {
            **dataclasses.asdict(outcome),
            "rejected": episode.rejected,
            "redrawn": episode.redrawn,
            "seconds": seconds,
            "instance": instance,
            "paths": np.zeros((0, 0, 4, 4)) if isinstance(found, Outcome) else np.array(found[0]),
            "motion": np.eye(4) if isinstance(found, Outcome) else found[1],
        }

    def found(self, episode, shown: int) -> tuple[Sequence[np.ndarray], np.ndarray] | Outcome:
        """What is imitated in an episode; its outcome if nothing is found, or no camera sees one of the bodies."""
        if self.condition.method in NETWORKS:
            self.reference(shown)  # what is wrong with the weights is no failure of an episode, and ends the campaign
        try:
            return self.imitated(episode, shown)
        except NotDrawn:  # of the demonstrations
            raise
        except InputError as error:
            return Outcome.failure(NOT_FOUND, str(error))

    def imitated(self, episode, shown: int) -> tuple[Sequence[np.ndarray], np.ndarray]:
        """Trajectories of the gripper, the best first, and the motion of the object, by the condition's method.

        Raises:
            InputError: there are none, or a cloud is empty or too small.
        """
        from tdf_jax.sim.tasks import demonstrate_episode

        condition = self.condition
        true = episode.T_world_target @ episode.T_target_object @ np.linalg.inv(episode.T_world_object)
        if condition.method == TRUTH:
            path = demonstrate_episode(episode, self.settings.seed).trajectory
            return [np.asarray(path.matrices, float)], true
        points, target_points = self.clouds(episode)
        known = condition.target == "known"
        paths, motion = self.replay(episode.number, points, None if known else target_points, shown)
        if condition.method != UNCENTRED:
            paths = [centred_path(path, points, episode.grip.opening, self.robot) for path in paths]
        return paths, motion

    def clouds(self, episode) -> tuple[np.ndarray, np.ndarray]:
        """Clouds of object and target, (points, 3) each, metres, world frame."""
        from tdf_jax.evaluation.cases import SEED_SPACE
        from tdf_jax.evaluation.relation_tasks import moved
        from tdf_jax.geometry.sampling import sample_surface

        rng = np.random.default_rng([SEED_SPACE, self.settings.seed, episode.number, 9])
        if self.condition.clouds == "full":
            return tuple(  # of two: the checker does not count a generator
                moved(sample_surface(one.mesh, POINTS, rng), T).astype(np.float32)
                for one, T in ((episode.object, episode.T_world_object), (episode.target, episode.T_world_target))
            )  # type: ignore[return-value]
        from tdf_jax.sim.cameras import camera_ring, observed_points
        from tdf_jax.sim.workcell import OBJECT, TARGET, build_workcell

        cell = build_workcell(
            None, episode.object_body, episode.T_world_object, episode.target_body, episode.T_world_target
        )
        data, several = cell.data(), int(self.condition.clouds.removeprefix("views"))
        clouds = []
        for name, T in ((OBJECT, episode.T_world_object), (TARGET, episode.T_world_target)):
            cameras = camera_ring(several, T[:3, 3], azimuth=rng.uniform(0, 360))
            seen = observed_points(cell.model, data, cameras, name, rng=rng)
            chosen = rng.permutation(len(seen))[:VIEWED]
            clouds.append(seen[np.sort(chosen)].astype(np.float32))
        return clouds[0], clouds[1]

    def replay(self, number: int, points, target_points, shown: int) -> "Replay":
        """What a method finds by the clouds."""
        import jax

        from tdf_jax.imitation import imitate
        from tdf_jax.sim import replay

        method = self.condition.method
        key = jax.random.fold_in(jax.random.key(self.settings.seed), number)
        if method == REPLAY:
            return replay.replay_by_centroids(self.shown(shown)[1], points, target_points)
        if method == ICP:
            return replay.replay_by_registration(self.shown(shown)[1], points, target_points, key=key)
        result = imitate(
            self.model,
            self.reference(shown),
            points,
            target_points=target_points,
            target_model=self.target_model,
            key=key,
        )
        if method == EVEN:
            return replay.blend_evenly(self.shown(shown)[1], result)
        found = replay.replay_candidates(result)
        if method == PAPER:
            return replay.replay_by_energy(self.model, self.paper_reference(shown), points, result.goal, key=key)
        return found
