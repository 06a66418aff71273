"""The plane that objects stand on: the largest plane of a scene, found by least squares from many hypotheses."""

from typing import Literal, NamedTuple, overload

import numpy as np
from jaxtyping import Bool, Float, Int
from numpy.typing import ArrayLike

from tdf_jax._internal import checks
from tdf_jax._internal.boundary import host
from tdf_jax._internal.errors import InputError
from tdf_jax.perception.voxels import canonical_order, distinct_rows, voxels_of

PATCH, TESTED = 0.03, 0.01  # metres, edges of the cells that give hypotheses, and of those that are counted
HYPOTHESES, COUNTED = 400, 20_000  # most of each
PATCH_POINTS = 6  # fewest cells in and around a patch of a hypothesis
START_BAND = 0.015  # metres: half of the thickness of the first band, more than the noise of most cameras
REFINED, RANKED = 5, 3000  # best hypotheses that are refined, and cells whose points decide among them
ITERATIONS = 30
WIDTH = 2.5  # half of a fitted band's thickness, standard deviations
# Standard deviations of the plane's noise above which a point is no longer the plane's: 1 of 740 noisy points of the
# plane is higher.
HEIGHT = 3.0
PLACE, PLACE_POINTS = 0.05, 40  # metres, edge of a place whose own noise is measured, and fewest points for it
LEAST_BAND = 0.0002  # metres, of exact data
MIDDLE = 0.6745  # standard deviations of the middle of the absolute values of normal numbers
MIDDLE_IN_BAND = 0.6634  # the same of those within 2.5 standard deviations
MOST_NOISE = 0.0058  # metres: of a surface that fills the first band, such as the side of a mug, which is no plane
# A plane covers at least this many cells (100 cm2), and this share of all.
LEAST_AREA, LEAST_SHARE = 100, 0.1


class Support(NamedTuple):
    """A plane with objects on one side.

    Attributes:
        plane: (a, b, c, d), unit normal (a, b, c) towards the objects; a x + b y + c z + d is the height above it,
            metres.
        noise: standard deviation of the plane's points, metres.
    """

    plane: Float[np.ndarray, "4"]
    noise: float

    def heights(self, points: Float[np.ndarray, "points 3"]) -> Float[np.ndarray, " points"]:
        """Heights of points above the plane, metres."""
        return points.astype(np.float64) @ self.plane[:3] + self.plane[3]

    def cells(self, points: Float[np.ndarray, "points 3"], edge: float) -> Int[np.ndarray, "points 2"]:
        """Whole coordinates of points in the plane, in cells of an edge, metres."""
        axes = np.linalg.svd(self.plane[None, :3])[2][1:]  # two directions in the plane
        return np.floor(points.astype(np.float64) @ axes.T / edge).astype(np.int64)

    def bands(self, points: Float[np.ndarray, "points 3"]) -> Float[np.ndarray, " points"]:
        """Height up to which a point is the plane's, metres.

        Near the camera a plane is seen more steeply, and its heights are noisier. The noise of a place is that of the
        points below the plane, where no object is.

        Args:
            points: all points of the scene, (points, 3), metres.
        """
        heights = self.heights(points)
        below = np.flatnonzero((heights < 0) & (heights > -START_BAND))
        index = distinct_rows(self.cells(points, PLACE))[1]
        below = below[np.lexsort((heights[below], index[below]))]
        counts = np.bincount(index[below], minlength=index.max() + 1)
        starts = np.concatenate([[0], np.cumsum(counts)[:-1]])
        noise = np.full(len(counts), self.noise)
        known = counts >= PLACE_POINTS
        noise[known] = -heights[below[starts[known] + counts[known] // 2]] / MIDDLE
        return np.maximum(LEAST_BAND, HEIGHT * noise)[index]

    def in_front(self, points: Float[np.ndarray, "points 3"]) -> Bool[np.ndarray, " points"]:
        """Which points of a scene, (points, 3), are above the plane and not its own."""
        return self.heights(points) > self.bands(points)


@overload
def remove_plane(
    points: Float[np.ndarray, "points 3"],
    camera: ArrayLike | None = None,
    *,
    return_plane: Literal[False] = False,
) -> Float[np.ndarray, "kept 3"]: ...
@overload
def remove_plane(
    points: Float[np.ndarray, "points 3"],
    camera: ArrayLike | None = None,
    *,
    return_plane: Literal[True],
) -> tuple[Float[np.ndarray, "kept 3"], Float[np.ndarray, "4"]]: ...
@host
def remove_plane(
    points: Float[np.ndarray, "points 3"],
    camera: ArrayLike | None = None,
    *,
    return_plane: bool = False,
) -> Float[np.ndarray, "kept 3"] | tuple[Float[np.ndarray, "kept 3"], Float[np.ndarray, "4"]]:
    """Remove the largest plane of a scene, such as a table, and all that is behind it.

    The largest plane covers the largest area. It is fitted by least squares, and points up to three standard deviations
    of its own noise above it are removed with it.

    Args:
        points: points of the scene, (points, 3), metres.
        camera: position of the camera, (3,), metres, in the frame of the points; objects are on its side of the plane.
            Without it they are on the side of more points over the plane.
        return_plane: also return the plane.

    Returns:
        The points in front of the plane, (kept, 3), in their order and type; with `return_plane`, and the plane
        (a, b, c, d): a unit normal towards the objects, and a x + b y + c z + d = 0 on the plane.

    Raises:
        InputError: the points are no cloud, there is no plane of 100 cm2 and a tenth of the scene, or nothing is in
            front of it.
    """
    function = "remove_plane()"
    checks.boolean(function, "return_plane", return_plane)
    cloud = np.asarray(checks.points(function, points))
    support = find_support(function, cloud, camera)
    if support is None:
        raise no_plane(function, len(cloud), "Check the unit, or go on without this step")
    kept = cloud[support.in_front(cloud)]
    if not len(kept):
        raise InputError(
            f"{function}: all {len(cloud)} points are on the largest plane or behind it; expected objects in front of "
            "it. Check the position of the camera"
        )
    return (kept, support.plane) if return_plane else kept


def find_support(
    function: str, points: Float[np.ndarray, "points 3"], camera: ArrayLike | None = None
) -> Support | None:
    """Find the plane that covers the largest area.

    Every patch of the surface is a hypothesis, which needs fewer of them than three points drawn at random.

    Args:
        function: name that error messages begin with.
        points: points of the scene, (points, 3), metres.
        camera: position of the camera, (3,), metres; see `remove_plane`.

    Returns:
        The plane; None if there is none that is large enough.

    Raises:
        InputError: the camera is not a position.
    """
    position = None if camera is None else np.asarray(checks.vector(function, "camera", camera))
    exact = points.astype(np.float64)
    exact = exact[canonical_order(exact)]
    tested = voxels_of(exact, TESTED)
    chosen = tested.means[tested.spread(COUNTED)]
    areas = 1 / tested.counts[tested.index]  # of points: near the camera they are denser
    hypotheses = _hypotheses(tested.means)
    if not len(hypotheses):
        return None
    scores = np.array([np.count_nonzero(np.abs(chosen @ plane[:3] + plane[3]) < START_BAND) for plane in hypotheses])
    few = np.isin(tested.index, tested.spread(RANKED))
    best, area = None, 0
    for index in np.argsort(-scores, kind="stable")[:REFINED]:
        plane, noise = _refined(exact[few], areas[few], hypotheses[index])
        if noise > MOST_NOISE:
            continue
        band = max(LEAST_BAND, WIDTH * noise)
        covered = int(np.count_nonzero(np.abs(tested.means @ plane[:3] + plane[3]) < band))
        if covered > area:
            best, area = plane, covered
    if best is None or area < max(LEAST_AREA, LEAST_SHARE * len(tested.means)):
        return None
    plane, noise = _refined(exact, areas, best)
    one = Support(plane, noise)
    sign = _side(exact, one) if position is None else np.sign(position @ plane[:3] + plane[3])
    return Support(plane * (sign or 1.0), noise)


def no_plane(function: str, count: int, fix: str) -> InputError:
    """The error where `find_support` finds nothing.

    Args:
        function: name that the message begins with.
        count: number of points of the scene.
        fix: what to do, a sentence without its full stop.
    """
    return InputError(
        f"{function}: there is no plane of {LEAST_AREA} cm2 that covers {LEAST_SHARE:.0%} of the surface that {count} "
        f"points show; expected a table. {fix}"
    )


def _hypotheses(points: Float[np.ndarray, "points 3"]) -> Float[np.ndarray, "hypotheses 4"]:
    """Planes through patches of the surface."""
    from scipy.spatial import KDTree

    patches = voxels_of(points, PATCH)
    centres = patches.means[patches.spread(HYPOTHESES)]
    planes = []
    for near in KDTree(points).query_ball_point(centres, PATCH, return_sorted=True):
        if len(near) >= PATCH_POINTS:
            planes.append(_fit(points[near], np.ones(len(near))))
    return np.array(planes).reshape(-1, 4)


def _fit(points: Float[np.ndarray, "points 3"], weights: Float[np.ndarray, " points"]) -> Float[np.ndarray, "4"]:
    """The plane of weighted least squares of the distances."""
    middle = weights @ points / weights.sum()
    offsets = points - middle
    normal = np.linalg.eigh((weights[:, None] * offsets).T @ offsets)[1][:, 0]
    return np.append(normal, -normal @ middle)


def _refined(
    points: Float[np.ndarray, "points 3"], areas: Float[np.ndarray, " points"], plane: Float[np.ndarray, "4"]
) -> tuple[np.ndarray, float]:
    """The plane fitted again to the points near it, until they do not change, and the deviation of their distances."""
    within = np.abs(points @ plane[:3] + plane[3]) < 2 * START_BAND  # the others will not come near
    points, areas = points[within], areas[within]
    band, noise, last = START_BAND, np.inf, None
    for _ in range(ITERATIONS):
        near = np.abs(points @ plane[:3] + plane[3]) < band
        if np.count_nonzero(near) < 3 or (last is not None and (near == last).all()):
            break
        plane, last = _fit(points[near], areas[near]), near
        # Of points in a band of 2.5 deviations; a wider or narrower one has another estimate, which brings it there.
        noise = _median(np.abs(points[near] @ plane[:3] + plane[3]), areas[near]) / MIDDLE_IN_BAND
        band = min(START_BAND, max(LEAST_BAND, WIDTH * noise))
    return plane, noise


def _median(values: Float[np.ndarray, " points"], weights: Float[np.ndarray, " points"]) -> float:
    order = np.argsort(values, kind="stable")
    cumulative = np.cumsum(weights[order])
    return float(values[order[np.searchsorted(cumulative, cumulative[-1] / 2)]])


def _side(points: Float[np.ndarray, "points 3"], support: Support) -> float:
    """Sign of the side with more points over the plane; beside it there may be a floor."""
    heights, cells = support.heights(points), support.cells(points, PATCH)
    band = max(LEAST_BAND, HEIGHT * support.noise)
    index = distinct_rows(cells)[1]
    covered = np.bincount(index, np.abs(heights) <= band) > 0
    over = covered[index]
    above, below = (np.count_nonzero(over & (sign * heights > band)) for sign in (1, -1))
    if above == below:
        above, below = np.count_nonzero(heights > band), np.count_nonzero(heights < -band)
    return 1.0 if above >= below else -1.0
