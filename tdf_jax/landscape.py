"""The energy field of eq. 4: every waypoint's descriptor loss with the query frame at every point of a grid, in one orientation."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from tdf_jax import poses
from tdf_jax.demonstration import Reference
from tdf_jax.errors import InputError
from tdf_jax.field import DescriptorField

PLANES = ("xy", "xz", "yz")
CHUNK_POINTS = 512  # descriptors that exist at a time, as in `optimize`


@dataclasses.dataclass(frozen=True)
class Grid:
    """A regular grid in the world: a line, a plane or a volume.

    Attributes:
        origin: world point where all coordinates are zero, metres.
        directions: unit vectors, one an axis of the grid.
        coordinates: along each direction, increasing, metres.
    """

    origin: Float[np.ndarray, "3"]
    directions: Float[np.ndarray, "axes 3"]
    coordinates: tuple[Float[np.ndarray, " count"], ...]

    @property
    def shape(self) -> tuple[int, ...]:
        """Points along each axis."""
        return tuple(len(steps) for steps in self.coordinates)

    @property
    def points(self) -> Float[np.ndarray, "*shape 3"]:
        """World points, metres; the last axis of the grid varies fastest."""
        mesh = np.stack(np.meshgrid(*self.coordinates, indexing="ij"), axis=-1)
        return self.origin + mesh @ self.directions


def plane_grid(
    half: float, count: int = 101, origin: Float[np.ndarray, "3"] | tuple[float, float, float] = (0.0, 0.0, 0.0), axes: str = "xy"
) -> Grid:
    """A square of a plane of the world.

    Args:
        half: of its side, metres.
        count: points along a side, at least 2.
        origin: its middle, metres, world frame.
        axes: "xy", "xz" or "yz".

    Raises:
        InputError: a side of no length, fewer than two points, an origin that is no point, or unknown axes.
    """
    if not 0 < half < np.inf:
        raise InputError(f"plane_grid(): half is {half}; expected a length above 0, metres")
    if not isinstance(count, int | np.integer) or count < 2:
        raise InputError(f"plane_grid(): count is {count}; expected a whole number of at least 2")
    if axes not in PLANES:
        raise InputError(f"plane_grid(): axes is {axes!r}; expected one of {', '.join(PLANES)}")
    origin = np.asarray(origin, dtype=float)
    if origin.shape != (3,) or not np.isfinite(origin).all():
        raise InputError(f"plane_grid(): origin is {origin.tolist()}; expected three finite numbers, metres")
    steps = np.linspace(-half, half, count)
    return Grid(origin, np.eye(3)[["xyz".index(axis) for axis in axes]], (steps, steps))


@dataclasses.dataclass(frozen=True)
class Landscape:
    """Energies over a grid.

    Attributes:
        grid: where.
        values: every waypoint's part of eq. 2 with the query frame's origin at the grid's points.
    """

    grid: Grid
    values: Float[np.ndarray, "poses *shape"]

    @property
    def least(self) -> Float[np.ndarray, "*shape"]:
        """E(x): the least of all waypoints' energies at a point."""
        return self.values.min(axis=0)

    @property
    def mean(self) -> Float[np.ndarray, "*shape"]:
        """The mean of all waypoints' energies at a point: eq. 2 of a trajectory whose waypoints all stand there."""
        return self.values.mean(axis=0)

    @property
    def minimisers(self) -> Float[np.ndarray, "poses 3"]:
        """x_i* of eq. 5: the grid's point where each waypoint's energy is least, metres, world frame."""
        best = self.values.reshape(len(self.values), -1).argmin(axis=1)
        return self.grid.points.reshape(-1, 3)[best]


def energy_landscape(
    field: DescriptorField,
    reference: Reference,
    grid: Grid,
    rotation: Float[Array, "3 3"] | None = None,
) -> Landscape:
    """Sweep the query frame over a grid (eq. 4 of the TDF paper).

    The field is evaluated once for a (grid point, query point), for all waypoints; no more than `CHUNK_POINTS` descriptors exist at a time.

    Args:
        field: the object's.
        reference: the demonstration's; only its descriptors and query points count, the waypoints may be of several.
        grid: positions of the query frame's origin.
        rotation: its orientation, R_world_query; by default the world's axes, as in the paper.

    Raises:
        InputError: a rotation of another shape, or a reference from another network than the field.
    """
    channels = field.conditioned.config.channels
    if reference.descriptors.shape[-1] != channels:
        raise InputError(
            f"energy_landscape(): the reference has {reference.descriptors.shape[-1]} channels and the field {channels}; "
            "expected both from the same model"
        )
    rotation = jnp.eye(3) if rotation is None else jnp.asarray(rotation)
    if rotation.shape != (3, 3):
        raise InputError(f"energy_landscape(): rotation has shape {rotation.shape}; expected (3, 3)")
    batch = max(1, CHUNK_POINTS // len(reference.query))
    points = jnp.asarray(grid.points.reshape(-1, 3), reference.query.dtype)
    values = _energies(field, reference.descriptors, poses.rotate(rotation, reference.query), points, batch)
    return Landscape(grid, np.asarray(values).T.reshape(-1, *grid.shape))


@functools.partial(jax.jit, static_argnames="batch")
def _energies(field, descriptors, query, points, batch):
    """(points, waypoints)."""

    def at(x):
        here = field.descriptors(query + x)
        return jax.lax.map(lambda there: jnp.mean(jnp.abs(here - there)), descriptors)

    return jax.lax.map(at, points, batch_size=batch)
