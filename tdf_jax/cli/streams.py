"""Standard output and standard error of a command: where they cannot be written, the command goes on without them."""

import contextlib
import errno
import os
import sys
from collections.abc import Iterator
from typing import Any, TextIO

PIPE_CODE = 141  # exit code that a shell reports of a tool that ends by SIGPIPE
FAILURE_CODE = 1


class Stream:
    """A text stream that drops what cannot be written; all else is the stream's own.

    Results are files, so that a full disk or a closed pipe behind a progress bar or a table must not end a computation.

    Attributes:
        error: the first error, or None.
    """

    def __init__(self, stream: TextIO):
        self._stream = stream
        self.error: OSError | None = None

    def write(self, text: str) -> int:
        """Write a text, or drop it.

        Args:
            text: the text.

        Returns:
            Number of its characters, also if it is dropped, so that callers go on.
        """
        if self.error is None:
            try:
                self._stream.write(text)
            except UnicodeEncodeError:  # a terminal that cannot show a degree sign shows a question mark
                encoding = self._stream.encoding or "ascii"
                self._stream.write(text.encode(encoding, "replace").decode(encoding))
            except OSError as error:
                self.error = error
        return len(text)

    def flush(self) -> None:
        """Write what is in the buffer, or drop it."""
        if self.error is None:
            try:
                self._stream.flush()
            except OSError as error:
                self.error = error

    def drain(self) -> None:
        """Flush; after an error, drop the rest of the buffer, because Python would try to write it at exit."""
        self.flush()
        if self.error is None:
            return
        with contextlib.suppress(OSError, ValueError, AttributeError), open(os.devnull, "w") as nowhere:
            number = self._stream.fileno()
            saved = os.dup(number)
            try:
                os.dup2(nowhere.fileno(), number)
                self._stream.flush()
            finally:
                os.dup2(saved, number)
                os.close(saved)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)


@contextlib.contextmanager
def guarded() -> Iterator[tuple[Stream, Stream]]:
    """Replace standard output and standard error by streams that never raise, and drain both at the end.

    Yields:
        The two streams.
    """
    before = sys.stdout, sys.stderr
    _open_standard_files()
    with open(os.devnull, "w", encoding="utf-8") as nowhere:
        output, messages = (Stream(nowhere if stream is None else stream) for stream in before)
        sys.stdout, sys.stderr = output, messages
        try:
            yield output, messages
        finally:
            sys.stdout, sys.stderr = before
            output.drain()
            messages.drain()


def _open_standard_files() -> None:
    """Give the numbers of closed standard files to the null device, as shells close them by `>&-`.

    Otherwise a result would get the number, and messages of compiled libraries would end up in it.
    """
    for number in range(3):
        try:
            os.fstat(number)
        except OSError:
            os.open(os.devnull, os.O_RDWR)  # takes the lowest free number


def write_failure(streams: tuple[Stream, Stream]) -> tuple[str, int] | None:
    """Find out whether something could not be written.

    Args:
        streams: standard output and standard error of `guarded`.

    Returns:
        A message that says what was not written, and the exit code for it; None if everything was written.
    """
    for stream, name in zip(streams, ("output", "messages")):
        if stream.error is not None and stream.error.errno == errno.EPIPE:
            return f"the {name} ended early, because the reader closed the pipe", PIPE_CODE
        if stream.error is not None:
            return f"error: the {name} could not be written ({stream.error.strerror or stream.error})", FAILURE_CODE
    return None
