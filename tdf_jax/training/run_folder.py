"""The folder of a run: settings, metrics as JSON lines, and a checkpoint. An interrupted run resumes from it."""

import json
from pathlib import Path

import jax
import jax.numpy as jnp
from flax import serialization

from tdf_jax._internal.errors import InputError
from tdf_jax._internal.files import replace_file
from tdf_jax.networks import occupancy
from tdf_jax.training import config

CONFIG, METRICS, STATE = "config.json", "metrics.jsonl", "state.msgpack"


def claim(directory: Path, settings: dict) -> None:
    """Write the settings of a run, or compare them with those in the folder; only `steps` may differ.

    Args:
        directory: folder of the run; it is made if it does not exist.
        settings: JSON values, as `dataclasses.asdict` gives of `TrainConfig`, and digests of the inputs.

    Raises:
        InputError: the folder holds a run with other settings, or cannot be written.
    """
    try:
        directory.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"train(): cannot make the folder {directory} ({error}); expected a writable place") from None
    old = settings_of(directory)
    changed = [] if old is None else [name for name in settings if name != "steps" and old.get(name) != settings[name]]
    if changed:
        raise InputError(
            f"train(): {directory} holds a run with other settings ({', '.join(changed)}); expected the same. "
            "Choose another directory, or delete this one."
        )
    replace_file("train()", directory / CONFIG, json.dumps(settings, indent=1).encode())


def settings_of(directory: Path) -> dict | None:
    """Settings of the run in a folder, under today's names; None if there is no run."""
    path = directory / CONFIG
    return _read(path, lambda content: _current(dict(json.loads(content)))) if path.exists() else None


def _current(settings: dict) -> dict:
    """Settings that the release before may have written, under today's names."""
    settings = {config.FORMER_FIELDS.get(name, name): value for name, value in settings.items()}
    network = settings.get("network")
    if isinstance(network, dict):
        settings["network"] = {occupancy.FORMER_FIELDS.get(name, name): value for name, value in network.items()}
    return settings


def save(directory: Path, params, state, step: int) -> None:
    """Write the checkpoint."""
    replace_file("train()", directory / STATE, serialization.to_bytes({"params": params, "state": state, "step": step}))


def restore(directory: Path, params, state) -> tuple:
    """Parameters, optimiser state and step of the checkpoint; the arguments and 0 if there is no checkpoint."""
    path = directory / STATE
    if not path.exists():
        return params, state, 0
    target = {"params": params, "state": state, "step": 0}
    saved = _read(path, lambda content: jax.tree.map(jnp.asarray, serialization.from_bytes(target, content)))
    shapes = [[leaf.shape for leaf in jax.tree.leaves(tree)] for tree in (target["params"], saved["params"])]
    if shapes[0] != shapes[1]:
        raise InputError(
            f"train(): {path} is a checkpoint of another network; expected one of these settings. "
            "Choose another directory."
        )
    return saved["params"], saved["state"], int(saved["step"])


def metrics(directory: Path) -> list[dict]:
    """The rows of a run's metrics, without a line that is damaged or that an interruption cut short."""
    path = directory / METRICS
    rows = (_row(line) for line in path.read_text(errors="replace").splitlines()) if path.exists() else ()
    return [row for row in rows if row is not None]


def add_metrics(directory: Path, row: dict) -> None:
    """Add a row to a run's metrics.

    Args:
        directory: folder of the run.
        row: metrics of a step, as JSON has them.

    Raises:
        InputError: the file cannot be written.
    """
    path = directory / METRICS
    try:
        # Closed at once: what a full disk has no room for must not wait in a buffer.
        with path.open("a") as file:
            file.write(json.dumps(row) + "\n")
    except OSError as error:
        raise InputError(
            f"train(): cannot write {path} ({error.strerror or error}); expected a writable file. Free some room if "
            "the disk is full, and run again to resume"
        ) from None


def drop_later_metrics(directory: Path, step: int) -> None:
    """Remove the metrics of steps after a checkpoint, which a resumed run repeats."""
    rows = [row for row in metrics(directory) if row["step"] <= step]
    replace_file("train()", directory / METRICS, "".join(json.dumps(row) + "\n" for row in rows).encode())


def _row(line):
    try:
        row = json.loads(line)
    except (ValueError, RecursionError):
        return None
    return row if isinstance(row, dict) and isinstance(row.get("step"), int) else None


def _read(path, parse):
    try:
        return parse(path.read_bytes())
    except Exception as error:  # damaged files raise whatever their parser stumbles on
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise InputError(
            f"train(): {path} cannot be read ({reason}): it is damaged or of another version. Delete the folder, or "
            "restore the file"
        ) from None
