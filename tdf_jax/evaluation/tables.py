"""Tables of results, as Markdown and as aligned text, and the numbers in their cells."""

from collections.abc import Iterable, Sequence

import numpy as np

from tdf_jax.evaluation.statistics import bootstrap_interval


def markdown(heads: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """A Markdown table.

    Args:
        heads: titles of the columns.
        rows: cells of every row, as many as there are columns.
    """
    lines = [_line(heads), "|" + "---|" * len(heads), *(_line(row) for row in rows)]
    return "\n".join(lines)


def aligned(rows: Sequence[Sequence[str]], words: int = 2) -> str:
    """A table for the terminal, with columns of equal width.

    Args:
        rows: cells of every row, titles included.
        words: number of first columns that are aligned left; the others hold numbers and are aligned right.
    """
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    return "\n".join(
        "  ".join(
            cell.ljust(width) if index < words else cell.rjust(width)
            for index, (cell, width) in enumerate(zip(row, widths))
        ).rstrip()
        for row in rows
    )


def percent(share: float | None) -> str:
    """A share as a percentage; "n/a" for None."""
    return "n/a" if share is None else f"{100 * share:.0f} %"


def between(interval: Sequence[float] | None, factor: float = 100.0, digits: int = 0, missing: str = "") -> str:
    """An interval in brackets, with a space before it.

    Args:
        interval: the lower and the upper end, or None.
        factor: what both ends are multiplied by.
        digits: number of digits after the point.
        missing: the words for None.
    """
    if interval is None:
        return missing
    low, high = (factor * end for end in interval)
    return f" ({low:.{digits}f} to {high:.{digits}f})"


def success_rate(successes: Sequence[bool]) -> str:
    """A success rate with its 95 % bootstrap interval.

    Args:
        successes: whether each case succeeded, of an object of its own; at least one.
    """
    values = np.array(successes, float)
    return percent(float(values.mean())) + between(bootstrap_interval(values, range(len(values))))


def _line(cells: Sequence[str]) -> str:
    return f"| {' | '.join(cells)} |"
