"""Regular grids of points along a line, in a plane or in a volume of the world, on which energies are evaluated."""

import dataclasses
from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float, Real
from numpy.typing import ArrayLike

from tdf_jax._internal import checks
from tdf_jax._internal.boundary import public
from tdf_jax._internal.errors import InputError
from tdf_jax.geometry.trajectory import Trajectory

PLANES = ("xy", "xz", "yz")
# Tolerance of the entries of directions @ directions.T; the columns of float32 rotations have errors of 1e-7.
ORTHONORMAL_TOLERANCE = 1e-6
# Tolerance of even steps, relative to the largest coordinate; float32 rounds to 6e-8.
EVEN_TOLERANCE = 1e-6
MAX_POINTS = 100_000_000  # points of the box around a path, 2.4 GB


@dataclasses.dataclass(frozen=True, eq=False)
class Grid:
    """A regular grid in the world with one, two or three axes.

    Attributes:
        origin: point where all coordinates are zero, (3,), metres, world frame.
        directions: perpendicular unit vectors, one for each axis of the grid, (axes, 3), world frame.
        coordinates: coordinates along each direction, at least two, increasing in even steps, metres.
        mask: which points of the grid are used, one boolean for each; None for all of them.

    Raises:
        InputError: an axis has fewer than two points or no extent, steps are uneven, directions are not perpendicular
            unit vectors, or the mask has another shape or no point.
    """

    origin: Float[np.ndarray, "3"]
    directions: Float[np.ndarray, "axes 3"]
    coordinates: tuple[Real[np.ndarray, " _count"], ...]
    mask: Bool[np.ndarray, "*shape"] | None = None

    def __post_init__(self):
        origin = checks.vector("Grid()", "origin", self.origin)
        directions = checks.numbers("Grid()", "directions", self.directions)
        if not isinstance(self.coordinates, Sequence | np.ndarray):
            raise InputError(
                f"Grid(): coordinates are {self.coordinates!r}; expected one list of numbers for each axis"
            )
        if directions.shape not in {(1, 3), (2, 3), (3, 3)} or len(self.coordinates) != len(directions):
            raise InputError(
                f"Grid(): directions have shape {directions.shape} and there are {len(self.coordinates)} lists of "
                "coordinates; expected one list for each of one to three directions (axes, 3)"
            )
        if not np.allclose(directions @ directions.T, np.eye(len(directions)), atol=ORTHONORMAL_TOLERANCE):
            raise InputError(f"Grid(): directions are {directions.tolist()}; expected perpendicular unit vectors")
        axes = tuple(checks.numbers("Grid()", "coordinates", steps) for steps in self.coordinates)
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
            largest_error = np.abs(steps - np.linspace(steps[0], steps[-1], len(steps))).max()
            if not largest_error <= EVEN_TOLERANCE * np.abs(steps).max():  # NaN too
                raise InputError(f"Grid(): the steps of the {name} axis differ; expected even ones, as of np.linspace")
        axes = tuple(np.linspace(steps[0], steps[-1], len(steps)) for steps in axes)
        try:
            mask = None if self.mask is None else np.asarray(self.mask)
        except ValueError:  # rows of different lengths
            mask = np.empty(0, object)
        if mask is not None and mask.dtype != bool:
            raise InputError(f"Grid(): mask has type {mask.dtype}; expected one boolean for each point")
        for name, value in (("origin", origin), ("directions", directions), ("coordinates", axes), ("mask", mask)):
            object.__setattr__(self, name, value)
        if mask is not None and (mask.shape != self.shape or not mask.any()):
            raise InputError(
                f"Grid(): mask has shape {mask.shape} and {np.count_nonzero(mask)} points; "
                f"expected {self.shape} and at least one"
            )

    @property
    def shape(self) -> tuple[int, ...]:
        """Number of points along each axis."""
        return tuple(len(steps) for steps in self.coordinates)

    @property
    def steps(self) -> Float[np.ndarray, " axes"]:
        """Distance between neighbours along each axis, (axes,), metres."""
        return np.array([(steps[-1] - steps[0]) / (len(steps) - 1) for steps in self.coordinates])

    @property
    def first(self) -> Float[np.ndarray, "3"]:
        """Point whose index is zero along all axes, (3,), metres, world frame."""
        return self.origin + np.array([steps[0] for steps in self.coordinates]) @ self.directions

    @property
    def points(self) -> Float[np.ndarray, "*shape 3"]:
        """All points of the grid, (*shape, 3), metres, world frame; the last axis of the grid varies fastest."""
        mesh = np.stack(np.meshgrid(*self.coordinates, indexing="ij"), axis=-1)
        return self.origin + mesh @ self.directions


@public
def plane_grid(
    half: float,
    count: int = 101,
    origin: ArrayLike = (0.0, 0.0, 0.0),
    axes: str | Float[np.ndarray, "2 3"] = "xy",
) -> Grid:
    """Make a square grid in a plane.

    Args:
        half: half of the side, metres.
        count: number of points along a side, at least 2.
        origin: centre of the square, (3,), metres, world frame.
        axes: "xy", "xz" or "yz" of the world, or any two perpendicular unit vectors that span the plane, (2, 3), world
            frame.

    Returns:
        The grid, count x count points.

    Raises:
        InputError: half is not above 0, count is below 2, the origin is not a finite point, or axes is unknown.
    """
    steps = _symmetric_steps("plane_grid()", half, count)
    centre = np.asarray(checks.vector("plane_grid()", "origin", origin))
    if isinstance(axes, str):
        if axes not in PLANES:
            raise InputError(
                f"plane_grid(): axes is {axes!r}; expected one of {', '.join(PLANES)}, or two unit vectors"
            )
        axes = np.eye(3)[["xyz".index(axis) for axis in axes]]
    directions = checks.numbers("plane_grid()", "axes", axes)
    if directions.shape != (2, 3):
        raise InputError(f"plane_grid(): axes have shape {directions.shape}; expected two vectors (2, 3)")
    return Grid(centre, directions, (steps, steps))


@public
def volume_grid(
    half: float,
    count: int = 64,
    origin: ArrayLike = (0.0, 0.0, 0.0),
    axes: Float[np.ndarray, "3 3"] | None = None,
) -> Grid:
    """Make a cubic grid.

    Args:
        half: half of the edge, metres.
        count: number of points along an edge, at least 2.
        origin: centre of the cube, (3,), metres, world frame.
        axes: directions of the edges, perpendicular unit vectors, (3, 3), world frame; by default the world's axes.

    Returns:
        The grid, count x count x count points.

    Raises:
        InputError: half is not above 0, count is below 2, the origin is not a finite point, or the axes are not
            perpendicular unit vectors.
    """
    steps = _symmetric_steps("volume_grid()", half, count)
    centre = np.asarray(checks.vector("volume_grid()", "origin", origin))
    directions = np.eye(3) if axes is None else checks.numbers("volume_grid()", "axes", axes)
    return Grid(centre, directions, (steps, steps, steps))


@public
def path_grid(
    path: Trajectory | Float[np.ndarray, "poses 3"],
    radius: float,
    step: float,
    axes: Float[np.ndarray, "3 3"] | None = None,
) -> Grid:
    """Make a grid of the neighbourhood of a path: the lattice points within a distance of it.

    The lattice has a point at the path's first corner.

    Args:
        path: a trajectory, or the corners of a polyline, (poses, 3), metres, world frame.
        radius: largest distance of a point from the path, metres.
        step: distance between neighbouring points, metres, at most the radius.
        axes: directions of the lattice, perpendicular unit vectors, (3, 3), world frame; by default the world's axes.

    Returns:
        The grid; its mask selects the points within the radius.

    Raises:
        InputError: radius or step is not above 0, step is above the radius, the path is not finite corners, or the box
            around it has too many points.
    """
    corners = path.translations if isinstance(path, Trajectory) else path
    corners = np.asarray(checks.coordinates("path_grid()", "path", corners, "poses"), dtype=float)
    for name, value in (("radius", radius), ("step", step)):
        checks.positive("path_grid()", name, value, "metres")
    if not step <= radius:
        raise InputError(f"path_grid(): step is {step} and radius {radius}; expected 0 < step <= radius, metres")
    axes = np.eye(3) if axes is None else checks.numbers("path_grid()", "axes", axes)
    if axes.shape != (3, 3) or not np.isfinite(axes).all():
        raise InputError(f"path_grid(): axes are {axes.tolist()}; expected three perpendicular unit vectors (3, 3)")
    along = (corners - corners[0]) @ axes.T / step
    low, high = along.min(axis=0), along.max(axis=0)
    reach = radius / step
    if not np.prod(high - low + 2 * reach + 1) <= MAX_POINTS:
        raise InputError(
            f"path_grid(): with a step of {step} m and a radius of {radius} m the grid has more than {MAX_POINTS} "
            "points; expected fewer; raise the step, or lower the radius"
        )
    coordinates = tuple(step * np.arange(np.ceil(a - reach), np.floor(b + reach) + 1) for a, b in zip(low, high))
    grid = Grid(corners[0], axes, coordinates)
    near = distance_from_polyline(grid.points.reshape(-1, 3), corners) <= radius
    return dataclasses.replace(grid, mask=near.reshape(grid.shape))


def distance_from_polyline(
    points: Float[np.ndarray, "points 3"], corners: Float[np.ndarray, "poses 3"]
) -> Float[np.ndarray, " points"]:
    """Compute distances from a polyline.

    Args:
        points: points, (points, 3), metres.
        corners: corners of the polyline, (poses, 3), metres, in the same frame.

    Returns:
        Distance of each point from the nearest point of the polyline, (points,), metres.
    """
    points, corners = np.asarray(points, float), np.asarray(corners, float)
    distance = np.linalg.norm(points - corners[0], axis=1)
    # The loop takes one piece at a time, so that memory does not grow with the number of pieces.
    for start, step in zip(corners, np.diff(corners, axis=0)):
        along = np.clip((points - start) @ step / max(step @ step, np.finfo(float).tiny), 0, 1)
        distance = np.minimum(distance, np.linalg.norm(points - start - along[:, None] * step, axis=1))
    return distance


def _symmetric_steps(function: str, half: float, count: int) -> np.ndarray:
    checks.positive(function, "half", half, "metres")
    return np.linspace(-half, half, checks.count(function, "count", count, least=2))
