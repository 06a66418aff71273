"""The map of the documentation names code that exists, with its current numbers, and lists all public names."""

import ast
import dataclasses
import importlib
import inspect
import re
from pathlib import Path

import pytest

import tdf_jax
from tdf_jax.cli.main import COMMANDS

ROOT = Path(__file__).parent.parent
ROWS = [
    [cell.strip() for cell in line.strip("|").split(" |")]
    for line in (ROOT / "docs" / "map.md").read_text().splitlines()
    if line.endswith(".py` |")
]
NAMES = (ROOT / "docs" / "api" / "names.md").read_text()


def resolved(file: str, name: str):
    """What a dotted name means in a file; the last part may be a field without a default, or a parameter's default."""
    found = importlib.import_module(file.removesuffix(".py").replace("/", "."))
    for part in name.split("."):
        if hasattr(found, part):
            found = getattr(found, part)
        elif dataclasses.is_dataclass(found):
            (found,) = (field for field in dataclasses.fields(found) if field.name == part)
        else:
            found = inspect.signature(found).parameters[part].default
    return found


@pytest.mark.parametrize("row", ROWS, ids=lambda row: row[0])
def test_a_row_names_code_that_exists(row):
    *_, name, file = (cell.strip("`") for cell in row)
    assert (ROOT / file).is_file()
    found = resolved(file, name)
    if len(row) == 4 and row[1]:
        assert found == ast.literal_eval(row[1])


def test_there_are_rows():
    assert len(ROWS) > 100


def test_every_command_has_a_row():
    assert {f"`tdf {name}`" for name in COMMANDS} <= {row[0] for row in ROWS}


def test_the_public_names_are_listed_once():
    listed = re.findall(r"^\| `(\w+)` \|", NAMES, re.MULTILINE)
    assert sorted(listed) == sorted(tdf_jax.__all__)
