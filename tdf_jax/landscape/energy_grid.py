"""Sweeping the query frame over a grid, in one orientation or many: from a field and a reference to a landscape (eq. 4 of the TDF paper)."""

from collections.abc import Callable, Iterator

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from tdf_jax._internal.deprecation import renamed_keywords
from tdf_jax._internal.devices import check_device_mesh
from tdf_jax._internal.errors import InputError
from tdf_jax.energy.reference import Reference
from tdf_jax.geometry import se3
from tdf_jax.geometry.grid import Grid
from tdf_jax.landscape import shared_lattice
from tdf_jax.landscape.storage import TEMPERATURE, Landscape
from tdf_jax.networks.field import DescriptorField

OVER_ROTATIONS = ("best", "each")
ORTHOGONAL = 1e-4  # how far R R^T may be from the identity


@renamed_keywords(mesh="device_mesh")
def energy_landscape(
    field: DescriptorField,
    reference: Reference,
    grid: Grid,
    rotation: Float[Array, "*rotations 3 3"] | None = None,
    reduce: str = "least",
    *,
    over_rotations: str = "best",
    temperature: float = TEMPERATURE,
    share: bool = True,
    device_mesh: jax.sharding.Mesh | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> Landscape:
    """Sweep the query frame over a grid.

    A point of the field is evaluated once for all waypoints, and once for all query points that meet there: where the
    query is a lattice with the grid's steps along the grid's axes (`lattice_query`, `snapped_query`), tens of times
    less work than one by one. The memory at work does not grow with the grid, only with the references: 8 kB for each
    query point and waypoint, twice.

    Args:
        field: the object's.
        reference: the demonstration's; waypoints may be of several.
        grid: positions of the query frame's origin.
        rotation: orientation R_world_query, or several (rotations, 3, 3), such as `se3.rotation_grid` or
            `se3.turns` give; by default the world's axes, as in the paper.
        reduce: how waypoints are combined, see `Landscape.combined`.
        over_rotations: of several rotations, keep the "best" at every point and for every waypoint, or "each".
        temperature: of the soft least, in units of the energy.
        share: False evaluates every (grid point, query point) by itself, to compare.
        device_mesh: devices to share the grid's tiles, of this process or of several that make the same call; see
            docs/guide/scaling.md.
        progress: called with the number of tiles done and of all.

    Raises:
        InputError: rotations that are none, an unknown choice, a device_mesh of another type, or a reference from another
            network than the field.
    """
    landscape = blank(field, reference, grid, rotation, reduce, over_rotations=over_rotations, temperature=temperature)
    for done, total in fill(landscape, field, reference, share=share, device_mesh=device_mesh):
        if progress is not None:
            progress(done, total)
    return landscape


def blank(
    field: DescriptorField,
    reference: Reference,
    grid: Grid,
    rotation: Float[Array, "*rotations 3 3"] | None = None,
    reduce: str = "least",
    *,
    over_rotations: str = "best",
    temperature: float = TEMPERATURE,
) -> Landscape:
    """A landscape with NaN for all energies, to `fill`; arguments and errors as `energy_landscape`."""
    channels = field.conditioned.config.channels
    if reference.descriptors.shape[-1] != channels:
        raise InputError(
            f"energy_landscape(): the reference has {reference.descriptors.shape[-1]} channels and the field {channels}; "
            "expected both from the same model"
        )
    if over_rotations not in OVER_ROTATIONS:
        raise InputError(
            f"energy_landscape(): over_rotations is {over_rotations!r}; expected one of {', '.join(OVER_ROTATIONS)}"
        )
    rotations = np.asarray(np.eye(3) if rotation is None else rotation, dtype=float)
    if rotations.shape[-2:] != (3, 3) or rotations.ndim not in (2, 3) or not len(rotations):
        raise InputError(
            f"energy_landscape(): rotation has shape {rotations.shape}; expected (3, 3), or several (rotations, 3, 3)"
        )
    rotations = rotations.reshape(-1, 3, 3)
    square = np.allclose(rotations @ rotations.swapaxes(1, 2), np.eye(3), atol=ORTHOGONAL)
    if not square or (np.linalg.det(rotations) < 0).any():
        raise InputError(
            "energy_landscape(): rotation holds matrices that are no rotations; expected R R^T = I and no mirror image"
        )
    count = len(reference.descriptors)
    shape = (count, *(() if over_rotations == "best" else (len(rotations),)), *grid.shape)
    waypoints = np.asarray(reference.trajectory.translations + field.origin)
    values = np.full(shape, np.nan, field.origin.dtype)
    turned = np.zeros(shape, np.int32) if over_rotations == "best" else None
    return Landscape(grid, values, waypoints, rotations, turned, reduce, temperature)


def fill(
    landscape: Landscape,
    field: DescriptorField,
    reference: Reference,
    done: int = 0,
    *,
    share: bool = True,
    device_mesh: jax.sharding.Mesh | None = None,
) -> Iterator[tuple[int, int]]:
    """Sweep a landscape from `blank` in place, tile by tile, so that what is finished can be looked at, kept, and gone on from.

    Args:
        landscape: with the first `done` parts finished.
        field, reference: as it was made with.
        done: parts to leave out, as this function counted them.
        share, device_mesh: see `energy_landscape`.

    Yields:
        The number of parts done and of all: tiles of the grid, one rotation after the other.
    """
    check_device_mesh("energy_landscape()", device_mesh)
    grid, query = landscape.grid, np.asarray(reference.query, dtype=float)
    found = [shared_lattice.layers(grid, query @ R.T, share) for R in landscape.rotations]
    cover = [shared_lattice.tiles(grid, each.span) for each in found]
    total = sum(map(len, cover))
    before = 0
    for index, (layers, tiles) in enumerate(zip(found, cover)):
        left = tiles[max(done - before, 0) :]
        before += len(tiles)
        for tile, values in shared_lattice.swept(field, reference.descriptors, grid, layers, left, device_mesh):
            _keep(landscape, index, tile.within(grid.shape), values)
            done += 1
            yield done, total


def _keep(landscape, index, part, values):
    """Enter one rotation's energies at one part of the grid."""
    if landscape.grid.mask is not None:
        values = np.where(landscape.grid.mask[part], values, np.nan)
    if landscape.turned is None:
        landscape.values[:, index, *part] = values
        return
    kept, turned = landscape.values[:, *part], landscape.turned[:, *part]
    better = ~(kept <= values)  # also where there is none yet
    turned[better] = index  # first: interrupted here, the point would be entered again, with its rotation
    kept[better] = values[better]


def query_change(
    field: DescriptorField,
    reference: Reference,
    changed: Reference,
    grid: Grid,
    rotation: Float[Array, "3 3"] | None = None,
    samples: int = 64,
    seed: int = 0,
) -> tuple[float, float]:
    """What another query set does to the energies: median and largest relative difference at random points of a grid.

    Args:
        field: the object's.
        reference: the demonstration's, with the query set as it was.
        changed: the same demonstration's, with the other query set, such as the one snapped onto the grid's lattice.
        grid: where.
        rotation: orientation R_world_query; by default the world's axes.
        samples: points.
        seed: of their draw.
    """
    rng = np.random.default_rng(seed)
    places = np.argwhere(np.ones(grid.shape, bool) if grid.mask is None else grid.mask)
    chosen = places[rng.integers(len(places), size=samples)]
    points = jnp.asarray(grid.first + chosen @ (grid.steps[:, None] * grid.directions), field.origin.dtype)
    R = jnp.eye(3) if rotation is None else jnp.asarray(rotation)
    before, after = (
        np.asarray(_at(field, one.descriptors, se3.rotate(R, one.query), points)) for one in (reference, changed)
    )
    apart = np.abs(after - before) / before
    return float(np.median(apart)), float(apart.max())


@jax.jit
def _at(field, descriptors, offsets, points):
    """Energies (points, waypoints)."""

    def one(x):
        here = field.descriptors(offsets + x)
        return jax.lax.map(lambda there: jnp.mean(jnp.abs(here - there)), descriptors)

    return jax.lax.map(one, points)
