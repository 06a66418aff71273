"""What a picture of an episode needs, and its file: where every body was, and what the bodies look like."""

import dataclasses
import functools
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from tdf_jax._internal.cache import digest
from tdf_jax._internal.errors import InputError
from tdf_jax._internal.files import replace_file
from tdf_jax.sim.robot import Robot
from tdf_jax.sim.solids import MOST_OF_BODY, Solid, robot_solids, simplified
from tdf_jax.sim.tasks import Episode
from tdf_jax.sim.workcell import COLOURS, OBJECT, TABLE, TABLE_NAME, TARGET, Workcell, build_workcell

FOLDER = "episodes"  # in the folder of `tdf simulate`
SCHEMA = 1  # raised when an array changes its meaning or goes
RATE = 20.0  # frames in a second of simulated time
LENGTH, TURN = 1e-4, 1 / 32767  # steps of the kept numbers: metres, and components of quaternions
ABSENT = -32768  # a kept number of a body that is not there
FARTHEST = 3.2  # metres from the origin; what falls farther is kept there


@dataclasses.dataclass(frozen=True, eq=False)
class Playback:
    """An episode to look at.

    Attributes:
        about: what it was and what became of it, in types of JSON: the fields of `tdf_jax.sim.condition.Condition`,
            "seed", "number" and "instance"; and of the outcome "overall", "strict", "cause", "detail", "slip" and
            "turn".
        times: times of the frames, (frames,), seconds, increasing.
        phases: phases of the motion in order: the name of each and the index of its first frame.
        bodies: names of the bodies.
        wxyz_xyz: poses T_world_body, (frames, bodies, 7), metres; NaN where a body is not there.
        solids: surfaces of the bodies.
        points: cloud of the object that was imitated on, (points, 3), metres, world frame; empty if there is none.
        path: poses of the gripper of the best candidate, from the pick to the release, T_world_grip, (poses, 7); empty
            if nothing was found.
    """

    about: Mapping[str, Any]
    times: Float[np.ndarray, " frames"]
    phases: tuple[tuple[str, int], ...]
    bodies: tuple[str, ...]
    wxyz_xyz: Float[np.ndarray, "frames bodies 7"]
    solids: tuple[Solid, ...]
    points: Float[np.ndarray, "points 3"]
    path: Float[np.ndarray, "poses 7"]

    @property
    def title(self) -> str:
        """The episode in a few words."""
        about = self.about
        what = f" on {about['instance']}" if about["instance"] else ""
        return f"{about['task']}, episode {about['number']}{what}, {about['mode']}"

    @property
    def verdict(self) -> str:
        """What became of it, in words."""
        about = self.about
        if not about["cause"]:
            return "success"
        return f"{about['cause']}: {about['detail']}" if about["detail"] else about["cause"]

    def phase(self, frame: int) -> str:
        """Name of the phase at a frame."""
        return next((name for name, first in reversed(self.phases) if first <= frame), "")


class Sampler:
    """Notes where the bodies of an episode are while it runs. It reads the state, and changes nothing."""

    def __init__(self, episode: Episode, robot: Robot | None):
        """Prepare to note.

        Args:
            episode: the episode.
            robot: the robot; None if there is none.
        """
        self._episode, self._robot = episode, robot
        self._surfaces = _surfaces(robot)
        self._bodies = (*dict.fromkeys(one.body for one in self._surfaces), OBJECT, TARGET, TABLE_NAME)
        self._times: list[float] = []
        self._poses: list[np.ndarray] = []
        self._phases: list[tuple[str, int]] = []
        self._model: Any = None
        self._numbers: dict[int, int] = {}  # of a body in the model, by its place in the names
        self._began = 0.0  # of the cell, in the time of the episode

    def watch(self, cell: Workcell, data: Any, phase: str) -> None:
        """Note a state if it is time for one, or if a phase begins.

        Args:
            cell: the cell; a second one of the same episode goes on where the first ended.
            data: its state.
            phase: name of the phase.
        """
        if cell.model is not self._model:
            self._model = cell.model
            names = {self._model.body(number).name: number for number in range(self._model.nbody)}
            self._numbers = {place: names[name] for place, name in enumerate(self._bodies) if name in names}
            self._began = self._times[-1] + 1 / RATE - data.time if self._times else 0.0
        elif data.time + self._began < self._times[-1] + 1 / RATE - 1e-9 and phase == self._phases[-1][0]:
            return
        if not self._phases or phase != self._phases[-1][0]:
            self._phases.append((phase, len(self._times)))
        poses = np.full((len(self._bodies), 7), np.nan)
        poses[self._bodies.index(TABLE_NAME)] = [1, 0, 0, 0, *TABLE[0]]
        for name, T in ((OBJECT, self._episode.T_world_object), (TARGET, self._episode.T_world_target)):
            poses[self._bodies.index(name)] = _pose(T)
        for place, number in self._numbers.items():
            poses[place, :4], poses[place, 4:] = data.xquat[number], data.xpos[number]
        self._times.append(float(data.time + self._began))
        self._poses.append(poses)

    def playback(
        self,
        about: Mapping[str, Any],
        points: Float[np.ndarray, "points 3"],
        path: Float[np.ndarray, "poses 4 4"],
    ) -> Playback:
        """What was noted; where nothing moved, the start.

        Args:
            about: see `Playback`.
            points: cloud of the object, (points, 3), metres, world frame.
            path: poses of the gripper of the best candidate, (poses, 4, 4).
        """
        if not self._times:
            cell = build_workcell(self._robot)
            self.watch(cell, cell.data(), "start")
        episode, solids = self._episode, [*self._surfaces]
        for name, mesh in ((OBJECT, episode.object_body.mesh), (TARGET, episode.target_body.mesh)):
            solids.append(Solid(name, *simplified(mesh.vertices, mesh.faces, MOST_OF_BODY), COLOURS[name][:3]))
        import trimesh

        top = trimesh.creation.box(2 * np.array(TABLE[1]))
        solids.append(Solid(TABLE_NAME, np.asarray(top.vertices), np.asarray(top.faces), COLOURS["table"][:3]))
        return Playback(
            about,
            np.array(self._times),
            tuple(self._phases),
            self._bodies,
            np.array(self._poses),
            tuple(solids),
            np.asarray(points, np.float32),
            np.array([_pose(T) for T in path]).reshape(-1, 7),
        )


@functools.lru_cache(maxsize=2)
def _surfaces(robot: Robot | None) -> tuple[Solid, ...]:
    return tuple(robot_solids(build_workcell(robot).model))


def _pose(T: Float[np.ndarray, "4 4"]) -> Float[np.ndarray, "7"]:
    from scipy.spatial.transform import Rotation

    return np.concatenate([Rotation.from_matrix(T[:3, :3]).as_quat(scalar_first=True), T[:3, 3]])


def save_playback(function: str, folder: Path, name: str, playback: Playback) -> Path:
    """Write an episode. The surfaces of its robot are written once for all episodes of a folder.

    Args:
        function: name that the error message begins with.
        folder: the folder, which is made if it does not exist.
        name: name of the file without its suffix.
        playback: the episode.

    Returns:
        The file.

    Raises:
        InputError: a file cannot be written.
    """
    own = [one for one in playback.solids if one.body in (OBJECT, TARGET, TABLE_NAME)]
    others = [one for one in playback.solids if one.body not in (OBJECT, TARGET, TABLE_NAME)]
    surfaces = _solid_arrays(others)
    robot = f"robot-{digest(*surfaces.values())[:12]}.npz"
    try:
        folder.mkdir(exist_ok=True)
    except OSError as error:
        raise InputError(f"{function}: cannot make the folder {folder} ({error}); expected a writable place") from None
    if not (folder / robot).exists():
        replace_file(function, folder / robot, lambda file: np.savez_compressed(file, **surfaces))
    header = {
        "schema": SCHEMA,
        "robot": robot,
        "about": dict(playback.about),
        "phases": playback.phases,
        "bodies": playback.bodies,
    }
    poses = np.clip(playback.wxyz_xyz, -FARTHEST, FARTHEST) / [*[TURN] * 4, *[LENGTH] * 3]
    arrays: dict[str, Any] = {
        "times": playback.times.astype(np.float32),
        "poses": np.where(np.isnan(poses), ABSENT, np.round(poses)).astype(np.int16),
        "points": playback.points.astype(np.float32),
        "path": playback.path.astype(np.float32),
        **_solid_arrays(own),
    }
    text, path = np.array(json.dumps(header)), folder / f"{name}.npz"
    replace_file(function, path, lambda file: np.savez_compressed(file, header=text, **arrays))
    return path


def load_playback(function: str, path: Path) -> Playback:
    """Read an episode.

    Args:
        function: name that the error message begins with.
        path: file of `save_playback`; that of the robot is beside it.

    Raises:
        InputError: it cannot be read, is of another version of tdf_jax, or the file of the robot is missing.
    """
    header, arrays = _read(function, path)
    robot = path.parent / header["robot"]
    if not robot.is_file():
        raise InputError(f"{function}: {path} needs {robot.name} beside it, with the robot; expected both: copy it too")
    _, surfaces = _read(function, robot, header=False)
    poses = arrays["poses"].astype(float)
    poses = np.where(poses == ABSENT, np.nan, poses * [*[TURN] * 4, *[LENGTH] * 3])
    return Playback(
        header["about"],
        arrays["times"].astype(float),
        tuple((name, first) for name, first in header["phases"]),
        tuple(header["bodies"]),
        poses,
        (*_solids(surfaces), *_solids(arrays)),
        arrays["points"],
        arrays["path"].astype(float),
    )


def kept_episodes(function: str, folder: Path) -> list[tuple[Path, dict[str, Any]]]:
    """The episodes that a folder of `tdf simulate` or `tdf benchmark --simulation` keeps, in the order of their names.

    Args:
        function: name that the error message begins with.
        folder: the folder.

    Returns:
        The file of each, and what it was and what became of it, see `Playback.about`.

    Raises:
        InputError: a file cannot be read, or is of another version of tdf_jax.
    """
    files = sorted(path for path in (folder / FOLDER).glob("*.npz") if not path.name.startswith("robot-"))
    return [(path, _read(function, path, arrays=False)[0]["about"]) for path in files]


def kept_episode(function: str, folder: Path, about: Mapping[str, Any]) -> Path | None:
    """The file of an episode that a folder keeps, the latest of several; None if there is none.

    Args:
        function: name that the error message begins with.
        folder: the folder.
        about: what it was, a part of `Playback.about`.

    Raises:
        InputError: a file cannot be read, or is of another version of tdf_jax.
    """
    known = kept_episodes(function, folder)
    files = [path for path, one in known if all(one.get(name) == value for name, value in about.items())]
    return max(files, key=lambda path: path.stat().st_mtime, default=None)


def _read(function: str, path: Path, header: bool = True, arrays: bool = True) -> tuple[dict, dict[str, np.ndarray]]:
    about: dict = {"schema": SCHEMA}
    try:
        with path.open("rb") as file, np.lib.npyio.NpzFile(file, allow_pickle=False) as archive:
            if header:
                about = json.loads(str(archive["header"]))
            found = {name: archive[name] for name in archive.files if name != "header"} if arrays else {}
        schema = about["schema"]
    except Exception as error:  # damaged archives raise errors of many kinds
        raise InputError(
            f"{function}: cannot read {path} ({type(error).__name__}: {str(error)[:200]}); expected an episode of "
            "`tdf simulate`: delete it"
        ) from None
    if schema != SCHEMA:
        raise InputError(
            f"{function}: {path} has schema {schema}; expected {SCHEMA}. Use the tdf_jax that wrote it, or run "
            "`tdf simulate` again with another --out"
        )
    return about, found


def _solid_arrays(solids: Sequence[Solid]) -> dict[str, Any]:
    """Surfaces one after the other: their vertices and faces, how many of both each has, its body and its colour."""
    none = np.zeros((0, 3))  # without a robot there are no surfaces of one
    return {
        "solid_bodies": np.array([one.body for one in solids]),
        "solid_colours": np.array([one.colour for one in solids], np.float32),
        "solid_counts": np.array([[len(one.vertices), len(one.faces)] for one in solids], np.int32).reshape(-1, 2),
        "solid_vertices": np.round(np.concatenate([none, *(one.vertices for one in solids)]) / LENGTH).astype(np.int16),
        "solid_faces": np.concatenate([none, *(one.faces for one in solids)]).astype(np.uint16),
    }


def _solids(arrays: Mapping[str, np.ndarray]) -> list[Solid]:
    ends = np.cumsum(arrays["solid_counts"], axis=0)[:-1]
    vertices = np.split(LENGTH * arrays["solid_vertices"].astype(float), ends[:, 0])
    faces = np.split(arrays["solid_faces"].astype(np.int32), ends[:, 1])
    parts = zip(arrays["solid_bodies"].tolist(), vertices, faces, arrays["solid_colours"].tolist())
    return [Solid(body, corners, triangles, tuple(colour)) for body, corners, triangles, colour in parts]
