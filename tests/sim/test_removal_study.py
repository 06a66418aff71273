"""The study of what removal costs: its parts against other ways to find them, and one view end to end."""

import numpy as np
import pytest

import tdf_jax as tdf
from tdf_jax.sim import removal_study
from tdf_jax.sim.removal_study import draw_object, draw_view, measure, part_of

pytest.importorskip("mujoco", reason="the extra 'sim' is not installed")


def test_a_handle_is_outside_of_the_body_and_pegs_leave_the_post():
    mug = tdf.build_mug()
    points = tdf.sample_surface(mug.mesh, 4000, 0)
    found = part_of(mug, points)
    assert 0.05 < found.mean() < 0.3
    assert (np.linalg.norm(points[found, :2], axis=1) > 0.039).all()
    rack = tdf.build_rack()
    points = tdf.sample_surface(rack.mesh, 4000, 0)
    found = part_of(rack, points)
    tip = rack.peg_lines[0, 1]
    assert (np.abs(points[found, 1]) < rack.parameters.peg_thickness).all() and found.any()
    near = np.linalg.norm(points - tip, axis=1) < 0.02
    assert found[near].all() and near.any()
    assert not part_of(tdf.build_bowl(), tdf.sample_surface(tdf.build_bowl().mesh, 50, 0)).any()


def test_a_low_bowl_keeps_its_points():
    rng = np.random.default_rng(3)
    view = draw_view(draw_object("bowl of 22 mm", rng), rng)
    assert view.own.sum() > 1000 and not view.part.any() and view.flying.any()
    assert not (view.own & view.flying).any()
    found = measure(view)
    assert found["lost"] <= 0.05 and found["edges"] <= found["lost"] and np.isnan(found["part, lost"])
    assert found["foreign"] < 0.02


def test_the_command_prints_a_row(monkeypatch, capsys, tmp_path):
    monkeypatch.setattr(removal_study, "draw_view", lambda shape, rng: None)
    monkeypatch.setattr(removal_study, "measure", lambda view: {"edges": 0.01, "part, lost": float("nan")})
    removal_study.main(["--objects", "2", "--rows", "bowl", "--out", str(tmp_path / "out.json")])
    assert "| bowl | 1.0 (1.0) | - |" in capsys.readouterr().out
    assert (tmp_path / "out.json").exists()
