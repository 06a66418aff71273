"""The rack family: closed meshes of given dimensions, pegs and their seats, and the range of sampled dimensions."""

import re
from dataclasses import replace
from typing import Any, cast

import numpy as np
import pytest
from scipy import ndimage
from test_mug import surface_samples, winding_numbers

from tdf_jax._internal.errors import InputError
from tdf_jax.geometry.sampling import sample_surface
from tdf_jax.shapes import Rack, RackParameters, build_mug, build_rack, sample_mug, sample_rack, scaled

PLAIN = RackParameters()
VARIANTS = {
    "plain": PLAIN,
    "level": RackParameters(peg_tilt=0.0, tip_radius=0.0),
    "steep": RackParameters(peg_tilt=np.radians(40), peg_height=0.285, peg_length=0.12),
    "round tip": RackParameters(peg_thickness=0.012, tip_radius=0.006),
    "square": RackParameters(base_outline="square", post_outline="square", base_width=0.1),
    "off the middle": RackParameters(base_offset=0.04, base_length=0.18),
    "two equal": RackParameters(second_length=0.085),
    "two level": RackParameters(second_length=0.085, peg_tilt=0.0, second_tilt=0.0),
    "two unlike": RackParameters(second_length=0.06, second_height=0.19, second_tilt=0.6, second_angle=2.5),
    "square, two unlike": RackParameters(second_length=0.1, second_height=0.2, second_angle=3.9, post_outline="square"),
}


def along(rack, origin, direction, start=-0.05, reach=0.2, step=2e-5):
    """Distances from a point at which a ray is in the material, metres."""
    distances = np.arange(start, reach, step)
    return distances[rack.contains(origin + distances[:, None] * direction)]


@pytest.mark.parametrize("name", VARIANTS)
def test_every_variant_is_one_closed_rack_that_stands_on_its_base(name):
    rack = build_rack(VARIANTS[name])
    mesh, p = rack.mesh, rack.parameters
    assert mesh.is_watertight and mesh.is_winding_consistent and mesh.volume > 0
    assert mesh.body_count == 1 and mesh.euler_number == 2
    np.testing.assert_allclose(mesh.bounds[0, 2], -p.height / 2, atol=1e-6)
    bottom = mesh.vertices[mesh.vertices[:, 2] < 1e-6 - p.height / 2]
    np.testing.assert_allclose(np.ptp(bottom[:, :2], axis=0), [p.base_length, p.base_width], atol=1e-6)
    np.testing.assert_allclose((bottom.min(axis=0) + bottom.max(axis=0))[:2] / 2, [p.base_offset, 0], atol=1e-6)
    # A line through the post beside the pegs ends at the post's top and, the other way, at the base's bottom.
    beside = along(rack, np.array([0.0, 0.35 * p.post_width, 0.0]), np.array([0.0, 0.0, 1.0]), reach=p.height)
    np.testing.assert_allclose(beside[-1], p.height / 2, atol=3e-5)
    assert rack.category == "rack" and rack.height == p.height


@pytest.mark.parametrize("name", VARIANTS)
def test_contains_agrees_with_the_winding_number_of_the_mesh(name):
    rack, rng = build_rack(VARIANTS[name]), np.random.default_rng(0)
    low, high = rack.mesh.bounds
    surface, normals = surface_samples(rack.mesh, rng, 80)
    away = rng.choice([-1, 1], 80)[:, None] * rng.uniform(1e-5, 2e-3, (80, 1)) * normals
    points = np.concatenate([rng.uniform(low - 0.005, high + 0.005, (20, 3)), surface + away])
    inside = winding_numbers(rack.mesh, points) > 0.5
    assert 20 < inside.sum() < 80
    np.testing.assert_array_equal(rack.contains(points), inside)


@pytest.mark.parametrize("name", VARIANTS)
def test_pegs_have_the_thickness_length_and_tilt_they_were_asked_for(name):
    rack = build_rack(VARIANTS[name])
    p, mesh = rack.parameters, rack.mesh
    asked = [(p.peg_length, p.peg_tilt, p.peg_height, 0.0)]
    if p.second_length:
        asked.append((p.second_length, p.second_tilt, p.second_height, p.second_angle))
    assert len(rack.peg_frames) == len(rack.peg_lines) == p.pegs == len(asked)
    for T, (begin, tip), (length, tilt, height, angle) in zip(rack.peg_frames, rack.peg_lines, asked, strict=True):
        out = np.array([np.cos(angle), np.sin(angle), 0.0])
        direction = np.cos(tilt) * out + np.sin(tilt) * np.array([0.0, 0.0, 1.0])
        np.testing.assert_allclose(tip - begin, length * direction, atol=1e-12)
        on_axis = begin - direction * (begin @ out) / np.cos(tilt)
        np.testing.assert_allclose(on_axis, [0, 0, height - p.height / 2], atol=1e-12)
        # The mesh: the peg ends at the tip, is as thick as asked half way, and begins at the post's surface.
        np.testing.assert_allclose(np.max((mesh.vertices - begin) @ direction), length, atol=1e-6)
        middle = (begin + tip) / 2
        for across in (T[:3, 1], T[:3, 2]):
            thick = along(rack, middle, across, -0.008, 0.008)
            np.testing.assert_allclose(thick[[0, -1]], [-p.peg_thickness / 2, p.peg_thickness / 2], atol=3e-5)
        level = begin - np.array([0.0, 0.0, 1.5 * p.peg_thickness])  # below the peg's root only the post is solid
        np.testing.assert_allclose(along(rack, level * [0, 0, 1], out)[-1], begin @ out, atol=3e-5)


@pytest.mark.parametrize("name", VARIANTS)
def test_a_seat_is_on_top_of_its_peg_half_way(name):
    rack = build_rack(VARIANTS[name])
    for T, (begin, tip) in zip(rack.peg_frames, rack.peg_lines, strict=True):
        origin, x, z = T[:3, 3], T[:3, 0], T[:3, 2]
        np.testing.assert_allclose(T[:3, :3].T @ T[:3, :3], np.eye(3), atol=1e-12)
        np.testing.assert_allclose(np.linalg.det(T[:3, :3]), 1.0)
        np.testing.assert_allclose(x, (tip - begin) / np.linalg.norm(tip - begin), atol=1e-12)
        assert (
            z[2] >= np.cos(np.radians(40)) - 1e-9 and abs(z @ np.cross(x, [0, 0, 1])) < 1e-12
        )  # up, in the peg's plane
        np.testing.assert_allclose(origin, (begin + tip) / 2 + rack.parameters.peg_thickness / 2 * z, atol=1e-12)
        for share in (-0.4, 0.0, 0.4):  # all along the peg
            seat = origin + share * np.linalg.norm(tip - begin) * x
            np.testing.assert_array_equal(rack.contains(seat + np.array([[-1e-5], [1e-5]]) * z), [True, False])


@pytest.mark.parametrize("name", VARIANTS)
def test_places_are_the_first_peg_and_the_ends_of_the_axis(name):
    rack = build_rack(VARIANTS[name])
    assert list(rack.frames) == ["peg", "post", "base"]
    np.testing.assert_array_equal(rack.frames["peg"], rack.peg_frames[0])
    assert rack.frames["peg"][0, 3] > 0 and abs(rack.frames["peg"][1, 3]) < 1e-12  # the front is +x
    for place, level, (below, above) in (("post", 0.5, (True, False)), ("base", -0.5, (False, True))):
        np.testing.assert_array_equal(rack.frames[place][:3, :3], np.eye(3))
        origin = rack.frames[place][:3, 3]
        np.testing.assert_array_equal(origin, [0, 0, level * rack.height])
        np.testing.assert_array_equal(rack.contains(origin + np.array([[0, 0, -1e-5], [0, 0, 1e-5]])), [below, above])


def test_any_peg_is_right():
    """The symmetry makes equal pegs equal; the second of two unlike pegs is one of the others."""
    for name, others in (("plain", 0), ("two equal", 0), ("two unlike", 1)):
        rack = build_rack(VARIANTS[name])
        assert len(rack.others("peg")) == others
        assert rack.others("post") == rack.others("base") == ()
    np.testing.assert_array_equal(rack.others("peg")[0], rack.peg_frames[1])
    first, second = build_rack(VARIANTS["two equal"]).peg_frames
    np.testing.assert_allclose(np.diag([-1, -1, 1, 1]) @ first, second, atol=1e-12)


def test_pegs_scale_with_the_rack():
    rack = build_rack(VARIANTS["two unlike"])
    small = cast(Rack, scaled(rack, 0.5))
    np.testing.assert_allclose(small.peg_lines, 0.5 * rack.peg_lines, atol=1e-12)
    for T, before in zip(small.peg_frames, rack.peg_frames, strict=True):
        np.testing.assert_allclose(T[:3, 3], 0.5 * before[:3, 3], atol=1e-12)
        np.testing.assert_allclose(T[:3, :3], before[:3, :3], atol=1e-12)
    np.testing.assert_allclose(small.frames["peg"], small.peg_frames[0], atol=1e-12)


# ---- sampling ----


def test_sampling_stays_in_its_ranges_and_repeats_with_the_seed():
    draws = [sample_rack(np.random.default_rng(seed)) for seed in range(400)]
    assert draws[:5] == [sample_rack(np.random.default_rng(seed)) for seed in range(5)]
    assert len(set(draws)) == 400
    two = [draw for draw in draws if draw.pegs == 2]
    for values, low, high in (
        ([draw.height for draw in draws], 0.22, 0.36),
        ([draw.peg_thickness for draw in draws], 0.006, 0.012),
        ([draw.peg_length for draw in draws] + [draw.second_length for draw in two], 0.050, 0.120),
        ([draw.peg_tilt for draw in draws] + [draw.second_tilt for draw in two], 0.0, np.radians(40)),
    ):
        margin = 0.05 * (high - low)  # the ranges are used from end to end
        assert low <= min(values) < low + margin and high - margin < max(values) <= high
    folds = np.array([draw.fold for draw in draws])
    pegs = np.array([draw.pegs for draw in draws])
    for kind in (pegs == 1, (pegs == 2) & (folds == 2), (pegs == 2) & (folds == 1)):
        assert 0.2 < kind.mean() < 0.5
    assert (folds[pegs == 1] == 1).all()
    assert all(draw.second_height < draw.peg_height - 0.02 for draw in two if draw.fold == 1)  # the first is the higher
    assert {draw.base_outline for draw in draws} == {draw.post_outline for draw in draws} == {"round", "square"}
    assert 0.1 < np.mean([draw.base_offset > 0 for draw in draws]) < 0.4


def assert_sampled_racks(seeds):
    for seed in seeds:
        rack = build_rack(sample_rack(np.random.default_rng(seed)))
        assert rack.mesh.is_watertight and rack.mesh.body_count == 1 and rack.mesh.euler_number == 2
        for T in rack.peg_frames:
            below_and_above = T[:3, 3] + np.array([[-1e-5], [1e-5]]) * T[:3, 2]
            np.testing.assert_array_equal(rack.contains(below_and_above), [True, False])


def test_sampled_racks_are_built():
    assert_sampled_racks(range(12))


@pytest.mark.slow
def test_many_sampled_racks_are_built():
    assert_sampled_racks(range(12, 400))


# ---- mugs on pegs ----


def finger_hole(mug, step=5e-4):
    """Diameter of the largest circle in a mug's finger hole, in its plane of symmetry, metres."""
    low, high = mug.mesh.bounds + np.array([[-0.005], [0.005]])
    x, z = np.arange(low[0], high[0], step), np.arange(low[2], high[2], step)
    plane = np.stack(np.meshgrid(x, [0.0], z, indexing="ij"), axis=-1)
    labelled: Any = ndimage.label(~mug.contains(plane.reshape(-1, 3)).reshape(len(x), len(z)))
    parts, count = labelled
    enclosed = [parts == part for part in range(1, count + 1) if part != parts[0, 0]]
    return max(2 * step * np.max(np.asarray(ndimage.distance_transform_edt(part))) for part in enclosed)


def hangs(mug, rack, peg, rng):
    """Whether a mug hangs somewhere on a peg without touching more: its handle above the peg and across it."""
    T, (begin, tip) = rack.peg_frames[peg], rack.peg_lines[peg]
    grip = mug.handle_frame[:3, 3] - [mug.parameters.handle_thickness / 2, 0, 0]  # the handle's inner side
    ours, theirs = sample_surface(mug.mesh, 1000, rng), sample_surface(rack.mesh, 2000, rng)
    for along_peg, across in ((T[:3, 0], T[:3, 1]), (-T[:3, 0], -T[:3, 1])):
        R = np.stack([T[:3, 2], along_peg, -across], axis=1)  # the handle up, and the mug's axis across the peg
        for share in np.linspace(0.4, -0.35, 8):
            for lift in (3e-4, 1.5e-3):  # a flared handle is thicker beside its grip
                t = T[:3, 3] + share * (tip - begin) + lift * T[:3, 2] - R @ grip
                placed = ours @ R.T + t
                standing = placed[:, 2].min() > -rack.height / 2
                if standing and not rack.contains(placed).any() and not mug.contains((theirs - t) @ R).any():
                    return True
    return False


@pytest.mark.slow
def test_most_sampled_mugs_hang_on_sampled_racks():
    rng, hung = np.random.default_rng(0), []
    for seed in range(60):
        mug = build_mug(sample_mug(np.random.default_rng([1, seed])))
        rack = build_rack(sample_rack(np.random.default_rng([2, seed])))
        assert finger_hole(mug) > rack.parameters.peg_thickness
        hung.append(any(hangs(mug, rack, peg, rng) for peg in range(rack.parameters.pegs)))
    assert np.mean(hung) >= 0.8


# ---- bad input ----


@pytest.mark.parametrize(
    "change, message",
    [
        ({"height": -0.1}, "height is -0.1; expected a positive number"),
        ({"peg_length": float("nan")}, "peg_length is nan"),
        ({"peg_thickness": 0.0}, "peg_thickness is 0.0"),
        ({"second_length": -0.05}, "second_length is -0.05; expected one finite number of 0 or more"),
        ({"base_outline": "oval"}, "base_outline is 'oval'; expected one of round, square"),
        ({"post_outline": 2}, "post_outline is 2"),
        ({"peg_tilt": 20.0}, "peg_tilt is 20.0; expected 0 to 0.698 (40 degrees)"),
        ({"peg_tilt": -0.1}, "peg_tilt is -0.1"),
        ({"second_length": 0.05, "second_tilt": 0.8}, "second_tilt is 0.8; expected 0 to 0.698"),
        ({"peg_thickness": 0.016}, "post_width must be more than 1.3 of peg_thickness"),
        ({"tip_radius": 0.005}, "tip_radius must be at most half of peg_thickness"),
        ({"base_thickness": 0.1}, "base_thickness must be less than 0.3 of height"),
        ({"base_offset": 0.065}, "the post is not on the base"),
        ({"base_width": 0.02}, "the post is not on the base"),
        ({"peg_height": 0.297}, "peg_height is above the post: lower it"),
        ({"peg_height": 0.016}, "peg_height is in the base: raise it"),
        ({"peg_length": 0.008}, "peg_length must be more than peg_thickness"),
        ({"second_length": 0.05, "second_height": 0.26}, "second_height must be at most peg_height"),
        ({"second_length": 0.05, "second_angle": 0.5}, "second_angle is 0.5; expected 1.05 to 5.24"),
    ],
)
def test_bad_dimensions_are_refused_by_name(change, message):
    with pytest.raises(InputError, match=rf"(?s)build_rack\(\).*{re.escape(message)}"):
        build_rack(replace(PLAIN, **change))
