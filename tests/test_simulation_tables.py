"""The tables of the page of simulations are those of its records."""

import importlib.util
import json
import shutil
from pathlib import Path

import pytest

DOCS = Path(__file__).parent.parent / "docs"


@pytest.fixture
def tables(tmp_path, monkeypatch):
    """The module, with copies of the page and of its records."""
    spec = importlib.util.spec_from_file_location("simulation_tables", DOCS / "simulation_tables.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    (tmp_path / "simulation").mkdir()
    for record in (DOCS / "results" / "simulation").glob("*.json"):
        shutil.copy(record, tmp_path / "simulation")
    monkeypatch.setattr(module, "RESULTS", tmp_path)
    return module


def test_the_tables_are_those_of_the_records(tables):
    page = tables.PAGE.read_text()
    assert tables.with_tables(page) == page


def test_an_episode_that_ends_otherwise_changes_the_tables(tables):
    page = tables.PAGE.read_text()
    path = tables.RESULTS / "simulation" / "known.json"
    record = json.loads(path.read_text())
    row = record["rows"][0]
    row["episodes"][0]["overall"] = False
    row["rates"]["overall"] = {"rate": 0.99, "interval": [0.97, 1.0]}
    path.write_text(json.dumps(record))
    changed = set(tables.with_tables(page).splitlines()) - set(page.splitlines())
    assert any(line.startswith("| mug on rack | teleport | upright | 100 |") and "99 %" in line for line in changed)
    assert any("**tdf_jax**" in line and "97 %" in line for line in changed)  # of the first 30


def test_a_page_without_a_table_is_refused(tables):
    with pytest.raises(SystemExit, match="expected one table 'known targets' between its comments"):
        tables.with_tables("# Simulation")


def test_records_say_what_their_episodes_say(tables):
    for path in (tables.RESULTS / "simulation").glob("*.json"):
        for row in json.loads(path.read_text())["rows"]:
            episodes = tables.drawn(row)
            for name in (*tables.SUCCESS, "strict"):
                share = sum(one[name] for one in episodes) / len(episodes)
                assert row["rates"][name]["rate"] == pytest.approx(share)
            assert sum(row["causes"].values()) == sum(bool(one["cause"]) for one in episodes)
