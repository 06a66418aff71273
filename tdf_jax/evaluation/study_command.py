"""The command line that the studies of this package and of `tdf_jax.sim` have in common."""

import argparse
from collections.abc import Callable
from pathlib import Path


def study_parser(
    module: str, docstring: str | None, counted: str, default: int, number: str, seed: str
) -> argparse.ArgumentParser:
    """A parser of the words of a study: how many of what are measured, and the seed.

    Args:
        module: name of the module, which `python -m` runs.
        docstring: its docstring, whose first line describes it.
        counted: what is measured, the name of an option without its dashes.
        default: how many are measured by default.
        number: what the number is, in words.
        seed: what the seed is of, in words.
    """
    parser = argparse.ArgumentParser(prog=f"python -m {module}", description=(docstring or "").partition("\n")[0])
    parser.add_argument(f"--{counted}", type=at_least(1), default=default, help=f"{number} (default: {default})")
    parser.add_argument("--seed", type=at_least(0), default=0, help=f"seed of {seed} (default: 0)")
    return parser


def at_least(least: int) -> Callable[[str], int]:
    """A type of `argparse`: a whole number that is not too small.

    Args:
        least: the smallest number.
    """

    def whole(text: str) -> int:
        value = int(text)
        if value < least:
            raise argparse.ArgumentTypeError(f"{value} is given; expected at least {least}")
        return value

    whole.__name__ = "whole number"  # in the message for what is none
    return whole


def file_to_write(text: str) -> Path:
    """A type of `argparse`: a file in an existing folder, which is said before the work and not after it."""
    path = Path(text)
    if path.is_dir() or not path.parent.is_dir():
        raise argparse.ArgumentTypeError(f"{path} is given; expected a file in an existing folder")
    return path
