"""One imitation of the paper, and its errors."""

import dataclasses
from typing import cast

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from tdf_jax.energy.losses import descriptor_loss, trajectory_energy
from tdf_jax.energy.reference import describe
from tdf_jax.evaluation.metrics import FLIP_DEGREES, longest_step, pose_error, shape_error
from tdf_jax.geometry.grid import distance_from_polyline
from tdf_jax.geometry.trajectory import Trajectory
from tdf_jax.networks.encoding import encode
from tdf_jax.networks.model import Model
from tdf_jax.paper import setting as settings
from tdf_jax.paper.setting import Setting
from tdf_jax.solvers.adam import optimize

SETTLED = 0.95  # share of the drop of the loss after which it counts as settled
DENSE = 61  # poses of the true path that a path of any number of poses is compared with
FLIPPED = np.radians(FLIP_DEGREES)


@dataclasses.dataclass(frozen=True)
class Run:
    """Result of one setting; poses are `wxyz_xyz`, T_world_query.

    Attributes:
        reference: the demonstration, (poses, 7).
        expected: ground truth on the test mug, (poses, 7).
        path: translations of the ground truth with `DENSE` poses, (dense, 3), metres, world frame.
        initial_trajectories: initial trajectory of every start, (starts, poses, 7).
        trajectories: final trajectory of every start, (starts, poses, 7).
        losses: energy of every start before each iteration and after the last, (starts, iterations + 1).
        descriptor: l_t alone, of the best start's trajectory and of the ground truth, (2,).
        expected_energy: energy of the ground truth.
    """

    reference: Float[np.ndarray, "poses 7"]
    expected: Float[np.ndarray, "poses 7"]
    path: Float[np.ndarray, "dense 3"]
    initial_trajectories: Float[np.ndarray, "starts poses 7"]
    trajectories: Float[np.ndarray, "starts poses 7"]
    losses: Float[np.ndarray, "starts iterations_and_1"]
    descriptor: Float[np.ndarray, "2"]
    expected_energy: Float[np.ndarray, ""]

    @property
    def best(self) -> int:
        """The start with the lowest energy at the end."""
        return int(np.nanargmin(self.losses[:, -1]))

    @property
    def trajectory(self) -> Float[np.ndarray, "poses 7"]:
        """The final trajectory of the best start."""
        return self.trajectories[self.best]

    @property
    def loss(self) -> float:
        """Energy of the best start at the end."""
        return float(self.losses[self.best, -1])

    @property
    def start_loss(self) -> float:
        """Energy of the best start before the first iteration."""
        return float(self.losses[self.best, 0])

    @property
    def settled(self) -> int:
        """Number of iterations after which the loss of the best start stays below a `SETTLED` share of its drop."""
        curve = self.losses[self.best]
        limit = curve[0] - SETTLED * (curve[0] - curve[-1])
        above = np.flatnonzero(curve > limit)
        return int(above[-1]) + 1 if len(above) else 0

    @property
    def pick_error(self) -> tuple[float, float]:
        """Position error, metres, and rotation error, radians, of the first pose."""
        distance, angle = pose_error(self.trajectory[0], self.expected[0])
        return float(distance), float(angle)

    @property
    def flipped(self) -> bool:
        """Whether the rotation error of the pick is above `FLIP_DEGREES`."""
        return self.pick_error[1] > FLIPPED

    @property
    def path_error(self) -> float:
        """Mean distance of the dense true path from the polyline through the estimated poses, metres.

        A path of few poses cuts corners, which this error includes.
        """
        return float(np.mean(distance_from_polyline(self.path, self.trajectory[:, 4:])))

    @property
    def waypoint_error(self) -> tuple[float, float]:
        """Mean position error, metres, and rotation error, radians, of all poses, a fixed last pose included."""
        distance, angle = pose_error(self.trajectory, self.expected)
        return float(distance.mean()), float(angle.mean())

    @property
    def shape_error(self) -> float:
        """See `tdf_jax.evaluation.metrics.shape_error`, metres."""
        return shape_error(self.trajectory[:, 4:], self.expected[:, 4:])

    @property
    def longest_step(self) -> float:
        """See `tdf_jax.evaluation.metrics.longest_step`; the demonstration's is 1 where it is evenly spaced."""
        return longest_step(self.trajectory[:, 4:])


def imitation(model: Model, setting: Setting) -> Run:
    """Imitate once.

    Args:
        model: the network.
        setting: the setting.
    """
    scene = settings.scene(setting)
    reference = describe(model, scene.demonstration)
    field = encode(model, jax.device_put(scene.points))
    goal = settings.goal(setting, field, reference)
    reference = settings.aim(setting, reference)
    key = jax.random.fold_in(jax.random.key(setting.seed), settings.STREAM + 1)
    result = optimize(
        field, reference, key, goal=goal, fix_last=setting.fix_last, energy=setting.energy, config=setting.optimiser
    )
    expected = cast(Trajectory, scene.expected(goal))
    dense = cast(Trajectory, settings.scene(dataclasses.replace(setting, num_poses=DENSE)).expected(goal))
    estimate = result.trajectory
    weights = jax.tree.map(lambda weight: jnp.asarray(weight, jnp.float32), setting.energy)
    return Run(
        reference=np.asarray(scene.demonstration.trajectory.wxyz_xyz),
        expected=np.asarray(expected.wxyz_xyz),
        path=np.asarray(dense.translations),
        initial_trajectories=np.asarray(result.initial_trajectories),
        trajectories=np.asarray(result.trajectories),
        losses=np.column_stack([result.candidate_history, result.energies]),
        descriptor=np.array([_descriptor_loss(one, field, reference) for one in (estimate, expected)]),
        expected_energy=np.asarray(_energy(expected, field, reference, weights)),
    )


_descriptor_loss = jax.jit(descriptor_loss)
_energy = jax.jit(trajectory_energy)
