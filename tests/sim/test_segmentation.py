"""Segmented clouds of one body: what is lost and what is foreign, mixed depths, and the robot's mask."""

import numpy as np
import pytest
from scipy.spatial import KDTree

from tdf_jax._internal.errors import InputError
from tdf_jax.shapes import build_mug, build_rack
from tdf_jax.sim.bodies import body_of
from tdf_jax.sim.cameras import camera_ring, depth_image, look_at, observed_points
from tdf_jax.sim.segmentation import mixed_depths, robot_mask, segmented_points
from tdf_jax.sim.workcell import OBJECT, TABLE_NAME, TARGET, build_workcell

SMALL = {"width": 320, "height": 240}


def placed(shape, x, y):
    T = np.eye(4)
    T[:3, 3] = x, y, -shape.mesh.bounds[0, 2]
    return T


@pytest.fixture(scope="module")
def scene(robot):
    """A mug and a rack on the table, and an arm; the arm alone."""
    mug, rack = build_mug(), build_rack()
    places = placed(mug, 0.45, 0.2), placed(rack, 0.6, -0.2)
    cell = build_workcell(robot, body_of(mug), places[0], body_of(rack), places[1])
    alone = build_workcell(robot)
    return cell, cell.data(), places, (alone, alone.data())


@pytest.mark.parametrize(("name", "place"), [(OBJECT, 0), (TARGET, 1)])
def test_one_body_is_segmented_as_the_simulator_does(scene, name, place):
    cell, data, places, own = scene
    centre = places[place][:3, 3] + (0, 0, 0.05)
    cameras = camera_ring(1, centre, azimuth=20, width=480, height=360)
    found = segmented_points(cell, data, cameras, centre, rng=0, own=own)
    true = observed_points(cell.model, data, cameras, name, rng=1)
    foreign, lost = (np.mean(KDTree(a).query(b)[0] > 0.005) for a, b in ((true, found), (found, true)))
    assert foreign < 0.05 and lost < 0.05, (foreign, lost)


def test_depths_at_an_edge_are_mixed():
    depth = np.full((20, 30), 1.0)
    depth[:, 15:], depth[:, 25:] = 0.6, 0.0  # a nearer surface, and nothing
    mixed = mixed_depths(depth, np.random.default_rng(0))
    changed = mixed != depth
    assert changed[:, 14:16].sum() == 20 and changed.sum() == 20  # one of the two pixels in every row
    assert ((mixed[changed] > 0.6) & (mixed[changed] < 1.0)).all()
    np.testing.assert_array_equal(mixed_depths(depth[:, :15], np.random.default_rng(0)), depth[:, :15])


def test_the_robot_is_masked_with_what_it_hides(scene):
    cell, data, _, (alone, state) = scene
    camera = look_at((1.2, 0.0, 0.6), (0.0, 0.0, 0.4), **SMALL)
    image = depth_image(cell.model, data, camera)
    mask = robot_mask(alone, state, camera, image.depth)
    bodies = {name: image.mask(cell.model, name) for name in (OBJECT, TARGET)}
    robot = (image.geoms >= 0) & (image.geoms != cell.model.geom(TABLE_NAME).id) & ~bodies[OBJECT] & ~bodies[TARGET]
    assert robot.sum() > 1000 and mask[robot].all()
    assert mask.sum() < 2 * robot.sum() and not (mask & bodies[OBJECT]).any()


def test_what_cannot_be_segmented_is_refused(scene):
    cell, data, places, own = scene
    with pytest.raises(InputError, match="cameras is empty"):
        segmented_points(cell, data, [], places[0][:3, 3])
    with pytest.raises(InputError, match="noise"):
        segmented_points(cell, data, camera_ring(1, places[0][:3, 3], **SMALL), places[0][:3, 3], noise=-1.0)
    up = look_at((0.5, 0.2, 0.5), (0.5, 0.2, 2.0), **SMALL)
    with pytest.raises(InputError, match="no pixel"):
        segmented_points(cell, data, [up], places[0][:3, 3])
