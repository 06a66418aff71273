"""`tdf`, the command line: names its commands and turns a user's mistake into a message and an exit code."""

import contextlib
import importlib
import signal
import sys
import threading
import warnings
from collections.abc import Iterator, Sequence

import jax
import tyro
from tqdm.auto import tqdm

import tdf_jax
from tdf_jax._internal.boundary import own_settings
from tdf_jax._internal.compiled import kept_compiled
from tdf_jax._internal.devices import platform_problem
from tdf_jax._internal.errors import InputError, TdfWarning
from tdf_jax.cli.pictures import PictureError
from tdf_jax.cli.streams import guarded, write_failure
from tdf_jax.landscape.storage import DEPRECATED_REDUCTIONS
from tdf_jax.paper.setting import DEPRECATED_FIELD_ENERGIES

NO_CACHE = "--no-cache"  # of every command
DESCRIPTION = (
    "Imitate a demonstrated pick-and-place trajectory on new objects. Compiled programs are kept in the user's cache, "
    f"so that the next command starts sooner; {NO_CACHE} neither reads nor writes them. "
    "--version prints the version of tdf_jax, env much more."
)
MEMORY = "error: out of memory; lower the number of starts, poses, query points or points, or raise the pitch"
# each is a function in the module of its name
COMMANDS = (
    "imitate",
    "demonstrate",
    "landscape",
    "view",
    "convert",
    "evaluate",
    "benchmark",
    "shapes",
    "dataset",
    "train",
    "reproduce",
    "simulate",
    "env",
)
# Options of the release before by command; they are accepted for one release, with a warning.
DEPRECATED_FLAGS = {
    "imitate": {"--inits": "--num-starts", "--poses": "--num-poses"},
    "landscape": {"--poses": "--num-poses"},
    "evaluate": {"--inits": "--num-starts", "--poses": "--num-poses"},
    "benchmark": {"--inits": "--num-starts", "--poses": "--num-poses"},
    "reproduce": {"--inits": "--num-starts", "--poses": "--num-poses", "--lever": "--rotation-scale"},
    "simulate": {"--video": "--animation"},
    "train": {"--poses": "--num-poses", "--network.asymmetry": "--network.symmetry-breaking-offset"},
}
# Choices of the release before by command and option; they are accepted for one release, with a warning.
DEPRECATED_CHOICES = {
    "landscape": {"--reduce": DEPRECATED_REDUCTIONS},
    "reproduce": {"--field-energy": DEPRECATED_FIELD_ENERGIES},
}
# Switches of the release before that do nothing any more, by command, and what to know; they are accepted for one
# release, with a warning.
DEPRECATED_SWITCHES = {"landscape": {"--no-page": "a page is written with --page alone"}}
# Signals that ask a command to stop, and what it says then.
SIGNALS = {signal.SIGINT: "interrupted", signal.SIGTERM: "terminated"}
if hasattr(signal, "SIGHUP"):
    SIGNALS[signal.SIGHUP] = "terminated, because its terminal was closed"
STYLE = (tyro.conf.FlagCreatePairsOff, tyro.conf.DisallowNone)  # `--json` without `--no-json`, no word for "not given"


def main(arguments: Sequence[str] | None = None) -> None:
    """Run one command.

    Args:
        arguments: the words after `tdf`; by default the process's.

    Raises:
        SystemExit: 0 after --help; otherwise with a line on stderr: 1 if a picture is missing, the output cannot be
            written or the system fails, 2 for a user's mistake, 128 and its number for a signal (130 for Ctrl-C, 143
            for SIGTERM), 141 if nobody reads the output.
    """
    with guarded() as streams:
        code = _code(sys.argv[1:] if arguments is None else arguments)
        for stream in streams:
            stream.flush()
        unwritten = write_failure(streams)
        if unwritten is not None:
            code = _failed(*unwritten) if not code else code
    if code is not None:
        raise SystemExit(code)


def _code(arguments: Sequence[str]) -> int | str | None:
    """Run one command, and give its exit code; None if it ends without one."""
    stopped: list[signal.Signals] = []
    try:
        keep = contextlib.nullcontext() if NO_CACHE in arguments else kept_compiled()
        arguments = [word for word in arguments if word != NO_CACHE]
        if arguments == ["--version"]:
            print(tdf_jax.__version__)
            return None
        with _warnings(), _signals(stopped), own_settings(), keep:
            commands = {name: getattr(importlib.import_module(f"tdf_jax.cli.{name}"), name) for name in COMMANDS}
            tyro.extras.subcommand_cli_from_dict(
                commands,
                prog="tdf",
                description=DESCRIPTION,
                args=_current(arguments),
                config=STYLE,
            )
    except BaseException as error:
        # An error that follows a signal, as of processes that it ended too, is not the reason.
        if stopped:
            return _failed(SIGNALS[stopped[0]], 128 + stopped[0])
        if isinstance(error, SystemExit):
            return error.code
        if isinstance(error, InputError | FloatingPointError):
            return _failed(f"error: {error}", 2)
        if isinstance(error, MemoryError) or (
            isinstance(error, jax.errors.JaxRuntimeError) and "RESOURCE_EXHAUSTED" in str(error)
        ):
            return _failed(MEMORY, 2)
        if isinstance(error, PictureError | OSError):
            return _failed(f"error: {error}", 1)
        if isinstance(error, KeyboardInterrupt):
            return _failed(SIGNALS[signal.SIGINT], 128 + signal.SIGINT)
        problem = platform_problem()
        if problem is not None:  # JAX_PLATFORMS=cuda without a GPU
            return _failed(f"error: {problem}", 2)
        raise
    return None


@contextlib.contextmanager
def _signals(stopped: list[signal.Signals]) -> Iterator[None]:
    """Let signals that ask to stop raise a KeyboardInterrupt, so that unfinished files are removed.

    Args:
        stopped: receives the signals.
    """

    def stop(number, frame):
        stopped.append(signal.Signals(number))
        raise KeyboardInterrupt

    before = {}
    if threading.current_thread() is threading.main_thread():  # others cannot set handlers
        # A handler of a program that calls this one stays, and so does what nohup ignores.
        defaults = signal.SIG_DFL, signal.default_int_handler
        before = {one: signal.getsignal(one) for one in SIGNALS if signal.getsignal(one) in defaults}
    try:
        for one in before:
            signal.signal(one, stop)
        yield
    finally:
        for one, handler in before.items():
            signal.signal(one, handler)


@contextlib.contextmanager
def _warnings() -> Iterator[None]:
    """Print warnings of tdf_jax as lines, each once, also beside a progress bar; all others stay as they are."""
    with warnings.catch_warnings():
        warnings.simplefilter("always", TdfWarning)
        others, printed = warnings.showwarning, set()

        def show(message, category, filename, lineno, file=None, line=None):
            if not issubclass(category, TdfWarning):
                others(message, category, filename, lineno, file, line)
            elif str(message) not in printed:
                printed.add(str(message))
                tqdm.write(f"tdf: warning: {message}", file=sys.stderr)

        warnings.showwarning = show
        yield


def _current(arguments: Sequence[str]) -> list[str]:
    """The arguments with today's names of options and choices."""
    new_names = DEPRECATED_FLAGS.get(arguments[0], {}) if arguments else {}
    new_choices = DEPRECATED_CHOICES.get(arguments[0], {}) if arguments else {}
    switches = DEPRECATED_SWITCHES.get(arguments[0], {}) if arguments else {}
    current, option = [], ""
    for word in arguments:
        name, equals, value = word.partition("=")
        if word in switches:
            print(f"tdf: warning: {word} is deprecated and does nothing: {switches[word]}", file=sys.stderr)
            continue
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


def _failed(message: str, code: int) -> int:
    print(f"tdf: {message}", file=sys.stderr)
    return code
