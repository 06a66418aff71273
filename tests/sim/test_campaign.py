"""Campaigns: the same outcomes in any number of processes, kept between runs, and what cannot be measured."""

import dataclasses
import os
import types

import numpy as np
import pytest
import trimesh
from conftest import DOWN
from PIL import Image

from tdf_jax._internal.errors import InputError
from tdf_jax.sim import campaign
from tdf_jax.sim.bodies import Body
from tdf_jax.sim.campaign import run_campaign, run_one
from tdf_jax.sim.condition import (
    EVEN,
    LIBRARY,
    METHODS,
    REPLAY,
    TRUTH,
    UNCENTRED,
    Condition,
    Settings,
    check_condition,
    check_settings,
)
from tdf_jax.sim.episode import Outcome
from tdf_jax.sim.imitator import Imitator, centred_paths
from tdf_jax.sim.recording import check_film
from tdf_jax.sim.report import record
from tdf_jax.sim.tasks import NotDrawn

SHELF = Condition("bowl_on_shelf", "known", "upright", "execute", method=TRUTH)


def settings(folder, condition=SHELF):
    return Settings(condition, "bowl", None, 3, folder)


@pytest.fixture(scope="module")
def first(robot, tmp_path_factory):
    """The outcomes of two episodes, in one process, and the folder that keeps them."""
    folder = tmp_path_factory.mktemp("campaign")
    return folder, list(run_campaign(settings(folder), 2, processes=1, progress=False))


def compared(folder, runs):
    made = record(settings(folder), runs)
    del made["seconds"]
    return made


@pytest.mark.slow
def test_the_truth_succeeds(first):
    _, runs = first
    assert [run.number for run in runs] == [0, 1] and all(run.outcome.overall for run in runs), runs


@pytest.mark.slow
def test_two_processes_give_the_same(first, tmp_path):
    folder, runs = first
    again = list(run_campaign(settings(tmp_path), 2, processes=2, progress=False))
    assert compared(tmp_path, again) == compared(folder, runs)


@pytest.mark.slow
def test_a_film_is_of_the_same_episode(first, tmp_path):
    try:
        check_film(path := tmp_path / "film.gif")
    except InputError as error:
        pytest.skip(f"FILM NOT CHECKED: {error}")
    folder, runs = first
    assert campaign.film(settings(folder), 0, path) == runs[0].outcome
    with Image.open(path) as film:
        assert getattr(film, "n_frames", 1) > 100


@pytest.mark.slow
def test_a_run_is_resumed(first, monkeypatch):
    """What is kept is not run again, and what is missing is."""
    folder, runs = first
    calls = []

    def run(imitator, number):
        calls.append(number)
        raise InputError("it runs again")

    monkeypatch.setattr(campaign, "_run", run)
    kept = [run_one(settings(folder), number) for number in (0, 1)]
    assert kept == runs and not calls
    with pytest.raises(InputError, match="it runs again"):
        run_one(settings(folder), 2)
    assert calls == [2]


@pytest.mark.slow
@pytest.mark.parametrize("method", METHODS)
def test_every_method_gives_a_path_and_a_motion(robot, tmp_path, method):
    imitator = Imitator(settings(tmp_path, SHELF._replace(method=method, mass=0.01)))
    episode, shown = imitator.episode(4)
    assert episode.object_body.mass == 0.01 and shown == 4
    np.testing.assert_array_equal(episode.T_world_target, imitator.demonstrated(4)[0].T_world_target)
    found = imitator.found(episode, shown)
    paths, motion = found.paths, found.motion
    assert len(found.openings) == len(paths) and (found.openings > 0).all()
    for T in (*paths[0], motion):
        np.testing.assert_allclose(T[:3, :3].T @ T[:3, :3], np.eye(3), atol=1e-4)
    # The gripper moves with the object from the pick to the release.
    np.testing.assert_allclose(motion @ paths[0][0], paths[0][-1], atol=2e-3)


@pytest.fixture
def imitator(tmp_path, monkeypatch):
    """An imitator by condition, without a robot or networks, whose only episode is two balls on a table."""
    ball = trimesh.creation.icosphere(1, 0.04)
    body = Body([np.asarray(ball.vertices)], 0.1, np.zeros(3), 1e-4 * np.eye(3), ball)
    starts = np.tile(np.eye(4), (2, 1, 1))
    starts[:, :3, 3] = [(0.4, 0.2, 0.04), (0.6, -0.2, 0.04)]
    shape = types.SimpleNamespace(mesh=ball)
    episode = types.SimpleNamespace(
        **{"number": 0, "rejected": 0, "redrawn": 0, "object": shape, "target": shape, "T_target_object": np.eye(4)},
        **{"object_body": body, "target_body": body, "T_world_object": starts[0], "T_world_target": starts[1]},
        grip=types.SimpleNamespace(opening=0.05),
    )
    monkeypatch.setattr(Imitator, "episode", lambda self, number: (episode, 0))
    monkeypatch.setattr("tdf_jax.sim.robot.load_robot", lambda *about: None)
    monkeypatch.setattr("tdf_jax.networks.checkpoint.load_model", lambda name: name)
    monkeypatch.setattr("tdf_jax.networks.model.fingerprint", lambda model: model)
    monkeypatch.setattr(Imitator, "reference", lambda self, shown: None)
    monkeypatch.setattr("tdf_jax.sim.imitator.centred_paths", lambda path, *about: [(path, 0.05)])

    def make(**change):
        made = Imitator(settings(tmp_path, SHELF._replace(**change)))
        made._demonstrated[0] = episode, None
        return made

    return make


def result(**change):
    return types.SimpleNamespace(
        **{"finite": [False, False], "energies": [np.nan, np.nan], "status": "2 of 2 candidates", **change}
    )


def refuse(*arguments, **keywords):
    raise InputError("relate(): the clouds are far apart; expected them in one frame")


@pytest.mark.parametrize("mode", ["execute", "teleport"])
@pytest.mark.parametrize(
    ("where", "what", "detail"),
    [
        ("tdf_jax.imitation.imitate", lambda *arguments, **keywords: result(), "no candidate is finite: 2 of 2 cand"),
        ("tdf_jax.imitation.imitate", refuse, "relate(): the clouds are far apart; expected them in one frame"),
    ],
)
def test_an_episode_in_which_nothing_is_found_fails(imitator, monkeypatch, mode, where, what, detail):
    monkeypatch.setattr(where, what)
    kept = campaign._run(imitator(method=LIBRARY, mode=mode), 0)
    assert kept["cause"] == "not found" and detail in kept["detail"]
    assert not (kept["grasp"] or kept["place"] or kept["overall"] or kept["strict"]) and np.isnan(kept["slip"])


@pytest.mark.parametrize("playbacks", [True, False])
def test_motions_are_kept_unless_they_are_not_asked_for(imitator, monkeypatch, playbacks):
    monkeypatch.setattr("tdf_jax.imitation.imitate", refuse)
    made = imitator(method=LIBRARY)
    made.settings = dataclasses.replace(made.settings, playbacks=playbacks)
    campaign._run(made, 0)
    assert (made.settings.folder / "episodes").is_dir() == playbacks


def test_an_episode_whose_target_no_camera_sees_fails(imitator, monkeypatch):
    """One camera sees the object; the target is hidden from it, as by a wall."""
    from tdf_jax.sim import cameras

    see = cameras.observed_points

    def hidden(model, data, rig, name, **options):
        if name == "target":
            rig = [cameras.look_at(one.T_world_camera[:3, 3], one.T_world_camera[:3, 3] + (0, 0, 1)) for one in rig]
        return see(model, data, rig, name, **options)

    monkeypatch.setattr(cameras, "observed_points", hidden)
    kept = campaign._run(imitator(method=REPLAY, clouds="views1", target="found", mask="simulator"), 0)
    assert kept["cause"] == "not found" and "none of 1 cameras sees the body 'target'" in kept["detail"]


def test_an_outcome_without_motion_is_kept_and_cannot_be_filmed(imitator, tmp_path, monkeypatch):
    monkeypatch.setattr("tdf_jax.imitation.imitate", refuse)
    made = imitator(method=LIBRARY)
    monkeypatch.setattr(campaign, "load_imitator", lambda settings: made)
    first, again = (run_one(made.settings, 0) for _ in range(2))
    assert first.outcome.cause == again.outcome.cause == "not found" and first.outcome.detail == again.outcome.detail
    with pytest.raises(InputError, match=r"episode 0 has no motion: relate\(\): the clouds are far apart"):
        campaign.film_one(made.settings, 0, tmp_path / "film.gif")


def test_the_times_of_an_episode_are_apart(imitator, monkeypatch):
    """A clock that counts: 2 s of imitation, 4 s of planning, 8 s of physics."""
    now = [0.0]
    monkeypatch.setattr(campaign.time, "perf_counter", lambda: now[0])

    def imitated(self, episode, shown):
        now[0] += 2
        return [np.eye(4)[None]], np.zeros((0, 3)), np.eye(4)

    def run_episode(episode, robot, candidates, openings, watch, planned):
        now[0] += 4
        planned()
        now[0] += 8
        return Outcome.failure("unreachable", "far")

    monkeypatch.setattr(Imitator, "imitated", imitated)
    monkeypatch.setattr("tdf_jax.sim.episode.run_episode", run_episode)
    made = imitator(method=UNCENTRED)
    monkeypatch.setattr(campaign, "load_imitator", lambda settings: made)
    run = run_one(made.settings, 0)
    assert run.seconds == (2.0, 4.0, 8.0)


@pytest.mark.parametrize("where", ["episode", "found"], ids=["the episode", "its demonstration"])
def test_an_episode_that_cannot_be_drawn_ends_no_campaign(imitator, monkeypatch, where):
    """It is kept as what it is, with the starts that were tried."""

    def nothing(self, *about):
        raise NotDrawn("draw_episode(): no bowl_on_shelf is within reach", 25, 1)

    monkeypatch.setattr(Imitator, where, nothing)
    made = imitator()
    monkeypatch.setattr(campaign, "load_imitator", lambda settings: made)
    first, again = (run_one(made.settings, 0) for _ in range(2))
    assert repr(first) == repr(again) and first.outcome.cause == "not drawn" and not first.outcome.drawn
    assert (first.rejected, first.redrawn) == (25, 1) and "within reach" in first.outcome.detail
    with pytest.raises(InputError, match="episode 0 has no motion: draw_episode"):
        campaign.found_in(made.settings, 0)


def test_a_demonstration_that_cannot_be_drawn_is_tried_once(imitator, monkeypatch):
    calls = []

    def nothing(*arguments):
        calls.append(arguments)
        raise NotDrawn("none is within reach")

    monkeypatch.setattr("tdf_jax.sim.tasks.draw_episode", nothing)
    made = imitator()
    for _ in range(2):
        with pytest.raises(NotDrawn, match=r"none is within reach \(of the demonstrations\)"):
            made.demonstrated(3)
    assert len(calls) == 1


def test_what_was_imitated_is_kept(imitator, monkeypatch):
    paths, motion = np.tile(DOWN, (2, 3, 1, 1)), np.diag([1.0, 1, 1, 1])
    paths[..., :3, 3] = np.random.default_rng(0).normal(size=(2, 3, 3))
    monkeypatch.setattr(Imitator, "imitated", lambda self, episode, shown: (list(paths), np.zeros((0, 3)), motion))
    far = Outcome.failure("unreachable", "far")
    monkeypatch.setattr("tdf_jax.sim.episode.run_episode", lambda *arguments, **keywords: far)
    made = imitator(method=UNCENTRED)
    monkeypatch.setattr(campaign, "load_imitator", lambda settings: made)
    assert run_one(made.settings, 0).outcome.cause == "unreachable"
    monkeypatch.setattr(Imitator, "imitated", lambda *about: pytest.fail("it is imitated again"))
    found = campaign.found_in(made.settings, 0)[-1]
    np.testing.assert_array_equal(found.paths, paths)
    np.testing.assert_array_equal(found.motion, motion)


def test_modes_and_masses_share_what_is_imitated(imitator, monkeypatch):
    """Centred or not; its time is that of when it was computed; another method imitates again."""
    calls = []

    def imitated(self, episode, shown):
        calls.append(self.condition)
        return [np.eye(4)[None]], np.zeros((0, 3)), np.eye(4)

    monkeypatch.setattr(Imitator, "imitated", imitated)
    monkeypatch.setattr("tdf_jax.sim.imitator.centred_paths", lambda path, *about: [(path + 1, 0.07), (path, 0.06)])
    light = {"mode": "teleport", "mass": 0.01, "method": LIBRARY}
    conditions = [{"mode": "execute", "method": UNCENTRED}, light, {"method": EVEN}]
    found = [imitator(**change).found(imitator(**change).episode(0)[0], 0) for change in conditions]
    assert len(calls) == 2 and found[0].seconds == found[1].seconds
    np.testing.assert_array_equal(found[1].paths, [found[0].paths[0] + 1, found[0].paths[0]])
    assert list(found[0].openings) == [0.07] and list(found[1].openings) == [0.07, 0.06]


def test_a_found_target_needs_weights_and_meshes_their_folder(tmp_path):
    found = settings(tmp_path, SHELF._replace(task="bowl_on_mug", target="found", method=LIBRARY))
    with pytest.raises(
        InputError, match="there are no weights of a mug, which is to be found; expected --target known"
    ):
        next(run_campaign(found, 1, progress=False))
    check_settings(dataclasses.replace(found, target_weights="mug"))
    check_settings(dataclasses.replace(found, condition=found.condition._replace(method=TRUTH)))
    with pytest.raises(InputError, match="objects is 'meshes' and meshes is None; expected a folder for 'meshes'"):
        next(run_campaign(settings(tmp_path, SHELF._replace(objects="meshes")), 1, progress=False))


def test_wrong_weights_are_no_failure_of_an_episode(imitator, monkeypatch):
    made = imitator(method=LIBRARY)
    monkeypatch.setattr(Imitator, "reference", refuse)
    with pytest.raises(InputError, match="far apart"):
        campaign._run(made, 0)


def test_the_processes_leave_no_setting_behind(monkeypatch):
    import os

    monkeypatch.setenv("XLA_FLAGS", "--xla_cpu_parallel_codegen_split_count=1")
    with campaign.process_pool(1):
        assert "eigen=false" in os.environ["XLA_FLAGS"] and "split_count" in os.environ["XLA_FLAGS"]
    assert os.environ["XLA_FLAGS"] == "--xla_cpu_parallel_codegen_split_count=1"
    monkeypatch.delenv("XLA_FLAGS")
    with campaign.process_pool(1):
        pass
    assert "XLA_FLAGS" not in os.environ


def test_a_centred_path_moves_the_object_as_before(robot):
    """The pick changes in the gripper, and so does every other pose."""
    rng = np.random.default_rng(0)
    path = np.tile(np.diag([1.0, -1, -1, 1]), (5, 1, 1))
    path[:, :3, 3] = np.cumsum(rng.normal(0, 0.05, (5, 3)), axis=0) + (0.4, 0, 0.2)
    depth = robot.fingers.depth(0.0)
    wall = path[0] @ np.array([0, 0.004, depth, 1])
    spread = np.stack([rng.uniform(-0.01, 0.01, 60), rng.choice([-0.001, 0.001], 60), rng.uniform(-0.02, 0.02, 60)])
    points = wall[:3] + spread.T
    ((centred, _),) = centred_paths(path, points, 0.05, robot)
    assert abs(centred[0][1, 3] - path[0][1, 3]) == pytest.approx(0.004, abs=1e-3)
    for before, after in zip(path, centred):
        np.testing.assert_allclose(after @ np.linalg.inv(centred[0]), before @ np.linalg.inv(path[0]), atol=1e-9)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"task": "mug_on_mug"}, "task is 'mug_on_mug'; expected one of"),
        ({"poses": "tilt30"}, "poses is 'tilt30'"),
        ({"mode": "think"}, "mode is 'think'"),
        ({"clouds": "views2"}, "clouds is 'views2'"),
        ({"mask": "simulator"}, "mask is 'simulator', and complete clouds need none"),
        ({"mask": "by hand", "clouds": "views1"}, "mask is 'by hand'; expected one of"),
        ({"method": "luck"}, "method is 'luck'"),
        ({"target": "found"}, "the shelf of bowl_on_shelf is known"),
        ({"demonstrations": 5}, "demonstrations is 5; expected 1 or 10"),
        ({"demonstrations": 10}, "a known target stands where it stood"),
        ({"task": "bowl_on_mug", "target": "found", "demonstrations": 10}, "truth has one demonstration"),
    ],
    ids=lambda value: "" if isinstance(value, dict) else value[:20],
)
def test_what_cannot_be_measured_is_refused(change, message):
    with pytest.raises(InputError, match=f"tdf simulate: {message}"):
        check_condition(SHELF._replace(**change))
    check_condition(SHELF)


def test_a_process_that_is_killed_ends_in_a_line():
    """Whether it runs episodes, films one or draws failures."""
    with pytest.raises(InputError, match="a process ended by itself, .* Run the command again"):
        with campaign.process_pool(1) as pool:
            pool.submit(os._exit, 3).result()
