"""Tables and the header of records, which all evaluations share."""

import json

import pytest

import tdf_jax as tdf
from tdf_jax._internal.errors import InputError
from tdf_jax.evaluation.records import SCHEMA, header, write_record
from tdf_jax.evaluation.tables import aligned, between, markdown, percent, success_rate


def test_markdown_has_a_line_for_the_heads_a_rule_and_a_line_for_each_row():
    assert markdown(["a", "b"], [("1", "2"), ("3", "4")]).splitlines() == [
        "| a | b |",
        "|---|---|",
        "| 1 | 2 |",
        "| 3 | 4 |",
    ]


def test_words_are_aligned_left_and_numbers_right():
    assert aligned([["method", "n"], ["copy", "10"], ["", "5"]], words=1).splitlines() == [
        "method   n",
        "copy    10",
        "         5",
    ]


def test_a_success_rate_has_its_interval_unless_there_is_one_case():
    assert success_rate([True, False]) == "50 % (0 to 100)"
    assert success_rate([True]) == "100 %"


def test_shares_and_intervals_are_percentages():
    assert percent(0.125) == "12 %" and percent(None) == "n/a"
    assert between([0.25, 1.0]) == " (25 to 100)" and between([1.234, 2.0], 1, 2) == " (1.23 to 2.00)"
    assert between(None) == "" and between(None, missing=" (n/a)") == " (n/a)"


def test_records_begin_with_the_same_keys(small_model, tmp_path):
    record = header({"seed": 1}, small_model)
    assert list(record) == ["schema", "tdf_jax", "settings", "weights", "machine"]
    assert (record["schema"], record["tdf_jax"]) == (SCHEMA, tdf.__version__)
    write_record("a test", tmp_path / "record.json", record | {"rows": []})
    assert json.loads((tmp_path / "record.json").read_text()) == record | {"rows": []}
    with pytest.raises(InputError, match="a test"):
        write_record("a test", tmp_path / "none" / "record.json", record)
