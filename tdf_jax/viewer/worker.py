"""A thread that computes the latest request only: a mouse asks far more often than a solver answers."""

import threading
import traceback
from collections.abc import Callable


class Worker:
    """Runs functions one after the other; a request replaces one of the same name that has not begun.

    Use it as a context manager, or close it.

    Args:
        failed: called with what to tell the user if a function fails.
    """

    def __init__(self, failed: Callable[[str], None]):
        self._failed = failed
        self._waiting: dict[str, Callable[[], None]] = {}
        self._changed = threading.Condition()
        self._closed = self._busy = False
        self._thread = threading.Thread(target=self._run, name="Worker", daemon=True)
        self._thread.start()

    def __enter__(self):
        return self

    def __exit__(self, *about):
        self.close()

    def ask(self, name: str, function: Callable[[], None]) -> None:
        """Compute something soon, instead of what was asked under this name before."""
        with self._changed:
            self._waiting.pop(name, None)
            self._waiting[name] = function
            self._changed.notify_all()

    def wait(self, seconds: float | None = None) -> bool:
        """Wait until nothing is left to compute; whether that is so."""
        with self._changed:
            return self._changed.wait_for(lambda: not self._waiting and not self._busy, seconds)

    def close(self) -> None:
        """Forget what has not begun, and end after what has."""
        with self._changed:
            self._closed = True
            self._waiting.clear()
            self._changed.notify_all()
        self._thread.join()

    def _run(self) -> None:
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._closed or self._waiting)
                if self._closed:
                    return
                name = next(iter(self._waiting))
                function = self._waiting.pop(name)
                self._busy = True
            try:
                function()
            except Exception as error:  # a viewer goes on, and says what did not work
                traceback.print_exc()
                self._failed(f"{type(error).__name__}: {error}")
            finally:
                with self._changed:
                    self._busy = False
                    self._changed.notify_all()
