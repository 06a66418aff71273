"""The container family: closed meshes of given dimensions, floor and opening, and room for what is to stand inside."""

import re
from dataclasses import replace

import numpy as np
import pytest
from test_mug import surface_samples, winding_numbers

from tdf_jax._internal.errors import InputError
from tdf_jax.geometry.sampling import sample_surface
from tdf_jax.shapes import ContainerParameters, build_bottle, build_container, sample_bottle, sample_container

PLAIN = ContainerParameters()
VARIANTS = {
    "square": PLAIN,
    "sharp": ContainerParameters(corner_radius=0.0),
    "tapered": ContainerParameters(taper=0.75, corner_radius=0.03),
    "rim": ContainerParameters(rim_width=0.012, taper=0.9),
    "box": ContainerParameters(length=0.18, corner_radius=0.02),
    "box, tapered": ContainerParameters(length=0.18, taper=0.8, corner_radius=0.0, rim_width=0.01),
    "round": ContainerParameters(style="round"),
    "round, tapered": ContainerParameters(style="round", taper=0.7, rim_width=0.01),
    "oval": ContainerParameters(style="round", length=0.16),
    "shelf": ContainerParameters(style="shelf", corner_radius=0.0, height=0.3, wall_thickness=0.012),
    "wide shelf": ContainerParameters(style="shelf", corner_radius=0.0, width=0.2, floor_thickness=0.02),
}
BINS = [name for name in VARIANTS if "shelf" not in name]
SHELVES = [name for name in VARIANTS if "shelf" in name]


def free(container, origin, direction, reach=0.25, step=2e-5):
    """How far a ray from a point in the air goes before it meets material, metres; inf if it does not."""
    distances = np.arange(0, reach, step)
    inside = container.contains(np.asarray(origin) + distances[:, None] * np.asarray(direction, float))
    assert not inside[0]
    return distances[np.argmax(inside)] if inside.any() else np.inf


def above_floor(container, height):
    return container.frames["floor"][:3, 3] + np.array([0, 0, height])


@pytest.mark.parametrize("name", VARIANTS)
def test_every_variant_is_one_closed_container_that_stands_on_its_base(name):
    container = build_container(VARIANTS[name])
    mesh, p = container.mesh, container.parameters
    assert mesh.is_watertight and mesh.is_winding_consistent and mesh.volume > 0
    assert mesh.body_count == 1 and mesh.euler_number == 2  # no hole through it
    np.testing.assert_allclose(mesh.bounds[:, :2].sum(axis=0), 0, atol=1e-9)
    np.testing.assert_allclose(mesh.bounds[:, 2], [-p.height / 2, p.height / 2], atol=1e-9)
    assert container.category == "container" and container.height == p.height


@pytest.mark.parametrize("name", VARIANTS)
def test_contains_agrees_with_the_winding_number_of_the_mesh(name):
    container, rng = build_container(VARIANTS[name]), np.random.default_rng(0)
    low, high = container.mesh.bounds
    surface, normals = surface_samples(container.mesh, rng, 80)
    away = rng.choice([-1, 1], 80)[:, None] * rng.uniform(1e-5, 2e-3, (80, 1)) * normals
    points = np.concatenate([rng.uniform(low - 0.005, high + 0.005, (20, 3)), surface + away])
    inside = winding_numbers(container.mesh, points) > 0.5
    assert 20 < inside.sum() < 80
    np.testing.assert_array_equal(container.contains(points), inside)


@pytest.mark.parametrize("name", BINS)
def test_a_bin_has_the_inner_sides_walls_and_taper_it_was_asked_for(name):
    container = build_container(VARIANTS[name])
    p, mesh = container.parameters, container.mesh
    for axis, side in ((0, p.length), (1, p.width)):
        direction = np.eye(3)[axis]
        at_floor, at_top = (free(container, above_floor(container, z), direction) for z in (1e-6, p.depth - 1e-6))
        np.testing.assert_allclose(2 * at_floor, side, atol=8e-5)
        np.testing.assert_allclose(2 * at_top, side / p.taper, atol=8e-5)
        rim = p.rim_width + p.wall_thickness
        np.testing.assert_allclose(mesh.extents[axis], side / p.taper + 2 * rim, atol=1e-6)
        if p.rim_width:  # under the rim and on top of it
            outside = np.array([0, 0, p.height / 2]) + (side / p.taper / 2 + rim - p.rim_width / 2) * direction
            levels = np.array([[1e-5], [-1e-5], [1e-5 - p.rim_thickness], [-1e-5 - p.rim_thickness]]) * [0, 0, 1]
            np.testing.assert_array_equal(container.contains(outside + levels), [False, True, True, False])
    assert free(container, above_floor(container, 1e-6), [0, 0, 1]) == np.inf  # open above


@pytest.mark.parametrize("name", SHELVES)
def test_a_shelf_has_the_room_it_was_asked_for_and_only_its_front_is_open(name):
    container = build_container(VARIANTS[name])
    p = container.parameters
    middle = above_floor(container, p.depth / 2)
    for direction, room in (
        ((0, 1, 0), p.width / 2),
        ((0, -1, 0), p.width / 2),
        ((-1, 0, 0), p.length / 2),
        ((0, 0, 1), p.depth / 2),
        ((0, 0, -1), p.depth / 2),
        ((1, 0, 0), np.inf),
    ):
        np.testing.assert_allclose(free(container, middle, direction), room, atol=3e-5)
    wall = [p.length + p.wall_thickness, p.width + 2 * p.wall_thickness]
    np.testing.assert_allclose(container.mesh.extents[:2], wall, atol=1e-9)
    np.testing.assert_allclose(p.depth + p.floor_thickness + p.wall_thickness, p.height)


@pytest.mark.parametrize("name", VARIANTS)
def test_places_are_the_middles_of_floor_and_opening_and_the_base(name):
    container = build_container(VARIANTS[name])
    p, mesh = container.parameters, container.mesh
    assert list(container.frames) == ["floor", "opening", "base"]
    for frame in container.frames.values():
        np.testing.assert_array_equal(frame[:3, :3], np.eye(3))
    floor, opening, base = (container.frames[place][:3, 3] for place in ("floor", "opening", "base"))
    np.testing.assert_array_equal(base, [0, 0, -p.height / 2])
    np.testing.assert_allclose(floor[2], p.floor_thickness - p.height / 2)
    # All over the floor it is solid just below and air just above.
    x, y = np.meshgrid(p.length / 2 * np.linspace(-0.6, 0.6, 5), p.width / 2 * np.linspace(-0.6, 0.6, 5))
    over = floor + np.stack([x.ravel(), y.ravel(), 0 * x.ravel()], axis=1)
    assert container.contains(over - [0, 0, 1e-6]).all() and not container.contains(over + [0, 0, 1e-6]).any()
    assert not container.contains(floor + np.linspace(0.01, 1, 50)[:, None] * (opening - floor)).any()
    # The opening is where the hull of the container ends.
    np.testing.assert_allclose((opening @ ([1, 0, 0] if p.style == "shelf" else [0, 0, 1])), mesh.bounds[
        1, 0 if p.style == "shelf" else 2
    ])  # fmt: skip
    sides = [free(container, floor + [0, 0, 1e-4], side) for side in ((0, 1, 0), (0, -1, 0), (-1, 0, 0))]
    np.testing.assert_allclose(sides, [p.width / 2, p.width / 2, p.length / 2], atol=8e-5)


# ---- sampling ----


def test_sampling_leaves_the_room_that_was_asked_for_and_repeats_with_the_seed():
    def draw(seed):
        return sample_container(np.random.default_rng(seed), width=0.08, height=0.2)

    draws = [draw(seed) for seed in range(400)]
    assert draws[:5] == [draw(seed) for seed in range(5)] and len(set(draws)) == 400
    for values in ([draw.width for draw in draws], [draw.length for draw in draws]):
        assert 1.2 * 0.08 <= min(values) < 1.25 * 0.08 and 1.95 * 0.08 < max(values) <= 2 * 0.08
    bins, shelves = ([draw for draw in draws if (draw.style == "shelf") == shelf] for shelf in (False, True))
    assert 0.3 * 0.2 <= min(draw.depth for draw in bins) and max(draw.depth for draw in bins) <= 0.9 * 0.2 + 1e-12
    assert 1.1 * 0.2 <= min(draw.depth for draw in shelves) and max(draw.depth for draw in shelves) <= 1.5 * 0.2 + 1e-12
    folds = [draw.fold for draw in draws]
    for fold in (0, 1, 2, 4):
        assert 0.15 < folds.count(fold) / 400 < 0.35
    for with_it in (lambda draw: draw.taper < 1, lambda draw: draw.rim_width > 0, lambda draw: draw.corner_radius > 0):
        assert 0.1 < np.mean([with_it(draw) for draw in bins]) < 0.8


def test_by_default_there_is_room_for_a_bottle_of_its_family():
    for seed in range(50):
        bottle = sample_bottle(np.random.default_rng(seed))
        container = sample_container(np.random.default_rng(seed))  # draws that bottle first
        body = 2 * (bottle.radius + max(bottle.bulge, 0))
        assert 1.2 * body <= container.width <= container.length * (1 + (container.style == "shelf")) <= 4 * body
        assert max(container.length, container.width) <= 2 * body
        low, high = (1.1, 1.5) if container.style == "shelf" else (0.3, 0.9)
        assert low * bottle.height <= container.depth + 1e-12 and container.depth <= high * bottle.height + 1e-12


def standing_pairs(seeds):
    """Whether sampled bottles stand on the middle of the floor of containers sampled for their width and height."""
    for seed in seeds:
        bottle = build_bottle(sample_bottle(np.random.default_rng([1, seed])))
        width, height = float(bottle.mesh.extents[:2].max()), bottle.height
        rng = np.random.default_rng([2, seed])
        container = build_container(sample_container(rng, width=width, height=height))
        middle = np.append(bottle.mesh.bounds[:, :2].mean(axis=0), 0)  # a handle is on one side
        shift = container.frames["floor"][:3, 3] - middle + [0, 0, height / 2 + 1e-5]
        ours, theirs = (sample_surface(one.mesh, 1000, rng) for one in (bottle, container))
        yield not container.contains(ours + shift).any() and not bottle.contains(theirs - shift).any()


def test_bottles_stand_in_containers_that_were_sampled_for_them():
    assert np.mean(list(standing_pairs(range(8)))) >= 0.85


@pytest.mark.slow
def test_most_bottles_stand_in_containers_that_were_sampled_for_them():
    assert np.mean(list(standing_pairs(range(8, 208)))) >= 0.95


def test_sampled_containers_are_built():
    for seed in range(12):
        container = build_container(sample_container(np.random.default_rng(seed)))
        assert container.mesh.is_watertight and container.mesh.body_count == 1 and container.mesh.euler_number == 2
        levels = above_floor(container, 0) + np.array([[0, 0, -1e-6], [0, 0, 1e-6]])
        np.testing.assert_array_equal(container.contains(levels), [True, False])


@pytest.mark.slow
def test_containers_of_anything_are_built():
    """Objects from flat to tall."""
    for seed in range(400):
        rng = np.random.default_rng(seed)
        width, height = np.exp(rng.uniform(np.log(0.02), np.log(0.3), 2))
        if 1 / 20 < width / height < 20:
            build_container(sample_container(rng, width=float(width), height=float(height)))


# ---- bad input ----


@pytest.mark.parametrize(
    "change, message",
    [
        ({"style": "bag"}, "style is 'bag'; expected one of round, box, shelf"),
        ({"height": -0.1}, "height is -0.1; expected a positive number"),
        ({"width": float("nan")}, "width is nan"),
        ({"wall_thickness": 0.0}, "wall_thickness is 0.0"),
        ({"corner_radius": -0.01}, "corner_radius is -0.01; expected one finite number of 0 or more"),
        ({"taper": 0.4}, "taper is 0.4; expected 0.5 to 1"),
        ({"taper": 1.1}, "taper is 1.1"),
        ({"floor_thickness": 0.08}, "floor_thickness must be less than half of height"),
        ({"floor_thickness": 0.14}, "floor_thickness leaves too little height inside"),
        ({"wall_thickness": 0.06}, "wall_thickness must be less than half of width"),
        ({"length": 0.1}, "width must be at most length"),
        ({"corner_radius": 0.05}, "corner_radius must be less than 0.4 of the width"),
        ({"rim_width": 0.01, "rim_thickness": 0.08}, "rim_thickness must be less than half of the depth"),
        ({"taper": 0.5, "floor_thickness": 0.05, "height": 0.11}, "taper narrows the base too much"),
        ({"style": "shelf"}, "corner_radius and rim_width are for bins; a shelf has 0"),
        ({"style": "shelf", "corner_radius": 0.0, "taper": 0.9}, "taper is for bins; a shelf has 1"),
    ],
)
def test_bad_dimensions_are_refused_by_name(change, message):
    with pytest.raises(InputError, match=rf"(?s)build_container\(\).*{re.escape(message)}"):
        build_container(replace(PLAIN, **change))


@pytest.mark.parametrize(
    "sizes, message",
    [
        ({"width": 0.0}, "width is 0.0; expected a positive number"),
        ({"width": 0.08, "height": float("nan")}, "height is nan"),
        ({"width": 80, "height": 0.2}, "width is 80 and height 0.2; expected the two of one object, in metres"),
    ],
)
def test_sizes_of_nothing_are_refused(sizes, message):
    with pytest.raises(InputError, match=rf"(?s)sample_container\(\).*{re.escape(message)}"):
        sample_container(np.random.default_rng(0), **sizes)
