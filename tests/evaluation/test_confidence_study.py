"""The study of the confidence: what counts as right, the bins, what is kept, and the printed reliability."""

from types import SimpleNamespace

import numpy as np
import pytest

from tdf_jax._internal.errors import InputError
from tdf_jax.evaluation import confidence_study
from tdf_jax.evaluation.confidence_study import Pick, main, measure, reliability, report
from tdf_jax.networks.checkpoint import load_model


def test_a_pick_is_right_within_both_limits():
    right = Pick("full", 0.2, 0.019, 19.0, np.nan)
    assert right.right
    assert not right._replace(distance=0.021).right and not right._replace(angle=21.0).right


def test_bins_have_equal_numbers_and_rise():
    rng = np.random.default_rng(0)
    predicted = rng.uniform(size=1003)
    right = (rng.uniform(size=1003) < predicted).astype(float)
    rows = reliability(predicted, right)
    assert len(rows) == 10 and sum(row["picks"] for row in rows) == 1003
    assert max(row["picks"] for row in rows) - min(row["picks"] for row in rows) <= 1
    assert (np.diff([row["predicted"] for row in rows]) > 0).all()
    for row in rows:
        assert row["right"] == pytest.approx(row["predicted"], abs=0.12)


def test_the_report_says_what_the_picks_are():
    """Of 20 picks, 15 right with a small residual; 4 hidden, of which 2 wrong ones are doubted."""
    good = [Pick("full", 0.1, 0.001, 1.0, np.nan)] * 13 + [Pick("camera1", 0.1, 0.001, 1.0, 5.0)] * 2
    bad = [Pick("noise", 1.0, 0.1, 90.0, np.nan)] * 3 + [Pick("camera1", 1.0, 0.1, 90.0, 5.0)] * 2
    text = report([*good, *bad, Pick("full", np.nan, np.nan, np.nan, np.nan)], (-3.39, 6.55))
    assert "picks: 21, of which 1 found nothing; right: 75 %" in text
    assert "in 100 % of pairs" in text
    assert "place hidden: 4 picks, confidence below 0.5 in 50 %" in text
    assert "place hidden, wrong: 2 picks, confidence below 0.5 in 100 %" in text
    error = float(text.split("expected calibration error: ")[1].split()[0])
    assert error == pytest.approx(0.75 * 0.01 + 0.25 * 0.033, abs=2e-3)


def test_an_interrupted_study_goes_on(monkeypatch, tmp_path, capsys):
    calls = []

    def measured(model, category, place, seed, number, hidden):
        calls.append(number)
        if number == 3 and len(calls) < 5:
            raise KeyboardInterrupt
        wrong = number % 2 == 1
        return Pick("full", 0.9 if wrong else 0.1, 0.1 if wrong else 0.001, 5.0, np.nan)

    monkeypatch.setattr(confidence_study, "measure", measured)
    monkeypatch.setattr(confidence_study, "load_model", lambda name: name)
    monkeypatch.setattr(confidence_study, "fingerprint", lambda model: model)
    words = ["--weights", "mug", "--picks", "24", "--seed", "3", "--out", str(tmp_path), "--fit"]
    with pytest.raises(KeyboardInterrupt):
        main(words)
    main(words)
    assert calls == [0, 1, 2, 3, *range(3, 24)]
    printed = capsys.readouterr().out
    assert "picks: 24, of which 0 found nothing; right: 50 %" in printed and "fitted to these picks" in printed
    with pytest.raises(SystemExit):  # too few of a kind
        main(["--picks", "4", "--seed", "3", "--out", str(tmp_path), "--fit"])
    assert "a fit needs 10 of each" in capsys.readouterr().err


def test_hidden_places_have_a_report_of_their_own(monkeypatch, tmp_path, capsys):
    def measured(model, category, place, seed, number, hidden):
        return Pick("camera1", 0.9, 0.1, 90.0, 3.0) if hidden else Pick("full", 0.1, 0.001, 5.0, np.nan)

    monkeypatch.setattr(confidence_study, "measure", measured)
    monkeypatch.setattr(confidence_study, "load_model", lambda name: name)
    monkeypatch.setattr(confidence_study, "fingerprint", lambda model: model)
    main(["--picks", "5", "--hidden", "2", "--out", str(tmp_path)])
    every, hidden = capsys.readouterr().out.split("places that one depth image hides")
    assert "picks: 5, of which 0 found nothing; right: 100 %" in every and "place hidden" not in every
    assert "picks: 2, of which 0 found nothing; right: 0 %" in hidden
    assert "place hidden, wrong: 2 picks, confidence below 0.5 in 100 %" in hidden


def test_the_first_pair_whose_place_is_hidden_is_taken(monkeypatch):
    asked = []

    def made(category, seed, index, *, place, clouds, natural):
        asked.append(index)
        return SimpleNamespace(seen=3 if index == 203 else 50, clouds=clouds)

    monkeypatch.setattr(confidence_study, "generated_case", made)
    case, number = confidence_study._hidden_case("mug", "handle", 0, 2)
    assert number == 203 and case.seen == 3 and asked == [200, 201, 202, 203]
    with pytest.raises(InputError, match="none of 100 depth images hides the rim of a bowl"):
        confidence_study._hidden_case("bowl", "rim", 0, 0)


def test_picks_that_find_nothing_end_in_a_line(monkeypatch, tmp_path, capsys):
    nothing = Pick("full", np.nan, np.nan, np.nan, np.nan)
    monkeypatch.setattr(confidence_study, "measure", lambda *about: nothing)
    monkeypatch.setattr(confidence_study, "load_model", lambda name: name)
    monkeypatch.setattr(confidence_study, "fingerprint", lambda model: model)
    with pytest.raises(SystemExit) as ended:
        main(["--picks", "2", "--out", str(tmp_path)])
    assert ended.value.code == 2 and "none of the 2 picks found anything" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--weights", "multi"], "--category is not given"),
        (["--weights", "none", "--category", "mug"], "none"),
    ],
)
def test_bad_words_end_in_a_line(tmp_path, capsys, words, message):
    with pytest.raises(SystemExit) as ended:
        main([*words, "--out", str(tmp_path)])
    assert ended.value.code == 2 and message in capsys.readouterr().err


@pytest.mark.slow
def test_a_pick_on_a_complete_mug_is_measured():
    one = measure(load_model("mug"), "mug", "handle", 901, 0)
    assert one.clouds == "full" and one.right and 0 < one.residual < 0.6 and np.isnan(one.seen)
