"""Nothing finished is lost: failing pictures, streams that cannot be written, signals, and warnings as lines."""

import contextlib
import errno
import io
import json
import os
import re
import signal
import subprocess
import sys
import threading
import time
import warnings
from pathlib import Path

import numpy as np
import pytest
from conftest import POSES, QUERIES, STARTS, quick_environment
from tqdm import tqdm

import tdf_jax as tdf
from tdf_jax._internal.errors import InputError, TdfWarning
from tdf_jax._internal.files import replace_folder
from tdf_jax.cli.main import main
from tdf_jax.viz import style

PACKAGE = Path(tdf.__file__).parent
TINY = ("--method", "adam", "--num-starts", STARTS, "--iterations", 3, "--points", 60)
TINY = (*TINY, "--num-poses", POSES, "--queries", QUERIES)
MISSING_MODULE = "module://matplotlib_inline.no_such_module"
needs_full = pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs a device that is always full")


def run(*words):
    """The exit code of a command; None if it ends without one."""
    try:
        main([str(word) for word in words])
    except SystemExit as stop:
        return stop.code
    return None


@pytest.fixture
def command(monkeypatch):
    """Replace `tdf shapes` by a function without arguments, and give what runs it."""

    def go(function, *words):
        def shapes() -> None:
            function()

        monkeypatch.setattr("tdf_jax.cli.shapes.shapes", shapes)
        return run("shapes", *words)

    return go


# Pictures


def broken(*_, **__):
    raise ValueError("no pictures today\nat all")


def test_a_training_run_without_its_curves_has_its_weights(weights, tmp_path, monkeypatch, capsys):
    model = tdf.load_model(weights)
    monkeypatch.setattr("tdf_jax.cli.train.run", lambda *_, **__: model.params)
    monkeypatch.setattr("tdf_jax.cli.train.load", lambda _: (None, None))
    monkeypatch.setattr("tdf_jax.cli.train.joined", lambda sets: sets[0])
    monkeypatch.setattr("tdf_jax.viz.training.training_figure", broken)
    sizes = ("latent", "vector_hidden", "vector_width", "decoder_width", "blocks")
    network = [f"--network.{name.replace('_', '-')}={getattr(model.config, name)}" for name in sizes]
    words = ("train", "--out", tmp_path / "run", "--data", tmp_path, "--start-from", weights, *network)
    assert run(*words) == 1
    out, error = capsys.readouterr()
    assert "saved" in out and "training.png is missing (ValueError" in error
    assert tdf.load_model(tmp_path / "run" / "weights.safetensors").config == model.config


def test_a_picture_that_cannot_be_replaced_is_named_as_one_of_an_earlier_run(tmp_path, monkeypatch, capsys):
    words = ("shapes", "--category", "bowl", "--count", 1, "--out", tmp_path / "a.png")
    monkeypatch.setattr(style, "DPI", 20)
    assert run(*words) is None
    before = (tmp_path / "a.png").read_bytes()
    monkeypatch.setattr("tdf_jax.viz.contact_sheet.contact_sheet", broken)
    assert run(*words) == 1
    assert (tmp_path / "a.png").read_bytes() == before
    assert f"{tmp_path / 'a.png'} is of an earlier run (ValueError" in capsys.readouterr().err


@pytest.mark.slow
def test_an_evaluation_without_its_pictures_is_complete(weights, tmp_path, monkeypatch, capsys):
    pytest.importorskip("igl")
    monkeypatch.setattr("tdf_jax.viz.reconstruction.transfer_figure", broken)
    words = ("--pairs", 2, "--num-starts", 2, "--iterations", 2, "--json", tmp_path / "a.json")
    assert run("evaluate", "--weights", weights, *words, "--figures", tmp_path / "pictures") == 1
    assert [path.name for path in (tmp_path / "pictures").iterdir()] == ["reconstructions.png"]
    out, error = capsys.readouterr()
    assert "generated mugs: 2 objects" in out and json.loads((tmp_path / "a.json").read_text())["rows"]
    assert "tdf evaluate: transfers.png is missing (ValueError" in error
    monkeypatch.setattr("tdf_jax.cli.evaluate._panels", broken)
    assert run("evaluate", "--weights", weights, *words, "--figures", tmp_path / "more") == 1
    assert "reconstructions.png is missing, transfers.png is missing (ValueError" in capsys.readouterr().err


@pytest.mark.slow
def test_a_benchmark_without_its_pictures_is_complete(weights, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr("tdf_jax.viz.evaluation.truth_figure", broken)
    words = ("--pairs", 1, "--methods", "centroids", "--out", tmp_path / "out")
    assert run("benchmark", "--weights", weights, *words) == 1
    names = {path.name for path in (tmp_path / "out").iterdir()}
    assert {"benchmark.md", "benchmark.json", "errors.png"} <= names and "truth.png" not in names
    assert "tdf benchmark: truth.png is missing (ValueError" in capsys.readouterr().err


@pytest.mark.slow
def test_a_reproduction_goes_on_after_a_picture_that_fails(weights, tmp_path, monkeypatch, capsys):
    for name, value in {"setting.POINTS": 40, "energy_maps.FIELDS": {}}.items():
        monkeypatch.setattr(f"tdf_jax.paper.{name}", value)
    monkeypatch.setattr("tdf_jax.viz.paper.figure4", broken)
    words = ("--num-poses", POSES, "--iterations", 2, "--queries", QUERIES, "--num-starts", STARTS)
    assert run("reproduce", "fig4", "--fast", "--weights", weights, "--out", tmp_path, *words) == 1
    assert {path.name for path in tmp_path.iterdir()} == {"runs", "fig4_turn.png"}
    out, error = capsys.readouterr()
    assert out == f"saved {tmp_path / 'fig4_turn.png'}\n" and "fig4.png is missing (ValueError" in error


@pytest.mark.parametrize(
    "backend",
    ["nonsense", "svg", *(pytest.param(one, marks=pytest.mark.slow) for one in (MISSING_MODULE, "", None))],
)
def test_no_backend_hinders_pictures_and_the_users_stays(tmp_path, backend):
    """In a fresh process, because matplotlib reads MPLBACKEND once; without the library, which takes long to load."""
    check = f"""
import os, runpy, sys
before = dict(os.environ)
runpy.run_path({str(PACKAGE / "viz" / "__init__.py")!r})
assert dict(os.environ) == before and "matplotlib.pyplot" not in sys.modules
import matplotlib
print(dict.__getitem__(matplotlib.rcParams, "backend"))
from matplotlib.figure import Figure
figure = Figure()
figure.subplots().plot([1, 2])
figure.savefig(sys.argv[1])
assert "matplotlib.pyplot" not in sys.modules
"""
    environment = {name: value for name, value in os.environ.items() if name != "MPLBACKEND"}
    environment |= {} if backend is None else {"MPLBACKEND": backend}
    words = [sys.executable, "-c", check, tmp_path / "a.png"]
    done = subprocess.run(words, env=environment, capture_output=True, text=True, check=True)
    assert (tmp_path / "a.png").read_bytes().startswith(b"\x89PNG")
    valid = backend in ("svg", MISSING_MODULE)  # modules are looked for when they are used
    assert (done.stdout.strip() == backend) == valid


def test_no_module_uses_the_global_state_of_matplotlib():
    """Which loads the backend."""
    code = "".join(path.read_text() for path in PACKAGE.rglob("*.py"))
    assert re.search(r"from matplotlib\.figure import", code)
    assert not re.findall(r"matplotlib(?:\.| import )(?:pyplot|animation)|pylab", code)


# Streams


def full():
    return open("/dev/full", "w")


def unread():
    read, write = os.pipe()
    os.close(read)
    return os.fdopen(write, "w")


def unbuffered():
    return io.TextIOWrapper(open("/dev/full", "wb", buffering=0), write_through=True)


STREAMS = {
    "full": (full, 1, "error: the {} could not be written (No space left on device)"),
    "unbuffered": (unbuffered, 1, "error: the {} could not be written (No space left on device)"),
    "unread": (unread, 141, "the {} ended early, because the reader closed the pipe"),
}


@needs_full
@pytest.mark.parametrize("kind", STREAMS)
@pytest.mark.parametrize("size", [10, 100_000])  # in the buffer until the end, and beyond it
def test_output_that_cannot_be_written_does_not_end_a_command(command, monkeypatch, capsys, kind, size):
    make, code, message = STREAMS[kind]
    finished = []

    def prints():
        print("x" * size)
        print("more")
        finished.append(True)

    with make() as stream:
        with monkeypatch.context() as changed:
            changed.setattr(sys, "stdout", stream)
            assert command(prints) == code
            assert sys.stdout is stream
        stream.flush()  # as Python does at exit: nothing is left that would fail again
    assert finished == [True]
    assert capsys.readouterr().err == f"tdf: {message.format('output')}\n"


@needs_full
@pytest.mark.parametrize("kind", STREAMS)
def test_messages_that_cannot_be_written_do_not_end_a_command(command, monkeypatch, capsys, kind):
    make, code, _ = STREAMS[kind]

    def shows_progress():
        for _ in tqdm(range(3), mininterval=0):
            print("a message", file=sys.stderr)
        warnings.warn("a warning", TdfWarning, stacklevel=1)
        print("the table")

    with make() as stream:
        with monkeypatch.context() as changed:
            changed.setattr(sys, "stderr", stream)
            assert command(shows_progress) == code
        stream.flush()
    assert capsys.readouterr().out == "the table\n"


@needs_full
@pytest.mark.parametrize("kind", STREAMS)
def test_help_that_cannot_be_written(monkeypatch, capsys, kind):
    make, code, message = STREAMS[kind]
    with make() as stream:
        with monkeypatch.context() as changed:
            changed.setattr(sys, "stdout", stream)
            assert run("--help") == code
        stream.flush()
    assert capsys.readouterr().err == f"tdf: {message.format('output')}\n"


@needs_full
def test_the_code_of_a_mistake_comes_before_that_of_a_stream(monkeypatch):
    with full() as stream, monkeypatch.context() as changed:
        changed.setattr(sys, "stderr", stream)
        assert run("nonsense") == 2
        stream.flush()


@pytest.mark.parametrize("name", ["stdout", "stderr"])
def test_a_closed_stream(command, monkeypatch, capsys, name):
    def prints():
        print("the table", file=sys.stdout)
        print("a message", file=sys.stderr)
        for _ in tqdm(range(2)):
            pass

    with monkeypatch.context() as changed:
        changed.setattr(sys, name, None)
        assert command(prints) is None
    out, error = capsys.readouterr()
    assert (out, "a message" in error) == (("", True) if name == "stdout" else ("the table\n", False))


def test_what_a_terminal_cannot_show_is_replaced(command, monkeypatch):
    stream = io.TextIOWrapper(io.BytesIO(), encoding="ascii")
    monkeypatch.setattr(sys, "stdout", stream)
    assert command(lambda: print("20\N{DEGREE SIGN}")) is None
    assert stream.buffer.getvalue() == b"20?\n"


def test_an_error_of_the_system_is_a_line(command, capsys):
    def fails():
        raise PermissionError(errno.EACCES, "Permission denied", "somewhere")

    assert command(fails) == 1
    assert capsys.readouterr().err == "tdf: error: [Errno 13] Permission denied: 'somewhere'\n"


# Signals

SIGNALS = {signal.SIGINT: "interrupted", signal.SIGTERM: "terminated", signal.SIGHUP: "terminated, because"}


@pytest.fixture
def default_handlers():
    """As of a command in a terminal; a test run in the background ignores some, and a command respects that."""
    before = {one: signal.getsignal(one) for one in SIGNALS}
    for one in SIGNALS:
        signal.signal(one, signal.default_int_handler if one == signal.SIGINT else signal.SIG_DFL)
    yield
    for one, handler in before.items():
        signal.signal(one, handler)


@pytest.mark.usefixtures("default_handlers")
@pytest.mark.parametrize("number", SIGNALS)
@pytest.mark.parametrize("hidden", [False, True])
def test_a_signal_cleans_up(command, tmp_path, capsys, number, hidden):
    def works():
        with replace_folder("tdf", tmp_path / "out", "result.json", ("result.json",)) as folder:
            (folder / "result.json").write_text("half")
            try:
                os.kill(os.getpid(), number)
                time.sleep(10)
            except KeyboardInterrupt:
                if hidden:  # as by processes that the signal ended too
                    raise InputError("a process died") from None
                raise

    before = [signal.getsignal(one) for one in SIGNALS]
    assert command(works) == 128 + number
    assert [signal.getsignal(one) for one in SIGNALS] == before
    assert not list(tmp_path.iterdir())
    out, error = capsys.readouterr()
    assert out == "" and error.startswith(f"tdf: {SIGNALS[number]}") and error.count("\n") == 1


@pytest.mark.parametrize("handler", [signal.SIG_IGN, "own"])
def test_a_handler_that_is_not_the_default_stays(command, handler):
    """Such as that of nohup, or of a program that calls the command."""
    came = []
    before = signal.signal(signal.SIGHUP, handler if handler != "own" else lambda *_: came.append("own"))
    try:
        assert command(lambda: os.kill(os.getpid(), signal.SIGHUP)) is None
    finally:
        signal.signal(signal.SIGHUP, before)
    assert came == (["own"] if handler == "own" else [])


def test_a_command_runs_in_a_thread_which_cannot_handle_signals(command):
    codes = []
    thread = threading.Thread(target=lambda: codes.append(command(lambda: None)))
    thread.start()
    thread.join()
    assert codes == [None]


# Warnings


def test_a_warning_of_the_library_is_a_line_once_and_others_stay(command, capsys):
    def warns():
        for _ in range(2):
            warnings.warn("a mug in millimetres", TdfWarning, stacklevel=1)
        warnings.warn("a bowl", tdf.CategoryWarning, stacklevel=1)
        warnings.warn("not of the library", UserWarning, stacklevel=1)

    with pytest.warns(UserWarning, match="not of the library") as others:
        assert command(warns) is None
    assert len(others) == 1
    assert capsys.readouterr().err == "tdf: warning: a mug in millimetres\ntdf: warning: a bowl\n"
    with pytest.raises(TdfWarning):  # as the tests' settings say
        warnings.warn("outside", TdfWarning, stacklevel=1)


def test_a_warning_beside_a_progress_bar_has_its_own_line(command, capsys):
    def warns():
        for _ in tqdm(range(3), mininterval=0):
            warnings.warn("a mug in millimetres", TdfWarning, stacklevel=1)

    command(warns)
    lines = [line.rpartition("\r")[2] for line in capsys.readouterr().err.split("\n")]
    assert lines.count("tdf: warning: a mug in millimetres") == 1 and "3/3" in lines[-2]


# Processes


def tdf_process(*words, **options):
    code = "from tdf_jax.cli.main import main; main()"
    options = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True} | options
    options["env"] = options.get("env", os.environ) | quick_environment()
    return subprocess.Popen([sys.executable, "-c", code, *map(str, words)], cwd=PACKAGE.parent, **options)


@pytest.mark.slow
@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGKILL])
def test_a_stopped_process_leaves_nothing_that_stays(weights, tmp_path, number):
    out = tmp_path / "runs" / "out"
    out.parent.mkdir()
    words = ("imitate", "--weights", weights, "--out", out, *TINY)
    with tdf_process(*words) as process:
        while not list(out.parent.iterdir()):
            assert process.poll() is None
            time.sleep(0.001)
        process.send_signal(number)
        output, messages = process.communicate()
    assert process.returncode == (143 if number == signal.SIGTERM else -9)
    assert output == "" and "Traceback" not in messages
    if number == signal.SIGTERM:
        assert messages.splitlines()[-1] == "tdf: terminated"
        assert not list(out.parent.iterdir())
    else:
        assert [path.name[:5] for path in out.parent.iterdir()] == [".out."]
    assert run(*words, "--no-plots") is None
    assert [path.name for path in out.parent.iterdir()] == ["out"]


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["full", "unread"])
def test_a_process_whose_output_is_lost_keeps_its_results(weights, tmp_path, kind):
    make, code, message = STREAMS[kind]
    if kind == "full" and not Path("/dev/full").exists():
        pytest.skip("needs a device that is always full")
    environment = os.environ | {"MPLBACKEND": "nonsense"}
    words = ("imitate", "--weights", weights, "--out", tmp_path / "out", *TINY)
    with make() as stream, tdf_process(*words, stdout=stream, env=environment) as process:
        _, messages = process.communicate()
    assert process.returncode == code and "Traceback" not in messages and "Exception" not in messages
    assert messages.splitlines()[-1] == f"tdf: {message.format('output')}"
    with contextlib.suppress(FileNotFoundError):
        assert len(list((tmp_path / "out").iterdir())) == 6
    assert np.isfinite(tdf.load_trajectory(tmp_path / "out" / "trajectory.npz").wxyz_xyz).all()
