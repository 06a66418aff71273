"""Checks before any timing: the peer is the original network, and both sides have equal energies and gradients."""

from pathlib import Path

import numpy as np

import tdf_jax as tdf
from bench import scene
from bench.measure import check, difference
from bench.workers import Workers
from tdf_jax._internal.errors import InputError

GOLDEN = Path(__file__).resolve().parents[1] / "tests" / "fixtures" / "ndf_latent32"
ORIGINAL = {"float32": 5e-5, "float64": 1e-10}
ENERGIES, GRADIENTS = 1e-5, 1e-3  # gradients contain signs of differences, and rounding changes some of them


def parity(workers: Workers, num_starts: int = 3, poses: int = 7, queries: int = 100) -> list[dict]:
    """All checks, by the competitors' own processes.

    Args:
        workers: the competitors' processes.
        num_starts: number of starts of the energies that are compared.
        poses: number of poses.
        queries: number of query points.

    Raises:
        InputError: the golden outputs are not there.
    """
    return original(workers) + energies(workers, num_starts, poses, queries)


def original(workers: Workers) -> list[dict]:
    """The peer's latents, descriptors and occupancies against those of the published code."""
    if not GOLDEN.with_suffix(".npz").exists():
        raise InputError(
            f"parity(): there are no golden outputs {GOLDEN}.npz; expected a checkout of the repository with its tests"
        )
    state = scene.weights(tdf.convert_checkpoint(GOLDEN.with_suffix(".pth")))
    with np.load(GOLDEN.with_suffix(".npz")) as stored:
        arrays = {name: stored[name] for name in ("point_cloud", "coords", "latent", "features", "occupancy")}
    inputs = {name: arrays[name] for name in ("point_cloud", "coords")}
    checks = []
    for precision, tolerance in ORIGINAL.items():
        settings = {"double": precision == "float64"}
        workers.ask("torch", "prepare", {"task": "golden", "settings": settings, "arrays": inputs, "state": state})
        found = workers.ask("torch", "run")["result"]
        names = ("latent", "features", "occupancy")
        checks += [
            check(f"original, {name}, {precision}", difference(found[name], arrays[name]), tolerance) for name in names
        ]
    return checks


def energies(workers: Workers, num_starts: int, poses: int, queries: int) -> list[dict]:
    """Energies of random starts and the gradients of their free poses, every competitor against the first."""
    state, arrays = scene.weights(tdf.load_model("mug")), scene.imitation(num_starts, poses, queries)
    found = {}
    for name in ("torch", "torch_tuned", "tdf_jax"):
        workers.ask(name, "prepare", {"task": "gradient", "settings": {}, "arrays": arrays, "state": state})
        found[name] = workers.ask(name, "run")["result"]
    # The fixed last pose lies where eq. 3's norm has its kink: which way its derivative points there is a matter of
    # rounding.
    found = {
        name: {kind: part if kind == "energies" else part[:, :-1] for kind, part in result.items()}
        for name, result in found.items()
    }
    expected = found.pop("torch")
    return [
        check(
            f"{kind}, {name} and torch",
            difference(result[kind], expected[kind]),
            ENERGIES if kind == "energies" else GRADIENTS,
        )
        for name, result in found.items()
        for kind in expected
    ]
