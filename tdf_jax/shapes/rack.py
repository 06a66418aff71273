"""Parametric racks to hang mugs on: watertight meshes with ground truth frames and an exact inside test.

Canonical frame: z up along the post, the first peg towards +x, the origin on the post's axis at half its height.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from tdf_jax._internal.errors import InputError
from tdf_jax.geometry.symmetry import about_z
from tdf_jax.shapes.shape import Shape, Solid, check_dimensions, draw_valid, draws, frame, is_one_body, solid_mesh
from tdf_jax.shapes.solid import Bar, circle, inset, outline_gauge, rectangle

OUTLINES = ("round", "square")
MAX_TILT = np.radians(40)

_PEG_AROUND = 24  # polygon corners around a peg; a multiple of 4, so that one of them is on top
_ROUNDING = 1 - np.cos(np.linspace(0, np.pi / 2, 6))  # levels of the rings of a rounded end, shares of its radius
_SECOND_BELOW = 0.1  # smallest distance of a lower second peg below the first one, share of the height, when sampled


@dataclass(frozen=True)
class RackParameters:
    """The dimensions of one rack, in metres unless stated otherwise; the defaults make a common 0.30 m rack with a peg.

    Attributes:
        height: height of the post's top; a tilted peg may rise above it.
        base_outline: "round" or "square", which may be longer one way than the other.
        base_length: extent of the base along x.
        base_width: extent of the base along y.
        base_thickness: thickness of the base.
        base_offset: distance of the base's centre from the post's axis, towards the first peg (negative: away).
        post_outline: "round" or "square".
        post_width: diameter or side of the post.
        peg_thickness: diameter of the pegs.
        peg_length: length of the first peg, from the post's surface to the tip along the peg.
        peg_tilt: angle by which it rises from the horizontal, 0 to 40 degrees, radians.
        peg_height: height at which its centre line meets the post's axis.
        tip_radius: rounding of the pegs' tips, up to half of their thickness.
        second_length: length of a second peg; 0 for a rack with one peg.
        second_tilt: angle by which the second peg rises, radians.
        second_height: height of the second peg, at most that of the first.
        second_angle: angle from the first peg to the second one about the post, radians.
    """

    height: float = 0.300
    base_outline: str = "round"
    base_length: float = 0.140
    base_width: float = 0.140
    base_thickness: float = 0.014
    base_offset: float = 0.0
    post_outline: str = "round"
    post_width: float = 0.020
    peg_thickness: float = 0.009
    peg_length: float = 0.085
    peg_tilt: float = 0.35
    peg_height: float = 0.255
    tip_radius: float = 0.003
    second_length: float = 0.0
    second_tilt: float = 0.35
    second_height: float = 0.255
    second_angle: float = np.pi

    @property
    def pegs(self) -> int:
        """Number of pegs."""
        return 2 if self.second_length > 0 else 1

    @property
    def fold(self) -> int:
        """Symmetry about z: 2 of two equal opposite pegs in the middle of the base, otherwise 1."""
        first = self.peg_length, self.peg_tilt, self.peg_height, np.pi, 0.0
        second = self.second_length, self.second_tilt, self.second_height, self.second_angle, self.base_offset
        return 2 if first == second else 1


@dataclass(frozen=True, eq=False)
class Rack(Shape):
    """A rack with its ground truth; see `Shape`.

    Its places are the first peg (origin on the line on top of the peg at half its length, x along the peg to the tip,
    z across it and up), the post (on the axis, at the post's top) and the base (on the axis, in the plane of the base).
    What hangs on one peg may as well hang on the other.
    """

    category = "rack"
    unitless = ("base_outline", "post_outline", "peg_tilt", "second_tilt", "second_angle")

    @property
    def peg_frames(self) -> tuple[Float[np.ndarray, "4 4"], ...]:
        """Frame of every peg, (4, 4), as that of the first one."""
        return tuple(_seat(self.parameters, number) for number in range(self.parameters.pegs))

    @property
    def peg_lines(self) -> Float[np.ndarray, "pegs 2 3"]:
        """Ends of the centre line of every peg, at the post's surface and at the tip, (pegs, 2, 3), metres."""
        lines = []
        for number in range(self.parameters.pegs):
            T, begin, length = _peg(self.parameters, number)
            lines.append(T[:3, 3] + np.array([[begin], [begin + length]]) * T[:3, 0])
        return np.array(lines)

    def others(self, place: str) -> tuple[Float[np.ndarray, "4 4"], ...]:
        """Frames that are as right as that of a place: the second of two unlike pegs.

        Args:
            place: name of the place.

        Returns:
            Frames T_object_place, (4, 4), without those that the symmetry makes equal to the place.
        """
        return self.peg_frames[1:] if place == "peg" and self.fold == 1 else ()

    @staticmethod
    def solid_of(parameters: RackParameters) -> Solid:
        """The base, the post and the pegs."""
        return _solid(parameters)


def build_rack(parameters: RackParameters = RackParameters()) -> Rack:
    """Build the mesh and the ground truth of one rack.

    Args:
        parameters: its dimensions, metres.

    Returns:
        The rack in its canonical frame.

    Raises:
        InputError: the dimensions do not make a rack; the message names the one to change.
    """
    _check(parameters)
    mesh = solid_mesh(_solid(parameters))
    if not is_one_body(mesh, handles=0):
        raise InputError(
            f"build_rack(): the dimensions give no single closed rack; got {parameters}; "
            "expected pegs that meet only in the post: move their heights and tilts towards the defaults"
        )
    half = parameters.height / 2
    places = {"peg": _seat(parameters, 0), "post": frame(0.0, half), "base": frame(0.0, -half)}
    return Rack(mesh, parameters, places)


def sample_rack(rng: np.random.Generator) -> RackParameters:
    """Draw the dimensions of a rack 0.22 to 0.36 m tall, with one peg, two equal opposite pegs or two unlike pegs.

    Pegs are 6 to 12 mm thick, 50 to 120 mm long and rise by 0 to 40 degrees.

    Args:
        rng: random generator; the same state gives the same rack.

    Returns:
        Dimensions that `build_rack` accepts.
    """
    return draw_valid(_draw, _check, rng)


def _draw(rng: np.random.Generator) -> RackParameters:
    uniform, chance = draws(rng)
    height = uniform(0.22, 0.36)
    length = height * uniform(0.36, 0.65)
    thickness = uniform(0.006, 0.012)
    peg_length, peg_tilt = uniform(0.050, 0.120), uniform(0, MAX_TILT)
    peg_height = height * uniform(0.75, 0.94)
    kind = rng.uniform()
    second, offset = {}, 0.0
    if kind < 0.3:
        second = {"second_length": peg_length, "second_tilt": peg_tilt, "second_height": peg_height}
    elif kind < 0.6:
        second = {
            "second_length": uniform(0.050, 0.120),
            "second_tilt": uniform(0, MAX_TILT),
            "second_height": peg_height - height * uniform(_SECOND_BELOW, 0.35),
            "second_angle": np.pi if chance(0.5) else uniform(2 * np.pi / 3, 4 * np.pi / 3),
        }
    elif chance(0.5):
        offset = length * uniform(0.1, 0.28)
    return RackParameters(
        height=height,
        base_outline=OUTLINES[rng.integers(2)],
        base_length=length,
        base_width=length if chance(0.6) else length * uniform(0.7, 1.3),
        base_thickness=uniform(0.008, 0.025),
        base_offset=offset,
        post_outline=OUTLINES[0] if chance(0.7) else OUTLINES[1],
        post_width=max(uniform(0.012, 0.028), 1.4 * thickness),
        peg_thickness=thickness,
        peg_length=peg_length,
        peg_tilt=peg_tilt,
        peg_height=peg_height,
        tip_radius=thickness * uniform(0.05, 0.5),
        **second,
    )


def _check(p: RackParameters) -> None:
    """Raise InputError unless the dimensions make one rack whose pegs leave the post and end in the air."""

    def need(truth, what):
        if not truth:
            raise InputError(f"build_rack(): {what}; got {p}")

    check_dimensions(
        "build_rack()",
        p,
        may_be_zero=("peg_tilt", "tip_radius", "second_length", "second_tilt"),
        may_be_negative=("base_offset",),
        choices={"base_outline": OUTLINES, "post_outline": OUTLINES},
    )
    radius = p.peg_thickness / 2
    need(p.post_width > 1.3 * p.peg_thickness, "post_width must be more than 1.3 of peg_thickness")
    need(p.tip_radius <= radius, "tip_radius must be at most half of peg_thickness")
    need(p.base_thickness < 0.3 * p.height, "base_thickness must be less than 0.3 of height")
    reach = np.max(outline_gauge(_base_outline(p), _post_outline(p) - [p.base_offset, 0.0]))
    need(reach < 0.95, "the post is not on the base: enlarge the base or lower base_offset")
    names = (("peg_tilt", "peg_height", "peg_length"), ("second_tilt", "second_height", "second_length"))
    for tilt, height, length in names[: p.pegs]:
        angle, level = getattr(p, tilt), getattr(p, height)
        # A tilt of 40 degrees survives the conversion to radians and back.
        need(angle <= MAX_TILT + 1e-9, f"{tilt} is {angle}; expected 0 to 0.698 (40 degrees)")
        need(level + 1.5 * radius / np.cos(angle) < p.height, f"{height} is above the post: lower it")
        need(level - 1.5 * radius / np.cos(angle) > p.base_thickness, f"{height} is in the base: raise it")
        need(getattr(p, length) > p.peg_thickness, f"{length} must be more than peg_thickness")
    if p.pegs == 2:
        need(p.second_height <= p.peg_height, "second_height must be at most peg_height: the first peg is the higher")
        need(
            np.pi / 3 <= p.second_angle <= 5 * np.pi / 3,
            f"second_angle is {p.second_angle}; expected 1.05 to 5.24 (60 to 300 degrees)",
        )


def _base_outline(p: RackParameters) -> np.ndarray:
    half = np.array([p.base_length, p.base_width]) / 2
    return circle(1.0) * half if p.base_outline == "round" else rectangle(half[0], half[1], 0.08 * half.min())


def _post_outline(p: RackParameters) -> np.ndarray:
    half = p.post_width / 2
    return circle(half, 32) if p.post_outline == "round" else rectangle(half, half, 0.15 * half)


def _peg(p: RackParameters, number: int) -> tuple[np.ndarray, float, float]:
    """Frame of a peg on the post's axis (x along the peg, z across it and up), where the peg begins, and its length."""
    first = p.peg_tilt, p.peg_height, p.peg_length, 0.0
    tilt, height, length, angle = (first, (p.second_tilt, p.second_height, p.second_length, p.second_angle))[number]
    T = np.eye(4)
    T[:3, :3] = [[np.cos(tilt), 0, -np.sin(tilt)], [0, 1, 0], [np.sin(tilt), 0, np.cos(tilt)]]
    T[2, 3] = height - p.height / 2
    outward = np.array([[np.cos(angle), np.sin(angle)]])
    surface = 1 / outline_gauge(_post_outline(p), outward)[0]
    return about_z(angle) @ T, float(surface / np.cos(tilt)), length


def _seat(p: RackParameters, number: int) -> np.ndarray:
    """Frame on top of a peg at half its length."""
    T, begin, length = _peg(p, number)
    T[:3, 3] += (begin + length / 2) * T[:3, 0] + p.peg_thickness / 2 * T[:3, 2]
    return T


def _peg_bar(p: RackParameters, number: int) -> Bar:
    T, begin, length = _peg(p, number)
    radius, end = p.peg_thickness / 2, begin + length
    # The bar's x axis is the peg's z axis, so a corner of the outline is on top; its z axis is along the peg.
    T_peg_bar = np.zeros((4, 4))
    T_peg_bar[[2, 1, 0, 3], [0, 1, 2, 3]] = 1, -1, 1, 1
    rounding = p.tip_radius * _ROUNDING if p.tip_radius else np.zeros(1)
    heights = np.concatenate([[-0.25 * radius], end - rounding[::-1]])  # begins beyond the axis, well inside the post
    scales = 1 - inset(end - heights, p.tip_radius) / radius
    # A fully round tip ends in a point, which would make triangles of no area.
    return Bar(heights, np.maximum(scales, 0.02), circle(radius, _PEG_AROUND), T @ T_peg_bar)


def _solid(p: RackParameters) -> Solid:
    half = p.height / 2
    bevel = 0.2 * p.base_thickness
    base_scales = 1 - bevel / min(p.base_length, p.base_width) * np.array([0.0, 0.0, 2.0])
    base = Bar(
        np.array([0.0, p.base_thickness - bevel, p.base_thickness]),
        base_scales,
        _base_outline(p),
        frame(p.base_offset, -half),
    )
    bevel = 0.2 * p.post_width / 2
    post = Bar(
        np.array([p.base_thickness / 2, p.height - bevel, p.height]),
        np.array([1.0, 1.0, 0.8]),
        _post_outline(p),
        frame(0.0, -half),
    )
    return Solid((base, post, *(_peg_bar(p, number) for number in range(p.pegs))), ())
