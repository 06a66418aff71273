"""`tdf imitate --targets`: the objects of a folder, with a folder of results for each."""

import dataclasses
import json
import sys
from collections.abc import Callable
from pathlib import Path

import tdf_jax
from tdf_jax._internal.errors import InputError
from tdf_jax.cli.options import Settings, resolved
from tdf_jax.io.mesh_folder import file_names
from tdf_jax.io.pointclouds import SUFFIXES

# Options that make or read the new object otherwise.
CONTRADICTING = ("target", "task", "depth")
# Settings that change no file.
SILENT = ("json",)


def imitate_targets(
    settings: Settings, imitate: Callable[[Settings], dict], plain: Callable[[dict], dict], result: str
) -> list[dict]:
    """Imitate on every mesh and cloud of a folder. What an interrupted run has done with the same settings is kept.

    Args:
        settings: settings of the command; `out` gets a folder for each file, with its name.
        imitate: imitates on one object, writes its folder and returns the record.
        plain: settings as the record has them.
        result: name of the record's file.

    Returns:
        The records, in the order of the files' names.

    Raises:
        InputError: the folder has no mesh or cloud, options contradict each other, or, in the end, objects were
            refused; the others are complete.
    """
    for name in CONTRADICTING:
        if getattr(settings, name) is not None:
            raise InputError(f"tdf imitate: --{name} and --targets name new objects; drop one of them")
    if settings.animation is not None:
        raise InputError(
            "tdf imitate: --animation is one film, which every object of --targets would overwrite; drop one of them, "
            "and film a single object by --target"
        )
    folder = settings.targets
    if folder is None or not folder.is_dir():
        raise InputError(f"tdf imitate: --targets is {folder}; expected a folder of meshes or point clouds")
    names = [name for name in file_names("tdf imitate", folder, False) if _is_object(name)]
    if not names:
        raise InputError(
            f"tdf imitate: --targets {folder} has no mesh and no point cloud; expected files with one of the suffixes "
            f"{', '.join(SUFFIXES)}"
        )
    if (settings.out / result).exists():
        raise InputError(
            f"tdf imitate: --out {settings.out} is the result of one object; expected another folder, which gets one "
            "for each"
        )
    several = [
        resolved(dataclasses.replace(settings, targets=None, target=folder / name, out=settings.out / name))
        for name in names
    ]
    try:
        settings.out.mkdir(exist_ok=True)
    except OSError as error:
        raise InputError(
            f"tdf imitate: cannot write {settings.out} ({error.strerror or error}); expected a place in an existing, "
            "writable folder"
        ) from None
    records, refused = [], []
    for number, (name, one) in enumerate(zip(names, several, strict=True), start=1):
        record = _done(one, plain, result)
        words = "done before"
        if record is None:
            try:
                record, words = imitate(one), ""
            except InputError as error:
                refused.append(name)
                print(f"{number}/{len(names)} {name}: refused: {error}", file=sys.stderr, flush=True)
                continue
        records.append(record)
        if not settings.json:
            print(_line(f"{number}/{len(names)} {name}", record, words), flush=True)
    if refused:
        raise InputError(
            f"tdf imitate: {len(refused)} of {len(names)} objects were refused: {', '.join(refused)}; the results of "
            f"the others are complete, in {settings.out}. Correct these files and run the command again"
        )
    return records


def _is_object(name: str) -> bool:
    return Path(name).suffix.lower() in SUFFIXES and not name.startswith(".")


def _done(settings: Settings, plain: Callable[[dict], dict], result: str) -> dict | None:
    """The record of an earlier run with the same settings, version and file; None if there is none."""
    path = settings.out / result
    try:
        if settings.target is None or path.stat().st_mtime < settings.target.stat().st_mtime:
            return None
        record = json.loads(path.read_text())
        wanted, before = plain(dataclasses.asdict(settings)), dict(record["settings"])
        same = all(before.get(name) == wanted[name] for name in wanted if name not in SILENT)
        return record if same and record["tdf_jax"] == tdf_jax.__version__ else None
    except (OSError, ValueError, KeyError, TypeError):
        return None


def _line(name: str, record: dict, words: str) -> str:
    """An object in one line."""
    parts = [f"loss {record['loss']['end']:.5f}"]
    if record["confidence"] is not None:
        parts.append(f"confidence {record['confidence']:.2f}")
    if record["recognised"] is not None:
        parts.append(f"recognised {record['recognised']:.2f}")
    parts.append(words or f"{record['seconds']['total']:.1f} s")
    return f"{name}: {', '.join(parts)}"
