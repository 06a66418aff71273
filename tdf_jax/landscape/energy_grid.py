"""Sweeps of the query frame over a grid, in one orientation or many (eq. 4 of the TDF paper)."""

from collections.abc import Callable, Iterator

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from tdf_jax._internal import checks
from tdf_jax._internal.boundary import host
from tdf_jax._internal.deprecation import renamed_keywords
from tdf_jax._internal.devices import check_device_mesh
from tdf_jax._internal.errors import InputError
from tdf_jax.energy.reference import Reference
from tdf_jax.geometry import se3
from tdf_jax.geometry.grid import Grid
from tdf_jax.landscape import shared_lattice
from tdf_jax.landscape.storage import TEMPERATURE, Landscape, check_reduction
from tdf_jax.networks.field import DescriptorField
from tdf_jax.solvers.initial import check_channels

OVER_ROTATIONS = ("best", "each")


@host
@renamed_keywords(mesh="device_mesh")
def energy_landscape(
    field: DescriptorField,
    reference: Reference,
    grid: Grid,
    rotation: Float[Array, "*rotations 3 3"] | None = None,
    reduce: str = "min",
    *,
    over_rotations: str = "best",
    temperature: float = TEMPERATURE,
    share: bool = True,
    device_mesh: jax.sharding.Mesh | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> Landscape:
    """Sweep the query frame over a grid.

    The field is evaluated once at a point for all waypoints, and for all query points that share the point. If the
    query points are a lattice with the grid's steps along the grid's axes (`lattice_query`, `snapped_query`), this
    saves most of the work (docs/guide/landscape.md). The working memory grows with the number of query points and
    waypoints, but not with the grid.

    Args:
        field: descriptor field of the object.
        reference: the demonstration; its waypoints may be those of several trajectories.
        grid: positions of the query frame's origin.
        rotation: orientation R_world_query, (3, 3), or several, (rotations, 3, 3), such as `tdf_jax.rotation_grid` or
            `tdf_jax.turns` give; by default the axes of the world, as in the paper.
        reduce: how the energies of the waypoints are combined: "min", "softmin", "assigned" or "mean", see
            `Landscape.combined`.
        over_rotations: "best" takes the minimum over rotations at every point and for every waypoint; "each" gives the
            energies of every rotation.
        temperature: temperature of the softmin, an energy.
        share: False evaluates each pair of a grid point and a query point separately, for comparisons.
        device_mesh: devices that share the tiles of the grid, of this process or of several that make the same call;
            see docs/guide/scaling.md.
        progress: function of the number of finished tiles and the number of all tiles, called after each tile.

    Returns:
        The landscape.

    Raises:
        InputError: `rotation` has no rotations, a choice is unknown, `device_mesh` has another type, or reference and
            field are from different networks.
    """
    reduce = check_reduction("energy_landscape()", reduce)
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
    reduce: str = "min",
    *,
    over_rotations: str = "best",
    temperature: float = TEMPERATURE,
) -> Landscape:
    """Make a landscape whose energies are all NaN, for `fill`; see `energy_landscape` for the arguments."""
    check_channels("energy_landscape()", field, reference)
    checks.choice("energy_landscape()", "over_rotations", over_rotations, OVER_ROTATIONS)
    rotations = np.asarray(np.eye(3) if rotation is None else rotation, dtype=float)
    if rotations.shape[-2:] != (3, 3) or rotations.ndim not in (2, 3) or not len(rotations):
        raise InputError(
            f"energy_landscape(): rotation has shape {rotations.shape}; expected (3, 3), or several (rotations, 3, 3)"
        )
    rotations = rotations.reshape(-1, 3, 3)
    checks.rotations("energy_landscape()", "rotation", rotations)
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
    """Sweep a landscape from `blank` in place, part by part, so that an interrupted sweep can be saved and continued.

    Args:
        landscape: landscape whose first `done` parts are finished.
        field: descriptor field that the landscape was made with.
        reference: reference that the landscape was made with.
        done: number of finished parts, as a previous call counted them; they are skipped.
        share: see `energy_landscape`.
        device_mesh: see `energy_landscape`.

    Yields:
        The number of finished parts and the number of all parts: tiles of the grid, one rotation after the other.
    """
    check_device_mesh("energy_landscape()", device_mesh)
    grid, query = landscape.grid, np.asarray(reference.query, dtype=float)
    layers = [shared_lattice.layers(grid, query @ R.T, share) for R in landscape.rotations]
    tiles = [shared_lattice.tiles(grid, each.span) for each in layers]
    total = sum(map(len, tiles))
    before = 0
    for index, (own_layers, own_tiles) in enumerate(zip(layers, tiles)):
        remaining = own_tiles[max(done - before, 0) :]
        before += len(own_tiles)
        sweep = shared_lattice.tile_energies(field, reference.descriptors, grid, own_layers, remaining, device_mesh)
        for tile, values in sweep:
            _enter(landscape, index, tile.within(grid.shape), values)
            done += 1
            yield done, total


def _enter(landscape, index, part, values):
    """Enter the energies of one rotation at one part of the grid."""
    if landscape.grid.mask is not None:
        values = np.where(landscape.grid.mask[part], values, np.nan)
    if landscape.turned is None:
        landscape.values[:, index, *part] = values
        return
    lowest, best = landscape.values[:, *part], landscape.turned[:, *part]
    better = ~(lowest <= values)  # also true where `lowest` is still NaN
    # The rotation is written first: after an interruption between both lines, the part is entered again.
    best[better] = index
    lowest[better] = values[better]


def query_change(
    field: DescriptorField,
    reference: Reference,
    changed: Reference,
    grid: Grid,
    rotation: Float[Array, "3 3"] | None = None,
    samples: int = 64,
    seed: int = 0,
) -> tuple[float, float]:
    """Compare the energies of two sets of query points at random points of a grid.

    Args:
        field: descriptor field of the object.
        reference: the demonstration with the first set of query points.
        changed: the same demonstration with the second set, such as the first one snapped onto the grid's lattice.
        grid: positions of the query frame's origin.
        rotation: orientation R_world_query, (3, 3); by default the axes of the world.
        samples: number of random points of the grid.
        seed: seed of the random points.

    Returns:
        The median and the largest relative difference of the energies.
    """
    rng = np.random.default_rng(seed)
    nodes = np.argwhere(np.ones(grid.shape, bool) if grid.mask is None else grid.mask)
    chosen = nodes[rng.integers(len(nodes), size=samples)]
    points = jnp.asarray(grid.first + chosen @ (grid.steps[:, None] * grid.directions), field.origin.dtype)
    R = jnp.eye(3) if rotation is None else jnp.asarray(rotation)
    before, after = (
        np.asarray(_energies_at(field, one.descriptors, se3.rotate(R, one.query), points))
        for one in (reference, changed)
    )
    change = np.abs(after - before) / before
    return float(np.median(change)), float(change.max())


@jax.jit
def _energies_at(field, descriptors, offsets, points):
    """Energies of every waypoint at single points, (points, waypoints)."""

    def energies(x):
        here = field.descriptors(offsets + x)
        return jax.lax.map(lambda reference: jnp.mean(jnp.abs(here - reference)), descriptors)

    return jax.lax.map(energies, points)
