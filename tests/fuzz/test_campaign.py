"""The campaign of hostile inputs: a few cheap cases, many with all tests; and the judge sees each kind of fault."""

import os
import re
import time
import warnings

import numpy as np
import pytest

import tdf_jax as tdf
from tdf_jax.cli.main import COMMANDS as NAMES, main

from . import campaign, cases, commands, files
from .cases import BAD, ONLY_REFUSED, ONLY_RIGHT, REFUSED, RIGHT, WARNED, Case, judge
from .undamaged import World

CHEAP = (
    files.mesh_reader,
    files.cloud_reader,
    files.demonstration_reader,
    files.trajectory_reader,
    files.weights_reader,
)


@pytest.fixture(scope="module")
def world(tmp_path_factory):
    return World(tmp_path_factory.mktemp("world"))


@pytest.mark.parametrize("number", range(40))
def test_hostile_files_are_read_right_or_refused(world, tmp_path, number):
    rng = np.random.default_rng([1, number])
    make = CHEAP[number % len(CHEAP)]
    kind = files.valid_case if number % 4 == 0 else files.damaged_case
    case = kind(rng, world, tmp_path, make)
    verdict, happened = judge(case, tmp_path)
    assert verdict != BAD, f"{case.kind}: {case.text}: {happened}"


@pytest.mark.slow
def test_a_campaign_of_hostile_inputs_has_no_bad_verdict(world):
    found = [campaign.run_library(0, number, world) for number in range(300)]
    assert len({row["kind"] for row in found}) > 20
    assert [row for row in found if row["verdict"] == BAD] == []


def test_a_case_depends_on_seed_and_number_only(world, tmp_path):
    texts = []
    for folder, seed in (("a", [0, 3]), ("b", [0, 3]), ("c", [1, 3]), ("d", [0, 4])):
        (tmp_path / folder).mkdir()
        case = files.damaged_case(np.random.default_rng(seed), world, tmp_path / folder, files.cloud_reader)
        texts.append((case.text, *(path.read_bytes() for path in (tmp_path / folder).iterdir())))
    assert texts[0] == texts[1] and len(set(texts)) == 3


def test_every_command_is_tried():
    assert {words[0] for words in commands.COMMANDS.values()} | set(commands.UNTRIED) == set(NAMES)


@pytest.mark.parametrize("number", range(12))
def test_hostile_numbers_of_a_simulation_are_refused(tmp_path, monkeypatch, capsys, number):
    """As in a child of the campaign, which asks for a refusal without a file."""
    rng = np.random.default_rng([2, number])
    words, expected = list(commands.COMMANDS["simulate"]), None
    while expected is not ONLY_REFUSED:
        words = list(commands.COMMANDS["simulate"])
        _, expected = commands._hostile_number(rng, words)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("tdf_jax.sim.campaign.run_campaign", lambda *about, **options: pytest.fail("it runs"))
    with pytest.raises(SystemExit) as stop:
        main(words)
    assert stop.value.code == 2 and list(tmp_path.iterdir()) == []
    assert re.search(r"tdf: \S|error|invalid", capsys.readouterr().err)


# The judge


def refuse(text):
    def act():
        raise tdf.InputError(text)

    return act


def warn():
    warnings.warn(tdf.SizeWarning("encode(): large"), stacklevel=1)


def numpy_warning():
    return np.float64(1) / np.float64(0)


MESSAGE = "load_points(): got x; expected y; save it again"


@pytest.mark.parametrize(
    ("act", "expected", "check", "verdict"),
    [
        (lambda: 1, ONLY_RIGHT, lambda result: None, RIGHT),
        (lambda: 1, ONLY_REFUSED, lambda result: None, BAD),
        (lambda: 1, cases.ANY, lambda result: "wrong", BAD),
        (warn, cases.ANY, lambda result: None, WARNED),
        (warn, cases.ANY, lambda result: "wrong, and said so", WARNED),
        (warn, ONLY_RIGHT, lambda result: None, BAD),
        (refuse(MESSAGE), cases.ANY, lambda result: None, REFUSED),
        (refuse(MESSAGE), ONLY_RIGHT, lambda result: None, BAD),
        (refuse("something is wrong; expected another"), cases.ANY, lambda result: None, BAD),
        (refuse("load_points(): it is damaged"), cases.ANY, lambda result: None, BAD),
        (lambda: int("x"), cases.ANY, lambda result: None, BAD),
        (numpy_warning, cases.ANY, lambda result: None, BAD),
    ],
)
def test_the_judge_sees_every_kind_of_end(tmp_path, act, expected, check, verdict):
    assert judge(Case("a", "b", act, check, expected), tmp_path)[0] == verdict


def test_the_judge_sees_what_is_written(tmp_path):
    def refused():
        (tmp_path / "half").write_text("half")
        raise tdf.InputError(MESSAGE)

    assert judge(Case("a", "b", refused, writes=("half",)), tmp_path)[0] == BAD
    assert judge(Case("a", "b", lambda: (tmp_path / "out").write_text("a"), writes=("out",)), tmp_path)[0] == RIGHT
    assert judge(Case("a", "b", lambda: os.unlink(tmp_path / "out")), tmp_path)[0] == BAD


def test_the_judge_stops_what_hangs(tmp_path, monkeypatch):
    monkeypatch.setattr(cases, "patience", lambda: 0.05)
    verdict, happened = judge(Case("a", "b", lambda: time.sleep(30)), tmp_path)
    assert verdict == BAD and "takes more than" in happened


def test_verdicts_are_kept_and_a_rerun_goes_on(tmp_path):
    log = tmp_path / "library.jsonl"
    log.write_text('{"case": 0, "kind": "a", "verdict": "right"}\n{"case": 1, "ki')
    assert [row["case"] for row in campaign.rows(log)] == [0]
    counts = campaign.table([{"kind": "a", "verdict": RIGHT}, {"kind": "b", "verdict": BAD}]).splitlines()
    assert counts[1].split() == ["a", "1", "0", "0", "0", "1"] and counts[-1].split() == [
        "all",
        "1",
        "0",
        "0",
        "1",
        "2",
    ]
