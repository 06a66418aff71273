"""Clearance on the way, and trajectories pushed clear: fixed ends, passages, reported failures."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest
from conftest import carried, composed, random_poses

import tdf_jax as tdf
from tdf_jax._internal.errors import InputError
from tdf_jax.geometry.distance_fields import DistanceGrid, box_obstacle
from tdf_jax.planning.avoidance import ClearanceConfig, push_clear
from tdf_jax.planning.distances import Clearance, clearance

pytestmark = pytest.mark.usefixtures("quick_compilation")
# A cube of 4 cm that is off the frame's origin, by its corners and its centre.
BODY = np.array(
    [[x, y, z] for x in (-0.02, 0.02) for y in (-0.02, 0.02) for z in (0.0, 0.04)] + [[0, 0, 0.02]], np.float32
)
LINE = tdf.line(7, (0, 0, 0), (0, 0.4, 0))
IN_THE_WAY = box_obstacle((0.01, 0.2, 0.02), (0.06, 0.04, 0.08))
AWAY = box_obstacle((0.5, 0.2, 0.0), (0.06, 0.04, 0.08))
ONE_LOOK = ClearanceConfig(iterations=1)
FEW_STEPS = ClearanceConfig(iterations=3)  # where nothing is found, each of many looks takes them all


def least_by_hand(trajectory, body, box_low, box_high, steps=400):
    """Least distance of the body's points to a box along the world's axes, at many poses on the way."""
    wxyz_xyz = np.asarray(tdf.resample(trajectory, steps).wxyz_xyz)
    x = np.concatenate([carried(pose, body) for pose in wxyz_xyz])
    over = np.maximum(box_low - x, x - box_high)
    return np.where((over < 0).all(axis=1), over.max(axis=1), np.linalg.norm(np.maximum(over, 0), axis=1)).min()


def ends_kept(cleared, trajectory):
    np.testing.assert_array_equal(
        cleared.trajectory.wxyz_xyz[jnp.array([0, -1])], trajectory.wxyz_xyz[jnp.array([0, -1])]
    )
    assert cleared.trajectory.num_poses == trajectory.num_poses


def assert_clear(cleared, trajectory, obstacles, margin=0.01, body=BODY):
    """Where the ends are clear themselves: by more looks than the library's own."""
    ends_kept(cleared, trajectory)
    looked = clearance(cleared.trajectory, body, obstacles, between=100).min
    assert cleared.clear and cleared.status.startswith("clear: moved by up to"), cleared.status
    assert looked > margin - 3e-4 and cleared.clearance == pytest.approx(looked, abs=3e-4)
    assert cleared.clearance >= margin - 1e-5 and cleared.excess >= -1e-5


# Clearance


def test_clearance_is_the_least_distance_at_poses_and_between():
    turning = tdf.line(4, (0, 0, 0), (0, 0.3, 0), end_rotation=[[0, -1, 0], [1, 0, 0], [0, 0, 1]])
    wall = box_obstacle((0.0, 0.05, 0.1), (0.5, 0.02, 0.02))
    found = clearance(turning, BODY, [AWAY, wall])
    assert found.waypoints.shape == (4, 2) and found.segments.shape == (3, 2)
    for i, pose in enumerate(np.asarray(turning.wxyz_xyz)):
        x = jnp.asarray(carried(pose, BODY))
        np.testing.assert_allclose(found.waypoints[i], [AWAY.distance(x).min(), wall.distance(x).min()], atol=1e-6)
    expected = least_by_hand(turning, BODY, [-0.25, 0.04, 0.09], [0.25, 0.06, 0.11])
    assert found.min == pytest.approx(expected, abs=3e-4)
    assert found.min == found.segments[:, 1].min() < found.waypoints.min() - 0.001
    assert (found.segments <= np.minimum(found.waypoints[:-1], found.waypoints[1:])).all()
    at_poses = clearance(turning, BODY, [AWAY, wall], between=0)
    np.testing.assert_allclose(at_poses.segments, np.minimum(found.waypoints[:-1], found.waypoints[1:]), atol=1e-7)


def test_obstacles_of_several_kinds_keep_their_order():
    grid = DistanceGrid(jnp.full(3, -2.0), jnp.asarray(4.0), jnp.full((2, 2, 2), 7.0))
    found = clearance(LINE, BODY, [AWAY, grid, IN_THE_WAY])
    alone = [clearance(LINE, BODY, [obstacle]).segments[:, 0] for obstacle in (AWAY, grid, IN_THE_WAY)]
    np.testing.assert_allclose(found.segments, np.stack(alone, axis=1), atol=1e-7)
    assert found.segments[:, 1].min() == pytest.approx(7) and found.min < 0


def test_one_pose_has_waypoints_only():
    found = clearance(tdf.Trajectory(LINE.wxyz_xyz[:1]), BODY, [AWAY])
    assert isinstance(found, Clearance) and found.segments.shape == (0, 1) and found.min == found.waypoints[0, 0]


# Pushed clear


def test_a_clear_path_comes_back_as_it_is():
    cleared = push_clear(LINE, BODY, [AWAY, AWAY])
    np.testing.assert_array_equal(cleared.trajectory.wxyz_xyz, LINE.wxyz_xyz)
    assert cleared.clear and cleared.deviation == 0 and cleared.status == "already clear: unchanged"
    assert cleared.clearance == pytest.approx(0.45, abs=1e-6)


def test_a_box_across_a_line_is_passed_by_the_near_side():
    scene = [AWAY, IN_THE_WAY]
    assert clearance(LINE, BODY, scene).min < -0.01
    cleared, again = (push_clear(LINE, BODY, scene, config=ClearanceConfig(iterations=20)) for _ in range(2))
    assert_clear(cleared, LINE, scene)
    # The box reaches 2 cm to the left and 4 cm to the right of the line, the cube 2 cm: 5 cm of shift are enough on the
    # left.
    assert 0.049 < cleared.deviation < 0.058
    assert np.asarray(cleared.trajectory.translations)[3, 0] < -0.045
    np.testing.assert_array_equal(again.trajectory.wxyz_xyz, cleared.trajectory.wxyz_xyz)


@pytest.mark.slow
def test_a_wall_between_two_poses_is_seen_and_passed():
    """No pose is nearer than 1.3 cm to the wall, and the gradients at its sides do not lead out of it."""
    wall = box_obstacle((0.0, 0.1667, 0.05), (0.4, 0.002, 0.3))
    body = BODY * np.float32([1, 0.1, 1])
    found = clearance(LINE, body, [AWAY, wall])
    assert found.waypoints.min() > 0.01 and found.min < 0
    cleared = push_clear(LINE, body, [AWAY, wall])
    assert_clear(cleared, LINE, [AWAY, wall], body=body)
    # Under it is the shortest way.
    assert np.asarray(cleared.trajectory.translations)[2:4, 2].max() < -0.1


@pytest.mark.slow
def test_a_post_in_a_semicircle_is_passed_with_the_margin():
    arc, post = tdf.semicircle(12, (0, 0, 0), (0, 0.4, 0)), box_obstacle((0.19, 0.2, 0), (0.03, 0.03, 0.6))
    assert clearance(arc, BODY, [post]).min < 0
    for margin in (0.005, 0.03):
        assert_clear(push_clear(arc, BODY, [post], margin=margin), arc, [post], margin)


@pytest.mark.slow
def test_several_obstacles_of_two_kinds_are_passed():
    floor = DistanceGrid(
        jnp.asarray([-1.0, -1, -0.05]),
        jnp.asarray(1.0),
        jnp.asarray(np.broadcast_to([0.0, 1.0], (3, 3, 2)), jnp.float32),
    )
    scene = [IN_THE_WAY, floor, box_obstacle((-0.06, 0.3, 0.0), (0.05, 0.02, 0.3))]
    cleared = push_clear(LINE, BODY, scene)
    assert_clear(cleared, LINE, scene)


@pytest.mark.slow
def test_a_body_that_touches_at_the_pick_leaves_by_the_shortest_ramp():
    """The cube stands on a table: near the pick the required distance is the length of the path from there."""
    table = box_obstacle((0, 0, -0.05), (0.3, 0.3, 0.1))
    path = tdf.line(7, (0, 0, 0), (0, 0.4, 0.1))
    cleared = push_clear(path, BODY, [table])
    ends_kept(cleared, path)
    assert cleared.clear and cleared.clearance == pytest.approx(0, abs=1e-6)
    found = clearance(cleared.trajectory, BODY, [table], between=31)
    assert found.waypoints[1:].min() > 0.01 - 1e-5
    # Sliding along the table for all of the 15 cm to its border is not allowed, and what is given does it nearly.
    assert clearance(path, BODY, [table]).waypoints[1, 0] > 0.01 and not cleared.status.startswith("already")
    slow = push_clear(path, BODY, [table], config=ClearanceConfig(ramp=0.2))
    assert slow.status == "already clear: unchanged"


@pytest.mark.slow
def test_a_body_of_more_points_than_a_descent_looks_at_is_clear_with_all_of_them():
    rng = np.random.default_rng(0)
    body = np.concatenate([BODY, rng.uniform(-1, 1, (400, 3)) * [0.02, 0.02, 0.02] + [0, 0, 0.02]]).astype(np.float32)
    assert_clear(push_clear(LINE, body, [IN_THE_WAY]), LINE, [IN_THE_WAY], body=body)


@pytest.mark.slow
def test_a_moved_scene_moves_the_result():
    motion = random_poses(5, 1, reach=0.5)[0]
    box = composed(motion, np.asarray(IN_THE_WAY.T_world_box)[None])[0]
    moved = box_obstacle(box[4:], IN_THE_WAY.size, box[:4])
    here = push_clear(LINE, BODY, [IN_THE_WAY]).trajectory
    path = LINE.transformed(jnp.asarray(motion, jnp.float32))
    # the same rotations; what is kept is kept as it is written
    path = tdf.Trajectory(path.wxyz_xyz * jnp.asarray([-1, -1, -1, -1, 1, 1, 1]))
    cleared = push_clear(path, BODY, [moved])
    ends_kept(cleared, path)
    there = cleared.trajectory
    expected = tdf.Trajectory(jnp.asarray(composed(motion, here.wxyz_xyz), jnp.float32))
    np.testing.assert_allclose(there.translations, expected.translations, atol=1e-3)
    np.testing.assert_allclose(there.rotations, expected.rotations, atol=1e-2)


# Failures are reported


def test_a_goal_inside_of_an_obstacle_is_reported():
    around = box_obstacle((0, 0.4, 0), (0.2, 0.2, 0.2))
    cleared = push_clear(LINE, BODY, [AWAY, around], config=ONE_LOOK)
    ends_kept(cleared, LINE)
    assert not cleared.clear
    assert "the last pose is 0.080 m inside obstacle 1" in cleared.status and "move that end" in cleared.status
    assert (
        "the first pose"
        in push_clear(LINE, BODY, [box_obstacle((0, 0, 0), (0.2, 0.2, 0.2)), AWAY], config=ONE_LOOK).status
    )


@pytest.mark.slow
def test_a_closed_room_is_reported():
    """Six walls around the start: there is no way out."""
    sides = np.concatenate([np.eye(3), -np.eye(3)])
    room = [box_obstacle(0.11 * side, 0.3 - 0.28 * np.abs(side)) for side in sides]
    cleared = push_clear(LINE, BODY, room, config=FEW_STEPS)
    ends_kept(cleared, LINE)
    assert not cleared.clear and cleared.excess < -0.005
    assert cleared.status.startswith("not clear: 0.0") and "lower the margin" in cleared.status
    assert cleared.clearance == pytest.approx(clearance(cleared.trajectory, BODY, room).min)


def test_two_poses_cannot_be_pushed_and_that_is_reported():
    two = tdf.line(2, (0, 0, 0), (0, 0.4, 0))
    cleared = push_clear(two, BODY, [IN_THE_WAY])
    np.testing.assert_array_equal(cleared.trajectory.wxyz_xyz, two.wxyz_xyz)
    assert not cleared.clear and "give it more poses, resample(trajectory, 5)" in cleared.status
    assert push_clear(two, BODY, [AWAY]).clear


# Errors


def test_bad_input_is_refused():
    @dataclasses.dataclass(frozen=True)
    class Plain:
        def distance(self, x):
            return x[..., 0]

    for function in (clearance, push_clear):
        name = function.__name__
        for obstacles in ([], IN_THE_WAY, None):
            with pytest.raises(InputError, match=rf"{name}\(\): obstacles are .*expected a list"):
                function(LINE, BODY, obstacles)
        for obstacle in (3.0, "box", Plain(), np.ones(3)):
            with pytest.raises(InputError, match=rf"{name}\(\): obstacles\[1\] is a"):
                function(LINE, BODY, [AWAY, obstacle])
        for body in (BODY[:, :2], BODY[:0], BODY * np.nan, [["a"] * 3]):
            with pytest.raises(InputError, match=rf"{name}\(\): body has"):
                function(LINE, body, [AWAY])
        with pytest.raises(InputError, match="NaN or infinite"):
            function(tdf.Trajectory(np.full((2, 7), np.inf)), BODY, [AWAY])
    for between in (-1, 1.5, 256, True):
        with pytest.raises(InputError, match=r"clearance\(\): between is"):
            clearance(LINE, BODY, [AWAY], between=between)
    for margin in (-0.01, np.nan, [0.01]):
        with pytest.raises(InputError, match="margin is"):
            push_clear(LINE, BODY, [AWAY], margin=margin)
    with pytest.raises(InputError, match="config is"):
        push_clear(LINE, BODY, [AWAY], config={"ramp": 1})
    for bad in (
        {"rotation_scale": 0.0},
        {"ramp": -1.0},
        {"deviation": np.inf},
        {"contact": -0.1},
        {"directions": 0},
        {"iterations": 1.5},
    ):
        with pytest.raises(InputError, match=rf"ClearanceConfig\(\): {next(iter(bad))} is"):
            ClearanceConfig(**bad)
