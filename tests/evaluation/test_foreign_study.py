"""The study of foreign points: which clouds it makes, and what it counts."""

import json

import numpy as np
import pytest
from scipy.spatial import KDTree

from tdf_jax.evaluation import foreign_study as study
from tdf_jax.evaluation.cases import generated_case
from tdf_jax.evaluation.tabletop import moved
from tdf_jax.geometry.sampling import sample_surface


@pytest.mark.parametrize("row", study.ROWS)
def test_a_fifth_of_a_cloud_is_foreign_and_where_the_row_says(row):
    case = study.foreign_case(50, 0, row)
    plain = generated_case("mug", 50, 0)
    np.testing.assert_allclose(case.points_b[: study.POINTS], plain.points_b, atol=1e-6)
    assert case.own == study.POINTS
    foreign = moved(case.points_b[case.own :].astype(float), np.linalg.inv(case.T_world_b))
    count = {study.NONE: 0, study.STRAY: 1}.get(row, study.FOREIGN)
    assert foreign.shape == (count, 3)
    if not count:
        return
    surface = sample_surface(case.object_b.mesh, 40_000, 0)
    gaps = KDTree(surface).query(foreign)[0]
    if row == study.STRAY:
        assert 2.8 < gaps[0] < 3.2
    elif row == study.OUTLIERS:
        near = gaps[: study.FOREIGN // 2]
        assert 0.009 < near.min() and near.max() < 0.061 and gaps.max() > 1
    elif row == study.TABLE:
        assert np.ptp(foreign[:, 2]) < 1e-6 and abs(foreign[0, 2] - surface[:, 2].min()) < 0.002
        assert 0.01 < gaps.max() < 0.025
    else:
        gap = study.NEIGHBOURS[row][1]
        assert gap - 0.001 < gaps.min() < gap + 0.008
        assert foreign[:, 2].min() > surface[:, 2].min() - 0.002


def test_points_of_the_handle_are_the_mugs_own():
    case = study.foreign_case(50, 1, "mug that touches it")
    handle = study.on_handle(case)
    assert 10 < handle.sum() < 300 and not handle[case.own :].any()


def test_a_pick_is_measured_without_and_with_removal(monkeypatch):
    """Of the mug's points 5 are removed, 2 of them on the handle, and of the foreign ones 7 stay."""
    case = study.foreign_case(50, 0, study.TABLE)
    handle = np.flatnonzero(study.on_handle(case))
    body = np.setdiff1d(np.arange(case.own), handle)

    def encode(model, points, clean, return_kept):
        kept = np.arange(len(points)) < case.own + 7
        kept[np.concatenate([handle[:2], body[:3]])] = False
        return clean, kept if clean else np.ones(len(points), bool)

    monkeypatch.setattr(study, "encode", encode)
    monkeypatch.setattr(study, "place_reference", lambda *about: None)
    monkeypatch.setattr(study, "picked", lambda clean, *about: (0.005, 5.0) if clean else (0.05, 5.0))
    before, after = study.measure(None, case, study.TABLE, 3, None)
    assert before == (study.TABLE, 3, False, 0, 0, study.FOREIGN, 0.05, 5.0)
    assert after == (study.TABLE, 3, True, 5, 2, 7, 0.005, 5.0)
    (alone,) = study.measure(None, case, study.NONE, 3, None)
    assert alone.clean


def test_the_study_prints_a_row_for_each_kind_and_keeps_the_picks(monkeypatch, tmp_path, capsys):
    def measure(model, case, row, pair, query):
        alone = [study.Pick(row, pair, True, 2, 1, 30, 0.015 if pair else 0.005, 5.0)]
        return alone if row == study.NONE else [study.Pick(row, pair, False, 0, 0, 375, 0.3, 90.0), *alone]

    monkeypatch.setattr(study, "measure", measure)
    monkeypatch.setattr(study, "foreign_case", lambda *about: None)
    monkeypatch.setattr(study, "load_model", lambda name: None)
    out = tmp_path / "picks.json"
    study.main(["--pairs", "2", "--rows", study.TABLE, study.NONE, "--out", str(out)])
    lines = capsys.readouterr().out.splitlines()
    assert lines[2:] == [
        "| none | same field | 2, 1 | 2 | 2 | 1 | 30 |",
        "| strip of the table | 0, 0 | 2, 1 | 2 | 2 | 1 | 30 |",
    ]
    assert len(json.loads(out.read_text())) == 6
