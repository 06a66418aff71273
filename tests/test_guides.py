"""The blocks of code in the guides run as printed, in their order, and do what the pages say.

README.md and docs/guide/camera.md have tests of their own (test_readme.py, perception/test_guide.py), and so has the
JSON of docs/guide/evaluation.md (evaluation/test_annotated_meshes.py). Lines of a shell that do not begin with `tdf`
are not run: they install from the package index, or need a program that is no part of this library.
"""

import ast
import builtins
import functools
import importlib
import json
import re
import shlex
import shutil
import symtable
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import trimesh
from conftest import CARRY, carried, random_cloud

import tdf_jax as tdf
from tdf_jax.cli.main import COMMANDS, main
from tdf_jax.geometry.views import visible

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

    yield run
    if "matplotlib.pyplot" in sys.modules:  # figures of a block must not reach other tests
        sys.modules["matplotlib.pyplot"].close("all")


@pytest.fixture
def assumed(small_model, demonstration):
    """The names of the README's example, with a small network."""
    return {"jax": jax, "tdf": tdf, "model": small_model, "demo": demonstration, "new": random_cloud(3).astype("f4")}


def test_every_page_with_python_is_run():
    with_python = {str(page.relative_to(ROOT)) for page in PAGES if blocks(page, "python")}
    here = {f"docs/{name}" for name in re.findall(r'run\("([\w/]+\.md)"', Path(__file__).read_text())}
    assert with_python == here | {"README.md", "docs/quickstart.md", "docs/guide/camera.md"}


def names(statement: ast.stmt) -> tuple[set[str], set[str]]:
    """Names that a statement at the top of a block reads from before it, and those that it defines."""
    top = symtable.symtable(ast.unparse(statement), "block", "exec")
    symbols, nested = top.get_symbols(), list(top.get_children())
    defined = {one.get_name() for one in symbols if one.is_assigned() or one.is_imported()}
    read = {one.get_name() for one in symbols if one.is_referenced()}
    if not isinstance(statement, ast.Assign):  # x = f(x) reads an earlier x; the variable of a loop is its own
        read -= defined
    for table in nested:
        read |= {one.get_name() for one in table.get_symbols() if one.is_global()}
        nested += table.get_children()
    return read - set(dir(builtins)), defined


@pytest.mark.parametrize("page", [page for page in PAGES if blocks(page, "python")], ids=lambda page: page.stem)
def test_pages_say_where_the_names_of_their_blocks_come_from(page):
    """A name is of the block, of an earlier one, which the page then says, or the words before it have the name."""
    known, before = set(), ""
    for prose, block in re.findall(r"(.*?)```python\n(.*?)```", page.read_text(), re.DOTALL):
        before += prose
        earlier = set(known)
        for statement in ast.parse(block).body:
            read, defined = names(statement)
            unsaid = {name for name in read - known if not re.search(rf"`{name}\b", before)}
            assert not unsaid, f"{page.name} does not say what these are: {sorted(unsaid)}"
            assert not read & earlier or "continue" in before, f"{page.name} does not say what {block[:60]!r} continues"
            known |= defined


def test_the_quick_start_is_the_readme():
    """Statement by statement, but for what is printed; test_readme.py runs them."""

    def statements(page):
        body = ast.parse("".join(blocks(page, "python"))).body
        return [ast.unparse(one) for one in body if not ast.unparse(one).startswith("print(")]

    assert statements(DOCS / "quickstart.md") == statements(ROOT / "README.md")


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
    """Every option and value is accepted; `RUN` has the lines that are run, and why the others are not."""
    seen = []
    for name in COMMANDS:
        module = importlib.import_module(f"tdf_jax.cli.{name}")
        command = functools.wraps(getattr(module, name))(lambda *_, name=name, **__: seen.append(name))
        monkeypatch.setattr(module, name, command)
    words = shlex.split(line)
    main(["--no-cache", *words[1:]])
    assert seen == [words[1]]


# Lines that the test below runs, by page, with the fewest starts, query points and sampled points. The other lines
# are understood only: each takes minutes with any settings (evaluate, benchmark, simulate, dataset, train,
# reproduce), waits for a user (view), needs a robot's file of another project (simulate --robot) or weights of such a
# run, or is one of these lines with another seed or file.
SMALL = ("--num-starts", "2", "--points", "200", "--no-plots")
RUN = {
    "installation": ("tdf imitate", "tdf env"),
    "quickstart": (
        "tdf imitate --target my_mug.obj --scale 0.01",
        "tdf imitate --category bowl --out bowl",
        "tdf imitate --task bowl_on_mug --out placed",
    ),
    "guide/camera": (
        "tdf imitate --depth docs/guide/camera/depth.png --depth-scale 0.001 "
        "--intrinsics docs/guide/camera/intrinsics.txt --camera-pose docs/guide/camera/T_world_camera.txt "
        "--workspace 0.2 -0.4 -0.05 0.8 0.4 0.5 --clusters",
    ),
    "guide/demonstrations": (
        "tdf demonstrate --points cloud.ply --trajectory path.tum --query-box 0.06 --grasp 12 --release 80 "
        "--out demo.npz",
        "tdf imitate --demonstration demo.npz --target new_mug.ply --out result",
    ),
    "guide/objects": ("tdf imitate --target my_scan.ply --drop-invalid --demonstration demo.npz --out result",),
    "guide/targets": (
        "tdf demonstrate --points bowl.ply --trajectory path.tum --query-box 0.06 --target-object mug.ply "
        "--out demo.npz",
        "tdf imitate --weights bowl --demonstration demo.npz --target new_bowl.ply --target-object new_mug.ply "
        "--target-weights mug",
        "tdf imitate --task bowl_on_mug --target known",
    ),
    "guide/viewer": ("tdf imitate --seed 500 --page --out imitation",),
}


@pytest.fixture
def recordings(tmp_path, monkeypatch):
    """An empty folder with the files that the guides name: clouds, a mesh in centimetres, a path from the rim."""
    monkeypatch.chdir(tmp_path)
    mugs = tdf.build_mug(), tdf.build_mug(tdf.MugParameters(height=0.09, handle_style="ring", handle_top=0.075))
    bowls = tdf.build_bowl(), tdf.build_bowl(tdf.sample_bowl(np.random.default_rng(4)))
    scaled = mugs[1].mesh.copy()
    scaled.apply_scale(100)
    scaled.export("my_mug.obj")
    clouds = {name: tdf.sample_surface(one.mesh, 400, 0) for name, one in zip(("mug", "new_mug"), mugs)}
    clouds |= {name: tdf.sample_surface(one.mesh, 400, 0) for name, one in zip(("bowl", "new_bowl"), bowls)}
    handle, rim = mugs[0].handle_frame[:3, 3], bowls[0].frames["rim"][:3, 3]
    # the bowl is put on the mug: its foot, the lowest points, comes to the rim
    above = mugs[0].mesh.bounds[1, 2] - bowls[0].mesh.bounds[0, 2]
    paths = {"handle": tdf.line(100, handle, handle + [0, 0.3, 0.1]), "rim": tdf.line(100, rim, rim + [0, 0.3, above])}
    clouds["mug"] = clouds["mug"] + [0, 0.3, 0]
    clouds |= {"cloud": tdf.sample_surface(mugs[0].mesh, 400, 0)}
    clouds |= {"my_scan": np.concatenate([clouds["new_mug"], np.full((3, 3), np.nan)])}
    for name, cloud in clouds.items():
        save_cloud(tmp_path / f"{name}.ply", cloud)
    return paths


@pytest.mark.slow
@pytest.mark.parametrize("page", RUN)
def test_cheap_command_lines_run(page, recordings, tmp_path):
    lines = RUN[page]
    assert set(lines) <= {" ".join(line.split()) for path, line in COMMAND_LINES if path == DOCS / f"{page}.md"}
    tdf.save_trajectory("path.tum", recordings["rim" if page == "guide/targets" else "handle"])
    if page == "guide/camera":
        shutil.copytree(DOCS / "guide" / "camera", tmp_path / "docs" / "guide" / "camera")
    if page == "guide/objects":
        query = tdf.box_query(jax.random.key(1), 16, size=0.06)
        shown = tdf.load_points("cloud.ply")
        tdf.save_demonstration("demo.npz", tdf.Demonstration(shown, tdf.resample(recordings["handle"], 5), query))
    for line in lines:
        words = shlex.split(line)[1:]
        generated = words[0] == "imitate" and not {"--demonstration", "--task"} & set(words)
        main([*words, *SMALL * (words[0] == "imitate"), *("--queries", "8") * generated])
        if words[0] == "imitate":
            out = words[words.index("--out") + 1] if "--out" in words else "imitation"
            assert np.isfinite(json.loads((tmp_path / out / "result.json").read_text())["loss"]["end"]), line
        if words[0] == "demonstrate":
            assert tdf.load_demonstration("demo.npz").grasp in (0, 12), line


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


def save_cloud(path, points):
    """A cloud as a text PLY; rows may be NaN."""
    with path.open("w") as file:
        file.write(f"ply\nformat ascii 1.0\nelement vertex {len(points)}\n")
        file.write("".join(f"property float {axis}\n" for axis in "xyz") + "end_header\n")
        np.savetxt(file, points)


def save_recording(folder):
    """A cloud, and the 100 poses of a gripper about it, in files."""
    cloud = random_cloud(0)
    save_cloud(folder / "cloud.ply", cloud)
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
    assert np.abs(names["change"][4:]).max() > 0  # the pick on a larger object
    assert names["found"].status


@pytest.mark.slow
def test_devices_and_batches(run, assumed, monkeypatch):
    joined = []
    monkeypatch.setattr(jax.distributed, "initialize", lambda *where, **which: joined.append((where, which)))
    monkeypatch.setattr(sys, "argv", ["imitate.py", "1"])
    clouds = jnp.asarray(np.stack([random_cloud(seed) for seed in (3, 4)]), jnp.float32)
    reference = tdf.describe(assumed["model"], assumed["demo"])
    names = run("guide/scaling.md", assumed | {"clouds": clouds, "reference": reference})
    assert names["result"].initial_trajectories.shape[0] == 512
    assert joined == [(("first-machine:7777",), {"num_processes": 2, "process_id": 1})]
    assert len(names["picks"]) == 2 and all(pick.shape == (7,) for pick in names["picks"])
    assert names["doubtful"] == []  # the confidence of a small network is not known
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


def test_an_object_that_moves(run, assumed, reference):
    result = tdf.carry(tdf.encode(assumed["model"], assumed["new"]), reference, jax.random.key(0), config=CARRY)
    moved = assumed["new"] + np.float32([0.1, 0.0, 0.05])
    names = run("guide/overview.md", assumed | {"moved": moved, "reference": reference, "result": result})
    np.testing.assert_allclose(names["field"].origin, moved.mean(axis=0), atol=1e-5)
    assert np.isfinite(names["result"].trajectory.wxyz_xyz).all()


def test_landscapes(run, assumed, monkeypatch):
    """On 11 points a side: 51 take ten seconds."""
    monkeypatch.setattr(tdf, "volume_grid", lambda half, count, origin: VOLUME(half, 11, origin))
    names = assumed | {"shown": random_cloud(0).astype("f4"), "handle": np.array([0.3, -0.2, 0.1])}
    names = run("guide/landscape.md", names)
    assert names["landscape"].values.shape == (7, 11, 11, 11)
    assert names["landscape"].combined.shape == (11, 11, 11) and names["landscape"].minimisers.shape == (7, 3)


VOLUME = tdf.volume_grid


def test_results_in_a_notebook(run, assumed, reference, tmp_path):
    result = tdf.carry(tdf.encode(assumed["model"], assumed["new"]), reference, jax.random.key(0), config=CARRY)
    box = trimesh.creation.box((0.1, 0.1, 0.1))
    (tmp_path / "imitation").mkdir()
    scene = tdf.ImitationScene(assumed["demo"], assumed["new"], result, meshes=(box, box))
    tdf.save_imitation(tmp_path / "imitation" / "scene.npz", scene)
    names = run("guide/viewer.md")
    assert len(names["modes"]) >= 1 and len(names["figure"].axes) >= 2


@pytest.mark.slow
def test_own_object(run, tmp_path):
    mug = tdf.build_mug(tdf.MugParameters(height=0.09, handle_style="ring", handle_top=0.075))
    mesh = mug.mesh.copy()
    mesh.apply_scale(100)
    mesh.export(tmp_path / "my_mug.obj")
    save_cloud(
        tmp_path / "my_scan.ply", np.concatenate([tdf.sample_surface(mug.mesh, 500, 0), np.full((3, 3), np.nan)])
    )
    shown = tdf.build_mug()
    handle = shown.handle_frame[:3, 3]
    path = tdf.lift_over(5, start=handle, end=handle + [0.0, 0.3, 0.1])
    query = tdf.box_query(jax.random.key(1), 128, size=0.06)
    tdf.save_demonstration(
        tmp_path / "demo.npz", tdf.Demonstration(tdf.sample_surface(shown.mesh, 1500, 1), path, query)
    )
    with pytest.warns(tdf.InvalidPointsWarning, match="removed 3 of 503 points"):
        names = run("guide/objects.md")
    assert len(names["scan"]) == 500
    assert abs(tdf.surface_logit(names["field"], names["points"])) < 1
    assert np.linalg.norm(names["result"].pick[4:] - mug.handle_frame[:3, 3]) < 0.02
    np.testing.assert_allclose(names["placed"].goal, names["goal"], atol=1e-5)
    again = tdf.load_trajectory("imitated.npz").wxyz_xyz
    np.testing.assert_allclose(again, names["result"].trajectory.wxyz_xyz, atol=1e-6)


@pytest.mark.slow
def test_uncertainty(run):
    """The second block needs a cloud whose handle is hidden, and a camera that sees it from where the result says."""
    mug = tdf.build_mug()
    handle = mug.handle_frame[:3, 3]
    path = tdf.wave(num_poses=7, start=handle, end=handle + [0.0, 0.3, 0.1])
    demo = tdf.Demonstration(
        tdf.sample_surface(mug.mesh, 1500, 0), path, tdf.box_query(jax.random.key(1), 128, size=0.06)
    )
    mesh, asked = tdf.build_mug(tdf.MugParameters(height=0.09)).mesh, []
    whole = tdf.sample_surface(mesh, 3000, 1)

    def seen_from(direction):
        direction = np.asarray(direction) / np.linalg.norm(direction)
        return whole[visible(mesh, whole, direction[None], np.random.default_rng(0))[0]]

    def take_cloud(from_direction):
        asked.append(np.asarray(from_direction))
        return seen_from(from_direction)

    names = {"jax": jax, "tdf": tdf, "model": tdf.load_model("mug"), "demo": demo, "take_cloud": take_cloud}
    with pytest.warns(tdf.CategoryWarning):  # no weights are sure of a mug of which one wall is seen
        names = run("guide/uncertainty.md", names | {"new": seen_from((-1.0, 0.0, 0.3))})
    assert len(asked) == 1 and asked[0][0] > 0.5  # the handle is along +x
    assert np.linalg.norm(names["result"].pick[4:] - handle) < 0.03
    assert names["found"].covariance.shape == (6, 6)


@pytest.mark.slow
def test_robot(run, robot, arm, tmp_path):
    trimesh.creation.box((0.3, 0.2, 0.08)).export(tmp_path / "shelf.obj")
    arm().rename(tmp_path / "my_arm.xml")
    names = run("guide/robot.md")
    velocities = np.diff(names["safe"].positions, axis=0) / np.diff(names["safe"].times)[:, None]
    assert 0.1 < np.abs(velocities).max() < 1.21  # the page's limit, and the noise of differences
    np.testing.assert_array_equal(names["again"].positions, names["motion"].positions)
    assert [part.stem for part in sorted(tmp_path.glob("*.yaml"))] == ["carry", "home", "to_pick"]
    np.testing.assert_allclose(names["points"][:, 2], 0.1, atol=1e-12)
