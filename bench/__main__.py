"""Time and memory of tdf_jax against PyTorch, in one run, alternately.

    python -m bench --out results             # all rows: bench.json and bench.md; about half an hour on two cores
    python -m bench --only encode_1500 step_10
    python -m bench --gate                    # exit code 1 if a check fails or a ratio is far below bench/baseline.json
    python -m bench --scaling --out results   # also curves over sizes, as scaling.png

The machine must be idle: PyTorch's threads wait for each other at every operation, so another process slows them down
by far more than its share.
"""

import argparse
import importlib.util
import json
import sys
from collections.abc import Sequence
from pathlib import Path

import tdf_jax as tdf
from bench import gate, report, scene
from bench.machine import machine
from bench.measure import matmul_gflops, measure
from bench.parity import parity
from bench.rows import QUICK, Sizes, rows, select
from bench.workers import WorkerError, Workers
from tdf_jax._internal.errors import InputError
from tdf_jax._internal.files import replace_file

BASELINE = Path(__file__).with_name("baseline.json")
BUSY_LOAD = 0.5  # processes; a higher load slows PyTorch down much more than tdf_jax
QUICK_ENERGIES = {"num_starts": 2, "poses": 3, "queries": 20}


def main(arguments: Sequence[str] | None = None) -> int:
    """Measure and report.

    Args:
        arguments: words of the command line; by default those of the process.

    Returns:
        0; 1 if a check, a competitor or the gate fails; 2 for a user's mistake.
    """
    options = _options(arguments)
    try:
        return _run(options)
    except InputError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    except WorkerError as error:
        print(f"failed: {error}", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        print("interrupted", file=sys.stderr)
        return 130


def _options(arguments):
    parser = argparse.ArgumentParser(prog="python -m bench", description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, metavar="DIR", help="write bench.json, bench.md and plots here")
    parser.add_argument(
        "--only", nargs="+", metavar="NAME", help="rows to measure, such as encode_1500 step_10 target landscape train"
    )
    parser.add_argument(
        "--repetitions", type=int, default=5, help="calls of every competitor, after a first one (default: 5)"
    )
    parser.add_argument("--quick", action="store_true", help="use small sizes, to test the benchmark itself")
    parser.add_argument("--gate", action="store_true", help="compare with the baseline")
    parser.add_argument("--baseline", type=Path, default=BASELINE, metavar="FILE", help="default: bench/baseline.json")
    parser.add_argument("--scaling", action="store_true", help="measure curves over sizes too; needs --out")
    return parser.parse_args(arguments)


def _run(options):
    if importlib.util.find_spec("torch") is None:
        raise InputError("bench: PyTorch is not installed; expected the extra: pip install 'tdf_jax[bench]'")
    if options.repetitions < 1:
        raise InputError(f"bench: --repetitions is {options.repetitions}; expected at least 1")
    if options.scaling and options.out is None:
        raise InputError("bench: --scaling without --out; expected a folder for the plots")
    baseline = gate.read(options.baseline) if options.gate else None
    selected = select(rows(QUICK if options.quick else Sizes()), options.only)
    if options.out is not None:
        _folder(options.out)
    record = {"machine": machine(), "quick": options.quick}
    print("machine:", ", ".join(f"{name} {value}" for name, value in record["machine"].items()), flush=True)
    if record["machine"]["load"] > BUSY_LOAD and not options.quick:
        print(
            f"warning: the load is {record['machine']['load']}: other processes run; measure on an idle machine",
            file=sys.stderr,
        )
    state = scene.weights(tdf.load_model("mug"))
    with Workers() as workers:
        record["parity"] = parity(workers, **(QUICK_ENERGIES if options.quick else {}))
        print(
            f"parity: {sum(one['passed'] for one in record['parity'])} of {len(record['parity'])} checks passed",
            flush=True,
        )
        correct = all(one["passed"] for one in record["parity"])
        record["matmul_gflops"] = matmul_gflops(workers, state)
        print(
            "matmul peak, GFLOP/s:",
            ", ".join(f"{name} {rate:.0f}" for name, rate in record["matmul_gflops"].items()),
            flush=True,
        )
        record["rows"] = {}
        for row in selected if correct else ():  # wrong results are not timed
            record["rows"][row.name] = measure(row, workers, state, options.repetitions)
            print(report.line(row.name, record["rows"][row.name]), flush=True)
            _write(options.out, record)  # after every row, because all rows take half an hour
        if options.scaling and correct:
            from bench import scaling

            record["scaling"] = scaling.scaling(workers, state, options.quick, options.repetitions)
            scaling.save(options.out / "scaling.png", record["scaling"])
    _write(options.out, record)
    return _verdict(record, baseline)


def _write(folder, record):
    if folder is not None:
        replace_file("bench", folder / "bench.json", (json.dumps(record, indent=1) + "\n").encode())
        replace_file("bench", folder / "bench.md", report.markdown(record).encode())


def _verdict(record, baseline):
    failures, apart = gate.failed_checks(record), []
    if baseline is not None:
        lost, apart = gate.lost_ratios(record, baseline)
        failures += lost
    for words in apart:
        print(f"gate: not compared: {words}")
    for words in failures:
        print(f"failed: {words}", file=sys.stderr)
    if baseline is not None and not failures:
        print("gate: passed")
    return 1 if failures else 0


def _folder(path):
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(
            f"bench: cannot write to {path} ({error}); expected a folder, or a name for a new one"
        ) from None


if __name__ == "__main__":
    sys.exit(main())
