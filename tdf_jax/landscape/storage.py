"""The energy field of eq. 4 over a grid, and its file: each waypoint's descriptor loss at every point of the grid."""

import dataclasses
import json
import os
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from tdf_jax._internal import checks
from tdf_jax._internal.boundary import public
from tdf_jax._internal.deprecation import warn
from tdf_jax._internal.errors import InputError
from tdf_jax._internal.files import replace_file
from tdf_jax.geometry.grid import Grid
from tdf_jax.io.content import known_suffix

REDUCTIONS = ("min", "softmin", "assigned", "mean")
# Choices of the release before; they are accepted for one release, with a DeprecationWarning.
DEPRECATED_REDUCTIONS = {"least": "min", "soft_least": "softmin"}
TEMPERATURE = 5e-4  # temperature of the softmin; the energy of a waypoint is about 0.002 at a match and 0.01 far away
FORMAT = 2  # format number of files; raise it if a field is removed or its meaning changes
READABLE_FORMATS = (1, 2)  # files of format 1 have the former names of the reductions
FRAME, UNIT = "world", "metre"


@dataclasses.dataclass(frozen=True, eq=False)
class Landscape:
    """Energies over a grid; they are NaN where the grid's mask is false.

    Attributes:
        grid: positions of the query frame's origin.
        values: each waypoint's part of eq. 2 with the query frame's origin at each point of the grid: the minimum over
            `rotations`, (poses, *grid.shape), or the energies of every rotation, (poses, rotations, *grid.shape).
        waypoints: positions of the demonstration, moved with the object's centroid, (poses, 3), metres, world frame.
        rotations: orientations R_world_query of the sweep, (rotations, 3, 3).
        turned: index of the rotation with the lowest energy, (poses, *grid.shape); None if `values` has every rotation.
        reduce: how `combined` reduces `values` over waypoints, one of `REDUCTIONS`.
        temperature: temperature of the softmin, an energy.

    Raises:
        InputError: `reduce` is unknown, the temperature is not above 0, the shapes do not match, or `turned` is not the
            index of a rotation.
    """

    grid: Grid
    values: Float[np.ndarray, " poses *shape"]
    waypoints: Float[np.ndarray, "poses 3"]
    rotations: Float[np.ndarray, "rotations 3 3"]
    turned: Int[np.ndarray, " poses *shape"] | None = None
    reduce: str = "min"
    temperature: float = TEMPERATURE

    def __post_init__(self):
        object.__setattr__(self, "reduce", check_reduction("Landscape()", self.reduce))
        checks.positive("Landscape()", "temperature", self.temperature, unit="an energy")
        shape = (len(self.waypoints), *self.grid.shape)
        each = (len(self.waypoints), len(self.rotations), *self.grid.shape)
        if self.values.shape != (shape if self.turned is not None else each):
            raise InputError(
                f"Landscape(): values have shape {self.values.shape}; expected {each}, or {shape} with the "
                "index of the best rotation in `turned`"
            )
        if np.asarray(self.values).dtype.kind not in "fiu":
            raise InputError(f"Landscape(): values have type {self.values.dtype}; expected energies")
        for name, expected in (("waypoints", (len(self.waypoints), 3)), ("rotations", (len(self.rotations), 3, 3))):
            if np.shape(getattr(self, name)) != expected:
                raise InputError(f"Landscape(): {name} have shape {getattr(self, name).shape}; expected {expected}")
        if not np.isfinite(checks.numbers("Landscape()", "waypoints", self.waypoints)).all():
            raise InputError("Landscape(): waypoints are NaN or infinite; expected finite positions, metres")
        checks.rotations("Landscape()", "rotations", self.rotations)
        if self.turned is not None:
            _check_turned(self.turned, shape, len(self.rotations))

    @property
    def combined(self) -> Float[np.ndarray, "*shape"]:
        """E(x): one energy for all waypoints, (*grid.shape); with all rotations, (rotations, *grid.shape).

        - "min": the minimum of the waypoints' energies.
        - "softmin": -T log(mean exp(-E_i / T)) with the temperature T, which is smooth, and between minimum and mean.
        - "assigned": the energy of the waypoint to which `rings` assigns the point, as in the paper's figures.
        - "mean": the mean, which is eq. 2 of a trajectory with all its waypoints at the point.
        """
        if self.reduce == "mean":
            return self.values.mean(axis=0)
        if self.reduce == "softmin":
            low = self.values.min(axis=0)
            return low - self.temperature * np.log(np.mean(np.exp((low - self.values) / self.temperature), axis=0))
        if self.reduce == "assigned":
            ring = self.rings
            if self.values.ndim > ring.ndim + 1:
                ring = np.broadcast_to(ring, self.values.shape[1:])
            return np.take_along_axis(self.values, ring[None], axis=0)[0]
        return self.values.min(axis=0)

    @property
    def rings(self) -> Int[np.ndarray, "*shape"]:
        """Index of the waypoint that each point is assigned to, (*grid.shape).

        It is the waypoint whose distance from the first waypoint is nearest to the point's distance from it.
        """
        first = self.waypoints[0]
        distances = np.linalg.norm(self.grid.points - first, axis=-1)
        return np.abs(distances[..., None] - np.linalg.norm(self.waypoints - first, axis=-1)).argmin(axis=-1)

    @property
    def minimisers(self) -> Float[np.ndarray, "poses 3"]:
        """x_i* of eq. 5: the grid point with the lowest energy of each waypoint, (poses, 3), metres, world frame."""
        return self.grid.points.reshape(-1, 3)[self._best[1]]

    @property
    def minimiser_rotations(self) -> Float[np.ndarray, "poses 3 3"]:
        """Orientation R_world_query of each minimiser, (poses, 3, 3)."""
        rotation, point = self._best
        if self.turned is not None:
            rotation = np.take_along_axis(self.turned.reshape(len(self.values), -1), point[:, None], axis=1)[:, 0]
        return self.rotations[rotation]

    def _repr_html_(self) -> str:
        from tdf_jax.viz.cards import landscape_card  # only a notebook asks, see tests/test_layout.py

        return landscape_card(self)

    @property
    def _best(self):
        """Indices of each waypoint's lowest energy: of the rotation (0 if `values` has one), and of the point."""
        flat = self.values.reshape(len(self.values), -1)
        return np.divmod(np.nanargmin(flat, axis=1), int(np.prod(self.grid.shape)))


def _check_turned(turned: np.ndarray, shape: tuple[int, ...], rotations: int) -> None:
    if turned.shape != shape or turned.dtype.kind not in "iu":
        raise InputError(
            f"Landscape(): turned has shape {turned.shape} and type {turned.dtype}; expected integers {shape}"
        )
    if turned.size and not 0 <= turned.min() <= turned.max() < rotations:
        raise InputError(
            f"Landscape(): turned has numbers from {turned.min()} to {turned.max()}; expected indices of the "
            f"{rotations} rotations"
        )


def check_reduction(function: str, reduce: str) -> str:
    """Check how waypoints are reduced, and replace a deprecated choice.

    Args:
        function: name that the error message begins with.
        reduce: one of `REDUCTIONS`, or a choice of the release before.

    Returns:
        One of `REDUCTIONS`.

    Raises:
        InputError: the choice is unknown.
    """
    if isinstance(reduce, str) and reduce in DEPRECATED_REDUCTIONS:
        warn(f"{function[:-1]}reduce={reduce!r})", f"reduce={DEPRECATED_REDUCTIONS[reduce]!r}")
        return DEPRECATED_REDUCTIONS[reduce]
    return checks.choice(function, "reduce", reduce, REDUCTIONS)


@public
def save_landscape(path: str | os.PathLike, landscape: Landscape, about: dict | None = None) -> None:
    """Write a landscape to an .npz file: its arrays, and a JSON header that describes them.

    Args:
        path: the file, in an existing folder; it appears only once it is complete.
        landscape: the landscape.
        about: other data for the header, in types of JSON, such as the settings of the sweep.

    Raises:
        InputError: the file cannot be written, or its name does not end in .npz.
    """
    path = known_suffix("save_landscape()", path, (".npz",))
    grid = landscape.grid
    header = {
        "format": FORMAT,
        "frame": FRAME,
        "unit": UNIT,
        "reduce": landscape.reduce,
        "temperature": landscape.temperature,
    }
    arrays: dict[str, Any] = {
        "values": landscape.values,
        "waypoints": landscape.waypoints,
        "rotations": landscape.rotations,
    }
    arrays |= {"origin": grid.origin, "directions": grid.directions}
    arrays |= {f"coordinates_{axis}": steps for axis, steps in enumerate(grid.coordinates)}
    arrays |= {"turned": landscape.turned} if landscape.turned is not None else {}
    arrays |= {"mask": grid.mask} if grid.mask is not None else {}
    text = json.dumps(header | {"about": about or {}})
    replace_file("save_landscape()", path, lambda file: np.savez(file, header=np.array(text), **arrays))


@public
def load_landscape(path: str | os.PathLike) -> tuple[Landscape, dict]:
    """Read a file of `save_landscape`, also of the release before.

    Args:
        path: the file.

    Returns:
        The landscape, and the `about` of `save_landscape`.

    Raises:
        InputError: the file does not exist, holds something else or is damaged.
    """
    path = known_suffix("load_landscape()", path, (".npz",))
    try:
        if path.exists() and not path.is_file():  # a pipe would wait for a writer
            raise OSError("it is no file")
        with path.open("rb") as opened, np.load(opened, allow_pickle=False) as file:
            arrays = {name: file[name] for name in file.files}
        header = json.loads(str(arrays.pop("header")))
        if header["format"] not in READABLE_FORMATS:
            raise InputError(
                f"load_landscape(): {path} has format {header['format']}; expected one of {READABLE_FORMATS}: "
                "compute it again"
            )
        for name, expected in (("frame", FRAME), ("unit", UNIT)):
            if header[name] != expected:
                raise InputError(
                    f"load_landscape(): {path} has the {name} {header[name]!r}; expected {expected!r}: compute it again"
                )
        axes = tuple(arrays[f"coordinates_{axis}"] for axis in range(len(arrays["directions"])))
        grid = Grid(arrays["origin"], arrays["directions"], axes, arrays.get("mask"))
        fields = {name: arrays[name] for name in ("values", "waypoints", "rotations")}
        reduce = header["reduce"]
        reduce = DEPRECATED_REDUCTIONS[reduce] if reduce in DEPRECATED_REDUCTIONS else reduce
        landscape = Landscape(
            grid, **fields, turned=arrays.get("turned"), reduce=reduce, temperature=header["temperature"]
        )
        return landscape, header["about"]
    except FileNotFoundError:
        raise InputError(
            f"load_landscape(): there is no file {path}; expected one from save_landscape or `tdf landscape`"
        ) from None
    except InputError:
        raise
    except Exception as error:  # a damaged archive raises errors of many kinds
        raise InputError(
            f"load_landscape(): cannot read {path} ({str(error)[:200]}); expected a file from save_landscape"
        ) from None
