"""`tdf`, the command line: names its commands and turns a user's mistake into a message and an exit code."""

import importlib
import os
import sys
from collections.abc import Sequence

import tyro

from tdf_jax.errors import InputError

COMMANDS = ("imitate", "convert", "train")  # each is a function in a module of its name
# Flags once (`--json`, not also `--no-json`), and vectors as `X Y Z`.
STYLE = (tyro.conf.FlagCreatePairsOff,)


def main(arguments: Sequence[str] | None = None) -> None:
    """Run one command.

    Args:
        arguments: the words after `tdf`; by default the process's.

    Raises:
        SystemExit: 2 for a user's mistake (a message is on stderr), 130 where the user interrupted.
    """
    commands = {name: getattr(importlib.import_module(f"tdf_jax.cli.{name}"), name) for name in COMMANDS}
    try:
        tyro.extras.subcommand_cli_from_dict(
            commands,
            prog="tdf",
            description="Imitate a demonstrated pick-and-place trajectory on new objects.",
            args=None if arguments is None else list(arguments),
            config=STYLE,
        )
    except InputError as error:
        _fail(f"error: {error}", 2)
    except MemoryError:
        _fail("error: out of memory; lower --inits, --queries or --points", 2)
    except KeyboardInterrupt:
        _fail("interrupted", 130)
    except BrokenPipeError:  # `tdf ... | head`: the reader has what it wanted
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def _fail(message: str, code: int) -> None:
    print(f"tdf: {message}", file=sys.stderr)
    raise SystemExit(code)
