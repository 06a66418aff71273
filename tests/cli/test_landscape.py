"""`tdf landscape`: what it writes, that it goes on after an interruption, and what it refuses."""

import dataclasses
import json
import re
import shutil
import sys

import numpy as np
import pytest

import tdf_jax as tdf
from tdf_jax.cli import landscape as command
from tdf_jax.cli.main import main
from tdf_jax.io.demonstrations import save_demonstration
from tdf_jax.landscape import shared_lattice

QUICK = ("--points", 60, "--num-poses", 3, "--queries", 8, "--half", 0.1, "--pitch", 0.05)


def run(*words):
    main([str(word) for word in words])


@pytest.fixture
def sweep(weights, tmp_path):
    """A quick run into tmp_path/out; gives its record and landscape."""

    def go(*words):
        run("landscape", "--weights", weights, "--out", tmp_path / "out", "--no-plots", *QUICK, *words)
        record = json.loads((tmp_path / "out" / "result.json").read_text())
        return record, tdf.load_landscape(tmp_path / "out" / "landscape.npz")[0]

    return go


@pytest.mark.slow
@pytest.mark.parametrize(
    ("grid", "pictures"),
    [("yz", {"map.png"}), ("volume", {"isosurface.png", "slices.gif"}), ("path", {"isosurface.png", "slices.gif"})],
)
def test_a_run_writes_every_file_and_nothing_beside_them(weights, tmp_path, grid, pictures):
    run("landscape", "--weights", weights, "--out", tmp_path / "out", "--grid", grid, "--page", *QUICK)
    assert {path.name for path in (tmp_path / "out").iterdir()} == {
        "result.json",
        "landscape.npz",
        "landscape.html",
    } | pictures
    assert [path.name for path in tmp_path.iterdir()] == ["out"]
    found, about = tdf.load_landscape(tmp_path / "out" / "landscape.npz")
    assert found.values.shape[1:] == found.grid.shape
    assert about["settings"]["grid"] == grid
    assert np.isnan(found.values).any() == (grid == "path")


@pytest.mark.parametrize("grid", ["yz", pytest.param("volume", marks=pytest.mark.slow)])
def test_pictures_that_fail_leave_the_results(weights, tmp_path, monkeypatch, capsys, grid):
    def broken(*_, **__):
        raise ValueError("no pictures today")

    pictures = {"yz": {"map.png"}, "volume": {"isosurface.png", "slices.gif"}}[grid] | {"landscape.html"}
    monkeypatch.setattr("tdf_jax.viz.landscapes.Marks", broken)
    monkeypatch.setattr("tdf_jax.viz.page.pages", lambda _: None)  # also where plotly is not installed
    with pytest.raises(SystemExit) as stop:
        run("landscape", "--weights", weights, "--out", tmp_path / "out", "--grid", grid, "--page", *QUICK)
    assert stop.value.code == 1
    assert {path.name for path in (tmp_path / "out").iterdir()} == {"result.json", "landscape.npz"}
    assert [path.name for path in tmp_path.iterdir()] == ["out"]
    error = capsys.readouterr().err.splitlines()[-1]
    assert re.findall(r"([\w.]+) is missing \(ValueError: no pictures today\)", error) == sorted(
        pictures, key=error.index
    )


def test_the_record_and_the_landscape_agree(sweep):
    record, found = sweep("--grid", "volume", "--reduce", "softmin")
    assert record["grid"]["shape"] == [5, 5, 5] == list(found.grid.shape)
    np.testing.assert_allclose(record["grid"]["steps"], 0.05)
    np.testing.assert_allclose(record["minimisers"], found.minimisers)
    apart = np.linalg.norm(found.minimisers - record["truth"], axis=1)
    np.testing.assert_allclose(record["minimiser_metres"], apart)
    assert record["energy"]["least"] == pytest.approx(float(found.combined.min()))
    assert found.reduce == "softmin"
    path = np.array(record["path"])
    ends = np.array(record["truth"])[[0, -1]]
    nearest = [
        found.grid.points.reshape(-1, 3)[np.linalg.norm(found.grid.points.reshape(-1, 3) - end, axis=1).argmin()]
        for end in ends
    ]
    np.testing.assert_allclose(path[[0, -1]], nearest, atol=1e-6)
    assert record["query_change"]["largest"] >= record["query_change"]["median"] > 0
    assert record["one_by_one"] == 125 * record["queries"]


@pytest.mark.slow
def test_query_points_as_they_are_share_nothing_and_change_nothing(sweep):
    record, _ = sweep("--query", "given")
    assert record["query_change"] is None
    assert record["queries"] == 8
    assert record["evaluations"] >= record["one_by_one"]
    snapped, _ = sweep("--query", "snapped", "--pitch", "0.03")
    assert snapped["queries"] == 8


@pytest.mark.parametrize(("rotation", "count"), [("identity", 1), ("pick", 1), ("best", 3), ("turns", 3)])
def test_orientations(sweep, rotation, count):
    record, found = sweep("--rotation", rotation, "--rotations", 3)
    assert record["rotations"] == count == len(found.rotations)
    if rotation == "identity":
        np.testing.assert_array_equal(found.rotations[0], np.eye(3))
        np.testing.assert_allclose(found.grid.directions, np.eye(3)[1:], atol=1e-9)
    if rotation == "turns":
        turn = found.rotations[1] @ found.rotations[0].T
        np.testing.assert_allclose(turn, [[-0.5, -np.sqrt(0.75), 0], [np.sqrt(0.75), -0.5, 0], [0, 0, 1]], atol=1e-6)


def test_an_interrupted_sweep_goes_on(sweep, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(shared_lattice, "NODES", 60)
    wanted, whole = sweep("--grid", "volume")
    shutil.rmtree(tmp_path / "out")
    true_fill, calls = command.fill, []

    def stopping(landscape, field, reference, done):
        calls.append(done)
        for count, total in true_fill(landscape, field, reference, done):
            yield count, total
            if count == 3 and len(calls) == 1:
                raise KeyboardInterrupt

    monkeypatch.setattr(command, "fill", stopping)
    with pytest.raises(SystemExit) as stop:
        sweep("--grid", "volume")
    assert stop.value.code == 130
    assert [path.name for path in tmp_path.iterdir()] == ["out.unfinished.npz"]
    with pytest.raises(SystemExit) as stop:  # other settings are not mixed in
        sweep("--grid", "volume", "--seed", 1)
    assert stop.value.code == 2
    assert "unfinished sweep with other settings" in capsys.readouterr().err
    record, found = sweep("--grid", "volume")
    assert calls == [0, 3]
    np.testing.assert_array_equal(found.values, whole.values)
    assert record["minimisers"] == wanted["minimisers"]
    assert [path.name for path in tmp_path.iterdir()] == ["out"]


@pytest.mark.parametrize("changed", [("--radius", "0.09"), ("--query", "snapped"), ("--rotation", "best")])
def test_another_sweep_does_not_go_on(sweep, tmp_path, monkeypatch, capsys, changed):
    """Each of these leaves the field as it was, and the first the grid's coordinates."""
    true_fill = command.fill

    def stopping(*arguments):
        yield next(true_fill(*arguments))
        raise KeyboardInterrupt

    first = (
        ("--grid", "path", "--radius", "0.075") if "--radius" in changed else ("--rotation", "turns", "--rotations", 2)
    )
    monkeypatch.setattr(command, "fill", stopping)
    with pytest.raises(SystemExit):
        sweep(*first)
    with pytest.raises(SystemExit) as stop:
        sweep(*first, *changed)
    assert stop.value.code == 2
    assert "other settings" in capsys.readouterr().err


def test_a_mask_makes_another_sweep(field, reference):
    grid = tdf.plane_grid(0.1, 3)
    masked = dataclasses.replace(grid, mask=np.eye(3, dtype=bool))
    digests = {
        command._digest(field, reference, one, np.eye(3)[None])
        for one in (grid, masked, dataclasses.replace(masked, mask=~masked.mask))
    }
    assert len(digests) == 3


def test_what_fails_after_the_sweep_does_not_lose_it(sweep, tmp_path, monkeypatch):
    def broken(*arguments):
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(command, "lowest_cost_path", broken)
        with pytest.raises(SystemExit):
            sweep()
    assert [path.name for path in tmp_path.iterdir()] == ["out.unfinished.npz"]
    done = []
    true_fill = command.fill
    monkeypatch.setattr(command, "fill", lambda *arguments: (done.append(arguments[3]), true_fill(*arguments))[1])
    sweep()
    assert done == [1]
    assert [path.name for path in tmp_path.iterdir()] == ["out"]


def test_the_path_is_as_sharp_as_asked_and_left_out_of_large_grids(sweep, monkeypatch):
    asked = []
    true_path = command.lowest_cost_path
    monkeypatch.setattr(
        command, "lowest_cost_path", lambda *arguments: (asked.append(arguments[3]), true_path(*arguments))[1]
    )
    sweep("--sharpness", 3)
    assert asked == [3.0]
    monkeypatch.setattr(command, "MAX_PATH_POINTS", 24)
    record, _ = sweep("--reduce", "mean")
    assert record["path"] is None and record["path_metres"] is None
    assert asked == [3.0]


def test_missing_extras_are_named_before_any_work(weights, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(command, "fill", None)
    for module, words in (("plotly.graph_objects", "plotly is not installed"), ("igl", "libigl")):
        with monkeypatch.context() as patch:
            patch.setitem(sys.modules, module, None)
            with pytest.raises(SystemExit) as stop:
                run("landscape", "--weights", weights, "--out", tmp_path / "out", "--grid", "volume", "--page", *QUICK)
        assert stop.value.code == 2
        assert words in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


def test_a_long_sweep_is_kept_on_the_way(sweep, tmp_path, monkeypatch):
    """Nothing but the file helps against a power cut."""
    monkeypatch.setattr(shared_lattice, "NODES", 60)
    monkeypatch.setattr(command, "SAVE_SECONDS", 0.0)
    kept = []
    true_save = command.save_landscape
    monkeypatch.setattr(
        command,
        "save_landscape",
        lambda path, *rest: (kept.append((path.name, rest[1].get("done"))), true_save(path, *rest)),
    )
    sweep("--grid", "volume")
    *parts, last = kept
    assert [done for _, done in parts] == list(range(1, len(parts) + 1))
    assert len(parts) > 3 and last[0] == "landscape.npz"


def test_a_demonstration_and_a_cloud_from_files(weights, tmp_path):
    rng = np.random.default_rng(0)
    path = tdf.line(4, start=(0, 0, 0), end=(0.1, 0, 0))
    save_demonstration(
        tmp_path / "demo.npz", tdf.Demonstration(rng.normal(size=(60, 3)) * 0.04, path, rng.normal(size=(9, 3)) * 0.02)
    )
    np.save(tmp_path / "cloud.npy", rng.normal(size=(60, 3)) * 0.04)
    files = ("--demonstration", tmp_path / "demo.npz", "--target", tmp_path / "cloud.npy", "--out", tmp_path / "out")
    run("landscape", "--weights", weights, *files, "--no-plots", "--half", 0.1, "--pitch", 0.05)
    record = json.loads((tmp_path / "out" / "result.json").read_text())
    assert record["truth"] is None
    assert len(record["minimiser_metres"]) == 4


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("--half", "0"), "--half is 0.0"),
        (("--half", "0.001"), "--half is 0.001; expected at least half the pitch"),
        (("--pitch", "-1"), "--pitch is -1.0"),
        (("--radius", "nan"), "--radius is nan"),
        (("--rotation", "best", "--rotations", "0"), "--rotations is 0"),
        (("--rotation", "turns", "--axis", "0", "0", "0"), "axis is"),
        (("--grid", "volume", "--pitch", "1e-6"), "GB free"),
        (("--grid", "path", "--pitch", "1e-6"), "GB free"),
        (("--grid", "path", "--radius", "1e-5"), "expected a pitch of at most the radius"),
        (("--pitch", "0.0001", "--half", "0.01"), "expected at most 4096"),
        (("--weights", "nothing"), "nothing"),
        (("--sharpness", "-1"), "--sharpness is -1"),
    ],
)
def test_mistakes_are_named_and_nothing_is_written(weights, tmp_path, capsys, words, message):
    with pytest.raises(SystemExit) as stop:
        run("landscape", "--weights", weights, "--out", tmp_path / "out", "--no-plots", *QUICK, *words)
    assert stop.value.code == 2
    error = capsys.readouterr().err
    assert message in error and "Traceback" not in error
    assert not list(tmp_path.iterdir())
