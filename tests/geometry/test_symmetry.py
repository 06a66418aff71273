"""Symmetric objects: the nearest of the equivalent poses, against a search over all rotations."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tdf_jax.geometry.symmetry import FOLDS, ROUND, about_z, equivalent, nearest_turn

STEPS = 1440  # of the search: a quarter of a degree


def turns(fold):
    """The turns about z a symmetry allows; for a round object so many of them."""
    return np.arange(fold or STEPS) * 2 * np.pi / (fold or STEPS)


def turned(points, angle):
    """Points turned about z, by scipy."""
    return Rotation.from_euler("z", angle).apply(points)


def squared(found, truth):
    return np.sum((found - truth) ** 2)


def random_frame(seed, reach=0.1):
    T = np.eye(4)
    T[:3, :3] = Rotation.random(random_state=seed).as_matrix()
    T[:3, 3] = reach * np.random.default_rng(seed).normal(size=3)
    return T


def tips(T, size):
    """The ends of a frame's axes, both ways."""
    points = np.concatenate([np.eye(3), -np.eye(3)]) * size
    return points @ T[:3, :3].T + T[:3, 3]


def test_folds_are_those_that_are_distinguished():
    assert ROUND == 0 and set(FOLDS) == {0, 1, 2, 4}


@pytest.mark.parametrize("angle", [-3.0, -0.4, 0.0, 1.2, np.pi / 2, np.pi])
def test_about_z_turns_x_towards_y(angle):
    np.testing.assert_allclose(about_z(angle)[:3, :3], Rotation.from_euler("z", angle).as_matrix(), atol=1e-12)
    np.testing.assert_array_equal(about_z(angle)[:, 3], [0, 0, 0, 1])
    np.testing.assert_array_equal(about_z(angle)[3], [0, 0, 0, 1])


@pytest.mark.parametrize("fold", FOLDS)
@pytest.mark.parametrize("seed", range(3))
def test_the_nearest_turn_is_the_best_of_all_that_are_allowed(fold, seed):
    """Noisy points off the axis, turned by angles all around: no allowed turn brings the true ones nearer."""
    rng = np.random.default_rng(seed)
    truth = rng.normal(size=(7, 3)) + [0.8, 0.3, 5.0]
    candidates = np.stack([turned(truth, other) for other in turns(fold)])
    for angle in rng.uniform(-np.pi, np.pi, 40):
        found = turned(truth, angle) + 0.3 * rng.normal(size=truth.shape)
        turn = nearest_turn(found, truth, fold)
        assert isinstance(turn, float) and abs(turn) <= np.pi + 1e-9
        distances = np.sum((found - candidates) ** 2, axis=(1, 2))
        assert squared(found, turned(truth, turn)) <= distances.min() + 1e-9
        off = np.abs(np.angle(np.exp(1j * (turns(fold) - turn))))
        assert off.min() < (1e-9 if fold else 2 * np.pi / STEPS)  # it is one of them
        assert off[np.argmin(distances)] <= off.min() + 2 * np.pi / STEPS


@pytest.mark.parametrize("fold", FOLDS)
def test_a_turned_copy_is_turned_back_as_far_as_the_symmetry_allows(fold):
    truth = np.random.default_rng(3).normal(size=(5, 3))
    for angle in np.radians([-170, -95, -50, -44, 0, 10, 44, 46, 89, 91, 134, 136, 179]):
        expected = (
            angle if fold == ROUND else min(turns(fold), key=lambda turn: abs(np.angle(np.exp(1j * (turn - angle)))))
        )
        turn = nearest_turn(turned(truth, angle), truth, fold)
        np.testing.assert_allclose(np.exp(1j * turn), np.exp(1j * expected), atol=1e-9)


def test_heights_do_not_count_but_distances_from_the_axis_do():
    """Far points outweigh near ones, as they move further; points on the axis say nothing."""
    truth = np.array([[1.0, 0, 0], [0.1, 0, 0], [0.1, 0, 0], [0, 0, 0]])
    # the far one by a quarter, the near ones by a half
    found = np.array([[0.0, 1, 3], [-0.1, 0, -2], [-0.1, 0, 0], [0, 0, 9]])
    np.testing.assert_allclose(np.degrees(nearest_turn(found, truth, ROUND)), 90, atol=2)
    np.testing.assert_allclose(np.degrees(nearest_turn(found, truth, 4)), 90)


@pytest.mark.parametrize("fold", FOLDS)
@pytest.mark.parametrize("seed", range(12))
def test_the_equivalent_pose_is_one_of_them_and_the_nearest(fold, seed):
    found, truth, size = random_frame(seed), random_frame(seed + 100), 0.05
    result = equivalent(found, truth, fold, size)
    every = [about_z(turn) @ truth for turn in turns(fold)]
    offs = np.array([np.abs(result - one).max() for one in every])
    assert offs.min() < (1e-12 if fold else 2 * np.pi / STEPS)
    distances = np.array([squared(tips(found, size), tips(one, size)) for one in every])
    assert squared(tips(found, size), tips(result, size)) <= distances.min() + 1e-12
    np.testing.assert_allclose(result[:3, :3] @ result[:3, :3].T, np.eye(3), atol=1e-12)
    np.testing.assert_allclose(result[2], truth[2], atol=1e-12)  # a turn about z leaves heights
    np.testing.assert_array_equal(result[3], [0, 0, 0, 1])


@pytest.mark.parametrize("fold", FOLDS)
def test_every_equivalent_of_the_truth_is_found_without_error_and_answered_by_itself(fold):
    truth = random_frame(5)
    for turn in turns(fold)[:: 1 if fold else 97]:
        found = about_z(turn) @ truth
        np.testing.assert_allclose(equivalent(found, truth, fold, 0.03), found, atol=1e-12)
    if fold:
        between = about_z(np.pi / fold) @ truth  # half way between two of them: none of them
        assert np.abs(equivalent(between, truth, fold, 0.03) - between).max() > 0.01


def test_without_a_symmetry_the_truth_is_the_only_one():
    truth = random_frame(1)
    assert equivalent(about_z(np.pi) @ truth, truth, 1, 0.03) is truth


def test_the_size_weighs_rotations_against_translations():
    """An estimate at the opposite side of the axis: near the rotated truth by position, near the truth by axes."""
    truth, found = np.eye(4), np.eye(4)
    truth[0, 3], found[0, 3] = 0.05, -0.05
    np.testing.assert_allclose(equivalent(found, truth, 2, 0.01), about_z(np.pi) @ truth, atol=1e-12)
    np.testing.assert_allclose(equivalent(found, truth, 2, 0.20), truth, atol=1e-12)
