"""Energies of a set of query points over a grid, with evaluations of the field that query points share.

With the query frame at grid point i, query point j is at `first + i steps + o_j`. Two query points whose offsets o
differ by whole steps of the grid visit the same nodes. They form a layer, for which the field is evaluated once, on the
grid extended by the layer's span. A lattice of 6 x 6 x 7 query points, with the pitch of a plane, has 7 layers of 36
query points. Random query points are layers of one, and the sweep evaluates them separately. The remaining work is the
sum of |descriptor - reference| over channels, for every grid point, query point and waypoint.
"""

import functools
import itertools
import math
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import NamedSharding
from jaxtyping import Array, Float, Int

from tdf_jax._internal import devices
from tdf_jax.geometry.grid import Grid
from tdf_jax.networks.field import DescriptorField

# Tolerance of whole steps, relative to a step; float32 rounds query points to 3e-6 of 12 mm.
STEP_TOLERANCE = 2e-5
NODES = 8192  # largest number of nodes of a tile with the span of a layer; their descriptors take 67 MB
CHUNK_POINTS = 512  # points of the field that are evaluated at once, as in `optimize`
# Channels that one fused loop adds up. If they are written out one by one, XLA vectorises along the last axis of the
# grid and has the sums in registers: 20 to 25 billion differences per second on two AVX-512 cores. A reduction over the
# channels reaches 0.2 to 0.6 billion.
UNROLLED = 32
LANES = 8  # float32 numbers in a vector; the last axis of a tile is a multiple of it


class Layers(NamedTuple):
    """Query points in groups that visit the same nodes.

    Attributes:
        order: indices of the query points, layer by layer, (queries,).
        first: position in `order` at which each layer begins, and the number of query points, (layers + 1,).
        offsets: vector from a grid point to the first node of each layer, (layers, 3), metres, world axes.
        shifts: number of nodes from there to each query point, in the order of `order`, (queries, axes), grid axes.
    """

    order: Int[np.ndarray, " queries"]
    first: Int[np.ndarray, " boundaries"]
    offsets: Float[np.ndarray, "layers 3"]
    shifts: Int[np.ndarray, "queries axes"]

    @property
    def span(self) -> tuple[int, ...]:
        """The largest shift along each axis of the grid: the number of nodes that a tile needs beyond its own."""
        return tuple(int(shift) for shift in self.shifts.max(axis=0))


def layers(grid: Grid, offsets: Float[np.ndarray, "queries 3"], share: bool = True) -> Layers:
    """Group query points by the nodes that they visit.

    Args:
        grid: grid whose steps separate the nodes.
        offsets: query points relative to the query frame's origin, (queries, 3), metres, world axes.
        share: False gives each query point a layer of its own. So does True if shared layers, because they span many
            steps, need more evaluations.

    Returns:
        The layers.
    """
    alone = _grouped(grid, offsets, share=False)
    if not share:
        return alone
    shared = _grouped(grid, offsets, share=True)
    return min(shared, alone, key=lambda grouped: evaluations(grid, grouped))


def _grouped(grid, offsets, share):
    offsets = np.asarray(offsets, dtype=float)
    steps = grid.steps
    along = offsets @ grid.directions.T / steps
    across = (offsets - (along * steps) @ grid.directions) / steps.min()
    remaining, groups = np.arange(len(offsets)), []
    while len(remaining):
        steps_apart = along[remaining] - along[remaining[0]]
        same = np.abs(steps_apart - np.round(steps_apart)).max(axis=1) < STEP_TOLERANCE
        same &= np.abs(across[remaining] - across[remaining[0]]).max(axis=1) < STEP_TOLERANCE
        if not share:
            same = remaining == remaining[0]
        groups.append(remaining[same])
        remaining = remaining[~same]
    shifts, bases = [], []
    for group in groups:
        whole = np.round(along[group] - along[group[0]]).astype(int)
        shifts.append(whole - whole.min(axis=0))
        bases.append(offsets[group[0]] + (whole.min(axis=0) * steps) @ grid.directions)
    first = np.cumsum([0, *(len(group) for group in groups)])
    return Layers(np.concatenate(groups), first, np.stack(bases), np.concatenate(shifts))


class Tile(NamedTuple):
    """A box of a grid.

    Attributes:
        start: index of the first point along each axis, (axes,).
        stop: index after the last point along each axis, (axes,); beyond the end of the grid, values are dropped.
    """

    start: tuple[int, ...]
    stop: tuple[int, ...]

    def within(self, shape: Sequence[int]) -> tuple[slice, ...]:
        """The part of the tile inside a grid of this shape, as slices."""
        return tuple(slice(a, min(b, size)) for a, b, size in zip(self.start, self.stop, shape))


def tiles(grid: Grid, span: Sequence[int]) -> list[Tile]:
    """Cover a grid with boxes of one size.

    Args:
        grid: the grid; boxes without a point of its mask are omitted.
        span: span of the layers, (axes,).

    Returns:
        The boxes. Each has at most `NODES` nodes, unless a box of the smallest size has more.
    """
    size = _tile_shape(grid.shape, span)
    starts = itertools.product(*(range(0, count, step) for count, step in zip(grid.shape, size)))
    cover = [Tile(start, tuple(a + step for a, step in zip(start, size))) for start in starts]
    return [tile for tile in cover if grid.mask is None or grid.mask[tile.within(grid.shape)].any()]


def _tile_shape(shape, span):
    """Shape of the tiles: the longest axis is divided until the nodes are few enough."""
    pieces = [1] * len(shape)

    def size():
        parts = [math.ceil(count / piece) for count, piece in zip(shape, pieces)]
        parts[-1] = LANES * math.ceil(parts[-1] / LANES)
        return parts

    while (
        math.prod(part + extra for part, extra in zip(size(), span)) > NODES
        and max(size()[:-1], default=1) + size()[-1] > 1 + LANES
    ):
        # Vectors lie along the last axis, so it is divided only if it is twice as long as the others.
        lengths = [*size()[:-1], size()[-1] / 2 if size()[-1] > LANES else 0]
        pieces[int(np.argmax(lengths))] += 1
    return tuple(size())


def evaluations(grid: Grid, grouped: Layers) -> int:
    """Number of points at which a sweep of these layers evaluates the field."""
    cover = tiles(grid, grouped.span)
    nodes = math.prod(stop - start + extra for start, stop, extra in zip(*cover[0], grouped.span))
    return len(cover) * len(grouped.offsets) * nodes


def tile_energies(
    field: DescriptorField,
    descriptors: Float[Array, "poses queries channels"],
    grid: Grid,
    grouped: Layers,
    chosen: Sequence[Tile],
    device_mesh: jax.sharding.Mesh | None = None,
) -> Iterator[tuple[Tile, Float[np.ndarray, " poses *tile"]]]:
    """Compute the energies of every waypoint, tile by tile.

    Each device of the device_mesh computes one tile at a time, and no more tiles are in memory. If there are several
    processes, each computes the tiles of its own devices, and all processes get all tiles.

    Args:
        field: descriptor field of the object.
        descriptors: descriptors of the demonstration, (poses, queries, channels).
        grid: grid of the tiles.
        grouped: layers of the query points.
        chosen: tiles from `tiles`.
        device_mesh: devices that share the tiles; by default jax's default device alone.

    Yields:
        Each tile and its energies inside the grid, (poses, *tile), in the order of `chosen`.
    """
    dtype = field.origin.dtype
    channels = descriptors.shape[-1]
    blocks = math.ceil(channels / UNROLLED)
    padded = np.zeros((len(grouped.order), blocks * UNROLLED, len(descriptors)), dtype)
    padded[:, :channels] = np.asarray(descriptors).transpose(1, 2, 0)[grouped.order]
    # Each block of channels is one slab, so that the loop over query points reads contiguous numbers.
    references = np.ascontiguousarray(padded.reshape(len(padded), blocks, UNROLLED, -1).swapaxes(0, 1))
    axes = grid.steps[:, None] * grid.directions
    shared = field, references, axes.astype(dtype), grouped.shifts.astype(np.int32), grouped.first.astype(np.int32)
    device_mesh = devices.default_device_mesh() if device_mesh is None else device_mesh
    everywhere = NamedSharding(device_mesh, devices.sharded(device_mesh))
    workers = list(device_mesh.devices.flat)
    own = [
        (index, jax.device_put(shared, worker))
        for index, worker in enumerate(workers)
        if worker.process_index == jax.process_index()
    ]
    scale = descriptors.shape[1] * channels
    for start in range(0, len(chosen), len(workers)):
        batch = chosen[start : start + len(workers)]
        parts = []
        for index, copy in own:
            # Every device has to compute a tile; if there are too few, the last one is computed again.
            tile = batch[min(index, len(batch) - 1)]
            corner = grid.first + np.asarray(tile.start) @ axes
            bases = jax.device_put((corner + grouped.offsets).astype(dtype), workers[index])
            size = tuple(stop - start for start, stop in zip(*tile))
            parts.append(_tile(*copy, bases, size, grouped.span)[None])
        shape = (len(workers), *parts[0].shape[1:])
        together = devices.gathered(jax.make_array_from_single_device_arrays(shape, everywhere, parts))
        for tile, sums in zip(batch, together):
            inside = tuple(slice(part.stop - part.start) for part in tile.within(grid.shape))
            yield tile, sums[:, *inside] / scale


@functools.partial(jax.jit, static_argnames=("size", "span"))
def _tile(field, references, axes, shifts, first, bases, size, span):
    """Sums of absolute differences over layers, queries and channels, (poses, *size); see `tile_energies`."""
    nodes = tuple(part + extra for part, extra in zip(size, span))
    numbers = jnp.meshgrid(*(jnp.arange(count, dtype=axes.dtype) for count in nodes), indexing="ij")
    # The sum is written out, because a matrix product may round to fewer digits on an accelerator.
    positions = functools.reduce(jnp.add, (number[..., None] * axis for number, axis in zip(numbers, axes)))
    blocks, _, unrolled, poses = references.shape

    def layer(sums, one):
        base, start, stop = one
        descriptors = _descriptors(field, positions.reshape(-1, 3) + base, blocks * unrolled).reshape(
            blocks, unrolled, *nodes
        )

        def block(sums, both):
            # Without the barrier, XLA fuses the slice of this block into the loop below and repeats it for every query
            # point.
            here, there = jax.lax.optimization_barrier(both)

            def query(j, sums):
                shift, reference = shifts[j], there[j]
                part = 0.0
                for channel in range(unrolled):
                    # Each channel has its own slice. XLA would copy one slice of all channels, and the copy takes as
                    # long as the sum.
                    shifted = jax.lax.dynamic_slice(here, (jnp.int32(channel), *shift), (1, *size))
                    part += jnp.abs(shifted - reference[channel].reshape(-1, *[1] * len(size)))
                return sums + part

            # The sum has three stages: half a million numbers added one by one lose 3e-4 of the sum in float32.
            return sums + jax.lax.fori_loop(start, stop, query, jnp.zeros_like(sums)), None

        return jax.lax.scan(block, sums, (descriptors, references))[0], None

    sums = jnp.zeros((poses, *size), references.dtype)
    return jax.lax.scan(layer, sums, (bases, first[:-1], first[1:]))[0]


def _descriptors(field, x, channels):
    """Descriptors at points, (channels, points), padded with zeros to a number of channels."""
    size = min(CHUNK_POINTS, len(x))
    chunks = math.ceil(len(x) / size)
    parts = jnp.pad(x, ((0, chunks * size - len(x)), (0, 0))).reshape(chunks, size, 3)
    descriptors = jax.lax.map(lambda part: field.descriptors(part).T, parts)
    descriptors = jnp.moveaxis(descriptors, 1, 0).reshape(descriptors.shape[1], -1)
    return jnp.pad(descriptors, ((0, channels - len(descriptors)), (0, 0)))[:, : len(x)]
