"""Computed runs, kept in a folder: an experiment that was interrupted computes only what is missing."""

import dataclasses
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

from tdf_jax._internal.cache import kept
from tdf_jax._internal.version import __version__
from tdf_jax.networks.model import Model, fingerprint
from tdf_jax.paper.energy_maps import Swept, figure2
from tdf_jax.paper.runs import Run, imitation
from tdf_jax.paper.setting import SHAPES, Setting

FORMAT = 3  # format number; raise it when the computation of a run or the content of a file changes


class Store:
    """Runs and landscapes of one model, each computed once.

    Args:
        model: the network.
        directory: existing folder of .npz files, one for each result; their names are digests of the setting and the
            weights.
    """

    def __init__(self, model: Model, directory: Path):
        self.model, self.directory = model, directory
        # These values are in every digest, so that a folder never mixes results of different versions.
        self._about = [FORMAT, __version__, fingerprint(model)]

    def run(self, setting: Setting) -> Run:
        """Load or compute the run of a setting."""
        return self._kept(
            ["run", setting], lambda: dataclasses.asdict(imitation(self.model, setting)), lambda arrays: Run(**arrays)
        )

    def landscapes(self, base: Setting, field: str, count: int) -> dict[str, Swept]:
        """Load or compute the panels of one field in figure 2, see `tdf_jax.paper.energy_maps.figure2`."""

        def swept():
            panels = figure2(self.model, base, field, count)
            return {
                f"{name}.{part}": value
                for name, panel in panels.items()
                for part, value in dataclasses.asdict(panel).items()
            }

        def panels(arrays):
            parts = [part.name for part in dataclasses.fields(Swept)]
            return {name: Swept(**{part: arrays[f"{name}.{part}"] for part in parts}) for name in SHAPES}

        return self._kept(["landscapes", base, field, count], swept, panels)

    def _kept(self, what: list, compute: Callable[[], dict], build: Callable[[dict], Any]) -> Any:
        about = [self._about, what]
        # Settings are dataclasses.
        plain = json.loads(json.dumps(about, default=dataclasses.asdict))
        return kept("tdf reproduce", self.directory, plain, compute, build)
