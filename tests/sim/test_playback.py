"""Episodes to look at: what is noted of them, and their files."""

import dataclasses
import os

import numpy as np
import pytest
from conftest import lifted, short_playback

from tdf_jax._internal.errors import InputError
from tdf_jax.sim import playback as module
from tdf_jax.sim.episode import run_episode, start_cell, teleport
from tdf_jax.sim.playback import RATE, Sampler, kept_episode, kept_episodes, load_playback, save_playback
from tdf_jax.sim.workcell import OBJECT, TABLE_NAME, TARGET


def test_an_episode_is_read_as_it_was_written(tmp_path):
    shown = short_playback()
    path = save_playback("test", tmp_path / "episodes", "it", shown)
    again = load_playback("test", path)
    assert again.about == shown.about and again.bodies == shown.bodies and again.phases == shown.phases
    np.testing.assert_allclose(again.times, shown.times, atol=1e-6)
    np.testing.assert_allclose(again.wxyz_xyz, shown.wxyz_xyz, atol=1e-4)
    np.testing.assert_array_equal(again.points, shown.points)
    np.testing.assert_allclose(again.path, shown.path, atol=1e-6)
    for one, other in zip(again.solids, shown.solids, strict=True):
        assert one.body == other.body
        np.testing.assert_allclose(one.colour, other.colour, atol=1e-6)
        np.testing.assert_allclose(one.vertices, other.vertices, atol=1e-4)
        np.testing.assert_array_equal(one.faces, other.faces)
    assert again.phase(1) == "path" and again.phase(2) == "settling" and again.verdict == "success"
    assert again.title == "bowl_on_shelf, episode 3, execute"
    failed = short_playback(cause="fell", detail="on the table", instance="my bowl")
    assert failed.verdict == "fell: on the table" and "episode 3 on my bowl" in failed.title


def test_the_robot_is_kept_once_for_all_episodes(tmp_path):
    for number in (3, 4):
        save_playback("test", tmp_path / "episodes", f"it{number}", short_playback(number=number))
    assert len(list((tmp_path / "episodes").glob("robot-*.npz"))) == 1
    found = kept_episodes("test", tmp_path)
    assert [(path.stem, about["number"]) for path, about in found] == [("it3", 3), ("it4", 4)]
    late = save_playback("test", tmp_path / "episodes", "it3again", short_playback(number=3))
    os.utime(late, (2e9, 2e9))
    assert kept_episode("test", tmp_path, {"number": 3, "seed": 0}) == late
    assert kept_episode("test", tmp_path, {"number": 3, "seed": 1}) is None


def test_what_is_damaged_or_of_another_version_is_refused(tmp_path, monkeypatch):
    path = save_playback("test", tmp_path / "episodes", "it", short_playback())
    monkeypatch.setattr(module, "SCHEMA", 2)
    with pytest.raises(InputError, match="it.npz has schema 1; expected 2"):
        load_playback("test", path)
    monkeypatch.undo()
    next(path.parent.glob("robot-*")).rename(tmp_path / "away.npz")
    with pytest.raises(InputError, match="needs robot-[0-9a-f]+.npz beside it"):
        load_playback("test", path)
    path.write_bytes(path.read_bytes()[:100])
    with pytest.raises(InputError, match="test: cannot read .*it.npz"):
        kept_episodes("test", tmp_path)


@pytest.mark.slow
@pytest.mark.parametrize("reach", [0.0, 3.0], ids=["placed", "out of reach"])
def test_an_executed_episode_is_noted_and_comes_out_the_same(robot, drawn, reach):
    episode = drawn("bowl_on_shelf")
    release = episode.release.copy()
    release[0, 3] += reach
    path = lifted(episode.pick, release, 0.2)
    sampler = Sampler(episode, robot)
    outcome = run_episode(episode, robot, [path], watch=sampler.watch)
    alone = run_episode(episode, robot, [path])
    assert repr(outcome) == repr(alone)
    shown = sampler.playback({}, np.zeros((0, 3)), path)
    place = {name: number for number, name in enumerate(shown.bodies)}
    np.testing.assert_allclose(shown.wxyz_xyz[0, place[OBJECT], 4:], episode.T_world_object[:3, 3], atol=2e-3)
    np.testing.assert_allclose(shown.wxyz_xyz[:, place[TARGET], 4:] - episode.T_world_target[:3, 3], 0, atol=1e-9)
    assert {one.body for one in shown.solids} == set(shown.bodies) and TABLE_NAME in place
    np.testing.assert_allclose(shown.path[0, 4:], episode.pick[:3, 3])
    if reach:
        assert outcome.cause == "unreachable" and shown.phases == (("start", 0),)
        return
    names = [name for name, _ in shown.phases]
    assert names == ["transit", "approach", "grasp", "path", "release", "retreat", "return", "settling"]
    assert (np.diff(shown.times) > 0).all() and np.median(np.diff(shown.times)) == pytest.approx(1 / RATE, abs=2e-3)
    seated = episode.T_world_target @ episode.T_target_object
    np.testing.assert_allclose(shown.wxyz_xyz[-1, place[OBJECT], 4:], seated[:3, 3], atol=0.02)
    assert np.isfinite(shown.wxyz_xyz).all()
    cell = start_cell(episode, robot)
    hand = next(name for name in shown.bodies if "base_mount" in name)
    home = cell.body_pose(cell.data(), hand)[:3, 3]
    np.testing.assert_allclose(shown.wxyz_xyz[[0, -1], place[hand], 4:], [home, home], atol=0.01)


@pytest.mark.slow
def test_a_teleported_episode_is_its_grasp_test_and_then_its_placement(robot, drawn):
    episode = drawn("bowl_on_shelf")
    motion = episode.T_world_target @ episode.T_target_object @ np.linalg.inv(episode.T_world_object)
    sampler = Sampler(episode, robot)
    outcome = teleport(episode, robot, episode.pick, motion, watch=sampler.watch)
    assert dataclasses.asdict(outcome) == dataclasses.asdict(teleport(episode, robot, episode.pick, motion))
    shown = sampler.playback({}, np.zeros((0, 3)), np.zeros((0, 4, 4)))
    (first, _), (second, begins) = shown.phases
    assert (first, second) == ("grasp test", "settling") and (np.diff(shown.times) > 0).all()
    place = {name: number for number, name in enumerate(shown.bodies)}
    arm = next(name for name in shown.bodies if "forearm" in name)
    hand = next(name for name in shown.bodies if "base_mount" in name)
    there = np.isfinite(shown.wxyz_xyz[..., 0])
    assert not there[:, place[arm]].any()  # a floating gripper alone, and then none
    assert there[:begins, place[hand]].all() and not there[begins:, place[hand]].any()
    assert there[:, [place[OBJECT], place[TARGET], place[TABLE_NAME]]].all()
    reset = motion @ episode.T_world_object
    np.testing.assert_allclose(shown.wxyz_xyz[begins, place[OBJECT], 4:], reset[:3, 3], atol=2e-3)
