"""What was computed, kept in a folder: an experiment that was interrupted does only what is missing."""

import dataclasses
import json
from collections.abc import Callable
from importlib.metadata import version
from pathlib import Path
from typing import Any

from tdf_jax._internal.files import kept
from tdf_jax.networks.model import Model, fingerprint
from tdf_jax.paper.energy_maps import Swept, figure2
from tdf_jax.paper.runs import Run, imitation
from tdf_jax.paper.setting import SHAPES, Setting

FORMAT = 2  # of the files, and of what they hold: raised when a run is computed otherwise


class Store:
    """Runs and landscapes of one model, each computed once.

    Args:
        model: the network.
        directory: receives one .npz for each; its name is a digest of the setting and the weights.
    """

    def __init__(self, model: Model, directory: Path):
        self.model, self.directory = model, directory
        # All that a result depends on, so that a folder never mixes what different versions computed.
        self._about = [FORMAT, version("tdf_jax"), fingerprint(model)]

    def run(self, setting: Setting) -> Run:
        """One imitation."""
        return self._kept(
            ["run", setting], lambda: dataclasses.asdict(imitation(self.model, setting)), lambda arrays: Run(**arrays)
        )

    def landscapes(self, base: Setting, field: str, count: int) -> dict[str, Swept]:
        """Figure 2 of one field, see `tdf_jax.paper.energy_maps.figure2`."""

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
        return kept("Store", self.directory, plain, compute, build)
