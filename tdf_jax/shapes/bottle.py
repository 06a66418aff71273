"""Parametric bottles: watertight meshes with ground truth frames and an exact inside test.

Canonical frame: z up along the bottle's axis, a flat bottle's wide side and a handle along x, the origin on the axis at
half the height. Bottles are solid except for the mouth of an open neck, because sensors see only their outside.
"""

from dataclasses import dataclass

import numpy as np

from tdf_jax._internal.errors import InputError
from tdf_jax.geometry.symmetry import ROUND
from tdf_jax.shapes.shape import Shape, Solid, check_dimensions, draw_valid, draws, frame, is_one_body, solid_mesh
from tdf_jax.shapes.solid import Loft, Tube, bar_line, bends_freely, encloses, inset, section, swept, tube_rings

SHOULDERS = ("arc", "slope")

_TUBE_RINGS = 30  # rings along the handle
_STEP = 2e-4  # share of the height over which a cap widens from the neck
_MIN_CAP = 0.005  # smallest cap, share of the height


@dataclass(frozen=True)
class BottleParameters:
    """The dimensions of one bottle, in metres unless stated otherwise; the defaults make a common 0.22 m bottle.

    Attributes:
        height: height of the top of the cap or of the mouth.
        radius: radius of the body, along x.
        aspect: the body's extent along y divided by that along x, 0.35 (flat) to 1; no unit.
        squareness: superellipse exponent of the body's cross-section, 2 (round, oval) to 20 (square); no unit.
        bulge: addition to the body's radius at half its height, which falls off as a parabola; positive for a barrel,
            negative for a waist.
        edge_radius: rounding of the bottom edge.
        shoulder_bottom: height at which the body ends and narrows to the neck.
        shoulder_top: height at which the neck begins.
        shoulder_style: "arc" (a dome of `shoulder_curve`) or "slope" (S-shaped, as of a wine bottle).
        shoulder_curve: superellipse exponent of an arc, 1 (straight cone) to 4 (flat top); no unit.
        neck_radius: radius at the beginning of the neck.
        neck_taper: radius of the neck's top divided by that of its beginning, 0.5 to 1.1; no unit.
        cap_height: height of the cap; 0 for an open mouth.
        cap_radius: radius at the beginning of the cap.
        cap_taper: radius of the cap's top divided by that of its beginning, 0.3 to 1.1; no unit.
        mouth_depth: depth of an open mouth; 0 for a closed top.
        handle: whether there is a handle, on the +x side.
        handle_top: height of the upper attachment, on the body or the neck.
        handle_bottom: height of the lower attachment.
        handle_reach: distance from the wider attachment on the wall to the centre line of the handle's bar.
        handle_width: width of the handle's section, across the plane of symmetry.
        handle_thickness: thickness of the handle's section, in the plane of symmetry.
    """

    height: float = 0.220
    radius: float = 0.036
    aspect: float = 1.0
    squareness: float = 2.0
    bulge: float = 0.0
    edge_radius: float = 0.004
    shoulder_bottom: float = 0.130
    shoulder_top: float = 0.170
    shoulder_style: str = "arc"
    shoulder_curve: float = 2.0
    neck_radius: float = 0.014
    neck_taper: float = 1.0
    cap_height: float = 0.018
    cap_radius: float = 0.016
    cap_taper: float = 1.0
    mouth_depth: float = 0.020
    handle: bool = False
    handle_top: float = 0.125
    handle_bottom: float = 0.050
    handle_reach: float = 0.032
    handle_width: float = 0.016
    handle_thickness: float = 0.011

    @property
    def fold(self) -> int:
        """Symmetry about z: 1 of bottles with a handle, otherwise 0 of round, 2 of flat and 4 of square ones."""
        if self.handle:
            return 1
        if self.aspect < 1:
            return 2
        return ROUND if self.squareness == 2 else 4


@dataclass(frozen=True, eq=False)
class Bottle(Shape):
    """A bottle with its ground truth; see `Shape`.

    Its places are on the axis: the neck (midway between the top and the height at which the shoulder's radius is the
    mean of those of body and neck), the base (in the plane of the base) and the body (at half the shoulder's height).
    """

    category = "bottle"
    unitless = ("aspect", "squareness", "shoulder_style", "shoulder_curve", "neck_taper", "cap_taper", "handle")

    @staticmethod
    def solid_of(parameters: BottleParameters) -> Solid:
        """The bottle, its handle and its mouth."""
        return _solid(parameters)


def build_bottle(parameters: BottleParameters = BottleParameters()) -> Bottle:
    """Build the mesh and the ground truth of one bottle.

    Args:
        parameters: its dimensions, metres.

    Returns:
        The bottle in its canonical frame.

    Raises:
        InputError: the dimensions do not make a bottle; the message names the one to change.
    """
    _check(parameters)
    mesh = solid_mesh(_solid(parameters))
    if not is_one_body(mesh, handles=int(parameters.handle)):
        raise InputError(
            f"build_bottle(): the dimensions give no single closed bottle; got {parameters}; "
            "expected the neck and handle of a common bottle: move them towards the defaults"
        )
    half, p = parameters.height / 2, parameters
    neck = (_neck_from(p) + p.height) / 2
    places = {
        "neck": frame(0.0, neck - half),
        "base": frame(0.0, -half),
        "body": frame(0.0, p.shoulder_bottom / 2 - half),
    }
    return Bottle(mesh, parameters, places)


def sample_bottle(rng: np.random.Generator) -> BottleParameters:
    """Draw the dimensions of a bottle 0.12 to 0.30 m tall.

    Bottles are round, flat or square, with every shoulder, capped or open, and some have a handle.

    Args:
        rng: random generator; the same state gives the same bottle.

    Returns:
        Dimensions that `build_bottle` accepts.
    """
    return draw_valid(_draw, _check, rng)  # the handle of most draws with one does not fit


def _draw(rng: np.random.Generator) -> BottleParameters:
    uniform, chance = draws(rng)
    height = uniform(0.12, 0.30)
    handle = chance(0.25)
    radius = height * (uniform(0.16, 0.28) if handle else uniform(0.12, 0.27))
    aspect = uniform(0.45, 0.85) if chance(0.3) else 1.0
    shoulder_bottom = height * uniform(0.42, 0.75)
    shoulder_top = shoulder_bottom + (0.94 * height - shoulder_bottom) * uniform(0.15, 0.75)
    neck = radius * min(uniform(0.25, 0.60), 0.8 * aspect)
    thickness = uniform(0.007, 0.013)
    return BottleParameters(
        height=height,
        radius=radius,
        aspect=aspect,
        squareness=uniform(2.8, 7.0) if chance(0.25) else 2.0,
        bulge=radius * uniform(-0.10, 0.08) if chance(0.3) else 0.0,
        edge_radius=radius * aspect * uniform(0.05, 0.4),
        shoulder_bottom=shoulder_bottom,
        shoulder_top=shoulder_top,
        shoulder_style=SHOULDERS[rng.integers(len(SHOULDERS))],
        shoulder_curve=uniform(1.0, 3.0),
        neck_radius=neck,
        neck_taper=uniform(0.75, 1.05),
        cap_height=(height - shoulder_top) * uniform(0.3, 0.95) if chance(0.7) else 0.0,
        cap_radius=neck * uniform(1.02, 1.35),
        cap_taper=uniform(0.35, 0.8) if chance(0.25) else uniform(0.9, 1.0),
        mouth_depth=height * uniform(0.03, 0.12),
        handle=handle,
        handle_top=height * uniform(0.50, 0.85),
        handle_bottom=height * uniform(0.15, 0.40),
        handle_reach=uniform(0.022, 0.042),
        handle_width=thickness * uniform(1.0, 2.0),
        handle_thickness=thickness,
    )


def _check(p: BottleParameters) -> None:
    """Raise InputError unless the dimensions make one bottle, with one finger hole if it has a handle."""

    def need(truth, what):
        if not truth:
            raise InputError(f"build_bottle(): {what}; got {p}")

    check_dimensions(
        "build_bottle()",
        p,
        may_be_zero=("edge_radius", "cap_height", "mouth_depth"),
        may_be_negative=("bulge",),
        choices={"shoulder_style": SHOULDERS},
    )
    need(0.35 <= p.aspect <= 1, f"aspect is {p.aspect}; expected 0.35 to 1")
    need(2 <= p.squareness <= 20, f"squareness is {p.squareness}; expected 2 (round) to 20 (square)")
    need(1 <= p.shoulder_curve <= 4, f"shoulder_curve is {p.shoulder_curve}; expected 1 to 4")
    need(0.5 <= p.neck_taper <= 1.1, f"neck_taper is {p.neck_taper}; expected 0.5 to 1.1")
    need(0.3 <= p.cap_taper <= 1.1, f"cap_taper is {p.cap_taper}; expected 0.3 to 1.1")
    need(
        p.edge_radius < p.shoulder_bottom < p.shoulder_top < p.height,
        "expected edge_radius, shoulder_bottom, shoulder_top and height to rise in this order",
    )
    need(p.cap_height <= 0.98 * (p.height - p.shoulder_top), "cap_height must be less than the neck's")
    need(
        p.cap_height == 0 or p.cap_height > _MIN_CAP * p.height,
        f"cap_height must be 0 or more than {_MIN_CAP} of height",
    )
    need(abs(p.bulge) < 0.3 * p.radius, "bulge must be less than 0.3 of radius")
    need(p.edge_radius < 0.9 * p.radius * p.aspect, "edge_radius must be less than 0.9 of the smaller radius")
    need(p.neck_radius <= 0.9 * p.radius * p.aspect, "neck_radius must be less than 0.9 of the body's smaller radius")
    widest = max(_neck(p, p.height - p.cap_height), _neck(p, p.height))
    need(p.cap_height == 0 or p.cap_radius >= widest, "cap_radius must be at least that of the neck within the cap")
    need(
        p.cap_height > 0 or p.mouth_depth < 0.9 * (p.height - p.shoulder_bottom),
        "mouth_depth must be less than the height of neck and shoulder",
    )
    if p.handle:
        _check_handle(p, need)


def _check_handle(p: BottleParameters, need) -> None:
    half = p.height / 2
    body, tube = _outline(p), _handle(p)
    need(
        p.handle_top - p.handle_bottom > 3 * p.handle_thickness,
        "handle_top and handle_bottom are too close for the thickness",
    )
    ends = tube_rings(tube)[[0, -1]].reshape(-1, 3)
    need(
        encloses(body, ends).all(),
        "the handle does not end inside the bottle: move its attachments to the body or the neck",
    )
    need(bends_freely(tube), "the handle bends more tightly than its thickness allows: thin it or move it out")
    need(p.handle_bottom > p.edge_radius + p.handle_thickness, "handle_bottom is below the body: raise it")
    gap = tube.line[:, 0] - p.handle_thickness / 2 - np.array([_wall(p, level) for level in tube.line[:, 1] + half])
    need(
        np.abs(np.diff((gap > 0.02 * p.height).astype(int))).sum() == 2,
        "the handle leaves no finger hole: raise handle_reach",
    )


def _shoulder(p: BottleParameters, share):
    """Share of the shoulder's narrowing that remains at a share of its height, 1 to 0."""
    if p.shoulder_style == "slope":
        return (1 + np.cos(np.pi * share)) / 2
    return np.maximum(1 - share**p.shoulder_curve, 0) ** (1 / p.shoulder_curve)


def _body(p: BottleParameters, level):
    """The body's radius along x at a level above the base, before its edge is rounded."""
    s = np.minimum(level / p.shoulder_bottom, 1)
    return p.radius + 4 * p.bulge * s * (1 - s)


def _neck(p: BottleParameters, level):
    """The neck's radius at a level, without the cap."""
    return p.neck_radius * (1 + (p.neck_taper - 1) * (level - p.shoulder_top) / (p.height - p.shoulder_top))


def _wall(p: BottleParameters, level: float) -> float:
    """Outer radius along x at a level above the base, without the cap and roundings."""
    if level <= p.shoulder_bottom:
        return float(_body(p, level))
    if level >= p.shoulder_top:
        return float(_neck(p, level))
    share = (level - p.shoulder_bottom) / (p.shoulder_top - p.shoulder_bottom)
    return float(p.neck_radius + (p.radius - p.neck_radius) * _shoulder(p, share))


def _neck_from(p: BottleParameters) -> float:
    """Level at which the shoulder's radius is the mean of those of body and neck."""
    share = np.linspace(0, 1, 401)
    return float(
        p.shoulder_bottom + (p.shoulder_top - p.shoulder_bottom) * share[np.argmax(_shoulder(p, share) <= 0.5)]
    )


def _outline(p: BottleParameters) -> Loft:
    unit = section(p.aspect, p.squareness)
    quarter = 1 - np.cos(np.linspace(0, np.pi / 2, 6))
    levels = (
        np.unique(
            np.round(
                np.concatenate([p.edge_radius * quarter, np.linspace(p.edge_radius, p.shoulder_bottom, 12)]) / p.height,
                9,
            )
        )
        * p.height
    )
    body = (_body(p, levels) - inset(levels, p.edge_radius))[:, None] * unit
    # Steps are small near the top of a dome, where it is flat.
    share = np.sin(np.linspace(0, np.pi / 2, 25))[1:] if p.shoulder_style == "arc" else np.linspace(0, 1, 25)[1:]
    narrowed = p.neck_radius + (p.radius * unit - p.neck_radius) * _shoulder(p, share)[:, None]
    shoulder = p.shoulder_bottom + (p.shoulder_top - p.shoulder_bottom) * share
    cap = p.height - p.cap_height
    neck = np.array([cap if p.cap_height else p.height])
    heights, radii = [levels, shoulder, neck], [body, narrowed, np.outer(_neck(p, neck), np.ones_like(unit))]
    if p.cap_height:
        size = p.cap_radius * (1 + (p.cap_taper - 1) * np.array([0.0, 0.9, 1.0]))
        size[2] -= 0.1 * p.cap_height if 0.1 * p.cap_height < 0.5 * size[2] else 0.0  # a bevel on top
        heights.append(cap + _STEP * p.height + (p.cap_height - _STEP * p.height) * np.array([0.0, 0.9, 1.0]))
        radii.append(np.outer(size, np.ones_like(unit)))
    return Loft(np.concatenate(heights) - p.height / 2, np.concatenate(radii))


def _handle(p: BottleParameters) -> Tube:
    top, bottom = p.handle_top - p.height / 2, p.handle_bottom - p.height / 2
    x_top, x_bottom = _wall(p, p.handle_top), _wall(p, p.handle_bottom)
    x_bar = max(x_top, x_bottom) + p.handle_reach
    radius = 0.6 * min((top - bottom) / 2, p.handle_reach)
    line = bar_line(x_top, x_bottom, x_bar, top, bottom, radius)
    return swept(line, p.handle_thickness, p.handle_width, 2.0, 1.15, _TUBE_RINGS)


def _solid(p: BottleParameters) -> Solid:
    parts = (_outline(p), _handle(p)) if p.handle else (_outline(p),)
    if p.cap_height > 0 or p.mouth_depth == 0:
        return Solid(parts, ())
    mouth = np.full(len(section(1.0, 2.0)), 0.75 * min(p.neck_radius, float(_neck(p, p.height))))
    return Solid(parts, (Loft(np.array([p.height / 2 - p.mouth_depth, p.height]), np.stack([mouth, mouth])),))
