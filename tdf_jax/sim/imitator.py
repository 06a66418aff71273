"""What is imitated in the episodes of a campaign, by its method: the library, the truth or a baseline."""

import dataclasses
import functools
import time
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from jaxtyping import Float

from tdf_jax._internal.cache import digest, kept
from tdf_jax._internal.errors import InputError
from tdf_jax._internal.version import __version__
from tdf_jax.sim.condition import (
    DEMONSTRATIONS,
    EVEN,
    ICP,
    LIBRARY,
    NETWORKS,
    PAPER,
    REPLAY,
    SEGMENTED,
    TRUTH,
    UNCENTRED,
    Settings,
)
from tdf_jax.sim.tasks import TASKS, Episode, NotDrawn

if TYPE_CHECKING:
    from tdf_jax.energy.reference import Reference
    from tdf_jax.geometry.demonstration import Demonstration
    from tdf_jax.sim.replay import Replay
    from tdf_jax.sim.robot import Robot
    from tdf_jax.sim.scans import Scan
    from tdf_jax.sim.workcell import Workcell

FORMAT = 14  # format number; raise it when what is drawn or imitated changes
FIRST_DEMONSTRATION = 1_000_000  # their numbers begin here, so that no episode shares their objects
POINTS = 1500  # of a complete cloud
VIEWED = 4000  # most points of a cloud of cameras: the field takes a subsample


class Found(NamedTuple):
    """What is imitated in an episode.

    Attributes:
        paths: trajectories of the gripper from the pick to the release, (paths, poses, 4, 4), metres, world frame, the
            best first; none if nothing is found.
        openings: opening of the fingers before they close, (paths,), metres.
        motion: motion M of the object: a point x of it ends at M x, 4x4.
        reason: why nothing is found, in words; empty if something is.
        seconds: time that it took when it was computed, without that of describing the demonstration.
        points: cloud of the object, (points, 3), metres, world frame; empty if none was needed or seen.
    """

    paths: Float[np.ndarray, "paths poses 4 4"]
    openings: Float[np.ndarray, " paths"]
    motion: Float[np.ndarray, "4 4"]
    reason: str
    seconds: float
    points: Float[np.ndarray, "points 3"]


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


def centred_paths(
    path: Float[np.ndarray, "poses 4 4"], points: Float[np.ndarray, "points 3"], opening: float, robot: "Robot"
) -> list[tuple[Float[np.ndarray, "poses 4 4"], float]]:
    """Paths whose pick is centred on the cloud, and their openings; see `tdf_jax.sim.centring`.

    The object moves as before.

    Args:
        path: poses of the gripper's frame from the pick to the release, (poses, 4, 4).
        points: cloud of the object at the pick, (points, 3), metres, world frame.
        opening: demonstrated opening of the fingers before they close, metres.
        robot: the robot.

    Returns:
        One path or several, the best first, and the opening of each, metres.
    """
    from tdf_jax.sim.centring import centred

    back = np.linalg.inv(path[0])
    return [
        (path @ (back @ grasp.T_world_grip), grasp.opening)
        for grasp in centred(path[0], points, opening, robot.fingers)
    ]


@functools.lru_cache(maxsize=1)
def load_imitator(settings: Settings) -> "Imitator":
    """The imitator of a campaign, loaded once in a process.

    Args:
        settings: what the episodes share.
    """
    return Imitator(settings)


class Imitator:
    """Imitates demonstrations in the episodes of a campaign: networks, demonstrations and the robot of one process.

    Attributes:
        settings: what the episodes share.
        condition: what they are measured under.
        robot: the robot.
    """

    def __init__(self, settings: Settings):
        """Load the networks, the robot and the users' meshes.

        Args:
            settings: what the episodes share.

        Raises:
            InputError: one of them cannot be used.
        """
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
        self._demonstrated: dict[int, tuple[Episode, Demonstration] | NotDrawn] = {}
        self._described: dict[int, Reference] = {}
        self._paper: dict[int, Reference] = {}

    def scan(self, number: int) -> "Scan | None":
        """The user's mesh that an episode has; None if its object is generated."""
        return self.scans[number % len(self.scans)] if self.scans else None

    def demonstrated(self, number: int) -> "tuple[Episode, Demonstration]":
        """The demonstrated episode and the demonstration.

        Raises:
            NotDrawn: nothing within reach is drawn.
        """
        from tdf_jax.sim.tasks import demonstrate_episode, draw_episode

        if number not in self._demonstrated:
            try:
                episode = draw_episode(
                    self.condition.task, self.robot, self.settings.seed, FIRST_DEMONSTRATION + number, "upright"
                )
                self._demonstrated[number] = episode, demonstrate_episode(episode, self.settings.seed)
            except NotDrawn as error:  # so that it is not tried again for every episode
                self._demonstrated[number] = error
        found = self._demonstrated[number]
        if isinstance(found, NotDrawn):
            raise NotDrawn(f"{found} (of the demonstrations)")
        return found

    def reference(self, number: int) -> "Reference":
        """The descriptors of a demonstration, or of all."""
        from tdf_jax.energy.reference import describe

        if number not in self._described:
            several = range(DEMONSTRATIONS) if number < 0 else (number,)
            demonstrations = [self.demonstrated(one)[1] for one in several]
            self._described[number] = describe(self.model, demonstrations, target_model=self.target_model)
        return self._described[number]

    def paper_reference(self, number: int) -> "Reference":
        """The descriptors of a demonstration for the paper's method."""
        from tdf_jax.sim.replay import describe_without_target

        if number not in self._paper:
            self._paper[number] = describe_without_target(self.model, self.demonstrated(number)[1])
        return self._paper[number]

    def episode(self, number: int):
        """An episode, and the number of the demonstration that it imitates; -1 for all of them."""
        from tdf_jax.sim.tasks import draw_episode

        condition, seed = self.condition, self.settings.seed
        demonstration = -1 if condition.demonstrations > 1 else number % DEMONSTRATIONS
        known = self.demonstrated(demonstration)[0] if condition.target == "known" else None
        episode = draw_episode(condition.task, self.robot, seed, number, condition.poses, known, self.scan(number))
        if condition.mass:
            body = dataclasses.replace(
                episode.object_body,
                mass=condition.mass,
                inertia=episode.object_body.inertia * (condition.mass / episode.object_body.mass),
            )
            episode.__dict__["object_body"] = body
        return episode, demonstration

    def depends_on(self, number: int) -> list:
        """All that an episode depends on besides its condition, as JSON values.

        Args:
            number: number of the episode.
        """
        scan = self.scan(number)
        return [
            *(FORMAT, __version__, *self.fingerprints, *self.robot_content),
            *(self.settings.seed, number, None if scan is None else [scan.name, scan.digest]),
        ]

    def found(self, episode: Episode, demonstration: int) -> Found:
        """What is imitated in an episode: kept, or computed and kept.

        Teleported and executed episodes, of whatever mass, share what is imitated, centred or not.

        Args:
            episode: the episode.
            demonstration: number of the demonstration; -1 for all of them.

        Raises:
            NotDrawn: there is no demonstration.
            InputError: something is wrong with the weights.
        """
        condition = self.condition
        method = LIBRARY if condition.method == UNCENTRED else condition.method
        shared = condition._replace(mode="", mass=0.0, method=method)
        about = ["imitation", *self.depends_on(episode.number), *shared]
        result = kept("tdf simulate", self.settings.folder, about, lambda: self._found(episode, demonstration))
        return self._opened(episode, demonstration, result)

    def _opened(self, episode: Episode, demonstration: int, result: dict[str, np.ndarray]) -> Found:
        """What is imitated, with the fingers opened by the cloud, and centred by the condition's method."""
        paths, method = result["paths"], self.condition.method
        if method == TRUTH or not len(paths):
            openings = np.full(len(paths), episode.grip.opening)
        else:
            opening = self.demonstrated(max(demonstration, 0))[0].grip.opening
            centred = [centred_paths(path, result["points"], opening, self.robot) for path in paths]
            if method == UNCENTRED:
                openings = np.array([several[0][1] for several in centred])
            else:
                openings = np.array([opening for several in centred for _, opening in several])
                paths = np.array([path for several in centred for path, _ in several])
        return Found(
            paths, openings, result["motion"], result["reason"].item(), float(result["seconds"]), result["points"]
        )

    def _found(self, episode: Episode, demonstration: int) -> dict[str, Any]:
        """Arrays to keep: those of `Found`, not centred, and the object's cloud."""
        if self.condition.method in NETWORKS:
            self.reference(
                demonstration
            )  # what is wrong with the weights is no failure of an episode, and ends the campaign
        paths, points, motion, reason = np.zeros((0, 0, 4, 4)), np.zeros((0, 3)), np.eye(4), ""
        began = time.perf_counter()
        try:
            paths, points, motion = self.imitated(episode, demonstration)
        except NotDrawn:  # of the demonstrations
            raise
        except InputError as error:
            reason = str(error)
        seconds = time.perf_counter() - began
        return {"paths": np.array(paths), "points": points, "motion": motion, "reason": reason, "seconds": seconds}

    def imitated(self, episode: Episode, demonstration: int) -> tuple[Sequence[np.ndarray], np.ndarray, np.ndarray]:
        """Trajectories of the gripper, the best first, the object's cloud, and the motion of the object.

        Of the true ones no cloud is needed, and it is empty.

        Raises:
            InputError: there are none, or a cloud is empty or too small.
        """
        from tdf_jax.sim.tasks import demonstrate_episode

        if self.condition.method == TRUTH:
            path = demonstrate_episode(episode, self.settings.seed).trajectory
            motion = episode.T_world_target @ episode.T_target_object @ np.linalg.inv(episode.T_world_object)
            return [np.asarray(path.matrices, float)], np.zeros((0, 3)), motion
        points, target_points = self.clouds(episode)
        paths, motion = self.replay(episode.number, points, target_points, demonstration)
        return paths, points, motion

    def clouds(self, episode) -> tuple[np.ndarray, np.ndarray | None]:
        """Clouds of the object and of a target that is found, (points, 3) each, metres, world frame."""
        from tdf_jax.evaluation.cases import SEED_SPACE
        from tdf_jax.evaluation.tabletop import moved
        from tdf_jax.geometry.sampling import sample_surface
        from tdf_jax.sim.workcell import OBJECT, TARGET

        rng = np.random.default_rng([SEED_SPACE, self.settings.seed, episode.number, 9])
        bodies = [(OBJECT, episode.object, episode.T_world_object)]
        if self.condition.target == "found":
            bodies.append((TARGET, episode.target, episode.T_world_target))
        if self.condition.clouds == "full":
            clouds = [moved(sample_surface(one.mesh, POINTS, rng), T) for _, one, T in bodies]
        else:
            clouds = [self.seen(episode, name, T[:3, 3], rng) for name, _, T in bodies]
        points, *targets = (cloud.astype(np.float32) for cloud in clouds)
        return points, targets[0] if targets else None

    def seen(self, episode, name: str, centre, rng: np.random.Generator) -> np.ndarray:
        """What the condition's cameras see of a body, (points, 3), metres, world frame.

        Args:
            episode: the episode.
            name: name of the body.
            centre: where the cameras look, (3,), metres, world frame.
            rng: random generator of their direction and of the noise.
        """
        from tdf_jax.sim.cameras import camera_ring, observed_points
        from tdf_jax.sim.segmentation import segmented_points
        from tdf_jax.sim.workcell import build_workcell

        segmented = self.condition.mask == SEGMENTED
        cell = build_workcell(
            self.robot if segmented else None,
            *(episode.object_body, episode.T_world_object, episode.target_body, episode.T_world_target),
        )
        data, several = cell.data(), int(self.condition.clouds.removeprefix("views"))
        cameras = camera_ring(several, centre, azimuth=rng.uniform(0, 360))
        if segmented:
            points = segmented_points(cell, data, cameras, centre, rng=rng, own=self.robot_alone)
        else:
            points = observed_points(cell.model, data, cameras, name, rng=rng)
        chosen = rng.permutation(len(points))[:VIEWED]
        return points[np.sort(chosen)]

    @functools.cached_property
    def robot_alone(self) -> "tuple[Workcell, Any] | None":
        """A cell with the robot alone, at home, and its state; None if there is no robot."""
        from tdf_jax.sim.workcell import build_workcell

        if self.robot is None:
            return None
        cell = build_workcell(self.robot)
        return cell, cell.data()

    def replay(self, number: int, points, target_points, demonstration: int) -> "Replay":
        """What a method finds by the clouds."""
        import jax

        from tdf_jax.imitation import imitate
        from tdf_jax.sim import replay

        method = self.condition.method
        key = jax.random.fold_in(jax.random.key(self.settings.seed), number)
        if method == REPLAY:
            return replay.replay_by_centroids(self.demonstrated(demonstration)[1], points, target_points)
        if method == ICP:
            return replay.replay_by_registration(self.demonstrated(demonstration)[1], points, target_points, key=key)
        result = imitate(
            self.model,
            self.reference(demonstration),
            points,
            target_points=target_points,
            target_model=self.target_model,
            key=key,
        )
        if method == EVEN:
            return replay.blend_evenly(self.demonstrated(demonstration)[1], result)
        found = replay.replay_candidates(result)
        if method == PAPER:
            return replay.replay_by_energy(
                self.model, self.paper_reference(demonstration), points, result.goal, key=key
            )
        return found
