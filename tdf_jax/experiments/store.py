"""What was computed, kept in a folder: an experiment that was interrupted does only what is missing."""

import dataclasses
import hashlib
import json
from collections.abc import Callable
from pathlib import Path

import jax
import numpy as np

from tdf_jax.errors import InputError
from tdf_jax.experiments.landscapes import Swept, figure2
from tdf_jax.experiments.run import Run, imitation
from tdf_jax.experiments.setting import SHAPES, Setting
from tdf_jax.files import replace_file
from tdf_jax.model import Model


class Store:
    """Runs and landscapes of one model, each computed once.

    Args:
        model: the network.
        directory: receives one .npz for each; its name is a digest of the setting and the weights.
    """

    def __init__(self, model: Model, directory: Path):
        self.model, self.directory = model, directory
        leaves = jax.tree.leaves(model.params)
        self._weights = hashlib.sha256(b"".join(np.asarray(leaf).tobytes() for leaf in leaves)).hexdigest()

    def run(self, setting: Setting) -> Run:
        """One imitation."""
        return Run(**self._kept(["run", dataclasses.asdict(setting)], lambda: dataclasses.asdict(imitation(self.model, setting))))

    def landscapes(self, base: Setting, field: str, count: int) -> dict[str, Swept]:
        """Figure 2 of one field, see `tdf_jax.experiments.landscapes.figure2`."""

        def swept():
            panels = figure2(self.model, base, field, count)
            return {f"{name}.{part}": value for name, panel in panels.items() for part, value in dataclasses.asdict(panel).items()}

        arrays = self._kept(["landscapes", dataclasses.asdict(base), field, count], swept)
        parts = [part.name for part in dataclasses.fields(Swept)]
        return {name: Swept(**{part: arrays[f"{name}.{part}"] for part in parts}) for name in SHAPES}

    def _kept(self, what: list, compute: Callable[[], dict]) -> dict:
        name = hashlib.sha256(json.dumps([self._weights, *what], sort_keys=True).encode()).hexdigest()[:20]
        path = self.directory / f"{name}.npz"
        if not path.exists():
            arrays = compute()
            replace_file("tdf reproduce", path, lambda file: np.savez(file, **arrays))
            return arrays
        try:
            with np.load(path) as file:
                return dict(file)
        except Exception as error:  # damaged files raise whatever their parser stumbles on
            raise InputError(f"tdf reproduce: {path} cannot be read ({error}); delete it, and run the command again") from None
