"""The study of recognition: what its record says of given evidence, and what it refuses before the work."""

import json
import types

import numpy as np
import pytest

from tdf_jax.evaluation import recognition_study as study


@pytest.fixture
def evidence(monkeypatch):
    """Right cases match well; wrong ones do not, but for one in four."""
    weights = types.SimpleNamespace(info=types.SimpleNamespace(name="mug", source="a test"))
    asked = []

    def given(model, category, seed, index, right):
        asked.append((category, seed, index, right))
        return (0.2, -0.2) if right or index % 4 == 3 else (0.9, -2.5)

    monkeypatch.setattr(study, "load_model", lambda name: weights)
    monkeypatch.setattr(study, "evidence", given)
    return asked


def test_the_record_has_rates_and_areas(evidence, tmp_path, capsys):
    study.main(["--count", "8", "--seed", "3", "--out", str(tmp_path / "record.json")])
    printed = capsys.readouterr().out
    kept = json.loads((tmp_path / "record.json").read_text())
    assert json.loads(printed[printed.index("{") :]) == kept
    assert len(evidence) == kept["cases"] == 16 and {case[:2] for case in evidence} == {("mug", 3)}
    assert kept["thresholds"]["0.5"] == {"wrong_doubted": 0.75, "right_doubted": 0.0}
    assert kept["area"] == kept["area_of_the_residual_alone"] == pytest.approx(0.75 + 0.25 / 2)
    assert kept["area_by_cloud"] == {"full": 1.0, "views1": 1.0, "views2": 1.0, "noise": 0.5}
    assert set(kept["thresholds_by_size"]) == {"common", "natural"} and kept["curve"] == [-2.77, 6.25, 4.76]


def test_a_fit_separates_what_it_was_fitted_to(evidence, tmp_path):
    study.main(["--count", "8", "--fit", "--out", str(tmp_path / "record.json")])
    kept = json.loads((tmp_path / "record.json").read_text())
    assert kept["curve"] != [-2.77, 6.25, 4.76] and np.isfinite(kept["curve"]).all()
    assert kept["thresholds"]["0.5"] == {"wrong_doubted": 0.75, "right_doubted": 0.0}


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--count", "0"], "--count: 0 is given; expected at least 1"),
        (["--seed", "-1"], "--seed: -1 is given; expected at least 0"),
        (["--out", "nowhere/record.json"], "expected a file in an existing folder"),
        (["--task", "bowl_on_mug", "--weights", "mug"], "drop --weights and --category"),
    ],
)
def test_mistakes_are_refused_before_the_work(words, message, evidence, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit) as stop:
        study.main(words)
    assert stop.value.code == 2 and message in capsys.readouterr().err and evidence == []
