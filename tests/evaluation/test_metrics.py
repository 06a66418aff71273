"""Measures of a path, by hand."""

import itertools

import numpy as np
import pytest

import tdf_jax as tdf
from tdf_jax.evaluation.cases import random_pose
from tdf_jax.evaluation.metrics import frechet_distance, jerk, longest_step, penetration


def test_the_frechet_distance_is_the_least_longest_leash():
    """Against all ways to walk both paths, listed."""
    rng = np.random.default_rng(0)
    for _ in range(5):
        found, truth = rng.normal(size=(4, 3)), rng.normal(size=(3, 3))
        apart = np.linalg.norm(found[:, None] - truth[None], axis=-1)
        leashes = []
        for steps in itertools.product(((1, 0), (0, 1), (1, 1)), repeat=5):
            at, longest = (0, 0), apart[0, 0]
            for step in steps:
                if at == (3, 2):
                    break
                at = at[0] + step[0], at[1] + step[1]
                if at[0] > 3 or at[1] > 2:
                    break
                longest = max(longest, apart[at])
            if at == (3, 2):
                leashes.append(longest)
        assert frechet_distance(found, truth) == pytest.approx(min(leashes))


def test_the_frechet_distance_does_not_see_spacing_but_does_see_order():
    even, uneven = (np.stack([x, 0 * x, 0 * x], axis=1) for x in (np.linspace(0, 1, 101), np.linspace(0, 1, 101) ** 2))
    assert frechet_distance(even, uneven) < 0.011
    assert frechet_distance(even, even[::-1]) == pytest.approx(1.0)
    assert frechet_distance(even, even + [0, 0.3, 0.4]) == pytest.approx(0.5)


def test_jerk_and_steps():
    time = np.arange(7.0)[:, None]
    assert jerk(time**2 * [1, -2, 0.5] + 3) == pytest.approx(0, abs=1e-9)
    assert jerk(time**3 * [1, 0, 0]) == pytest.approx(6)
    assert jerk(np.zeros((3, 3))) == 0.0
    assert longest_step(time * [0, 0.1, 0]) == pytest.approx(1)
    assert longest_step(np.array([[0, 0, 0], [1, 0, 0], [1, 3, 0]])) == pytest.approx(1.5)
    assert longest_step(np.zeros((4, 3))) == 1.0


def test_penetration_counts_query_points_in_the_solid():
    mug, T_world_mug = tdf.build_mug(), random_pose(0, 0)
    rng = np.random.default_rng(0)
    # Points of the mug's own frame, half of them in the solid, as the query of a pose that is the mug's.
    points = rng.uniform(*mug.mesh.bounds, (20000, 3))
    inside = mug.contains(points)
    chosen = np.concatenate([points[inside][:50], points[~inside][:50]])
    at = tdf.Trajectory.from_matrices(np.stack([T_world_mug, T_world_mug + np.outer([0, 0, 1, 0], [0, 0, 0, 2.0])]))
    assert penetration(at, chosen, mug, T_world_mug) == pytest.approx(0.25, abs=0.011)
