"""The tables of docs/results/simulation.md, written anew from the records beside it.

python docs/simulation_tables.py

The records are what `tdf benchmark --simulation` writes. Each table stands between two comments of the page, the first
of which names it; everything else on the page is prose.
"""

import json
import re
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np

from tdf_jax.evaluation.tables import between, markdown, percent, success_rate
from tdf_jax.sim.report import PARTS, WORDS

RESULTS = Path(__file__).resolve().parent / "results"
PAGE = RESULTS / "simulation.md"
FOUND = ("mugs_found", "bowls_found", "bottles_found")
OTHER_METHODS = (
    ("upright", ("other_methods", "even_blending_and_paper")),
    ("tilt60", ("other_methods_tilt60", "even_blending_and_paper_tilt60")),
)
SUCCESS = ("grasp", "place", "overall")


def rows_of(*records: str) -> Iterator[tuple[dict, list]]:
    """The rows of some records, and the seconds of their episodes.

    Args:
        records: names of the records.
    """
    for record in records:
        found = json.loads((RESULTS / "simulation" / f"{record}.json").read_text())
        yield from zip(found["rows"], found["seconds"], strict=True)


def drawn(row: dict) -> list[dict]:
    """The episodes of a row that were drawn."""
    return [one for one in row["episodes"] if one["cause"] != "not drawn"]


def words(row: dict, *names: str) -> list[str]:
    """Names of a row's condition, in words."""
    return [str(row["condition"][name]).replace("_", " ") for name in names]


def rate(found: dict) -> str:
    """A rate with its interval."""
    return percent(found["rate"]) + between(found["interval"])


def rates(*records: str, beside: bool = True) -> str:
    """How often the grasp, the place and both succeed, beside published rates or without them."""
    rows = [row for row, _ in rows_of(*records)]
    by_handle = any(row["condition"]["task"] == "mug_on_rack" for row in rows)
    systems = list(dict.fromkeys(one["system"] for row in rows for one in row["published"] if beside))
    heads = ["task", "mode", "poses", "episodes", *SUCCESS, *["hung by the handle"] * by_handle]
    cells = []
    for row in rows:
        cell = [*words(row, "task", "mode", "poses"), str(len(drawn(row)))]
        cell += [rate(row["rates"][name]) for name in SUCCESS]
        if by_handle:
            cell.append(rate(row["rates"]["strict"]) if row["condition"]["task"] == "mug_on_rack" else "")
        cells.append([*cell, *(published(row, system) for system in systems)])
    found = {"R-NDF": "place"}
    return markdown([*heads, *(f"{system}: {found.get(system, 'overall')}" for system in systems)], cells)


def published(row: dict, system: str) -> str:
    """The published rate of a system, and in brackets that of one demonstration."""
    known = {}
    for one in row["published"]:
        if one["system"] == system:
            known[one["demonstrations"]] = one["place" if one["overall"] is None else "overall"]
    if not known:
        return ""
    most = max(known)
    return f"{100 * known[most]:g} %" + (f" (one: {100 * known[1]:g} %)" if 1 in known and most > 1 else "")


def other_methods() -> str:
    """Success of other methods, and of the library on the same episodes."""
    cells = []
    for poses, records in OTHER_METHODS:
        others = [row for row, _ in rows_of(*records)]
        library = {(row["condition"]["task"], row["condition"]["mode"]): row for row, _ in rows_of("known")
                   if row["condition"]["poses"] == poses}  # fmt: skip
        for (task, mode), row in library.items():
            same = [one for one in others if (one["condition"]["task"], one["condition"]["mode"]) == (task, mode)]
            most = max(len(drawn(one)) for one in same)
            for one in (row, *same):
                episodes = drawn(one)[:most]
                name = one["condition"]["method"]
                cells.append(
                    [
                        *words(row, "task", "mode", "poses"),
                        f"**{name}**" if one is row else "the paper's energy" if name == "paper" else name,
                        str(len(episodes)),
                        *(success_rate([episode[which] for episode in episodes]) for which in SUCCESS),
                    ]
                )
    return markdown(["task", "mode", "poses", "method", "episodes", *SUCCESS], cells)


def criteria() -> str:
    """How often each criterion of the place holds."""
    cells = []
    for row, _ in rows_of("known", *FOUND, "real"):
        of = row["place_criteria"]
        cells.append(
            [*words(row, "task", "mode", "target"), poses_of(row), *(rate(of[n]) if n in of else "" for n in WORDS)]
        )
    return markdown(["task", "mode", "target", "poses", *WORDS.values()], cells)


def poses_of(row: dict) -> str:
    """How the object starts, and whether it is real."""
    return row["condition"]["poses"] + (", real" if row["condition"]["objects"] == "meshes" else "")


def failures() -> str:
    """The causes of failure, how far objects moved in the hand, and how many draws were rejected."""
    cells = []
    others = [record for _, records in OTHER_METHODS for record in records]
    for row, _ in rows_of("known", *FOUND, "real", *others):
        moved = row["moved_in_hand_median"]
        cells.append(
            [
                *words(row, "task", "mode", "target"),
                poses_of(row),
                row["condition"]["method"],
                f"{sum(row['causes'].values())} of {len(drawn(row))}",
                ", ".join(f"{cause} {count}" for cause, count in row["causes"].items()),
                "" if moved is None else f"{1e3 * moved['metres']:.1f} mm, {moved['degrees']:.1f}°",
                str(row["rejected"]),
                str(row["redrawn"]),
            ]
        )
    heads = ["task", "mode", "target", "poses", "method", "failed", "causes", "moved in the hand"]
    return markdown([*heads, "starts rejected", "pairs rejected"], cells)


def times() -> str:
    """Median seconds of the parts of an episode, and minutes of a row."""
    cells = []
    for row, seconds in rows_of("known"):
        parts = np.array(seconds["episodes"], float)
        medians = [f"{value:.1f}" for value in np.median(parts, axis=0)]
        cells.append([*words(row, "task", "mode", "poses"), *medians, f"{parts.sum() / 60:.1f}"])
    return markdown(["task", "mode", "poses", *PARTS, "all episodes, minutes"], cells)


TABLES: dict[str, Callable[[], str]] = {
    "known targets": lambda: rates("known"),
    "found targets": lambda: rates(*FOUND),
    "real objects": lambda: rates("real", beside=False),
    "true picks and releases": lambda: rates("truth", beside=False),
    "other methods": other_methods,
    "criteria": criteria,
    "failures": failures,
    "times": times,
}


def with_tables(page: str) -> str:
    """The page with every table written anew.

    Args:
        page: text of the page, with each of `TABLES` between `<!-- table: NAME -->` and `<!-- end of table -->`.
    """
    for name, table in TABLES.items():
        begin, end = f"<!-- table: {name} -->", "<!-- end of table -->"
        pattern = re.compile(f"{re.escape(begin)}\n.*?{re.escape(end)}", re.DOTALL)
        found = pattern.findall(page)
        if len(found) != 1:
            raise SystemExit(f"{PAGE.name}: expected one table {name!r} between its comments")
        page = page.replace(found[0], f"{begin}\n\n{table().strip()}\n\n{end}")
    return page


if __name__ == "__main__":
    PAGE.write_text(with_tables(PAGE.read_text()))
