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

import tdf_jax
from tdf_jax._internal import checks
from tdf_jax._internal.errors import InputError
from tdf_jax._internal.files import replace_file, replace_folder
from tdf_jax.cli.camera import choose, read_scene, table as cluster_table
from tdf_jax.cli.options import Settings, resolved
from tdf_jax.cli.pictures import Pictures, check_animation, check_page
from tdf_jax.cli.scenes import make_scene
from tdf_jax.cli.targets import imitate_targets
from tdf_jax.cli.tasks import TaskScene, make_task, not_judged
from tdf_jax.energy.losses import EnergyWeights
from tdf_jax.energy.reference import describe
from tdf_jax.evaluation.metrics import path_error, pose_error
from tdf_jax.evaluation.scene import Scene
from tdf_jax.geometry.trajectory import Trajectory
from tdf_jax.imitation import imitate as imitate_scene
from tdf_jax.io.pointclouds import load_points
from tdf_jax.io.trajectories import save_trajectory
from tdf_jax.networks.checkpoint import load_model
from tdf_jax.networks.model import Model
from tdf_jax.solvers.adam import OptimizeConfig
from tdf_jax.solvers.imitation_scene import SCENE, ImitationScene, save_imitation, weights_of
from tdf_jax.solvers.multistart import SolveConfig
from tdf_jax.solvers.pick import CarryConfig
from tdf_jax.solvers.result import Result
from tdf_jax.uncertainty.modes import cluster_poses

# Folded into the seed's key: `random_pose` draws a generated mug's rotation from the key of the same seed, and a start
# drawn from that one would be the answer.
STREAM = 0x1D317A7E
SCHEMA = 3  # raised when a field of result.json changes its meaning or goes
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
        records = imitate_targets(settings, one, _plain_settings, RESULT)
        if settings.json:
            print(json.dumps(records, indent=1))
        pictures.check()
        return
    settings = resolved(settings)
    record = one(settings)
    if settings.clusters and not settings.json:
        print(cluster_table(record["camera"]))
    print(json.dumps(record, indent=1) if settings.json else _table(record, settings.out))
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
    relation = _relation(scene, task, result)
    save_trajectory(folder / "trajectory.npz", trajectory)
    save_trajectory(folder / "trajectory.tum", trajectory)
    found, expected = _errors(scene, trajectory)
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
    title = _title(float(result.loss), found, relation)
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
    record = _record(settings, model, scene, energy, config, result, relation, camera, seconds)
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


def _errors(scene: Scene, trajectory: Trajectory) -> tuple[dict | None, Trajectory | None]:
    """Distances from the truth, metres and radians, and the true trajectory; None where it is not known.

    A path to a target has a true pick, but no true path: there are many good ones.
    """
    expected = scene.expected(trajectory.wxyz_xyz[-1], trajectory.wxyz_xyz[0])
    if expected is None:
        return None, None
    expected_path = None if scene.demonstration.target is not None else expected
    distance, angle = pose_error(trajectory.wxyz_xyz[0], expected.wxyz_xyz[0])
    found = {
        "pick_metres": float(distance),
        "pick_radians": float(angle),
        "path_metres": None if expected_path is None else path_error(trajectory, expected_path),
    }
    return found, expected_path


def _title(loss: float, found: dict | None, relation: dict | None) -> str:
    """One line over the picture."""
    known = [] if relation is None or relation["success"] is None else [_placement(relation)]
    if found is None:
        unknown = "pick and path errors n/a" if relation is None else "pick error n/a"
        return "; ".join([f"loss {loss:.4f}", unknown, *known])
    angle = np.degrees(found["pick_radians"])
    parts = [f"loss {loss:.4f}", f"pick-pose error {100 * found['pick_metres']:.1f} cm, {angle:.0f}°"]
    if found["path_metres"] is not None:
        parts.append(f"path error {100 * found['path_metres']:.1f} cm")
    return "; ".join(parts + known)


def _placement(relation: dict) -> str:
    """How an object is placed on its target, in words."""
    gap, penetration, tilt = (relation[name] for name in ("gap", "penetration", "tilt"))
    deep = "more than 10" if penetration is None else f"{1000 * penetration:.0f}"
    words = [f"gap {1000 * gap:.1f} mm", f"penetration {deep} mm"]
    words += [] if tilt is None else [f"tilt {tilt:.0f}°"]
    words += [f"not {name}" for name in ("hung", "supported") if not relation[name]]
    return f"{'success' if relation['success'] else 'failure'}: {', '.join(words)}"


def _record(
    settings: Settings,
    model: Model,
    scene: Scene,
    energy: EnergyWeights | None,
    config: CarryConfig | SolveConfig | OptimizeConfig,
    result: Result,
    relation: dict | None,
    camera: dict | None,
    timings: dict[str, float],
) -> dict:
    """Everything about a run that result.json holds; numbers that are not finite are null."""
    found, expected = _errors(scene, result.trajectory)
    demonstration = scene.demonstration
    return {
        "schema": SCHEMA,
        "tdf_jax": tdf_jax.__version__,
        "seed": settings.seed,
        "settings": _plain_settings(dataclasses.asdict(settings)),
        "energy": None if energy is None else dataclasses.asdict(energy),
        "optimiser": dataclasses.asdict(config),
        "weights": dataclasses.asdict(model.info),
        "machine": {"jax": jax.__version__, "device": jax.devices()[0].device_kind, "backend": jax.default_backend()},
        "demonstration": {
            "points": len(demonstration.points),
            "poses": demonstration.trajectory.num_poses,
            "grasp": demonstration.grasp,
            "release": demonstration.release,
            "queries": len(demonstration.query),
        },
        "target": {"points": len(scene.points), "T_world_target": scene.T_world_target.tolist()},
        "foreign_points": {"object": int(result.foreign_points), "target": int(result.target_foreign_points)},
        **({} if camera is None else {"camera": camera}),
        "status": result.status,
        "best": result.best,
        "loss": {"start": float(np.asarray(result.candidate_history)[result.best, 0]), "end": result.loss},
        "confidence": _plain(float(result.confidence)),
        "recognised": _plain(float(result.recognised)),
        "advice": result.advice or None,
        "modes": _modes(config, result),
        "errors": found,
        "goal": _plain(result.goal),
        "relation": relation,
        "expected": None if expected is None else _plain(expected.wxyz_xyz),
        "energies": _plain(result.energies),
        "losses": _plain(result.candidate_history),
        "seconds": {name: round(value, 3) for name, value in timings.items()},
    }


def _table(record: dict, out: Path) -> str:
    """The record in a few lines."""
    found, seconds = record["errors"], record["seconds"]
    optimiser = record["optimiser"]
    sizes = record["demonstration"] | optimiser
    if record["modes"] is not None:
        starts, best = "{num_starts} starts of the pick", "of the best pick"
    elif "num_trajectory_starts" in sizes:
        starts, best = (
            "{num_trajectory_starts} starts, {num_starts} of the keyframe",
            "the best candidate of every waypoint",
        )
    else:
        starts, best = (
            "{num_starts} starts, {iterations} iterations",
            f"start {record['best'] + 1} of {sizes['num_starts']}; {record['status']}",
        )
    parts = ", ".join(f"{name} {value:.1f}" for name, value in seconds.items() if name != "total")
    pick = path = "n/a (the truth is not known)"
    if found is not None:
        pick = f"{100 * found['pick_metres']:.2f} cm, {np.degrees(found['pick_radians']):.1f} degrees"
        if found["path_metres"] is not None:
            path = f"{100 * found['path_metres']:.2f} cm, mean over waypoints"
    rows = {
        "run": f"{starts}, {{poses}} poses, {{queries}} queries".format(**sizes),
        "loss, start": f"{record['loss']['start']:.5f}",
        "loss, end": f"{record['loss']['end']:.5f} ({best})",
        "pick-pose error": pick,
        "path error": path,
        "time": f"{seconds['total']:.1f} s ({parts})",
        "written to": str(out),
    }
    if record["relation"] is not None:
        relation = record["relation"]
        rows["loss, end"] = f"{record['loss']['end']:.5f} (sum of the pick's and both contact regions)"
        angle = np.degrees(relation["moved_radians"])
        rows["object moves"] = f"{100 * relation['moved_metres']:.1f} cm and {angle:.0f} degrees, to the target"
        if relation["success"] is not None:
            rows["placement"] = _placement(relation)
    if "camera" in record:
        clusters, frame = record["camera"]["clusters"], record["camera"]["frame"]
        taken = next(one for one in clusters if one["taken"] == "object")
        rows["object"] = f"{taken['points']} points of the depth images, 1 of {len(clusters)} objects"
        if frame == "camera":
            rows["frame"] = "that of the camera, because there is no --camera-pose"
    foreign = [f"{number} of the {name}'s cloud" for name, number in record["foreign_points"].items() if number]
    if foreign:
        rows["foreign points"] = f"removed {', '.join(foreign)}"
    if record["modes"] is not None:
        rows["solutions"] = _solutions(record["modes"])
    if record["recognised"] is not None:
        rows["recognised"] = f"{record['recognised']:.2f} that the object is of the demonstration's category"
    if record["confidence"] is not None:
        rows["confidence"] = f"{record['confidence']:.2f} that the pick is right to 2 cm and 20 degrees"
    if record["advice"] is not None:
        rows["what to do"] = record["advice"]
    return "\n".join(f"{name:<17}{value}" for name, value in rows.items())


def _relation(scene: Scene, task: TaskScene | None, result: Result) -> dict | None:
    """Where the object goes on the target; None if the demonstration has no target."""
    if scene.demonstration.target is None:
        return None
    motion = Trajectory(result.object_motion[None]).matrices[0]
    centroid = scene.points.mean(axis=0)
    judged = not_judged() if task is None else task.judged(result.object_motion)
    moved = pose_error(result.object_motion, np.array([1.0, 0, 0, 0, 0, 0, 0]))[1]
    seating = np.asarray(result.seatings)[result.best]
    return {
        "object_motion": _plain(result.object_motion),
        "moved_metres": float(np.linalg.norm(motion[:3, :3] @ centroid + motion[:3, 3] - centroid)),
        "moved_radians": float(moved),
        "T_world_contact": _plain(result.target_trajectories[result.best, 0]),
        "target_residual": _plain(float(result.target_residual)),
        "seating": None if np.isnan(seating).any() else _plain(seating),
        **{name: _plain(value) for name, value in judged.items()},
    }


def _modes(config, result) -> list[dict] | None:
    """The distinct picks; None for methods that do not bring them to their minima."""
    if not isinstance(config, CarryConfig):
        return None
    modes = cluster_poses(jax.numpy.asarray(result.picks), result.energies)
    return [{"pick": _plain(mode.pose), "energy": mode.energy, "share": mode.share} for mode in modes]


def _solutions(modes: list[dict]) -> str:
    """How many distinct picks there are, and how far behind the second is."""
    words = f"{len(modes)} distinct pick{'s' if len(modes) != 1 else ''}"
    if len(modes) < 2:
        return words
    best, second = (mode["energy"] for mode in modes[:2])
    higher = f", {second / best - 1:.0%} higher".replace("%", " %") if best > 0 else ""
    return f"{words}; the second's loss is {second:.5f}{higher}"


def _plain_settings(settings: dict) -> dict:
    return {name: _plain(value) for name, value in settings.items()}


def _plain(value):
    """A value as JSON has it."""
    if isinstance(value, Path):
        return str(value)
    if isinstance(value, jax.Array | np.ndarray):
        return _plain(np.asarray(value).tolist())
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    return None if isinstance(value, float) and not np.isfinite(value) else value
