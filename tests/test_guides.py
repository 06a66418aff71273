"""The blocks of code in the guides run as printed, in their order, and do what the pages say.

README.md and docs/guide/camera.md have tests of their own (test_readme.py, perception/test_guide.py), and so has the
JSON of docs/guide/evaluation.md (evaluation/test_annotated_meshes.py). The blocks of the quick start are those of
README.md. Those of objects, uncertainty, landscape, robot and viewer need trained weights, and have no test yet.
"""

import functools
import importlib
import re
import shlex
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import carried, random_cloud

import tdf_jax as tdf
from tdf_jax.cli.main import COMMANDS, main

ROOT = Path(__file__).parent.parent
DOCS = ROOT / "docs"
PAGES = [ROOT / "README.md", *sorted(DOCS.glob("*.md")), *sorted((DOCS / "guide").glob("*.md"))]


def blocks(page: Path, language: str) -> list[str]:
    return re.findall(rf"```{language}\n(.*?)```", page.read_text(), re.DOTALL)


@pytest.fixture
def run(tmp_path, monkeypatch):
    """Runs blocks of a page in an empty folder, with the names that the page assumes; gives all names."""
    monkeypatch.chdir(tmp_path)

    def run(page, names=(), chosen=slice(None)):
        names = dict(names)
        for block in blocks(DOCS / page, "python")[chosen]:
            exec(block, names)
        return names

    return run


@pytest.fixture
def assumed(small_model, demonstration):
    """The names of the README's example, with a small network."""
    return {"jax": jax, "tdf": tdf, "model": small_model, "demo": demonstration, "new": random_cloud(3).astype("f4")}


def test_languages_of_blocks_are_known():
    """A block of another language would be run by no test."""
    known = {"python", "sh", "json", "bibtex", "xml", "yaml"}
    for page in PAGES:
        assert set(re.findall(r"^```(\w+)", page.read_text(), re.MULTILINE)) <= known, page


def command_lines(block: str) -> list[str]:
    """The lines of `tdf` in a block for a shell: continued lines are joined, and its variables are replaced."""
    lines = [line.partition("  #")[0].strip() for line in block.replace("\\\n", " ").splitlines()]
    variables = dict(found.groups() for line in lines if (found := re.fullmatch(r'(\w+)="?([^"]*)"?', line)))
    lines = [re.sub(r"\$(\w+)", lambda found: variables[found[1]], line) for line in lines if line.startswith("tdf ")]
    return list(dict.fromkeys(lines))


COMMAND_LINES = [
    (page, line)
    for page in [*PAGES, *sorted((DOCS / "results").glob("*.md"))]
    for block in blocks(page, "sh")
    for line in command_lines(block)
]


@pytest.mark.parametrize("page, line", COMMAND_LINES, ids=[f"{page.stem}: {line}" for page, line in COMMAND_LINES])
def test_command_lines_are_understood(page, line, monkeypatch):
    """Every option and value is accepted; the commands themselves are run by their own tests."""
    seen = []
    for name in COMMANDS:
        module = importlib.import_module(f"tdf_jax.cli.{name}")
        command = functools.wraps(getattr(module, name))(lambda *_, name=name, **__: seen.append(name))
        monkeypatch.setattr(module, name, command)
    words = shlex.split(line)
    main(["--no-cache", *words[1:]])
    assert seen == [words[1]]


def test_shapes(run, capsys):
    names = run("guide/shapes.md")
    assert names["bowl"].fold in (0, 2, 4) and len(names["rack"].peg_frames) >= 1
    assert names["container"].parameters.style in capsys.readouterr().out


def test_clearance(run):
    names = run("guide/clearance.md")
    before = tdf.clearance(names["path"], names["held"], names["obstacles"]).min
    assert before < 0 and names["cleared"].clear
    after = tdf.clearance(names["cleared"].trajectory, names["held"], names["obstacles"]).min
    assert after >= 0.01 - 1e-3


def test_demonstrations(run, tmp_path):
    """What the command line and Python make of a recording is the same demonstration."""
    save_recording(tmp_path)
    names = run("guide/demonstrations.md")
    written = tdf.load_demonstration("demo.npz")
    assert (written.grasp, written.release % 100) == (12, names["demo"].release % 100)
    (line, _) = blocks(DOCS / "guide/demonstrations.md", "sh")[0].splitlines()
    main(shlex.split(line)[1:])
    again = tdf.load_demonstration("demo.npz")
    np.testing.assert_allclose(again.trajectory.wxyz_xyz, written.trajectory.wxyz_xyz, atol=1e-6)
    assert np.ptp(again.query, axis=0).max() <= 0.06


def save_recording(folder):
    """A cloud, and the 100 poses of a gripper about it, in files."""
    cloud = random_cloud(0)
    np.savetxt(folder / "cloud.xyz", cloud)
    header = f"ply\nformat ascii 1.0\nelement vertex {len(cloud)}\n"
    header += "".join(f"property float {axis}\n" for axis in "xyz") + "end_header\n"
    (folder / "cloud.ply").write_text(header + (folder / "cloud.xyz").read_text())
    start = cloud.mean(axis=0)
    tdf.save_trajectory(folder / "path.tum", tdf.line(100, start, start + [0, 0.3, 0.1]))


def test_gradients(run, assumed):
    names = run("guide/gradients.md", assumed)
    assert names["slope"].wxyz_xyz.shape == assumed["demo"].trajectory.wxyz_xyz.shape
    assert np.abs(names["slope"].wxyz_xyz).max() > 0
    first = names["loss"](
        tdf.imitate(assumed["model"], assumed["demo"], assumed["new"], key=jax.random.key(0)).trajectory
    )
    assert names["value"] < first
    assert names["pull"].shape == assumed["new"].shape and np.abs(names["pull"]).max() > 0


def test_devices_and_batches(run, assumed, monkeypatch):
    joined = []
    monkeypatch.setattr(jax.distributed, "initialize", lambda *where, **which: joined.append((where, which)))
    monkeypatch.setattr(sys, "argv", ["imitate.py", "1"])
    clouds = jnp.asarray(np.stack([random_cloud(seed) for seed in (3, 4)]), jnp.float32)
    reference = tdf.describe(assumed["model"], assumed["demo"])
    names = run("guide/scaling.md", assumed | {"sys": sys, "clouds": clouds, "reference": reference})
    assert names["result"].initial_trajectories.shape[0] == 512
    assert joined == [(("first-machine:7777",), {"num_processes": 2, "process_id": 1})]
    assert names["losses"].shape == (2,) and names["trajectories"].wxyz_xyz.shape[0] == 2


def test_targets(run, small_model, demonstration):
    released = carried(np.asarray(demonstration.object_motion), demonstration.points)
    meeting = released.mean(axis=0)
    names = {
        "jax": jax,
        "tdf": tdf,
        "bowl_model": small_model,
        "mug_model": small_model,
        "bowl_cloud": demonstration.points,
        "path": demonstration.trajectory,
        "grip": demonstration.query,
        "mug_cloud": random_cloud(5) - random_cloud(5).mean(axis=0) + meeting + [0.05, 0.05, 0],
        "contact": tdf.box_query(jax.random.key(3), 8, size=0.05),
        "pose": np.concatenate([[1.0, 0, 0, 0], meeting]),
        "new_bowl": random_cloud(3),
        "new_mug": random_cloud(6) + [0.2, 0.1, 0],
    }
    result = run("guide/targets.md", names)["result"]
    assert result.object_motion.shape == (7,) and result.goal.shape == (7,)
    assert result.target_trajectories.shape[1:] == (1, 7)
