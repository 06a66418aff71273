"""Configurations of an arm: the distinct positions of its joints with which the gripper is at a pose."""

import functools
import itertools
from collections.abc import Iterator

import numpy as np
from jaxtyping import Float

from tdf_jax.sim.kinematics import Kinematics
from tdf_jax.sim.robot import Robot

SEARCHES = 40  # random starts of the search at a pose
SAME = 0.05  # radians, configurations nearer than this are one
HALF_TURN = np.diag([-1.0, -1.0, 1.0, 1.0])  # about the approach: the same grasp of a parallel gripper


class Configurations:
    """The configurations of an arm at poses of its gripper, each pose searched once."""

    def __init__(self, kinematics: Kinematics):
        self.kinematics = kinematics
        self._found: dict[bytes, tuple[list[np.ndarray], Iterator[np.ndarray]]] = {}

    def at(self, T: Float[np.ndarray, "4 4"]) -> Iterator[Float[np.ndarray, " joints"]]:
        """Configurations at a pose: what is found from home, then from anywhere.

        If the configurations at the pose half a turn about the approach away are known, they are tried first, with the
        last joint turned by half a turn. Where that joint turns the gripper about its approach and every one of them
        can turn so far, there are no others.

        Args:
            T: pose of the gripper's frame, 4x4, metres, world frame.

        Yields:
            Positions of the joints, (joints,), radians.
        """
        found, more = self._found.setdefault(_key(T), ([], self._search(T)))
        for number in itertools.count():
            if number == len(found):
                one = next(more, None)
                if one is None:
                    return
                found.append(one)
            yield found[number]

    def _search(self, T) -> Iterator[np.ndarray]:
        robot, seen = self.kinematics.robot, []
        for number, start in enumerate(self._starts(T)):
            find = self.kinematics.search if number else self.kinematics.solve
            solution = find(T, np.clip(start, robot.lower, robot.upper))
            if solution is not None:
                wrapped = _near(robot, solution)
                if all(np.abs(wrapped - other).max() > SAME for other in seen):
                    seen.append(wrapped)
                    yield wrapped

    @functools.cached_property
    def _turns_approach(self) -> bool:
        """Whether the last joint turns the gripper about its approach."""
        home = np.asarray(self.kinematics.robot.home, float)
        turned = home + np.append(np.zeros(len(home) - 1), np.pi)
        return np.allclose(self.kinematics.pose(turned), self.kinematics.pose(home) @ HALF_TURN, atol=1e-6)

    def _starts(self, T) -> Iterator[np.ndarray]:
        robot = self.kinematics.robot
        turned = list(self.at(T @ HALF_TURN)) if _key(T @ HALF_TURN) in self._found else []
        all_turn = bool(turned)
        for one in turned:
            last = one[-1] + np.array([-np.pi, np.pi])
            within = last[(last >= robot.lower[-1]) & (last <= robot.upper[-1])]
            all_turn &= len(within) > 0
            if len(within):
                yield np.append(one[:-1], within[np.argmin(np.abs(within - robot.home[-1]))])
        if all_turn and self._turns_approach:
            return
        rng = np.random.default_rng(0)
        for number in range(1 + SEARCHES):
            yield robot.home + (rng.uniform(-np.pi, np.pi, robot.num_joints) if number else 0.0)


def _key(T: np.ndarray) -> bytes:
    return (np.round(T, 9) + 0.0).tobytes()  # without negative zeros


def _near(robot: Robot, joints: np.ndarray) -> np.ndarray:
    """The same configuration, with whole turns of the joints towards home where the limits allow it."""
    turns = np.round((joints - robot.home) / (2 * np.pi))
    moved = joints - 2 * np.pi * turns
    return np.where((moved >= robot.lower) & (moved <= robot.upper), moved, joints)
