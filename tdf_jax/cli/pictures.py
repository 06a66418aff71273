"""Optional outputs of a command: a picture or a page that fails costs nothing else."""

import contextlib
from collections.abc import Iterator
from pathlib import Path


class PictureError(Exception):
    """Raised at the end of a command, when its results are complete but pictures are missing."""


class Pictures:
    """The pictures of one run of a command.

    Args:
        command: name that the message begins with.
    """

    def __init__(self, command: str):
        self._command = command
        self._missing: list[str] = []

    @contextlib.contextmanager
    def drawing(self, path: Path) -> Iterator[Path]:
        """Note a picture as missing if the block fails, and go on; only an interruption passes.

        Args:
            path: the picture that the block writes. Imports that only it needs belong into the block.

        Yields:
            The path.
        """
        try:
            yield path
        except Exception as error:
            lines = str(error).splitlines()
            reason = f"{type(error).__name__}: {lines[0]}" if lines else type(error).__name__
            state = f"{path} is of an earlier run" if path.exists() else f"{path.name} is missing"
            self._missing.append(f"{state} ({reason})")

    def check(self) -> None:
        """End a command.

        Raises:
            PictureError: a picture is missing.
        """
        if self._missing:
            raise PictureError(f"{self._command}: {'; '.join(self._missing)}. All other results are complete")
