"""Cells: what stands where, what is fixed, and what falls."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tdf_jax.sim.board import Board
from tdf_jax.sim.bodies import body_of
from tdf_jax.sim.physics import FRICTION
from tdf_jax.sim.workcell import FIXTURE, OBJECT, TARGET, build_workcell

mujoco = pytest.importorskip("mujoco", reason="the extra 'sim' is not installed")


@pytest.fixture(scope="module")
def board():
    return body_of(Board())


def tilted(x, y, z):
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = Rotation.from_rotvec((0.3, -0.2, 0.9)).as_matrix(), (x, y, z)
    return T


def after(cell, seconds):
    data = cell.data()
    for _ in range(int(seconds / cell.model.opt.timestep)):
        mujoco.mj_step(cell.model, data)
    return data


def test_bodies_are_where_they_are_put(board):
    one, target = tilted(0.5, 0.2, 0.4), tilted(0.6, -0.2, 0.3)
    cell = build_workcell(None, board, one, board, target)
    data = cell.data()
    np.testing.assert_allclose(cell.body_pose(data, OBJECT), one, atol=1e-9)
    np.testing.assert_allclose(cell.body_pose(data, TARGET), target, atol=1e-9)
    model = cell.model
    assert model.body_mass[model.body(OBJECT).id] == pytest.approx(board.mass)
    assert model.nu == 0 and cell.robot is None
    friction = {tuple(model.geom_friction[number]) for number in range(model.ngeom)}
    assert friction == {FRICTION} and FRICTION[0] <= 0.8
    assert not model.dof_damping.any()  # no artificial one


def test_mass_and_inertia_of_a_free_body_are_its_own(board):
    cell = build_workcell(None, board, tilted(0.5, 0, 0.5))
    model, number = cell.model, cell.model.body(OBJECT).id
    axes = Rotation.from_quat(model.body_iquat[number], scalar_first=True).as_matrix()
    np.testing.assert_allclose(axes @ np.diag(model.body_inertia[number]) @ axes.T, board.inertia, atol=1e-9)
    np.testing.assert_allclose(model.body_ipos[number], board.centre, atol=1e-12)


def test_a_free_body_falls_onto_the_table_and_a_fixed_or_held_one_stays(board):
    start = np.eye(4)
    start[:3, 3] = 0.5, 0.2, 0.2
    falls = build_workcell(None, board, start)
    middle = pytest.approx(0.06, abs=0.001)  # of a board that stands
    assert falls.body_pose(after(falls, 0.8), OBJECT)[2, 3] == middle
    held = build_workcell(None, board, start, board, start @ tilted(0.3, -0.4, 0.2), fixture=True)
    data = after(held, 0.5)
    np.testing.assert_allclose(held.body_pose(data, OBJECT), start, atol=1e-4)
    np.testing.assert_allclose(held.body_pose(data, TARGET), start @ tilted(0.3, -0.4, 0.2), atol=1e-9)
    data.eq_active[held.model.equality(FIXTURE).id] = 0
    for _ in range(400):
        mujoco.mj_step(held.model, data)
    assert held.body_pose(data, OBJECT)[2, 3] == middle
    stands = build_workcell(None, None, None, board, start, fixed_target=False, table=False)
    assert stands.body_pose(after(stands, 0.3), TARGET)[2, 3] < -0.1  # and there is no table


def test_a_pair_of_robot_and_surroundings_can_touch(robot, board):
    """No pair is excluded that a motion must avoid."""
    cell = build_workcell(robot, board, tilted(0.5, 0.2, 0.4), board, tilted(0.6, -0.2, 0.3))
    model = cell.model
    for number in range(model.nexclude):
        bodies = divmod(int(model.exclude_signature[number]), 1 << 16)
        assert all(model.body(body).name.startswith("robot/") for body in bodies)
    welds = [number for number in range(model.neq) if model.eq_type[number] == mujoco.mjtEq.mjEQ_WELD]
    assert not welds


def test_a_robot_starts_at_home_with_open_fingers(robot):
    cell = build_workcell(robot)
    data = cell.data()
    np.testing.assert_array_equal(data.qpos[cell.arm], robot.home)
    np.testing.assert_array_equal(data.ctrl[cell.arm_actuators], robot.home)
    assert data.ctrl[cell.finger_actuator] == pytest.approx(robot.fingers.commands[0])
    for _ in range(500):
        mujoco.mj_step(cell.model, data)
    np.testing.assert_allclose(data.qpos[cell.arm], robot.home, atol=1e-3)  # gravity on the arm is compensated


def test_a_cell_without_a_robot_has_no_gripper(board):
    with pytest.raises(ValueError, match="the cell has no robot"):
        build_workcell(None, board).fingers  # noqa: B018
