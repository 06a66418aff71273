"""The mug family: closed meshes, ground truth frames, and an inside test that agrees with the mesh."""

import subprocess
import sys
from dataclasses import asdict, replace

import numpy as np
import pytest

from tdf_jax.errors import InputError
from tdf_jax.shapes import HANDLE_STYLES, MugParameters, build_mug, sample_mug, scaled

VARIANTS = [
    MugParameters(),
    MugParameters(squareness=6.0, foot_height=0.003, handle_squareness=5.0),
    MugParameters(top_radius=0.048, bottom_radius=0.032, edge_radius=0.018),
    MugParameters(bulge=0.007, wall_thickness=0.003, lip_radius=0.0, handle_flare=1.5),
    MugParameters(bulge=-0.004, edge_radius=0.0, foot_height=0.002),
]


def sampled(seed):
    return build_mug(sample_mug(np.random.default_rng(seed)))


def winding_numbers(mesh, points):
    """Sum of the signed solid angles of all triangles over 4 pi: 1 inside, 0 outside; no mug formula in it."""
    a, b, c = np.moveaxis(mesh.triangles[None] - points[:, None, None], 2, 0)
    la, lb, lc = (np.linalg.norm(side, axis=-1) for side in (a, b, c))
    volume = np.sum(a * np.cross(b, c), axis=-1)
    spread = la * lb * lc + np.sum(a * b, -1) * lc + np.sum(b * c, -1) * la + np.sum(c * a, -1) * lb
    return np.sum(np.arctan2(volume, spread), axis=1) / (2 * np.pi)


def surface_samples(mesh, rng, count):
    faces = rng.choice(len(mesh.faces), count, p=mesh.area_faces / mesh.area)
    points = np.einsum("pk,pki->pi", rng.dirichlet(np.ones(3), count), mesh.triangles[faces])
    return points, mesh.face_normals[faces]


def assert_one_closed_cup(mesh):
    assert mesh.is_watertight and mesh.is_winding_consistent
    assert mesh.volume > 0
    assert mesh.body_count == 1
    assert mesh.euler_number == 0  # genus 1: the finger hole, and no other


@pytest.mark.parametrize("style", HANDLE_STYLES)
@pytest.mark.parametrize("parameters", VARIANTS)
def test_every_style_is_one_closed_cup_whose_grip_is_clay(style, parameters):
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


@pytest.mark.parametrize("change, message", [
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
])
def test_bad_dimensions_are_refused_by_name(change, message):
    with pytest.raises(InputError, match=r"build_mug\(\)") as error:
        build_mug(replace(MugParameters(), **change))
    assert message in str(error.value)


def test_bad_arguments_are_refused():
    mug = build_mug()
    with pytest.raises(InputError, match=r"Mug.contains\(\): points have shape \(5, 2\)"):
        mug.contains(np.zeros((5, 2)))
    with pytest.raises(InputError, match="NaN"):
        mug.contains(np.array([[0.0, np.nan, 0.0]]))
    for factor in (0.0, -1.0, float("inf")):
        with pytest.raises(InputError, match=r"scaled\(\): factor"):
            scaled(mug, factor)
    assert mug.contains(np.zeros((0, 3))).shape == (0,)


def test_importing_shapes_does_not_load_trimesh():
    code = "import sys, tdf_jax.shapes; sys.exit('trimesh' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code]).returncode == 0
