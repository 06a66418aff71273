"""Every public name and its signature, against the list in public_names.txt and those of the release before.

`python tests/test_public_names.py` writes the file anew. `public_names_0_1.txt` is what 0.1.0 had; a class there also
has its methods and properties, each after a dot.
"""

import dataclasses
import inspect
import re
import warnings
from pathlib import Path

import pytest

import tdf_jax as tdf

LIST = Path(__file__).parent / "public_names.txt"


def described(name: str) -> str:
    """One line: a function with the names and kinds of its arguments, a class with its fields."""
    value = getattr(tdf, name)
    if inspect.isclass(value):
        fields = ", ".join(field.name for field in dataclasses.fields(value)) if dataclasses.is_dataclass(value) else ""
        return f"{name}: class({fields})"
    parameters = inspect.signature(value).parameters.values()
    bare = [one.replace(annotation=inspect.Parameter.empty) for one in parameters]
    defaults = [one if one.default in (inspect.Parameter.empty, None) else one.replace(default=...) for one in bare]
    return f"{name}{inspect.Signature(defaults)}".replace("Ellipsis", "...")


def listed() -> str:
    names = [name for name in tdf.__all__ if not inspect.ismodule(getattr(tdf, name))]
    return "".join(f"{described(name)}\n" for name in sorted(names))


def test_public_names_are_those_of_the_list():
    assert listed() == LIST.read_text()


def lines_of(release: str) -> list[str]:
    return (LIST.parent / f"public_names_{release}.txt").read_text().splitlines()


def refuses_as_unknown(function, keyword: str) -> bool:
    """Whether a keyword is none that the function takes, under a new name or as a deprecated one."""
    if keyword in inspect.signature(function).parameters:
        return False
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)
        try:
            function(**{keyword: ()})
        except (TypeError, tdf.InputError) as refused:
            return "unexpected keyword" in str(refused)
    return False


@pytest.mark.parametrize("line", [line for line in lines_of("0_1") if ": class" not in line])
def test_functions_of_0_1_are_called_as_before(line):
    """By position and by keyword; new arguments have defaults, and those that were optional still are."""
    name, _, rest = line.partition("(")
    before = inspect.signature(eval(f"lambda {rest.removesuffix(')')}: None")).parameters
    function = getattr(tdf, name)
    now = inspect.signature(function).parameters
    by_position = [[one for one in names.values() if one.kind is one.POSITIONAL_OR_KEYWORD] for names in (before, now)]
    assert len(by_position[0]) <= len(by_position[1])
    for old, new in zip(*by_position):
        assert new.name == old.name or not refuses_as_unknown(function, old.name)
        assert old.default is old.empty or new.default is not new.empty
    named = [one.name for one in before.values() if one.kind is one.KEYWORD_ONLY]
    assert [keyword for keyword in named if refuses_as_unknown(function, keyword)] == []
    required = [one.name for one in now.values() if one.default is one.empty and one.kind is not one.VAR_KEYWORD]
    assert len(required) <= sum(one.default is one.empty for one in before.values())


@pytest.mark.parametrize("line", [line for line in lines_of("0_1") if ": class" in line])
def test_classes_of_0_1_have_their_fields_and_attributes(line):
    name, fields, attributes = re.fullmatch(r"(\w+): class\((.*?)\)(.*)", line).groups()
    cls, fields = getattr(tdf, name), [field for field in fields.split(", ") if field]
    now = {field.name for field in dataclasses.fields(cls)} if dataclasses.is_dataclass(cls) else set()
    for attribute in fields + re.findall(r"\.(\w+)", attributes):
        assert attribute in now or hasattr(cls, attribute), attribute
    assert [field for field in fields if refuses_as_unknown(cls, field)] == []


if __name__ == "__main__":
    LIST.write_text(listed())
