"""Optional outputs of a command: a picture or a page that fails does not stop the command."""

import contextlib
from collections.abc import Iterator
from pathlib import Path

from tdf_jax._internal.errors import InputError


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
    def drawing(self, path: Path, *others: Path) -> Iterator[Path]:
        """Note pictures as missing if the block fails, and go on; only an interruption passes.

        Args:
            path: picture that the block is for. Imports that only the picture needs belong into the block.
            others: further pictures that the block is for.

        Yields:
            The first path.
        """
        try:
            yield path
        except Exception as error:
            lines = str(error).splitlines()
            reason = f"{type(error).__name__}: {lines[0]}" if lines else type(error).__name__
            states = (
                f"{one} is of an earlier run" if one.exists() else f"{one.name} is missing" for one in (path, *others)
            )
            self._missing.append(f"{', '.join(states)} ({reason})")

    def check(self) -> None:
        """End a command.

        Raises:
            PictureError: a picture is missing.
        """
        if self._missing:
            raise PictureError(f"{self._command}: {'; '.join(self._missing)}. All other results are complete")


def check_page(function: str) -> None:
    """Refuse --page at once where the extra that draws it is not installed.

    Args:
        function: name that the message begins with.

    Raises:
        InputError: plotly is not installed.
    """
    with contextlib.suppress(ImportError):  # matplotlib is broken, which is no reason not to compute: see `Pictures`
        from tdf_jax.viz.page import pages

        pages(function)


def check_animation(function: str, path: Path) -> None:
    """Refuse --animation at once where it could not be written.

    Args:
        function: name that the message begins with.
        path: the film.

    Raises:
        InputError: the ending is none of a film, the folder does not exist, or the encoder is not installed.
    """
    from tdf_jax.viz.film_file import ENDINGS, check_encoder

    if path.suffix.lower() not in ENDINGS:
        raise InputError(f"{function}: --animation is {path}; expected a name that ends in {' or '.join(ENDINGS)}")
    if path.is_dir() or not path.parent.is_dir():
        raise InputError(f"{function}: --animation is {path}; expected a file in an existing folder")
    check_encoder(path)
