"""Every public name and its signature, against the list in public_names.txt.

`python tests/test_public_names.py` writes the file anew.
"""

import dataclasses
import inspect
from pathlib import Path

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


def test_names_of_the_release_before_have_stayed():
    for name in (
        "imitate",
        "encode",
        "describe",
        "refine",
        "solve",
        "optimize",
        "carry",
        "thin",
        "turns",
        "rotation_grid",
    ):
        assert callable(getattr(tdf, name))


if __name__ == "__main__":
    LIST.write_text(listed())
