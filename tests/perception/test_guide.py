"""The guide's blocks of code, in their order and on its own depth image."""

import re
from pathlib import Path

import numpy as np
import pytest

import tdf_jax as tdf

ROOT = Path(__file__).parents[2]
BLOCKS = re.findall(r"```python\n(.*?)```", (ROOT / "docs" / "guide" / "camera.md").read_text(), re.DOTALL)


def run(monkeypatch, blocks):
    monkeypatch.chdir(ROOT)
    names = {}
    for block in blocks:
        exec(block, names)
    return names


def test_two_objects_are_seen(monkeypatch, capsys):
    names = run(monkeypatch, BLOCKS[:2])
    assert len(names["clouds"]) == 2 and min(map(len, names["clouds"])) > 5000
    assert names["counts"].flying > 100 and names["counts"].invalid > 0
    assert capsys.readouterr().out
    middles = sorted(cloud.mean(axis=0)[1] for cloud in names["clouds"])
    np.testing.assert_allclose(middles, [-0.06, 0.09], atol=0.03)


@pytest.mark.slow
def test_the_mug_is_taken_and_picked(monkeypatch, capsys):
    names = run(monkeypatch, BLOCKS)
    assert len(BLOCKS) == 5
    assert abs(names["cloud"].mean(axis=0)[1] + 0.06) < 0.03
    assert names["choice"].residuals.min() < 0.5 < names["choice"].residuals.max()
    assert float(names["result"].confidence) > 0.8
    assert len(names["views"][0]) == len(names["points"])
    np.testing.assert_allclose(names["T_world_camera"][:3, :3], np.diag([1.0, -1, -1]), atol=1e-12)
    pick = np.asarray(names["result"].trajectory.matrices[0])[:3, 3]
    assert np.linalg.norm(names["cloud"] - pick, axis=1).min() < 0.02
    assert isinstance(names["result"], tdf.Result)
