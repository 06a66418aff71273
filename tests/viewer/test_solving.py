import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import CARRY, carried, composed, random_cloud

import tdf_jax as tdf
from tdf_jax._internal.errors import InputError
from tdf_jax.solvers.imitation_scene import Weights, weights_of
from tdf_jax.viewer import solving


@pytest.fixture(scope="module")
def scene(demonstration, small_model):
    cloud = random_cloud(3).astype(np.float32)
    result = tdf.imitate(small_model, demonstration, cloud, key=jax.random.key(0), config=CARRY, clean=False)
    return tdf.ImitationScene(demonstration, cloud, result, weights=weights_of("small", small_model))


@pytest.fixture(scope="module")
def problem(scene, small_model):
    return solving.problem_of(scene, small_model)


@pytest.fixture(scope="module")
def placed(placed_scene, small_model):
    return solving.problem_of(placed_scene, small_model)


def test_an_imitation_without_a_pick_is_refused(scene, small_model):
    none = np.full_like(np.asarray(scene.result.energies), np.nan)
    without = dataclasses.replace(scene, result=dataclasses.replace(scene.result, energies=none))
    with pytest.raises(InputError, match="tdf view: the imitation has no pick to show"):
        solving.problem_of(without, small_model)


def test_an_energy_of_nought_is_no_error(scene, small_model):
    energies = np.zeros_like(np.asarray(scene.result.energies))
    perfect = dataclasses.replace(scene, result=dataclasses.replace(scene.result, energies=energies))
    found = solving.chosen(solving.problem_of(perfect, small_model), 0)
    assert found.energy == 0 and found.result.first_residual == 0


def test_a_chosen_pick_is_that_of_the_result(problem, scene):
    modes = tdf.cluster_poses(scene.result.picks, scene.result.energies)
    for number, mode in enumerate(modes):
        found = solving.chosen(problem, number)
        np.testing.assert_array_equal(found.pick, mode.pose)
        assert found.energy == mode.energy and found.seconds is None
        np.testing.assert_allclose(problem.energy_in_place(found.pick_in_place), mode.energy, rtol=1e-3)
        path = solving.path_between(problem, found.pick, found.goal)
        np.testing.assert_allclose(path, found.path, atol=1e-5)


def test_a_goal_is_the_end_of_the_path(problem):
    found = solving.chosen(problem, 0)
    goal = found.goal + np.float32([0, 0, 0, 0, 0.1, -0.2, 0.05])
    moved = solving.with_goal(problem, goal, found)
    np.testing.assert_allclose(moved.path[-1], goal, atol=1e-5)
    np.testing.assert_array_equal(moved.pick, found.pick)
    expected = tdf.carry_trajectory(problem.reference.trajectory, jnp.asarray(found.pick), jnp.asarray(goal))
    np.testing.assert_allclose(moved.path, expected.wxyz_xyz, atol=1e-5)


def test_approach_and_retreat_move_with_the_ends(demonstration, small_model):
    longer = dataclasses.replace(demonstration, grasp=1, release=2)
    cloud = random_cloud(3).astype(np.float32)
    result = tdf.imitate(small_model, longer, cloud, key=jax.random.key(0), config=CARRY, clean=False)
    problem = solving.problem_of(tdf.ImitationScene(longer, cloud, result), small_model)
    found = solving.chosen(problem, 0)
    np.testing.assert_allclose(solving.path_between(problem, found.pick, found.goal), found.path, atol=1e-5)


def test_a_lost_pick_is_found_from_many_starts(problem, monkeypatch):
    last = solving.chosen(problem, 0)
    motion = np.float32([1, 0, 0, 0, 0.02, 0.0, 0.0])
    assert solving.dragged(problem, motion, last).tracked
    none = dataclasses.replace(last, result=dataclasses.replace(last.result, first_residual=np.float32(np.nan)))
    lost = dataclasses.replace(last, result=dataclasses.replace(last.result, first_residual=np.float32(1e-6)))
    monkeypatch.setattr(solving, "carry", functools.partial(tdf.carry, config=CARRY))
    for one in (none, lost):
        found = solving.dragged(problem, motion, one)
        assert not found.tracked and np.isfinite(found.energy)


@pytest.mark.slow
def test_the_pick_follows_a_dragged_object():
    """Of the shipped network: the pick of the moved cloud is the moved pick, as its latent turns with the cloud."""
    from tdf_jax.evaluation.cases import generated_case, place_demonstration

    model, pair = tdf.load_model("mug"), generated_case("mug", 60, 0, points=1500)
    query = tdf.box_query(jax.random.key(1), 64, (0.04, 0.04, 0.04))
    shown = place_demonstration(pair, "wave", 5, query)
    result = tdf.imitate(model, shown, pair.points_b, key=jax.random.key(0))
    problem = solving.problem_of(tdf.ImitationScene(shown, pair.points_b, result), model)
    last = solving.chosen(problem, 0)
    rng = np.random.default_rng(0)
    for turn, shift in ((0.0, 0.08), (0.5, 0.03), (2.0, 0.1)):
        axis = rng.normal(size=3)
        axis *= np.sin(turn / 2) / np.linalg.norm(axis)
        centre = problem.points.mean(axis=0)
        motion = np.array([np.cos(turn / 2), *axis, 0, 0, 0])
        motion[4:] = centre - carried(motion, centre[None])[0] + shift
        found = solving.dragged(problem, motion, last)
        expected = composed(motion, last.pick[None])[0]
        np.testing.assert_allclose(found.pick[4:], expected[4:], atol=0.002)
        assert abs(found.pick[:4] @ expected[:4]) > np.cos(np.radians(2) / 2)
        np.testing.assert_allclose(found.energy, last.energy, rtol=0.05)
        np.testing.assert_allclose(problem.energy_in_place(found.pick_in_place), found.energy, rtol=0.02)
        np.testing.assert_array_equal(found.goal, last.goal)
        assert found.tracked
        assert found.confidence == pytest.approx(float(result.confidence), abs=0.05) and min(found.seconds) > 0


@pytest.mark.parametrize("number", [0, 1])
def test_the_path_to_a_target_is_that_of_the_result(placed, number):
    """By another way: `imitate` warps the path of the reference, and the viewer that of the demonstration."""
    found = solving.chosen(placed, number)
    assert len(found.path) > placed.scene.demonstration.trajectory.num_poses  # made denser
    path = solving.path_between(placed, found.pick, found.goal, found.to_target)
    np.testing.assert_allclose(path, found.path, atol=1e-4)
    index = int(placed.modes[number].members[0])
    contact = placed.scene.result.target_trajectories[index, 0]
    np.testing.assert_allclose(solving.contact_of(placed, found), contact, atol=1e-5)


def test_the_arrival_at_a_target_moves_with_the_goal(placed):
    last = solving.chosen(placed, 0)
    shift = np.float32([0, 0, 0, 0, 0.1, -0.2, 0.05])
    moved = solving.with_goal(placed, last.goal + shift, last)
    assert moved.path.shape == last.path.shape
    np.testing.assert_allclose(moved.path[-3:], last.path[-3:] + shift, atol=1e-4)
    np.testing.assert_allclose(moved.path[0], last.path[0], atol=1e-4)
    contacts = [solving.contact_of(placed, one) for one in (moved, last)]
    np.testing.assert_allclose(contacts[0], contacts[1] + shift, atol=1e-4)
    back = solving.with_goal(placed, last.goal, moved)
    np.testing.assert_allclose(back.path, last.path, atol=1e-4)


def test_energies_of_picks_for_a_target_are_without_the_contact_regions(placed):
    last = solving.chosen(placed, 0)
    assert last.energy < placed.modes[0].energy
    assert last.energy == placed.energy_in_place(last.pick_in_place)
    still = solving.dragged(placed, solving.IDENTITY, last)
    np.testing.assert_allclose(still.energy, last.energy, rtol=0.1)


def test_an_object_on_a_target_keeps_its_place_there(placed):
    """The object's motion from its initial pose to its place is the same place of the dragged object."""
    last = solving.chosen(placed, 0)
    motion = np.float32([1, 0, 0, 0, 0.02, -0.01, 0.03])
    found = solving.dragged(placed, motion, last)
    assert found.path.shape == last.path.shape
    np.testing.assert_allclose(found.path[-1, 4:], found.goal[4:], atol=1e-5)
    point = random_cloud(9)[:1]  # of the object in its initial pose

    def ends(found, at):
        there = composed(found.goal, np.array([[1.0, 0, 0, 0, *carried(_inverse(found.pick), at)[0]]]))
        return there[0, 4:]

    np.testing.assert_allclose(ends(found, point + motion[4:]), ends(last, point), atol=1e-4)


def _inverse(pose):
    from tdf_jax.geometry import se3

    return np.asarray(se3.inverse(jnp.asarray(pose)))


def test_a_ray_hits_the_first_point_near_it():
    points = np.array([[0.0, 0, 1], [0.001, 0, 2], [0.1, 0, 0.5], [0, 0, -1]])
    origin, up = np.zeros(3), np.array([0.0, 0, 2])
    np.testing.assert_array_equal(solving.point_under(points, origin, up, 0.01), points[0])
    np.testing.assert_array_equal(solving.point_under(points, origin, -up, 0.01), points[3])
    assert solving.point_under(points, origin, np.array([0.0, 1, 0]), 0.01) is None


def test_weights_are_those_of_the_scene_or_refused(scene, small_model, weights, tmp_path):
    name = str(weights)
    kept = dataclasses.replace(scene, weights=weights_of(name, tdf.load_model(name)))
    assert solving.model_of(kept, None).info.name == "small"
    assert solving.model_of(kept, name).info.name == "small"
    with pytest.raises(InputError, match="names no weights; expected --weights"):
        solving.model_of(dataclasses.replace(scene, weights=None), None)
    gone = dataclasses.replace(scene, weights=Weights(str(tmp_path / "gone.safetensors"), "x"))
    with pytest.raises(InputError, match="made with the weights .*gone.safetensors, and there is no such file"):
        solving.model_of(gone, None)
    with pytest.raises(InputError, match="are not those that the imitation was made with"):
        solving.model_of(dataclasses.replace(kept, weights=Weights(name, "0123456789abcdef")), None)


def test_the_surface_lies_about_the_object(problem):
    pytest.importorskip("igl")
    triangles = solving.reconstructed(problem)
    assert triangles.ndim == 3 and triangles.shape[1:] == (3, 3)
