"""Generated objects: closed meshes, ground truth frames, an exact inside test, true symmetries; and the mug family."""

import re
import subprocess
import sys
from dataclasses import asdict, replace

import numpy as np
import pytest

from tdf_jax._internal.errors import InputError
from tdf_jax.shapes import (
    FAMILIES,
    HANDLE_STYLES,
    BottleParameters,
    BowlParameters,
    ContainerParameters,
    MugParameters,
    RackParameters,
    build_mug,
    sample_mug,
    scaled,
)

VARIANTS = [
    MugParameters(),
    MugParameters(squareness=6.0, foot_height=0.003, handle_squareness=5.0),
    MugParameters(top_radius=0.048, bottom_radius=0.032, edge_radius=0.018),
    MugParameters(bulge=0.007, wall_thickness=0.003, lip_radius=0.0, handle_flare=1.5),
    MugParameters(bulge=-0.004, edge_radius=0.0, foot_height=0.002),
]


PARAMETERS = {
    "mug": MugParameters,
    "bowl": BowlParameters,
    "bottle": BottleParameters,
    "rack": RackParameters,
    "container": ContainerParameters,
}
OTHERS = ("bowl", "bottle", "rack", "container")  # families whose own tests are elsewhere


def sampled(seed, category="mug"):
    family = FAMILIES[category]
    return family.build(family.sample(np.random.default_rng(seed)))


def winding_numbers(mesh, points):
    """Sum of the signed solid angles of all triangles over 4 pi: 1 inside, 0 outside; no formula of a family in it."""
    found = []
    for few in np.array_split(points, -(-len(points) // 16)):  # a bowl has 17000 triangles
        a, b, c = np.moveaxis(mesh.triangles[None] - few[:, None, None], 2, 0)
        la, lb, lc = (np.linalg.norm(side, axis=-1) for side in (a, b, c))
        volume = np.sum(a * np.cross(b, c), axis=-1)
        spread = la * lb * lc + np.sum(a * b, -1) * lc + np.sum(b * c, -1) * la + np.sum(c * a, -1) * lb
        found.append(np.sum(np.arctan2(volume, spread), axis=1) / (2 * np.pi))
    return np.concatenate(found)


def turned(points, angle):
    """Points turned about z."""
    cos, sin = np.cos(angle), np.sin(angle)
    return points @ np.array([[cos, sin, 0], [-sin, cos, 0], [0, 0, 1]])


def surface_samples(mesh, rng, count):
    faces = rng.choice(len(mesh.faces), count, p=mesh.area_faces / mesh.area)
    points = np.einsum("pk,pki->pi", rng.dirichlet(np.ones(3), count), mesh.triangles[faces])
    return points, mesh.face_normals[faces]


def assert_one_closed_body(mesh, holes):
    assert mesh.is_watertight and mesh.is_winding_consistent
    assert mesh.volume > 0
    assert mesh.body_count == 1
    assert mesh.euler_number == 2 - 2 * holes


def assert_one_closed_cup(mesh):
    assert_one_closed_body(mesh, holes=1)  # the finger hole, and no other


# ---- every family ----


def test_the_first_place_of_a_family_is_where_a_demonstration_picks_it_or_puts_something():
    """The order is that of the places in data sets, too."""
    places = {category: family.places for category, family in FAMILIES.items()}
    assert places == {
        "mug": ("handle", "rim", "base"),
        "bowl": ("rim", "base", "body"),
        "bottle": ("neck", "base", "body"),
        "rack": ("peg", "post", "base"),
        "container": ("floor", "opening", "base"),
    }


@pytest.mark.parametrize("category", FAMILIES)
def test_a_family_builds_its_category_with_its_places_in_a_frame_that_stands_upright(category):
    family = FAMILIES[category]
    assert family.build().parameters == PARAMETERS[category]()
    for seed in range(4):
        shape = sampled(seed, category)
        assert shape.category == category and shape.height == shape.parameters.height
        assert_one_closed_body(
            shape.mesh, holes={"mug": 1, "bottle": int(getattr(shape.parameters, "handle", False))}.get(category, 0)
        )
        np.testing.assert_allclose(shape.mesh.bounds[0, 2], -shape.height / 2, atol=1e-6)
        np.testing.assert_array_equal(shape.axis, [0, 0, 1])
        assert len(family.places) == 3 and set(shape.frames) == set(family.places)
        for name, frame in shape.frames.items():
            np.testing.assert_allclose(frame[:3, :3] @ frame[:3, :3].T, np.eye(3), atol=1e-12)
            np.testing.assert_allclose(np.linalg.det(frame[:3, :3]), 1.0, atol=1e-12)
            if name != "peg":  # it is tilted
                np.testing.assert_array_equal(frame[:3, 2], [0, 0, 1])
            np.testing.assert_array_equal(frame[3], [0, 0, 0, 1])


@pytest.mark.slow
@pytest.mark.parametrize("category, seed", [(category, seed) for category in OTHERS for seed in range(3)])
def test_contains_of_every_family_agrees_with_the_winding_number_of_the_mesh(category, seed):
    """Points keep 2e-4 m from the surface: a bottle's mesh splits the quadrilaterals of its shoulder into triangles."""
    shape, rng = sampled(100 + seed, category), np.random.default_rng(seed)
    low, high = shape.mesh.bounds
    surface, normals = surface_samples(shape.mesh, rng, 60)
    away = rng.choice([-1, 1], 60)[:, None] * rng.uniform(2e-4, 1.5e-3, (60, 1)) * normals
    points = np.concatenate([rng.uniform(low - 0.005, high + 0.005, (60, 3)), surface + away])
    inside = winding_numbers(shape.mesh, points) > 0.5
    assert 20 < inside.sum() < 100
    np.testing.assert_array_equal(shape.contains(points), inside)


@pytest.mark.parametrize("category, seed", [(category, seed) for category in OTHERS for seed in range(8)])
def test_contains_of_every_family_switches_at_the_surface(category, seed):
    shape = sampled(200 + seed, category)
    same_shape_all_the_way_up = category != "bottle" or (
        shape.parameters.aspect == 1 and shape.parameters.squareness == 2
    )
    step = 1e-6 if same_shape_all_the_way_up and not getattr(shape.parameters, "handle", False) else 1e-4
    points, normals = surface_samples(shape.mesh, np.random.default_rng(seed), 3000)
    wrong = ~shape.contains(points - step * normals) | shape.contains(points + step * normals)
    assert wrong.mean() <= 0.001  # a sample within a step of an edge may cross the other face


@pytest.mark.parametrize("category", ["bowl", "bottle"])
def test_contains_of_every_family_measures_the_volume_of_the_mesh(category):
    shape, rng = sampled(7, category), np.random.default_rng(0)
    low, high = shape.mesh.bounds
    share = shape.contains(rng.uniform(low, high, (200_000, 3))).mean()
    np.testing.assert_allclose(share * np.prod(high - low), shape.mesh.volume, rtol=0.02)


SYMMETRIC = [
    ("mug", {}, 1),
    ("mug", {"squareness": 5.0, "foot_height": 0.003}, 1),
    ("bowl", {}, 0),
    ("bowl", {"foot_height": 0.008, "rim_flare": 0.006}, 0),
    ("bowl", {"aspect": 0.7}, 2),
    ("bowl", {"squareness": 5.0, "foot_height": 0.008}, 4),
    ("bowl", {"squareness": 5.0, "aspect": 0.7}, 2),
    ("bottle", {}, 0),
    ("bottle", {"cap_height": 0.0, "bulge": 0.005, "shoulder_style": "slope"}, 0),
    ("bottle", {"aspect": 0.6}, 2),
    ("bottle", {"squareness": 5.0, "cap_height": 0.0}, 4),
    ("bottle", {"squareness": 5.0, "aspect": 0.6}, 2),
    ("bottle", {"handle": True}, 1),
    ("bottle", {"handle": True, "aspect": 0.6}, 1),
    ("bottle", {"handle": True, "squareness": 5.0}, 1),
    ("rack", {}, 1),
    ("rack", {"second_length": 0.085}, 2),
    ("rack", {"second_length": 0.085, "base_outline": "square", "base_width": 0.11, "post_outline": "square"}, 2),
    ("rack", {"second_length": 0.030}, 1),
    ("rack", {"second_length": 0.085, "second_tilt": 0.0}, 1),
    ("rack", {"second_length": 0.085, "second_height": 0.2}, 1),
    ("rack", {"second_length": 0.085, "second_angle": 2.5}, 1),
    ("rack", {"second_length": 0.085, "base_offset": 0.03}, 1),
    ("container", {}, 4),
    ("container", {"taper": 0.8, "rim_width": 0.01}, 4),
    ("container", {"style": "round", "taper": 0.8, "rim_width": 0.01}, 0),
    ("container", {"length": 0.16}, 2),
    ("container", {"style": "round", "length": 0.16}, 2),
    ("container", {"style": "shelf", "corner_radius": 0.0}, 1),
]


@pytest.mark.parametrize("category, change, fold", SYMMETRIC)
def test_the_fold_is_the_symmetry_of_the_solid(category, change, fold):
    """Turned by what its symmetry allows an object is itself, and by half of that it is not."""
    shape = FAMILIES[category].build(replace(PARAMETERS[category](), **change))
    assert shape.fold == fold
    rng, reach = np.random.default_rng(0), np.abs(shape.mesh.bounds).max(axis=0)
    reach[:2] = reach[:2].max()
    points = rng.uniform(-reach, reach, (20_000, 3))
    inside = shape.contains(points)

    def differs(angle):
        return np.sum(shape.contains(turned(points, angle)) != inside) / inside.sum()

    for number in (1, 2, 3):
        assert differs(number * 2 * np.pi / (fold or 64)) == 0  # the outline of a round one is a polygon of 64 corners
    if fold:
        assert differs(np.pi / fold) > 0.02
    else:
        # between corners: a bowl's wall is thin
        assert max(differs(angle) for angle in rng.uniform(-np.pi, np.pi, 4)) < 0.03


@pytest.mark.parametrize(
    "category, seeds",
    [("mug", range(3)), ("bowl", range(12)), ("bottle", range(20)), ("rack", range(4)), ("container", range(16))],
)
def test_folds_of_sampled_objects_are_their_symmetries(category, seeds):
    folds = set()
    for seed in seeds:
        shape = sampled(seed, category)
        folds.add(shape.fold)
        reach = np.abs(shape.mesh.bounds).max(axis=0)
        points = np.random.default_rng(seed).uniform(-reach, reach, (5_000, 3))
        inside = shape.contains(points)
        again = shape.contains(turned(points, 2 * np.pi / (shape.fold or 64)))
        np.testing.assert_array_equal(again, inside)
        if shape.fold:
            assert np.mean(shape.contains(turned(points, np.pi / shape.fold)) != inside) > 0.01 * inside.mean()
    assert folds == {"mug": {1}, "bowl": {0, 2, 4}, "rack": {1, 2}}.get(category, {0, 1, 2, 4})


NO_LENGTHS = {
    "mug": {"squareness", "handle_style", "handle_squareness", "handle_flare"},
    "bowl": {"aspect", "squareness", "curve"},
    "bottle": {"aspect", "squareness", "shoulder_style", "shoulder_curve", "neck_taper", "cap_taper", "handle"},
    "rack": {"base_outline", "post_outline", "peg_tilt", "second_tilt", "second_angle"},
    "container": {"style", "taper"},
}


@pytest.mark.parametrize("category, change", [
    ("bowl", {"aspect": 0.7, "foot_height": 0.006, "rim_flare": 0.005, "curve": 2.5}),
    ("bottle", {"handle": True, "squareness": 4.0, "bulge": 0.002, "cap_height": 0.0, "neck_taper": 0.9}),
    ("rack", {"second_length": 0.085, "post_outline": "square"}),
    ("container", {"taper": 0.8, "rim_width": 0.01}),
])  # fmt: skip
@pytest.mark.parametrize("factor", [0.4, 3.0])
def test_scaled_keeps_the_shape_of_every_family(category, change, factor):
    family, rng = FAMILIES[category], np.random.default_rng(0)
    shape = family.build(replace(PARAMETERS[category](), **change))
    other = scaled(shape, factor)
    assert type(other) is type(shape) and other.fold == shape.fold and other.category == category
    np.testing.assert_allclose(other.height, factor * shape.height)
    np.testing.assert_allclose(other.mesh.vertices, factor * shape.mesh.vertices, rtol=1e-9)
    np.testing.assert_array_equal(other.mesh.faces, shape.mesh.faces)
    assert list(other.frames) == list(shape.frames)
    for name, frame in shape.frames.items():
        np.testing.assert_allclose(other.frames[name][:3, 3], factor * frame[:3, 3], rtol=1e-12)
        np.testing.assert_array_equal(other.frames[name][:3, :3], frame[:3, :3])
        np.testing.assert_array_equal(other.frames[name][3], [0, 0, 0, 1])
    after = asdict(other.parameters)
    for name, value in asdict(shape.parameters).items():
        assert after[name] == (value if name in NO_LENGTHS[category] else value * factor), name
    points = rng.uniform(*1.1 * shape.mesh.bounds, (20_000, 3))
    assert np.mean(other.contains(factor * points) == shape.contains(points)) > 0.9999
    again = family.build(other.parameters)
    np.testing.assert_allclose(again.mesh.volume, other.mesh.volume, rtol=1e-4)
    for name, frame in again.frames.items():
        np.testing.assert_allclose(frame, other.frames[name], atol=1e-9)


# ---- mugs ----


@pytest.mark.parametrize("style", HANDLE_STYLES)
@pytest.mark.parametrize("parameters", VARIANTS)
def test_every_style_is_one_closed_cup_whose_grip_is_solid(style, parameters):
    mug = build_mug(replace(parameters, handle_style=style))
    assert_one_closed_cup(mug.mesh)
    grip = mug.handle_frame[:3, 3]
    assert mug.contains(grip[None]).all()
    # A bar's thickness beyond the grip is air on both sides: outside the mug, and in the finger hole.
    assert not mug.contains(grip + np.array([[1.0, 0, 0], [-1.0, 0, 0]]) * parameters.handle_thickness).any()


@pytest.mark.parametrize("seed", range(8))
def test_sampled_mugs_are_closed_cups_of_real_size(seed):
    mug = sampled(seed)
    assert_one_closed_cup(mug.mesh)
    low, high = mug.mesh.bounds
    assert 0.07 <= mug.parameters.height <= 0.13
    np.testing.assert_allclose(low[2], -mug.parameters.height / 2, atol=1e-6)  # it stands on its bottom
    assert high[2] <= 0.65 * mug.parameters.height  # a ring or an ear may rise above the rim
    assert high[0] > -low[0] + 0.01  # the handle is on the +x side
    np.testing.assert_allclose(high[1], -low[1], atol=1e-6)


def test_sampling_covers_the_family_and_repeats_with_the_seed():
    draws = [sample_mug(np.random.default_rng(seed)) for seed in range(60)]
    assert draws[:5] == [sample_mug(np.random.default_rng(seed)) for seed in range(5)]
    assert len(set(draws)) == 60
    assert {draw.handle_style for draw in draws} == set(HANDLE_STYLES)
    assert any(draw.squareness > 2 for draw in draws) and any(draw.squareness == 2 for draw in draws)
    assert any(draw.bulge > 0 for draw in draws) and any(draw.bulge < 0 for draw in draws)
    assert any(draw.foot_height > 0 for draw in draws)
    first, second = sampled(3), sampled(3)
    np.testing.assert_array_equal(first.mesh.vertices, second.mesh.vertices)
    np.testing.assert_array_equal(first.mesh.faces, second.mesh.faces)


@pytest.mark.parametrize("squareness", [2.0, 8.0])
def test_the_mesh_has_the_dimensions_it_was_asked_for(squareness):
    parameters = MugParameters(squareness=squareness, handle_flare=1.0)
    low, high = build_mug(parameters).mesh.bounds
    reach = parameters.handle_reach + parameters.handle_thickness / 2
    level = parameters.handle_top / parameters.height
    at_handle = parameters.bottom_radius + level * (parameters.top_radius - parameters.bottom_radius)
    np.testing.assert_allclose([low[2], high[2]], [-0.05, 0.05], atol=1e-6)
    np.testing.assert_allclose(high[0], at_handle + reach, atol=1e-4)  # 30 rings cut the bends
    np.testing.assert_allclose(high[1], 0.041, atol=1e-4)  # the lip draws back just where the cup is widest


def test_a_square_mug_is_square():
    parameters = MugParameters(squareness=20.0)
    corner = np.array([[-0.0385, 0.0385, 0.0]])
    assert build_mug(parameters).contains(corner).all()
    assert not build_mug(replace(parameters, squareness=2.0)).contains(corner).any()


def test_floor_wall_foot_and_cavity_are_where_the_parameters_say():
    p = MugParameters(foot_height=0.004)
    mug = build_mug(p)
    bottom = -p.height / 2
    levels = bottom + np.array([0.002, 0.0042, 0.0088, 0.0092, 0.06, 0.0999])  # recess to 0.004, floor to 0.009, cavity
    axis = np.stack([np.zeros(6), np.zeros(6), levels], axis=1)
    np.testing.assert_array_equal(mug.contains(axis), [False, True, True, False, False, False])
    x = -np.array([0.0362, 0.0367, 0.0403, 0.0407])  # the wall at half height spans 0.0365 to 0.0405
    wall = np.stack([x, np.zeros(4), np.zeros(4)], axis=1)
    np.testing.assert_array_equal(mug.contains(wall), [False, True, True, False])
    ring = np.array([[-0.0315, 0, bottom + 0.001], [-0.0285, 0, bottom + 0.001]])  # foot: 0.029 to 0.034 and more
    np.testing.assert_array_equal(mug.contains(ring), [True, False])


@pytest.mark.parametrize("style", HANDLE_STYLES)
def test_the_handle_merges_with_the_wall_and_stays_out_of_the_cavity(style):
    p = MugParameters(handle_style=style, handle_thickness=0.012, handle_flare=1.5)
    mug = build_mug(p)
    for level in (p.handle_top, p.handle_bottom):
        outer = p.bottom_radius + (p.top_radius - p.bottom_radius) * level / p.height
        x = np.linspace(outer - p.wall_thickness + 1e-4, outer + 0.003, 50)  # through the wall into the handle
        inside = mug.contains(np.stack([x, np.zeros(50), np.full(50, level - p.height / 2)], axis=1))
        assert inside.all()
    vertices = mug.mesh.vertices
    radius = np.hypot(vertices[:, 0], vertices[:, 1])
    in_cavity = (vertices[:, 2] > p.bottom_thickness + 0.003 - p.height / 2) & (radius < 0.0358)
    assert not in_cavity.any()  # the inner wall starts at 0.0359 there


def test_flare_thickens_the_handle_at_the_wall_only():
    plain = MugParameters(handle_thickness=0.010, handle_flare=1.0)
    flared = replace(plain, handle_flare=1.5)
    above = np.array([[0.0415, 0, plain.handle_top + 0.0060 - plain.height / 2]])  # half thickness 0.005, flared 0.0075
    assert build_mug(flared).contains(above).all() and not build_mug(plain).contains(above).any()
    beyond = build_mug(plain).handle_frame[None, :3, 3] + np.array([[0.0055, 0, 0]])
    assert not build_mug(flared).contains(beyond).any()


@pytest.mark.parametrize("seed", range(3))
def test_contains_agrees_with_the_winding_number_of_the_mesh(seed):
    mug, rng = sampled(100 + seed), np.random.default_rng(seed)
    low, high = mug.mesh.bounds
    surface, _ = surface_samples(mug.mesh, rng, 200)
    spread = rng.uniform(low - 0.005, high + 0.005, (100, 3))
    points = np.concatenate([spread, surface + 1e-3 * rng.normal(size=surface.shape)])
    winding = winding_numbers(mug.mesh, points)
    assert np.mean((winding > 0.5) == mug.contains(points)) >= 0.997


@pytest.mark.parametrize("seed", range(6))
def test_contains_switches_at_the_surface(seed):
    parameters = sample_mug(np.random.default_rng(200 + seed))
    for flare, step in ((1.0, 1e-6), (parameters.handle_flare, 5e-5)):  # exact, but for the twist of a flared tube
        mug = build_mug(replace(parameters, handle_flare=flare))
        points, normals = surface_samples(mug.mesh, np.random.default_rng(seed), 1500)
        wrong = ~mug.contains(points - step * normals) | mug.contains(points + step * normals)
        assert wrong.mean() <= 0.001  # a sample within a step of an edge may cross the other face


def test_contains_measures_the_volume_of_the_mesh():
    mug, rng = sampled(7), np.random.default_rng(0)
    low, high = mug.mesh.bounds
    share = mug.contains(rng.uniform(low, high, (200_000, 3))).mean()
    np.testing.assert_allclose(share * np.prod(high - low), mug.mesh.volume, rtol=0.02)


@pytest.mark.parametrize("seed", range(4))
def test_frames(seed):
    mug = sampled(seed)
    assert set(mug.frames) == {"handle", "rim", "base"}
    for frame in mug.frames.values():
        assert frame.shape == (4, 4)
        np.testing.assert_allclose(frame[:3, :3] @ frame[:3, :3].T, np.eye(3), atol=1e-12)
        np.testing.assert_allclose(np.linalg.det(frame[:3, :3]), 1.0, atol=1e-12)
        np.testing.assert_array_equal(frame[3], [0, 0, 0, 1])
        np.testing.assert_array_equal(frame[:3, 2], mug.axis)
    p = mug.parameters
    handle, rim, base = mug.handle_frame, mug.rim_frame, mug.base_frame
    assert mug.contains(handle[None, :3, 3]).all()
    np.testing.assert_allclose(handle[2, 3], (p.handle_top + p.handle_bottom - p.height) / 2)
    np.testing.assert_array_equal(handle[:3, 0], [1, 0, 0])
    np.testing.assert_array_equal(rim[:3, 0], [-1, 0, 0])
    np.testing.assert_allclose(rim[:3, 3], [p.wall_thickness / 2 - p.top_radius, 0, p.height / 2])
    down, up = rim[:3, 3] - 1e-5 * mug.axis, rim[:3, 3] + 1e-5 * mug.axis
    np.testing.assert_array_equal(mug.contains(np.stack([down, up])), [True, False])
    np.testing.assert_allclose(base[:3, 3], [0, 0, mug.mesh.bounds[0, 2]], atol=1e-6)


def test_scaled_scales_mesh_frames_parameters_and_contains():
    mug, rng = sampled(11), np.random.default_rng(0)
    small = scaled(mug, 0.4)
    np.testing.assert_allclose(small.mesh.vertices, 0.4 * mug.mesh.vertices, rtol=1e-9)
    np.testing.assert_allclose(small.mesh.volume, 0.4**3 * mug.mesh.volume, rtol=1e-6)
    for name, frame in mug.frames.items():
        np.testing.assert_allclose(small.frames[name][:3, 3], 0.4 * frame[:3, 3], rtol=1e-12)
        np.testing.assert_array_equal(small.frames[name][:3, :3], frame[:3, :3])
    before, after = asdict(mug.parameters), asdict(small.parameters)
    for name, value in before.items():
        shape_only = name in ("squareness", "handle_style", "handle_squareness", "handle_flare")
        assert after[name] == (value if shape_only else value * 0.4)
    points = rng.uniform(-0.08, 0.08, (20_000, 3))
    assert np.mean(small.contains(0.4 * points) == mug.contains(points)) > 0.9999
    again = build_mug(small.parameters)
    np.testing.assert_allclose(again.mesh.volume, small.mesh.volume, rtol=1e-4)
    np.testing.assert_allclose(again.handle_frame, small.handle_frame, atol=1e-9)
    assert_one_closed_cup(scaled(mug, 25.0).mesh)


@pytest.mark.parametrize(
    "change, message",
    [
        ({"height": -0.1}, "height is -0.1"),
        ({"height": 0.0}, "height is 0.0"),
        ({"top_radius": float("nan")}, "top_radius is nan"),
        ({"height": "tall"}, "height is 'tall'"),
        ({"foot_height": -0.001}, "foot_height is -0.001"),
        ({"wall_thickness": 0.041}, "wall_thickness must be less than the radius"),
        ({"wall_thickness": 0.03, "edge_radius": 0.0}, "the cavity closes at its floor"),
        ({"bulge": -0.05}, "wall_thickness must be less than the radius"),
        ({"bottom_thickness": 0.12}, "bottom is too thick"),
        ({"edge_radius": 0.039}, "edge_radius"),
        ({"foot_height": 0.003, "foot_width": 0.04}, "no recess"),
        ({"lip_radius": 0.003}, "lip_radius"),
        ({"squareness": 1.0}, "squareness is 1.0"),
        ({"handle_squareness": 50.0}, "handle_squareness is 50.0"),
        ({"handle_flare": 0.5}, "handle_flare is 0.5"),
        ({"handle_style": "loop"}, "handle_style is 'loop'"),
        ({"handle_top": 0.11}, "handle_top is above the body"),
        ({"handle_bottom": 0.002}, "handle_bottom is below the body"),
        ({"handle_bottom": 0.07}, "too close"),
        ({"handle_reach": 0.001}, "handle"),
        ({"handle_width": 0.06}, "handle_width"),
        ({"handle_reach": 0.0055}, "finger hole"),
        ({"handle_style": "ring", "handle_bottom": 0.009}, "hangs below"),
    ],
)
def test_bad_dimensions_are_refused_by_name(change, message):
    with pytest.raises(InputError, match=rf"(?s)build_mug\(\).*{re.escape(message)}"):
        build_mug(replace(MugParameters(), **change))


@pytest.mark.parametrize("category, name", [(name, name.capitalize()) for name in PARAMETERS])
def test_bad_arguments_are_refused(category, name):
    shape = FAMILIES[category].build()
    with pytest.raises(InputError, match=rf"{name}.contains\(\): points has shape \(5, 2\)"):
        shape.contains(np.zeros((5, 2)))
    with pytest.raises(InputError, match="NaN"):
        shape.contains(np.array([[0.0, np.nan, 0.0]]))
    for factor in (0.0, -1.0, float("inf")):
        with pytest.raises(InputError, match=r"scaled\(\): factor"):
            scaled(shape, factor)
    assert shape.contains(np.zeros((0, 3))).shape == (0,)


@pytest.mark.slow
def test_importing_shapes_does_not_load_trimesh():
    code = "import sys, tdf_jax.shapes; sys.exit('trimesh' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code]).returncode == 0
