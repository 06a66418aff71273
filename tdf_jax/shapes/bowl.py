"""Parametric bowls: watertight meshes with ground truth frames and an exact inside test.

Canonical frame: z up along the bowl's axis, an oval's long side along x, the origin on the axis at half the height.
"""

from dataclasses import dataclass

import numpy as np

from tdf_jax._internal.errors import InputError
from tdf_jax.geometry.symmetry import ROUND
from tdf_jax.shapes.shape import Shape, Solid, check_dimensions, draw_valid, draws, frame, is_one_body, solid_mesh
from tdf_jax.shapes.solid import Loft, inset, section

_PROFILE = 60  # points along the side's profile
_FLARE_FROM = 0.8  # share of the side's height at which a flared or drawn-in rim begins


@dataclass(frozen=True)
class BowlParameters:
    """The dimensions of one bowl, in metres unless stated otherwise; the defaults make a common 0.15 m cereal bowl.

    Attributes:
        height: height of the bowl, including its foot.
        radius: outer radius at the rim, along x, before `rim_flare`.
        aspect: extent along y divided by that along x, 0.4 (oval) to 1; no unit.
        squareness: superellipse exponent of the cross-section, 2 (round, oval) to 20 (square); no unit.
        base_radius: radius of the base, or of the foot, along x.
        curve: superellipse exponent of the side's profile, 1 (straight cone), 2 (quarter of an ellipse) to 6 (flat
            floor, upright wall); no unit.
        rim_flare: displacement of the rim outwards (positive) or inwards (negative), over the uppermost fifth of the
            side.
        wall_thickness: thickness of the wall along x, normal to its profile; an oval's wall is thinner along y by its
            aspect.
        bottom_thickness: thickness of the floor, above the foot.
        foot_height: height of the ring under the base; 0 for a flat base.
        foot_width: radial width of that ring.
        lip_radius: rounding of both edges of the rim; less than half the wall.
    """

    height: float = 0.060
    radius: float = 0.075
    aspect: float = 1.0
    squareness: float = 2.0
    base_radius: float = 0.036
    curve: float = 2.0
    rim_flare: float = 0.0
    wall_thickness: float = 0.004
    bottom_thickness: float = 0.005
    foot_height: float = 0.0
    foot_width: float = 0.005
    lip_radius: float = 0.0015

    @property
    def fold(self) -> int:
        """Symmetry about z: 0 of round bowls, 2 of oval ones and rectangles, 4 of square ones."""
        if self.aspect < 1:
            return 2
        return ROUND if self.squareness == 2 else 4


@dataclass(frozen=True, eq=False)
class Bowl(Shape):
    """A bowl with its ground truth; see `Shape`.

    Its places are the rim (origin on top of the wall on the +x side, x outward, z up), the base (on the axis, in the
    plane of the base) and the body (on the axis, at half the height).
    """

    category = "bowl"
    unitless = ("aspect", "squareness", "curve")

    @staticmethod
    def solid_of(parameters: BowlParameters) -> Solid:
        """The body, the hollow and the recess of the foot."""
        return _solid(parameters)


def build_bowl(parameters: BowlParameters = BowlParameters()) -> Bowl:
    """Build the mesh and the ground truth of one bowl.

    Args:
        parameters: its dimensions, metres.

    Returns:
        The bowl in its canonical frame.

    Raises:
        InputError: the dimensions do not make a bowl; the message names the one to change.
    """
    _check(parameters)
    mesh = solid_mesh(_solid(parameters))
    if not is_one_body(mesh, handles=0):
        raise InputError(
            f"build_bowl(): the dimensions give no single closed bowl; got {parameters}; "
            "expected the walls of a common bowl: move them towards the defaults"
        )
    half, p = parameters.height / 2, parameters
    rim = float(_outer(p)[0][-1] + _inner_radius(p, np.array([p.height]))[0]) / 2
    return Bowl(mesh, parameters, {"rim": frame(rim, half), "base": frame(0.0, -half), "body": frame(0.0, 0.0)})


def sample_bowl(rng: np.random.Generator) -> BowlParameters:
    """Draw the dimensions of a bowl 0.10 to 0.22 m wide.

    Bowls are shallow to deep, with or without a foot, with a plain, flared or drawn-in rim; some are oval or square.

    Args:
        rng: random generator; the same state gives the same bowl.

    Returns:
        Dimensions that `build_bowl` accepts.
    """
    return draw_valid(_draw, _check, rng)  # some draws have a floor that is too thick for a shallow bowl


def _draw(rng: np.random.Generator) -> BowlParameters:
    uniform, chance = draws(rng)
    radius = uniform(0.05, 0.11)
    height = 2 * radius * uniform(0.22, 0.70)
    wall = radius * uniform(0.025, 0.10)
    flare = rng.uniform()
    return BowlParameters(
        height=height,
        radius=radius,
        aspect=uniform(0.60, 0.88) if chance(0.15) else 1.0,
        squareness=uniform(2.8, 7.0) if chance(0.15) else 2.0,
        base_radius=radius * uniform(0.32, 0.75),
        curve=uniform(1.0, 3.5),
        rim_flare=radius * (uniform(0.02, 0.12) if flare < 0.35 else uniform(-0.06, -0.02) if flare < 0.5 else 0.0),
        wall_thickness=wall,
        bottom_thickness=wall * uniform(1.0, 2.5),
        foot_height=uniform(0.002, 0.010) if chance(0.45) else 0.0,
        foot_width=uniform(0.003, 0.008),
        lip_radius=wall * uniform(0.15, 0.48),
    )


def _check(p: BowlParameters) -> None:
    """Raise InputError unless the dimensions make one bowl."""

    def need(truth, what):
        if not truth:
            raise InputError(f"build_bowl(): {what}; got {p}")

    check_dimensions("build_bowl()", p, may_be_zero=("foot_height", "lip_radius"), may_be_negative=("rim_flare",))
    need(0.4 <= p.aspect <= 1, f"aspect is {p.aspect}; expected 0.4 to 1")
    need(2 <= p.squareness <= 20, f"squareness is {p.squareness}; expected 2 (round) to 20 (square)")
    need(1 <= p.curve <= 6, f"curve is {p.curve}; expected 1 to 6")
    need(2 * p.lip_radius < p.wall_thickness, "lip_radius must be less than half of wall_thickness")
    need(p.base_radius < 0.95 * p.radius, "base_radius must be less than 0.95 of radius")
    need(abs(p.rim_flare) < 0.25 * p.radius, "rim_flare must be less than a quarter of radius")
    need(
        p.radius + min(p.rim_flare, 0) > p.base_radius + p.wall_thickness,
        "base_radius leaves no room for the wall: lower it",
    )
    need(
        p.foot_height + p.bottom_thickness + p.lip_radius < 0.6 * p.height,
        "the bottom is too thick for the height: lower it",
    )
    need(p.foot_height == 0 or p.foot_width < 0.8 * p.base_radius, "foot_width leaves no recess: lower it")
    need(
        p.wall_thickness < 0.25 * p.radius * p.aspect,
        "wall_thickness must be less than a quarter of the smaller radius",
    )


def _outer(p: BowlParameters) -> tuple[np.ndarray, np.ndarray]:
    """Radius along x and height above the base, upwards, of the side above the foot, before edges are rounded."""
    # Even angles along the profile make small steps near the base, where it is flat, and heights rise everywhere.
    s = 1 - np.cos(np.linspace(0, np.pi / 2, _PROFILE))
    radius = p.base_radius + (p.radius - p.base_radius) * (1 - (1 - s) ** p.curve) ** (1 / p.curve)
    radius = radius + p.rim_flare * (np.maximum(s - _FLARE_FROM, 0) / (1 - _FLARE_FROM)) ** 2
    return radius, p.foot_height + (p.height - p.foot_height) * s


def _inner_radius(p: BowlParameters, levels: np.ndarray) -> np.ndarray:
    """Radius along x of the hollow at levels above the base: the side, offset inwards by the thickness of the wall."""
    radius, height = _outer(p)
    along = np.stack([np.gradient(radius), np.gradient(height)])
    along /= np.linalg.norm(along, axis=0)
    inner_radius, inner_height = radius - p.wall_thickness * along[1], height + p.wall_thickness * along[0]
    # The offset of a side that leans inwards ends below the rim, and is extended straight from there.
    further = max(height[-1] - inner_height[-1], 0) / along[1, -1] + p.wall_thickness
    inner_radius = np.append(inner_radius, inner_radius[-1] + further * along[0, -1])
    inner_height = np.append(inner_height, inner_height[-1] + further * along[1, -1])
    order = np.argsort(inner_height)
    return np.interp(levels, inner_height[order], inner_radius[order])


def _solid(p: BowlParameters) -> Solid:
    unit, floor = section(p.aspect, p.squareness), p.foot_height + p.bottom_thickness
    quarter = 1 - np.cos(np.linspace(0, np.pi / 2, 6))
    radius, height = _outer(p)
    lip = p.height - p.lip_radius * quarter
    levels = np.unique(np.round(np.concatenate([[0.0], height, lip]) / p.height, 9)) * p.height
    outer = np.interp(levels, height, radius) - inset(p.height - levels, p.lip_radius)
    levels_in = (
        np.unique(
            np.round(
                np.concatenate([floor + (p.height - floor) * (1 - np.cos(np.linspace(0, np.pi / 2, _PROFILE))), lip])
                / p.height,
                9,
            )
        )
        * p.height
    )
    inner = _inner_radius(p, levels_in) + inset(p.height - levels_in, p.lip_radius)
    above = np.append(levels_in, 1.5 * p.height)  # the cut extends well beyond the rim, so that no two faces coincide
    hollows = [Loft(above - p.height / 2, np.append(inner, inner[-1])[:, None] * unit)]
    if p.foot_height > 0:
        recess = (p.base_radius - p.foot_width) * unit
        hollows.append(Loft(np.array([-p.height, p.foot_height - p.height / 2]), np.stack([recess, recess])))
    return Solid((Loft(levels - p.height / 2, outer[:, None] * unit),), tuple(hollows))
