"""Batches drawn ahead of the steps that take them: by a thread, or by processes where an accelerator would wait for one."""

import concurrent.futures
import concurrent.futures.process
import contextlib
import dataclasses
import functools
import itertools
import multiprocessing
import os
import shutil
import signal
import tempfile
import threading
from collections import deque
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np

from tdf_jax._internal.devices import one_at_a_time
from tdf_jax._internal.errors import InputError
from tdf_jax.training.batch import Batch
from tdf_jax.training.dataset import DataSet

AHEAD = 2  # batches a process has been asked for at any time, so that none waits for this one

_draw = None  # of a drawing process


@contextlib.contextmanager
def drawn_ahead(
    draw: Callable[[DataSet, int], Batch], data: DataSet, start: int, workers: int
) -> Iterator[Iterator[Batch]]:
    """The batches of the steps from `start` on, in order; a step's batch does not depend on who draws it.

    Args:
        draw: from the data and a step to its batch; of several workers one that can be pickled.
        data: the objects.
        start: the first step.
        workers: processes, which begin with the main module of this one; 1 is a thread of this one.

    Raises:
        InputError: workers is less than 1, or, when the next batch is asked for, a process died.
    """
    if workers < 1:
        raise InputError(f"drawn_ahead(): workers is {workers}; expected at least 1")
    with contextlib.ExitStack() as stack:
        if workers == 1:
            pool = concurrent.futures.ThreadPoolExecutor(1)
            ask = functools.partial(pool.submit, draw, data)
        else:
            # Mapped from files, all processes share one copy of the objects.
            folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="tdf_train_")))
            for field in dataclasses.fields(data):
                np.save(folder / f"{field.name}.npy", getattr(data, field.name))
            # Started afresh, for a forked copy of a process that runs JAX may hang.
            pool = concurrent.futures.ProcessPoolExecutor(
                workers, multiprocessing.get_context("spawn"), _open, (folder, draw)
            )
            ask = functools.partial(pool.submit, _drawn)
        stack.callback(pool.shutdown, cancel_futures=True)
        yield _in_order(ask, start, asked_ahead(workers))


def asked_ahead(workers: int) -> int:
    """How many batches are drawn, or waited for, at any time."""
    return 1 if workers == 1 else AHEAD * workers


def _in_order(ask, start, ahead):
    asked = deque(ask(step) for step in range(start, start + ahead))
    for step in itertools.count(start + ahead):
        try:
            batch = asked.popleft().result()
        except concurrent.futures.process.BrokenProcessPool:
            raise InputError(
                "train(): a process that drew samples died, perhaps for want of memory; expected it to live: use fewer workers, and run again to go on"
            ) from None
        asked.append(ask(step))
        yield batch


def _open(folder, draw):
    """Make this process one that draws."""
    global _draw
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C reaches every process of the terminal: the run answers it
    threading.Thread(target=_end_with_the_run, args=(folder,), daemon=True).start()
    columns = {
        field.name: np.asarray(np.load(folder / f"{field.name}.npy", mmap_mode="r"))
        for field in dataclasses.fields(DataSet)
    }
    _draw = functools.partial(draw, DataSet(**columns))


def _end_with_the_run(folder):
    """A killed run tells nobody: its processes would wait for ever for another step, and its objects would stay on the disk."""
    multiprocessing.parent_process().join()
    shutil.rmtree(folder, ignore_errors=True)
    os._exit(1)


def _drawn(step):
    return _draw(step)


def usual_workers() -> int:
    """A thread beside a CPU, which has no core to spare; beside an accelerator a process on every core."""
    return 1 if one_at_a_time() else os.cpu_count() or 1
