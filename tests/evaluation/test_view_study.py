"""The study of a second view: which mugs count as hidden, and what the second view sees."""

import json

import numpy as np

from tdf_jax.evaluation import view_study
from tdf_jax.shapes import build_mug


def test_points_of_the_handle_are_outside_the_body():
    mug = build_mug()
    points = np.array([[0.0, 0, 0.05], [mug.parameters.top_radius, 0, 0.05], mug.handle_frame[:3, 3]])
    assert view_study.handle_points(mug, points) == 1


def test_the_second_view_is_from_where_the_advice_says(monkeypatch):
    """The opposite of a first view in which the handle is hidden sees the handle."""
    clouds = []

    def picked(model, reference, mug, R, points, number):
        clouds.append(points)
        middle = mug.mesh.vertices.mean(axis=0)
        away = R @ (middle - points.mean(axis=0))
        return len(clouds) % 2 == 0, 0.25, away / np.linalg.norm(away)

    monkeypatch.setattr(view_study, "picked", picked)
    cases = [view_study.measure(None, None, 1, number) for number in range(8)]
    hidden = [case for case in cases if case is not None]
    assert 0 < len(hidden) < len(cases) and len(clouds) == 2 * len(hidden)
    assert all(not case.before and case.after and case.turned < 60 for case in hidden)
    assert np.mean([case.seen >= 20 for case in hidden]) >= 0.5
    assert all(len(both) > len(first) for first, both in zip(clouds[::2], clouds[1::2]))


def test_the_study_prints_rates_and_keeps_the_cases(monkeypatch, tmp_path, capsys):
    def measure(model, reference, seed, number):
        return None if number % 2 else view_study.Case(number, False, number > 0, 0.2, 0.9, 30, 5.0)

    monkeypatch.setattr(view_study, "measure", measure)
    monkeypatch.setattr(view_study, "load_model", lambda name: None)
    monkeypatch.setattr(view_study, "demonstrate", lambda model, seed: None)
    view_study.main(["--mugs", "4", "--out", str(tmp_path / "cases.json")])
    printed = capsys.readouterr().out
    assert "right with one view: 0 %" in printed and "right with the second view: 75 %" in printed
    assert [case["number"] for case in json.loads((tmp_path / "cases.json").read_text())] == [0, 2, 4, 6]
