"""Many episodes in physics under one condition, in several processes, kept between runs."""

import concurrent.futures
import contextlib
import dataclasses
import json
import math
import multiprocessing
import os
import time
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from tqdm.auto import tqdm

from tdf_jax._internal import checks, workers
from tdf_jax._internal.cache import digest, kept
from tdf_jax._internal.errors import InputError
from tdf_jax.sim.condition import Condition, Settings, check_settings
from tdf_jax.sim.episode import NOT_DRAWN, NOT_FOUND, Outcome
from tdf_jax.sim.imitator import FIRST_DEMONSTRATION, Found, Imitator, load_imitator, load_objects
from tdf_jax.sim.tasks import Episode, NotDrawn

if TYPE_CHECKING:
    from tdf_jax.sim.robot import Robot

FORMAT = 6  # format number; raise it when what becomes of an imitation changes
MOST_PROCESSES = 1024  # more are a mistake


@dataclasses.dataclass(frozen=True)
class Run:
    """An episode and what became of it.

    Attributes:
        condition: what it was measured under.
        number: number of the episode.
        outcome: what became of it; that it was not drawn, if no start is within reach.
        rejected, redrawn: starts and pairs drawn before it; see `tdf_jax.sim.tasks.Episode`.
        seconds: wall times of imitation, planning and physics, with what each compiled; they differ from run to run.
        instance: name of the user's mesh; empty for a generated object, of which every episode has its own.
    """

    condition: Condition
    number: int
    outcome: Outcome
    rejected: int
    redrawn: int
    seconds: tuple[float, float, float]
    instance: str = ""

    @property
    def object(self) -> str | int:
        """What intervals are over: the mesh, or the number of the episode."""
        return self.instance or self.number


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
        episodes: number of episodes. The outcome of one of which no start is within reach says that it is not drawn.
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
    count = min(episodes, processes or _cores())
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


def _cores() -> int:
    """Number of cores that this process may use; of all, where the system does not say."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


@contextlib.contextmanager
def process_pool(count: int):
    """Processes in which a product of matrices uses one core: the order of its sums is the same in all.

    Raises:
        InputError: one of them ended by itself.
    """
    flag, name = "--xla_cpu_multi_thread_eigen=false", "XLA_FLAGS"
    before = os.environ.get(name)
    os.environ[name] = f"{before} {flag}" if before else flag
    try:
        context = multiprocessing.get_context("spawn")
        with concurrent.futures.ProcessPoolExecutor(count, context, initializer=workers.begin) as pool:
            yield pool
    except concurrent.futures.process.BrokenProcessPool:
        raise InputError(
            "tdf simulate: a process ended by itself, perhaps for lack of memory; what is finished is kept. Run the "
            "command again, with --processes 1 if it ends again"
        ) from None
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
    return Run(
        settings.condition,
        number,
        Outcome(**fields),
        rejected=int(result["rejected"]),
        redrawn=int(result["redrawn"]),
        seconds=(imitation, planning, executed - planning),
        instance=result["instance"].item(),
    )


def _kept(settings: Settings, number: int, view: bool = False) -> dict[str, np.ndarray]:
    """The arrays of an episode: kept, or computed and kept."""
    imitator = load_imitator(settings)
    about = ["episode", FORMAT, *imitator.depends_on(number), *settings.condition]
    # A viewed episode runs, also if its outcome is kept.
    viewed = _run(imitator, number, view=True) if view else None
    return kept("tdf simulate", settings.folder, about, lambda: viewed or _run(imitator, number))


def _run(imitator: Imitator, number: int, view: bool = False) -> dict[str, Any]:
    """Imitate and run one episode: arrays to keep."""
    from tdf_jax.sim.episode import run_episode, teleport
    from tdf_jax.sim.playback import FOLDER, Sampler, save_playback
    from tdf_jax.sim.viewer import Viewer

    condition, scan = imitator.condition, imitator.scan(number)
    instance = "" if scan is None else scan.name
    try:
        episode, demonstration = imitator.episode(number)
        found = imitator.found(episode, demonstration)
    except NotDrawn as error:
        return _arrays(Outcome.failure(NOT_DRAWN, str(error)), error, (0.0, 0.0, 0.0), instance)
    sampler = Sampler(episode, imitator.robot)
    began = planned = time.perf_counter()

    def plan_ends():
        nonlocal planned
        planned = time.perf_counter()

    if not len(found.paths):
        outcome = Outcome.failure(NOT_FOUND, found.reason)
    elif condition.mode == "execute":
        with watched(Viewer) as (show, _):

            def watch(cell, data, phase):
                sampler.watch(cell, data, phase)
                if view:
                    show(cell, data, phase)

            candidates = list(found.paths), found.openings.tolist()
            outcome = run_episode(episode, imitator.robot, *candidates, watch=watch, planned=plan_ends)
    else:
        pick, opening = found.paths[0, 0], found.openings[0]
        outcome = teleport(episode, imitator.robot, pick, found.motion, opening, watch=sampler.watch)
    seconds = (found.seconds, time.perf_counter() - began, planned - began)
    path = found.paths[0] if len(found.paths) else np.zeros((0, 4, 4))
    if imitator.settings.playbacks:
        playback = sampler.playback(_described(imitator.settings, number, instance, outcome), found.points, path)
        save_playback("tdf simulate", imitator.settings.folder / FOLDER, _file_name(imitator, number), playback)
    return _arrays(outcome, episode, seconds, instance)


def _arrays(
    outcome: Outcome, drawn: Episode | NotDrawn, seconds: tuple[float, float, float], instance: str
) -> dict[str, Any]:
    """What is kept of an episode; its times are those of imitation, of planning and physics, and of planning alone."""
    counts = {"rejected": drawn.rejected, "redrawn": drawn.redrawn}
    return {**dataclasses.asdict(outcome), **counts, "seconds": seconds, "instance": instance}


def _file_name(imitator: Imitator, number: int) -> str:
    """Name of the file of an episode: what it is for the reader, and a digest of all that it depends on."""
    condition = imitator.condition
    words = (condition.task, condition.mode, condition.target, condition.poses, condition.method, f"{number:04d}")
    about = digest(json.dumps([*imitator.depends_on(number), *condition], sort_keys=True).encode())
    return f"{'-'.join(words).replace(' ', '_')}-{about[:8]}"


def about_episode(settings: Settings, number: int) -> dict[str, Any]:
    """What an episode is measured under, in types of JSON; see `tdf_jax.sim.playback.Playback`."""
    return {**settings.condition._asdict(), "seed": settings.seed, "number": number}


def _described(settings: Settings, number: int, instance: str, outcome: Outcome) -> dict[str, Any]:
    """What an episode was and what became of it."""
    results = {name: getattr(outcome, name) for name in ("overall", "strict", "cause", "detail")}
    for name in ("slip", "turn"):
        value = float(getattr(outcome, name))
        results[name] = None if math.isnan(value) else value
    return about_episode(settings, number) | {"instance": instance} | results


def found_in(settings: Settings, number: int) -> tuple[Episode, "Robot", Found]:
    """What an episode is, and what was imitated in it: kept, or computed and kept.

    Args:
        settings: what the episodes share.
        number: number of the episode.

    Returns:
        The episode, the robot, and what was imitated.

    Raises:
        InputError: nothing is drawn or imitated.
    """
    imitator = load_imitator(settings)
    try:
        episode, demonstration = imitator.episode(number)
        found = imitator.found(episode, demonstration)
    except NotDrawn as error:
        raise InputError(f"tdf simulate: episode {number} has no motion: {error}") from None
    if not len(found.paths):
        raise InputError(f"tdf simulate: episode {number} has no motion: {found.reason}")
    return episode, imitator.robot, found


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

    episode, robot, found = found_in(settings, number)
    with watched(Recorder) as (watch, recorders):
        outcome = run_episode(episode, robot, list(found.paths), found.openings.tolist(), watch=watch)
        if not recorders:
            raise InputError(f"tdf simulate: episode {number} has no motion to film: {outcome.detail}")
        recorders[0].save(path)
    return outcome


@contextlib.contextmanager
def watched(kind):
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
