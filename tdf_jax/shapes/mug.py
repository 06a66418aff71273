"""Parametric mugs: watertight meshes with ground truth frames and an exact inside test.

Canonical frame: z up along the mug's axis, the handle along +x, the origin on the axis at half the body's height.
Every surface is flat between neighbouring rings, and `Mug.contains` tests the planes of the mesh. Training labels and
surface samples therefore agree to rounding, which a smooth formula would not achieve.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from tdf_jax._internal.errors import InputError
from tdf_jax.shapes.shape import Shape, Solid, check_dimensions, draw_valid, draws, frame, is_one_body, solid_mesh
from tdf_jax.shapes.solid import Frusta, Tube, bar_line, bends_freely, in_frusta, inset, polygon, swept, tube_rings

HANDLE_STYLES = ("d", "ring", "ear", "square")

_TUBE_RINGS = 30  # rings along the handle
_LANDMARKS_ALONG, _LANDMARKS_UP, _LANDMARKS_AROUND = 24, 16, 32  # counts along the handle; up the wall and around it
_MAY_BE_ZERO = ("edge_radius", "foot_height", "lip_radius")


@dataclass(frozen=True)
class MugParameters:
    """The dimensions of one mug, in metres unless stated otherwise; the defaults make a common 0.10 m mug.

    Attributes:
        height: height of the body.
        top_radius: outer radius at the rim; of square mugs half the side.
        bottom_radius: outer radius at the bottom, before the edge is rounded.
        bulge: addition to the radius at half height, which falls off as a parabola; positive for a barrel, negative for
            a waist.
        squareness: superellipse exponent of the body's cross-section, 2 (round) to 20 (square); no unit.
        wall_thickness: thickness of the body's wall.
        bottom_thickness: thickness of the floor, above the recess of the foot.
        edge_radius: rounding of the outer bottom edge.
        foot_height: depth of the recess inside the foot ring; 0 for a flat bottom.
        foot_width: radial width of the foot ring.
        lip_radius: rounding of both edges of the rim; less than half the wall.
        handle_style: "d" (straight bar, round ends), "ring" (part of an ellipse), "ear" (widest above the middle) or
            "square" (straight bar and arms).
        handle_top: height of the upper attachment above the bottom.
        handle_bottom: height of the lower attachment above the bottom.
        handle_reach: distance from the wider attachment on the wall to the centre line of the handle's bar.
        handle_width: width of the tube's section, across the mug's plane of symmetry.
        handle_thickness: thickness of the tube's section, in the mug's plane of symmetry.
        handle_squareness: superellipse exponent of the tube's section, 2 (ellipse) to 20 (rectangle); no unit.
        handle_flare: size of the tube's section at the wall divided by its size at the grip, 1 to 2; no unit.
    """

    height: float = 0.100
    top_radius: float = 0.041
    bottom_radius: float = 0.040
    bulge: float = 0.0
    squareness: float = 2.0
    wall_thickness: float = 0.004
    bottom_thickness: float = 0.005
    edge_radius: float = 0.006
    foot_height: float = 0.0
    foot_width: float = 0.005
    lip_radius: float = 0.0016
    handle_style: str = "d"
    handle_top: float = 0.082
    handle_bottom: float = 0.024
    handle_reach: float = 0.030
    handle_width: float = 0.014
    handle_thickness: float = 0.009
    handle_squareness: float = 2.0
    handle_flare: float = 1.15

    @property
    def fold(self) -> int:
        """Symmetry about z: 1, because the handle distinguishes all sides."""
        return 1


@dataclass(frozen=True, eq=False)
class Mug(Shape):
    """A mug with its ground truth; see `Shape`. Its places are the handle, the rim and the base."""

    category = "mug"
    unitless = ("squareness", "handle_style", "handle_squareness", "handle_flare")

    @property
    def handle_frame(self) -> Float[np.ndarray, "4 4"]:
        """Pose with its origin on the handle's centre line midway between the attachments, x outward, z up."""
        return self.frames["handle"]

    @property
    def rim_frame(self) -> Float[np.ndarray, "4 4"]:
        """Pose with its origin on top of the rim opposite to the handle, x outward (object -x), z up."""
        return self.frames["rim"]

    @property
    def base_frame(self) -> Float[np.ndarray, "4 4"]:
        """Pose with its origin on the axis in the plane of the base, x towards the handle, z up."""
        return self.frames["base"]

    @property
    def finger_hole(self) -> Float[np.ndarray, "corners 2"]:
        """Outline around the finger hole in the x-z plane, (corners, 2), metres, object frame.

        It is the handle's centre line, and the line through the wall that closes it.
        """
        return _centre_line(self.parameters)

    @staticmethod
    def solid_of(parameters: MugParameters) -> Solid:
        """The body and the handle, the cavity and the recess of the foot."""
        return _solid(parameters)

    def landmarks(self) -> Float[np.ndarray, "landmarks 3"]:
        """Points that correspond on all mugs, (landmarks, 3), metres, object frame.

        They are on the four sides of the handle (inner, outer, left, right) at even shares of its centre line's length,
        and on the outer wall at even shares of the height and even angles.
        """
        p = self.parameters
        line = _even(_centre_line(p), _LANDMARKS_ALONG)
        tangent = np.gradient(line, axis=0)
        normal = np.stack([tangent[:, 1], -tangent[:, 0]], axis=1) / np.linalg.norm(tangent, axis=1, keepdims=True)
        middle = np.stack([line[:, 0], np.zeros(len(line)), line[:, 1]], axis=1)
        thick = np.stack([normal[:, 0], np.zeros(len(line)), normal[:, 1]], axis=1) * p.handle_thickness / 2
        wide = np.array([0.0, p.handle_width / 2, 0.0])
        levels = np.linspace(0, p.height, _LANDMARKS_UP)
        around = polygon(p.squareness, _LANDMARKS_AROUND)
        wall = np.concatenate(
            [
                np.column_stack([r * around, np.full(len(around), z)])
                for r, z in zip(_wall(p, levels), levels - p.height / 2)
            ]
        )
        return np.concatenate([middle + thick, middle - thick, middle + wide, middle - wide, wall])


def build_mug(parameters: MugParameters = MugParameters()) -> Mug:
    """Build the mesh and the ground truth of one mug.

    Args:
        parameters: its dimensions, metres.

    Returns:
        The mug in its canonical frame.

    Raises:
        InputError: the dimensions do not make a mug; the message names the one to change.
    """
    _check(parameters)
    mesh = solid_mesh(_solid(parameters))
    if not is_one_body(mesh, handles=1):
        raise InputError(
            f"build_mug(): the dimensions give no single closed cup with one handle; got {parameters}; "
            "expected walls and handle of a common mug: move them towards the defaults"
        )
    grip = _grip(_tube(parameters), parameters)
    rim = parameters.top_radius - parameters.wall_thickness / 2
    half = parameters.height / 2
    return Mug(
        mesh, parameters, {"handle": frame(grip[0], grip[1]), "rim": frame(-rim, half, -1.0), "base": frame(0.0, -half)}
    )


def sample_mug(rng: np.random.Generator) -> MugParameters:
    """Draw the dimensions of a mug 0.07 to 0.13 m tall: straight, tapered, barrel, waisted, square, every handle.

    Args:
        rng: random generator; the same state gives the same mug.

    Returns:
        Dimensions that `build_mug` accepts.
    """
    return draw_valid(_draw, _check, rng)  # the handle of about one draw in ten does not fit its body


def _draw(rng: np.random.Generator) -> MugParameters:
    uniform, chance = draws(rng)
    height = uniform(0.07, 0.13)
    top = height * uniform(0.33, 0.63)
    bottom = top * (uniform(0.96, 1.03) if chance(0.5) else uniform(0.65, 1.0))
    wall = uniform(0.0025, 0.006)
    thickness = uniform(0.006, 0.013)
    return MugParameters(
        height=height,
        top_radius=top,
        bottom_radius=bottom,
        bulge=bottom * uniform(-0.08, 0.16) if chance(0.45) else 0.0,
        squareness=uniform(2.5, 7.0) if chance(0.2) else 2.0,
        wall_thickness=wall,
        bottom_thickness=uniform(0.003, 0.008),
        edge_radius=bottom * (uniform(0.03, 0.25) if chance(0.8) else uniform(0.25, 0.65)),
        foot_height=uniform(0.001, 0.004) if chance(0.35) else 0.0,
        foot_width=uniform(0.003, 0.006),
        lip_radius=wall * uniform(0.15, 0.48),
        handle_style=HANDLE_STYLES[rng.integers(len(HANDLE_STYLES))],
        handle_top=height * uniform(0.68, 0.94),
        handle_bottom=height * uniform(0.09, 0.38),
        handle_reach=uniform(0.020, 0.042),
        handle_width=thickness * uniform(0.8, 2.2),
        handle_thickness=thickness,
        handle_squareness=uniform(2.5, 7.0) if chance(0.4) else 2.0,
        handle_flare=uniform(1.0, 1.5),
    )


def _check(parameters: MugParameters) -> None:
    """Raise InputError unless the dimensions make one closed mug with one finger hole."""

    def need(truth, what):
        if not truth:
            raise InputError(f"build_mug(): {what}; got {parameters}")

    p = parameters
    styles = {"handle_style": HANDLE_STYLES}
    check_dimensions("build_mug()", p, may_be_zero=_MAY_BE_ZERO, may_be_negative=("bulge",), choices=styles)
    for name in ("squareness", "handle_squareness"):
        need(2 <= getattr(p, name) <= 20, f"{name} is {getattr(p, name)}; expected 2 (round) to 20 (square)")
    need(1 <= p.handle_flare <= 2, f"handle_flare is {p.handle_flare}; expected 1 to 2")
    need(2 * p.lip_radius < p.wall_thickness, "lip_radius must be less than half of wall_thickness")
    floor = p.foot_height + p.bottom_thickness
    need(floor + _inner_edge(p) + p.lip_radius < p.height, "the bottom is too thick for the height: lower it")
    need(p.edge_radius + p.lip_radius < p.height, "edge_radius is too large for the height")
    levels = np.linspace(0, 1, 65) * p.height
    need(np.min(_wall(p, levels)) > p.wall_thickness, "wall_thickness must be less than the radius at every height")
    need(p.edge_radius < 0.9 * p.bottom_radius, "edge_radius must be less than 0.9 of bottom_radius")
    need(_wall(p, floor) > p.wall_thickness + _inner_edge(p), "the cavity closes at its floor: thin the wall")
    need(
        p.foot_height == 0 or p.edge_radius + p.foot_width < 0.95 * p.bottom_radius,
        "foot_width leaves no recess: lower it or edge_radius",
    )
    size = p.handle_thickness * p.handle_flare
    need(p.handle_top + size / 2 < p.height - p.lip_radius, "handle_top is above the body: lower it")
    need(p.handle_bottom - size / 2 > 0, "handle_bottom is below the body: raise it")
    need(p.handle_top - p.handle_bottom > 2 * size, "handle_top and handle_bottom are too close for the thickness")
    need(p.handle_width * p.handle_flare < p.bottom_radius, "handle_width must be less than the radius")
    _check_handle(p, need)


def _check_handle(p: MugParameters, need) -> None:
    outer, tube = _body(p), _tube(p)
    rings = tube_rings(tube)
    need(rings[..., 2].min() > -p.height / 2, "the handle hangs below the bottom: raise handle_bottom")
    buried = in_frusta(outer, np.concatenate([rings[0], rings[-1]])).all()
    need(buried, "the handle does not end inside the body: move its attachments away from the rounded edge")
    need(bends_freely(tube), "the handle bends more tightly than its thickness allows: thin it or move it out")
    gap = tube.line[:, 0] - p.handle_thickness * tube.scales / 2 - _wall(p, tube.line[:, 1] + p.height / 2)
    free = gap > 0.02 * p.height
    need(np.abs(np.diff(free.astype(int))).sum() == 2, "the handle leaves no finger hole: raise handle_reach")


def _wall(p: MugParameters, level):
    """Outer radius at a level above the bottom, before edges are rounded."""
    s = level / p.height
    return p.bottom_radius + (p.top_radius - p.bottom_radius) * s + 4 * p.bulge * s * (1 - s)


def _inner_edge(p: MugParameters) -> float:
    """Rounding of the cavity's floor, concentric with the outer edge, so that the wall is nowhere thinner there."""
    return max(p.edge_radius - p.wall_thickness, p.wall_thickness / 2)


def _levels(p: MugParameters, low: float, high: float, low_radius: float, high_radius: float) -> np.ndarray:
    """Levels of a profile's rings, which are close together along both roundings."""
    quarter = 1 - np.cos(np.linspace(0, np.pi / 2, 6))
    middle = np.linspace(low + low_radius, high - high_radius, 10)
    levels = np.concatenate([low + low_radius * quarter, middle, high - high_radius * quarter])
    return np.unique(np.round(levels / p.height, 9)) * p.height  # one level, not two that rounding separates


def _body(p: MugParameters) -> Frusta:
    levels = _levels(p, 0.0, p.height, p.edge_radius, p.lip_radius)
    radii = _wall(p, levels) - inset(levels, p.edge_radius) - inset(p.height - levels, p.lip_radius)
    return Frusta(levels - p.height / 2, radii, p.squareness)


def _solid(p: MugParameters) -> Solid:
    floor = p.foot_height + p.bottom_thickness
    levels = _levels(p, floor, p.height, _inner_edge(p), p.lip_radius)
    radii = _wall(p, levels) - p.wall_thickness
    radii = radii - inset(levels - floor, _inner_edge(p)) + inset(p.height - levels, p.lip_radius)
    above = np.append(levels, 1.5 * p.height)  # the cut extends well beyond the rim, so that no two faces coincide
    cavity = Frusta(above - p.height / 2, np.append(radii, radii[-1]), p.squareness)
    if p.foot_height == 0:
        return Solid((_body(p), _tube(p)), (cavity,))
    inner = p.bottom_radius - p.edge_radius - p.foot_width
    recess = Frusta(np.array([-p.height, p.foot_height - p.height / 2]), np.array([inner, inner]), p.squareness)
    return Solid((_body(p), _tube(p)), (cavity, recess))


def _tube(p: MugParameters) -> Tube:
    return swept(_centre_line(p), p.handle_thickness, p.handle_width, p.handle_squareness, p.handle_flare, _TUBE_RINGS)


def _centre_line(p: MugParameters) -> np.ndarray:
    """The handle's centre line in the x-z plane from the upper to the lower attachment, in the middle of the wall."""
    top, bottom = p.handle_top, p.handle_bottom
    x_top, x_bottom = (float(_wall(p, level)) - p.wall_thickness / 2 for level in (top, bottom))
    x_bar = max(x_top, x_bottom) + p.wall_thickness / 2 + p.handle_reach
    half, middle = (top - bottom) / 2, (top + bottom) / 2 - p.height / 2
    if p.handle_style in ("d", "square"):
        radius = {"d": 0.98, "square": 0.5}[p.handle_style] * min(half, p.handle_reach)
        return bar_line(x_top, x_bottom, x_bar, middle + half, middle - half, radius)
    t = np.linspace(0, 1, 160)
    if p.handle_style == "ring":
        centre = 0.35  # share of the reach; the ellipse intersects the wall beyond its widest height
        angle = (1 - 2 * t) * np.arccos(-centre / (1 - centre))
        out, up = centre + (1 - centre) * np.cos(angle), np.sin(angle) / np.sin(angle[0])
    else:
        basis = np.stack([(1 - t) ** 3, 3 * t * (1 - t) ** 2, 3 * t**2 * (1 - t), t**3], axis=1)
        out, up = (basis @ np.array([[0.0, 1.0], [1.1, 1.45], [1.3, -0.3], [0.0, -1.0]])).T
        out = out / out.max()
    wall = x_bottom + (x_top - x_bottom) * (up + 1) / 2
    return np.stack([wall + out * (x_bar - wall), middle + half * up], axis=1)


def _even(line: np.ndarray, count: int) -> np.ndarray:
    """Points along a polyline, evenly spaced by length."""
    at = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(line, axis=0), axis=1))])
    even = np.linspace(0, at[-1], count)
    return np.stack([np.interp(even, at, line[:, axis]) for axis in range(2)], axis=1)


def _grip(tube: Tube, p: MugParameters) -> np.ndarray:
    """The outermost point of the centre line half way between the attachments, (x, z)."""
    height = (p.handle_top + p.handle_bottom - p.height) / 2
    a, b = tube.line[:-1], tube.line[1:]
    crossing = (a[:, 1] - height) * (b[:, 1] - height) <= 0
    a, b = a[crossing], b[crossing]
    share = (height - a[:, 1]) / (b[:, 1] - a[:, 1])
    return np.array([np.max(a[:, 0] + share * (b[:, 0] - a[:, 0])), height])
