"""Episodes: the truth succeeds, in both modes, and what is done wrong fails for its own cause."""

import dataclasses

import numpy as np
import pytest
from conftest import lifted
from scipy.spatial.transform import Rotation

from tdf_jax.sim import episode as module, placement
from tdf_jax.sim.episode import CAUSES, run_episode, teleport
from tdf_jax.sim.tasks import TASKS, demonstrate_episode


def true_motion(episode):
    return episode.T_world_target @ episode.T_target_object @ np.linalg.inv(episode.T_world_object)


def raised(motion, x=0.0, z=0.0):
    moved = motion.copy()
    moved[0, 3] += x
    moved[2, 3] += z
    return moved


def path_of(episode):
    return lifted(episode.pick, episode.release, 0.2)


@pytest.mark.parametrize(
    "task", [pytest.param(one, marks=[] if one == "bowl_on_shelf" else pytest.mark.slow) for one in TASKS]
)
def test_the_executed_truth_succeeds(robot, drawn, task):
    path = path_of(drawn(task))
    if task == "mug_on_rack":  # along the peg
        path = np.asarray(demonstrate_episode(drawn(task), 0, points=60).trajectory.matrices, float)
    outcome = run_episode(drawn(task), robot, [path])
    assert outcome.grasp and outcome.place and outcome.overall and outcome.strict, outcome
    assert outcome.cause == "" and outcome.slip < 0.01 and outcome.turn < 10


@pytest.mark.slow
def test_an_episode_is_the_same_again(robot, drawn):
    episode = drawn("bowl_on_shelf")
    first, second = (dataclasses.astuple(run_episode(episode, robot, [path_of(episode)])) for _ in range(2))
    assert first == second


@pytest.mark.slow
def test_a_tilted_object_is_picked_from_its_fixture(robot, drawn):
    episode = drawn("bowl_on_shelf", "tilt60")
    outcome = run_episode(episode, robot, [path_of(episode)])
    assert outcome.grasp and outcome.slip < 0.02, outcome


def test_a_pick_beside_the_object_is_a_wrong_pick(robot, drawn):
    episode = drawn("bowl_on_shelf")
    path = path_of(episode)
    path[:, 0, 3] += 0.1
    outcome = run_episode(episode, robot, [path])
    assert not (outcome.grasp or outcome.overall or outcome.strict)
    assert outcome.cause == "pick wrong" and "cm" in outcome.detail


@pytest.mark.slow
def test_a_release_beside_the_target_fell(robot, drawn):
    episode = drawn("bowl_on_shelf")
    release = episode.release.copy()
    release[1, 3] -= 0.22
    outcome = run_episode(episode, robot, [lifted(episode.pick, release, 0.2)])
    assert outcome.grasp and not outcome.place and outcome.cause == "fell", outcome


@pytest.mark.slow
def test_out_of_reach_is_unreachable(robot, drawn):
    """The pick is right, and there is no way to the release."""
    episode = drawn("bowl_on_shelf")
    path = path_of(episode)
    path[2:, 0, 3] += 3.0
    outcome = run_episode(episode, robot, [path])
    assert outcome.cause == "unreachable" and not outcome.overall and np.isnan(outcome.slip)


def test_the_teleported_truth_succeeds(robot, drawn):
    episode = drawn("bowl_on_shelf")
    outcome = teleport(episode, robot, episode.pick, true_motion(episode))
    assert outcome.grasp and outcome.place and outcome.overall and outcome.strict and outcome.cause == ""


@pytest.mark.parametrize(
    ("task", "motion", "cause"),
    [
        pytest.param("bowl_on_shelf", {"x": 0.3}, "fell", id="beside the shelf"),
        pytest.param("bowl_on_mug", {"x": 0.08}, "fell", id="beside the mug", marks=pytest.mark.slow),
        pytest.param("mug_on_rack", {"z": -0.03}, "fell", id="in the rack", marks=pytest.mark.slow),
        pytest.param("bottle_on_shelf", {"z": -0.03}, "stuck", id="in the shelf"),
    ],
)
def test_a_wrong_placement_is_no_success(robot, drawn, task, motion, cause):
    episode = drawn(task)
    outcome = teleport(episode, robot, episode.pick, raised(true_motion(episode), **motion))
    assert not (outcome.place or outcome.overall or outcome.strict) and outcome.cause == cause, outcome
    assert outcome.grasp  # for the grasp is tested apart


@pytest.mark.slow
def test_a_bowl_on_its_side_is_not_upright_or_fell(robot, drawn):
    episode = drawn("bowl_on_shelf")
    over = np.eye(4)
    over[:3, :3] = Rotation.from_euler("x", 180, degrees=True).as_matrix()
    over[2, 3] = 0.06 + float(episode.object.mesh.extents[2])
    motion = episode.T_world_target @ over @ np.linalg.inv(episode.T_world_object)
    outcome = teleport(episode, robot, episode.pick, motion)
    assert not outcome.place and outcome.cause == "not upright", outcome


@pytest.mark.slow
def test_a_grasp_of_the_air_fails_the_whole_but_not_the_place(robot, drawn):
    episode = drawn("bowl_on_shelf")
    pick = episode.pick.copy()
    pick[2, 3] += 0.15
    outcome = teleport(episode, robot, pick, true_motion(episode))
    assert outcome.place and not outcome.grasp and not outcome.overall and outcome.cause == "pick wrong"


def test_errors_of_a_pick_leave_out_the_symmetries(drawn):
    bowl, mug = drawn("bowl_on_shelf"), drawn("mug_on_rack")
    half = np.diag([-1.0, -1, 1, 1])
    turn = np.eye(4)
    turn[:3, :3] = Rotation.from_euler("z", 100, degrees=True).as_matrix()
    for episode in (bowl, mug):
        assert module._pick_error(episode, episode.pick) == ""
        assert module._pick_error(episode, episode.pick @ half) == ""
        assert module._pick_error(episode, raised(episode.pick, x=0.05)) != ""
    assert module._pick_error(bowl, bowl.T_world_object @ turn @ bowl.grip.T_object_grip) == ""
    assert module._pick_error(mug, mug.T_world_object @ turn @ mug.grip.T_object_grip) != ""


def test_a_contact_shortly_before_the_end_counts(drawn, monkeypatch):
    """A bowl that rests, and then is thrown up: in the air it has left the board less than 0.1 s ago, or more."""
    episode = drawn("bowl_on_shelf")
    cell = placement.reset_cell(episode, episode.T_world_target @ episode.T_target_object)
    data = cell.data()
    on_board = (placement.OBJECT_KIND, placement.TARGET_KIND)
    assert placement.settle(cell, data) == {on_board}
    data.joint("object").qvel[2] = 1.0
    monkeypatch.setattr(placement, "SETTLE", 0.08)
    assert placement.settle(cell, data) == {on_board} and data.ncon == 0
    monkeypatch.setattr(placement, "LAST", 0.02)
    assert placement.settle(cell, data) == set()


def test_causes_are_named_once():
    assert len(set(CAUSES)) == len(CAUSES) and "" not in CAUSES
