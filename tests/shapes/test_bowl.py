"""The bowl family: closed meshes of given dimensions, places on the material, and the range of sampled dimensions."""

import re
from dataclasses import replace

import numpy as np
import pytest

from tdf_jax._internal.errors import InputError
from tdf_jax.shapes import BowlParameters, build_bowl, sample_bowl

PLAIN = BowlParameters()
VARIANTS = {
    "plain": PLAIN,
    "oval": BowlParameters(aspect=0.65),
    "square": BowlParameters(squareness=6.0),
    "rectangle": BowlParameters(aspect=0.8, squareness=4.0, curve=3.0),
    "foot": BowlParameters(foot_height=0.008, base_radius=0.030),
    "flared": BowlParameters(rim_flare=0.008),
    "drawn in": BowlParameters(rim_flare=-0.006, lip_radius=0.001),
    "flared on a foot": BowlParameters(rim_flare=0.006, foot_height=0.010),
    "cone": BowlParameters(curve=1.0),
    "steep": BowlParameters(curve=4.0),
    "sharp": BowlParameters(lip_radius=0.0),
}


def material_along(bowl, level, direction=(1.0, 0.0)):
    """Distances from the axis, 5e-6 m apart, that are material at a level above the base."""
    reach = np.arange(0, 0.1, 5e-6)
    flat = reach[:, None] * np.array(direction) / np.linalg.norm(direction)
    return reach[bowl.contains(np.column_stack([flat, np.full(len(reach), level - bowl.height / 2)]))]


def outer(bowl, levels, direction=(1.0, 0.0)):
    """Radius of the outside at levels above the base."""
    return np.array([material_along(bowl, level, direction)[-1] for level in levels])


def below_the_rim(p, count=5):
    """Levels of the side between the floor and the rounding of the rim."""
    return np.linspace(p.foot_height + p.bottom_thickness, 0.92 * p.height, count)


@pytest.mark.parametrize("name", VARIANTS)
def test_every_variant_is_one_closed_bowl_that_stands_on_its_base(name):
    bowl = build_bowl(VARIANTS[name])
    mesh = bowl.mesh
    assert mesh.is_watertight and mesh.is_winding_consistent and mesh.volume > 0
    assert mesh.body_count == 1 and mesh.euler_number == 2  # no hole through it
    np.testing.assert_allclose(mesh.bounds[:, :2].sum(axis=0), 0, atol=1e-9)  # the axis is in the middle
    np.testing.assert_allclose(mesh.bounds[:, 2], [-bowl.height / 2, bowl.height / 2], atol=1e-6)
    assert bowl.category == "bowl" and bowl.height == bowl.parameters.height


@pytest.mark.parametrize("name", VARIANTS)
def test_radius_flare_and_aspect_are_the_extents_of_a_sharp_rim(name):
    """A lip narrows the uppermost ring; without it the rim is as wide as the parameters, with the long side along x."""
    p = replace(VARIANTS[name], lip_radius=0.0)
    bowl = build_bowl(p)
    np.testing.assert_allclose(outer(bowl, [p.height - 1e-6]), p.radius + p.rim_flare, atol=2e-5)
    low, high = bowl.mesh.bounds
    if p.rim_flare >= 0:
        np.testing.assert_allclose(high[0], p.radius + p.rim_flare, atol=1e-6)
    else:
        assert p.radius + p.rim_flare < high[0] < p.radius  # widest below the rim
    np.testing.assert_allclose(high[1], p.aspect * high[0], atol=1e-6)
    np.testing.assert_allclose(low[:2], -high[:2], atol=1e-6)


@pytest.mark.parametrize("name", VARIANTS)
def test_the_wall_is_as_thick_as_asked_across_it(name):
    """Inwards from the outside along its normal: material up to the thickness, air from there on."""
    p = replace(VARIANTS[name], lip_radius=0.0)
    bowl, levels, step = build_bowl(p), below_the_rim(p), 2e-4
    radius = outer(bowl, levels)
    slope = (outer(bowl, levels + step) - outer(bowl, levels - step)) / (2 * step)
    inward = np.stack([-np.ones_like(slope), np.zeros_like(slope), slope], axis=1) / np.hypot(1, slope)[:, None]
    surface = np.stack([radius, np.zeros_like(radius), levels - p.height / 2], axis=1)
    for share, material in ((0.02, True), (0.5, True), (0.97, True), (1.03, False), (1.5, False)):
        np.testing.assert_array_equal(
            bowl.contains(surface + share * p.wall_thickness * inward), material, err_msg=f"{share}"
        )


@pytest.mark.parametrize("change", [
    {"rim_flare": -0.006},
    {"rim_flare": -0.012, "height": 0.040},  # leaning in by more than 45 degrees
    {"rim_flare": -0.018, "height": 0.030},  # by 80
])  # fmt: skip
def test_a_drawn_in_rim_has_the_walls_thickness_and_a_top(change):
    p = BowlParameters(**change, lip_radius=0.0018)
    bowl = build_bowl(p)
    np.testing.assert_allclose(bowl.mesh.bounds[1, 2], p.height / 2, atol=1e-6)
    assert bowl.contains(bowl.frames["rim"][None, :3, 3] - [0, 0, 1e-5]).all()
    sharp = build_bowl(replace(p, lip_radius=0.0))
    low, high = outer(sharp, [p.height - 4e-4, p.height - 1e-4])
    across = np.ptp(material_along(sharp, p.height - 1e-4)) / np.hypot(1, (low - high) / 3e-4)
    np.testing.assert_allclose(across, p.wall_thickness, rtol=0.1)


def test_a_wall_of_an_oval_is_thinner_along_y_as_its_aspect():
    bowl = build_bowl(BowlParameters(aspect=0.65))
    for level in (0.02, 0.035, 0.05):
        along_x, along_y = material_along(bowl, level), material_along(bowl, level, (0, 1))
        np.testing.assert_allclose(along_y[[0, -1]], 0.65 * along_x[[0, -1]], atol=1e-5)


def test_outlines_are_round_oval_or_square():
    """Where the outside crosses a diagonal, at the level where it is widest."""
    level, diagonal = 0.0584, (1.0, 1.0)
    radius = outer(build_bowl(PLAIN), [level])[0]
    for change, expected in (
        ({}, 1.0),
        ({"aspect": 0.65}, np.sqrt(2 / (1 + 1 / 0.65**2))),
        ({"squareness": 6.0}, 2 ** (1 / 2 - 1 / 6)),
        ({"squareness": 6.0, "aspect": 0.65}, np.sqrt(2) / (1 + 0.65**-6) ** (1 / 6)),
    ):
        found = outer(build_bowl(replace(PLAIN, **change)), [level], diagonal)[0]
        np.testing.assert_allclose(found / radius, expected, rtol=1e-3)


@pytest.mark.parametrize("foot", [0.0, 0.008])
def test_the_side_is_a_cone_an_ellipse_or_steeper_above_the_foot(foot):
    share = np.array([0.1, 0.3, 0.5, 0.7, 0.9])
    for curve in (1.0, 2.0, 4.0):
        p = BowlParameters(curve=curve, foot_height=foot, lip_radius=0.0)
        radius = outer(build_bowl(p), foot + (p.height - foot) * share)
        out = (radius - p.base_radius) / (p.radius - p.base_radius)
        np.testing.assert_allclose(out**curve + (1 - share) ** curve, 1, atol=3e-3)


@pytest.mark.parametrize("flare", [0.008, -0.006])
@pytest.mark.parametrize("foot", [0.0, 0.008])
def test_only_the_uppermost_fifth_of_the_side_is_turned_out_or_drawn_in(flare, foot):
    p = BowlParameters(foot_height=foot, lip_radius=0.0)
    share = np.array([0.2, 0.5, 0.79, 0.9, 0.999])
    levels = foot + (p.height - foot) * share
    turned = outer(build_bowl(replace(p, rim_flare=flare)), levels) - outer(build_bowl(p), levels)
    np.testing.assert_allclose(turned[:3], 0, atol=5e-5)
    np.testing.assert_allclose(turned[3:], [flare / 4, flare], atol=0.02 * abs(flare))


def test_foot_recess_and_floor_are_where_the_parameters_say():
    p = BowlParameters(foot_height=0.008, foot_width=0.006, bottom_thickness=0.004, base_radius=0.030)
    bowl = build_bowl(p)
    # On the axis: recess up to 0.008, floor up to 0.012, then the hollow, also above the rim.
    levels = np.array([0.001, 0.0078, 0.0082, 0.0118, 0.0122, 0.05, 0.059, 0.07]) - p.height / 2
    axis = np.column_stack([np.zeros((8, 2)), levels])
    np.testing.assert_array_equal(bowl.contains(axis), [False, False, True, True, False, False, False, False])
    for level in (0.0005, 0.004, 0.0075):  # the ring the bowl stands on
        np.testing.assert_allclose(material_along(bowl, level)[[0, -1]], [0.024, 0.030], atol=1.1e-5)
    flat = build_bowl(replace(p, foot_height=0.0))
    levels = np.array([0.0001, 0.0038, 0.0042]) - p.height / 2
    np.testing.assert_array_equal(flat.contains(np.column_stack([np.zeros((3, 2)), levels])), [True, True, False])
    ring = flat.mesh.vertices[flat.mesh.vertices[:, 2] < 1e-6 - p.height / 2]
    np.testing.assert_allclose(np.hypot(ring[:, 0], ring[:, 1]).max(), p.base_radius, atol=1e-6)


def test_the_lip_rounds_both_edges_of_the_rim():
    p = BowlParameters(lip_radius=0.0019)
    rounded, sharp = build_bowl(p), build_bowl(replace(p, lip_radius=0.0))
    below = np.array([0.0002, 0.0006, 0.0012])
    back = p.lip_radius - np.sqrt(p.lip_radius**2 - (p.lip_radius - below) ** 2)
    for depth, inset in zip(below, back, strict=True):
        edges, before = (material_along(bowl, p.height - depth)[[0, -1]] for bowl in (rounded, sharp))
        np.testing.assert_allclose(before, [p.radius - p.wall_thickness, p.radius], atol=5e-5)
        np.testing.assert_allclose(edges - before, [inset, -inset], atol=8e-5)  # six rings make the quarter circle


@pytest.mark.parametrize("name", VARIANTS)
def test_places_are_the_rims_top_on_the_x_side_and_two_points_of_the_axis(name):
    p = replace(VARIANTS[name], lip_radius=0.0)
    bowl = build_bowl(p)
    assert set(bowl.frames) == {"rim", "base", "body"}
    for place in bowl.frames.values():
        np.testing.assert_array_equal(place[:3, :3], np.eye(3))  # x outward, z up
    rim, base, body = (bowl.frames[name][:3, 3] for name in ("rim", "base", "body"))
    np.testing.assert_array_equal(base, [0, 0, -p.height / 2])
    np.testing.assert_array_equal(body, [0, 0, 0])
    top = material_along(bowl, p.height - 1e-6)
    np.testing.assert_allclose(rim, [(top[0] + top[-1]) / 2, 0, p.height / 2], atol=2e-5)
    rounded = build_bowl(replace(p, lip_radius=0.3 * p.wall_thickness))
    np.testing.assert_allclose(rounded.frames["rim"], bowl.frames["rim"], atol=1e-9)
    np.testing.assert_array_equal(rounded.contains(rim + np.array([[0, 0, -1e-5], [0, 0, 1e-5]])), [True, False])


# ---- sampling ----


def test_sampling_covers_the_family_and_repeats_with_the_seed():
    draws = [sample_bowl(np.random.default_rng(seed)) for seed in range(200)]
    assert draws[:5] == [sample_bowl(np.random.default_rng(seed)) for seed in range(5)]
    assert len(set(draws)) == 200
    diameters = np.array([2 * draw.radius for draw in draws])
    assert 0.10 <= diameters.min() < 0.11 and 0.21 < diameters.max() <= 0.22
    depths = np.array([draw.height for draw in draws]) / diameters
    assert depths.min() < 0.27 and depths.max() > 0.65
    for with_it in (
        lambda draw: draw.foot_height > 0,
        lambda draw: draw.rim_flare > 0,
        lambda draw: draw.rim_flare < 0,
        lambda draw: draw.rim_flare == 0,
        lambda draw: draw.aspect < 1,
        lambda draw: draw.squareness > 2,
        lambda draw: draw.curve > 3,
        lambda draw: draw.curve < 1.3,
    ):
        assert 0.05 < np.mean([with_it(draw) for draw in draws]) < 0.8


def test_sampled_bowls_are_built_and_have_every_symmetry():
    bowls = [build_bowl(sample_bowl(np.random.default_rng(seed))) for seed in range(24)]
    assert {bowl.fold for bowl in bowls} == {0, 2, 4}
    for bowl in bowls:
        assert bowl.mesh.is_watertight and bowl.mesh.body_count == 1 and bowl.mesh.euler_number == 2
        # Held above the rim's middle a gripper is in the air; a tenth of the wall below it, in the material.
        rim = bowl.frames["rim"][:3, 3]
        below = 0.1 * bowl.parameters.wall_thickness
        np.testing.assert_array_equal(bowl.contains(rim + np.array([[0, 0, -below], [0, 0, 1e-5]])), [True, False])
    first, second = (build_bowl(sample_bowl(np.random.default_rng(3))) for _ in range(2))
    np.testing.assert_array_equal(first.mesh.vertices, second.mesh.vertices)
    np.testing.assert_array_equal(first.mesh.faces, second.mesh.faces)


# ---- bad input ----


@pytest.mark.parametrize(
    "change, message",
    [
        ({"height": -0.1}, "height is -0.1; expected a positive number"),
        ({"height": 0.0}, "height is 0.0; expected a positive number"),
        ({"height": "tall"}, "height is 'tall'; expected a positive number"),
        ({"radius": float("nan")}, "radius is nan; expected a positive number"),
        ({"radius": float("inf")}, "radius is inf"),
        ({"wall_thickness": 0.0}, "wall_thickness is 0.0"),
        ({"bottom_thickness": 0.0}, "bottom_thickness is 0.0"),
        ({"base_radius": -0.01}, "base_radius is -0.01"),
        ({"foot_height": -0.001}, "foot_height is -0.001; expected one finite number of 0 or more"),
        ({"foot_width": 0.0}, "foot_width is 0.0"),
        ({"lip_radius": -0.001}, "lip_radius is -0.001"),
        ({"aspect": 0.39}, "aspect is 0.39; expected 0.4 to 1"),
        ({"aspect": 1.01}, "aspect is 1.01"),
        ({"squareness": 1.9}, "squareness is 1.9; expected 2 (round) to 20 (square)"),
        ({"squareness": 21.0}, "squareness is 21.0"),
        ({"curve": 0.9}, "curve is 0.9; expected 1 to 6"),
        ({"curve": 6.1}, "curve is 6.1"),
        ({"rim_flare": float("nan")}, "rim_flare is nan"),
        ({"rim_flare": 0.019}, "rim_flare must be less than a quarter of radius"),
        ({"rim_flare": -0.019}, "rim_flare must be less than a quarter of radius"),
        ({"rim_flare": -0.018, "base_radius": 0.054}, "base_radius leaves no room"),
        ({"base_radius": 0.072}, "base_radius must be less than 0.95 of radius"),
        ({"base_radius": 0.0711}, "base_radius leaves no room for the wall"),
        ({"lip_radius": 0.002}, "lip_radius must be less than half of wall_thickness"),
        ({"bottom_thickness": 0.035}, "the bottom is too thick for the height"),
        ({"foot_height": 0.030}, "the bottom is too thick for the height"),
        ({"foot_height": 0.003, "foot_width": 0.029}, "foot_width leaves no recess"),
        ({"wall_thickness": 0.019}, "wall_thickness must be less than a quarter of the smaller radius"),
        ({"wall_thickness": 0.012, "aspect": 0.6}, "wall_thickness must be less than a quarter of the smaller radius"),
    ],
)
def test_bad_dimensions_are_refused_by_name(change, message):
    with pytest.raises(InputError, match=rf"(?s)build_bowl\(\).*{re.escape(message)}"):
        build_bowl(replace(PLAIN, **change))


@pytest.mark.parametrize(
    "change",
    [
        {"aspect": 0.4},
        {"squareness": 20.0},
        {"curve": 6.0},
        {"rim_flare": 0.0187},
        {"rim_flare": -0.0187, "lip_radius": 0.0},
        {"base_radius": 0.0709},
        {"wall_thickness": 0.0187},
        {"foot_height": 0.003, "foot_width": 0.0287},
        {"bottom_thickness": 0.001},
    ],
)
def test_dimensions_at_the_ends_of_their_ranges_are_built(change):
    mesh = build_bowl(replace(PLAIN, **change)).mesh
    assert mesh.is_watertight and mesh.body_count == 1 and mesh.euler_number == 2
