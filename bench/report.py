"""The report of a run as Markdown: times and ratios, rates and memory, targets, and checks."""

from bench.gate import failed_checks
from bench.workers import COMPETITORS
from tdf_jax.evaluation.tables import markdown as table

BUSY = 0.1  # cores; the report notes more work than this by other processes


def markdown(record: dict) -> str:
    """The report of one run.

    Args:
        record: the record, as `bench.__main__` writes it.
    """
    parts = [_heading(record), _times(record), _rates(record), _targets(record), _checks(record)]
    return "\n\n".join(part for part in parts if part) + "\n"


def line(name: str, row: dict) -> str:
    """One row in one line, for the terminal.

    Args:
        name: name of the row.
        row: its entry in the record.
    """
    times = ", ".join(f"{competitor} {_seconds(found)}" for competitor, found in row["competitors"].items())
    ratios = ", ".join(f"{pair} {ratio:.2f}" for pair, ratio in row["ratios"].items())
    return f"{name}: {times}" + (f"; {ratios}" if ratios else "")


def _heading(record):
    machine = record["machine"]
    versions = ", ".join(f"{name} {machine[name]}" for name in ("python", "jax", "jaxlib", "torch", "numpy", "tdf_jax"))
    peaks = ", ".join(f"{rate:.0f} in {COMPETITORS[name].title}" for name, rate in record["matmul_gflops"].items())
    words = [
        "# tdf_jax against PyTorch",
        f"{machine['cpu']}, {machine['cores']} cores, {machine['memory_gigabytes']} GB, {machine['system']}; "
        f"load {machine['load']} at the start. {versions}. Float32 matmul peak, GFLOP/s: {peaks}.",
        "All competitors have the same weights and inputs and alternate in one run, each in a process of its own. "
        "Times are medians (least to most) after a first call that warms up; ratios are of medians (and of least "
        "times). (a) PyTorch as NDF's users run it: weights record gradients, and the standard allocator is used. "
        "(b) PyTorch tuned by an expert: no gradients for weights that are not trained, one thread for each core, a "
        "setting of glibc that keeps freed memory, and a fixed pose that is evaluated once. (c) tdf_jax on the same "
        "processors. All encode before the first step, as NDF does; times to a target begin after that.",
    ]
    if record["quick"]:
        words.insert(1, "**Quick run: sizes that test the machinery; the times mean nothing.**")
    return "\n\n".join(words)


def _times(record):
    pairs = list(dict.fromkeys(pair for row in record["rows"].values() for pair in row["ratios"]))
    names = [name for name in COMPETITORS if any(name in row["competitors"] for row in record["rows"].values())]
    heads = (f"{COMPETITORS[name].mark} {COMPETITORS[name].title}" for name in names)
    ratios = (" / ".join(COMPETITORS[name].mark for name in pair.split(" / ")) for pair in pairs)
    rows, notes = [], []
    for row in record["rows"].values():
        cells, others = [], max((found["others_cores"] for found in row["competitors"].values()), default=0.0)
        for name in names:
            found = row["competitors"].get(name)
            cells.append(("failed" if name in row["errors"] else "") if found is None else _seconds(found))
            if found and found["note"]:
                notes.append(f"- {row['title']}, {COMPETITORS[name].mark}: {found['note']}.")
        if others > BUSY and not record["quick"]:
            notes.append(
                f"- {row['title']}: other processes used up to {others:.1f} cores meanwhile; measure again on an idle "
                "machine."
            )
        rows.append([row["title"], *cells, *(_ratio(row, pair) for pair in pairs)])
    parts = ["## Times", table(["seconds", *heads, *ratios], rows), "\n".join(notes)]
    return "\n\n".join(part for part in parts if part)


def _rates(record):
    best = max(record["matmul_gflops"].values())
    heads = ["row", "competitor", "GFLOP/s", "of the matmul peak", "peak memory, MB", "before the row, MB"]
    rows = []
    for row in record["rows"].values():
        for name, found in row["competitors"].items():
            compiling = "" if found["compile_seconds"] is None else f"{found['compile_seconds']:.1f}"
            rate = (
                ("", "")
                if found["gflops"] is None
                else (f"{found['gflops']:.1f}", f"{100 * found['gflops'] / best:.0f} %")
            )
            memory = f"{found['peak_megabytes']:.0f}", f"{found['base_megabytes']:.0f}"
            rows.append([row["title"], COMPETITORS[name].mark, *rate, *memory, compiling])
    words = (
        "Operations are those of the leanest known form of the task, the same for all (bench/flops.py); an answer that "
        "takes fewer may have a rate above the peak. Memory is the resident set of the process, its libraries and "
        "inputs included."
    )
    return "\n\n".join(["## Rates and memory", words, table([*heads, "compiling, s"], rows)])


def _targets(record):
    lines = []
    for row in record["rows"].values():
        facts = row["facts"]
        if "target" not in facts:
            continue
        reached = ", ".join(
            f"{COMPETITORS[name].title} {energy:.6f}"
            for name, energy in facts["energies"].items()
            if name != "torch_tuned"
        )
        below = facts.get("tdf_jax_steps")
        passed = "" if below is None else f"; (c)'s steps passed the target after {below}"
        lines.append(
            f"- {row['title']}: target {facts['target']:.6f}, the best of PyTorch's starts; reached: "
            f"{reached or 'nothing'}{passed}."
        )
    return "## Targets\n\n" + "\n".join(lines) if lines else ""


def _checks(record):
    everything = [("parity", one) for one in record["parity"]]
    everything += [(row["title"], one) for row in record["rows"].values() for one in row["checks"]]
    failures = failed_checks(record)
    words = f"{sum(one['passed'] for _, one in everything)} of {len(everything)} checks passed."
    rows = [[title, one["what"], f"{one['error']:.1e}", f"{one['tolerance']:.0e}"] for title, one in everything]
    checks = table(["row", "check", "error", "tolerance"], rows)
    return "\n\n".join(["## Correctness", words, *(f"- **{failure}**" for failure in failures), checks])


def _seconds(found):
    seconds = found["seconds"]
    if len(seconds["all"]) == 1:
        return f"{seconds['median']:.3g} (once)"
    return f"{seconds['median']:.3g} ({seconds['least']:.3g} to {seconds['most']:.3g})"


def _ratio(row, pair):
    return f"{row['ratios'][pair]:.2f} ({row['ratios_of_least'][pair]:.2f})" if pair in row["ratios"] else ""
