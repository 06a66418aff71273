"""Comparison of a run with the committed baseline: correctness, and ratios within a wide margin."""

import json
from pathlib import Path

from tdf_jax._internal.errors import InputError

LEAST = 0.6  # smallest ratio, as a share of the baseline's; runs of one machine differ under load


def failed_checks(record: dict) -> list[str]:
    """All checks and competitors that failed, in words.

    Args:
        record: record of the run.
    """
    named = [("parity", one) for one in record["parity"]]
    named += [(name, one) for name, row in record["rows"].items() for one in row["checks"]]
    failures = [
        f"{name}: {one['what']} is {one['error']:.1e}; expected at most {one['tolerance']:.1e}"
        for name, one in named
        if not one["passed"]
    ]
    for name, row in record["rows"].items():
        failures += [
            f"{name}: {competitor} failed: {error.strip().splitlines()[-1]}"
            for competitor, error in row["errors"].items()
        ]
    return failures


def lost_ratios(record: dict, baseline: dict) -> tuple[list[str], list[str]]:
    """Ratios that are missing or below `LEAST` of the baseline's, and rows that could not be compared, in words.

    Rows are compared if both runs have them at the same sizes.

    Args:
        record: record of the run.
        baseline: record of the baseline.
    """
    lost, apart = [], []
    for name, row in record["rows"].items():
        before = baseline["rows"].get(name)
        if before is None or before["sizes"] != row["sizes"]:
            apart.append(f"{name}: not in the baseline at these sizes")
            continue
        for pair, expected in before["ratios"].items():
            found = row["ratios"].get(pair)
            if found is None:
                lost.append(f"{name}: no ratio {pair}; the baseline's is {expected:.2f}")
            elif found < LEAST * expected:
                lost.append(
                    f"{name}: {pair} is {found:.2f}, {found / expected:.2f} of the baseline's {expected:.2f}; expected "
                    f"{LEAST} of it"
                )
    return lost, apart


def read(path: str | Path) -> dict:
    """Read a record.

    Args:
        path: the file.

    Raises:
        InputError: the file is missing or is no record.
    """
    try:
        record = json.loads(Path(path).read_text())
    except (OSError, ValueError) as error:
        raise InputError(
            f"bench: cannot read the baseline {path} ({error}); expected a bench.json, such as --out writes"
        ) from None
    if not isinstance(record, dict) or not isinstance(record.get("rows"), dict):
        raise InputError(f"bench: {path} has no rows; expected a bench.json, such as --out writes")
    return record
