"""`tdf imitate --targets`: a folder for every object, what is kept, and what is refused."""

import json

import numpy as np
import pytest
from conftest import POSES, QUERIES, STARTS, random_cloud

from tdf_jax.cli import imitate as command
from tdf_jax.cli.main import main

TINY = ("--method", "adam", "--num-starts", STARTS, "--iterations", 3, "--points", 60, "--no-plots")
TINY += ("--num-poses", POSES, "--queries", QUERIES)


def run(*words):
    main([str(word) for word in words])


@pytest.fixture
def objects(tmp_path):
    """Two clouds, and what is no object."""
    folder = tmp_path / "objects"
    folder.mkdir()
    for name, seed in (("a.npy", 3), ("b.xyz", 4)):
        cloud = random_cloud(seed, 60)
        np.save(folder / name, cloud) if name.endswith("npy") else np.savetxt(folder / name, cloud)
    (folder / "notes.md").write_text("no object")
    (folder / "._a.npy").write_bytes(b"")
    return folder


@pytest.fixture
def started(monkeypatch):
    """Names of the objects that are imitated on, in order."""
    names, go = [], command._run
    monkeypatch.setattr(
        command, "_run", lambda settings, *others: names.append(settings.target.name) or go(settings, *others)
    )
    return names


def test_each_object_gets_the_folder_of_a_run_of_its_own(objects, tmp_path, weights, capsys):
    options = ("--weights", weights, *TINY)
    run("imitate", "--targets", objects, "--out", tmp_path / "out", *options)
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].startswith("1/2 a.npy: loss ") and lines[1].startswith("2/2 b.xyz: loss ") and len(lines) == 2
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == ["a.npy", "b.xyz"]
    for name in ("a.npy", "b.xyz"):
        run("imitate", "--target", objects / name, "--out", tmp_path / "alone", *options)
        several, alone = (
            json.loads((one / "result.json").read_text()) for one in (tmp_path / "out" / name, tmp_path / "alone")
        )
        assert several["energies"] == alone["energies"] and several["goal"] == alone["goal"]
        assert several["settings"] | {"out": None} == alone["settings"] | {"out": None}


def test_a_second_run_does_what_is_missing(objects, tmp_path, weights, started, capsys):
    words = ("imitate", "--targets", objects, "--out", tmp_path / "out", "--weights", weights, *TINY)
    run(*words)
    run(*words)
    assert started == ["a.npy", "b.xyz"] and "done before" in capsys.readouterr().out
    (tmp_path / "out" / "a.npy" / "result.json").unlink()
    for path in (tmp_path / "out" / "a.npy").iterdir():
        path.unlink()
    run(*words)
    assert started[2:] == ["a.npy"]
    np.savetxt(objects / "b.xyz", random_cloud(5, 60))  # another object under its name
    run(*words)
    assert started[3:] == ["b.xyz"]
    capsys.readouterr()
    run(*words, "--json")
    records = json.loads(capsys.readouterr().out)
    assert [record["settings"]["target"] for record in records] == [str(objects / name) for name in ("a.npy", "b.xyz")]
    run(*words, "--seed", 1)
    assert started[4:] == ["a.npy", "b.xyz"]


def test_a_refused_object_does_not_stop_the_others(objects, tmp_path, weights, capsys):
    np.save(objects / "a.npy", random_cloud(3, 5))
    with pytest.raises(SystemExit) as stop:
        run("imitate", "--targets", objects, "--out", tmp_path / "out", "--weights", weights, *TINY)
    assert stop.value.code == 2
    out, error = capsys.readouterr()
    assert "1/2 a.npy: refused: " in error and "1 of 2 objects were refused: a.npy" in error
    assert out.startswith("2/2 b.xyz: loss ") and (tmp_path / "out" / "b.xyz" / "result.json").exists()


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--target", "a.npy"], "--target and --targets name new objects"),
        (["--task", "mug_on_rack"], "--task and --targets name new objects"),
        (["--animation", "film.gif"], "--animation is one film, which every object of --targets would overwrite"),
        (["--targets", "nowhere"], "--targets is nowhere; expected a folder"),
        (["--targets", "empty"], "has no mesh and no point cloud"),
        (["--out", "single"], "is the result of one object"),
        (["--out", "no/where"], "expected a place in an existing"),
        (["--k", "0.1"], "--k is a weight of eq. 3"),
    ],
)
def test_bad_options_are_refused(objects, tmp_path, monkeypatch, capsys, words, message):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "empty").mkdir()
    (tmp_path / "single").mkdir()
    (tmp_path / "single" / "result.json").write_text("{}")
    with pytest.raises(SystemExit) as stop:
        run("imitate", "--targets", objects, "--out", "out", *words)
    assert stop.value.code == 2 and message in capsys.readouterr().err
    assert not (tmp_path / "out").exists()
