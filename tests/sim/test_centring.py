"""Centring: a grasp that is turned and shifted comes back to the middle of the wall or onto the neck of the cloud."""

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from tdf_jax.geometry.sampling import sample_surface
from tdf_jax.geometry.symmetry import ROUND
from tdf_jax.shapes import FAMILIES
from tdf_jax.sim.centring import centred
from tdf_jax.sim.grasps import grip_of
from tdf_jax.sim.necks import CLEARANCE, DEPTHS, LEVEL_STEP, neck_holds


def shape_cloud_and_grip(category, seed, robot):
    family = FAMILIES[category]
    shape = family.build(family.sample(np.random.default_rng(seed)))
    return shape, sample_surface(shape.mesh, 1500, np.random.default_rng(3)), grip_of(shape, robot.fingers)


@pytest.fixture(
    scope="module", params=[("mug", 0), ("mug", 1), ("bowl", 2), ("bottle", 2)], ids=lambda one: f"{one[0]}{one[1]}"
)
def held(request, robot):
    category, seed = request.param
    most = {"mug": (2, 1e-3), "bowl": (3, 1e-3), "bottle": (2, 0.5e-3)}[category]
    return *shape_cloud_and_grip(category, seed, robot)[1:], most


@pytest.fixture(scope="module", params=range(2, 7), ids=lambda seed: f"bottle{seed}")
def neck(request, robot):
    """Bottles with round necks."""
    shape, cloud, grip = shape_cloud_and_grip("bottle", request.param, robot)
    assert grip.fold == ROUND
    return shape, cloud, grip


def section_of(mesh, height):
    """Points of a horizontal section, (points, 3)."""
    return trimesh.intersections.mesh_plane(mesh, (0, 0, 1), (0, 0, height)).reshape(-1, 3)


def moved_grip(T, degrees, shift, fingers):
    """Turned about the x axis at the pads, and shifted along the closing direction."""
    turn = np.eye(4)
    turn[:3, :3] = Rotation.from_euler("x", degrees, degrees=True).as_matrix()
    pads = np.array([0, 0, fingers.depth(0.0)])
    turn[:3, 3] = pads - turn[:3, :3] @ pads + (0, shift, 0)
    return T @ turn


def errors(T, true, fingers):
    """Angle about the x axis, degrees, and offset along the closing direction at the pads, metres."""
    local = np.linalg.inv(true) @ T
    at = local @ [0, 0, fingers.depth(0.0), 1]
    return abs(np.degrees(np.arctan2(local[2, 1], local[1, 1]))), abs(at[1])


def grasp(T, cloud, grip, robot):
    """The best of the centred grasps, 4x4."""
    return centred(T, cloud, grip.opening, robot.fingers)[0].T_world_grip


def test_a_grasp_that_is_turned_and_shifted_comes_back(held, robot):
    cloud, grip, (most_degrees, most_offset) = held
    for degrees, shift in ((15, 0.005), (-15, 0.005), (15, -0.005), (-15, -0.005)):
        T = moved_grip(grip.T_object_grip, degrees, shift, robot.fingers)
        assert errors(T, grip.T_object_grip, robot.fingers)[0] == pytest.approx(15)
        angle, offset = errors(grasp(T, cloud, grip, robot), grip.T_object_grip, robot.fingers)
        assert angle < most_degrees and offset < most_offset, (degrees, shift)


def test_a_grasp_in_the_middle_stays(held, robot):
    cloud, grip, (most_degrees, most_offset) = held
    angle, offset = errors(grasp(grip.T_object_grip, cloud, grip, robot), grip.T_object_grip, robot.fingers)
    assert angle < most_degrees and offset < most_offset


def test_along_a_wall_a_grasp_stays(held, robot):
    """Along x, where the wall goes on, nothing is known."""
    cloud, grip, _ = held
    if grip.fold == ROUND:
        return
    T = moved_grip(grip.T_object_grip, 10, 0.003, robot.fingers)
    local = np.linalg.inv(grip.T_object_grip) @ grasp(T, cloud, grip, robot)
    assert abs(local[0, 3]) < 1e-3
    np.testing.assert_allclose(local[0, :3], (1, 0, 0), atol=0.05)


@pytest.mark.parametrize("degrees", [-15, 15])
def test_a_grasp_turned_about_the_approach_closes_along_the_normal_of_a_wall(held, robot, degrees):
    """Pads that close at an angle to the normal turn the object in the hand by it."""
    cloud, grip, _ = held
    if grip.fold == ROUND:
        return
    turned = grip.T_object_grip.copy()
    turned[:3, :3] = turned[:3, :3] @ Rotation.from_euler("z", degrees, degrees=True).as_matrix()
    found = grasp(turned, cloud, grip, robot)
    assert np.degrees(np.arccos(found[:3, 1] @ grip.T_object_grip[:3, 1])) < 4


def test_the_opening_is_that_of_what_the_cloud_shows(held, robot):
    """The demonstrated one was of another wall or neck."""
    cloud, grip, _ = held
    (found, *_) = centred(grip.T_object_grip, cloud, 0.05, robot.fingers)
    assert found.opening == pytest.approx(grip.opening, abs=4e-3)


@pytest.mark.parametrize("height", [-0.012, 0.0, 0.015])
def test_on_a_neck_a_grasp_comes_to_the_axis_and_to_where_pads_hold(neck, robot, height):
    """Descriptors find the height on a neck to some centimetres, and its axis better."""
    shape, cloud, grip = neck
    T = moved_grip(grip.T_object_grip, 5, 0.004, robot.fingers)
    T[:3, 3] += (0.004, 0, height)
    found = grasp(T, cloud, grip, robot)
    local = np.linalg.inv(grip.T_object_grip) @ found
    assert np.degrees(np.arccos(local[2, 2])) < 5 and np.linalg.norm(local[:2, 3]) < 4e-3
    # By the exact widths, pads hold there well: not at the depth from where they slide off a slope.
    top = shape.mesh.bounds[1, 2]
    levels = np.arange(LEVEL_STEP, DEPTHS[1], LEVEL_STEP)
    widths = 2 * np.array([np.abs(section_of(shape.mesh, top - level)[:, :2]).max() for level in levels])
    holds = neck_holds(levels, widths, top - shape.mesh.center_mass[2], robot.fingers.widest)
    off = [abs(top - one.depth + robot.fingers.tip(one.width) - found[2, 3]) for one in holds]
    near = [one.score for one, distance in zip(holds, off) if distance < 3e-3]
    assert max(near) > 0.2 * max(one.score for one in holds)


@pytest.mark.parametrize("degrees", [(4, 0), (-4, 3), (0, -5)])
def test_the_inside_of_a_hollow_neck_and_a_shoulder_do_not_mislead(robot, degrees):
    neck = trimesh.creation.annulus(r_min=0.012, r_max=0.017, height=0.04)
    shoulder = trimesh.creation.cylinder(radius=0.05, height=0.1)
    neck.apply_translation((0, 0, 0.08))
    shoulder.apply_translation((0, 0, 0.01))
    hollow = trimesh.util.concatenate(neck, shoulder)
    cloud = np.asarray(trimesh.sample.sample_surface(hollow, 3000, seed=0)[0])
    T = np.diag([-1.0, 1.0, -1.0, 1.0])
    T[:3, :3] = Rotation.from_euler("xy", degrees, degrees=True).as_matrix() @ T[:3, :3]
    T[:3, 3] = (0.004, -0.002, 0.08 + robot.fingers.tip(0.034))
    (found,) = centred(T, cloud, 0.06, robot.fingers)
    assert np.degrees(np.arccos(-found.T_world_grip[2, 2])) < 0.5
    at = found.T_world_grip @ (0, 0, robot.fingers.tip(0.034), 1)
    assert np.linalg.norm(at[:2]) < 5e-4 and 0.06 < at[2] < 0.09
    assert found.opening == pytest.approx(0.034 + 2 * CLEARANCE, abs=1.5e-3)


def test_a_tilted_neck_is_held_where_it_swings_least(neck, robot):
    """The closing direction is in the vertical plane of the axis; other turns, a few degrees away, come after it."""
    _, cloud, grip = neck
    tilted = np.eye(4)
    tilted[:3, :3] = Rotation.from_euler("xz", (40, 70), degrees=True).as_matrix()
    found = centred(tilted @ grip.T_object_grip, cloud @ tilted[:3, :3].T, grip.opening, robot.fingers)
    assert len(found) == 3
    for one, most in zip(found, (0.5, 5.5, 5.5)):
        normal = np.cross(tilted[:3, 2], (0, 0, 1))
        normal /= np.linalg.norm(normal)
        assert np.degrees(np.arcsin(abs(one.T_world_grip[:3, 1] @ normal))) < most
    upright = centred(grip.T_object_grip, cloud, grip.opening, robot.fingers)
    assert len(upright) == 1  # no turn is better, so it stays
    np.testing.assert_allclose(upright[0].T_world_grip[:3, 1] @ grip.T_object_grip[:3, 1], 1, atol=2e-3)


def depth_below_rim(T, cloud, fingers):
    """From the first point between the pads to the tips of the closed fingers, along the approach, metres."""
    x, y, z = ((cloud - T[:3, 3]) @ T[:3, :3]).T
    return fingers.tip(0.005) - z[(np.abs(x) < 0.011) & (np.abs(y) < 0.02)].min()


@pytest.mark.parametrize("degrees", [-10, 0, 10])
@pytest.mark.parametrize("seed", [3, 25, 44])
def test_on_a_low_bowl_a_grasp_is_no_deeper_than_shown(robot, seed, degrees):
    """Further down the wall bends into the floor, and pads that follow it slide off."""
    shape, cloud, grip = shape_cloud_and_grip("bowl", seed, robot)
    assert shape.height < 0.04
    shown = depth_below_rim(grip.T_object_grip, cloud, robot.fingers)
    deep = moved_grip(grip.T_object_grip, degrees, 0.0, robot.fingers)
    deep[:3, 3] += 0.008 * deep[:3, 2]
    assert depth_below_rim(deep, cloud, robot.fingers) > shown + 0.005
    found = grasp(deep, cloud, grip, robot)
    assert depth_below_rim(found, cloud, robot.fingers) == pytest.approx(shown, abs=0.0025)
    assert errors(found, grip.T_object_grip, robot.fingers)[0] < 8


def test_on_a_high_wall_a_grasp_keeps_its_depth(robot):
    _, cloud, grip = shape_cloud_and_grip("mug", 0, robot)
    deep = grip.T_object_grip.copy()
    deep[:3, 3] += 0.004 * deep[:3, 2]
    found = grasp(deep, cloud, grip, robot)
    assert depth_below_rim(found, cloud, robot.fingers) == pytest.approx(
        depth_below_rim(deep, cloud, robot.fingers), abs=0.0015
    )


def test_with_nothing_between_the_fingers_a_grasp_stays(held, robot):
    cloud, grip, _ = held
    away = grip.T_object_grip.copy()
    away[:3, 3] += 0.5
    (found,) = centred(away, cloud, grip.opening, robot.fingers)
    np.testing.assert_array_equal(found.T_world_grip, away)
    assert found.opening == grip.opening
