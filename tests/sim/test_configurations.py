"""Configurations: they reach the pose, and half a turn of the gripper costs no new search."""

import dataclasses

import numpy as np
from conftest import angle, downward

from tdf_jax.sim.configurations import HALF_TURN, SEARCHES, Configurations
from tdf_jax.sim.kinematics import Kinematics, kinematics_of


@dataclasses.dataclass(frozen=True, eq=False)
class Counted(Kinematics):
    """Kinematics that notes what it solves."""

    solved: list = dataclasses.field(default_factory=list)

    def solve(self, T, start, iterations=40):
        self.solved.append(T)
        return super().solve(T, start, iterations)

    def search(self, T, start, iterations=40):
        self.solved.append(T)
        return super().search(T, start, iterations)


def test_every_configuration_is_at_the_pose_and_another(robot):
    T, kinematics = downward(0.45, 0.1, 0.2), kinematics_of(robot)
    found = list(Configurations(kinematics).at(T))
    assert len(found) > 1
    for number, joints in enumerate(found):
        reached = kinematics.pose(joints)
        assert np.linalg.norm(reached[:3, 3] - T[:3, 3]) < 1e-4 and angle(reached, T) < 0.1
        assert ((joints >= robot.lower) & (joints <= robot.upper)).all()
        assert all(np.abs(joints - other).max() > 0.05 for other in found[:number])


def test_a_pose_is_searched_once_and_half_a_turn_from_what_is_known(robot):
    T, kinematics = downward(0.45, 0.1, 0.2), Counted(robot)
    configurations = Configurations(kinematics)
    found = list(configurations.at(T))
    assert len(kinematics.solved) == 1 + SEARCHES
    assert list(configurations.at(T)) == found and len(kinematics.solved) == 1 + SEARCHES
    turned = list(configurations.at(T @ HALF_TURN))
    assert len(kinematics.solved) == 1 + SEARCHES + len(found)
    assert len(turned) == len(found)
    for joints in turned:
        assert angle(kinematics.pose(joints), T @ HALF_TURN) < 0.1


def test_where_the_last_joint_cannot_turn_so_far_the_search_goes_on(robot):
    """Half a turn of the gripper then needs other joints too, as on many arms of seven."""
    narrow = dataclasses.replace(robot, lower=robot.lower.copy(), upper=robot.upper.copy())
    narrow.lower[-1], narrow.upper[-1] = -2.0, 2.0
    T, kinematics = downward(0.45, 0.1, 0.2), Counted(narrow)
    configurations = Configurations(kinematics)
    found = list(configurations.at(T))
    assert found and all(abs(joints[-1]) <= 2 for joints in found)
    within = sum(abs(abs(joints[-1]) - np.pi) <= 2 for joints in found)
    assert within < len(found)
    turned = list(configurations.at(T @ HALF_TURN))
    assert len(kinematics.solved) == 2 * (1 + SEARCHES) + within
    assert {tuple(np.round(joints, 2)) for joints in turned} == {
        tuple(np.round(joints, 2)) for joints in Configurations(Kinematics(narrow)).at(T @ HALF_TURN)
    }
