"""What `tdf imitate` tells: the record of a run for machines, the table for people."""

import dataclasses
from pathlib import Path

import jax
import numpy as np

import tdf_jax
from tdf_jax.solvers.pick import CarryConfig
from tdf_jax.cli.options import Settings
from tdf_jax.energy.losses import EnergyWeights
from tdf_jax.evaluation.scene import Scene
from tdf_jax.evaluation.metrics import path_error, pose_error
from tdf_jax.networks.model import Model
from tdf_jax.uncertainty.modes import cluster_poses
from tdf_jax.solvers.adam import OptimizeConfig, Result
from tdf_jax.solvers.multistart import SolveConfig
from tdf_jax.geometry.trajectory import Trajectory

SCHEMA = 2  # raised when a field of result.json changes its meaning or goes
RESULT = "result.json"
NAMES = (RESULT, "trajectory.npz", "trajectory.tum", "imitation.png", "loss.png")


def errors(trajectory: Trajectory, expected: Trajectory | None) -> dict | None:
    """Distances from the truth, metres and radians; None where it is not known."""
    if expected is None:
        return None
    distance, angle = pose_error(trajectory.wxyz_xyz[0], expected.wxyz_xyz[0])
    return {
        "pick_metres": float(distance),
        "pick_radians": float(angle),
        "path_metres": path_error(trajectory, expected),
    }


def title(loss: float, found: dict | None) -> str:
    """One line over the picture."""
    if found is None:
        return f"loss {loss:.4f}; pick and path errors n/a"
    angle = np.degrees(found["pick_radians"])
    pick = f"pick-pose error {100 * found['pick_metres']:.1f} cm, {angle:.0f}°"
    return f"loss {loss:.4f}; {pick}; path error {100 * found['path_metres']:.1f} cm"


def record(
    settings: Settings,
    model: Model,
    scene: Scene,
    energy: EnergyWeights | None,
    config: CarryConfig | SolveConfig | OptimizeConfig,
    result: Result,
    timings: dict[str, float],
) -> dict:
    """Everything about a run that result.json holds; numbers that are not finite are null."""
    trajectory = result.trajectory
    expected = scene.expected(trajectory.wxyz_xyz[-1], trajectory.wxyz_xyz[0])
    demonstration = scene.demonstration
    return {
        "schema": SCHEMA,
        "tdf_jax": tdf_jax.__version__,
        "seed": settings.seed,
        "settings": {name: _plain(value) for name, value in dataclasses.asdict(settings).items()},
        "energy": None if energy is None else dataclasses.asdict(energy),
        "optimiser": dataclasses.asdict(config),
        "weights": dataclasses.asdict(model.info),
        "machine": {"jax": jax.__version__, "device": jax.devices()[0].device_kind, "backend": jax.default_backend()},
        "demonstration": {
            "points": len(demonstration.points),
            "poses": demonstration.trajectory.poses,
            "queries": len(demonstration.query),
        },
        "target": {"points": len(scene.points), "T_world_target": scene.T_world_target.tolist()},
        "status": result.status,
        "best": result.best,
        "loss": {"start": float(result.losses[result.best, 0]), "end": result.loss},
        "confidence": result.confidence,
        "recognised": result.recognised,
        "modes": _modes(config, result),
        "errors": errors(trajectory, expected),
        "goal": _plain(trajectory.wxyz_xyz[-1]),
        "expected": None if expected is None else _plain(expected.wxyz_xyz),
        "energies": _plain(result.energies),
        "losses": _plain(result.losses),
        "seconds": {name: round(value, 3) for name, value in timings.items()},
    }


def table(record: dict, out: Path) -> str:
    """The record in a few lines."""
    found, seconds = record["errors"], record["seconds"]
    optimiser = record["optimiser"]
    sizes = record["demonstration"] | optimiser
    if record["modes"] is not None:
        starts, best = "{scouts} starts of the pick", "of the best pick"
    elif "scouts" in sizes:
        starts, best = "{inits} starts, {scouts} of the keyframe", "the best candidate of every waypoint"
    else:
        starts, best = "{inits} starts, {iterations} iterations", f"start {record['best'] + 1} of {sizes['inits']}; {record['status']}"
    parts = ", ".join(f"{name} {value:.1f}" for name, value in seconds.items() if name != "total")
    pick = path = "n/a (the truth is not known)"
    if found is not None:
        pick = f"{100 * found['pick_metres']:.2f} cm, {np.degrees(found['pick_radians']):.1f} degrees"
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
    if record["modes"] is not None:
        rows["solutions"] = _solutions(record["modes"])
    if record["recognised"] is not None:
        rows["recognised"] = f"{record['recognised']:.2f} that the object is of the demonstration's category"
    if record["confidence"] is not None:
        rows["confidence"] = f"{record['confidence']:.2f} that the pick is right to 2 cm and 20 degrees"
    return "\n".join(f"{name:<17}{value}" for name, value in rows.items())


def _modes(config, result) -> list[dict] | None:
    """The distinct picks; None for methods that do not bring them to their minima."""
    if not isinstance(config, CarryConfig):
        return None
    modes = cluster_poses(result.trajectories[:, 0], result.energies)
    return [{"pick": _plain(mode.pose), "energy": mode.energy, "share": mode.share} for mode in modes]


def _solutions(modes: list[dict]) -> str:
    """How many distinct picks there are, and how far behind the second is."""
    told = f"{len(modes)} distinct pick{'s' if len(modes) != 1 else ''}"
    return told if len(modes) < 2 else f"{told}; the second's loss is {modes[1]['energy']:.5f}"


def _plain(value):
    """A value as JSON has it."""
    if isinstance(value, Path):
        return str(value)
    if isinstance(value, jax.Array | np.ndarray):
        return _plain(np.asarray(value).tolist())
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    return None if isinstance(value, float) and not np.isfinite(value) else value
