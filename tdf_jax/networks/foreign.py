"""Foreign points of a cloud: of the table, of a neighbour, or of nothing.

Statistics find what is far from all else. What is near is found by the field. A network that has encoded an object
alone has its surface at the object's points, within a hundredth of the object's size. With a fifth of the points of
something else it has not, neither at these points nor at the object's own. The measure of a field is the mean logarithm
of the distances of the cloud's points from its surface. A part of the cloud is the object if its field is much better
by this measure than that of the whole cloud, which holds for no part of a clean cloud.
"""

from collections.abc import Callable, Iterator
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int

from tdf_jax.networks.field import DescriptorField
from tdf_jax.networks.occupancy import Conditioned, decode

EXTENT = 3.0  # extent of an object over the median distance from its centre, about the diagonal of its bounding box
# Gap, in extents, to what is not of the object. Visible parts of one object, such as its two sides over the rim, are up
# to 0.4 diagonals apart in a cloud of one camera.
REMOTE = 1.0
CELLS = 4  # cells in such a gap: their means represent the points
MOST = 0.3  # largest share of foreign points; of more it is not known which part is the object
SAMPLE = 448  # points at which a field is judged
SEARCHED = 2048  # points of a cloud in which its parts are searched for
PADDING = 256  # numbers of points are padded to a multiple of this, so that many share one program
NEIGHBOURS = 8  # points whose mean distance says how isolated a point is
ISOLATED = 3.0  # this multiple of the median of these distances
SUSPECTS = 64  # most isolated points that are judged besides the sample
# Distances from a field's surface, in extents: larger ones count as CAP, smaller ones as little more than FLOOR. Points
# within KEPT of the surface stay.
CAP, FLOOR, KEPT = 0.06, 0.0005, 0.03
LOGIT = 4.0  # a smaller logit is near the surface, whatever its slope
# A field whose sample has fewer points far from the surface than FEW, and no suspect, is that of a clean cloud.
FAR, FAR_LOGIT, FEW = 0.04, 6.0, 3
DIRECTIONS = 26
CUT = 0.22  # share of the points that is cut off along a direction: a fifth, and a little
REFINED = 3  # parts that are refined, the best ones
BANDS = CAP, CAP, 0.045, KEPT  # distances within which points stay in each round of it
LEAST = 0.55  # smallest share of the points of a part
# Smallest share of foreign points near an object. Fewer do little harm, and some clean clouds of racks have 1 to 3 %
# that the network does not know well.
FEWEST = 0.04
# Groups of points that were left out: how many, of how many points, and the distance that links them over the median
# distance of nearest points.
GROUPS, LEAST_GROUP, LINK = 5, 10, 3.0
TRIPLES, SUPPORTS = 500, 2  # planes that are tried, and kept
FLAT, BENEATH = 0.01, 0.03  # extents: half the thickness of a plane; share of the points beneath it
# A field of a measure up to GOOD is that of a clean cloud. A part is the object if its measure is at most BETTER, and
# less than that of the whole cloud by at least MARGIN; at ENOUGH, no others are refined. On generated objects, fields
# of complete clean clouds have -5.5 to -6.4, with noise of 2 mm and in poor views up to -3, and no part is better
# by more than 0.25; with a fifth of foreign points fields have -3 to -5.3, and those of the object's points -5.3 to -6.
GOOD, BETTER, MARGIN, ENOUGH = -5.5, -4.3, 0.27, -5.7


class Finding(NamedTuple):
    """What the field says of a cloud.

    Attributes:
        kept: mask of the points of the object, (points,); all of them if none is foreign.
        field: field of these points; None if none is foreign.
    """

    kept: Bool[np.ndarray, " points"]
    field: DescriptorField | None


def remote_points(points: Float[np.ndarray, "points 3"]) -> Bool[np.ndarray, " points"]:
    """Find points that are farther from the largest part of a cloud than the cloud is large.

    Args:
        points: point cloud, (points, 3), metres.

    Returns:
        Mask of the points that are not in the largest of the parts with gaps of an extent between them, (points,).
    """
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components
    from scipy.spatial import KDTree

    radii, gap = _radii(points)
    gap *= REMOTE * EXTENT
    if radii.max() <= gap:
        return np.zeros(len(points), bool)
    cells = np.floor((points - points.min(axis=0)) / max(gap, 1e-300) * CELLS)
    cell = np.unique(cells, axis=0, return_inverse=True)[1].reshape(-1)
    counts = np.bincount(cell)
    middles = np.stack([np.bincount(cell, weights=column) for column in points.T.astype(float)], axis=1)
    # The mean of a cell is up to a diagonal of a cell from its points, on both sides of a gap.
    pairs = KDTree(middles / counts[:, None]).query_pairs(gap * (1 + 2 * np.sqrt(3) / CELLS), output_type="ndarray")
    links = coo_array((np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), shape=(len(counts),) * 2)
    part = connected_components(links, directed=False)[1]
    largest = np.argmax(np.bincount(part, weights=counts))
    return (part != largest)[cell]


def extent_of(points: Float[np.ndarray, "points 3"]) -> float:
    """About the diagonal of an object's bounding box, metres; fewer than half of the points have no influence on it.

    Args:
        points: point cloud, (points, 3), metres.
    """
    return EXTENT * _radii(points)[1]


def find_foreign(
    field: DescriptorField,
    points: Float[np.ndarray, "points 3"],
    encode_part: Callable[[Int[np.ndarray, " part"], bool], DescriptorField],
) -> Finding:
    """Find the points of a cloud that are not of its object, by the fields of parts of it.

    Args:
        field: field of the whole cloud.
        points: point cloud, (points, 3), metres, world frame.
        encode_part: function that encodes a part of the cloud, given by indices; roughly and fast if its second
            argument is False.

    Returns:
        The points to keep, and their field. If more than `MOST` of the points look foreign, `kept` says which, and the
            field is None.
    """
    clean = Finding(np.ones(len(points), bool), None)
    extent = extent_of(points)
    if extent == 0:
        return clean
    isolation = _isolation(points)
    suspects = np.argsort(-isolation, kind="stable")[:SUSPECTS]
    suspects = suspects[isolation[suspects] > ISOLATED]
    judged = np.concatenate([points[_spread(len(points), SAMPLE)], points[suspects]])
    distances, logits = _misfit(field, judged, extent)
    far = (distances >= FAR) & (np.abs(logits) > FAR_LOGIT)
    if np.count_nonzero(far[:SAMPLE]) < FEW and not far[SAMPLE:].any():
        return clean
    before = _measure(distances[:SAMPLE])
    if before <= GOOD:
        return clean
    searched = _spread(len(points), SEARCHED)
    found = _search(points[searched], extent, lambda part: encode_part(searched[part], False))
    if found is None:
        return clean
    rough, ratio = found
    kept = (isolation <= ratio) & _near(rough, points, extent, KEPT)
    if kept.mean() > 1 - FEWEST or kept.mean() < LEAST:
        return clean
    better = encode_part(np.flatnonzero(kept), True)
    after = _measure(_misfit(better, judged[:SAMPLE], extent)[0])
    if after > min(BETTER, before - MARGIN):
        return clean
    return Finding(kept, better if kept.mean() >= 1 - MOST else None)


def _search(points, extent: float, encode_part) -> tuple[DescriptorField, float] | None:
    """The field of a part of a cloud that is the best for all of it, and how isolated points of the part may be."""
    sample, isolation, trials = points[_spread(len(points), SAMPLE // 2)], _isolation(points), []
    for ratio, part in _parts(points, isolation, extent):
        field = encode_part(np.flatnonzero(part))
        trials.append((_measure(_misfit(field, sample, extent)[0]), ratio, field))
    trials.sort(key=lambda trial: trial[0])
    best, least = None, np.inf
    for _, ratio, field in trials[:REFINED]:
        for band in BANDS:
            part = (isolation <= ratio) & _near(field, points, extent, band)
            if part.mean() < LEAST:
                break
            field = encode_part(np.flatnonzero(part))
            measure = _measure(_misfit(field, sample, extent)[0])
            if measure < least:
                best, least = (field, ratio), measure
        if least < ENOUGH:
            break
    if best is None:
        return None
    field, ratio = best
    # A part that was left out with what is foreign, such as a handle, comes back if it makes the field better.
    fitting = (isolation <= ratio) & _near(field, points, extent, KEPT)
    for group in _groups(points, (isolation <= ratio) & ~fitting):
        other = encode_part(np.flatnonzero(fitting | group))
        measure = _measure(_misfit(other, sample, extent)[0])
        if measure < least:
            field, least, fitting = other, measure, fitting | group
    return field, ratio


def _parts(points, isolation, extent: float) -> Iterator[tuple[float, Bool[np.ndarray, " points"]]]:
    """Parts that may be the object, each after the largest isolation of its points."""
    for ratio in (2.0, ISOLATED):
        dense = isolation <= ratio
        if LEAST <= dense.mean() < 1:
            yield ratio, dense
    for support in _supports(points, extent):
        if support.mean() <= 1 - LEAST:
            yield np.inf, ~support
    centred = points - np.median(points, axis=0)
    for direction in _directions(centred):
        along = centred @ direction
        yield np.inf, along <= np.quantile(along, 1 - CUT)


def _groups(points, left_out) -> list[Bool[np.ndarray, " points"]]:
    """The largest groups of connected points among those that were left out."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components
    from scipy.spatial import KDTree

    chosen = np.flatnonzero(left_out)
    if len(chosen) < LEAST_GROUP:
        return []
    tree = KDTree(points)
    gap = LINK * float(np.median(tree.query(points, k=2)[0][:, 1]))
    pairs = KDTree(points[chosen]).query_pairs(gap, output_type="ndarray")
    links = coo_array((np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), shape=(len(chosen),) * 2)
    number = connected_components(links, directed=False)[1]
    sizes = np.bincount(number)
    largest = [index for index in np.argsort(-sizes, kind="stable")[:GROUPS] if sizes[index] >= LEAST_GROUP]
    groups = np.zeros((len(largest), len(points)), bool)
    for row, index in zip(groups, largest):
        row[chosen[number == index]] = True
    return list(groups)


def _supports(points, extent: float) -> list[Bool[np.ndarray, " points"]]:
    """Points on planes that have nearly all others on one side: what an object stands on, and its own flat sides."""
    triples = points[np.random.default_rng(0).integers(len(points), size=(TRIPLES, 3))].astype(float)
    normals = np.cross(triples[:, 1] - triples[:, 0], triples[:, 2] - triples[:, 0])
    lengths = np.linalg.norm(normals, axis=1)
    normals, corners = normals[lengths > 0] / lengths[lengths > 0, None], triples[lengths > 0, 0]
    heights = points @ normals.T - (normals * corners).sum(axis=1)
    on = np.abs(heights) < FLAT * extent
    beneath = np.minimum((heights < -FLAT * extent).mean(axis=0), (heights > FLAT * extent).mean(axis=0))
    order = np.argsort(-np.where(beneath < BENEATH, on.mean(axis=0), 0), kind="stable")
    chosen: list[Bool[np.ndarray, " points"]] = []
    for index in order:
        if len(chosen) == SUPPORTS or beneath[index] >= BENEATH:
            break
        if all((on[:, index] & other).sum() < on[:, index].sum() / 2 for other in chosen):
            chosen.append(on[:, index])
    return chosen


def _near(field: DescriptorField, points, extent: float, band: float) -> Bool[np.ndarray, " points"]:
    distances, logits = _misfit(field, points, extent)
    return (distances < band) | (np.abs(logits) <= LOGIT)


def _spread(count: int, most: int) -> Int[np.ndarray, " spread"]:
    """At most so many indices, spread over a cloud in its order."""
    return np.linspace(0, count - 1, min(most, count)).astype(int)


def _directions(centred) -> Float[np.ndarray, "directions 3"]:
    """Directions spread over the sphere, in a frame that rotates with the cloud."""
    axes = np.linalg.eigh(np.cov(centred.T.astype(float)))[1].T
    skew = ((centred @ axes.T) ** 3).sum(axis=0)
    axes = axes * np.where(skew < 0, -1.0, 1.0)[:, None]
    number = np.arange(DIRECTIONS) + 0.5
    height, angle = 1 - 2 * number / DIRECTIONS, np.pi * (1 + np.sqrt(5)) * number
    width = np.sqrt(1 - height**2)
    return np.stack([width * np.cos(angle), width * np.sin(angle), height], axis=1) @ axes


def _radii(points) -> tuple[Float[np.ndarray, " points"], float]:
    """Distances from the middle of a cloud, and their median."""
    radii = np.linalg.norm(points - np.median(points, axis=0), axis=1)
    return radii, float(np.median(radii))


def _isolation(points) -> Float[np.ndarray, " points"]:
    """Mean distance of every point to its neighbours over the median of these distances."""
    from scipy.spatial import KDTree

    exact = points.astype(np.float64)
    distances = KDTree(exact).query(exact, k=min(NEIGHBOURS + 1, len(exact)))[0][:, 1:].mean(axis=1)
    return distances / max(float(np.median(distances)), 1e-300)


def _measure(distances) -> float:
    return float(np.log(distances + FLOOR).mean())


def _misfit(field: DescriptorField, points, extent: float):
    """Distances of points from the surface, in extents and to the first order, and their logits."""
    local = points - np.asarray(field.origin, points.dtype)
    padded = np.resize(local, (-(-len(local) // PADDING) * PADDING, 3)).astype(field.origin.dtype)
    logits, slopes = (np.asarray(part)[: len(local)] for part in _slope(field.conditioned, padded))
    return np.minimum(np.abs(logits) / np.maximum(slopes * extent, 1e-12), CAP), logits


@jax.jit
def _slope(conditioned: Conditioned, x):
    logits, pull = jax.vjp(lambda x: decode(conditioned, x)[1], x)
    return logits, jnp.linalg.norm(pull(jnp.ones_like(logits))[0], axis=-1)
