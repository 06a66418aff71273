"""What `tdf imitate` says of a run: result.json, the printed table and the line over the picture."""

import dataclasses
from pathlib import Path

import jax
import numpy as np

import tdf_jax
from tdf_jax.cli.options import Settings
from tdf_jax.cli.tasks import TaskScene, not_judged
from tdf_jax.energy.losses import EnergyWeights
from tdf_jax.evaluation.metrics import path_error, pose_error
from tdf_jax.evaluation.scene import Scene
from tdf_jax.geometry.trajectory import Trajectory
from tdf_jax.networks.model import Model
from tdf_jax.solvers.adam import OptimizeConfig
from tdf_jax.solvers.multistart import SolveConfig
from tdf_jax.solvers.pick import CarryConfig
from tdf_jax.solvers.result import Result
from tdf_jax.uncertainty.modes import cluster_poses

SCHEMA = 3  # raised when a field of result.json changes its meaning or goes


def record_of(
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
    """Everything about a run that result.json holds; numbers that are not finite are null.

    Args:
        settings: options of the command.
        model: network of the object.
        scene: the demonstration and the target.
        energy: weights of the energy; None for `carry`.
        config: settings of the solver.
        result: what was found.
        relation: the placement, see `relation_of`.
        camera: what was chosen in depth images; None without them.
        timings: seconds of each part, by name.
    """
    found, expected = errors_of(scene, result.trajectory)
    demonstration = scene.demonstration
    return {
        "schema": SCHEMA,
        "tdf_jax": tdf_jax.__version__,
        "seed": settings.seed,
        "settings": plain_settings(dataclasses.asdict(settings)),
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


def errors_of(scene: Scene, trajectory: Trajectory) -> tuple[dict | None, Trajectory | None]:
    """Distances from the truth, metres and radians, and the true trajectory; None where it is not known.

    A path to a target has a true pick, but no true path: there are many good ones.

    Args:
        scene: the demonstration and the target.
        trajectory: the imitated trajectory.
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


def relation_of(scene: Scene, task: TaskScene | None, result: Result) -> dict | None:
    """Where the object goes on the target; None if the demonstration has no target.

    Args:
        scene: the demonstration and the target.
        task: the task that judges the placement; None if there is none.
        result: what was found.
    """
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


def table_of(record: dict, out: Path) -> str:
    """The record in a few lines.

    Args:
        record: see `record_of`.
        out: folder that it was written to.
    """
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


def title_of(loss: float, found: dict | None, relation: dict | None) -> str:
    """One line over the picture.

    Args:
        loss: energy of the best candidate.
        found: errors, see `errors_of`.
        relation: the placement, see `relation_of`.
    """
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


def plain_settings(settings: dict) -> dict:
    """Options as JSON has them.

    Args:
        settings: values by the names of the options.
    """
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
