"""`tdf view`: what it opens, and what it refuses."""

import dataclasses
import threading

import jax
import numpy as np
import pytest
from conftest import CARRY, random_cloud, short_playback

import tdf_jax as tdf
from tdf_jax.cli.main import main
from tdf_jax.geometry.grid import plane_grid
from tdf_jax.landscape.storage import Landscape
from tdf_jax.sim.playback import FOLDER, save_playback
from tdf_jax.solvers.imitation_scene import SCENE, weights_of

pytest.importorskip("viser", reason="the extra 'viewer' is not installed")


@pytest.fixture
def folder(demonstration, weights, tmp_path):
    model, cloud = tdf.load_model(weights), random_cloud(3).astype(np.float32)
    result = tdf.imitate(model, demonstration, cloud, key=jax.random.key(0), config=CARRY, clean=False)
    (tmp_path / "out").mkdir()
    scene = tdf.ImitationScene(demonstration, cloud, result, weights=weights_of(str(weights), model))
    tdf.save_imitation(tmp_path / "out" / SCENE, scene)
    return tmp_path / "out"


@pytest.fixture
def landscape(demonstration, tmp_path):
    grid = plane_grid(0.1, 4)
    values = np.linalg.norm(grid.points, axis=-1)[None]
    (tmp_path / "land").mkdir()
    # The demonstrated pick, moved with the centroid of the object of `folder`.
    motion = random_cloud(3).mean(axis=0) - np.asarray(demonstration.points, float).mean(axis=0)
    first = np.asarray(demonstration.trajectory.translations[:1], float) + motion
    found = Landscape(grid, values, first, np.eye(3)[None], np.zeros(values.shape, np.int32))
    tdf.save_landscape(tmp_path / "land" / "landscape.npz", found)
    return tmp_path / "land"


def refusal(capsys, *words):
    with pytest.raises(SystemExit) as stop:
        main(["view", *map(str, words), "--no-browser", "--port", "0"])
    assert stop.value.code == 2
    return capsys.readouterr().err


@pytest.fixture
def simulated(tmp_path):
    (tmp_path / "benchmark" / "runs").mkdir(parents=True)
    save_playback("test", tmp_path / "benchmark" / "runs" / FOLDER, "it", short_playback(number=4))
    return tmp_path / "benchmark" / "runs"


@pytest.mark.parametrize(
    "what", ["imitation", "both", "landscape", "episodes", "benchmark", "scene", "energies", "kept", "one"]
)
def test_a_folder_is_shown_until_ctrl_c(folder, landscape, simulated, what, monkeypatch, capsys):
    def interrupted(self, timeout=None):
        raise KeyboardInterrupt

    opened = []
    monkeypatch.setattr("webbrowser.open", lambda address: opened.append(address) or True)
    monkeypatch.setattr("tdf_jax.cli.view.Waiting.wait", interrupted)
    words = {
        "imitation": [folder],
        "both": [folder, "--landscape", landscape],
        "landscape": [landscape],
        "episodes": [simulated, "--episode", 4],
        "benchmark": [simulated.parent],
        "scene": [folder / SCENE],
        "energies": [landscape / "landscape.npz"],
        "kept": [simulated / FOLDER],
        "one": [simulated / FOLDER / "it.npz"],
    }[what]
    with pytest.raises(SystemExit) as stop:
        main(["view", *map(str, words), "--port", "0"])
    assert stop.value.code == 130
    out = capsys.readouterr().out
    assert out.startswith("http://127.0.0.1:") and out.count("\n") == 1
    assert opened == [out.split()[0]]
    assert not [thread for thread in threading.enumerate() if "Worker" in thread.name]


def test_an_object_is_shown_to_demonstrate_on(tmp_path, monkeypatch, capsys):
    def interrupted(self, timeout=None):
        raise KeyboardInterrupt

    monkeypatch.setattr("tdf_jax.cli.view.Waiting.wait", interrupted)
    tdf.build_mug().mesh.export(tmp_path / "mug.obj")
    words = ["--demonstrate", tmp_path / "demo.npz", "--port", "0", "--no-browser"]
    with pytest.raises(SystemExit) as stop:
        main(["view", str(tmp_path / "mug.obj"), *map(str, words)])
    assert stop.value.code == 130 and capsys.readouterr().out.startswith("http://127.0.0.1:")
    assert not (tmp_path / "demo.npz").exists()
    assert "expected a new .npz file" in refusal(capsys, tmp_path / "mug.obj", "--demonstrate", tmp_path / "demo.txt")
    assert "--demonstrate has no use for --weights; drop it" in refusal(
        capsys, tmp_path / "mug.obj", *words[:2], "--weights", "mug"
    )
    assert "To make a demonstration on an object, add --demonstrate" in refusal(capsys, tmp_path / "mug.obj")
    assert "drop --scale" in refusal(capsys, tmp_path, "--scale", "0.01")


def test_options_of_other_folders_are_refused(folder, landscape, simulated, capsys):
    assert "there is no episode 7 in" in refusal(capsys, simulated, "--episode", 7)
    assert "simulated episodes, has no use for --landscape; drop it" in refusal(
        capsys, simulated, "--landscape", landscape
    )
    assert "an imitation, has no use for --episode; drop it" in refusal(capsys, folder, "--episode", 0)
    said = refusal(capsys, landscape, "--weights", "mug", "--landscape", landscape)
    assert "a landscape, has no use for --landscape, --weights; drop them" in said


def test_what_is_no_result_is_refused(folder, landscape, weights, tmp_path, capsys):
    assert "tdf view: there is no folder" in refusal(capsys, tmp_path / "nowhere")
    (tmp_path / "empty").mkdir()
    assert "it is empty" in refusal(capsys, tmp_path / "empty")
    (tmp_path / "simulation").mkdir()
    (tmp_path / "simulation" / "result.json").write_text("{}")
    said = refusal(capsys, tmp_path / "simulation")
    assert "tdf view: " in said and "expected a folder of `tdf imitate`, `tdf landscape` or `tdf simulate`" in said
    assert "load_imitation" not in said
    assert "there is no file" in refusal(capsys, folder, "--landscape", tmp_path / "empty")
    assert "are not those that the imitation was made with" in refusal(capsys, folder, "--weights", "bowl")


def test_a_landscape_of_another_pose_is_refused(folder, landscape, capsys):
    found, about = tdf.load_landscape(landscape / "landscape.npz")
    tdf.save_landscape(
        landscape / "landscape.npz", dataclasses.replace(found, waypoints=found.waypoints + [0, 0, 0.03]), about
    )
    said = refusal(capsys, folder, "--landscape", landscape)
    assert "has its first waypoint 3.0 cm from that of the imitation; expected at most 2 cm" in said


def test_files_that_cannot_be_shown_alone_are_named(folder, simulated, demonstration, tmp_path, capsys):
    tdf.save_demonstration(tmp_path / "demo.npz", demonstration)
    assert "holds a demonstration; expected a folder of results" in refusal(capsys, tmp_path / "demo.npz")
    tdf.save_trajectory(tmp_path / "trajectory.npz", demonstration.trajectory)
    assert "holds a trajectory without its object" in refusal(capsys, tmp_path / "trajectory.npz")
    (robot,) = (simulated / FOLDER).glob("robot-*.npz")
    assert "holds the robot of simulated episodes" in refusal(capsys, robot)
    np.savez(tmp_path / "other.npz", a=np.ones(2), b=np.ones(2))
    assert "holds the arrays a, b; expected a folder of" in refusal(capsys, tmp_path / "other.npz")
    (tmp_path / "cut.npz").write_bytes((folder / SCENE).read_bytes()[:-100])
    assert "tdf view: cannot read" in refusal(capsys, tmp_path / "cut.npz")
    (tmp_path / "motion.csv").write_text("time,a\n")
    assert "tdf view: " in refusal(capsys, tmp_path / "motion.csv")


def test_a_browser_that_does_not_open_is_said(landscape, monkeypatch, capsys):
    def interrupted(self, timeout=None):
        raise KeyboardInterrupt

    monkeypatch.setattr("webbrowser.open", lambda address: False)
    monkeypatch.setattr("tdf_jax.cli.view.Waiting.wait", interrupted)
    with pytest.raises(SystemExit):
        main(["view", str(landscape), "--port", "0"])
    assert capsys.readouterr().out.endswith("No browser was opened; open the address yourself.\n")
