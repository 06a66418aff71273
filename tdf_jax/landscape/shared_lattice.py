"""Descriptor losses of a query set carried over a grid, each point of the field evaluated once for all who meet there.

Carried to grid point i, query point j stands at `first + i steps + o_j`. Two query points whose offsets o differ by
whole steps of the grid stand on the same nodes: they form a layer, whose field is evaluated once on the grid extended
by their span. On a lattice of 6 x 6 x 7 in a plane of the same pitch that leaves 7 layers of 36 query points; points
drawn at random are layers of one, and the sweep is then the direct one. What remains is the sum of |descriptor -
reference| over channels, for every grid point, query point and waypoint.
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

# of a step: offsets this near to whole steps apart share nodes; float32 rounding of a query is 3e-6 of 12 mm
TOGETHER = 2e-5
NODES = 8192  # of a tile and layer: 67 MB of descriptors
CHUNK_POINTS = 512  # descriptors evaluated at a time, as in `optimize`
# Channels added up in one fused loop. Written out one by one, XLA vectorises along the grid's last axis and keeps the
# sums in registers: 20 to 25 billion differences a second on two AVX-512 cores, where a reduction over the channels
# runs at 0.2 to 0.6.
UNROLLED = 32
LANES = 8  # float32 numbers of a vector; tiles' last axis is a multiple


class Layers(NamedTuple):
    """Query points in groups that stand on the same nodes.

    Attributes:
        order: query points, those of a layer together.
        first: where each layer begins in `order`, and the number of query points.
        offsets: from a grid point to the layer's first node, world axes, metres.
        shifts: nodes from there to each query point along the grid's axes, in `order`.
    """

    order: Int[np.ndarray, " queries"]
    first: Int[np.ndarray, " boundaries"]
    offsets: Float[np.ndarray, "layers 3"]
    shifts: Int[np.ndarray, "queries axes"]

    @property
    def span(self) -> tuple[int, ...]:
        """The largest shift along each axis: nodes a tile needs beyond its own."""
        return tuple(int(shift) for shift in self.shifts.max(axis=0))


def layers(grid: Grid, offsets: Float[np.ndarray, "queries 3"], share: bool = True) -> Layers:
    """Group query points by the nodes they stand on.

    Args:
        grid: whose steps count.
        offsets: of the query points from the query frame's origin, world axes, metres.
        share: False gives each a layer of its own; so does a query that spans so many steps that sharing would evaluate
            more.
    """
    alone = _grouped(grid, offsets, share=False)
    if not share:
        return alone
    shared = _grouped(grid, offsets, share=True)
    return min(shared, alone, key=lambda found: evaluations(grid, found))


def _grouped(grid, offsets, share):
    offsets = np.asarray(offsets, dtype=float)
    steps = grid.steps
    along = offsets @ grid.directions.T / steps
    across = (offsets - (along * steps) @ grid.directions) / steps.min()
    left, groups = np.arange(len(offsets)), []
    while len(left):
        apart = along[left] - along[left[0]]
        same = np.abs(apart - np.round(apart)).max(axis=1) < TOGETHER
        same &= np.abs(across[left] - across[left[0]]).max(axis=1) < TOGETHER
        if not share:
            same = left == left[0]
        groups.append(left[same])
        left = left[~same]
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
        start: index of its first point.
        stop: index after its last; may lie beyond the grid's end, where values are dropped.
    """

    start: tuple[int, ...]
    stop: tuple[int, ...]

    def within(self, shape: Sequence[int]) -> tuple[slice, ...]:
        """The part that lies in a grid of a shape."""
        return tuple(slice(a, min(b, size)) for a, b, size in zip(self.start, self.stop, shape))


def tiles(grid: Grid, span: Sequence[int]) -> list[Tile]:
    """Boxes of one size that cover all points of a grid that count, each with at most `NODES` nodes where that is possible."""
    size = _tile_shape(grid.shape, span)
    starts = itertools.product(*(range(0, count, step) for count, step in zip(grid.shape, size)))
    cover = [Tile(start, tuple(a + step for a, step in zip(start, size))) for start in starts]
    return [tile for tile in cover if grid.mask is None or grid.mask[tile.within(grid.shape)].any()]


def _tile_shape(shape, span):
    """Equal parts of the grid: the longest axis is cut until the nodes fit."""
    pieces = [1] * len(shape)

    def size():
        parts = [math.ceil(count / piece) for count, piece in zip(shape, pieces)]
        parts[-1] = LANES * math.ceil(parts[-1] / LANES)
        return parts

    while (
        math.prod(part + extra for part, extra in zip(size(), span)) > NODES
        and max(size()[:-1], default=1) + size()[-1] > 1 + LANES
    ):
        # The last axis is the vectors': it is cut only where it is twice as long as the others.
        lengths = [*size()[:-1], size()[-1] / 2 if size()[-1] > LANES else 0]
        pieces[int(np.argmax(lengths))] += 1
    return tuple(size())


def evaluations(grid: Grid, found: Layers) -> int:
    """Points of the field that a sweep of these layers evaluates."""
    cover = tiles(grid, found.span)
    nodes = math.prod(stop - start + extra for start, stop, extra in zip(*cover[0], found.span))
    return len(cover) * len(found.offsets) * nodes


def swept(
    field: DescriptorField,
    descriptors: Float[Array, "poses queries channels"],
    grid: Grid,
    found: Layers,
    which: Sequence[Tile],
    device_mesh: jax.sharding.Mesh | None = None,
) -> Iterator[tuple[Tile, Float[np.ndarray, " poses *tile"]]]:
    """Energies of every waypoint on tiles, in their order.

    As many tiles are computed at a time as the device_mesh has devices, one on each; no more is held. Of several processes
    each computes those of its own devices, and all of them get all.

    Args:
        field: the object's.
        descriptors: the demonstration's.
        grid: the tiles'.
        found: layers of the query points.
        which: from `tiles`.
        device_mesh: of devices to share the tiles; jax's default one alone if not given.
    """
    dtype = field.origin.dtype
    channels = descriptors.shape[-1]
    blocks = math.ceil(channels / UNROLLED)
    padded = np.zeros((len(found.order), blocks * UNROLLED, len(descriptors)), dtype)
    padded[:, :channels] = np.asarray(descriptors).transpose(1, 2, 0)[found.order]
    # One slab a block of channels, so that the loop over query points walks through contiguous numbers.
    references = np.ascontiguousarray(padded.reshape(len(padded), blocks, UNROLLED, -1).swapaxes(0, 1))
    axes = grid.steps[:, None] * grid.directions
    shared = field, references, axes.astype(dtype), found.shifts.astype(np.int32), found.first.astype(np.int32)
    device_mesh = devices.default_device_mesh() if device_mesh is None else device_mesh
    everywhere = NamedSharding(device_mesh, devices.sharded(device_mesh))
    workers = list(device_mesh.devices.flat)
    own = [
        (index, jax.device_put(shared, worker))
        for index, worker in enumerate(workers)
        if worker.process_index == jax.process_index()
    ]
    scale = descriptors.shape[1] * channels
    for start in range(0, len(which), len(workers)):
        some = which[start : start + len(workers)]
        parts = []
        for index, copy in own:
            # Every device computes something: where the tiles run out, the last one again.
            tile = some[min(index, len(some) - 1)]
            corner = grid.first + np.asarray(tile.start) @ axes
            bases = jax.device_put((corner + found.offsets).astype(dtype), workers[index])
            size = tuple(stop - start for start, stop in zip(*tile))
            parts.append(_tile(*copy, bases, size, found.span)[None])
        shape = (len(workers), *parts[0].shape[1:])
        together = devices.gathered(jax.make_array_from_single_device_arrays(shape, everywhere, parts))
        for tile, sums in zip(some, together):
            inside = tuple(slice(part.stop - part.start) for part in tile.within(grid.shape))
            yield tile, sums[:, *inside] / scale


@functools.partial(jax.jit, static_argnames=("size", "span"))
def _tile(field, references, axes, shifts, first, bases, size, span):
    """Sums of absolute differences (poses, *size); see `swept` for the arguments."""
    nodes = tuple(part + extra for part, extra in zip(size, span))
    numbers = jnp.meshgrid(*(jnp.arange(count, dtype=axes.dtype) for count in nodes), indexing="ij")
    # Written out: a matrix product may round to fewer digits on an accelerator.
    places = sum(number[..., None] * axis for number, axis in zip(numbers, axes))
    blocks, _, unrolled, poses = references.shape

    def layer(sums, one):
        base, start, stop = one
        descriptors = _descriptors(field, places.reshape(-1, 3) + base, blocks * unrolled).reshape(
            blocks, unrolled, *nodes
        )

        def block(sums, both):
            # Without the barrier the slice of this block is fused into the loop below, and taken again for every query
            # point.
            here, there = jax.lax.optimization_barrier(both)

            def query(j, sums):
                place, wanted = shifts[j], there[j]
                part = 0.0
                for channel in range(unrolled):
                    # A slice for each channel: one slice of all would be copied, and the copy takes as long as the sum.
                    moved = jax.lax.dynamic_slice(here, (channel, *place), (1, *size))
                    part += jnp.abs(moved - wanted[channel].reshape(-1, *[1] * len(size)))
                return sums + part

            # In three stages: half a million numbers added one by one lose 3e-4 of the sum in float32.
            return sums + jax.lax.fori_loop(start, stop, query, jnp.zeros_like(sums)), None

        return jax.lax.scan(block, sums, (descriptors, references))[0], None

    sums = jnp.zeros((poses, *size), references.dtype)
    return jax.lax.scan(layer, sums, (bases, first[:-1], first[1:]))[0]


def _descriptors(field, x, channels):
    """Descriptors at points, (channels, points), with zeros for channels that do not exist."""
    size = min(CHUNK_POINTS, len(x))
    chunks = math.ceil(len(x) / size)
    parts = jnp.pad(x, ((0, chunks * size - len(x)), (0, 0))).reshape(chunks, size, 3)
    found = jax.lax.map(lambda part: field.descriptors(part).T, parts)
    found = jnp.moveaxis(found, 1, 0).reshape(found.shape[1], -1)
    return jnp.pad(found, ((0, channels - len(found)), (0, 0)))[:, : len(x)]
