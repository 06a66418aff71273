"""Objects of a scene that stand apart from each other."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float, Int
from numpy.typing import ArrayLike

from tdf_jax._internal import checks
from tdf_jax._internal.boundary import host
from tdf_jax._internal.errors import InputError
from tdf_jax.perception.support import find_support, no_plane
from tdf_jax.perception.voxels import canonical_order, voxels_of

GAP = 0.02  # metres: objects at 3 cm stand apart, and parts of one object that hide each other mostly do not
CELLS = 5  # cells in a gap: their means represent the points
LEAST_POINTS = 50  # of a cluster that is an object
# Points join others only if at least this share of the median number of points is around them: stray points make no
# bridge. Of 0.02, 0.05 and 0.1, the last loses a fifth of the points of some pegs.
DENSE = 0.05
BORDER = 0.25  # of a gap: the distance within which the others belong to the cluster
# What floats above the table is a part of an object that hides the rest of it, such as a peg behind its post: metres
# above the table, largest distance in gaps, and largest share of the object's points.
FLOATING, NEAR, FRAGMENT = 0.02, 3.0, 0.25
FLAT = 2.0  # a cluster that is nowhere higher than this multiple of the table's band is unevenness of the table


@host
def separate_objects(
    points: Float[np.ndarray, "points 3"] | Sequence[Float[np.ndarray, "_ 3"]],
    workspace: ArrayLike | None = None,
    *,
    plane: bool = True,
    camera: ArrayLike | None = None,
    gap: float = GAP,
    min_points: int = LEAST_POINTS,
) -> list[Float[np.ndarray, "_ 3"]]:
    """Separate the objects on a table: the table is removed, and clusters of points with gaps between them remain.

    Objects that touch each other stay one cluster, and an object whose visible parts are apart becomes several.

    Args:
        points: points of the scene, (points, 3), metres, such as from `points_from_depth`; or a list of several views
            of it in one world frame, whose table is removed from each by itself: its noise depends on the distance of
            the camera.
        workspace: box that the objects are in, its smallest and its largest x, y and z, (6,) or (2, 3), metres, in the
            frame of the points. Points outside are left out first, which removes walls and floors; by default there is
            no box.
        plane: whether to remove the largest plane first, as `remove_plane` does.
        camera: position of the camera, (3,), metres, see `remove_plane`; of several views, one for each, (views, 3).
        gap: distance between points of different objects, metres.
        min_points: smallest number of points of an object; smaller clusters are left out.

    Returns:
        One cloud for each object, the one of most points first; points in their order and type.

    Raises:
        InputError: the points are no cloud, the workspace is empty, there is no plane or no object, or another number
            of cameras than of views.
    """
    function = "separate_objects()"
    checks.boolean(function, "plane", plane)
    checks.positive(function, "gap", gap, "metres")
    checks.count(function, "min_points", min_points)
    views, cameras = _views(function, points, camera)
    if workspace is not None:
        box = workspace_box(function, workspace)
        within = [view[((view >= box[0]) & (view <= box[1])).all(axis=1)] for view in views]
        if not any(map(len, within)):
            raise InputError(
                f"{function}: none of {sum(map(len, views))} points is in the workspace {box.tolist()}; expected "
                "objects in it. Check its unit and its frame, which is that of the points"
            )
        views, cameras = zip(*((view, one) for view, one in zip(within, cameras) if len(view)))
    heights = bands = None
    if plane:
        # Each view has its own table: of merged ones, that of a near camera would be the noise of a far one's.
        above = [_above_table(function, view, one) for view, one in zip(views, cameras)]
        views, heights, bands = zip(*above)
        heights, bands = np.concatenate(heights), np.concatenate(bands)
    cloud = np.concatenate(views)
    clusters = clusters_of(cloud, gap)
    if heights is not None and bands is not None:
        clusters = _joined(cloud, clusters, heights, gap)
        high = np.unique(clusters[heights > FLAT * bands])
        clusters = np.where(np.isin(clusters, high), clusters, -1)
    sizes = np.bincount(clusters[clusters >= 0])
    large = np.flatnonzero(sizes >= min_points)
    if not len(large):
        largest = (
            f"the largest of {np.count_nonzero(sizes)} clusters has {sizes.max()}" if len(sizes) else "none is left"
        )
        raise InputError(
            f"{function}: no cluster has {min_points} points: {largest}; expected an object. Check the workspace, the "
            "unit and the camera, or lower min_points"
        )
    return [cloud[clusters == index] for index in large[np.argsort(-sizes[large], kind="stable")]]


def _views(function: str, points, camera) -> tuple[list[np.ndarray], list]:
    """The views, and the camera of each, or None."""
    if not isinstance(points, list | tuple) or not points or not all(np.ndim(view) == 2 for view in points):
        return [np.asarray(checks.points(function, points))], [camera]
    views = [np.asarray(checks.points(function, view, f"points[{index}]")) for index, view in enumerate(points)]
    if camera is None:
        return views, [None] * len(views)
    positions = checks.numbers(function, "camera", camera)
    if positions.shape != (len(views), 3):
        raise InputError(
            f"{function}: camera has the shape {positions.shape}; expected the position of the camera of each of "
            f"{len(views)} views, ({len(views)}, 3)"
        )
    return views, list(positions)


def _above_table(function: str, view: np.ndarray, camera) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Points of a view above its largest plane, their heights, and those up to which a point is the plane's."""
    support = find_support(function, view, camera)
    if support is None:
        raise no_plane(function, len(view), "If there is none, or it is removed already, pass plane=False")
    heights, bands = support.heights(view), support.bands(view)
    front = heights > bands
    return view[front], heights[front], bands[front]


def clusters_of(points: Float[np.ndarray, "points 3"], gap: float = GAP) -> Int[np.ndarray, " points"]:
    """Number the clusters of points that are closer than a gap.

    Args:
        points: points, (points, 3), metres.
        gap: distance, metres.

    Returns:
        Number of every point's cluster, (points,), from 0, which does not depend on the order of the points; -1 of
        stray points.
    """
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components
    from scipy.spatial import KDTree

    if not len(points):
        return np.zeros(0, int)
    exact = points.astype(np.float64)
    order = canonical_order(exact)
    voxels = voxels_of(exact[order], gap / CELLS)
    count = len(voxels.means)
    first, second = KDTree(voxels.means).query_pairs(gap, output_type="ndarray").T
    around = voxels.counts + np.bincount(first, voxels.counts[second], count)
    around += np.bincount(second, voxels.counts[first], count)
    dense = around >= DENSE * np.median(np.repeat(around, voxels.counts))
    both = dense[first] & dense[second]
    joined = coo_array((np.ones(both.sum(), bool), (first[both], second[both])), shape=(count, count))
    labels = connected_components(joined, directed=False)[1]
    distance, nearest = KDTree(voxels.means[dense]).query(voxels.means[~dense])
    labels[~dense] = np.where(distance <= BORDER * gap, labels[np.flatnonzero(dense)[nearest]], -1)
    found = np.empty(len(points), int)
    found[order] = labels[voxels.index]
    return found


def _joined(points, clusters, heights, gap: float) -> Int[np.ndarray, " points"]:
    """Numbers of clusters in which small ones that float above the table have the number of the object beside them."""
    from scipy.spatial import KDTree

    sizes = np.bincount(clusters[clusters >= 0])
    lowest = np.full(len(sizes), np.inf)
    np.minimum.at(lowest, clusters[clusters >= 0], heights[clusters >= 0])
    standing = np.flatnonzero((lowest <= FLOATING) & (sizes >= LEAST_POINTS))
    floating = np.flatnonzero((lowest > FLOATING) & (sizes > 0))
    trees = {number: KDTree(points[clusters == number]) for number in standing} if len(floating) else {}
    found = clusters.copy()
    for number in floating:
        part = points[clusters == number]
        distances = {
            other: tree.query(part, distance_upper_bound=NEAR * gap)[0].min()
            for other, tree in trees.items()
            if sizes[number] <= FRAGMENT * sizes[other]
        }
        if distances and min(distances.values()) < NEAR * gap:
            found[clusters == number] = min(distances, key=lambda other: distances[other])
    return found


def workspace_box(function: str, workspace: ArrayLike) -> Float[np.ndarray, "2 3"]:
    """Check that a workspace is a box.

    Args:
        function: name that error messages begin with.
        workspace: its smallest and its largest x, y and z, (6,) or (2, 3), metres.

    Returns:
        Its smallest and its largest corner, (2, 3), metres.

    Raises:
        InputError: it is not.
    """
    box = checks.numbers(function, "workspace", workspace)
    if box.shape not in ((6,), (2, 3)) or not np.isfinite(box).all():
        raise InputError(
            f"{function}: workspace is {box.tolist()}; expected the smallest and then the largest x, y and z, six "
            "finite numbers, metres"
        )
    box = box.reshape(2, 3)
    if not (box[0] < box[1]).all():
        raise InputError(
            f"{function}: workspace is {box.tolist()}; expected the smallest x, y and z before the largest: "
            "xmin ymin zmin xmax ymax zmax"
        )
    return box
