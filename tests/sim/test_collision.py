"""Collisions of planned positions: contacts that are there are found with their depth, and no others."""

import numpy as np
import pytest
from conftest import downward

from tdf_jax.sim.board import Board
from tdf_jax.sim.bodies import body_of
from tdf_jax.sim.collision import Collisions
from tdf_jax.sim.kinematics import kinematics_of
from tdf_jax.sim.workcell import build_workcell


def standing(x, y, z=0.06):
    T = np.eye(4)
    T[:3, 3] = x, y, z
    return T


@pytest.fixture(scope="module")
def collisions(robot):
    board = body_of(Board())
    return Collisions(
        build_workcell(robot, board, standing(0.45, 0.3), board, standing(0.45, -0.3), fixed_target=False)
    )


@pytest.fixture(scope="module")
def reached(robot):
    """Joints at which the gripper's frame points down at a place."""

    def at(x, y, z):
        joints = robot.home
        for height in (*np.arange(0.4, z, -0.02), z):  # on the way down, without another configuration
            joints = kinematics_of(robot).solve(downward(x, y, height), joints)
            assert joints is not None
        return joints

    return at


def test_nothing_touches_at_home_but_what_stands_on_the_table(robot, collisions):
    assert collisions.depths(robot.home, 0.05) == {}


def test_an_object_in_the_table_and_one_in_the_target(robot, collisions):
    found = collisions.depths(robot.home, 0.05, standing(0.45, 0.3, 0.05))
    assert set(found) == {("object", "table")}
    assert found["object", "table"] == pytest.approx(0.01, abs=2e-4)
    found = collisions.depths(robot.home, 0.05, standing(0.45, -0.3, 0.17))
    assert set(found) == {("object", "target")}
    assert found["object", "target"] == pytest.approx(0.01, abs=2e-4)
    # The target is where it is said to be.
    assert collisions.depths(robot.home, 0.05, standing(0.45, -0.3, 0.17), standing(0.45, 0.0)) == {}


def test_a_gripper_in_the_table(robot, collisions, reached):
    # The fingertips are 4 mm beyond the gripper's frame.
    found = collisions.depths(reached(0.45, 0.0, -0.01), 0.0)
    assert set(found) == {("hand", "table")} and 0.005 < found["hand", "table"] < 0.03
    assert collisions.depths(reached(0.45, 0.0, 0.02), 0.0) == {}


def test_open_fingers_around_an_object_touch_nothing_and_closed_ones_do(robot, collisions, reached):
    joints = reached(0.45, 0.0, 0.2)
    thin = standing(0.45, 0.0, 0.5)
    found = collisions.depths(joints, 0.05, standing(0.45, 0.0, 0.2))
    assert ("hand", "object") in found
    assert collisions.depths(joints, 0.05, thin).keys() <= {("arm", "object")}


def test_links_of_the_arm_that_are_folded_into_each_other_are_found(robot, collisions):
    folded = robot.home.copy()
    folded[2] = 3.1  # the elbow, closed
    found = collisions.depths(folded, 0.05)
    assert any(pair in found for pair in (("arm", "arm"), ("arm", "hand")))


def test_the_arm_through_a_board(robot, collisions):
    found = collisions.depths(robot.home, 0.05, standing(0.0, 0.1, 0.5))
    assert ("arm", "object") in found
