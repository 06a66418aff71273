"""Parts of solids: polygons stacked along an axis or swept along a line, their meshes and exact inside tests."""

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

if TYPE_CHECKING:
    import trimesh

_AROUND = 64  # polygon corners around the body; a multiple of 8, so a square mug keeps its corners
_TUBE_AROUND = 16  # polygon corners around the handle's tube
_QUARTER = np.linspace(0, np.pi / 2, 9)  # angles of the corners of a rounded corner


class Frusta(NamedTuple):
    """Stacked frusta: the unit polygon (see `polygon`) scaled by `radii` at `heights`, with flat sides in between.

    Attributes:
        heights: rising heights of the polygons, (rings,).
        radii: their radii, (rings,).
        squareness: superellipse exponent of the polygon.
    """

    heights: np.ndarray
    radii: np.ndarray
    squareness: float


class Loft(NamedTuple):
    """Stacked polygons about the z axis, with straight edges in between.

    Attributes:
        heights: rising heights of the polygons, (rings,).
        radii: distances of their corners from the axis, at even angles, (rings, corners).
    """

    heights: np.ndarray
    radii: np.ndarray


class Tube(NamedTuple):
    """A section swept along a line in the x-z plane.

    Attributes:
        line: centre line, (rings, 2).
        mitres: directions along which the section is cut at every ring, (rings, 2).
        scales: factors on the section, (rings,).
        section: half of thickness and width, (2,), a factor on the unit polygon.
        squareness: superellipse exponent of the polygon.
    """

    line: np.ndarray
    mitres: np.ndarray
    scales: np.ndarray
    section: np.ndarray
    squareness: float


class Bar(NamedTuple):
    """Stacked frusta of one convex outline along an axis in any direction, with flat sides in between.

    Attributes:
        heights: rising distances of the polygons along the axis, (rings,).
        scales: factors on the outline there, (rings,).
        outline: corners of the outline, counter-clockwise about the axis, which is inside, (corners, 2).
        T_object_bar: frame of the bar, whose z axis is the axis, (4, 4).
    """

    heights: np.ndarray
    scales: np.ndarray
    outline: np.ndarray
    T_object_bar: np.ndarray


Part = Frusta | Loft | Tube | Bar


def encloses(part: Part, points: np.ndarray) -> np.ndarray:
    """Which points (points, 3) are inside a part."""
    match part:
        case Frusta():
            return in_frusta(part, points)
        case Loft():
            return in_loft(part, points)
        case Tube():
            return in_tube(part, points)
        case Bar():
            return in_bar(part, points)


def rings(part: Part) -> np.ndarray:
    """The corners (rings, corners, 3) of a part."""
    match part:
        case Frusta():
            return frusta_rings(part)
        case Loft():
            return loft_rings(part)
        case Tube():
            return tube_rings(part)
        case Bar():
            return bar_rings(part)


def section(aspect: float, exponent: float) -> np.ndarray:
    """Radii (corners,) at even angles of a superellipse that reaches 1 along x and `aspect` along y."""
    angle = np.arange(_AROUND) * (2 * np.pi / _AROUND)
    return (np.abs(np.cos(angle)) ** exponent + np.abs(np.sin(angle) / aspect) ** exponent) ** (-1 / exponent)


def polygon(exponent: float, count: int) -> np.ndarray:
    """Corners (count, 2) on the unit superellipse at even angles, counter-clockwise from +x."""
    angle = np.arange(count) * (2 * np.pi / count)
    corners = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    return corners / np.sum(np.abs(corners) ** exponent, axis=1, keepdims=True) ** (1 / exponent)


def circle(radius: float, count: int = _AROUND) -> np.ndarray:
    """Corners (count, 2) of a regular polygon on a circle, counter-clockwise from +x."""
    return radius * polygon(2.0, count)


def rectangle(half_x: float, half_y: float, radius: float = 0.0) -> np.ndarray:
    """Corners (corners, 2) of a rectangle whose corners are rounded by quarter circles, counter-clockwise."""
    arc = radius * np.stack([np.cos(_QUARTER), np.sin(_QUARTER)], axis=1) if radius else np.zeros((1, 2))
    centre = np.array([half_x - radius, half_y - radius])
    corners = []
    for signs in ((1, 1), (-1, 1), (-1, -1), (1, -1)):
        corner = (centre + arc) * signs
        corners.append(corner if signs[0] == signs[1] else corner[::-1])  # a mirror image runs the other way
    return np.concatenate(corners)


def outline_gauge(outline: np.ndarray, flat: np.ndarray) -> np.ndarray:
    """Factor on a convex outline (corners, 2) about the origin at which it reaches each point of `flat` (points, 2)."""
    ends = np.stack([outline, np.roll(outline, -1, axis=0)], axis=1)
    edges = np.linalg.solve(ends, np.ones((len(outline), 2, 1)))[..., 0]
    return np.max(flat @ edges.T, axis=1)


def _gauge(flat: np.ndarray, exponent: float, count: int) -> np.ndarray:
    """Factor on the polygon at which it reaches each point of `flat` (points, 2): 1 on its edges, as in the mesh."""
    corners = polygon(exponent, count)
    edges = np.linalg.solve(np.stack([corners, np.roll(corners, -1, axis=0)], axis=1), np.ones((count, 2, 1)))[..., 0]
    sector = np.floor(np.arctan2(flat[:, 1], flat[:, 0]) * (count / (2 * np.pi))).astype(int) % count
    return np.sum(edges[sector] * flat, axis=1)


def in_frusta(frusta: Frusta, points: np.ndarray) -> np.ndarray:
    """Which points (points, 3) are inside stacked frusta."""
    radius = np.interp(points[:, 2], frusta.heights, frusta.radii, left=-1.0, right=-1.0)
    return _gauge(points[:, :2], frusta.squareness, _AROUND) <= radius


def frusta_rings(frusta: Frusta) -> np.ndarray:
    """The corners (rings, corners, 3) of stacked frusta, upwards."""
    rings = frusta.radii[:, None, None] * polygon(frusta.squareness, _AROUND)
    heights = np.broadcast_to(frusta.heights[:, None, None], (*rings.shape[:2], 1))
    return np.concatenate([rings, heights], axis=-1)


def in_loft(loft: Loft, points: np.ndarray) -> np.ndarray:
    """Which points (points, 3) are inside a loft, within its polygon at their height.

    A mesh splits the surface between two rings into triangles. If the rings have different shapes, the triangles differ
    slightly from the straight surface.
    """
    heights, radii = loft
    height = points[:, 2]
    below = np.clip(np.searchsorted(heights, height, side="right") - 1, 0, len(heights) - 2)
    share = (height - heights[below]) / (heights[below + 1] - heights[below])
    corner = np.arctan2(points[:, 1], points[:, 0]) * (radii.shape[1] / (2 * np.pi))
    first = np.floor(corner).astype(int) % radii.shape[1]
    ends = []
    for one in (first, (first + 1) % radii.shape[1]):
        angle = one * (2 * np.pi / radii.shape[1])
        radius = (1 - share) * radii[below, one] + share * radii[below + 1, one]
        ends.append(radius[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1))
    along, to_point = ends[1] - ends[0], points[:, :2] - ends[0]
    left = along[:, 0] * to_point[:, 1] - along[:, 1] * to_point[:, 0] >= 0
    return left & (height >= heights[0]) & (height <= heights[-1])


def loft_rings(loft: Loft) -> np.ndarray:
    """The corners (rings, corners, 3) of a loft, upwards."""
    angle = np.arange(loft.radii.shape[1]) * (2 * np.pi / loft.radii.shape[1])
    heights = np.broadcast_to(loft.heights[:, None], loft.radii.shape)
    return np.stack([loft.radii * np.cos(angle), loft.radii * np.sin(angle), heights], axis=-1)


def in_tube(tube: Tube, points: np.ndarray) -> np.ndarray:
    """Which points (points, 3) are inside a tube: between the mitre planes of a step and within its section there."""
    rings = tube_rings(tube).reshape(-1, 3)
    near = np.flatnonzero(np.all((points >= rings.min(axis=0)) & (points <= rings.max(axis=0)), axis=1))
    flat, y = points[near][:, [0, 2]], points[near, 1]
    forward = -_normal(tube.mitres)
    past = flat @ forward.T - np.sum(tube.line * forward, axis=1)  # (near, rings), distance past each mitre plane
    point, step = np.nonzero((past[:, :-1] >= 0) & (past[:, 1:] <= 0))
    start, end = past[point, step], -past[point, step + 1]
    share = start / np.maximum(start + end, np.finfo(float).tiny)
    scale = tube.scales[step] + share * (tube.scales[step + 1] - tube.scales[step])
    across = np.sum((flat[point] - tube.line[step]) * _normal(_directions(tube.line))[step], axis=1)
    size = _gauge(np.stack([across, y[point]], axis=1) / tube.section, tube.squareness, _TUBE_AROUND)
    inside = np.zeros(len(points), bool)
    inside[near[point[size <= scale]]] = True
    return inside


def tube_rings(tube: Tube) -> np.ndarray:
    """The corners (rings, corners, 3) of a swept tube, along its line."""
    section = polygon(tube.squareness, _TUBE_AROUND) * tube.section
    flat = tube.line[:, None] + tube.scales[:, None, None] * section[:, :1] * tube.mitres[:, None]
    return np.stack([flat[..., 0], tube.scales[:, None] * section[:, 1], flat[..., 1]], axis=-1)


def in_bar(bar: Bar, points: np.ndarray) -> np.ndarray:
    """Which points (points, 3) are inside a bar."""
    local = (points - bar.T_object_bar[:3, 3]) @ bar.T_object_bar[:3, :3]
    scale = np.interp(local[:, 2], bar.heights, bar.scales, left=-1.0, right=-1.0)
    inside = np.zeros(len(points), bool)
    widest = np.max(np.sum(bar.outline**2, axis=1))
    near = np.flatnonzero((scale > 0) & (np.sum(local[:, :2] ** 2, axis=1) <= widest * scale**2 * (1 + 1e-9)))
    inside[near] = outline_gauge(bar.outline, local[near, :2]) <= scale[near]
    return inside


def bar_rings(bar: Bar) -> np.ndarray:
    """The corners (rings, corners, 3) of a bar, along its axis."""
    flat = bar.scales[:, None, None] * bar.outline
    heights = np.broadcast_to(bar.heights[:, None, None], (*flat.shape[:2], 1))
    return np.concatenate([flat, heights], axis=-1) @ bar.T_object_bar[:3, :3].T + bar.T_object_bar[:3, 3]


def mitres(line: np.ndarray) -> np.ndarray:
    """Bisecting normals of the bends, with a length that preserves the thickness of the steps on both sides."""
    normals = _normal(_directions(line))
    before, after = np.concatenate([normals[:1], normals]), np.concatenate([normals, normals[-1:]])
    return (before + after) / (1 + np.sum(before * after, axis=1, keepdims=True))


def _directions(line: np.ndarray) -> np.ndarray:
    steps = np.diff(line, axis=0)
    return steps / np.linalg.norm(steps, axis=1, keepdims=True)


def _normal(vectors: np.ndarray) -> np.ndarray:
    """Vectors (..., 2) of the x-z plane rotated by 90 degrees, so that (rotated, y, vector) is right-handed."""
    return np.stack([vectors[..., 1], -vectors[..., 0]], axis=-1)


def inset(distance, radius: float):
    """Inset of a surface whose edge is rounded by a quarter circle of this radius, at a distance from the edge."""
    return radius - np.sqrt(np.maximum(radius**2 - np.maximum(radius - distance, 0) ** 2, 0))


def bar_line(x_top: float, x_bottom: float, x_bar: float, top: float, bottom: float, radius: float) -> np.ndarray:
    """Centre line (points, 2) of a handle in the x-z plane: two level arms, an upright bar, and round corners."""
    turn, middle = np.linspace(0, np.pi / 2, 40), (top + bottom) / 2
    x, z = x_bar - radius * (1 - np.sin(turn)), top - radius * (1 - np.cos(turn))
    return np.concatenate(
        [[[x_top, top]], np.stack([x, z], 1), np.stack([x, 2 * middle - z], 1)[::-1], [[x_bottom, bottom]]]
    )


def swept(line: np.ndarray, thickness: float, width: float, squareness: float, flare: float, count: int) -> Tube:
    """Tube of a handle along its centre line, `flare` times as thick at both ends, with level ends towards the axis."""
    line = resample(line, count)
    scales = 1 + (flare - 1) * np.linspace(-1, 1, len(line)) ** 4
    ends = np.stack([[0.4 * end[0], end[1]] for end in (line[0], line[-1])])  # well inside the body
    line = np.concatenate([ends[:1], line, ends[1:]])
    scales = np.concatenate([scales[:1], scales, scales[-1:]])
    return Tube(line, mitres(line), scales, np.array([thickness, width]) / 2, squareness)


def bends_freely(tube: Tube) -> bool:
    """Whether no ring of a tube intersects the next one."""
    steps = np.diff(tube_rings(tube)[..., [0, 2]], axis=0)
    return bool((np.einsum("smi,si->sm", steps, np.diff(tube.line, axis=0)) > 0).all())


def resample(line: np.ndarray, count: int) -> np.ndarray:
    """Place `count` points along a polyline, half by length and half by bending, so that bends have short steps."""
    knots = np.arange(len(line))
    between = np.linspace(0, len(line) - 1, 8 * (len(line) - 1) + 1)
    fine = np.stack([np.interp(between, knots, line[:, axis]) for axis in range(2)], axis=1)
    steps = np.diff(fine, axis=0)
    lengths = np.linalg.norm(steps, axis=1)
    headings = np.unwrap(np.arctan2(steps[:, 1], steps[:, 0]))
    turns = np.abs(np.gradient(headings))
    cost = np.concatenate([[0.0], np.cumsum(lengths / lengths.sum() + turns / turns.sum())])
    at = np.linspace(0, cost[-1], count)
    return np.stack([np.interp(at, cost, fine[:, axis]) for axis in range(2)], axis=1)


def closed_mesh(rings: np.ndarray) -> "trimesh.Trimesh":
    """Mesh of rings (rings, corners, 3), counter-clockwise about their direction, with fans at both ends."""
    import trimesh

    count, corners = rings.shape[:2]
    here = np.arange(count * corners).reshape(count, corners)
    there = np.roll(here, -1, axis=1)
    first, last = np.full(corners, count * corners), np.full(corners, count * corners + 1)
    triangles = [
        (here[:-1], there[:-1], there[1:]),
        (here[:-1], there[1:], here[1:]),
        (there[0], here[0], first),
        (here[-1], there[-1], last),
    ]
    faces = np.concatenate([np.stack(corner, axis=-1).reshape(-1, 3) for corner in triangles])
    return trimesh.Trimesh(np.concatenate([rings.reshape(-1, 3), rings[[0, -1]].mean(axis=1)]), faces, process=False)
