"""Depth cameras: pinhole geometry, depths and masks against single rays and the renderer, clouds of one body."""

import os
import subprocess
import sys

import numpy as np
import pytest

from tdf_jax._internal.errors import InputError
from tdf_jax.sim import cameras
from tdf_jax.sim.cameras import NOISE, Camera, camera_ring, depth_image, look_at, observed_points

mujoco = pytest.importorskip("mujoco", reason="the extra 'sim' is not installed")

CELL = """<mujoco>
  <asset><mesh name="wedge" vertex="0 0 0  .06 0 0  0 .05 0  0 0 .09  .03 .03 .08"/></asset>
  <worldbody>
    <geom name="table" type="box" size=".4 .6 .02" pos=".5 0 -.02"/>
    <geom type="sphere" size=".3" pos=".5 0 .2" group="3"/>
    <body name="block" pos=".5 .1 .05"><freejoint/><geom type="box" size=".03 .04 .05"/></body>
    <body name="part" pos=".45 -.1 .0">
      <geom type="mesh" mesh="wedge"/><geom type="sphere" size=".02" pos="0 0 .1"/>
    </body>
    <body name="away" pos="9 9 9"><geom type="sphere" size=".02"/></body>
    <body name="bare"/>
  </worldbody>
</mujoco>"""
CENTRE = np.array([0.5, 0, 0.05])
SMALL = {"width": 96, "height": 72}


@pytest.fixture(scope="module")
def cell():
    model = mujoco.MjModel.from_xml_string(CELL)
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    return model, data


def test_a_camera_looks_at_its_target_with_the_world_upright():
    camera = look_at((1.2, 0.3, 0.6), CENTRE)
    R, position = camera.T_world_camera[:3, :3], camera.T_world_camera[:3, 3]
    np.testing.assert_allclose(R.T @ R, np.eye(3), atol=1e-12)
    assert np.linalg.det(R) == pytest.approx(1)
    np.testing.assert_allclose(position, (1.2, 0.3, 0.6))
    np.testing.assert_allclose(R[:, 2], (CENTRE - position) / np.linalg.norm(CENTRE - position))
    assert R[2, 1] < 0 and R[2, 0] == pytest.approx(0)  # y is down, x is level


def test_a_camera_can_look_straight_down():
    R = look_at((0.5, 0, 1), CENTRE).T_world_camera[:3, :3]
    np.testing.assert_allclose(R, [[0, -1, 0], [-1, 0, 0], [0, 0, -1]], atol=1e-12)


def test_the_intrinsics_place_the_field_of_view():
    camera = Camera(np.eye(4), fovy=60, width=64, height=48)
    for row, tangent in ((-0.5, -np.tan(np.pi / 6)), (47.5, np.tan(np.pi / 6))):  # edges of the outermost pixels
        ray = np.linalg.inv(camera.intrinsics) @ (31.5, row, 1)
        np.testing.assert_allclose(ray, (0, tangent, 1), atol=1e-12)


@pytest.mark.parametrize("count", [1, 3])
def test_a_ring_stands_around_its_centre(count):
    ring = camera_ring(count, CENTRE, azimuth=20)
    away = np.array([camera.T_world_camera[:3, 3] for camera in ring]) - CENTRE
    np.testing.assert_allclose(np.linalg.norm(away, axis=1), 0.7)
    elevations = np.degrees(np.arcsin(away[:, 2] / 0.7))
    np.testing.assert_allclose(elevations, [45] if count == 1 else [35, 45, 55])
    azimuths = np.degrees(np.arctan2(away[:, 1], away[:, 0])) % 360
    np.testing.assert_allclose(azimuths, [20] if count == 1 else [20, 140, 260])
    for camera, offset in zip(ring, away):
        np.testing.assert_allclose(camera.T_world_camera[:3, 2], -offset / 0.7, atol=1e-12)


def test_depths_of_a_table_are_those_of_its_plane(cell):
    camera = look_at((0.5, 0.3, 0.7), (0.5, 0.3, 0), **SMALL)
    image = depth_image(*cell, camera)
    assert image.depth.shape == image.geoms.shape == (72, 96)
    table = image.geoms == cell[0].geom("table").id
    assert table.mean() > 0.5
    np.testing.assert_allclose(image.depth[table], 0.7, atol=1e-12)


def test_depths_and_masks_are_those_of_single_rays(cell):
    model, data = cell
    camera = camera_ring(3, CENTRE, **SMALL)[1]
    image = depth_image(model, data, camera)
    seen = set()
    for row, column in np.random.default_rng(0).integers((72, 96), size=(400, 2)):
        ray = np.linalg.inv(camera.intrinsics) @ (column, row, 1)
        geom = np.zeros(1, np.int32)
        start, R = camera.T_world_camera[:3, 3], camera.T_world_camera[:3, :3]
        far = mujoco.mj_ray(model, data, start, R @ ray, np.array([1, 1, 1, 0, 0, 0], np.uint8), 1, -1, geom)
        assert image.geoms[row, column] == geom[0]
        assert image.depth[row, column] == pytest.approx(max(far, 0), abs=1e-9)  # the ray has depth 1
        for name in ("block", "part"):
            body = model.body(name).id
            assert image.mask(model, name)[row, column] == (geom[0] >= 0 and model.geom_bodyid[geom[0]] == body)
        seen.add(int(geom[0]))
    assert len(seen) >= 4


RENDERED = """
import sys
import mujoco, numpy as np
model = mujoco.MjModel.from_xml_string(sys.stdin.read())
data = mujoco.MjData(model)
mujoco.mj_forward(model, data)
renderer = mujoco.Renderer(model, 240, 320)
free = mujoco.MjvCamera()
free.lookat, free.distance, free.azimuth, free.elevation = (0.5, 0, 0.05), 0.7, 180, -45
renderer.update_scene(data, free)
renderer.enable_depth_rendering()
depth = renderer.render().copy()
renderer.enable_segmentation_rendering()
np.savez(sys.argv[1], depth=depth, geoms=renderer.render()[..., 0])
renderer.close()
"""


def test_depths_and_masks_are_those_of_the_renderer(cell, tmp_path):
    model, data = cell
    environment = {**os.environ, "MUJOCO_GL": os.environ.get("MUJOCO_GL", "egl")}  # read when mujoco is imported
    command = [sys.executable, "-c", RENDERED, str(tmp_path / "rendered.npz")]
    run = subprocess.run(command, input=CELL, capture_output=True, text=True, env=environment, timeout=300)
    if run.returncode:
        pytest.skip(f"NOT COMPARED with the renderer, for there is no off-screen rendering here: {run.stderr[-300:]}")
    with np.load(tmp_path / "rendered.npz") as rendered:
        depth, geoms = rendered["depth"], rendered["geoms"]
    image = depth_image(model, data, camera_ring(1, CENTRE, width=320, height=240)[0])
    assert np.mean(image.geoms == geoms) > 0.998  # pixels at edges are the renderer's own
    flat = (image.geoms == geoms) & (geoms >= 0)
    flat &= model.geom_type[image.geoms] != mujoco.mjtGeom.mjGEOM_SPHERE  # which it draws as a polyhedron
    assert flat.mean() > 0.5 and len(set(geoms[flat])) == 3
    np.testing.assert_allclose(image.depth[flat], depth[flat], rtol=0, atol=1e-4)


def surface_distance(points):
    """Distance of points from the surface of the block of the cell."""
    away = np.abs(points - (0.5, 0.1, 0.05)) - (0.03, 0.04, 0.05)
    return np.where((away < 0).all(axis=1), -away.max(axis=1), np.linalg.norm(np.maximum(away, 0), axis=1))


def test_points_lie_on_the_body_in_the_world_frame(cell):
    points = observed_points(*cell, camera_ring(3, CENTRE, **SMALL), "block", noise=0.0)
    assert len(points) > 200
    assert surface_distance(points).max() < 1e-9
    low, high = np.min(points, axis=0), np.max(points, axis=0)
    np.testing.assert_allclose(low[:2], (0.47, 0.06), atol=0.012)  # three cameras see all of its sides
    np.testing.assert_allclose(high, (0.53, 0.14, 0.1), atol=0.012)


def test_one_camera_sees_only_the_sides_towards_it(cell):
    points = observed_points(*cell, camera_ring(1, CENTRE, **SMALL), "block", noise=0.0)
    assert len(points) > 100
    assert points[:, 0].max() == pytest.approx(0.53, abs=1e-9)
    sides = (points[:, 0] > 0.53 - 1e-9) | (points[:, 2] > 0.1 - 1e-9) | (points[:, 1] < 0.06 + 1e-9)
    assert sides.all()


def test_the_window_around_a_body_gives_the_points_of_the_whole_image(cell, monkeypatch):
    ring = camera_ring(3, CENTRE, **SMALL)
    found = [observed_points(*cell, ring, name, rng=5) for name in ("block", "part")]
    monkeypatch.setattr(cameras, "_window", lambda model, data, camera, body: (0, camera.height, 0, camera.width))
    for name, points in zip(("block", "part"), found):
        np.testing.assert_allclose(points, observed_points(*cell, ring, name, rng=5), rtol=0, atol=1e-12)


def test_noise_is_along_the_depth_and_follows_its_generator(cell):
    camera = look_at((0.5, 0.1, 0.8), (0.5, 0.1, 0))
    exact, noisy = (observed_points(*cell, camera, "block", noise=noise, rng=3) for noise in (0.0, NOISE))
    along = (noisy - exact) @ camera.T_world_camera[:3, 2]
    assert len(along) > 3000
    assert np.std(along) == pytest.approx(NOISE, rel=0.05)
    assert abs(np.mean(along)) < NOISE / 10
    np.testing.assert_array_equal(noisy, observed_points(*cell, camera, "block", rng=np.random.default_rng(3)))
    assert not np.array_equal(noisy, observed_points(*cell, camera, "block", rng=4))


def test_pixels_at_edges_of_the_depth_are_dropped(cell):
    model, data = cell
    camera = look_at((0.5, 0.1, 0.8), (0.5, 0.1, 0), **SMALL)
    mask = depth_image(model, data, camera).mask(model, "block")
    inside = mask.copy()
    inside[1:-1, 1:-1] &= mask[:-2, 1:-1] & mask[2:, 1:-1] & mask[1:-1, :-2] & mask[1:-1, 2:]
    assert 0 < inside.sum() < mask.sum()
    assert len(observed_points(model, data, camera, "block")) == inside.sum()


def test_a_body_that_no_camera_sees_is_refused(cell):
    for name in ("away", "bare"):
        with pytest.raises(InputError, match=rf"observed_points\(\): none of 3 cameras sees the body '{name}'"):
            observed_points(*cell, camera_ring(3, CENTRE, **SMALL), name)


@pytest.mark.parametrize(
    "call, message",
    [
        (lambda cell: observed_points(*cell, camera_ring(1, CENTRE), "mug"), "no body 'mug'; it has world, block"),
        (lambda cell: observed_points(*cell, [], "block"), "cameras is empty"),
        (lambda cell: observed_points(*cell, camera_ring(1, CENTRE), "block", noise=-1), "noise is -1"),
        (lambda cell: look_at(CENTRE, CENTRE), "expected two different points"),
        (lambda cell: look_at(CENTRE, (0, 0, np.nan)), "look_at()"),
        (lambda cell: camera_ring(0, CENTRE), "count is 0"),
        (lambda cell: camera_ring(2, CENTRE, distance=0.0), "distance is 0"),
        (lambda cell: camera_ring(2, CENTRE, elevations=(35, 95)), "elevations is 95"),
        (lambda cell: Camera(np.eye(4), fovy=180), "fovy is 180"),
        (lambda cell: Camera(np.eye(4), width=0), "width is 0"),
        (lambda cell: Camera(2 * np.eye(4)), "T_world_camera"),
    ],
)
def test_wrong_values_are_refused(cell, call, message):
    with pytest.raises(InputError, match=message.replace("(", r"\(").replace(")", r"\)")):
        call(cell)
