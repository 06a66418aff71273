"""Worker processes: they leave interruptions to the process that started them, and end with it."""

import multiprocessing
import os
import shutil
import signal
import threading
from pathlib import Path


def begin(folder: Path | None = None) -> None:
    """Prepare this process, which another one has started, for work.

    Args:
        folder: folder of the process that started this one, which is removed if that one is killed.
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C reaches every process of the terminal, and the run handles it
    threading.Thread(target=_end_with_the_run, args=(folder,), daemon=True).start()


def _end_with_the_run(folder):
    """End this process and remove the folder when the run ends, because a killed run can do neither."""
    run = multiprocessing.parent_process()
    assert run is not None
    run.join()
    if folder is not None:
        shutil.rmtree(folder, ignore_errors=True)
    os._exit(1)
