"""Semantic places of bowls' and bottles' meshes, measured on sections through their axis.

Frames are as in `tdf_jax.shapes.Bowl` and `tdf_jax.shapes.Bottle`: the origin of the canonical frame is on the axis at
half the height, z points up and the front along +x. T_object_place are frames of a bowl's rim, base and body and of a
bottle's neck, base and body. The mesh may be open, because no measurement needs its inside.
"""

import dataclasses
from collections.abc import Collection
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float

from tdf_jax._internal.errors import InputError
from tdf_jax.evaluation.places import BELOW_RIM, crossings
from tdf_jax.geometry.symmetry import FOLDS, ROUND
from tdf_jax.shapes.shape import frame

if TYPE_CHECKING:
    import trimesh

DIRECTIONS = 48  # half planes about the axis, a multiple of 8
LEVELS = 400  # horizontal levels; they are 0.5 mm apart on a common bottle
AXIS_LEVELS = 50
# Shares of the height between which the middle of an object without symmetry is its axis: the cap of a bottle is above
# all handles, and the lower half of a bowl below all spouts.
AXIS_FROM = {"bowl": (0.1, 0.5), "bottle": (0.9, 1.0)}
TURNS = {ROUND: (1 / 8, 1 / 4), 2: (1 / 2,), 4: (1 / 4,)}  # shares of a full turn that keep an outline of a symmetry
CHANGE = 0.15  # share of the radius: largest change of the outline by such a turn
LEAST_FRONT = 0.9  # smallest reach to the front over the reach to the other sides
# Strength of the harmonic of an outline below which it has no direction; an ellipse 4 % longer than wide has it.
SHAPELESS = 0.02
NARROWER = 0.9  # radius of the widest neck over that of the body
CURVES = np.linspace(1.0, 3.0, 17)  # values of `BottleParameters.shoulder_curve` that are fitted
# Lowest start of a shoulder over the height of its middle. With a lower start, barrels would count as shoulders.
LOWEST_SHOULDER = 0.5


@dataclasses.dataclass(frozen=True, eq=False)
class Profile:
    """The surface of an object as distances from its axis.

    Attributes:
        origin: point on the axis at half the height, (3,), metres, frame of the mesh.
        height: height, metres.
        sections: for each direction, evenly spaced about the axis from +x on, the surface in the plane through the
            axis: segments, (segments, 2, 2), of (distance from the axis in that direction, height above the origin),
            metres.
        radii: distance of the outermost surface, (levels, directions), metres; levels rise. Holes are interpolated, and
            a direction without any surface is NaN.
        turned: angle from +x to the longer side, or to the nearest flat side of a square, radians; 0 if the symmetry or
            the shape has no such side.
    """

    origin: Float[np.ndarray, "3"]
    height: float
    sections: tuple[Float[np.ndarray, "_ 2 2"], ...]
    radii: Float[np.ndarray, "levels directions"]
    turned: float


def profile(mesh: "trimesh.Trimesh", category: str, fold: int, name: str) -> Profile:
    """Measure the axis and the profile of a bowl or bottle whose front points along +x, z up.

    Args:
        mesh: the mesh, metres.
        category: "bowl" or "bottle".
        fold: symmetry of the object, see `tdf_jax.geometry.symmetry`.
        name: name of the mesh, for messages.

    Raises:
        InputError: the mesh does not have this symmetry about z, or reaches farther to another side than to its front.
    """
    axis = np.append(_axis(mesh, AXIS_FROM[category] if fold == 1 else (0.0, 1.0), name), mesh.bounds[0, 2])
    sections = _sections(mesh, axis)
    # The height is the median of the highest points of all directions, because the rim of a scan leans, and because
    # stray vertices must not raise it.
    tops = [section[(section[..., 0] > 0).any(axis=1), :, 1].max(initial=-np.inf) for section in sections]
    height = float(np.median([top for top in tops if top > -np.inf]))
    sections = tuple(section - [0.0, height / 2] for section in sections)
    radii = np.stack([_outermost(section, _levels(height)) for section in sections], axis=1)
    missing = int(np.isnan(radii[0]).sum())
    if missing > DIRECTIONS / 4:
        raise InputError(
            f"profile(): {name} has no surface in {missing} of {DIRECTIONS} directions from its middle; expected one "
            "about its axis; repair the mesh, or correct its 'up'"
        )
    origin = axis + [0.0, 0.0, height / 2]
    around = _outline(radii)
    _check_symmetry(around, mesh.bounds - origin, fold, name)
    return Profile(origin, height, sections, radii, _turned(around, fold))


def profile_places(
    found: Profile, category: str, fold: int, name: str, places: Collection[str]
) -> dict[str, Float[np.ndarray, "4 4"]]:
    """Frames of the places of a bowl or bottle.

    Args:
        found: profile of the mesh.
        category: "bowl" or "bottle".
        fold: symmetry of the object, see `tdf_jax.geometry.symmetry`.
        name: name of the mesh, for messages.
        places: places to measure, of those of its category.

    Returns:
        T_object_place, 4x4, metres, by the names of `tdf_jax.shapes.FAMILIES`.

    Raises:
        InputError: a place needs an open bowl with a wall, or a bottle with a neck on a body, and the mesh is none.
    """
    half = found.height / 2
    frames = {"base": frame(0.0, -half)}
    if category == "bowl":
        frames["body"] = frame(0.0, 0.0)
        if "rim" in places:
            frames["rim"] = frame(_rim(found, fold, name), half)
    elif set(places) - set(frames):
        neck, body = _bottle_levels(found, fold, name)
        frames |= {"neck": frame(0.0, neck), "body": frame(0.0, body)}
    return {place: frames[place] for place in places}


def _levels(height: float) -> np.ndarray:
    return ((np.arange(LEVELS) + 0.5) / LEVELS - 0.5) * height


def _axis(mesh, shares: tuple[float, float], name: str) -> np.ndarray:
    """The axis, (x, y): the median of the middles of horizontal sections between two shares of the height."""
    from trimesh.intersections import mesh_plane

    low, high = mesh.bounds[:, 2]
    levels = low + (high - low) * (shares[0] + (shares[1] - shares[0]) * (np.arange(AXIS_LEVELS) + 0.5) / AXIS_LEVELS)
    cuts = (
        np.asarray(mesh_plane(mesh, plane_normal=[0, 0, 1], plane_origin=[0, 0, level]))[..., :2].reshape(-1, 2)
        for level in levels
    )
    # The middle of an outline is its axis for every symmetry. The mean of its points depends on how densely each side
    # was scanned, and the middle of the whole bounding box depends on stray vertices and on a leaning rim.
    middles = [(cut.min(axis=0) + cut.max(axis=0)) / 2 for cut in cuts if len(cut)]
    if not middles:
        raise InputError(
            f"profile(): {name} has no surface from {100 * shares[0]:.0f} to {100 * shares[1]:.0f} % of its height, "
            "where its axis is measured; expected one; repair the mesh, or correct its 'up'"
        )
    return np.median(middles, axis=0)


def _sections(mesh, axis: np.ndarray) -> list[np.ndarray]:
    """The surface in the half plane of each direction; coordinates are relative to a point on the axis."""
    from trimesh.intersections import mesh_plane

    there = []
    for angle in np.arange(DIRECTIONS // 2) * (2 * np.pi / DIRECTIONS):
        along, across = np.array([np.cos(angle), np.sin(angle), 0.0]), np.array([-np.sin(angle), np.cos(angle), 0.0])
        # The plane is moved by less than the accuracy of any mesh, because vertices, and often whole edges, lie in
        # planes through the axis.
        cut = mesh_plane(mesh, plane_normal=across, plane_origin=axis + 1e-6 * across) - axis
        there.append(np.stack([cut @ along, cut[..., 2]], axis=-1))
    return there + [section * [-1.0, 1.0] for section in there]


def _outermost(section: np.ndarray, levels: np.ndarray) -> np.ndarray:
    """The largest first coordinate at each level of the second coordinate.

    A level without a positive one is interpolated from its neighbours. All are NaN if no level has one.
    """
    first, last = (np.searchsorted(levels, end) for end in (section[..., 1].min(axis=1), section[..., 1].max(axis=1)))
    segment = np.repeat(np.arange(len(section)), last - first)
    level = np.arange(len(segment)) - np.repeat(np.cumsum(last - first) - last, last - first)
    a, b = section[segment, 0], section[segment, 1]
    reach = np.zeros(len(levels))
    np.maximum.at(reach, level, a[:, 0] + (levels[level] - a[:, 1]) / (b[:, 1] - a[:, 1]) * (b[:, 0] - a[:, 0]))
    seen = reach > 0
    return np.interp(levels, levels[seen], reach[seen]) if seen.any() else np.full(len(levels), np.nan)


def _outline(radii: np.ndarray) -> np.ndarray:
    """Radii of the body by direction, relative to the median radius."""
    body = radii[LEVELS // 8 : LEVELS // 2]
    return np.median(body / np.nanmedian(body, axis=1, keepdims=True), axis=0)


def _check_symmetry(around: np.ndarray, bounds: np.ndarray, fold: int, name: str) -> None:
    if fold == 1:
        front, side = bounds[1, 0], max(-bounds[0, 0], bounds[1, 1], -bounds[0, 1])
        if front < LEAST_FRONT * side:
            raise InputError(
                f"profile(): {name} reaches {100 * front:.1f} cm from its axis to its front and {100 * side:.1f} cm to "
                "another side; expected its handle or longer side at the front; correct 'front' and 'up'"
            )
        return
    # The quantile leaves out lugs.
    changes = [np.nanquantile(np.abs(around - np.roll(around, round(turn * DIRECTIONS))), 0.9) for turn in TURNS[fold]]
    if max(changes) > CHANGE:
        raise InputError(
            f"profile(): {name} is not {FOLDS[fold]}: a turn of {360 * TURNS[fold][np.argmax(changes)]:g} degrees "
            f"about 'up' changes its outline by {100 * max(changes):.0f} % of its radius; expected "
            f"{100 * CHANGE:.0f} % at most; correct 'symmetry' or 'up'"
        )


def _turned(around: np.ndarray, fold: int) -> float:
    if fold in (ROUND, 1):
        return 0.0
    angles = np.arange(DIRECTIONS) * (2 * np.pi / DIRECTIONS)
    harmonic = np.nansum(around**2 * np.exp(1j * fold * angles)) / np.nansum(around**2)
    # The second harmonic is largest along the longer side. The fourth is largest along the corners of a square, which
    # lie between its sides.
    return float(np.angle(harmonic if fold == 2 else -harmonic)) / fold if abs(harmonic) > SHAPELESS else 0.0


def _rim(found: Profile, fold: int, name: str) -> float:
    """Distance of the middle of the wall at the rim from the axis.

    It is the median over the front and the sides that the symmetry makes equal.
    """
    if crossings(found.sections[0][..., ::-1], 0.0).max(initial=-np.inf) > found.height / 4:
        raise _unmeasured(name, "it is closed above; is 'up' right?", "a bowl, open above")
    middles = []
    for section in found.sections[:: 1 if fold == ROUND else DIRECTIONS // fold]:
        side = section[(section[..., 0] > 0).all(axis=1)]
        # The level is relative to the top on this side, because a rim may lean.
        wall = crossings(side, side[..., 1].max(initial=-np.inf) - BELOW_RIM * found.height)
        if len(wall) > 1:
            middles.append(wall[-2:].mean())
    if not middles:
        raise _unmeasured(name, "its rim on the front is no wall with two sides.", "a bowl with a wall")
    return float(np.median(middles))


def _bottle_levels(found: Profile, fold: int, name: str) -> tuple[float, float]:
    """Heights of the places of the neck and of the body."""
    radius, height, wanted = _mean_radius(found, fold), found.height, "a bottle with a neck above its body"
    width = float(np.nanmax(_widths(found)))
    if width > height:  # a handle of a lying bottle would count as its neck
        raise _unmeasured(
            name, f"it is {100 * width:.1f} cm wide and {100 * height:.1f} cm high; is 'up' right?", wanted
        )
    levels = _levels(height) + height / 2
    body = float(np.quantile(radius[: LEVELS // 2], 0.9))  # the largest may be a seam, and the median a waist
    neck = float(np.quantile(radius[LEVELS // 2 :], 0.2))
    # The neck begins at the middle of the shoulder, where the radius is half way between those of body and neck. Two
    # iterations usually suffice.
    for _ in range(4):
        below = (radius < (body + neck) / 2) & (np.arange(LEVELS) > np.argmax(radius[: LEVELS // 2]))
        if neck > NARROWER * body or not below.any():
            raise _unmeasured(name, "nothing above its body is narrow enough for a neck; is 'up' right?", wanted)
        above = int(np.argmax(below))
        neck = float(np.quantile(radius[above:], 0.3))  # most caps are wider than their neck
    half_way = float(np.interp((body + neck) / 2, radius[[above, above - 1]], levels[[above, above - 1]]))
    upright = slice(above // 4, above)  # leaves out the rounded bottom edge
    body_to = _shoulder_from(levels[upright], radius[upright], half_way, neck, height)
    return half_way / 2, (body_to - height) / 2


def _widths(found: Profile) -> np.ndarray:
    """Widths by level and direction; unlike radii, they do not depend on how a scan leans."""
    return found.radii[:, : DIRECTIONS // 2] + found.radii[:, DIRECTIONS // 2 :]


def _mean_radius(found: Profile, fold: int) -> np.ndarray:
    """Half of the median width by level; directions towards a handle are left out."""
    beside = slice(DIRECTIONS // 16, 7 * DIRECTIONS // 16 + 1) if fold == 1 else slice(None)
    return np.nanmedian(_widths(found)[:, beside], axis=1) / 2


def _shoulder_from(levels: np.ndarray, radius: np.ndarray, half_way: float, neck: float, height: float) -> float:
    """Level above the base where the body ends and the shoulder begins.

    The shoulder is the best fit, up to its middle at `half_way`, of all shoulders of `BottleParameters` on bodies with
    any bulge. The highest level with 95 % of the body's radius is no substitute, because it is in the middle of a dome
    (docs/results/code_notes.md).
    """
    best, level = np.inf, half_way
    start = np.arange(LOWEST_SHOULDER * half_way, half_way, 0.0025 * height)[:, None]
    bulge = 4 * np.minimum(levels / start, 1) * (1 - np.minimum(levels / start, 1))
    # Shapes of shoulders, and their share below half_way; None is a straight slope.
    shoulders = [(curve, (1 - 0.5**curve) ** (1 / curve)) for curve in CURVES] + [(None, 0.5)]
    for curve, middle in shoulders:
        share = middle * np.maximum(levels - start, 0) / (half_way - start)
        wide = (1 + np.cos(np.pi * share)) / 2 if curve is None else np.maximum(1 - share**curve, 0) ** (1 / curve)
        rest = radius - neck * (1 - wide)
        # Least squares for the radius of the body, which multiplies `wide`, and for its bulge.
        ww, wb, bb, wr, br = (
            np.sum(one * other, axis=1, keepdims=True)
            for one, other in ((wide, wide), (wide, bulge), (bulge, bulge), (wide, rest), (bulge, rest))
        )
        body, out = np.array([bb * wr - wb * br, ww * br - wb * wr]) / (ww * bb - wb**2)
        off = np.abs(rest - body * wide - out * bulge).sum(
            axis=1
        )  # seams and labels are outliers, so it is not squared
        off[(start + (half_way - start) / middle > height)[:, 0]] = np.inf  # the neck would begin above the top
        if off.min() < best:
            best, level = off.min(), start[off.argmin(), 0]
    return float(level)


def _unmeasured(name: str, what: str, expected: str) -> InputError:
    return InputError(
        f"profile_places(): {name} cannot be measured: {what} Expected {expected}: correct its 'up', or give 'places' "
        "for it"
    )
