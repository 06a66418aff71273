"""The command that times the viewer: what it measures, and what it says where something is missing."""

import json
import sys

import jax
import numpy as np
import pytest
from conftest import CARRY, random_cloud

import tdf_jax as tdf
from bench import browser, viewer
from tdf_jax._internal.errors import InputError
from tdf_jax.solvers.imitation_scene import weights_of


def test_a_missing_browser_is_said_before_anything_is_computed(monkeypatch, capsys):
    pytest.importorskip("viser", reason="the extra 'viewer' is not installed")
    monkeypatch.setattr(browser.shutil, "which", lambda name: None)
    monkeypatch.setattr(viewer, "tdf_command", lambda words: pytest.fail("an imitation was begun"))
    monkeypatch.setattr(sys, "argv", ["bench.viewer"])
    with pytest.raises(SystemExit) as ended:
        viewer.main()
    assert ended.value.code == 2
    assert "no browser is installed; expected one of chromium" in capsys.readouterr().err


def test_a_missing_driver_is_said(monkeypatch, tmp_path):
    monkeypatch.setitem(sys.modules, "playwright.sync_api", None)
    with pytest.raises(InputError, match=r"playwright is not installed; expected the extra 'dev'"):
        viewer.measure(tmp_path, 1)


def test_no_repetition_is_refused(monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", ["bench.viewer", "--repetitions", "0"])
    with pytest.raises(SystemExit) as ended:
        viewer.main()
    assert ended.value.code == 2 and "expected at least 1" in capsys.readouterr().err


def test_a_spread_is_the_median_with_the_least_and_the_most():
    assert viewer.spread([{"s": 3.0}, {"s": 1.0}, {"s": 1.5}], "s") == "1.50 (1.00 to 3.00)"


@pytest.mark.slow
def test_drags_find_other_picks_and_pages_paint_in_a_browser(
    chromium, demonstration, small_model, tmp_path, monkeypatch, capsys
):
    cloud = random_cloud(3).astype(np.float32)
    result = tdf.imitate(small_model, demonstration, cloud, key=jax.random.key(0), config=CARRY, clean=False)
    weights = tmp_path / "small.safetensors"
    tdf.save_model(small_model, weights)
    kept = weights_of(str(weights), small_model)
    tdf.save_imitation(tmp_path / "scene.npz", tdf.ImitationScene(demonstration, cloud, result, weights=kept))
    monkeypatch.setattr(sys, "argv", ["bench.viewer", "--folder", str(tmp_path), "--repetitions", "2", "--json"])
    viewer.main()
    record = json.loads(capsys.readouterr().out)
    assert [len(rows) for rows in (record["drag"], *record["paint"].values())] == [2, 2, 2]
    for row in record["drag"]:
        assert 0 < row["encoding"] + row["search"] <= row["found"] <= row["shown"]
    for rows in record["paint"].values():
        assert all(row["painted"] > 0 and 0.1 < row["megabytes"] < 10 for row in rows)
