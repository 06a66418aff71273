"""One process for each competitor, asked over a pipe, so that environments, thread pools and memory stay apart.

A child reads pickled requests (kind, payload) from its standard input and answers each with one pickled dictionary.
"""

import contextlib
import os
import pickle
import subprocess
import sys
import time
import traceback
from pathlib import Path
from typing import NamedTuple

import numpy as np

ROOT = Path(__file__).resolve().parents[1]
KEPT = str(8 * 2**30)  # bytes glibc may keep or grow the heap by, rather than ask the system for every large tensor
TUNED = {"MALLOC_MMAP_THRESHOLD_": KEPT, "MALLOC_TRIM_THRESHOLD_": KEPT}

CPU = {"JAX_PLATFORMS": "cpu"}  # environment of PyTorch's processes


class Competitor(NamedTuple):
    """A competitor: its mark in tables, its title, its module, whether it is tuned, and environment variables."""

    mark: str
    title: str
    module: str
    tuned: bool
    environment: dict


COMPETITORS = {
    "torch": Competitor("(a)", "PyTorch, as NDF's users run it", "peer", False, {}),
    "torch_tuned": Competitor("(b)", "PyTorch, tuned", "peer", True, TUNED),
    "tdf_jax": Competitor("(c)", "tdf_jax", "ours", False, CPU),
    # In rows of tdf_jax alone, what the title names second.
    "tdf_jax_solve": Competitor("(d)", "tdf_jax.solve, or the second way", "ours", False, CPU),
}


class WorkerError(RuntimeError):
    """A child failed or died; the message says how."""


class Worker:
    """The parent's end of one child."""

    def __init__(self, name: str):
        environment = {key: value for key, value in os.environ.items() if not key.startswith("MALLOC_")}
        self.name = name
        self.process = subprocess.Popen(
            [sys.executable, "-m", "bench.workers", name],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            cwd=ROOT,
            env=environment | COMPETITORS[name].environment,
        )

    def ask(self, kind: str, payload=None) -> dict:
        """One request's answer.

        Raises:
            WorkerError: it failed there, or the child is gone.
        """
        try:
            pickle.dump((kind, payload), self.process.stdin)
            self.process.stdin.flush()
            answer = pickle.load(self.process.stdout)
        except (EOFError, BrokenPipeError, pickle.UnpicklingError):
            code = self.process.wait()
            raise WorkerError(
                f"the process of {self.name} ended with {code}" + (", probably out of memory" if code == -9 else "")
            ) from None
        if "error" in answer:
            raise WorkerError(answer["error"])
        return answer

    def close(self) -> None:
        """End the child."""
        with contextlib.suppress(OSError):
            self.process.stdin.close()
        self.process.wait()
        self.process.stdout.close()


class Workers:
    """Children by competitor, each starts at its first request; one that died is restarted."""

    def __init__(self):
        self._started = {}

    def __enter__(self):
        return self

    def __exit__(self, *_):
        for worker in self._started.values():
            worker.close()

    def ask(self, name: str, kind: str, payload=None) -> dict:
        """See `Worker.ask`."""
        if name in self._started and self._started[name].process.poll() is not None:
            self._started.pop(name).close()
        if name not in self._started:
            self._started[name] = Worker(name)
        return self._started[name].ask(kind, payload)


def serve(name: str) -> None:
    """A child's life: requests until the pipe closes."""
    from bench import machine

    answers, requests = os.fdopen(os.dup(1), "wb"), sys.stdin.buffer
    os.dup2(2, 1)  # whatever a library prints must not get into the answers
    module, tuned = COMPETITORS[name].module, COMPETITORS[name].tuned
    task = None

    def prepare(payload):
        nonlocal task
        task = None  # the last row's memory goes before the next row's comes
        tasks = __import__(f"bench.{module}", fromlist=["prepare"])
        task = tasks.prepare(payload["task"], tuned, payload["settings"], payload["arrays"], payload["state"])
        return {}

    def run(_):
        worked, began = time.process_time(), time.perf_counter()
        result = task()
        wall, worked = time.perf_counter() - began, time.process_time() - worked
        seconds = result.pop("seconds", wall)
        arrays = {key: np.asarray(value) for key, value in result.items()}
        return {"seconds": seconds, "wall": wall, "worked": worked, "result": arrays}

    def settle(_):
        machine.settle()
        return {"resident": machine.resident()}

    kinds = {"prepare": prepare, "run": run, "settle": settle, "peak": lambda _: {"peak": machine.peak()}}
    while True:
        try:
            kind, payload = pickle.load(requests)
        except (EOFError, KeyboardInterrupt):
            return
        try:
            answer = kinds[kind](payload)
        except KeyboardInterrupt:
            return
        except BaseException:
            answer = {"error": traceback.format_exc()}
        pickle.dump(answer, answers)
        answers.flush()


if __name__ == "__main__":
    serve(sys.argv[1])
