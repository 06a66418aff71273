"""Episodes: drawn the same again, with objects that stand, or are held, where an arm can pick and place them."""

import numpy as np
import pytest
from conftest import angle
from scipy.spatial.transform import Rotation

import tdf_jax as tdf
from tdf_jax._internal.errors import InputError
from tdf_jax.geometry.symmetry import ROUND
from tdf_jax.sim import tasks
from tdf_jax.sim.kinematics import kinematics_of
from tdf_jax.sim.tasks import ABOVE, OBJECTS, TARGETS, TASKS, demonstrate_episode, draw_episode


def lowest(shape, T):
    return (shape.mesh.vertices @ T[:3, :3].T + T[:3, 3])[:, 2].min()


def same(one, other):
    for name in ("T_world_object", "T_world_target", "T_target_object", "T_target_contact"):
        np.testing.assert_array_equal(getattr(one, name), getattr(other, name))
    np.testing.assert_array_equal(one.grip.T_object_grip, other.grip.T_object_grip)
    np.testing.assert_array_equal(one.object.mesh.vertices, other.object.mesh.vertices)
    assert (one.rejected, one.redrawn) == (other.rejected, other.redrawn)


@pytest.mark.parametrize(
    "task",
    [pytest.param(task, marks=[] if task in ("bowl_on_shelf", "mug_on_rack") else pytest.mark.slow) for task in TASKS],
)
def test_objects_and_targets_stand_on_the_table_within_reach(robot, drawn, task):
    episode = drawn(task)
    assert (episode.object.category, episode.target.category) == TASKS[task][:2]
    for shape, T, area in (
        (episode.object, episode.T_world_object, OBJECTS),
        (episode.target, episode.T_world_target, TARGETS),
    ):
        assert lowest(shape, T) == pytest.approx(0, abs=1e-9) and T[2, 2] == pytest.approx(1)
        assert all(low <= value <= high for value, (low, high) in zip(T[:2, 3], area))
    assert not episode.fixture
    # Both ends are within reach by a search from other starts.
    kinematics, rng = kinematics_of(robot), np.random.default_rng(77)
    for T in (episode.pick, episode.release):
        starts = [np.clip(robot.home + rng.normal(0, 0.8, 6), robot.lower, robot.upper) for _ in range(20)]
        turned = [T @ half for half in (np.eye(4), np.diag([-1.0, -1, 1, 1]))]
        assert any(kinematics.solve(pose, start) is not None for start in starts for pose in turned)


def test_an_episode_is_the_same_again_and_its_neighbour_another(robot, drawn):
    one = drawn("bowl_on_shelf")
    same(draw_episode("bowl_on_shelf", robot, 900, 0), one)
    other = draw_episode("bowl_on_shelf", robot, 900, 1)
    assert np.abs(other.T_world_object - one.T_world_object).max() > 1e-3
    assert (
        other.object.mesh.vertices.shape != one.object.mesh.vertices.shape
        or (other.object.mesh.vertices != one.object.mesh.vertices).any()
    )


@pytest.mark.parametrize("poses", ["tilt60", "uniform"])
def test_tilted_objects_are_held_above_the_table(drawn, poses):
    episode = drawn("bowl_on_shelf", poses)
    assert episode.fixture and episode.poses == poses
    assert lowest(episode.object, episode.T_world_object) == pytest.approx(ABOVE, abs=1e-6)
    tilt = np.degrees(np.arccos(episode.T_world_object[2, 2]))
    assert tilt > 1
    if poses == "tilt60":
        assert tilt <= np.degrees(np.arccos(0.25)) + 1e-6  # roll and pitch within 60 degrees


def test_a_known_target_stays(robot, drawn):
    known = drawn("bowl_on_shelf")
    episode = draw_episode("bowl_on_shelf", robot, 900, 5, known=known)
    assert episode.target == known.target
    np.testing.assert_array_equal(episode.T_world_target, known.T_world_target)
    assert (episode.T_world_object != known.T_world_object).any()


@pytest.mark.slow
def test_a_known_target_of_a_relation_stays(robot, drawn):
    known = drawn("bowl_on_mug")
    episode = draw_episode("bowl_on_mug", robot, 900, 5, known=known)
    assert episode.target is known.target
    np.testing.assert_array_equal(episode.T_world_target, known.T_world_target)


@pytest.mark.slow
@pytest.mark.parametrize("task", ["bowl_on_shelf", "mug_on_rack"])
def test_a_demonstration_leads_from_the_true_pick_to_the_true_release(drawn, task):
    episode = drawn(task)
    demonstration = demonstrate_episode(episode, 0, points=60)
    path = np.asarray(demonstration.trajectory.matrices, float)
    for T, true in ((path[0], episode.pick), (path[-1], episode.release)):
        np.testing.assert_allclose(T[:3, 3], true[:3, 3], atol=1e-5)
        assert angle(T, true) < 0.05
    # Its clouds lie on the object and the target, where they are.
    assert demonstration.target is not None
    for shape, T, points in (
        (episode.object, episode.T_world_object, demonstration.points),
        (episode.target, episode.T_world_target, demonstration.target.points),
    ):
        local = (np.asarray(points, float) - T[:3, 3]) @ T[:3, :3]
        low, high = shape.mesh.bounds
        assert (local > low - 1e-4).all() and (local < high + 1e-4).all()
        assert np.ptp(local, axis=0).min() > 0.5 * (high - low).min()
    # The held object clears the target on the way.
    assert path[:, 2, 3].max() > path[-1, 2, 3] + 0.005


def test_what_nothing_fits_around_is_drawn_again(robot, drawn, monkeypatch):
    """A bottle whose neck is too wide is counted, and ends no run."""
    grip_of, calls = tasks.grip_of, []

    def too_wide_once(shape, fingers):
        calls.append(shape)
        if len(calls) == 1:
            raise InputError("grip_of(): too wide")
        return grip_of(shape, fingers)

    monkeypatch.setattr(tasks, "grip_of", too_wide_once)
    episode = draw_episode("bowl_on_shelf", robot, 900, 0)
    assert episode.redrawn == 1 and len(calls) == 2 and calls[1] is episode.object


def test_where_no_object_fits_the_gripper_it_is_said(robot, monkeypatch):
    """Not that the arm does not reach, which was not looked at."""

    def too_wide(shape, fingers):
        raise InputError("grip_of(): too wide")

    monkeypatch.setattr(tasks, "grip_of", too_wide)
    with pytest.raises(tasks.NotDrawn, match=r"fits UR5e in 20 pairs: grip_of\(\): too wide; expected a gripper that"):
        draw_episode("bowl_on_shelf", robot, 900, 0)


@pytest.mark.slow
def test_a_tilted_bottle_is_picked_in_the_plane_of_its_tilt(robot, drawn):
    episode = drawn("bottle_on_shelf", "tilt60")
    assert episode.grip.fold == ROUND
    axis, closing = episode.T_world_object[:3, 2], episode.pick[:3, 1]
    normal = np.cross(axis, [0.0, 0, 1])
    normal /= np.linalg.norm(normal)
    assert np.degrees(np.arcsin(abs(closing @ normal))) < 5.1
    # The same grasp as before but for the turn about the neck's axis.
    plain = tasks.grip_of(episode.object, robot.fingers)
    turn = episode.grip.T_object_grip @ np.linalg.inv(plain.T_object_grip)
    np.testing.assert_allclose(turn[:3, 2], (0, 0, 1), atol=1e-9)
    np.testing.assert_allclose(turn[:3, 3], 0, atol=1e-9)
    # Along the demonstrated path the weight turns it little about the closing axis.
    path = np.asarray(demonstrate_episode(episode, 0, points=60).trajectory.matrices, float)
    centre = (
        path[:, :3, :3] @ (np.linalg.inv(episode.grip.T_object_grip) @ np.append(episode.object_body.centre, 1))[:3]
    )
    arms = np.einsum("si,si->s", np.cross(centre, (0, 0, -1.0)), path[:, :3, 1])  # of its weight
    assert np.abs(arms).max() < 0.2 * np.linalg.norm(centre[0])


def test_a_round_grasp_is_turned_to_where_the_object_does_not_swing(robot):
    grip = tasks.grip_of(tdf.build_bottle(), robot.fingers)
    T = np.eye(4)
    T[:3, :3] = Rotation.from_euler("zyx", (70, 35, -20), degrees=True).as_matrix()
    turned = tasks._turned(grip, T)
    assert len(turned) == 3
    up = T[2, :3]
    for one, off in zip(turned, (0, 5, 5)):
        closing = one.T_object_grip[:3, 1]
        across = np.cross((0, 0, 1), up) / np.linalg.norm(up[:2])
        assert np.degrees(np.arcsin(abs(closing @ across))) == pytest.approx(off, abs=1e-6)
    assert tasks._turned(grip, np.eye(4)) == [grip]  # upright nothing swings
    assert tasks._turned(grip._replace(fold=1), T)[0].fold == 1 and len(tasks._turned(grip._replace(fold=1), T)) == 1


def test_wrong_names_are_refused(robot):
    with pytest.raises(InputError, match=r"draw_episode\(\): task is 'mug_on_mug'; expected one of mug_on_rack"):
        draw_episode("mug_on_mug", robot, 0, 0)
    with pytest.raises(InputError, match=r"draw_episode\(\): poses is 'tilt30'; expected one of upright"):
        draw_episode("bowl_on_mug", robot, 0, 0, "tilt30")


def test_a_robot_that_reaches_nothing_is_said(monkeypatch, robot):
    monkeypatch.setattr(tasks, "within_reach", lambda *arguments: False)
    monkeypatch.setattr(tasks, "MOST_PAIRS", 2)
    with pytest.raises(InputError, match=r"no bowl_on_shelf of episode 4 \(seed 1\) is within reach of UR5e in 2"):
        draw_episode("bowl_on_shelf", robot, 1, 4)
