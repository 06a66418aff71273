"""Runs cases one after the other, judges them, keeps the verdicts, and goes on where it was interrupted."""

import argparse
import collections
import faulthandler
import json
import os
import resource
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np

from . import arguments, commands, fields, files
from .cases import BAD, VERDICTS, Case, judge, patience
from .undamaged import World

Maker = Callable[[np.random.Generator, World, Path], Case]
# Shares of the cases inside of the process.
LIBRARY: dict[str, tuple[float, Maker]] = {
    "files": (0.6, files.file_case),
    "arguments": (0.25, arguments.argument_case),
    "fields": (0.15, fields.field_case),
}
MEMORY = 12 * 2**30  # bytes that the process may take for data: a wrong number of rows must not take the machine's


def library_case(seed: int, number: int, world: World, folder: Path) -> Case:
    """The case of a number; it depends on the seed and the number only."""
    rng = np.random.default_rng([seed, number])
    shares = np.cumsum([share for share, _ in LIBRARY.values()])
    makers = [maker for _, maker in LIBRARY.values()]
    return makers[int(np.searchsorted(shares, rng.random() * shares[-1]))](rng, world, folder)


def run_library(seed: int, number: int, world: World) -> dict:
    """Make and judge a case in a new folder."""
    return _judged(number, world, lambda folder: library_case(seed, number, world, folder), judge)


def run_command(seed: int, number: int, world: World) -> dict:
    """Make and judge a case of the command line, in a new folder."""
    rng = np.random.default_rng([seed, number, 1])
    return _judged(number, world, lambda folder: commands.command_case(rng, world, folder), commands.judge_command)


def _judged(number: int, world: World, make: Callable, judge_case: Callable) -> dict:
    folder = Path(tempfile.mkdtemp(prefix="case-", dir=world.folder))
    began = time.perf_counter()
    try:
        case = make(folder)
        verdict, happened = judge_case(case, folder)
    finally:
        shutil.rmtree(folder, ignore_errors=True)
    seconds = round(time.perf_counter() - began, 3)
    happened = happened.replace(str(folder), "FOLDER")
    return {"case": number, "kind": case.kind, "text": case.text, "verdict": verdict, "happened": happened,
    "seconds": seconds}  # fmt: skip


RUNS = {"library": run_library, "commands": run_command}


# One process works, another watches it, because some calls never come back, or end the process.


def _work(out: Path, part: str, seed: int, stop: int) -> None:
    """Run the cases that have no verdict yet."""
    resource.setrlimit(resource.RLIMIT_DATA, (MEMORY, resource.getrlimit(resource.RLIMIT_DATA)[1]))
    world = World(out / "world")
    log, current = out / f"{part}.jsonl", out / f"{part}.current"
    done = {row["case"] for row in rows(log)}
    with log.open("a") as file:
        for number in range(stop):
            if number in done:
                continue
            current.write_text(str(number))
            # More than a case may take: the first ones of a kind make the undamaged objects, too.
            faulthandler.dump_traceback_later(3 * patience(), exit=True)
            row = RUNS[part](seed, number, world)
            faulthandler.cancel_dump_traceback_later()
            file.write(json.dumps(row) + "\n")
            file.flush()
            if row["verdict"] == BAD:
                print(f"{part} {number} {row['kind']}: {row['text']}\n  {_last(row['happened'])}", flush=True)
    current.unlink(missing_ok=True)


def rows(log: Path) -> list[dict]:
    """Verdicts in a file, without a line that was cut short."""
    found = []
    for line in log.read_text().splitlines() if log.exists() else []:
        try:
            found.append(json.loads(line))
        except ValueError:
            continue
    return found


def _watch(out: Path, part: str, seed: int, stop: int) -> None:
    """Run a worker until all cases have a verdict; a case that ends its process is bad."""
    log, current = out / f"{part}.jsonl", out / f"{part}.current"
    while len({row["case"] for row in rows(log)} & set(range(stop))) < stop:
        current.unlink(missing_ok=True)
        environment = os.environ | {
            "JAX_COMPILATION_CACHE_DIR": str(out / "compiled"), "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0",
            "JAX_PERSISTENT_CACHE_MIN_ENTRY_SIZE_BYTES": "0",
        }  # fmt: skip
        words = [sys.executable, "-m", "tests.fuzz", "--worker", part, "--out", str(out), "--seed", str(seed)]
        done = subprocess.run([*words, "--cases", str(stop)], env=environment, cwd=Path(__file__).parents[2])
        if done.returncode and not current.exists():
            raise SystemExit(f"the worker ended with {done.returncode}")
        if current.exists():
            number = int(current.read_text())
            text = f"the process ended with {done.returncode}, after a hang or a crash"
            row = {"case": number, "kind": "?", "text": text, "verdict": BAD, "happened": text, "seconds": 0}
            with log.open("a") as file:
                file.write("\n" + json.dumps(row) + "\n")


def table(found: list[dict]) -> str:
    """Numbers of cases by kind and verdict."""
    counts = collections.Counter((row["kind"], row["verdict"]) for row in found)
    kinds = sorted({row["kind"] for row in found})
    lines = [f"{'kind':<24}" + "".join(f"{verdict:>9}" for verdict in VERDICTS) + f"{'all':>9}"]
    for kind in [*kinds, "all"]:
        numbers = [
            sum(n for (k, v), n in counts.items() if v == verdict and kind in (k, "all")) for verdict in VERDICTS
        ]
        lines.append(f"{kind:<24}" + "".join(f"{number:>9}" for number in [*numbers, sum(numbers)]))
    return "\n".join(lines)


def _last(text: str) -> str:
    lines = text.strip().splitlines()
    return " | ".join(lines[-3:])[-400:] if lines else ""


def _only(arguments, world: World) -> Iterator[dict]:
    """Cases of one kind, or one case."""
    run, numbers = RUNS[arguments.worker or "library"], range(10**9)
    if arguments.case is not None:
        yield run(arguments.seed, arguments.case, world)
        return
    wanted = 0
    for number in numbers:
        if wanted == arguments.cases:
            return
        folder = Path(tempfile.mkdtemp(prefix="case-", dir=world.folder))
        kind = library_case(arguments.seed, number, world, folder).kind
        shutil.rmtree(folder)
        if kind.startswith(arguments.only):
            wanted += 1
            yield run(arguments.seed, number, world)


def main() -> int:
    """Run the campaign that the command line describes; 1 if a case is bad."""
    parser = argparse.ArgumentParser("python -m tests.fuzz", description="Hostile inputs, and what the library does.")
    parser.add_argument("--cases", type=int, default=500, help="cases inside of the process")
    parser.add_argument("--commands", type=int, default=None, help="cases of the command line; by default 3 in 100")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path, default=Path("runs/fuzz"), help="folder of the verdicts; a rerun goes on")
    parser.add_argument("--again", action="store_true", help="forget bad verdicts, and try these cases again")
    parser.add_argument("--only", help="beginning of the kind of cases to run, in this process")
    parser.add_argument("--case", type=int, help="run this case only, and print what happened")
    parser.add_argument("--worker", choices=RUNS, help="with --case: which cases the number is of")
    given = parser.parse_args()
    out = given.out.resolve()
    out.mkdir(parents=True, exist_ok=True)
    if given.only is not None or given.case is not None:
        found = []
        for row in _only(given, World(out / "world")):
            found.append(row)
            if row["verdict"] == BAD or given.case is not None:
                print(f"{row['case']} {row['kind']}: {row['text']}: {row['verdict']}\n{row['happened']}\n")
        print(table(found))
        return int(any(row["verdict"] == BAD for row in found))
    if given.worker:
        _work(out, given.worker, given.seed, given.cases)
        return 0
    settings = {"seed": given.seed}
    if (out / "settings.json").exists() and json.loads((out / "settings.json").read_text()) != settings:
        raise SystemExit(f"{out} holds a campaign with another seed; choose another --out")
    (out / "settings.json").write_text(json.dumps(settings))
    for log in out.glob("*.jsonl") if given.again else ():
        kept = [row for row in rows(log) if row["verdict"] != BAD]
        log.write_text("".join(json.dumps(row) + "\n" for row in kept))
    numbers = {"library": given.cases, "commands": 3 * given.cases // 100 if given.commands is None else given.commands}
    everything = []
    for part, number in numbers.items():
        _watch(out, part, given.seed, number)
        everything += [row for row in rows(out / f"{part}.jsonl") if row["case"] < number]
    print(table(everything))
    return int(any(row["verdict"] == BAD for row in everything))
