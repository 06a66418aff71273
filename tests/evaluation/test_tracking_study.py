"""The study of tracking: motions, what counts as one pick, what is kept, and the printed report."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tdf_jax.evaluation import tracking_study
from tdf_jax.evaluation.tracking_study import Move, main, measure, motion, report
from tdf_jax.networks.checkpoint import load_model
from tdf_jax.solvers.tracking import TrackConfig

GOOD = Move("mug", 20.0, 0.0002, 0.3, False, 1.02, 1.01, 0.1, 2.0, 0.08)
BAD = GOOD._replace(distance=0.05, ratio=3.0)


def test_motions_are_within_their_bounds_and_about_the_object():
    T_world_object = np.eye(4)
    T_world_object[:3, 3] = 0.4, -0.2, 0.3
    moves = [motion(np.random.default_rng(seed), T_world_object, 30.0, 0.05) for seed in range(300)]
    angles = [np.degrees(Rotation.from_matrix(T[:3, :3]).magnitude()) for T in moves]
    distances = [np.linalg.norm((T @ T_world_object)[:3, 3] - T_world_object[:3, 3]) for T in moves]
    assert 25 < max(angles) <= 30 and 13 < np.mean(angles) < 17
    assert 0.045 < max(distances) <= 0.05 and np.mean(distances) == pytest.approx(0.75 * 0.05, rel=0.05)


def test_a_pick_is_one_within_both_limits():
    assert GOOD.same
    assert not GOOD._replace(distance=0.0011).same and not GOOD._replace(turn=1.1).same


def test_the_report_counts_what_is_lost():
    bowl = BAD._replace(category="bowl", lost=True)
    text = report([GOOD, GOOD._replace(lost=True), BAD, bowl])
    assert "| mug | 3 | 1 | 1 | 0 | 1 |" in text
    assert "| bowl | 1 | 0 | 0 | 1 | 0 |" in text
    assert "| all | 4 | 1 | 1 | 1 | 1 |" in text
    assert "other picks (0, 10, 50, 90, 100 %): 3.000, 3.000, 3.000" in text
    assert "track, seconds (0, 10, 50, 90, 100 %): 0.080" in text


def test_an_interrupted_study_goes_on(monkeypatch, tmp_path, capsys):
    calls = []

    def measured(model, category, clouds, seed, number, angle, distance, config):
        calls.append(number)
        if number == 2 and len(calls) < 4:
            raise KeyboardInterrupt
        return GOOD._replace(category=category)

    monkeypatch.setattr(tracking_study, "measure", measured)
    monkeypatch.setattr(tracking_study, "load_model", lambda name: name)
    monkeypatch.setattr(tracking_study, "fingerprint", lambda model: model)
    words = ["--moves", "6", "--seed", "3", "--out", str(tmp_path)]
    with pytest.raises(KeyboardInterrupt):
        main(words)
    main(words)
    assert calls == [0, 1, 2, *range(2, 6)]
    assert "| all | 6 | 6 | 0 | 0 | 0 |" in capsys.readouterr().out


@pytest.mark.parametrize("words", [["--angle", "200"], ["--distance", "-1"], ["--clouds", "none"]])
def test_bad_settings_are_refused(words, tmp_path):
    with pytest.raises(SystemExit) as stopped:
        main([*words, "--out", str(tmp_path)])
    assert stopped.value.code == 2


@pytest.mark.slow
def test_a_mug_that_moved_is_tracked_to_the_pick_of_carry():
    move = measure(load_model("mug"), "mug", "full", 840, 1, 30.0, 0.05, TrackConfig())
    assert move.same and not move.lost and move.track < move.carry
