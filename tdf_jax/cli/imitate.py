"""`tdf imitate`: the main job, from files or generated objects to a folder of results."""

import contextlib
import dataclasses
import json
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Any

import jax
import numpy as np
import tyro
from tqdm.auto import tqdm

from tdf_jax._internal import checks
from tdf_jax._internal.errors import InputError
from tdf_jax._internal.files import replace_file, replace_folder
from tdf_jax.cli.camera import choose, read_scene, table as cluster_table
from tdf_jax.cli.imitation_record import errors_of, plain_settings, record_of, relation_of, table_of, title_of
from tdf_jax.cli.options import Settings, resolved
from tdf_jax.cli.pictures import Pictures, check_animation, check_page
from tdf_jax.cli.scenes import make_scene
from tdf_jax.cli.targets import imitate_targets
from tdf_jax.cli.tasks import make_task
from tdf_jax.energy.losses import EnergyWeights
from tdf_jax.energy.reference import describe
from tdf_jax.imitation import imitate as imitate_scene
from tdf_jax.io.pointclouds import load_points
from tdf_jax.io.trajectories import save_trajectory
from tdf_jax.networks.checkpoint import load_model
from tdf_jax.networks.model import Model
from tdf_jax.solvers.adam import OptimizeConfig
from tdf_jax.solvers.imitation_scene import SCENE, ImitationScene, save_imitation, weights_of
from tdf_jax.solvers.multistart import SolveConfig
from tdf_jax.solvers.pick import CarryConfig

# Folded into the seed's key: `random_pose` draws a generated mug's rotation from the key of the same seed, and a start
# drawn from that one would be the answer.
STREAM = 0x1D317A7E
RESULT, PAGE = "result.json", "imitation.html"
NAMES = (RESULT, SCENE, "trajectory.npz", "trajectory.tum", "imitation.png", "loss.png", PAGE)


def imitate(settings: Annotated[Settings, tyro.conf.arg(name="")] = Settings()) -> None:
    """Imitate a demonstrated trajectory on a new object; by default on a generated mug in a random pose.

    Writes a folder with result.json, trajectory.npz, trajectory.tum, scene.npz, imitation.png and loss.png; with
    --page also imitation.html. With --targets, one such folder for every object of a folder. `tdf view` shows a folder.
    """
    pictures = Pictures("tdf imitate")

    def one(settings):
        if settings.animation is not None and settings.out.resolve() in settings.animation.resolve().parents:
            raise InputError(
                f"tdf imitate: --animation is {settings.animation}, in --out {settings.out}, which holds the files of "
                "one run and is replaced by the next; expected a file beside it"
            )
        with replace_folder("tdf imitate", settings.out, RESULT, NAMES) as folder:
            return _run(settings, folder, pictures)

    if settings.targets is not None:
        records = imitate_targets(settings, one, plain_settings, RESULT)
        if settings.json:
            print(json.dumps(records, indent=1))
        pictures.check()
        return
    settings = resolved(settings)
    record = one(settings)
    if settings.clusters and not settings.json:
        print(cluster_table(record["camera"]))
    print(json.dumps(record, indent=1) if settings.json else table_of(record, settings.out))
    pictures.check()


def _run(settings: Settings, folder: Path, pictures: Pictures) -> dict:
    """Imitate, write the folder and return the record."""
    seconds = {}
    began = time.perf_counter()
    if settings.page:
        check_page("tdf imitate")
    if settings.animation is not None:
        check_animation("tdf imitate", settings.animation)
    query_key, start_key = jax.random.split(jax.random.fold_in(jax.random.key(settings.seed), STREAM))
    with _timed(seconds, "load"):
        config = _config(settings)
        energy = None
        if not isinstance(config, CarryConfig):
            energy = EnergyWeights() if settings.k is None else EnergyWeights(settings.k)
        model = load_model(str(settings.weights))  # `resolved` has put the name of the category's weights
        target_model, target_points = _target(settings, model)
        seen = read_scene(settings)
        task = None if settings.task is None else make_task(settings)
        first = None if seen is None else seen.clouds[0]
        scene = make_scene(settings, query_key, first) if task is None else task.scene
        target_points = target_points if task is None else task.target_points
    camera = None
    if seen is not None:
        with _timed(seconds, "choose"):
            search = config if isinstance(config, CarryConfig) else CarryConfig()
            points, found, camera = choose(settings, seen, model, target_model, scene.demonstration, search)
            scene = dataclasses.replace(scene, points=points)
            if found is not None:
                target_points, target_model = found, model if target_model is None else target_model
    with _timed(seconds, "encode"):
        related = scene.demonstration.target is not None
        offset = None if related and not any(settings.goal_offset) else settings.goal_offset
        reference = jax.block_until_ready(describe(model, scene.demonstration, target_model=target_model))
    steps = config.solver.num_steps if isinstance(config, CarryConfig) else config.num_steps
    # The regions on the object and on a new target are found before the pick, and report no steps.
    before = 0 if not related else 1 if target_points is None else 2
    with _timed(seconds, "optimise"), _progress(steps, before) as progress:
        result = imitate_scene(
            model,
            reference,
            scene.points,
            target_points=target_points,
            target_model=target_model,
            key=start_key,
            goal_offset=None if offset is None else np.array(offset),
            clean=settings.clean,
            energy=energy,
            config=config,
            progress=progress,
        )
        trajectory = jax.block_until_ready(result.trajectory)
    relation = relation_of(scene, task, result)
    save_trajectory(folder / "trajectory.npz", trajectory)
    save_trajectory(folder / "trajectory.tum", trajectory)
    found, expected = errors_of(scene, trajectory)
    shown = ImitationScene(
        scene.demonstration,
        scene.points,
        result,
        target_points,
        expected,
        scene.meshes,
        weights_of(str(settings.weights), model),
        None if target_model is None else weights_of(str(settings.target_weights or settings.weights), target_model),
    )
    save_imitation(folder / SCENE, shown)
    title = title_of(float(result.loss), found, relation)
    if not settings.no_plots:
        with _timed(seconds, "plots"):
            rows = "start" if isinstance(config, OptimizeConfig) else "candidate"
            _draw(folder, shown, title, rows, pictures)
    if settings.page:
        with _timed(seconds, "page"), pictures.drawing(folder / PAGE) as path:
            from tdf_jax.viz.imitation_page import save_imitation_page

            save_imitation_page(path, shown, title)
    if settings.animation is not None:
        with _timed(seconds, "animation"), pictures.drawing(settings.animation) as path:
            from tdf_jax.viz.film import RATE, film_frames
            from tdf_jax.viz.film_file import save_film

            save_film(path, list(film_frames(shown)), RATE)
    seconds["total"] = time.perf_counter() - began
    record = record_of(settings, model, scene, energy, config, result, relation, camera, seconds)
    replace_file("tdf imitate", folder / RESULT, json.dumps(record, indent=1).encode())
    return record


def _target(settings: Settings, model: Model) -> tuple[Model | None, np.ndarray | None]:
    """Network and points of the new target; None where there is none. `make_task` has the points of a task."""
    if settings.task is not None or settings.target_object is None:
        return None if settings.target_weights is None else load_model(settings.target_weights), None
    points = load_points(
        settings.target_object,
        settings.points,
        settings.scale,
        (settings.seed + 1) % checks.SEEDS,  # samples of one mesh by one seed are the same points
        drop_invalid=settings.drop_invalid,
    )
    return model if settings.target_weights is None else load_model(settings.target_weights), points


def _config(settings: Settings) -> CarryConfig | SolveConfig | OptimizeConfig:
    starts: dict[str, Any] = {} if settings.num_starts is None else {"num_starts": settings.num_starts}
    if settings.method == "adam":
        return (
            OptimizeConfig(**starts)
            if settings.iterations is None
            else OptimizeConfig(iterations=settings.iterations, **starts)
        )
    if settings.iterations is not None:
        raise InputError("tdf imitate: --iterations is for --method adam; drop one or add the other")
    if settings.method == "gauss-newton":
        return SolveConfig() if settings.num_starts is None else SolveConfig(num_trajectory_starts=settings.num_starts)
    return CarryConfig(**starts)


def _draw(folder: Path, scene: ImitationScene, title: str, rows: str, pictures: Pictures) -> None:
    related = scene.demonstration.target is not None
    with pictures.drawing(folder / "imitation.png") as path:
        from tdf_jax.viz.imitation import imitation_figure
        from tdf_jax.viz.relations import relation_figure
        from tdf_jax.viz.style import save_figure

        result = scene.result
        if related:
            figure = relation_figure(scene.demonstration, scene.points, result, scene.target_points, title=title)
        else:
            figure = imitation_figure(
                scene.demonstration, scene.points, result.trajectory, scene.expected, scene.meshes, title
            )
        save_figure(path, figure)
    with pictures.drawing(folder / "loss.png") as path:
        from tdf_jax.viz.imitation import loss_figure
        from tdf_jax.viz.style import save_figure

        history = np.asarray(scene.result.candidate_history)
        if not related:  # with a target, the last energies are sums with those of the contact regions
            history = np.column_stack([history, scene.result.energies])
        save_figure(path, loss_figure(history, int(scene.result.best), rows=rows))


@contextlib.contextmanager
def _timed(seconds: dict[str, float], name: str) -> Iterator[None]:
    began = time.perf_counter()
    yield
    seconds[name] = time.perf_counter() - began


@contextlib.contextmanager
def _progress(iterations: int, before: int = 0) -> Iterator:
    """A bar on stderr, and the function that solvers call to move it; `before` solves end before the first call."""
    with tqdm(total=(before + 1) * iterations, desc="imitating", unit="step") as bar:

        def move(done, energies):
            bar.set_postfix(loss=f"{np.min(energies):.5f}", refresh=False)
            bar.update(before * iterations + done - bar.n)

        yield move
