"""`tdf`, the command line: names its commands and turns a user's mistake into a message and an exit code."""

import importlib
import os
import sys
from collections.abc import Sequence

import jax
import tyro

from tdf_jax._internal.errors import InputError
from tdf_jax.landscape.storage import DEPRECATED_REDUCTIONS
from tdf_jax.paper.setting import DEPRECATED_FIELD_ENERGIES

MEMORY = "error: out of memory; lower the number of starts, poses, query points or points, or raise the pitch"
# each is a function in the module of its name
COMMANDS = ("imitate", "landscape", "convert", "evaluate", "benchmark", "shapes", "dataset", "train", "reproduce")
# Options of the release before by command; they are accepted for one release, with a warning.
DEPRECATED_FLAGS = {
    "imitate": {"--inits": "--num-starts", "--poses": "--num-poses"},
    "landscape": {"--poses": "--num-poses"},
    "evaluate": {"--inits": "--num-starts", "--poses": "--num-poses"},
    "benchmark": {"--inits": "--num-starts", "--poses": "--num-poses"},
    "reproduce": {"--inits": "--num-starts", "--poses": "--num-poses", "--lever": "--rotation-scale"},
    "train": {"--poses": "--num-poses", "--network.asymmetry": "--network.symmetry-breaking-offset"},
}
# Choices of the release before by command and option; they are accepted for one release, with a warning.
DEPRECATED_CHOICES = {
    "landscape": {"--reduce": DEPRECATED_REDUCTIONS},
    "reproduce": {"--field-energy": DEPRECATED_FIELD_ENERGIES},
}
STYLE = (tyro.conf.FlagCreatePairsOff, tyro.conf.DisallowNone)  # `--json` without `--no-json`, no word for "not given"


def main(arguments: Sequence[str] | None = None) -> None:
    """Run one command.

    Args:
        arguments: the words after `tdf`; by default the process's.

    Raises:
        SystemExit: 2 for a user's mistake, 130 for an interruption, each with a line on stderr; 0 after --help.
    """
    commands = {name: getattr(importlib.import_module(f"tdf_jax.cli.{name}"), name) for name in COMMANDS}
    try:
        tyro.extras.subcommand_cli_from_dict(
            commands,
            prog="tdf",
            description="Imitate a demonstrated pick-and-place trajectory on new objects.",
            args=_current(sys.argv[1:] if arguments is None else arguments),
            config=STYLE,
        )
        sys.stdout.flush()
    except (InputError, FloatingPointError) as error:
        _fail(f"error: {error}", 2)
    except MemoryError:
        _fail(MEMORY, 2)
    except jax.errors.JaxRuntimeError as error:
        if "RESOURCE_EXHAUSTED" not in str(error):
            raise
        _fail(MEMORY, 2)
    except KeyboardInterrupt:
        _fail("interrupted", 130)
    except BrokenPipeError:  # `tdf imitate --json | head`: nobody reads on, and Python would complain again at exit
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def _current(arguments: Sequence[str]) -> list[str]:
    """The arguments with today's names of options and choices."""
    new_names = DEPRECATED_FLAGS.get(arguments[0], {}) if arguments else {}
    new_choices = DEPRECATED_CHOICES.get(arguments[0], {}) if arguments else {}
    current, option = [], ""
    for word in arguments:
        name, equals, value = word.partition("=")
        if name in new_names:
            print(f"tdf: warning: {name} is deprecated; use {new_names[name]}", file=sys.stderr)
            name = new_names[name]
        chosen = new_choices.get(name if equals else option, {})
        choice = value if equals else name
        if choice in chosen:
            option = name if equals else option
            print(f"tdf: warning: {option} {choice} is deprecated; use {option} {chosen[choice]}", file=sys.stderr)
            name, value = (name, chosen[choice]) if equals else (chosen[choice], "")
        current.append(name + equals + value)
        option = name
    return current


def _fail(message: str, code: int) -> None:
    print(f"tdf: {message}", file=sys.stderr)
    raise SystemExit(code)
