"""Parametric containers to stand bottles in: watertight meshes with ground truth frames and an exact inside test.

Canonical frame: z up, the longer side or a shelf's open side along x, the origin in the middle of the outside.
"""

from dataclasses import dataclass

import numpy as np

from tdf_jax._internal import checks
from tdf_jax._internal.errors import InputError
from tdf_jax.geometry.symmetry import ROUND
from tdf_jax.shapes.bottle import sample_bottle
from tdf_jax.shapes.shape import Shape, Solid, check_dimensions, draw_valid, draws, frame, is_one_body, solid_mesh
from tdf_jax.shapes.solid import Bar, circle, rectangle

STYLES = ("round", "box", "shelf")
ROOM = (1.2, 2.0)  # inner sides of the floor over the width of what is to stand on it, when sampled
_LONGER = 1.12  # smallest ratio of the sides of a sampled box that is not square


@dataclass(frozen=True)
class ContainerParameters:
    """The dimensions of one container, in metres unless stated otherwise; the defaults make a square 0.15 m bin.

    Attributes:
        style: "round" (a bin, open above), "box" (a rectangular bin, open above) or "shelf" (a compartment with walls
            on all sides but the front, which is along +x).
        height: height of the outside.
        length: inner extent of the floor along x; at least `width` for bins.
        width: inner extent of the floor along y.
        taper: inner extent of a bin at the floor divided by that at the top, 0.5 to 1; no unit; 1 for shelves.
        corner_radius: rounding of a box's upright inner edges, at the top.
        wall_thickness: thickness of the walls at the top, and of a shelf's ceiling.
        floor_thickness: thickness of the floor.
        rim_width: width of a flat rim around the top of a bin, outside its wall; 0 for none.
        rim_thickness: thickness of that rim.
    """

    style: str = "box"
    height: float = 0.150
    length: float = 0.120
    width: float = 0.120
    taper: float = 1.0
    corner_radius: float = 0.010
    wall_thickness: float = 0.004
    floor_thickness: float = 0.005
    rim_width: float = 0.0
    rim_thickness: float = 0.004

    @property
    def fold(self) -> int:
        """Symmetry about z: 1 of shelves, otherwise 2 if one side is longer, 4 of square bins and 0 of round ones."""
        if self.style == "shelf":
            return 1
        if self.length != self.width:
            return 2
        return ROUND if self.style == "round" else 4

    @property
    def depth(self) -> float:
        """Height of the room above the floor, metres."""
        return self.height - self.floor_thickness - (self.wall_thickness if self.style == "shelf" else 0.0)


@dataclass(frozen=True, eq=False)
class Container(Shape):
    """A container with its ground truth; see `Shape`.

    Its places are the floor (origin in the middle of the inner floor), the opening (in the middle of the top of a bin,
    or of a shelf's open side) and the base (on the axis, in the plane of the base); z is up everywhere.
    """

    category = "container"
    unitless = ("style", "taper")

    @staticmethod
    def solid_of(parameters: ContainerParameters) -> Solid:
        """The outside and its rim, and the room within."""
        return _solid(parameters)


def build_container(parameters: ContainerParameters = ContainerParameters()) -> Container:
    """Build the mesh and the ground truth of one container.

    Args:
        parameters: its dimensions, metres.

    Returns:
        The container in its canonical frame.

    Raises:
        InputError: the dimensions do not make a container; the message names the one to change.
    """
    _check(parameters)
    mesh = solid_mesh(_solid(parameters))
    if not is_one_body(mesh, handles=0):
        raise InputError(
            f"build_container(): the dimensions give no single closed container; got {parameters}; "
            "expected the walls of a common bin or shelf: move them towards the defaults"
        )
    half, p = parameters.height / 2, parameters
    floor = p.floor_thickness - half
    if p.style == "shelf":
        middle, front = p.wall_thickness / 2, (p.length + p.wall_thickness) / 2
        places = {"floor": frame(middle, floor), "opening": frame(front, floor + p.depth / 2)}
    else:
        places = {"floor": frame(0.0, floor), "opening": frame(0.0, half)}
    return Container(mesh, parameters, places | {"base": frame(0.0, -half)})


def sample_container(
    rng: np.random.Generator, *, width: float | None = None, height: float | None = None
) -> ContainerParameters:
    """Draw the dimensions of a round, square or longer bin, or of a shelf with one open side.

    Inner sides of the floor are 1.2 to 2 times as wide as the object that is to stand in the container. A bin is 0.3 to
    0.9 times as deep as the object is tall; a shelf is 1.1 to 1.5 times as tall inside.

    Args:
        rng: random generator; the same state gives the same container.
        width: largest horizontal extent of that object, metres; by default the body of a bottle from `sample_bottle`.
        height: its height, metres; by default that bottle's.

    Returns:
        Dimensions that `build_container` accepts.

    Raises:
        InputError: the width or the height is not positive, or they differ by more than a factor of 20.
    """
    if width is None or height is None:
        bottle = sample_bottle(rng)
        width = 2 * (bottle.radius + max(bottle.bulge, 0.0)) if width is None else width
        height = bottle.height if height is None else height
    checks.positive("sample_container()", "width", width, "metres")
    checks.positive("sample_container()", "height", height, "metres")
    if not 1 / 20 < width / height < 20:
        raise InputError(
            f"sample_container(): width is {width} and height {height}; expected the two of one object, in metres, not "
            "20 times apart; correct the unit"
        )
    return draw_valid(lambda rng: _draw(rng, width, height), _check, rng)


def _draw(rng: np.random.Generator, width: float, height: float) -> ContainerParameters:
    uniform, chance = draws(rng)
    kind = rng.uniform()
    if kind < 0.25:
        length, across = (width * uniform(*ROOM) for _ in range(2))
        wall, floor = (min(width, height) * uniform(0.06, 0.20) for _ in range(2))
        return ContainerParameters(
            style="shelf",
            height=height * uniform(1.1, 1.5) + floor + wall,
            length=length,
            width=across,
            corner_radius=0.0,
            wall_thickness=wall,
            floor_thickness=floor,
        )
    long = kind < 0.45
    across = width * uniform(ROOM[0], ROOM[1] / _LONGER / 1.05 if long else ROOM[1])
    length = uniform(_LONGER * across, ROOM[1] * width) if long else across
    floor = width * uniform(0.04, 0.12)
    wall = width * uniform(0.03, 0.10)
    return ContainerParameters(
        style="box" if long or kind < 0.72 else "round",
        height=height * uniform(0.3, 0.9) + floor,
        length=length,
        width=across,
        taper=1.0 if chance(0.4) else uniform(0.75, 1.0),
        corner_radius=0.0 if chance(0.3) else across / 2 * uniform(0.04, 0.45),
        wall_thickness=wall,
        floor_thickness=floor,
        rim_width=width * uniform(0.06, 0.18) if chance(0.3) else 0.0,
        rim_thickness=wall * uniform(0.7, 1.5),
    )


def _check(p: ContainerParameters) -> None:
    """Raise InputError unless the dimensions make one container."""

    def need(truth, what):
        if not truth:
            raise InputError(f"build_container(): {what}; got {p}")

    check_dimensions(
        "build_container()",
        p,
        may_be_zero=("corner_radius", "rim_width"),
        may_be_negative=(),
        choices={"style": STYLES},
    )
    need(0.5 <= p.taper <= 1, f"taper is {p.taper}; expected 0.5 to 1")
    need(p.depth > 0.1 * p.height, "floor_thickness leaves too little height inside: lower it")
    need(p.floor_thickness < 0.5 * p.height, "floor_thickness must be less than half of height")
    need(p.wall_thickness < 0.5 * p.width, "wall_thickness must be less than half of width")
    if p.style == "shelf":
        need(p.taper == 1, "taper is for bins; a shelf has 1")
        need(p.corner_radius == 0 and p.rim_width == 0, "corner_radius and rim_width are for bins; a shelf has 0")
        return
    need(p.length >= p.width, "width must be at most length: the longer side is along x")
    need(
        p.style == "round" or p.corner_radius < 0.4 * p.width / p.taper,
        "corner_radius must be less than 0.4 of the width at the top: it is a round bin otherwise",
    )
    need(p.rim_width == 0 or p.rim_thickness < 0.5 * p.depth, "rim_thickness must be less than half of the depth")
    need(_scale(p, 0.0) > 0.3, "taper narrows the base too much below a thick floor: raise it")


def _scale(p: ContainerParameters, level: float) -> float:
    """Extent of a bin at a level above its base over that at the top."""
    return p.taper + (1 - p.taper) * (level - p.floor_thickness) / (p.height - p.floor_thickness)


def _outline(p: ContainerParameters, further: float) -> np.ndarray:
    """Outline of the top of a bin, a distance outside its inner edge."""
    half = np.array([p.length, p.width]) / (2 * p.taper) + further
    if p.style == "round":
        return circle(1.0) * half
    return rectangle(half[0], half[1], p.corner_radius + further if p.corner_radius else 0.0)


def _solid(p: ContainerParameters) -> Solid:
    half, top = p.height / 2, 1.5 * p.height  # cuts extend well beyond the outside, so that no two faces coincide
    if p.style == "shelf":
        outer = np.array([p.length + p.wall_thickness, p.width + 2 * p.wall_thickness]) / 2
        back = p.wall_thickness - outer[0]
        room = rectangle(p.length, p.width / 2)  # twice as long as the inside
        inside = np.array([p.floor_thickness, p.floor_thickness + p.depth])
        ones = np.ones(2)
        return Solid(
            (Bar(np.array([0.0, p.height]), ones, rectangle(outer[0], outer[1]), frame(0.0, -half)),),
            (Bar(inside, ones, room, frame(back + p.length, -half)),),
        )

    def bar(low, high, outline):
        return Bar(np.array([low, high]), np.array([_scale(p, low), _scale(p, high)]), outline, frame(0.0, -half))

    parts = [bar(0.0, p.height, _outline(p, p.wall_thickness))]
    if p.rim_width:
        rim = _outline(p, p.wall_thickness + p.rim_width)
        parts.append(Bar(np.array([p.height - p.rim_thickness, p.height]), np.ones(2), rim, frame(0.0, -half)))
    return Solid(tuple(parts), (bar(p.floor_thickness, top, _outline(p, 0.0)),))
