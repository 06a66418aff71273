"""The bottle family: dimensions, places, symmetry, errors, and the range of sampled dimensions."""

import re
from dataclasses import replace

import numpy as np
import pytest

from tdf_jax._internal.errors import InputError
from tdf_jax.shapes import BottleParameters, build_bottle, sample_bottle

PLAIN = BottleParameters()
VARIANTS = {
    "plain": PLAIN,
    "flat": BottleParameters(aspect=0.5),
    "square": BottleParameters(squareness=6.0),
    "rectangle": BottleParameters(aspect=0.6, squareness=5.0),
    "barrel": BottleParameters(bulge=0.004, shoulder_curve=3.0),
    "waist": BottleParameters(bulge=-0.006, edge_radius=0.0),
    "wine": BottleParameters(shoulder_style="slope", neck_taper=0.8, cap_height=0.0),
    "cone": BottleParameters(shoulder_curve=1.0, cap_taper=0.5),
    "open": BottleParameters(cap_height=0.0, neck_taper=1.1),
    "closed": BottleParameters(cap_height=0.0, mouth_depth=0.0),
    "wide cap": BottleParameters(cap_radius=0.036, cap_height=0.04),
    "handle": BottleParameters(handle=True),
    "handle on the neck": BottleParameters(handle=True, handle_top=0.19, handle_bottom=0.08, cap_height=0.0),
    "flat with a handle": BottleParameters(handle=True, aspect=0.6, bulge=-0.003),
}


def along(bottle, level, direction=(1.0, 0.0)):
    """Distances from the axis, 5e-6 m apart, that are material at a level above the base."""
    reach = np.arange(0, 0.1, 5e-6)
    flat = reach[:, None] * np.array(direction) / np.linalg.norm(direction)
    return reach[bottle.contains(np.column_stack([flat, np.full(len(reach), level - bottle.height / 2)]))]


def outer(bottle, levels, direction=(1.0, 0.0)):
    """Radius of the outside at levels above the base; of one with a handle, look along another direction."""
    return np.array([along(bottle, level, direction)[-1] for level in levels])


def on_axis(bottle, levels):
    """Which levels of the axis are material."""
    levels = np.asarray(levels) - bottle.height / 2
    return bottle.contains(np.column_stack([np.zeros((len(levels), 2)), levels]))


def at(bottle, x, y, level):
    return bool(bottle.contains(np.array([[x, y, level - bottle.height / 2]]))[0])


@pytest.mark.parametrize("name", VARIANTS)
def test_every_variant_is_one_closed_bottle_that_stands_on_its_base(name):
    bottle = build_bottle(VARIANTS[name])
    mesh = bottle.mesh
    assert mesh.is_watertight and mesh.is_winding_consistent and mesh.volume > 0
    assert mesh.body_count == 1
    assert mesh.euler_number == (0 if bottle.parameters.handle else 2)  # the hole for the fingers, and no other
    np.testing.assert_allclose(mesh.bounds[:, 2], [-bottle.height / 2, bottle.height / 2], atol=1e-6)
    np.testing.assert_allclose(mesh.bounds[:, 1].sum(), 0, atol=1e-9)
    assert bottle.category == "bottle" and bottle.height == bottle.parameters.height


@pytest.mark.parametrize("name", VARIANTS)
def test_radius_aspect_bulge_and_handle_are_the_extents(name):
    """A flat bottle's wide side and the handle are along x; the handle is on the +x side."""
    p = VARIANTS[name]
    low, high = build_bottle(p).mesh.bounds
    widest = p.radius + max(p.bulge, 0)
    ends = np.array([p.handle_bottom, p.handle_top])
    ends = ends[ends < p.shoulder_bottom] / p.shoulder_bottom
    reach = np.max(p.radius + 4 * p.bulge * ends * (1 - ends)) + p.handle_reach + p.handle_thickness / 2
    np.testing.assert_allclose(-low[0], widest, atol=1e-4)  # twelve rings hit no barrel's widest level
    np.testing.assert_allclose(high[0], reach if p.handle else widest, atol=1e-4)
    np.testing.assert_allclose(high[1], max(widest * p.aspect, p.cap_radius * (p.cap_height > 0)), atol=1e-4)


def test_outlines_are_round_flat_or_square():
    for change, expected in (
        ({}, 1.0),
        ({"aspect": 0.5}, np.sqrt(2 / (1 + 1 / 0.5**2))),
        ({"squareness": 6.0}, 2 ** (1 / 2 - 1 / 6)),
        ({"squareness": 6.0, "aspect": 0.5}, np.sqrt(2) / (1 + 0.5**-6) ** (1 / 6)),
    ):
        found = outer(build_bottle(replace(PLAIN, **change)), [0.07], (1, 1))[0]
        np.testing.assert_allclose(found / PLAIN.radius, expected, rtol=1e-3)


@pytest.mark.parametrize("bulge", [0.0, 0.005, -0.007])
def test_the_body_bulges_as_a_parabola_that_ends_at_base_and_shoulder(bulge):
    p = BottleParameters(bulge=bulge, edge_radius=0.0)
    share = np.array([0.001, 0.25, 0.5, 0.75, 0.999])
    found = outer(build_bottle(p), p.shoulder_bottom * share)
    np.testing.assert_allclose(found, p.radius + 4 * bulge * share * (1 - share), atol=6e-5)


def test_the_bottom_edge_is_rounded():
    p = BottleParameters(edge_radius=0.012)
    angle = np.radians([18, 36, 54, 72, 90])  # six rings make the quarter circle
    levels = p.edge_radius * (1 - np.cos(angle))
    np.testing.assert_allclose(
        outer(build_bottle(p), levels), p.radius - p.edge_radius * (1 - np.sin(angle)), atol=2e-5
    )
    base = build_bottle(p).mesh.vertices
    base = base[base[:, 2] < 1e-6 - p.height / 2]
    np.testing.assert_allclose(np.hypot(base[:, 0], base[:, 1]).max(), p.radius - p.edge_radius, atol=1e-6)
    sharp = build_bottle(replace(p, edge_radius=0.0))
    np.testing.assert_allclose(outer(sharp, levels), p.radius, atol=1.1e-5)


@pytest.mark.parametrize("direction, across", [((1, 0), 1.0), ((0, 1), 0.6)])
@pytest.mark.parametrize("style, curve", [("arc", 1.0), ("arc", 2.0), ("arc", 3.0), ("slope", 2.0)])
def test_shoulders_narrow_from_the_bodys_outline_to_the_round_neck(style, curve, direction, across):
    p = BottleParameters(shoulder_style=style, shoulder_curve=curve, aspect=0.6)
    share = np.array([0.001, 0.2, 0.4, 0.6, 0.8, 0.95, 1.0])
    left = {"arc": (1 - share**curve) ** (1 / curve), "slope": (1 + np.cos(np.pi * share)) / 2}[style]
    found = outer(build_bottle(p), p.shoulder_bottom + (p.shoulder_top - p.shoulder_bottom) * share, direction)
    np.testing.assert_allclose(found, p.neck_radius + (across * p.radius - p.neck_radius) * left, atol=1e-4)


@pytest.mark.parametrize("taper", [0.6, 1.0, 1.1])
def test_a_neck_tapers_to_its_top_whether_capped_or_open(taper):
    p = BottleParameters(neck_taper=taper, mouth_depth=0.0, cap_height=0.0)
    levels = np.array([0.171, 0.18, 0.19, 0.2, 0.2199])
    expected = p.neck_radius * (1 + (taper - 1) * (levels - 0.170) / 0.050)
    for direction in ((1, 0), (1, 1), (0, 1)):
        np.testing.assert_allclose(outer(build_bottle(p), levels, direction), expected, atol=2e-5)
    capped = build_bottle(replace(p, cap_height=0.018))
    np.testing.assert_allclose(outer(capped, levels[:4]), expected[:4], atol=2e-5)


@pytest.mark.parametrize("taper", [0.4, 1.0])
def test_a_cap_steps_out_from_the_neck_and_tapers_to_its_bevel(taper):
    p = BottleParameters(cap_taper=taper, cap_radius=0.018, cap_height=0.020)
    bottle = build_bottle(p)
    under, step = outer(bottle, [0.1999, 0.2001])
    np.testing.assert_allclose([under, step], [p.neck_radius, p.cap_radius], atol=1.2e-4)
    share = np.array([0.2, 0.5, 0.85])
    np.testing.assert_allclose(outer(bottle, 0.2 + 0.02 * share), p.cap_radius * (1 + (taper - 1) * share), atol=5e-5)
    top = outer(bottle, [p.height - 1e-6])[0]
    np.testing.assert_allclose(top, p.cap_radius * taper - 0.1 * p.cap_height, atol=5e-5)
    assert on_axis(bottle, [0.15, 0.199, 0.201, 0.2199]).all()  # solid, whatever the depth of the mouth would be


def test_a_cap_is_no_film():
    with pytest.raises(InputError, match="cap_height must be 0 or more than 0.005 of height"):
        build_bottle(BottleParameters(cap_height=2e-5))
    p = BottleParameters(cap_height=1.2e-3)
    np.testing.assert_allclose(build_bottle(p).mesh.bounds[1, 2], p.height / 2, atol=1e-6)


@pytest.mark.parametrize("taper, hole", [(1.0, 0.0105), (0.8, 0.0084), (1.1, 0.0105)])
def test_an_open_mouth_is_as_deep_as_asked_and_narrower_than_the_neck(taper, hole):
    p = BottleParameters(cap_height=0.0, mouth_depth=0.030, neck_taper=taper)
    bottle = build_bottle(p)
    np.testing.assert_array_equal(
        on_axis(bottle, [0.05, 0.1898, 0.1902, 0.2199, 0.2201]), [True, True, False, False, False]
    )
    for level in (0.1905, 0.2199):
        np.testing.assert_allclose(along(bottle, level)[0], hole, atol=1.1e-5)
    assert on_axis(build_bottle(replace(p, mouth_depth=0.0)), [0.1902, 0.2199]).all()


def test_a_handle_is_a_bar_of_its_section_at_its_reach_with_a_hole_for_fingers():
    p = BottleParameters(handle=True)
    bottle, bare = build_bottle(p), build_bottle(replace(p, handle=False))
    middle, bar = (p.handle_top + p.handle_bottom) / 2, p.radius + p.handle_reach
    thick, wide = p.handle_thickness / 2, p.handle_width / 2
    assert at(bottle, bar, 0, middle) and not at(bare, bar, 0, middle)
    for x, y, material in (
        (bar + 0.98 * thick, 0, True),
        (bar + 1.02 * thick, 0, False),
        (bar - 0.97 * thick, 0, True),
        (bar - 1.02 * thick, 0, False),
    ):
        assert at(bottle, x, y, middle) == material
    for side in (-1, 1):
        assert at(bottle, bar, side * 0.97 * wide, middle) and not at(bottle, bar, side * 1.02 * wide, middle)
    assert not at(bottle, p.radius + 0.002, 0, middle)  # between wall and bar
    assert not at(bottle, -bar, 0, middle) and not at(bottle, 0, bar, middle)
    # Arms at the two levels, from the wall to the bar, and nothing above or below them but the flare.
    for level in (p.handle_top, p.handle_bottom):
        for x in np.linspace(p.radius - 0.002, p.radius + 0.010, 5):
            assert at(bottle, x, 0, level)
    for level in (p.handle_top + 1.2 * p.handle_thickness, p.handle_bottom - 1.2 * p.handle_thickness):
        assert not at(bottle, p.radius + 0.005, 0, level)


def test_a_handle_leaves_the_mouth_open():
    bottle = build_bottle(VARIANTS["handle on the neck"])
    np.testing.assert_array_equal(
        on_axis(bottle, [0.189, 0.199, 0.201, 0.21, 0.219]), [True, True, False, False, False]
    )
    assert at(bottle, 0.020, 0, 0.19)  # the upper arm is at the neck
    assert not at(bottle, 0.020, 0, 0.2)


@pytest.mark.parametrize("name", VARIANTS)
def test_places_lie_on_the_axis_the_neck_between_the_shoulders_half_and_the_top(name):
    p = VARIANTS[name]
    bottle = build_bottle(p)
    assert set(bottle.frames) == {"neck", "base", "body"}
    for place in bottle.frames.values():
        np.testing.assert_array_equal(place[:3, :3], np.eye(3))
        np.testing.assert_array_equal(place[:2, 3], 0)
        np.testing.assert_array_equal(place[3], [0, 0, 0, 1])
    neck, base, body = (bottle.frames[name][2, 3] + p.height / 2 for name in ("neck", "base", "body"))
    np.testing.assert_allclose([base, body], [0, p.shoulder_bottom / 2], atol=1e-12)
    begins = 2 * neck - p.height
    assert p.shoulder_bottom < begins < p.shoulder_top
    under, over = outer(bottle, [begins - 5e-4, begins + 5e-4], (-1, 0))  # the side without a handle
    assert over < (p.radius + p.neck_radius) / 2 < under


@pytest.mark.parametrize(
    "change, fold",
    [
        ({}, 0),
        ({"aspect": 0.5}, 2),
        ({"squareness": 6.0}, 4),
        ({"aspect": 0.5, "squareness": 6.0}, 2),
        ({"handle": True}, 1),
        ({"handle": True, "aspect": 0.6}, 1),
        ({"handle": True, "squareness": 6.0}, 1),
    ],
)
def test_the_outline_and_a_handle_decide_the_symmetry(change, fold):
    assert build_bottle(replace(PLAIN, **change)).fold == fold


# ---- sampling ----


def test_sampling_covers_the_family_and_repeats_with_the_seed():
    draws = [sample_bottle(np.random.default_rng(seed)) for seed in range(200)]
    assert draws[:5] == [sample_bottle(np.random.default_rng(seed)) for seed in range(5)]
    assert len(set(draws)) == 200
    heights = np.array([draw.height for draw in draws])
    assert 0.12 <= heights.min() < 0.13 and 0.29 < heights.max() <= 0.30
    for with_it in (
        lambda draw: draw.handle,
        lambda draw: draw.aspect < 1,
        lambda draw: draw.squareness > 2,
        lambda draw: draw.aspect == 1 and draw.squareness == 2 and not draw.handle,
        lambda draw: draw.bulge > 0,
        lambda draw: draw.bulge < 0,
        lambda draw: draw.cap_height > 0,
        lambda draw: draw.cap_height == 0,
        lambda draw: draw.shoulder_style == "arc",
        lambda draw: draw.shoulder_style == "slope",
        lambda draw: draw.neck_taper < 0.9,
        lambda draw: draw.cap_taper < 0.8,
    ):
        assert 0.05 < np.mean([with_it(draw) for draw in draws]) < 0.85
    assert any(draw.handle and draw.aspect < 1 for draw in draws) and any(
        draw.handle and draw.squareness > 2 for draw in draws
    )
    assert any(draw.handle and draw.handle_top > draw.shoulder_bottom for draw in draws)


def test_sampled_bottles_are_built_and_have_every_symmetry():
    bottles = [build_bottle(sample_bottle(np.random.default_rng(seed))) for seed in range(40)]
    assert {bottle.fold for bottle in bottles} == {0, 1, 2, 4}
    for bottle in bottles:
        mesh, p = bottle.mesh, bottle.parameters
        assert mesh.is_watertight and mesh.body_count == 1 and mesh.euler_number == (0 if p.handle else 2)
        np.testing.assert_allclose(mesh.bounds[:, 2], [-p.height / 2, p.height / 2], atol=1e-6)
        assert (mesh.bounds[1, 0] > 0.01 - mesh.bounds[0, 0]) == p.handle  # on the +x side
        # At the neck's place the outside is the neck's, or the cap's.
        width = outer(bottle, [bottle.frames["neck"][2, 3] + p.height / 2], (-1, 0))[0]
        assert width < 1.01 * max((p.radius + p.neck_radius) / 2, p.cap_radius)
    first, second = (build_bottle(sample_bottle(np.random.default_rng(3))) for _ in range(2))
    np.testing.assert_array_equal(first.mesh.vertices, second.mesh.vertices)
    np.testing.assert_array_equal(first.mesh.faces, second.mesh.faces)


# ---- bad input ----


RISE = "expected edge_radius, shoulder_bottom, shoulder_top and height to rise in this order"


@pytest.mark.parametrize("change, message", [
    ({"height": -0.1}, "height is -0.1; expected a positive number"),
    ({"height": "tall"}, "height is 'tall'; expected a positive number"),
    ({"radius": float("nan")}, "radius is nan; expected a positive number"),
    ({"radius": 0.0}, "radius is 0.0; expected a positive number"),
    ({"neck_radius": float("inf")}, "neck_radius is inf"),
    ({"cap_radius": 0.0}, "cap_radius is 0.0"),
    ({"edge_radius": -0.001}, "edge_radius is -0.001; expected one finite number of 0 or more"),
    ({"cap_height": -0.001}, "cap_height is -0.001; expected one finite number of 0 or more"),
    ({"mouth_depth": -0.001}, "mouth_depth is -0.001; expected one finite number of 0 or more"),
    ({"bulge": float("nan")}, "bulge is nan"),
    ({"aspect": 0.34}, "aspect is 0.34; expected 0.35 to 1"),
    ({"aspect": 1.1}, "aspect is 1.1"),
    ({"squareness": 1.9}, "squareness is 1.9; expected 2 (round) to 20 (square)"),
    ({"squareness": 21.0}, "squareness is 21.0"),
    ({"shoulder_style": "dome"}, "shoulder_style is 'dome'; expected one of arc, slope"),
    ({"shoulder_curve": 0.9}, "shoulder_curve is 0.9; expected 1 to 4"),
    ({"shoulder_curve": 4.1}, "shoulder_curve is 4.1"),
    ({"neck_taper": 0.4}, "neck_taper is 0.4; expected 0.5 to 1.1"),
    ({"neck_taper": 1.2}, "neck_taper is 1.2"),
    ({"cap_taper": 0.2}, "cap_taper is 0.2; expected 0.3 to 1.1"),
    ({"cap_taper": 1.2}, "cap_taper is 1.2"),
    ({"shoulder_bottom": 0.18}, RISE),
    ({"shoulder_top": 0.23}, RISE),
    ({"shoulder_bottom": 0.003}, RISE),
    ({"cap_height": 0.0495}, "cap_height must be less than the neck's"),
    ({"bulge": 0.011}, "bulge must be less than 0.3 of radius"),
    ({"bulge": -0.011}, "bulge must be less than 0.3 of radius"),
    ({"edge_radius": 0.033}, "edge_radius must be less than 0.9 of the smaller radius"),
    ({"edge_radius": 0.020, "aspect": 0.6}, "edge_radius must be less than 0.9 of the smaller radius"),
    ({"neck_radius": 0.033}, "neck_radius must be less than 0.9 of the body's smaller radius"),
    ({"aspect": 0.4}, "neck_radius must be less than 0.9 of the body's smaller radius"),
    ({"cap_radius": 0.0139}, "cap_radius must be at least that of the neck within the cap"),
    ({"cap_height": 0.0, "mouth_depth": 0.082}, "mouth_depth must be less than the height of neck and shoulder"),
])  # fmt: skip
def test_bad_dimensions_are_refused_by_name(change, message):
    with pytest.raises(InputError, match=rf"(?s)build_bottle\(\).*{re.escape(message)}"):
        build_bottle(replace(PLAIN, **change))


@pytest.mark.parametrize(
    "change, message",
    [
        ({"handle_reach": -0.01}, "handle_reach is -0.01"),
        ({"handle_width": 0.0}, "handle_width is 0.0"),
        ({"handle_bottom": 0.093}, "handle_top and handle_bottom are too close for the thickness"),
        ({"handle_bottom": 0.126}, "handle_top and handle_bottom are too close"),
        ({"handle_top": 0.218, "cap_height": 0.0}, "the handle does not end inside the bottle"),
        ({"handle_top": 0.230}, "the handle does not end inside the bottle"),
        ({"handle_width": 0.080}, "the handle does not end inside the bottle"),
        (
            {"handle_thickness": 0.0245, "handle_reach": 0.018},
            "the handle bends more tightly than its thickness allows",
        ),
        ({"handle_bottom": 0.014}, "handle_bottom is below the body: raise it"),
        ({"handle_reach": 0.008, "handle_thickness": 0.008}, "the handle leaves no finger hole: raise handle_reach"),
        # A cap as wide as the handle reaches fills its hole.
        (
            {"handle_top": 0.203, "handle_bottom": 0.168, "cap_radius": 0.06, "cap_height": 0.0489},
            "the dimensions give no single closed bottle",
        ),
    ],
)
def test_bad_handles_are_refused_by_name(change, message):
    with pytest.raises(InputError, match=rf"(?s)build_bottle\(\).*{re.escape(message)}"):
        build_bottle(replace(PLAIN, handle=True, **change))


@pytest.mark.parametrize(
    "change",
    [
        {"handle_top": 0.3, "handle_thickness": 0.05},
        {"cap_radius": 0.0139, "cap_height": 0.0},
        {"mouth_depth": 0.3},
    ],
)
def test_dimensions_of_parts_a_bottle_does_not_have_do_not_matter(change):
    mesh = build_bottle(replace(PLAIN, **change)).mesh
    np.testing.assert_allclose(mesh.bounds[1, 0], PLAIN.radius, atol=1e-6)
    assert mesh.euler_number == 2


@pytest.mark.parametrize(
    "change",
    [
        {"aspect": 0.35, "neck_radius": 0.011},
        {"squareness": 20.0},
        {"shoulder_curve": 4.0},
        {"neck_taper": 0.5},
        {"cap_taper": 0.3},
        {"cap_taper": 1.1},
        {"cap_height": 0.0489},
        {"bulge": 0.0107},
        {"bulge": -0.0107},
        {"edge_radius": 0.0323},
        {"neck_radius": 0.0324, "cap_radius": 0.0324},
        {"cap_height": 0.0, "mouth_depth": 0.0809},
        {"shoulder_top": 0.1301},
        {"handle": True, "handle_bottom": 0.0155},
    ],
)
def test_dimensions_at_the_ends_of_their_ranges_are_built(change):
    bottle = build_bottle(replace(PLAIN, **change))
    assert bottle.mesh.is_watertight and bottle.mesh.body_count == 1
    assert bottle.mesh.euler_number == (0 if "handle" in change else 2)


@pytest.mark.parametrize("handle", ["no", 2, None])
def test_a_handle_is_there_or_not(handle):
    with pytest.raises(InputError, match="handle is .*; expected True or False"):
        build_bottle(BottleParameters(handle=handle))


def test_a_cap_is_no_narrower_than_the_neck_it_sits_on():
    with pytest.raises(InputError, match="cap_radius must be at least that of the neck within the cap"):
        build_bottle(BottleParameters(neck_taper=0.5, cap_radius=0.0075))
