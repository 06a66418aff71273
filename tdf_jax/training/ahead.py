"""Batches drawn ahead of the steps that take them: by a thread, or by processes where an accelerator would wait for one."""

import concurrent.futures
import contextlib
import dataclasses
import functools
import itertools
import multiprocessing
import os
import signal
import tempfile
from collections import deque
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np

from tdf_jax.devices import one_at_a_time
from tdf_jax.training.batch import Batch
from tdf_jax.training.dataset import DataSet

AHEAD = 2  # batches a process has been asked for at any time, so that none waits for this one

_draw = None  # of a drawing process


@contextlib.contextmanager
def drawn_ahead(draw: Callable[[DataSet, int], Batch], data: DataSet, start: int, workers: int) -> Iterator[Iterator[Batch]]:
    """The batches of the steps from `start` on, in order; a step's batch does not depend on who draws it.

    Args:
        draw: from the data and a step to its batch; of several workers one that can be pickled.
        data: the objects.
        start: the first step.
        workers: processes; 1 is a thread of this one.
    """
    with contextlib.ExitStack() as stack:
        if workers == 1:
            pool, ahead = concurrent.futures.ThreadPoolExecutor(1), 1
            ask = functools.partial(pool.submit, draw, data)
        else:
            # Mapped from files, all processes share one copy of the objects.
            folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="tdf_train_")))
            for field in dataclasses.fields(data):
                np.save(folder / f"{field.name}.npy", getattr(data, field.name))
            # Started afresh, for a forked copy of a process that runs JAX may hang.
            pool = concurrent.futures.ProcessPoolExecutor(workers, multiprocessing.get_context("spawn"), _open, (folder, draw))
            ahead = AHEAD * workers
            ask = functools.partial(pool.submit, _drawn)
        stack.callback(pool.shutdown, cancel_futures=True)
        yield _in_order(ask, start, ahead)


def _in_order(ask, start, ahead):
    asked = deque(ask(step) for step in range(start, start + ahead))
    for step in itertools.count(start + ahead):
        batch = asked.popleft().result()
        asked.append(ask(step))
        yield batch


def _open(folder, draw):
    """Make this process one that draws."""
    global _draw
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C reaches every process of the terminal: the run answers it
    columns = {field.name: np.asarray(np.load(folder / f"{field.name}.npy", mmap_mode="r")) for field in dataclasses.fields(DataSet)}
    _draw = functools.partial(draw, DataSet(**columns))


def _drawn(step):
    return _draw(step)


def usual_workers() -> int:
    """A thread beside a CPU, which has no core to spare; beside an accelerator a process on every core."""
    return 1 if one_at_a_time() else os.cpu_count() or 1
