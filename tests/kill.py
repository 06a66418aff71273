"""Kill campaign: commands are killed at random moments and run again, and end with what an undisturbed run gives.

    python -m tests.kill --kills 100 --seed 0 --folder runs/kill

One run-through kills one command several times and then lets it end. After every kill, every file under its final name
must be whole, nothing finished may be gone or computed again, and no process may be left. At the end, the results must
equal those of an undisturbed run but for times, and nothing unfinished may be left. A campaign that is interrupted goes
on when it is started again with the same folder.
"""

import argparse
import contextlib
import dataclasses
import io
import json
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

HANG = 600  # seconds after which a run counts as hanging
LINGER = 30  # seconds in which the processes of a killed run must end
EARLIER = 1.0  # time of the files of a result that was there before, seconds
ENDINGS = re.compile(r"\..*\.[0-9a-f]{16}\.(unfinished|replaced)")
CODE = """
import sys
from tdf_jax.cli import landscape, main
from tdf_jax.training import dataset
landscape.SAVE_SECONDS, dataset.SHARD = 0.0, 2  # as if the work were long
main.main()
"""
NETWORK = ("latent=4", "vector-hidden=6", "vector-width=12", "decoder-width=8", "blocks=2")
OBJECTS = ("--points", "400", "--queries", "100", "--cameras", "4", "--validation", "2")
SCENE = ("--weights", "../small.safetensors", "--points", "60", "--num-poses", "3", "--queries", "8")


@dataclasses.dataclass(frozen=True)
class Command:
    """A command with tiny settings.

    Attributes:
        words: its words; the result is `out`.
        parts: the finished parts in the folder of a run-through, each with what a rerun must not change; None if all
            is finished, so that a rerun begins again.
    """

    words: tuple[str, ...]
    parts: Callable[[Path], dict[str, object] | None]


def files(pattern: str) -> Callable[[Path], dict[str, object]]:
    """Finished parts that are files, which are never written again."""
    return lambda folder: {
        str(path.relative_to(folder)): path.stat().st_mtime_ns
        for path in folder.glob(pattern)
        if not ENDINGS.fullmatch(path.name)
    }


def steps(folder: Path) -> dict[str, object]:
    """Steps up to the checkpoint of a training run, each with the time that its metrics have."""
    from flax import serialization

    path, metrics = folder / "out" / "state.msgpack", folder / "out" / "metrics.jsonl"
    if not path.exists():
        return {}
    done = int(serialization.msgpack_restore(path.read_bytes())["step"])
    rows = [json.loads(line) for line in metrics.read_text().split("\n")[:-1]]
    return {f"step {row['step']}": row["seconds"] for row in rows if row["step"] <= done}


def tiles(folder: Path) -> dict[str, object] | None:
    """Tiles of an unfinished sweep."""
    path, result = folder / "out.unfinished.npz", folder / "out" / "result.json"
    if not path.exists():
        return None if result.exists() and result.stat().st_mtime > EARLIER else {}
    with np.load(path) as arrays:
        done = json.loads(str(arrays["header"]))["about"]["done"]
    return {f"tile {tile}": True for tile in range(1, done + 1)}


COMMANDS = {
    "train": Command(
        (
            "train", "--data", "../data", "--out", "out", "--steps=300", "--batch=2", "--points=32", "--queries=16",
            "--box=4", "--num-poses=2", "--warmup=2", "--validate-every=150", "--save-seconds=0",
            *(f"--network.{size}" for size in NETWORK),
        ),
        steps,
    ),
    "dataset": Command(
        ("dataset", "--out", "out", "--objects", "40", *OBJECTS, "--workers", "2"), files("out/*.npz")
    ),
    "landscape": Command(
        (
            "landscape", *SCENE, "--half", "0.1", "--pitch", "0.05", "--rotation", "turns", "--rotations", "64",
            "--out", "out",
        ),
        tiles,
    ),
    "benchmark": Command(
        (
            "benchmark", "--weights", "../small.safetensors", "--pairs", "8", "--methods", "copy", "centroids", "PCA",
            "--out", "out",
        ),
        files("out/runs/*.npz"),
    ),
    "imitate": Command(
        ("imitate", *SCENE, "--method", "adam", "--num-starts", "3", "--iterations", "3", "--out", "out"),
        lambda folder: {},
    ),
}  # fmt: skip


def main() -> None:
    """Run or continue a campaign, print its table, and exit with 1 if anything is wrong."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--kills", type=int, default=100)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--folder", type=Path, default=Path("runs/kill"))
    parser.add_argument("--commands", nargs="+", choices=COMMANDS, default=list(COMMANDS))
    options = parser.parse_args()
    records = campaign(options.folder.resolve(), options.kills, options.seed, options.commands)
    print(table(records))
    sys.exit(any(record["problems"] for record in records))


def campaign(folder: Path, kills: int, seed: int, commands=tuple(COMMANDS)) -> list[dict]:
    """Records of run-throughs with at least so many kills together, of a folder that keeps them.

    Args:
        folder: folder of the campaign, made if it is missing.
        kills: number of kills.
        seed: seed of the moments.
        commands: names of `COMMANDS`, taken in turn.
    """
    folder.mkdir(parents=True, exist_ok=True)
    log = folder / "records.jsonl"
    records = [json.loads(line) for line in log.read_text().splitlines()] if log.exists() else []
    prepare(folder)
    while sum(len(record["kills"]) for record in records) < kills:
        name = commands[len(records) % len(commands)]
        expected, first, last = undisturbed(folder, name)
        rng = np.random.default_rng([seed, len(records)])
        record = run_through(folder, name, expected, first, last, rng, number=len(records))
        records.append(record)
        with log.open("a") as file:
            file.write(json.dumps(record) + "\n")
        print(json.dumps(record), flush=True)
    return records


def table(records: list[dict]) -> str:
    """The campaign in Markdown."""
    lines = ["| command | run-throughs | kills | with parts finished | problems |", "|---|---|---|---|---|"]
    for name in dict.fromkeys(record["command"] for record in records):
        own = [record for record in records if record["command"] == name]
        kills = [kill for record in own for kill in record["kills"]]
        problems = sum(len(record["problems"]) for record in own)
        lines.append(
            f"| {name} | {len(own)} | {len(kills)} | {sum(kill['parts'] > 0 for kill in kills)} | {problems} |"
        )
    return "\n".join(lines)


def prepare(folder: Path) -> None:
    """Make the inputs: a data set, and weights of a small random network."""
    weights = folder / "small.safetensors"
    if weights.exists():
        return
    import jax

    import tdf_jax as tdf
    from tdf_jax.networks.occupancy import initialise

    with started(folder, folder, ("dataset", "--out", "data", "--objects", "4", *OBJECTS, "--workers", "1")) as run:
        assert run.wait() == 0
    sizes = {name.replace("-", "_"): int(size) for name, _, size in (one.partition("=") for one in NETWORK)}
    config = tdf.NetworkConfig(**sizes)
    info = tdf.ModelInfo("small", "random numbers", cloud_points=40)
    tdf.save_model(tdf.Model(initialise(jax.random.key(0), config), config, info), weights)


def undisturbed(folder: Path, name: str) -> tuple[dict[str, object], float, float]:
    """Results of an undisturbed run, and the seconds to its first file and to its end; kept in the folder."""
    own, about = folder / f"undisturbed-{name}", folder / f"undisturbed-{name}.json"
    if not about.exists():
        results = []
        for _ in range(2):  # the first run fills the cache of compiled programs
            shutil.rmtree(own, ignore_errors=True)
            own.mkdir()
            began, first = time.monotonic(), None
            with started(folder, own, COMMANDS[name].words) as run:
                while run.poll() is None:
                    first = time.monotonic() - began if first is None and any(own.iterdir()) else first
                    time.sleep(0.01)
            assert run.returncode == 0 and first is not None, f"{name} does not run"
            seconds = first, time.monotonic() - began
            results.append(content(own))
        different = differences(*results)
        assert not different, f"two undisturbed runs of {name} differ: {different}"
        about.write_text(json.dumps(seconds))
    return content(own), *json.loads(about.read_text())


@contextlib.contextmanager
def started(folder: Path, place: Path, words):
    """A command that runs in a place below the folder of a campaign, as a session of its own."""
    temporary = folder / "tmp"
    temporary.mkdir(exist_ok=True)
    environment = os.environ | {
        "TMPDIR": str(temporary),
        "PYTHONPATH": str(Path(__file__).parents[1]),
        "JAX_COMPILATION_CACHE_DIR": str(folder / "compiled"),
        "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0",
        "JAX_PERSISTENT_CACHE_MIN_ENTRY_SIZE_BYTES": "0",
    }
    words = [sys.executable, "-c", CODE, *words]
    with (folder / "messages").open("w") as messages:
        run = subprocess.Popen(
            words, cwd=place, env=environment, stdout=messages, stderr=messages, start_new_session=True
        )
        try:
            yield run
        finally:
            with contextlib.suppress(ProcessLookupError):
                os.killpg(run.pid, signal.SIGKILL)
            run.wait()


def run_through(folder: Path, name: str, expected, first: float, last: float, rng, number: int) -> dict:
    """Kill a command several times, let it end, and compare.

    Args:
        folder: folder of the campaign.
        name: name of the command.
        expected: content of an undisturbed run.
        first: seconds to its first file.
        last: seconds to its end.
        rng: draws the moments.
        number: number of the run-through.

    Returns:
        A record: the command, its kills, and problems in words.
    """
    place, command = folder / f"through-{number:03d}", COMMANDS[name]
    shutil.rmtree(place, ignore_errors=True)
    place.mkdir()
    replaces = name in ("imitate", "landscape") and rng.random() < 0.5
    if replaces:
        shutil.copytree(folder / f"undisturbed-{name}" / "out", place / "out")
        for path in (place / "out").iterdir():
            os.utime(path, (EARLIER, EARLIER))
    kills, problems, parts = [], [], {}
    finishes = rng.random() < 0.5  # the first kill comes with the first finished part, however fast the machine is
    for number_of_kill in range(rng.integers(2, 6)):
        # Most kills come after the first change of a file, however busy the machine is.
        wait, delay = (0.0, rng.uniform(0, first)) if rng.random() < 0.15 else (HANG, rng.uniform(0, last - first))
        state = changes
        if finishes and number_of_kill == 0:
            state, wait, delay = command.parts, HANG, 0.0
        before = state(place)
        with started(folder, place, command.words) as run:
            began = time.monotonic()
            while time.monotonic() - began < wait and run.poll() is None and state(place) == before:
                time.sleep(0.01)
            try:
                run.wait(delay)
                break  # it ended before
            except subprocess.TimeoutExpired:
                run.kill()
            run.wait()
            moment = time.monotonic() - began
            problems += left_processes(run.pid)
        problems += broken(place) + tracebacks(folder)
        if replaces and not (place / "out").is_dir() and not list(place.glob(".out.*.replaced")):
            problems.append("the earlier result is lost")
        now = command.parts(place)
        problems += lost(parts, now)
        parts = now or {}
        kills.append({"seconds": round(moment, 2), "parts": len(parts), "files": sum(1 for _ in place.rglob("*"))})
    with started(folder, place, command.words) as run:
        try:
            code = run.wait(HANG)
        except subprocess.TimeoutExpired:
            code = "a hang"
    if code != 0:
        problems.append(f"the last run ended with {code}: {(folder / 'messages').read_text()[-2000:]}")
    problems += tracebacks(folder) + differences(expected, content(place)) + lost(parts, command.parts(place))
    problems += [f"tmp/{path.name} is left" for path in (folder / "tmp").glob("tdf*")]
    if not problems:
        shutil.rmtree(place)
    return {"command": name, "number": number, "replaces": replaces, "kills": kills, "problems": problems}


def changes(folder: Path) -> dict[str, int]:
    """Times of the last changes below a folder."""
    times = {}
    for path in folder.rglob("*"):
        with contextlib.suppress(FileNotFoundError):
            times[str(path)] = path.stat().st_mtime_ns
    return times


def lost(before: dict[str, object], now: dict[str, object] | None) -> list[str]:
    """Parts that were finished before and are not now, or that were computed again."""
    if now is None:
        return []
    problems = [f"{part} is lost" for part in before if part not in now]
    return problems + [f"{part} was computed again" for part in before if part in now and before[part] != now[part]]


def tracebacks(folder: Path) -> list[str]:
    """What the last run said, if that is a traceback."""
    messages = (folder / "messages").read_text()
    return [f"a traceback: {messages[-2000:]}"] if "Traceback" in messages else []


def left_processes(group: int) -> list[str]:
    """Wait until no process of a killed run is left."""
    deadline = time.monotonic() + LINGER
    while time.monotonic() < deadline:
        try:
            os.killpg(group, 0)
        except ProcessLookupError:
            return []
        time.sleep(0.05)
    return ["processes are left"]


def broken(folder: Path) -> list[str]:
    """Files under their final names that cannot be read whole."""
    problems = []
    for path in folder.rglob("*"):
        if path.is_file() and not any(ENDINGS.fullmatch(part) for part in path.relative_to(folder).parts):
            try:
                read(path)
            except Exception as error:
                problems.append(f"{path.name} is half-written ({type(error).__name__}: {error})")
    return problems


def content(folder: Path) -> dict[str, object]:
    """Everything below a folder, by name, without times."""
    return {
        str(path.relative_to(folder)): read(path) if path.is_file() else "folder" for path in sorted(folder.rglob("*"))
    }


def read(path: Path) -> object:
    """A file, read whole, without times, so that equal ones are equal."""
    if path.suffix == ".json":
        return timeless(json.loads(path.read_text()))
    if path.suffix == ".jsonl":  # a log: a kill may cut its last line
        lines = path.read_text().split("\n")
        return timeless([json.loads(line) for line in lines[:-1]])
    if path.suffix == ".npz":
        with path.open("rb") as file, np.load(file) as arrays:
            return {name: array_of(arrays[name]) for name in arrays.files if "seconds" not in name}
    if path.suffix == ".msgpack":
        import jax
        from flax import serialization

        leaves, _ = jax.tree.flatten_with_path(serialization.msgpack_restore(path.read_bytes()))
        return {jax.tree_util.keystr(key): array_of(leaf) for key, leaf in leaves}
    if path.suffix == ".safetensors":
        import safetensors.numpy

        return {name: array_of(array) for name, array in safetensors.numpy.load(path.read_bytes()).items()}
    if path.suffix in (".png", ".gif"):
        from PIL import Image, ImageSequence

        with Image.open(io.BytesIO(path.read_bytes())) as picture:
            return [array_of(np.asarray(frame.convert("RGB"))) for frame in ImageSequence.Iterator(picture)]
    if path.suffix == ".md":  # numbers are in the .json beside it; their columns depend on the times
        return re.sub(r"[-+ |]+", " ", re.sub(r"\d+(\.\d+)?", "#", path.read_text()))
    return path.read_text()


def array_of(array) -> tuple:
    """An array as a value that can be compared."""
    array = np.asarray(array)
    if array.dtype.kind == "U":  # the header of a landscape, with its settings and its time
        return ("text", str(timeless(json.loads(str(array)))))
    return (array.dtype.str, array.shape, array.tobytes())


def timeless(value):
    """A JSON value without the keys that are times."""
    if isinstance(value, dict):
        return {key: timeless(item) for key, item in value.items() if "seconds" not in key}
    return [timeless(item) for item in value] if isinstance(value, list) else value


def differences(expected: dict, found: dict) -> list[str]:
    """How the content of a folder differs from the expected one."""
    problems = [f"{name} is missing" for name in expected if name not in found]
    problems += [f"{name} is too much" for name in found if name not in expected]
    return problems + [f"{name} differs" for name in expected if name in found and expected[name] != found[name]]


if __name__ == "__main__":
    main()
