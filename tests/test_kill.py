"""Commands that are killed at random moments go on, and end with what an undisturbed run gives."""

import dataclasses
import json

import kill
import numpy as np
import pytest
from conftest import quick_environment

# A shorter run of each command than a campaign by hand has: most of the time of a process is its start.
SHORT = {"40": "12", "--steps=300": "--steps=60", "--validate-every=150": "--validate-every=60"}


@pytest.mark.slow
def test_killed_commands_lose_nothing_and_end_as_undisturbed_ones(tmp_path, monkeypatch):
    names = ("dataset", "train")
    for name in names:
        words = tuple(SHORT.get(word, word) for word in kill.COMMANDS[name].words)
        assert words != kill.COMMANDS[name].words
        monkeypatch.setitem(kill.COMMANDS, name, dataclasses.replace(kill.COMMANDS[name], words=words))
    for variable, value in quick_environment().items():
        monkeypatch.setenv(variable, value)
    records = kill.campaign(tmp_path, kills=3, seed=3, commands=names)  # two in the first run-through
    assert [record["problems"] for record in records] == [[]] * len(records)
    assert {record["command"] for record in records} == set(names)
    assert sum(len(record["kills"]) for record in records) >= 3
    assert any(kill["parts"] for record in records for kill in record["kills"])
    assert kill.campaign(tmp_path, kills=3, seed=3, commands=names) == records  # which are kept


def test_half_written_files_are_found(tmp_path):
    np.savez(tmp_path / "whole.npz", a=np.arange(1000))
    content = (tmp_path / "whole.npz").read_bytes()
    assert kill.broken(tmp_path) == []
    for name in ("half.npz", ".half.npz.0123456789abcdef.unfinished"):
        (tmp_path / name).write_bytes(content[:500])
    (tmp_path / "half.json").write_text('{"a": ')
    found = sorted(problem.partition(" ")[0] for problem in kill.broken(tmp_path))
    assert found == ["half.json", "half.npz"]


def test_what_differs_but_for_times_is_found(tmp_path):
    for name, loss, seconds in (("a", 1, 2), ("b", 1, 3), ("c", 2, 2)):
        (tmp_path / name).mkdir()
        (tmp_path / name / "result.json").write_text(json.dumps({"loss": loss, "at": {"seconds": seconds}}))
        np.savez(tmp_path / name / "run.npz", loss=loss, seconds=seconds)
    (tmp_path / "b" / "more").write_text("")
    a, b, c = (kill.content(tmp_path / name) for name in "abc")
    assert kill.differences(a, b) == ["more is too much"] and kill.differences(b, a) == ["more is missing"]
    assert kill.differences(a, c) == ["result.json differs", "run.npz differs"]


def test_parts_that_are_lost_or_computed_again_are_found(tmp_path):
    assert kill.lost({"a": 1, "b": 1, "c": 1}, {"b": 2, "c": 1, "d": 1}) == ["a is lost", "b was computed again"]
    assert kill.lost({"a": 1}, None) == []
