import dataclasses
import io
import json
import pickle
import re
import sys
import typing
import zipfile

import jax
import numpy as np
import pytest
from conftest import POSES, QUERIES, STARTS

import tdf_jax as tdf
from tdf_jax.cli import imitation_record as report, main as command_line, scenes
from tdf_jax.cli.main import main
from tdf_jax.cli.options import Settings
from tdf_jax.evaluation.cases import PLACE, generated_case
from tdf_jax.evaluation.metrics import pose_error
from tdf_jax.geometry.paths import PATHS
from tdf_jax.io.demonstrations import save_demonstration
from tdf_jax.networks.checkpoint import load_model, save_model
from tdf_jax.shapes import build_mug

QUICK = ("--method", "adam", "--num-starts", STARTS, "--iterations", 3, "--points", 60)
TINY = (*QUICK, "--num-poses", POSES, "--queries", QUERIES)
FILES = {"result.json", "scene.npz", "trajectory.npz", "trajectory.tum", "imitation.png", "loss.png"}


def run(*words):
    main([str(word) for word in words])


@pytest.fixture(scope="module")
def folder(weights, tmp_path_factory):
    """A run with every default but the sizes."""
    out = tmp_path_factory.mktemp("run") / "out"
    run("imitate", "--weights", weights, "--out", out, *TINY)
    return out


@pytest.fixture
def imitate(weights, tmp_path):
    """A quick run into tmp_path/out; gives its record."""

    def go(*words):
        run("imitate", "--weights", weights, "--out", tmp_path / "out", "--no-plots", *words)
        return json.loads((tmp_path / "out" / "result.json").read_text())

    return go


@pytest.fixture
def watched(monkeypatch):
    """The library's results behind the command, in order."""
    results = []

    def watching(*arguments, **options):
        results.append(tdf.imitate(*arguments, **options))
        return results[-1]

    monkeypatch.setattr("tdf_jax.cli.imitate.imitate_scene", watching)
    return results


@pytest.fixture
def refusal(tmp_path, capsys, monkeypatch):
    """The message that a command is refused with; nothing may be written in tmp_path or the current folder."""
    here = tmp_path / "here"
    here.mkdir()
    monkeypatch.chdir(here)

    def go(*words):
        before = {path: path.read_bytes() if path.is_file() else None for path in tmp_path.rglob("*")}
        with pytest.raises(SystemExit) as stop:
            run(*words)
        assert stop.value.code == 2
        assert {path: path.read_bytes() if path.is_file() else None for path in tmp_path.rglob("*")} == before
        out, error = capsys.readouterr()
        assert out == "" and "Traceback" not in error
        return error

    return go


def record_of(folder):
    return json.loads((folder / "result.json").read_text())


# What a run writes


def test_the_default_method_carries(imitate, watched, capsys):
    record = imitate("--points", 60, "--num-poses", 4, "--queries", 8, "--num-starts", 6)
    assert record["settings"]["method"] == "carry" and record["energy"] is None
    assert record["optimiser"] == dataclasses.asdict(tdf.CarryConfig(num_starts=6))
    np.testing.assert_array_equal(np.float32(record["energies"]), watched[0].energies)
    assert record["confidence"] is None  # not calibrated for these weights
    modes = tdf.cluster_poses(watched[0].trajectories[:, 0], watched[0].energies)
    assert [mode["energy"] for mode in record["modes"]] == [mode.energy for mode in modes]
    out = capsys.readouterr().out
    assert (
        "6 starts of the pick, 4 poses, 8 queries" in out
        and "(of the best pick)" in out
        and f"{len(modes)} distinct pick" in out
    )


@pytest.mark.slow
def test_the_papers_energy_can_be_solved(imitate, watched, capsys):
    record = imitate(
        "--points", 60, "--num-poses", 4, "--queries", 8, "--num-starts", 2, "--method", "gauss-newton", "--k", 0.1
    )
    assert record["optimiser"] == dataclasses.asdict(tdf.SolveConfig(num_trajectory_starts=2))
    assert record["energy"] == dataclasses.asdict(tdf.EnergyWeights(0.1)) and record["modes"] is None
    np.testing.assert_array_equal(np.float32(record["energies"]), watched[0].energies)
    out = capsys.readouterr().out
    assert "2 starts, 64 of the keyframe, 4 poses, 8 queries" in out and "the best candidate of every waypoint" in out


def test_a_run_writes_every_file_and_nothing_beside_them(folder):
    assert {path.name for path in folder.iterdir()} == FILES
    assert [path.name for path in folder.parent.iterdir()] == ["out"]
    for name in ("imitation.png", "loss.png"):
        assert (folder / name).read_bytes().startswith(b"\x89PNG")


def test_the_record_tells_all_settings(folder, weights):
    record = record_of(folder)
    assert (record["schema"], record["tdf_jax"], record["seed"]) == (report.SCHEMA, tdf.__version__, 0)
    assert record["settings"] == {
        "target": None, "targets": None, "scale": 1.0, "drop_invalid": False, "task": None, "target_object": None,
        "target_weights": None,
        "target_pose": "random", "demonstration": None, "category": "mug",
        "trajectory": "wave",
        "goal_offset": [0.0, 0.0, 0.0], "k": None, "method": "adam", "num_starts": 3, "num_poses": 4, "queries": 8,
        "iterations": 3, "points": 60,
        "seed": 0, "weights": str(weights), "out": str(folder), "no_plots": False, "page": False, "json": False,
        "animation": None,
        "depth": None, "intrinsics": None, "camera_pose": None, "mask": None, "workspace": None, "depth_scale": None,
        "clusters": False, "clean": True,
    }  # fmt: skip
    assert record["foreign_points"] == {"object": 0, "target": 0}
    assert record["energy"] == dataclasses.asdict(tdf.EnergyWeights(0.02))
    assert record["optimiser"] == dataclasses.asdict(tdf.OptimizeConfig(num_starts=3, iterations=3))
    assert record["weights"]["name"] == "small"
    assert record["status"] == "all 3 starts finite"
    seconds = record["seconds"]
    assert list(seconds) == ["load", "encode", "optimise", "plots", "total"]
    assert 0 < sum(value for name, value in seconds.items() if name != "total") <= seconds["total"] * 1.001


def test_the_record_keeps_every_start_and_the_best_is_the_least(folder):
    record = record_of(folder)
    losses, energies = np.array(record["losses"]), np.array(record["energies"])
    assert losses.shape == (3, 3) and energies.shape == (3,)
    assert record["best"] == np.argmin(energies)
    assert record["loss"] == {"start": losses[record["best"], 0], "end": energies.min()}


def test_the_truth_is_the_handle_and_the_goal(folder):
    record = record_of(folder)
    found = tdf.load_trajectory(folder / "trajectory.npz")
    expected = np.array(record["expected"], np.float32)
    pair = generated_case("mug", 0, 0, points=60)
    handle = tdf.Trajectory.from_matrices(np.stack([pair.T_world_place_b] * 2)).wxyz_xyz[0]
    metres, radians = pose_error(expected[0], handle)
    assert metres < 1e-5 and radians < 1e-3
    np.testing.assert_allclose(record["target"]["T_world_target"], pair.T_world_b)
    np.testing.assert_allclose(expected[-1], found.wxyz_xyz[-1], atol=1e-5)
    np.testing.assert_allclose(record["goal"], found.wxyz_xyz[-1], atol=1e-6)
    metres, radians = pose_error(found.wxyz_xyz[0], handle)
    errors = record["errors"]
    assert errors["pick_metres"] == pytest.approx(float(metres), abs=1e-5)
    assert errors["pick_radians"] == pytest.approx(float(radians), abs=1e-3)
    path = np.linalg.norm(expected[:, 4:] - found.translations, axis=1).mean()
    assert errors["path_metres"] == pytest.approx(path, abs=1e-5)


def test_the_goal_is_the_demonstrations_carried_by_the_centroids_and_offset(imitate, weights):
    plain = np.array(imitate(*TINY)["goal"])
    offset = np.array(imitate(*TINY, "--goal-offset", "-0.1", "0.2", "0.3")["goal"])
    np.testing.assert_allclose(offset - plain, [0, 0, 0, 0, -0.1, 0.2, 0.3], atol=1e-6)
    model, pair = tdf.load_model(weights), generated_case("mug", 0, 0, points=60)
    origins = [tdf.encode(model, tdf.thin(points, 40)).origin for points in (pair.points_a, pair.points_b)]
    place = pair.T_world_place_a[:3, 3] + PLACE - origins[0] + origins[1]
    np.testing.assert_allclose(plain, [1, 0, 0, 0, *place], atol=1e-5)


def test_both_trajectory_files_hold_the_best(folder):
    npz, tum = (tdf.load_trajectory(folder / f"trajectory.{kind}") for kind in ("npz", "tum"))
    np.testing.assert_array_equal(npz.wxyz_xyz, tum.wxyz_xyz.astype(np.float32))
    assert npz.num_poses == 4


def test_a_seed_gives_the_same_run_and_another_another(imitate, folder):
    first, again, other = record_of(folder), imitate(*TINY), imitate(*TINY, "--seed", 1)
    same = ("losses", "energies", "goal", "expected", "errors", "target")
    assert {name: first[name] for name in same} == {name: again[name] for name in same}
    assert all(first[name] != other[name] for name in same)


def test_no_start_is_drawn_from_the_key_of_the_targets_pose(imitate, watched):
    """With one key for both, a start's rotation would be the answer before any step."""
    expected = np.array(imitate(*TINY)["expected"])
    _, radians = pose_error(watched[0].initial_trajectories[:, 0], expected[0])
    assert (radians > 0.2).all()


# What it prints


def test_the_table(folder, weights, tmp_path, capsys):
    run("imitate", "--weights", weights, "--out", tmp_path / "out", "--no-plots", *TINY)
    out, error = capsys.readouterr()
    record = record_of(tmp_path / "out")
    rows = {line[:17].strip(): line[17:] for line in out.splitlines()}
    assert list(rows) == [
        "run", "loss, start", "loss, end", "pick-pose error", "path error", "time", "written to"
    ]  # fmt: skip
    assert rows["loss, start"] == f"{record['loss']['start']:.5f}"
    assert rows["loss, end"].startswith(f"{record['loss']['end']:.5f} (start {record['best'] + 1} of 3")
    degrees = np.degrees(record["errors"]["pick_radians"])
    assert rows["pick-pose error"] == f"{100 * record['errors']['pick_metres']:.2f} cm, {degrees:.1f} degrees"
    assert rows["path error"].startswith(f"{100 * record['errors']['path_metres']:.2f} cm")
    assert rows["written to"] == str(tmp_path / "out")
    assert "3/3" in error  # the progress bar


def test_json_is_the_record_alone(weights, tmp_path, capsys):
    run("imitate", "--weights", weights, "--out", tmp_path / "out", "--no-plots", "--json", *TINY)
    assert json.loads(capsys.readouterr().out) == record_of(tmp_path / "out")
    assert {path.name for path in (tmp_path / "out").iterdir()} == FILES - {"imitation.png", "loss.png"}


@pytest.mark.parametrize("command", [(), ("imitate",), ("convert",), ("evaluate",), ("dataset",), ("train",)])
def test_help(capsys, command):
    with pytest.raises(SystemExit) as stop:
        run(*command, "--help")
    assert stop.value.code == 0
    assert "usage: tdf" in capsys.readouterr().out


# Targets and demonstrations


def mesh_file(path, suffix):
    build_mug().mesh.export(path := path / f"mug.{suffix}")
    return path


@pytest.mark.parametrize("kind", ["obj", "npy"])
def test_an_own_target_has_no_truth(imitate, tmp_path, capsys, kind):
    if kind == "obj":
        path = mesh_file(tmp_path, "obj")
    else:
        np.save(path := tmp_path / "mug.npy", build_mug().mesh.vertices)
    record = imitate("--target", path, *TINY)
    assert record["errors"] is None and record["expected"] is None
    assert record["settings"]["target_pose"] == "given"
    assert record["target"] == {"points": 60, "T_world_target": np.eye(4).tolist()}
    assert capsys.readouterr().out.count("n/a") == 2


def test_scale_and_pose_of_an_own_target(tmp_path):
    np.save(tmp_path / "cloud.npy", cloud := np.random.default_rng(0).normal(size=(50, 3)).astype(np.float32))
    settings = Settings(
        target=tmp_path / "cloud.npy", category="mug", scale=0.1, target_pose="random", num_poses=3, queries=4
    )
    made = scenes.make_scene(dataclasses.replace(settings, trajectory="line"), jax.random.key(0))
    T = made.T_world_target
    np.testing.assert_allclose(made.points, 0.1 * cloud @ T[:3, :3].T + T[:3, 3], atol=1e-6)
    assert np.linalg.norm(T - np.eye(4)) > 0.1
    assert made.meshes[1] is None and made.T_world_places is None


def test_a_drawn_mesh_lies_where_its_points_do(tmp_path):
    path = mesh_file(tmp_path, "stl")
    settings = Settings(target=path, category="mug", target_pose="random", trajectory="line", num_poses=2, queries=4)
    for one in (settings, dataclasses.replace(settings, target=None)):
        made = scenes.make_scene(one, jax.random.key(0))
        for points, mesh in zip((made.demonstration.points, made.points), made.meshes):
            assert (points >= mesh.bounds[0] - 1e-6).all() and (points <= mesh.bounds[1] + 1e-6).all()


def test_every_path_can_be_named():
    annotation = typing.get_type_hints(Settings)["trajectory"]
    (choices,) = (typing.get_args(one) for one in typing.get_args(annotation) if one is not type(None))
    assert choices == tuple(PATHS)


@pytest.mark.parametrize("shape", PATHS)
def test_generated_demonstrations_go_from_the_handle_to_the_place(shape):
    settings = Settings(category="mug", trajectory=shape, num_poses=5, queries=7, target_pose="given")
    made = scenes.make_scene(settings, jax.random.key(0))
    shown, (handle_a, handle_b) = made.demonstration, made.T_world_places
    ends = shown.trajectory.matrices
    np.testing.assert_allclose(ends[0], handle_a, atol=1e-6)
    np.testing.assert_allclose(ends[-1, :3, 3] - handle_a[:3, 3], PLACE, atol=1e-6)
    assert shown.query.shape == (7, 3) and np.abs(shown.query).max() <= 0.04
    np.testing.assert_allclose(handle_b[:3, :3], np.eye(3), atol=1e-6)  # the target in its canonical pose
    assert np.ptp(made.points[:, 2]) == pytest.approx(0.12, abs=0.002)


@pytest.mark.parametrize(("poses", "words"), [(4, ()), pytest.param(6, ("--num-poses", 4), marks=pytest.mark.slow)])
def test_an_own_demonstration(imitate, tmp_path, poses, words):
    points = np.random.default_rng(0).normal(size=(70, 3)).astype(np.float32)
    demonstration = tdf.Demonstration(points, tdf.line(num_poses=poses), tdf.box_query(jax.random.key(0), 8))
    save_demonstration(tmp_path / "demo.npz", demonstration)
    record = imitate("--demonstration", tmp_path / "demo.npz", *QUICK, *words)
    assert record["demonstration"] == {"points": 70, "poses": 4, "grasp": 0, "release": -1, "queries": 8}
    assert record["errors"] is None
    goal = demonstration.trajectory.wxyz_xyz[-1, 4:] - points.mean(axis=0)
    assert np.linalg.norm(goal - np.array(record["goal"])[4:]) < 1  # carried from one centroid to the other


def test_an_earlier_result_is_replaced(imitate, tmp_path):
    imitate(*TINY)
    (tmp_path / "out" / "loss.png").write_bytes(b"old")
    imitate(*TINY)
    assert {path.name for path in (tmp_path / "out").iterdir()} == FILES - {"imitation.png", "loss.png"}


def test_a_picture_that_fails_leaves_the_results(weights, tmp_path, monkeypatch, capsys):
    def broken(*_, **__):
        raise ValueError("no pictures today\nat all")

    monkeypatch.setattr("tdf_jax.viz.imitation.imitation_figure", broken)
    with pytest.raises(SystemExit) as stop:
        run("imitate", "--weights", weights, "--out", tmp_path / "out", *TINY)
    assert stop.value.code == 1
    assert {path.name for path in (tmp_path / "out").iterdir()} == FILES - {"imitation.png"}
    assert record_of(tmp_path / "out")["best"] in range(STARTS)
    out, error = capsys.readouterr()
    assert "written to" in out and error.splitlines()[-1] == (
        "tdf: error: tdf imitate: imitation.png is missing (ValueError: no pictures today). All other results are "
        "complete"
    )


# Bad input


def cloud(rows):
    return np.random.default_rng(0).normal(size=(rows, 3))


BAD_CLOUDS = {
    "tiny": (cloud(20), "20 points; expected at least 21"),
    "empty": (cloud(0), "0 points"),
    "nan": (np.where(np.arange(90).reshape(30, 3) == 4, np.nan, cloud(30)), "1 of the 30 points.* NaN"),
    "infinite": (np.where(np.arange(90).reshape(30, 3) == 4, np.inf, cloud(30)), "infinite"),
    "equal": (np.ones((30, 3)), "all equal"),
    "flat": (np.ones((30, 2)), r"shape \(30, 2\)"),
    "words": (np.array(["a"] * 30), "type"),
    "objects": (np.array([{}] * 30, dtype=object), "cannot be read|holds Python objects"),
}


def check(message, pattern):
    """The message in one line, as a terminal's frames break it otherwise."""
    assert re.search(pattern, " ".join(re.sub("[│╭╮╰╯─]", " ", message).split())), message


@pytest.mark.parametrize("name", BAD_CLOUDS)
@pytest.mark.parametrize("option", ["--target", "--demonstration"])
def test_bad_clouds(refusal, weights, tmp_path, name, option):
    points, message = BAD_CLOUDS[name]
    if option == "--target":
        np.save(path := tmp_path / "cloud.npy", points)
    else:
        rest = {"wxyz_xyz": np.asarray(tdf.line(num_poses=3).wxyz_xyz), "query": np.zeros((4, 3))}
        np.savez(path := tmp_path / "demo.npz", points=points, **rest)
    check(refusal("imitate", "--weights", weights, option, path), f"^tdf: error: .*{message}")


BAD_FILES = {
    "missing.obj": (None, "there is no file .*missing.obj"),
    "mug.obj": (b"v 0 0 0\nv 1 0 0\nv 0 1 0\n", "3 points; expected at least 21"),
    "empty.stl": (b"", "it is empty, 0 bytes"),
    "broken.npy": (b"\x93NUMPY\x01", "cannot be read as .npy"),
    "broken.ply": (b"ply\nformat", "cannot be read as .ply"),
    "mug.dae": (b"<COLLADA/>", "suffix '.dae'; expected one of"),
}


@pytest.mark.parametrize("name", BAD_FILES)
def test_bad_target_files(refusal, weights, tmp_path, name):
    content, message = BAD_FILES[name]
    if content is not None:
        (tmp_path / name).write_bytes(content)
    check(refusal("imitate", "--weights", weights, "--target", tmp_path / name), f"^tdf: error: .*{message}")


@pytest.mark.parametrize(("words", "message"), [
    (("--method", "adam", "--k", "-0.1"), "--k is -0.1; expected one finite number of 0 or more"),
    (("--method", "gauss-newton", "--k", "nan"), "--k is nan"),
    (("--k", "0.02"), "--k is a weight of eq. 3, which --method carry does not minimise"),
    (("--num-poses", "1"), "poses is 1; expected a whole number of at least 2"),
    (("--num-starts", "0"), "--num-starts is 0"),
    (("--method", "adam", "--iterations", "0"), "iterations is 0"),
    (("--iterations", "50"), "--iterations is for --method adam"),
    (("--queries", "0"), "count is 0"),
    (("--points", "20"), "20 points"),
    (("--seed", "-1"), "--seed is -1"),
    (("--seed", str(2**32)), "--seed is 4294967296"),
    (("--goal-offset", "0", "nan", "0"), "--goal-offset"),
    (("--scale", "2"), "--scale is for a --target file"),
    (("--demonstration", "missing.npz"), "there is no file missing.npz"),
    (("--demonstration", "a.npz", "--queries", "5"), "--queries is for a generated"),
    (("--demonstration", "a.npz", "--trajectory", "line"), "--trajectory is for a generated"),
])  # fmt: skip
def test_bad_settings(refusal, weights, words, message):
    check(refusal("imitate", "--weights", weights, *words), f"^tdf: error: .*{message}")


def test_a_target_scale_of_zero(refusal, weights, tmp_path):
    np.save(tmp_path / "cloud.npy", cloud(30))
    words = ("--target", tmp_path / "cloud.npy", "--scale", 0)
    check(refusal("imitate", "--weights", weights, *words), "^tdf: error: .*scale is 0")


@pytest.mark.parametrize(("words", "exists"), [
    (("imitate", "--trajectory", "circle"), "'semicircle'"),
    (("imitate", "--target-pose", "upright"), "'given'"),
    (("imitate", "--weight", "mug"), "--weights"),
    (("imitate", "--num-starts", "few"), "INT"),
    (("imitate", "extra"), "extra"),
    (("imitation",), "imitate"),
    ((), "imitate"),
    (("convert", "one.pth"), "OUT.safetensors"),
])  # fmt: skip
def test_unknown_words_name_what_exists(refusal, words, exists):
    check(refusal(*words), exists)


def test_unknown_weights_name_what_exists(refusal):
    check(refusal("imitate", "--weights", "teapot"), r"there are no weights 'teapot'; expected one of \(")


def tampered(weights, change):
    content = bytearray(weights.read_bytes())
    change(content)
    return bytes(content)


def other_sizes(weights):
    """The header of another network over these tensors."""
    content = weights.read_bytes()
    assert content.count(b'latent\\": 4') == 1
    return content.replace(b'latent\\": 4', b'latent\\": 5')


BAD_WEIGHTS = {
    "truncated": (lambda weights: weights.read_bytes()[:-10], "truncated"),
    "tampered": (lambda weights: tampered(weights, lambda c: c.__setitem__(-1, c[-1] ^ 1)), "checksum"),
    "foreign": (lambda weights: b"not weights", "not a valid safetensors file"),
    "empty": (lambda weights: b"", "not a valid safetensors file"),
    "another architecture": (other_sizes, r"expected \("),
}


@pytest.mark.parametrize("name", BAD_WEIGHTS)
def test_bad_weights(refusal, weights, tmp_path, name):
    make, message = BAD_WEIGHTS[name]
    (tmp_path / "bad.safetensors").write_bytes(make(weights))
    check(refusal("imitate", "--weights", tmp_path / "bad.safetensors"), f"^tdf: error: load_model.*{message}")


@pytest.mark.parametrize("place", ["missing/out", "file", "file/out", "full", "."])
def test_unwritable_output_is_refused_before_any_work(refusal, monkeypatch, tmp_path, place):
    (tmp_path / "here" / "file").write_bytes(b"")
    (tmp_path / "here" / "full").mkdir()
    (tmp_path / "here" / "full" / "notes.txt").write_bytes(b"mine")
    monkeypatch.setattr("tdf_jax.cli.imitate.load_model", lambda name: pytest.fail("the work has begun"))
    check(refusal("imitate", "--out", place), "^tdf: error: tdf imitate: .*expected")


class Evil:
    def __reduce__(self):
        return (print, ("evil code runs",))


def checkpoint(content, **members):
    archive = io.BytesIO()
    with zipfile.ZipFile(archive, "w") as file:
        for name, member in {"data.pkl": content, "version": b"3\n", **members}.items():
            file.writestr(f"archive/{name}", member)
    return archive.getvalue()


BAD_CHECKPOINTS = {
    "missing": (None, "no such file"),
    "code": (checkpoint(pickle.dumps({"weight": Evil()})), "print"),
    "other": (checkpoint(pickle.dumps({"weight": 1})), "state_dict"),
    "truncated": (checkpoint(pickle.dumps({}))[:60], "truncated or damaged"),
    "old": (pickle.dumps({}), "old format"),
    "text": (b"hello", "not a PyTorch checkpoint"),
}


@pytest.mark.parametrize("name", BAD_CHECKPOINTS)
def test_bad_checkpoints(refusal, tmp_path, name):
    content, message = BAD_CHECKPOINTS[name]
    if content is not None:
        (tmp_path / "in.pth").write_bytes(content)
    error = refusal("convert", tmp_path / "in.pth", tmp_path / "out.safetensors")
    check(error, f"^tdf: error: .*{message}")
    assert "evil code runs" not in error


def test_train_refuses_unwritable_places_before_training(refusal, tmp_path, monkeypatch):
    monkeypatch.setattr("tdf_jax.cli.train.run", lambda *_: pytest.fail("the work has begun"))
    (tmp_path / "file").write_bytes(b"")
    check(refusal("train", "--out", tmp_path / "file" / "run"), "^tdf: error: tdf train: cannot make")
    (tmp_path / "run").mkdir()
    for place in (tmp_path / "mug.npz", tmp_path / "missing" / "mug.safetensors"):
        check(refusal("train", "--out", tmp_path / "run", "--weights", place), "^tdf: error: tdf train: --weights is")


def test_train_refuses_bad_numbers_before_training(refusal, tmp_path, monkeypatch):
    monkeypatch.setattr("tdf_jax.cli.train.run", lambda *_: pytest.fail("the work has begun"))
    check(
        refusal("train", "--out", tmp_path / "run", "--workers", -1),
        "^tdf: error: tdf train: --workers is -1; expected 1 or more, or 0",
    )
    check(
        refusal("train", "--out", tmp_path / "run", "--network.symmetry-breaking-offset", 1),
        "symmetry_breaking_offset is 1.0; expected one finite number of 0 or more, less than 1",
    )


@pytest.mark.parametrize(
    ("given", "asked", "trained"), [(0.0, None, 0.0), (0.2, None, 0.2), (0.0, 0.1, 0.1), (0.2, 0.1, 0.1)]
)
def test_a_run_keeps_the_offset_of_its_start_weights_unless_another_is_given(
    given, asked, trained, weights, tmp_path, monkeypatch, capsys
):
    model = load_model(weights)
    start = tmp_path / "start.safetensors"
    save_model(
        dataclasses.replace(model, config=dataclasses.replace(model.config, symmetry_breaking_offset=given)), start
    )
    runs = []

    def trained_as(config, *_, initial, workers):
        runs.append((config.network, workers))
        return initial

    monkeypatch.setattr("tdf_jax.cli.train.run", trained_as)
    monkeypatch.setattr("tdf_jax.cli.train.load", lambda _: (None, None))
    monkeypatch.setattr("tdf_jax.cli.train.joined", lambda sets: sets[0])
    monkeypatch.setattr("tdf_jax.viz.training.training_figure", lambda _: None)
    monkeypatch.setattr("tdf_jax.viz.style.save_figure", lambda *_: None)
    sizes = {
        name: getattr(model.config, name)
        for name in ("latent", "vector_hidden", "vector_width", "decoder_width", "blocks")
    }
    options = [word for name, size in sizes.items() for word in (f"--network.{name.replace('_', '-')}", size)]
    options += [] if asked is None else ["--network.symmetry-breaking-offset", asked]
    run("train", "--out", tmp_path / "run", "--data", tmp_path, "--start-from", start, *options, "--workers", 3)
    expected = dataclasses.replace(model.config, symmetry_breaking_offset=trained)
    assert runs == [(expected, 3)]
    assert load_model(tmp_path / "run" / "weights.safetensors").config == expected


# Evaluation


@pytest.fixture(scope="module")
def real(tmp_path_factory):
    """A folder of one annotated mesh, in centimetres."""
    folder = tmp_path_factory.mktemp("real")
    build_mug().mesh.copy().apply_scale(100).export(folder / "cup.obj")
    (folder / "meshes.json").write_text(json.dumps({"cup.obj": {"unit": 0.01, "up": "+z", "handle": "+x"}}))
    return folder


EVALUATE = ("--pairs", 2, "--num-starts", 2, "--iterations", 2, "--seed", 3)


@pytest.fixture(scope="module")
def evaluation(weights, real, tmp_path_factory):
    """The record of a run with all options but pictures, and its model card."""
    folder = tmp_path_factory.mktemp("evaluation")
    words = ("--meshes", real, "--num-poses", 2, "--clouds", "full", "half", "--baselines")
    run(
        "evaluate",
        "--weights",
        weights,
        *EVALUATE,
        *words,
        "--json",
        folder / "scores.json",
        "--card",
        folder / "small.md",
    )
    assert {file.name for file in folder.iterdir()} == {"scores.json", "small.md"}
    return json.loads((folder / "scores.json").read_text()), (folder / "small.md").read_text()


def test_an_evaluation_has_a_row_for_every_method_condition_and_set(evaluation, real):
    methods, conditions = ("small", "random weights", "PCA", "ICP"), ("full", "half")
    expected = [
        (objects, cloud, method)
        for objects in ("generated mugs", "real mugs")
        for cloud in conditions
        for method in methods
    ]
    evaluation, _ = evaluation
    rows = evaluation["rows"]
    assert [(row["set"], row["clouds"], row["method"]) for row in rows] == expected
    for row in rows:
        generated = row["set"] == "generated mugs"
        assert row["cases"] == len(row["errors"]) == 2 and row["objects"] == (2 if generated else 1)
        assert [error["object"] for error in row["errors"]] == (["mug 0", "mug 1"] if generated else ["cup", "cup"])
        assert (row["iou"] is None) == (row["iou_refined"] is None) == (row["method"] != "small")
        assert row["position_median_cm"] == pytest.approx(np.median([error["position_cm"] for error in row["errors"]]))
        assert (row["interval_1cm_10deg"] is None) != generated
    assert evaluation["settings"]["meshes"] == real.name and evaluation["settings"]["seed"] == 3
    assert evaluation["weights"] == {"name": "small", "source": "a test"}


def test_a_plain_evaluation_gives_the_same_numbers_and_a_table(evaluation, weights, capsys, tmp_path):
    run("evaluate", "--weights", weights, *EVALUATE, "--json", tmp_path / "scores.json")
    (row,) = json.loads((tmp_path / "scores.json").read_text())["rows"]
    assert row == evaluation[0]["rows"][0]
    out, _ = capsys.readouterr()
    title, heads, units, line = out.splitlines()
    assert title == "generated mugs: 2 objects, 2 transfers of the handle; best of 2 starts by loss"
    cells = re.split(r"  +", line)
    assert cells[:4] == ["small", "full", f"{row['iou']:.3f}", f"{row['iou_refined']:.3f}"] and cells[-4] == str(
        row["flips"]
    )
    low, high = row["interval_2cm_20deg"]
    assert cells[-1] == f"{100 * row['success_2cm_20deg']:.0f} % ({100 * low:.0f} to {100 * high:.0f})"
    ends = {name: heads.index(name) + len(name) for name in ("IoU", "rotation, deg", "flips", "2 cm, 20 deg")}
    assert (
        ends["2 cm, 20 deg"] == len(line)
        and line[: ends["IoU"]].endswith(cells[2])
        and line[: ends["flips"]].endswith(cells[-4])
    )


def test_a_model_card_tells_what_the_record_does(evaluation):
    record, card = evaluation
    lines = card.splitlines()
    assert lines[0] == "# small" and "| trained by | a test |" in lines
    assert "Generated mugs: 2 that no training run saw, 2 transfers of the handle." in lines
    assert (
        "`tdf evaluate --seed 3 --pairs 2 --num-starts 2 --iterations 2 --meshes DIR --num-poses 2 --category mug "
        "--clouds full half`" in card
    )
    rows = [[cell.strip() for cell in line.strip("|").split("|")] for line in lines if line.count("|") == 11]
    rows = [row for row in rows if row[0] not in ("cloud", "---")]
    assert len(rows) == len(record["rows"]) == 16
    for cells, row in zip(rows, record["rows"]):
        assert cells[1] == row["method"] and cells[2] == ("n/a" if row["iou"] is None else f"{row['iou']:.3f}")
        assert cells[3] == ("n/a" if row["iou_refined"] is None else f"{row['iou_refined']:.3f}")
        assert cells[4] == f"{row['position_median_cm']:.2f} / {row['position_p90_cm']:.2f} cm"
        assert cells[-1].startswith(f"{100 * row['success_2cm_20deg']:.0f} %")


@pytest.mark.slow
def test_pictures_of_an_evaluation(weights, real, tmp_path, monkeypatch):
    drawn, triangle = [], np.array([[[0, 0, 0], [0.05, 0, 0], [0, 0.05, 0.01]]])
    monkeypatch.setattr(
        "tdf_jax.networks.surface.surface_triangles", lambda field, T, bounds: drawn.append(bounds) or triangle
    )
    monkeypatch.setattr("tdf_jax.cli.evaluate.MOST_GENERATED", 1)
    run(
        "evaluate",
        "--weights",
        weights,
        *EVALUATE,
        "--meshes",
        real,
        "--num-poses",
        2,
        "--figures",
        tmp_path / "pictures",
    )
    assert {path.name for path in (tmp_path / "pictures").iterdir()} == {"reconstructions.png", "transfers.png"}
    assert (tmp_path / "pictures" / "transfers.png").read_bytes().startswith(b"\x89PNG")
    assert len(drawn) == 2  # one generated mug, and the real one in one of its poses
    np.testing.assert_allclose(drawn[1], build_mug().mesh.bounds, atol=1e-4)


@pytest.mark.slow
def test_an_evaluation_of_depth_images_says_how_many_places_are_seen(weights, capsys, tmp_path):
    words = ("--clouds", "camera1", "--clutter", "none", "outliers", "--stand", "tilt60", "--solver", "carry")
    files = ("--json", tmp_path / "scores.json", "--card", tmp_path / "small.md")
    run("evaluate", "--weights", weights, *EVALUATE, *words, "--no-reconstruct", *files)
    record = json.loads((tmp_path / "scores.json").read_text())
    settings = [(row["clouds"], row["clutter"], row["stand"]) for row in record["rows"]]
    assert settings == [("camera1", "none", "tilt60"), ("camera1", "outliers", "tilt60")]
    for row in record["rows"]:
        assert sum(part["cases"] for part in row["by_sight"].values()) == 2 and row["iou"] is None
        seen = [error["place_points"] >= 20 for error in row["errors"]]
        assert row["by_sight"].get("seen", {"cases": 0})["cases"] == sum(seen)
        assert all(error["confidence"] is None for error in row["errors"])  # of weights that are not calibrated
    assert min(error["foreign"] for error in record["rows"][1]["errors"]) > 50
    out, _ = capsys.readouterr()
    assert "picks of tdf.imitate" in out and "camera1, outliers, tilt60" in out and "confidence < 0.5" in out
    card = (tmp_path / "small.md").read_text()
    assert "--clutter none outliers --stand tilt60 --solver carry" in card
    assert "| one depth image, on a table; outliers; tilted within 60 degrees | small |" in card


def test_every_condition_can_be_asked_for():
    from tdf_jax.cli.evaluate import Cloud, Clutter
    from tdf_jax.evaluation.cases import CLOUDS
    from tdf_jax.evaluation.tabletop import CLUTTER

    assert typing.get_args(Cloud) == (*CLOUDS, "all")
    assert typing.get_args(Clutter) == (*CLUTTER, "all")


@pytest.mark.parametrize(("words", "message"), [
    (("--pairs", "0"), "--pairs is 0; expected at least 1, or 0 with --meshes"),
    (("--pairs", "-1", "--meshes", "."), "--pairs is -1"),
    (("--num-poses", "0"), "--num-poses is 0"),
    (("--seed", "-1"), "--seed is -1"),
    (("--size", "12"), "--size is 12.0; expected one finite number from 0.01 to 1, metres"),
    (("--place", "spout"), "--place is 'spout'; expected one of a mug's: handle, rim, base"),
    (("--num-starts", "0"), "num_starts is 0"),
    (("--clouds", "fog"), "views1"),
    (("--meshes", "none"), "load_annotated.*there is no folder none"),
    (("--meshes", "."), "load_annotated.*is empty"),
    (("--json", "none/scores.json"), "--json is none/scores.json; expected a file in an existing folder"),
    (("--json", "."), "--json is ."),
    (("--card", "none/mug.md"), "--card is none/mug.md; expected a file in an existing folder"),
    (("--figures", "none/pictures"), "--figures is none/pictures; expected a folder"),
])  # fmt: skip
def test_bad_evaluations_are_refused_before_any_work(refusal, monkeypatch, words, message):
    monkeypatch.setattr("tdf_jax.networks.checkpoint.load_model", lambda name: pytest.fail("the work has begun"))
    check(refusal("evaluate", *words), message)


# Endings that are no mistakes


@pytest.mark.parametrize(("error", "code", "message"), [
    (KeyboardInterrupt(), 130, "tdf: interrupted\n"),
    (MemoryError(), 2, "out of memory"),
    (jax.errors.JaxRuntimeError("RESOURCE_EXHAUSTED: Out of memory allocating 1 bytes."), 2, "out of memory"),
])  # fmt: skip
def test_other_ends_are_one_line(weights, tmp_path, monkeypatch, capsys, error, code, message):
    def fail(*_, **__):
        raise error

    monkeypatch.setattr("tdf_jax.cli.imitate.imitate_scene", fail)
    with pytest.raises(SystemExit) as stop:
        run("imitate", "--weights", weights, "--out", tmp_path / "out", *TINY)
    assert stop.value.code == code
    assert capsys.readouterr().err.splitlines(keepends=True)[-1].endswith(message) or message == "out of memory"
    assert not list(tmp_path.iterdir())


def test_a_bug_keeps_its_traceback(monkeypatch, tmp_path):
    monkeypatch.setattr("tdf_jax.cli.imitate.load_model", lambda _: {}["a bug"])
    with pytest.raises(KeyError):
        run("imitate", "--out", tmp_path / "out")
    assert not list(tmp_path.iterdir())


def test_a_message_says_that_every_start_is_non_finite(refusal, weights, monkeypatch):
    def broken(*arguments, **options):
        return dataclasses.replace(tdf.imitate(*arguments, **options), energies=np.full(3, np.nan))

    monkeypatch.setattr("tdf_jax.cli.imitate.imitate_scene", broken)
    check(refusal("imitate", "--weights", weights, *TINY), "^imitating.* 3 of 3 starts became non-finite: 0, 1, 2")


def test_commands_are_the_functions_of_their_modules():
    assert set(command_line.COMMANDS) == {
        "imitate",
        "demonstrate",
        "landscape",
        "view",
        "convert",
        "evaluate",
        "benchmark",
        "shapes",
        "dataset",
        "train",
        "reproduce",
        "simulate",
        "env",
    }
    for name in command_line.COMMANDS:
        assert callable(getattr(sys.modules[f"tdf_jax.cli.{name}"], name))


def test_a_film_inside_the_folder_of_results_is_refused(tmp_path, capsys):
    """The folder is replaced as a whole by the next run, and nothing else in it is the command's to replace."""
    out = tmp_path / "out"
    with pytest.raises(SystemExit) as stop:
        run("imitate", "--out", out, "--animation", out / "films" / "film.gif")
    error = capsys.readouterr().err
    assert stop.value.code == 2 and "expected a file beside it" in error and f"in --out {out}" in error
    assert not list(tmp_path.iterdir())


def test_the_table_says_how_much_worse_the_second_pick_is():
    assert report._solutions([{"energy": 0.002}]) == "1 distinct pick"
    words = report._solutions([{"energy": 0.002}, {"energy": 0.0025}, {"energy": 0.004}])
    assert words == "3 distinct picks; the second's loss is 0.00250, 25 % higher"
    assert report._solutions([{"energy": 0.0}, {"energy": 0.1}]) == "2 distinct picks; the second's loss is 0.10000"
