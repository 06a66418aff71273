"""Prefetching of batches by a thread, or by processes if an accelerator would wait for one thread."""

import concurrent.futures
import concurrent.futures.process
import contextlib
import dataclasses
import functools
import itertools
import multiprocessing
import os
import tempfile
from collections import deque
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np

from tdf_jax._internal import checks, workers
from tdf_jax._internal.devices import one_at_a_time
from tdf_jax._internal.errors import InputError
from tdf_jax._internal.files import temporary_folder
from tdf_jax.training.batch import Batch
from tdf_jax.training.dataset import DataSet

PREFETCH = 2  # batches requested of each process at any time, so that no process waits for this one

_draw: Callable[[int], Batch] | None = None  # set in a drawing process


@contextlib.contextmanager
def prefetched(
    draw: Callable[[DataSet, int], Batch], data: DataSet, start: int, workers: int
) -> Iterator[Iterator[Batch]]:
    """The batches of the steps from `start` on, in order; a step's batch does not depend on the worker.

    Args:
        draw: makes the batch of the data and a step; it can be pickled if there are several workers.
        data: objects to draw from.
        start: first step.
        workers: number of processes, which import the main module of this one; 1 is a thread of this process.

    Raises:
        InputError: `workers` is less than 1, or, when the next batch is requested, a process died.
    """
    checks.count("train()", "workers", workers)
    with contextlib.ExitStack() as stack:
        if workers == 1:
            pool = concurrent.futures.ThreadPoolExecutor(1)
            ask = functools.partial(pool.submit, draw, data)
        else:
            # All processes map the same files and share one copy of the objects.
            files = {f"{field.name}.npy": getattr(data, field.name) for field in dataclasses.fields(data)}
            place = Path(tempfile.gettempdir())
            try:
                folder = stack.enter_context(temporary_folder(place / "tdf_train", files))
                for name, array in files.items():
                    np.save(folder / name, array)
            except OSError as error:
                raise InputError(
                    f"train(): cannot write in {place} ({error.strerror or error}); expected room for the objects "
                    "there. Set TMPDIR to another folder, or use one worker"
                ) from None
            # Processes are spawned because a forked copy of a process that runs JAX may hang.
            pool = concurrent.futures.ProcessPoolExecutor(
                workers, multiprocessing.get_context("spawn"), _open, (folder, draw)
            )
            ask = functools.partial(pool.submit, _drawn)
        stack.callback(pool.shutdown, cancel_futures=True)
        yield _in_order(ask, start, num_prefetched(workers))


def num_prefetched(workers: int) -> int:
    """Number of batches that are requested at any time."""
    return 1 if workers == 1 else PREFETCH * workers


def _in_order(ask, start, count):
    requested = deque(ask(step) for step in range(start, start + count))
    for step in itertools.count(start + count):
        try:
            batch = requested.popleft().result()
        except concurrent.futures.process.BrokenProcessPool:
            raise InputError(
                "train(): a process that drew samples died, perhaps for lack of memory; expected it to live. Use fewer "
                "workers, and run again to resume"
            ) from None
        requested.append(ask(step))
        yield batch


def _open(folder, draw):
    """Prepare this process to draw batches."""
    global _draw
    workers.begin(folder)
    columns = {
        field.name: np.asarray(np.load(folder / f"{field.name}.npy", mmap_mode="r"))
        for field in dataclasses.fields(DataSet)
    }
    _draw = functools.partial(draw, DataSet(**columns))


def _drawn(step):
    assert _draw is not None
    return _draw(step)


def usual_workers() -> int:
    """Default number of workers: a thread on a CPU, which has no core to spare; with an accelerator one per core."""
    return 1 if one_at_a_time() else os.cpu_count() or 1
