"""Where energies are swept: regular grids of points along a line, in a plane or in a volume of the world."""

import dataclasses
from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float

from tdf_jax._internal.errors import InputError
from tdf_jax.geometry.trajectory import Trajectory

PLANES = ("xy", "xz", "yz")
SQUARE = 1e-6  # how far from perpendicular unit vectors directions may be: float32 rotations are 1e-7 off
EVEN = 1e-6  # how far coordinates may be from even steps, of the largest: float32's rounding is 6e-8


@dataclasses.dataclass(frozen=True, eq=False)
class Grid:
    """A regular grid in the world with one, two or three axes.

    Attributes:
        origin: world point where all coordinates are zero, metres.
        directions: perpendicular unit vectors in the world, one an axis of the grid.
        coordinates: along each direction, increasing in even steps, at least two, metres.
        mask: which points count; all of them if it is not given.

    Raises:
        InputError: an axis of fewer than two points or of no extent, uneven steps, directions that are not
            perpendicular unit vectors, or a mask of another shape or with no point.
    """

    origin: Float[np.ndarray, "3"]
    directions: Float[np.ndarray, "axes 3"]
    coordinates: tuple[Float[np.ndarray, " count"], ...]
    mask: Bool[np.ndarray, "*shape"] | None = None

    def __post_init__(self):
        origin, directions = np.asarray(self.origin, dtype=float), np.asarray(self.directions, dtype=float)
        if origin.shape != (3,) or not np.isfinite(origin).all():
            raise InputError(f"Grid(): origin is {origin.tolist()}; expected three finite numbers, metres")
        if directions.shape not in {(1, 3), (2, 3), (3, 3)} or len(self.coordinates) != len(directions):
            raise InputError(
                f"Grid(): directions have shape {directions.shape} and there are {len(self.coordinates)} lists of coordinates; "
                "expected one list for each of one to three directions (axes, 3)"
            )
        if not np.allclose(directions @ directions.T, np.eye(len(directions)), atol=SQUARE):
            raise InputError(f"Grid(): directions are {directions.tolist()}; expected perpendicular unit vectors")
        axes = tuple(np.asarray(steps, dtype=float) for steps in self.coordinates)
        for name, steps in zip("first second third".split(), axes):
            if steps.ndim != 1 or len(steps) < 2:
                raise InputError(
                    f"Grid(): the {name} axis has coordinates of shape {steps.shape}; expected at least two numbers"
                )
            step = (steps[-1] - steps[0]) / (len(steps) - 1)
            if not 0 < step < np.inf:
                raise InputError(
                    f"Grid(): the {name} axis goes from {steps[0]} to {steps[-1]}; expected it to increase"
                )
            if np.abs(steps - np.linspace(steps[0], steps[-1], len(steps))).max() > EVEN * np.abs(steps).max():
                raise InputError(f"Grid(): the steps of the {name} axis differ; expected even ones, as of np.linspace")
        axes = tuple(np.linspace(steps[0], steps[-1], len(steps)) for steps in axes)
        mask = None if self.mask is None else np.asarray(self.mask, dtype=bool)
        for name, value in (("origin", origin), ("directions", directions), ("coordinates", axes), ("mask", mask)):
            object.__setattr__(self, name, value)
        if mask is not None and (mask.shape != self.shape or not mask.any()):
            raise InputError(
                f"Grid(): mask has shape {mask.shape} and {np.count_nonzero(mask)} points; expected {self.shape} and at least one"
            )

    @property
    def shape(self) -> tuple[int, ...]:
        """Points along each axis."""
        return tuple(len(steps) for steps in self.coordinates)

    @property
    def steps(self) -> Float[np.ndarray, " axes"]:
        """Distance of neighbours along each axis, metres."""
        return np.array([(steps[-1] - steps[0]) / (len(steps) - 1) for steps in self.coordinates])

    @property
    def first(self) -> Float[np.ndarray, "3"]:
        """The point of index zero along all axes, metres."""
        return self.origin + np.array([steps[0] for steps in self.coordinates]) @ self.directions

    @property
    def points(self) -> Float[np.ndarray, "*shape 3"]:
        """World points, metres; the last axis of the grid varies fastest."""
        mesh = np.stack(np.meshgrid(*self.coordinates, indexing="ij"), axis=-1)
        return self.origin + mesh @ self.directions


def plane_grid(
    half: float,
    count: int = 101,
    origin: Sequence[float] = (0.0, 0.0, 0.0),
    axes: str | Float[np.ndarray, "2 3"] = "xy",
) -> Grid:
    """A square of a plane.

    Args:
        half: of its side, metres.
        count: points along a side, at least 2.
        origin: its middle, metres, world frame.
        axes: "xy", "xz" or "yz" of the world, or any two perpendicular unit vectors that span the plane.

    Raises:
        InputError: a side of no length, fewer than two points, an origin that is no point, or unknown axes.
    """
    steps = _symmetric("plane_grid", half, count)
    if isinstance(axes, str):
        if axes not in PLANES:
            raise InputError(
                f"plane_grid(): axes is {axes!r}; expected one of {', '.join(PLANES)}, or two unit vectors"
            )
        axes = np.eye(3)[["xyz".index(axis) for axis in axes]]
    if np.shape(axes) != (2, 3):
        raise InputError(f"plane_grid(): axes have shape {np.shape(axes)}; expected two vectors (2, 3)")
    return Grid(_point("plane_grid", origin), np.asarray(axes), (steps, steps))


def volume_grid(
    half: float,
    count: int = 64,
    origin: Sequence[float] = (0.0, 0.0, 0.0),
    axes: Float[np.ndarray, "3 3"] | None = None,
) -> Grid:
    """A cube.

    Args:
        half: of its edge, metres.
        count: points along an edge, at least 2.
        origin: its middle, metres, world frame.
        axes: directions of its edges; by default the world's axes.

    Raises:
        InputError: an edge of no length, fewer than two points, an origin that is no point, or axes that are not
            perpendicular.
    """
    steps = _symmetric("volume_grid", half, count)
    return Grid(_point("volume_grid", origin), np.eye(3) if axes is None else np.asarray(axes), (steps, steps, steps))


def path_grid(
    path: Trajectory | Float[np.ndarray, "poses 3"],
    radius: float,
    step: float,
    axes: Float[np.ndarray, "3 3"] | None = None,
) -> Grid:
    """The neighbourhood of a path: points of a lattice through its first corner that lie within a distance of it.

    Args:
        path: a trajectory, or the corners of a polyline, metres, world frame.
        radius: of the neighbourhood, metres.
        step: between points, metres; at most the radius.
        axes: directions of the lattice; by default the world's axes.

    Raises:
        InputError: a radius or a step that is not positive, a step above the radius, or a path that is none.
    """
    corners = np.asarray(path.translations if isinstance(path, Trajectory) else path, dtype=float)
    if corners.ndim != 2 or corners.shape[1] != 3 or len(corners) < 1 or not np.isfinite(corners).all():
        raise InputError(f"path_grid(): the path has shape {corners.shape}; expected finite corners (poses, 3), metres")
    if not 0 < step <= radius < np.inf:
        raise InputError(f"path_grid(): step is {step} and radius {radius}; expected 0 < step <= radius, metres")
    axes = np.eye(3) if axes is None else np.asarray(axes, dtype=float)
    along = (corners - corners[0]) @ axes.T / step
    low, high = along.min(axis=0), along.max(axis=0)
    reach = radius / step
    coordinates = tuple(step * np.arange(np.ceil(a - reach), np.floor(b + reach) + 1) for a, b in zip(low, high))
    grid = Grid(corners[0], axes, coordinates)
    near = distance_from_polyline(grid.points.reshape(-1, 3), corners) <= radius
    return dataclasses.replace(grid, mask=near.reshape(grid.shape))


def distance_from_polyline(
    points: Float[np.ndarray, "points 3"], corners: Float[np.ndarray, "poses 3"]
) -> Float[np.ndarray, " points"]:
    """Distance of points from the nearest point of the polyline through some corners, metres."""
    points, corners = np.asarray(points, float), np.asarray(corners, float)
    least = np.linalg.norm(points - corners[0], axis=1)
    # one piece at a time: memory does not grow with their number
    for start, step in zip(corners, np.diff(corners, axis=0)):
        along = np.clip((points - start) @ step / max(step @ step, np.finfo(float).tiny), 0, 1)
        least = np.minimum(least, np.linalg.norm(points - start - along[:, None] * step, axis=1))
    return least


def _symmetric(function, half, count):
    if not 0 < half < np.inf:
        raise InputError(f"{function}(): half is {half}; expected a length above 0, metres")
    if not isinstance(count, int | np.integer) or count < 2:
        raise InputError(f"{function}(): count is {count}; expected a whole number of at least 2")
    return np.linspace(-half, half, count)


def _point(function, origin):
    origin = np.asarray(origin, dtype=float)
    if origin.shape != (3,) or not np.isfinite(origin).all():
        raise InputError(f"{function}(): origin is {origin.tolist()}; expected three finite numbers, metres")
    return origin
