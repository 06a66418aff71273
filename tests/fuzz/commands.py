"""Cases of command lines. Each runs in a child of this process, which itself never starts JAX."""

import dataclasses
import json
import os
import re
import select
import shutil
import signal
import sys
import tempfile
import time
import traceback
from collections.abc import Callable
from pathlib import Path

import numpy as np

from . import damage, files, undamaged as good
from .cases import (
    ANY,
    BAD,
    DOUBT,
    LONGEST,
    ONLY_REFUSED,
    ONLY_RIGHT,
    REFUSED,
    RIGHT,
    WARNED,
    differs,
    differs_as_set,
    patience,
    snapshot,
)
from .files import one_of
from .undamaged import CLOUD, World

WARM_SECONDS = 600  # the first run of a command compiles
SIZES = ["--network.latent", "4", "--network.vector-hidden", "6", "--network.vector-width", "12"]
SIZES += ["--network.decoder-width", "8", "--network.blocks", "2"]
SCENE = ["--weights", "w.safetensors", "--target", "cloud.npy", "--demonstration", "demo.npz", "--points", "40"]
# Commands that take seconds, with every file in the case's folder.
COMMANDS = {
    "imitate": ["imitate", *SCENE, "--num-starts", "4", "--no-plots", "--goal-offset", "0", "0", "0.1", "--out", "out"],
    "adam": ["imitate", *SCENE, "--method", "adam", "--num-starts", "2", "--iterations", "2", "--k", "0.02", "--out",
    "out"],
    "demonstrate": [
        "demonstrate", "--points", "cloud.npy", "--trajectory", "t.tum", "--query-box", "0.06", "--queries", "8",
        "--grasp", "1",
        "--release", "2", "--seed", "3", "--out", "out.npz",
    ],
    "landscape": [
        "landscape", *SCENE, "--grid", "xy", "--half", "0.05", "--pitch", "0.05", "--query", "given", "--no-plots",
        "--out", "out",
    ],
    "convert": ["convert", "c.pth", "out.safetensors"],
    "dataset": [
        "dataset", "--out", "out", "--objects", "2", "--validation", "2", "--points", "100", "--queries", "100",
        "--cameras", "4",
        "--workers", "1", "--seed", "5",
    ],
    "train": [
        "train", "--out", "out", "--data", "data", "--steps", "2", "--warmup", "0", "--batch", "2", "--points", "40",
        "--queries", "8",
        "--box", "4", "--num-poses", "2", *SIZES,
    ],
    "shapes": ["shapes", "--category", "bowl", "--count", "1", "--seed", "2", "--meshes", "meshes", "--out", "out.png"],
    "evaluate": [
        "evaluate", "--weights", "w.safetensors", "--category", "bottle", "--pairs", "0", "--meshes", "meshes",
        "--num-poses", "1",
        "--num-starts", "1", "--iterations", "1", "--json", "out.json",
    ],
    "benchmark": ["benchmark", "--weights", "w.safetensors", "--pairs", "1", "--seed", "1", "--num-starts", "1",
    "--out", "out"],
    "reproduce": ["reproduce", "fig1", "--weights", "w.safetensors", "--fast", "--out", "out"],
    "simulate": [
        "simulate", "--task", "bowl_on_shelf", "--method", "truth", "--mode", "teleport", "--episodes", "1", "--seed",
        "3", "--demonstrations", "1", "--processes", "1", "--json", "out.json", "--out", "out",
    ],
}  # fmt: skip
# `tdf env` reads nothing, and `tdf view` runs until Ctrl-C: tests/cli/test_view.py tries what it refuses.
UNTRIED = ("env", "view")
# Those whose undamaged form is quick; of the others only what is refused is tried.
QUICK = ("imitate", "adam", "demonstrate", "landscape", "convert", "dataset", "shapes")
RESUMED = ("dataset", "train", "benchmark", "reproduce", "simulate")  # what they finished stays if they fail
OUTPUTS = ("out", "out.npz", "out.safetensors", "out.png", "out.json")


@dataclasses.dataclass(frozen=True)
class CommandCase:
    """A command line, what surrounds it, and what is known of its end.

    Attributes:
        kind: kind of input.
        text: what is hostile about it.
        command: key of `COMMANDS`.
        words: the words after `tdf`.
        expected: verdicts that are not bad.
        same: whether the result must be that of the undamaged command.
        around: called in the child before the command.
    """

    kind: str
    text: str
    command: str
    words: list[str]
    expected: frozenset[str] = ANY
    same: bool = False
    around: Callable[[], None] = lambda: None


def lay_out(folder: Path, world: World, command: str) -> None:
    """Put the undamaged files of a command into a folder."""
    words = COMMANDS[command]
    contents = {
        "w.safetensors": lambda: (world.folder / "small.safetensors").read_bytes(),
        "cloud.npy": lambda: good.npy_bytes(CLOUD),
        "demo.npz": lambda: good.npz_bytes(**good.demonstration_arrays()),
        "t.tum": lambda: good.tum_text(good.poses()).encode(),
        "c.pth": lambda: world.checkpoint,
    }
    for name, content in contents.items():
        if name in words:
            (folder / name).write_bytes(content())
    if "data" in words:
        shutil.copytree(world.folder / "data", folder / "data")
    if "meshes" in words:
        (folder / "meshes").mkdir()
        for name, data in world.mesh_folder.items():
            (folder / "meshes" / name).write_bytes(data)


def prepare(world: World) -> None:
    """Make the files that need JAX in a child, and run every quick command once, so that it is compiled."""
    done = world.folder / "warm"
    done.mkdir(exist_ok=True)
    if not (world.folder / "data" / "validation-0000.npz").exists():
        child(lambda: (world.weights, world.data_set, None)[-1], WARM_SECONDS)
    for command in QUICK:
        kept = done / command
        if kept.exists():
            continue
        folder = Path(tempfile.mkdtemp(prefix="warm-", dir=world.folder))
        lay_out(folder, world, command)
        code, output = run(COMMANDS[command], folder, WARM_SECONDS)
        if code:
            raise SystemExit(f"the undamaged tdf {command} ends with {code}: {output}")
        folder.rename(kept)


def child(act: Callable[[], None], seconds: float) -> tuple[int | None, str]:
    """Call a function in a child; its exit code, None if it was too slow, and what it printed."""
    import jax._src.xla_bridge as bridge

    if bridge._backends:
        raise SystemExit("JAX has started in this process; its children would not be right")
    sys.stdout.flush()
    sys.stderr.flush()
    reading, writing = os.pipe()  # not a file, because some children must not write files
    number = os.fork()
    if number == 0:
        code = 1
        try:
            os.setsid()
            os.dup2(writing, 1)
            os.dup2(writing, 2)
            os.close(reading)
            os.close(writing)
            act()
            code = 0
        except SystemExit as end:
            code = end.code if isinstance(end.code, int) else 0 if end.code is None else 1
            if isinstance(end.code, str):
                print(end.code, file=sys.stderr)
        except BaseException:
            traceback.print_exc()
        finally:
            try:
                sys.stdout.flush()
                sys.stderr.flush()
            finally:
                os._exit(code)
    os.close(writing)
    end, printed, code = time.monotonic() + seconds, b"", None
    with open(reading, "rb", buffering=0) as pipe:
        while time.monotonic() < end:
            pid, status = os.waitpid(number, os.WNOHANG)
            while select.select([pipe], [], [], 0 if pid else 0.05)[0] and (piece := pipe.read(2**16)):
                printed += piece
            if pid:
                code = os.waitstatus_to_exitcode(status)
                break
        else:
            os.killpg(number, signal.SIGKILL)  # the child's own group, of which it is the first
            os.waitpid(number, 0)
    return code, printed.decode(errors="replace")


def run(words, folder: Path, seconds: float, around: Callable[[], None] = lambda: None) -> tuple[int | None, str]:
    """Run `tdf` in a folder; the exit code and what it printed."""

    def act():
        from tdf_jax.cli.main import main

        os.chdir(folder)
        around()
        main(words)

    return child(act, seconds)


def _import_all() -> None:
    """Import what commands import, so that children need not."""
    import importlib

    from tdf_jax.cli.main import COMMANDS as names

    for name in (*(f"tdf_jax.cli.{name}" for name in names), "trimesh", "scipy.spatial", "matplotlib.pyplot"):
        importlib.import_module(name)


def judge_command(case: CommandCase, folder: Path) -> tuple[str, str]:
    """Run a case, and judge its exit code, its output and what it wrote."""
    _import_all()
    before = snapshot(folder)
    code, output = run(case.words, folder, patience(), case.around)
    after = snapshot(folder)
    changed = sorted(name for name in before.keys() | after.keys() if before.get(name) != after.get(name))
    problem, verdict = None, REFUSED
    if code is None:
        problem = f"takes more than {patience():.0f} s"
    elif "Traceback (" in output:
        problem = "a traceback"
    elif code not in (0, 1, 2, 141):  # the last where nobody reads the output
        problem = f"exit code {code}"
    elif code and not re.search(r"tdf: \S|error|unrecognized|missing|required|invalid", output, re.IGNORECASE):
        problem = f"exit code {code} without a message"
    elif code and max(map(len, output.splitlines()), default=0) > LONGEST + 2 * sum(map(len, case.words)):
        problem = "a message without end"
    elif code == 2 and changed and case.command not in RESUMED:
        problem = f"refused, and writes {changed}"
    elif any(re.search(r"\.(unfinished|replaced)$", name) for name in changed):
        problem = f"leaves {changed}"
    elif code == 0:
        verdict = WARNED if "warning:" in output else RIGHT
        problem = _result_problem(case, folder)
    if problem is not None:
        return BAD, f"{problem}: {output}"
    if verdict not in case.expected:
        return BAD, f"{verdict}; expected {' or '.join(sorted(case.expected))}: {output}"
    return verdict, output[-2000:]


def _result_problem(case: CommandCase, folder: Path) -> str | None:
    """Say what is wrong with the results of a command that succeeded."""
    out = next((case.words[i + 1] for i, word in enumerate(case.words[:-1]) if word == "--out"), None)
    if case.command == "convert" and len(case.words) == 3:
        out = case.words[2]
    if out is None or any(word in case.words for word in ("-h", "--help")):
        return None
    path = folder / out
    whole = folder.parent / "warm" / case.command
    if case.command in {"imitate", "adam"}:
        record = json.loads((path / "result.json").read_text())
        with np.load(path / "trajectory.npz") as arrays:
            poses = arrays["wxyz_xyz"]
        if not np.isfinite(poses).all() or not np.isfinite(record["loss"]["end"]):
            return "the trajectory is not finite"
        if np.abs(np.linalg.norm(poses[:, :4], axis=1) - 1).max() > 1e-3:
            return "a quaternion is not of norm 1"
        if case.same:
            with np.load(whole / "out" / "trajectory.npz") as arrays:
                return differs(poses, arrays["wxyz_xyz"], 1e-3)
    if case.command == "demonstrate":
        with np.load(path) as arrays:
            if not all(np.isfinite(arrays[name]).all() for name in ("points", "wxyz_xyz", "query")):
                return "the demonstration is not finite"
            if case.same:
                return differs_as_set(arrays["points"], CLOUD) or differs(arrays["wxyz_xyz"], good.poses())
    if case.command == "landscape":
        with np.load(path / "landscape.npz") as arrays:
            if not np.isfinite(arrays["values"]).any():
                return "no energy is finite"
            if case.same:
                with np.load(whole / "out" / "landscape.npz") as expected:
                    return differs(arrays["values"], expected["values"], 1e-3)
    if case.command in {"convert", "shapes"} and not path.is_file():
        return "there is no result"
    if case.command == "convert" and case.same:
        return None if path.read_bytes() == (whole / "out.safetensors").read_bytes() else "other weights"
    if case.command == "dataset" and case.same:
        names = sorted(one.name for one in path.iterdir())
        return None if names == sorted(one.name for one in (whole / "out").iterdir()) else f"holds {names}"
    return None


# What is hostile


NUMBERS = (
    "nan",
    "inf",
    "-inf",
    "-1",
    "0",
    "1e999",
    "-0.0",
    "abc",
    "",
    " ",
    "1,5",
    "0x10",
    "1_000",
    "²",
    "1e-30",
    "1e30",
    "2.5",
    str(2**70),
    "None",
    "1 2",
    "--",
    "@",
    "\0",
)
# What cannot be meant by any number.
NO_NUMBERS = ("nan", "abc", "", " ", "1,5", "²", "None", "1 2", "@")
SMALL_ONLY = {"--num-poses", "--queries", "--points", "--num-starts", "--iterations", "--objects", "--count", "--pairs"}


def _is_number(word: str) -> bool:
    return re.fullmatch(r"-?\d+(\.\d+)?", word) is not None


def _hostile_file(rng, world, folder, words):
    """One of the files of a command replaced."""
    kinds = {
        "cloud.npy": (files.cloud_content, files.mesh_content), "demo.npz": (files.demonstration_content,),
        "t.tum": (files.trajectory_content,), "w.safetensors": (files.weights_content,),
        "c.pth": (files.checkpoint_content,),
    }  # fmt: skip
    name = one_of(rng, [word for word in words if word in kinds])
    index = words.index(name)
    data = (folder / name).read_bytes()
    draw = rng.random()
    if draw < 0.5:
        place = folder / "content"
        place.mkdir()
        case = one_of(rng, kinds[name])(rng, world, place)
        words[index] = str(next(place.iterdir()).relative_to(folder))
        return case.text, case.expected, False
    if draw < 0.75:
        place = folder / "path"
        place.mkdir()
        make = one_of(rng, [make for make in damage.PATHS if make is not damage.other_type])
        text, path, readable = make(rng, place, name, data)
        words[index] = str(path) if rng.random() < 0.5 or "\0" in str(path) else os.path.relpath(path, folder)
        return text, ONLY_RIGHT if readable else ONLY_REFUSED if readable is False else ANY, bool(readable)
    if name == "cloud.npy" and draw < 0.85:
        unit = one_of(rng, [1000, 100, 1e6])
        (folder / name).write_bytes(good.npy_bytes(CLOUD * np.float32(unit)))
        return f"the cloud times {unit:g}", DOUBT, False
    harm = one_of(rng, damage.BYTES)
    text, data = harm(rng, data)
    (folder / name).write_bytes(data)
    seen = harm in {damage.empty, damage.foreign, damage.noise, damage.truncated}
    return text, ONLY_REFUSED if seen else ANY, name in {"demo.npz", "w.safetensors", "c.pth"}


def _hostile_number(rng, words):
    """One number replaced."""
    places = [i for i, word in enumerate(words) if _is_number(word)]
    index = one_of(rng, places)
    value = one_of(rng, NUMBERS)
    option = next((word for word in reversed(words[:index]) if word.startswith("--")), "")
    before, words[index] = words[index], value
    refused = value in NO_NUMBERS or (
        value in {"inf", "-inf", "1e999", "2.5", "1e30", "1e-30", str(2**70), "0x10"} and "." not in before
    )
    return f"{option} {value!r}", ONLY_REFUSED if refused else ANY


def _hostile_words(rng, words):
    """Words missing, doubled, in another order, or unknown."""
    choice = int(rng.integers(9))
    index = int(rng.integers(len(words)))
    if choice == 0:
        gone = words.pop(index)
        return f"without {gone}", ANY
    if choice == 1:
        words.insert(index, words[index])
        return f"{words[index]} twice", ANY
    if choice == 2:
        words.append(
            one_of(rng, ["--stranger", "stray", "--out=", "--", "-x", "--json=maybe", "--no-such 3", "é", "--OUT", "-"])
        )
        return f"{words[-1]!r} at the end", ANY
    if choice == 3:
        rng.shuffle(words)
        return "words shuffled", ANY
    if choice == 4:
        words[0] = one_of(rng, ["imitat", "", "IMITATE", "tdf", "é", "--version", "help", "imitate;ls"])
        return f"the command {words[0]!r}", ONLY_REFUSED if words[0] != "--version" else ANY
    if choice == 5:
        words[:] = one_of(rng, [[], ["--help"], ["-h"], [""], ["--"], ["imitate", "--help"], ["\0"]])
        return f"the words {words}", ANY
    if choice == 6:
        places = [i for i, word in enumerate(words) if word.startswith("--")] or [0]
        place = one_of(rng, places)
        words[place] = words[place][:-1]
        return f"{words[place]} cut", ANY
    if choice == 7:
        place = one_of(rng, [i for i, word in enumerate(words) if word.startswith("--")] or [0])
        words[place] = one_of(
            rng, ["--scale", "--seed", "--category", "--method", "--grid", "--up", "--fold", "--clouds", "--config"]
        )
        return f"{words[place]} in place of another", ANY
    words[index] = one_of(
        rng, ["mug", "", "x" * 5000, "../../..", "/", "~", "$HOME", "*", "nan", "{}", "漢字", "\udce9"]
    )
    return f"word {index} is {words[index][:20]!r}", ANY


def _hostile_output(rng, folder, words, command):
    """Places for the results that cannot be used, or only with care."""
    index = words.index("--out") + 1 if "--out" in words else len(words) - 1
    suffix = Path(words[index]).suffix
    choice = int(rng.integers(12))
    expected, same = ONLY_REFUSED, False
    if choice == 0:
        words[index], text = f"file/out{suffix}", "in a file"
        (folder / "file").write_text("mine")
    elif choice == 1:
        words[index], text = f"none/out{suffix}", "in a folder that does not exist"
        expected = ANY
    elif choice == 2:
        words[index], text = "a" * 400 + suffix, "a long name"
    elif choice == 3:
        words[index], text = f"/proc/out{suffix}", "on a system folder"
    elif choice == 4:
        place = folder / words[index]
        place.mkdir()
        (place / "mine.txt").write_text("mine")
        text, expected = "a folder with a file of mine", ANY if command in RESUMED else ONLY_REFUSED
    elif choice == 5:
        (folder / words[index]).write_text("mine")
        text, expected, same = "a file of mine", ANY if suffix else ONLY_REFUSED, bool(suffix)
    elif choice == 6:
        (folder / words[index]).symlink_to(words[index])
        text, expected = "a link to itself", ANY if suffix else ONLY_REFUSED
    elif choice == 7:
        words[index], text = ".", "the current folder"
        expected = ANY if command in RESUMED else ONLY_REFUSED
    elif choice == 8:
        words[index], text, expected, same = f"ä 漢 🙂{suffix}", "a name of other languages", ONLY_RIGHT, True
    elif choice == 9:
        words[index], text, expected, same = os.fsdecode(b"caf\xe9" + suffix.encode()), "a name in Latin-1", ANY, True
    elif choice == 10:
        words[index], text = f"out\0{suffix}", "a name with a zero byte"
    else:
        words[index], text, expected = f"out{suffix}.bak", "another suffix", ONLY_REFUSED if suffix else ANY
    return text, expected, same


def _hostile_surroundings(rng, folder, command):
    """A full disk, a lost output, settings of the shell."""

    def full():
        import resource

        signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
        resource.setrlimit(resource.RLIMIT_FSIZE, (size, resource.getrlimit(resource.RLIMIT_FSIZE)[1]))

    def lost():
        target = os.open("/dev/full", os.O_WRONLY)
        os.dup2(target, 1)

    def closed():
        os.close(1)

    def broken():
        reading, writing = os.pipe()
        os.close(reading)
        os.dup2(writing, 1)

    def gone():
        (folder / "gone").mkdir()
        os.chdir(folder / "gone")
        os.rmdir(folder / "gone")

    def variable(name, value):
        return lambda: os.environ.__setitem__(name, value)

    size = int(rng.choice([0, 10, 100, 1000]))
    options = {
        f"room for {size} bytes": (full, ANY, False), "the output on /dev/full": (lost, ANY, False),
        "no output": (closed, ANY, False),
        "nobody reads the output": (broken, ANY, False), "the current folder is gone": (gone, ANY, False),
        "MPLBACKEND of a notebook": (variable("MPLBACKEND", "module://none.backend_inline"), ONLY_RIGHT, True),
        "JAX_PLATFORMS of another machine": (variable("JAX_PLATFORMS", "cuda"), ANY, False),
        "COLUMNS of 1": (variable("COLUMNS", "1"), ONLY_RIGHT, True),
        "LANG of C": (variable("LC_ALL", "C"), ONLY_RIGHT, True),
        "no HOME": (lambda: os.environ.pop("HOME", None), ONLY_RIGHT, True),
    }  # fmt: skip
    text = one_of(rng, list(options))
    return text, *options[text]


def command_case(rng, world: World, folder: Path) -> CommandCase:
    """A hostile command line."""
    if "_prepared" not in world.__dict__:
        prepare(world)
        world.__dict__["_prepared"] = True
    draw = rng.random()
    names = list(COMMANDS)
    if draw < 0.4:
        command = one_of(rng, ["imitate", "imitate", "demonstrate", "demonstrate", "landscape", "convert"])
        lay_out(folder, world, command)
        words = list(COMMANDS[command])
        text, expected, same = _hostile_file(rng, world, folder, words)
        return CommandCase(f"{command} file", text, command, words, expected, same)
    if draw < 0.6:
        command = one_of(rng, [name for name in names if name not in {"convert", "reproduce"}])
        lay_out(folder, world, command)
        words = list(COMMANDS[command])
        text, expected = _hostile_number(rng, words)
        if command not in QUICK:  # numbers that would be right take minutes
            while expected is not ONLY_REFUSED:
                words = list(COMMANDS[command])
                text, expected = _hostile_number(rng, words)
        return CommandCase("numbers", f"{command} {text}", command, words, expected)
    if draw < 0.76:
        command = one_of(rng, QUICK)
        lay_out(folder, world, command)
        words = list(COMMANDS[command])
        text, expected = _hostile_words(rng, words)
        return CommandCase("words", f"{command}: {text}", command, words, expected)
    command = one_of(rng, QUICK)
    lay_out(folder, world, command)
    words = list(COMMANDS[command])
    if draw < 0.9:
        text, expected, same = _hostile_output(rng, folder, words, command)
        return CommandCase("output", f"{command}: {text}", command, words, expected, same)
    text, around, expected, same = _hostile_surroundings(rng, folder, command)
    return CommandCase("surroundings", f"{command}: {text}", command, words, expected, same, around)
