"""The report of a campaign: rates, causes and the record, of outcomes that are known."""

import dataclasses
import json

import numpy as np
import pytest

from tdf_jax.sim.campaign import Run
from tdf_jax.sim.condition import Condition, Settings
from tdf_jax.sim.episode import Outcome
from tdf_jax.sim.report import causes, criteria, not_drawn, rates, record, summary

CONDITION = Condition("mug_on_rack", "known", "upright", "execute")
GOOD = Outcome(True, True, True, True, "", "", 0.002, 1.0)
SLACK = Outcome(True, True, True, False, "not on the peg", "no peg", 0.004, 3.0)
FELL = Outcome(True, False, False, False, "fell", "it fell", 0.006, 5.0)
NEVER = Outcome(False, False, False, False, "unreachable", "far", np.nan, np.nan)


@pytest.fixture
def runs():
    outcomes = (GOOD, GOOD, SLACK, FELL, FELL, NEVER, GOOD, GOOD)
    return [
        Run(CONDITION, number, outcome, number % 3, number % 2, (1.0 + number, 2.0, 8.0 + number))
        for number, outcome in enumerate(outcomes)
    ]


def test_rates_count_every_episode(runs):
    table = rates(runs)
    assert {name: rate for name, (rate, _) in table.items()} == {
        "grasp": 7 / 8, "place": 5 / 8, "overall": 5 / 8, "strict": 4 / 8,
    }  # fmt: skip
    for rate, interval in table.values():
        assert rate is not None and interval is not None
        assert 0 <= interval[0] < rate < interval[1] <= 1


def test_causes_are_counted_the_most_frequent_first(runs):
    assert list(causes(runs).items()) == [("fell", 2), ("not on the peg", 1), ("unreachable", 1)]


def test_criteria_of_the_place_are_those_of_the_protocol(runs, tmp_path):
    on_peg = dataclasses.replace(GOOD, touches=True, off_table=True, settled=True, hung=True, no_collision=True)
    runs[0] = dataclasses.replace(runs[0], outcome=on_peg)
    table = criteria(runs)
    assert list(table) == ["touches", "off_table", "settled", "hung", "no_collision"] and table["hung"][0] == 1 / 8
    made = record(Settings(CONDITION, "mug", None, 7, tmp_path), runs)
    assert made["place_criteria"]["settled"]["rate"] == 1 / 8
    first = made["episodes"][0]
    assert first["touches"] is True and first["comes_off"] is first["upright"] is None  # which nothing tests here
    bowl = [dataclasses.replace(runs[0], condition=CONDITION._replace(task="bowl_on_mug", mode="teleport"))]
    assert list(criteria(bowl)) == ["touches", "off_table", "settled", "upright", "comes_off"]
    assert "touches the target 12 %, not the table 12 %, settled 12 %, hung by the handle 12 %" in summary(runs)


def test_what_was_not_drawn_is_named_and_not_counted(runs, tmp_path):
    before = rates(runs)
    for number, mesh in ((8, "cup"), (9, "cup")):
        detail = f"draw_episode(): there is no mug_on_rack with cup (episode {number}, seed 3): too thick"
        runs.append(Run(CONDITION, number, Outcome.failure("not drawn", detail), 0, 1, (0.0, 0.0, 0.0), mesh))
    assert rates(runs) == before and "not drawn" not in causes(runs)
    (words,) = not_drawn(runs)
    assert words == "8, 9: cup: draw_episode(): there is no mug_on_rack with cup (seed 3): too thick"
    assert f"  not drawn, and not counted: {words}" in (text := summary(runs)) and "tdf_jax: 8 episodes" in text
    made = json.loads(json.dumps(record(Settings(CONDITION, "mug", None, 7, tmp_path), runs), allow_nan=False))
    assert made["not_drawn"] == [8, 9] and made["episodes"][9]["mesh"] == "cup"
    nothing = record(Settings(CONDITION, "mug", None, 7, tmp_path), runs[8:])
    assert nothing["rates"]["overall"] == {"rate": None, "interval": None} and "overall: n/a" in summary(runs[8:])


def test_intervals_are_over_meshes(runs):
    """Four episodes of each of two meshes are two objects."""
    outcomes = [GOOD] * 4 + [FELL] * 4
    runs = [
        dataclasses.replace(one, outcome=new, instance="ab"[n // 4]) for n, (one, new) in enumerate(zip(runs, outcomes))
    ]
    assert rates(runs)["overall"] == (0.5, [0.0, 1.0])
    assert rates(runs[:4])["overall"] == (1.0, None)  # of one object there is none


def test_a_summary_says_all_of_it(runs):
    text = summary(runs)
    assert text.startswith("mug_on_rack, target known, upright, execute, full clouds, 1 demonstration, tdf_jax: 8 epi")
    assert "  overall: 62 % (" in text and "  overall, hung by the handle: 50 % (" in text
    assert "  failed: fell: 2" in text
    assert "moved in the hand, median: 2.0 mm, 1.0 degrees" in text  # of 2, 2, 4, 6, 6, 2, 2
    assert "7 starts out of reach, 4 pairs that do not fit or have no start within reach" in text
    assert "  seconds, median: imitation 4.5, planning 2.0, physics 11.5" in text
    assert "  seconds, all episodes: imitation 36.0, planning 16.0, physics 92.0" in text


def test_a_record_is_json_whose_seconds_stand_apart(runs, tmp_path):
    settings = Settings(CONDITION, "mug", None, 7, tmp_path)
    made = record(settings, runs)
    again = json.loads(json.dumps(made, allow_nan=False))
    assert again["condition"]["task"] == "mug_on_rack" and again["seed"] == 7
    assert again["episodes"][5]["slip"] is None and again["episodes"][3]["cause"] == "fell"
    assert [one["number"] for one in again["episodes"]] == list(range(8))
    assert again["rates"]["strict"]["rate"] == 0.5 and again["causes"]["fell"] == 2
    slower = [Run(run.condition, run.number, run.outcome, run.rejected, run.redrawn, (99.0, 9.0, 90.0)) for run in runs]
    assert made["seconds"]["episodes"][1] == [2.0, 2.0, 9.0] and made["seconds"]["planning"] == 16.0
    other = record(settings, slower)
    assert {key for key in made if made[key] != other[key]} == {"seconds"}
