"""Plans: the gripper is where the trajectory says, within the limits of the joints, or it is said why not."""

import numpy as np
import pytest
from conftest import angle, downward, lifted

import tdf_jax as tdf
from tdf_jax._internal.errors import InputError
from tdf_jax.sim.board import Board
from tdf_jax.sim.bodies import body_of
from tdf_jax.sim.collision import free_positions
from tdf_jax.sim.kinematics import kinematics_of
from tdf_jax.sim.motion import APPROACH, CARRYING, SHORTEST, Failure, plan_motion
from tdf_jax.sim.workcell import OBJECT, build_workcell

PHASES = ["transit", "approach", "grasp", "path", "release", "retreat", "return"]


def gripper_poses(robot, positions):
    """Poses of the gripper, by the physics."""
    import mujoco

    cell = build_workcell(robot)
    data, poses = cell.data(), []
    for joints in positions:
        data.qpos[cell.arm] = joints
        mujoco.mj_kinematics(cell.model, data)
        poses.append(cell.gripper_pose(data))
    return np.array(poses)


def test_the_gripper_goes_through_every_pose(robot, planned, corners):
    phases = planned.segment_slices()
    assert list(phases) == PHASES
    poses = gripper_poses(robot, planned.positions[phases["path"]])
    passed = -1
    for T in corners:
        distances = np.linalg.norm(poses[:, :3, 3] - T[:3, 3], axis=1)
        near = int(np.argmin(distances))
        assert distances[near] < 1e-3 and angle(poses[near], T) < 0.5
        assert near > passed
        passed = near
    # On straight lines between them, with the same orientation.
    assert max(np.abs(poses[:, 0, 3] - 0.45).max(), poses[:, 2, 3].max() - 0.3) < 1e-3
    assert max(angle(T, corners[0]) for T in poses[::10]) < 0.5


def test_the_approach_is_straight_and_the_fingers_close_at_rest(robot, planned, corners):
    phases = planned.segment_slices()
    approach = gripper_poses(robot, planned.positions[phases["approach"]])
    assert approach[0][2, 3] - corners[0][2, 3] == pytest.approx(0.1, abs=2e-3)
    assert np.abs(approach[:, :2, 3] - corners[0][:2, 3]).max() < 1e-3
    retreat = gripper_poses(robot, planned.positions[phases["retreat"]])
    assert retreat[-1][2, 3] - corners[-1][2, 3] == pytest.approx(0.1, abs=2e-3)
    for name, opening in (("grasp", 0.0), ("release", robot.fingers.widest)):
        assert np.ptp(planned.positions[phases[name]], axis=0).max() < 1e-9
        np.testing.assert_allclose(planned.gripper[phases[name]], opening)
    np.testing.assert_allclose(planned.positions[[0, -1]], [robot.home, robot.home], atol=1e-6)


def test_limits_are_held(robot, planned):
    assert (planned.positions >= robot.lower).all() and (planned.positions <= robot.upper).all()
    steps = np.diff(planned.times)[:, None]
    velocities = np.diff(planned.positions, axis=0) / steps
    assert (np.abs(velocities) <= robot.max_velocity * 1.001).all()
    path = planned.segment_slices()["path"]
    assert (np.abs(velocities[path][:-1]) <= CARRYING * robot.max_velocity * 1.001).all()
    accelerations = np.diff(velocities, axis=0) / steps[1:]
    assert (np.abs(accelerations) <= robot.max_acceleration * 1.02).all()


def test_a_plan_is_the_same_again(robot, planned, corners):
    again = tdf.plan_joints(tdf.Trajectory.from_matrices(corners), robot)
    np.testing.assert_array_equal(again.positions, planned.positions)
    np.testing.assert_array_equal(again.times, planned.times)


@pytest.fixture(scope="module")
def surrounded(robot):
    """A cell with a mug to pick and a board to place it on, and the pick at its rim."""
    from tdf_jax.sim.grasps import grip_of

    mug = tdf.build_mug()
    T_mug, T_board = np.eye(4), np.eye(4)
    T_mug[:3, 3], T_board[:3, 3] = (0.42, 0.2, -mug.mesh.bounds[0, 2]), (0.6, -0.2, 0.06)
    cell = build_workcell(robot, body_of(mug), T_mug, body_of(Board()), T_board)
    grip = grip_of(mug, robot.fingers)
    release = T_mug.copy()
    release[:3, 3] += T_board[:3, 3] - T_mug[:3, 3] + (0, 0, 0.06 - mug.mesh.bounds[0, 2] + 0.001)
    return cell, T_mug @ grip.T_object_grip, release @ grip.T_object_grip, grip.opening


def test_a_motion_around_a_scene_touches_nothing_but_what_it_may(robot, surrounded):
    import mujoco

    cell, pick, release, opening = surrounded
    plan = plan_motion([lifted(pick, release)], robot, openings=[opening], grip=0.0, cell=cell)
    assert not isinstance(plan, Failure), plan
    # The half turn of a parallel gripper is the same grasp.
    assert min(angle(plan.pick, pick), angle(plan.pick @ np.diag([-1, -1, 1, 1]), pick)) < 1e-3
    np.testing.assert_allclose(plan.release[:3, 3], release[:3, 3], atol=1e-9)
    model, data = cell.model, cell.data()
    T_start = cell.body_pose(data, OBJECT)
    held = np.linalg.inv(plan.pick) @ T_start
    phases = plan.motion.segment_slices()
    path = phases["path"]
    for sample in range(0, plan.motion.num_samples, 15):
        data.qpos[cell.arm] = plan.motion.positions[sample]
        cell.open_fingers(data, opening)
        mujoco.mj_kinematics(model, data)
        if path.start <= sample < path.stop:
            cell.set_body_pose(data, OBJECT, cell.gripper_pose(data) @ held)
        elif sample == path.stop:
            cell.set_body_pose(data, OBJECT, plan.release @ held)
        mujoco.mj_kinematics(model, data)
        mujoco.mj_collision(model, data)
        for number in range(data.ncon):
            names = {model.body(int(model.geom_bodyid[geom])).name for geom in data.contact.geom[number]}
            depth = -data.contact.dist[number]
            robots = [name for name in names if name.startswith("robot/")]
            if len(robots) == len(names) and depth > 0.002:
                assert all("gripper" in name for name in names), (sample, names, depth)
            if len(robots) == 1 and "object" not in names:
                assert depth < 0.003, (sample, names, depth)


def test_a_table_in_the_way_is_said(robot, surrounded):
    cell, pick, release, opening = surrounded
    low = pick.copy()
    low[2, 3] -= 0.08
    path = tdf.Trajectory.from_matrices(lifted(low, release))
    with pytest.raises(
        InputError, match=r"plan_joints\(\): there is no motion: hand and \w+ collide on the way to the pick"
    ):
        tdf.plan_joints(path, robot, opening=opening, cell=cell)


@pytest.mark.slow
def test_a_target_in_the_way_is_said_and_the_next_candidate_taken(robot, surrounded):
    cell, pick, release, opening = surrounded
    low = release.copy()
    low[2, 3] -= 0.1
    plan = plan_motion([lifted(pick, low)], robot, openings=[opening], grip=0.0, cell=cell)
    assert isinstance(plan, Failure) and "collide" in plan.reason and "target" in plan.reason
    # The next candidate is taken.
    plan = plan_motion([lifted(pick, low), lifted(pick, release)], robot, openings=[opening] * 2, grip=0.0, cell=cell)
    assert not isinstance(plan, Failure) and plan.candidate == 1


def test_a_pick_out_of_reach_is_said(robot, corners):
    far = corners.copy()
    far[:, 0, 3] += 2
    with pytest.raises(InputError, match=r"plan_joints\(\): there is no motion: the pick .* out of reach"):
        tdf.plan_joints(tdf.Trajectory.from_matrices(far), robot)


def test_near_the_end_of_its_reach_the_arm_leaves_as_far_as_it_can(robot, corners):
    """The gripper faces the base, so that it must go out to leave: the release is 4 cm before the end of the reach."""
    kinematics = kinematics_of(robot)
    R = np.stack([(0.0, 0, 1), (0, 1, 0), (-1, 0, 0)], axis=1)  # along -x, closing along y

    def facing(x):
        T = np.eye(4)
        T[:3, :3], T[:3, 3] = R, (x, 0.1, 0.3)
        return T

    starts = robot.home + np.random.default_rng(0).uniform(-np.pi, np.pi, (40, 6))
    reach = max(x for x in np.arange(0.4, 1.0, 0.005) if any_configuration(kinematics, facing(x), starts))
    poses = np.stack([corners[0], facing(reach - 0.04)])
    motion = tdf.plan_joints(tdf.Trajectory.from_matrices(poses), robot)
    retreat = gripper_poses(robot, motion.positions[motion.segment_slices()["retreat"]])
    assert retreat[-1][0, 3] - retreat[0][0, 3] == pytest.approx(SHORTEST * APPROACH, abs=2e-3)


def any_configuration(kinematics, T, starts):
    return any(kinematics.search(T, start) is not None for start in starts)


def test_the_robot_may_not_overlap_with_itself_and_a_cloud_may_by_a_millimetre():
    """Shapes of the robot are known: where its links overlapped by 1 mm in a plan, the arm got stuck in physics."""

    class Overlap:
        def __init__(self, *pair):
            self.pair = pair

        def depths(self, joints, opening, T_object):
            return {self.pair: 0.001}

    for pair, passes in ((("arm", "hand"), False), (("arm", "arm"), False), (("arm", "target"), True)):
        assert free_positions(Overlap(*pair), 0.05)(np.zeros(6)) is passes


@pytest.mark.slow
def test_a_release_out_of_reach_is_said(robot, corners):
    end = corners.copy()
    end[2:, 0, 3] += 2
    with pytest.raises(InputError, match=r"plan_joints\(\): there is no motion: the release has no configuration"):
        tdf.plan_joints(tdf.Trajectory.from_matrices(end), robot)


def test_wrong_arguments_are_refused(robot, corners):
    path = tdf.Trajectory.from_matrices(corners)
    other = build_workcell(None)
    for message, arguments, options in (
        ("trajectory is not one trajectory", (corners, robot), {}),
        ("trajectory is not one trajectory", (tdf.Trajectory(path.wxyz_xyz[None]), robot), {}),
        ("robot is str; expected load_robot", (path, "UR5e"), {}),
        ("approach is 0", (path, robot), {"approach": 0}),
        ("approach is nan", (path, robot), {"approach": np.nan}),
        ("seed is 0", (path, robot), {"seed": 0}),
        ("opening is 0.2 .* the widest opening of UR5e", (path, robot), {"opening": 0.2}),
        ("opening is 0.02 and grip 0.03", (path, robot), {"opening": 0.02, "grip": 0.03}),
        ("opening is 'wide'", (path, robot), {"opening": "wide"}),
        ("and grip nan; expected", (path, robot), {"grip": np.nan}),
        ("the cell is not one with this robot's arm", (path, robot), {"cell": other}),
        ("the cell is not one with this robot's arm", (path, robot), {"cell": build_workcell(robot, floating=True)}),
        ("cell is int; expected", (path, robot), {"cell": 3}),
    ):
        with pytest.raises(InputError, match=rf"plan_joints\(\): .*{message}"):
            tdf.plan_joints(*arguments, **options)


def test_a_path_of_one_pose_is_a_pick_and_a_release(robot):
    motion = tdf.plan_joints(tdf.Trajectory.from_matrices(downward(0.45, 0.1, 0.2)[None]), robot)
    assert [name for name, _ in motion.segments] == [name for name in PHASES if name != "path"]
