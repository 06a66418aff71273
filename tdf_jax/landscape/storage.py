"""The energy field of eq. 4 over a grid: every waypoint's descriptor loss with the query frame at each of its points."""

import dataclasses
import json
import os
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int

from tdf_jax._internal.errors import InputError
from tdf_jax._internal.files import replace_file
from tdf_jax.geometry.grid import Grid

REDUCTIONS = ("least", "soft_least", "assigned", "mean")
TEMPERATURE = 5e-4  # of the soft least; a waypoint's energy is some 0.002 where it is met and 0.01 far away
FORMAT = 1  # of files; raised when a field changes its meaning or goes
FRAME = "world"


@dataclasses.dataclass(frozen=True, eq=False)
class Landscape:
    """Energies over a grid of the world; NaN where the grid's mask is false.

    Attributes:
        grid: where.
        values: every waypoint's part of eq. 2 with the query frame's origin at the grid's points: (poses, *grid.shape),
            the least over `rotations`, or (poses, rotations, *grid.shape) if each was kept.
        waypoints: the demonstration's positions, its centroid moved to the object's, metres.
        rotations: orientations R_world_query of the sweep, (rotations, 3, 3).
        turned: which rotation has the least energy, as `values`; None if each was kept.
        reduce: how `combined` comes from `values`, one of `REDUCTIONS`.
        temperature: of the soft least, in units of the energy.
    """

    grid: Grid
    values: Float[np.ndarray, " poses *shape"]
    waypoints: Float[np.ndarray, "poses 3"]
    rotations: Float[np.ndarray, "rotations 3 3"]
    turned: Int[np.ndarray, " poses *shape"] | None = None
    reduce: str = "least"
    temperature: float = TEMPERATURE

    def __post_init__(self):
        if self.reduce not in REDUCTIONS:
            raise InputError(f"Landscape(): reduce is {self.reduce!r}; expected one of {', '.join(REDUCTIONS)}")
        if not 0 < self.temperature < np.inf:
            raise InputError(f"Landscape(): temperature is {self.temperature}; expected an energy above 0")
        shape = (len(self.waypoints), *self.grid.shape)
        each = (len(self.waypoints), len(self.rotations), *self.grid.shape)
        if self.values.shape != (shape if self.turned is not None else each):
            raise InputError(
                f"Landscape(): values have shape {self.values.shape}; expected {each}, or {shape} with the rotation of each in `turned`"
            )

    @property
    def combined(self) -> Float[np.ndarray, "*shape"]:
        """E(x), one energy of all waypoints at a point; for each rotation if each was kept.

        - "least": the least of the waypoints' energies.
        - "soft_least": -T log(mean exp(-E_i / T)), T the temperature: between the least and the mean, and smooth.
        - "assigned": the energy of the waypoint whose distance from the first one is nearest to the point's: rings, as
        in the paper's
          figures.
        - "mean": the mean, eq. 2 of a trajectory whose waypoints all stand there.
        """
        if self.reduce == "mean":
            return self.values.mean(axis=0)
        if self.reduce == "soft_least":
            least = self.values.min(axis=0)
            return least - self.temperature * np.log(np.mean(np.exp((least - self.values) / self.temperature), axis=0))
        if self.reduce == "assigned":
            ring = self.rings
            if self.values.ndim > ring.ndim + 1:
                ring = np.broadcast_to(ring, self.values.shape[1:])
            return np.take_along_axis(self.values, ring[None], axis=0)[0]
        return self.values.min(axis=0)

    @property
    def rings(self) -> Int[np.ndarray, "*shape"]:
        """Which waypoint every point is assigned to: the one as far from the first waypoint as the point is, or nearest to that."""
        first = self.waypoints[0]
        apart = np.linalg.norm(self.grid.points - first, axis=-1)
        return np.abs(apart[..., None] - np.linalg.norm(self.waypoints - first, axis=-1)).argmin(axis=-1)

    @property
    def minimisers(self) -> Float[np.ndarray, "poses 3"]:
        """x_i* of eq. 5: the grid's point where each waypoint's energy is least, metres, world frame."""
        return self.grid.points.reshape(-1, 3)[self._best[1]]

    @property
    def minimiser_rotations(self) -> Float[np.ndarray, "poses 3 3"]:
        """The orientation R_world_query of each minimiser."""
        rotation, point = self._best
        if self.turned is not None:
            rotation = np.take_along_axis(self.turned.reshape(len(self.values), -1), point[:, None], axis=1)[:, 0]
        return self.rotations[rotation]

    @property
    def _best(self):
        """Indices of each waypoint's least energy: of the rotation, if each was kept, and of the point."""
        flat = self.values.reshape(len(self.values), -1)
        return np.divmod(np.nanargmin(flat, axis=1), int(np.prod(self.grid.shape)))


def save_landscape(path: str | os.PathLike, landscape: Landscape, about: dict | None = None) -> None:
    """Write a landscape to an .npz file: its arrays, and a JSON header that says what they are.

    Args:
        path: the file; it appears only once it is whole.
        landscape: what to write.
        about: anything else for the header that JSON can hold, such as the settings it was made with.

    Raises:
        InputError: the file cannot be written, or its name does not end in .npz.
    """
    path = _npz("save_landscape", path)
    grid = landscape.grid
    header = {
        "format": FORMAT,
        "frame": FRAME,
        "unit": "metre",
        "reduce": landscape.reduce,
        "temperature": landscape.temperature,
    }
    arrays = {"values": landscape.values, "waypoints": landscape.waypoints, "rotations": landscape.rotations}
    arrays |= {"origin": grid.origin, "directions": grid.directions}
    arrays |= {f"coordinates_{axis}": steps for axis, steps in enumerate(grid.coordinates)}
    arrays |= {"turned": landscape.turned} if landscape.turned is not None else {}
    arrays |= {"mask": grid.mask} if grid.mask is not None else {}
    text = json.dumps(header | {"about": about or {}})
    replace_file("save_landscape", path, lambda file: np.savez(file, header=np.array(text), **arrays))


def load_landscape(path: str | os.PathLike) -> tuple[Landscape, dict]:
    """Read what `save_landscape` wrote.

    Args:
        path: the file.

    Returns:
        The landscape, and what was said about it.

    Raises:
        InputError: there is no such file, or it holds something else or is damaged.
    """
    path = _npz("load_landscape", path)
    try:
        with path.open("rb") as opened, np.load(opened, allow_pickle=False) as file:
            arrays = {name: file[name] for name in file.files}
        header = json.loads(str(arrays.pop("header")))
        if header["format"] != FORMAT:
            raise InputError(
                f"load_landscape(): {path} has format {header['format']}; expected {FORMAT}: make it again"
            )
        axes = tuple(arrays[f"coordinates_{axis}"] for axis in range(len(arrays["directions"])))
        grid = Grid(arrays["origin"], arrays["directions"], axes, arrays.get("mask"))
        fields = {name: arrays[name] for name in ("values", "waypoints", "rotations")}
        found = Landscape(
            grid, **fields, turned=arrays.get("turned"), reduce=header["reduce"], temperature=header["temperature"]
        )
        return found, header["about"]
    except FileNotFoundError:
        raise InputError(
            f"load_landscape(): there is no file {path}; expected one from save_landscape or `tdf landscape`"
        ) from None
    except InputError:
        raise
    except Exception as error:  # a damaged archive raises one of a dozen kinds
        raise InputError(
            f"load_landscape(): cannot read {path} ({error}); expected a file from save_landscape"
        ) from None


def _npz(function, path):
    path = Path(path)
    if path.suffix != ".npz":
        raise InputError(f"{function}(): the file is {path}; expected a name that ends in .npz")
    return path
