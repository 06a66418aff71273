"""The study of derivatives: what an error is, what is kept, the printed report, and one pair on the real network."""

import numpy as np
import pytest

from tdf_jax.evaluation import sensitivity_study
from tdf_jax.evaluation.sensitivity_study import CHANGES, Pair, main, measure, report
from tdf_jax.networks.checkpoint import load_model

FOUND = np.tile([0.0, 0.0, 0.0, 0.03, 0.0, 0.04], (len(CHANGES), 1))
NONE = np.zeros((0, 6))
PAIR = Pair("mug", 1.1 * FOUND, FOUND, 1.5 * FOUND, NONE, 1e-4)


def test_errors_are_relative_to_what_is_found():
    assert PAIR.error("latent") == pytest.approx(0.1)
    assert PAIR.error("box moved", "again") == pytest.approx(0.5)


def test_free_directions_do_not_count():
    """The rotation about z of a bowl is off by more than all else."""
    yaw = np.eye(6)[2:3]
    off = Pair("bowl", 1.1 * FOUND + 5 * yaw, FOUND - 2 * yaw, FOUND, yaw, 1e-4)
    assert off.error("latent") == pytest.approx(0.1)


def test_the_report_has_a_row_for_each_change():
    text = report([PAIR, Pair("bowl", 1.3 * FOUND, FOUND, 1.5 * FOUND, np.eye(6)[2:3], 3e-4)])
    assert "| cloud stretched | 2 % | 1.00 mm | 20 % | 28 % | 30 % |  |" in text
    assert "| box moved | 2 mm | 0.10 mm | 20 % | 28 % | 30 % | 50 % |" in text
    assert "free directions: 0 in 1 pairs, 1 in 1 pairs" in text
    assert "offset, mm (50, 90, 100 %): 0.20, 0.28, 0.30" in text


def test_an_interrupted_study_goes_on(monkeypatch, tmp_path, capsys):
    calls = []

    def measured(model, category, seed, number):
        calls.append((category, number))
        if number == 2 and len(calls) < 4:
            raise KeyboardInterrupt
        return PAIR

    monkeypatch.setattr(sensitivity_study, "measure", measured)
    monkeypatch.setattr(sensitivity_study, "load_model", lambda name: name)
    monkeypatch.setattr(sensitivity_study, "fingerprint", lambda model: model)
    words = ["--pairs", "4", "--seed", "3", "--out", str(tmp_path)]
    with pytest.raises(KeyboardInterrupt):
        main(words)
    main(words)
    assert calls == [("mug", 0), ("bowl", 1), ("bottle", 2), ("bottle", 2), ("mug", 3)]
    assert "| latent | 2 % | 1.00 mm | 10 % | 10 % | 10 % |  |" in capsys.readouterr().out


@pytest.mark.slow
def test_derivatives_on_a_mug_agree_with_picks_that_are_found_again():
    pair = measure(load_model("mug"), "mug", 870, 0)
    assert pair.error("cloud stretched") < 0.15
    assert pair.error("query points stretched") < 0.25
    assert pair.offset < 1e-3
