"""Foreign points: what is far from all else, and what does not fit the field of the rest."""

import dataclasses
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import random_cloud

import tdf_jax as tdf
from tdf_jax.networks import encoding, foreign
from tdf_jax.networks.foreign import find_foreign, remote_points

CLOUD = random_cloud(3)
STRAY = np.array([[3.0, 0.0, 0.2]], CLOUD.dtype)


def sphere(count, seed, radius=0.1):
    directions = np.random.default_rng(seed).standard_normal((count, 3))
    return radius * directions / np.linalg.norm(directions, axis=1, keepdims=True)


def patch(count, seed):
    """The side of a wall beside the sphere that touches it."""
    return np.random.default_rng(seed).uniform((0.1, -0.15, -0.1), (0.102, 0.15, 0.1), (count, 3))


class Ball(NamedTuple):
    """What stands for a field: the sphere that fits points best."""

    centre: np.ndarray
    radius: float


def fitted(points) -> Any:
    solution = np.linalg.lstsq(np.c_[2 * points, np.ones(len(points))], (points**2).sum(axis=1))[0]
    return Ball(solution[:3], float(np.sqrt(solution[3] + solution[:3] @ solution[:3])))


@pytest.fixture
def balls(monkeypatch):
    """Fields that are spheres, and how many were encoded."""

    def misfit(ball, points, extent):
        height = np.linalg.norm(points - ball.centre, axis=1) - ball.radius
        return np.minimum(np.abs(height) / extent, foreign.CAP), -1000 * height

    monkeypatch.setattr(foreign, "_misfit", misfit)
    encoded = []

    def find(points):
        encoded.clear()
        return find_foreign(fitted(points), points, lambda part, _: encoded.append(len(part)) or fitted(points[part]))

    return find, encoded


def test_points_that_do_not_fit_the_field_of_the_others_are_found(balls):
    find, _ = balls
    for share in (0.05, 0.1, 0.2):
        count = round(1000 * share / (1 - share))
        points = np.concatenate([sphere(1000, 0), patch(count, 1)])
        finding = find(points)
        apart = np.linalg.norm(points, axis=1) > 0.11
        assert finding.kept[:1000].all() and not finding.kept[apart].any() and apart.sum() > 0.7 * count
        assert np.linalg.norm(finding.field.centre) < 0.001 < np.linalg.norm(fitted(points).centre)


def test_a_clean_cloud_is_judged_by_its_own_field_alone(balls):
    find, encoded = balls
    for noise in (0.0, 0.002):
        points = sphere(600, 2) + noise * np.random.default_rng(3).standard_normal((600, 3))
        finding = find(points)
        assert finding.kept.all() and finding.field is None and not encoded


def test_a_cloud_whose_parts_fit_no_better_loses_no_point(balls):
    """The network does not know this object."""
    find, encoded = balls
    points = np.random.default_rng(4).uniform(-0.1, 0.1, (600, 3)) * [1, 0.6, 0.3]
    assert find(points).kept.all() and len(encoded) > 10


def test_of_too_many_foreign_points_none_is_removed(balls):
    find, _ = balls
    finding = find(np.concatenate([sphere(600, 5), patch(400, 6)]))
    assert finding.field is None and 0.3 < np.mean(~finding.kept) < 0.45


def test_what_is_farther_than_the_object_is_large_is_remote():
    side = np.concatenate([sphere(200, 7), sphere(50, 8) + [0.28, 0, 0]])  # 0.08 m apart: a hidden part between them
    assert not remote_points(side).any()
    far = np.concatenate([sphere(200, 9), [[3.0, 0, 0]], sphere(30, 10) + [0, 1.0, 0], [[0, 0, -0.7]]])
    for shift in (0.0, 57.0):
        np.testing.assert_array_equal(remote_points(far + shift), np.arange(len(far)) >= 200)


def test_a_stray_point_changes_nothing(small_model):
    for place in (0, 13, len(CLOUD)):
        points = np.insert(CLOUD, place, STRAY, axis=0)
        field, kept = tdf.encode(small_model, points, return_kept=True)
        np.testing.assert_array_equal(np.flatnonzero(~kept), [place])
        jax.tree.map(np.testing.assert_array_equal, field, tdf.encode(small_model, CLOUD))
    left, kept = tdf.encode(small_model, points, clean=False, return_kept=True)
    assert kept.all() and np.abs(left.origin - field.origin).max() > 0.01


def test_of_two_large_parts_that_are_far_apart_both_stay_with_a_warning(small_model):
    points = np.concatenate([CLOUD, CLOUD[: len(CLOUD) * 2 // 3] + [5.0, 0, 0]])
    with pytest.warns(tdf.ForeignPointsWarning, match=r"encode\(\): .* of .* none of them is removed"):
        field, kept = tdf.encode(small_model, points, return_kept=True)
    assert kept.all()
    jax.tree.map(np.testing.assert_array_equal, field, tdf.encode(small_model, points, clean=False))


def test_traced_points_are_taken_as_they_are(small_model):
    points = np.concatenate([CLOUD, STRAY]).astype(np.float32)
    kept = []

    @jax.jit
    def origin(points):
        field, mask = tdf.encode(small_model, points, return_kept=True)
        kept.append(mask)
        return field.origin

    np.testing.assert_allclose(origin(jnp.asarray(points)), points.mean(axis=0), atol=1e-6)
    assert kept[0].all()


def test_only_networks_that_know_their_training_clouds_judge_points(small_model, monkeypatch):
    """Converted weights know no density, and a cloud in another unit has no surface where the field has one."""
    judged = []

    def find(field, points, encode_part):
        judged.append(len(points))
        return foreign.Finding(np.ones(len(points), bool), None)

    monkeypatch.setattr(encoding, "find_foreign", find)
    points = np.concatenate([CLOUD] * 4)[:120] * 0.3 / np.linalg.norm(np.ptp(CLOUD, axis=0))
    points += 0.001 * np.random.default_rng(0).standard_normal(points.shape)
    sizes = {"smallest_diagonal": 0.08, "largest_diagonal": 0.5}
    for known, expected in (({}, 0), ({"cloud_points": 120}, 0), (sizes, 0), (sizes | {"cloud_points": 120}, 1)):
        judged.clear()
        model = dataclasses.replace(small_model, info=dataclasses.replace(small_model.info, **known))
        tdf.encode(model, points)
        assert len(judged) == expected
    with pytest.warns(tdf.SizeWarning):
        tdf.encode(model, 100 * (points - points.mean(axis=0)))
    tdf.encode(model, points[:60])
    tdf.encode(model, points, clean=False)
    assert len(judged) == 1


def test_points_near_an_object_are_not_removed_in_silence(small_model, monkeypatch):
    points = np.concatenate([CLOUD] * 4)[:120] * 0.3 / np.linalg.norm(np.ptp(CLOUD, axis=0))
    points += 0.001 * np.random.default_rng(0).standard_normal(points.shape)
    known = {"smallest_diagonal": 0.08, "largest_diagonal": 0.5, "cloud_points": 120}
    model = dataclasses.replace(small_model, info=dataclasses.replace(small_model.info, **known))
    kept = np.arange(len(points)) < 100
    part = tdf.encode(model, points[:100], clean=False)
    monkeypatch.setattr(encoding, "find_foreign", lambda *about: foreign.Finding(kept, part))
    with pytest.warns(tdf.ForeignPointsWarning, match=r"encode\(\): 20 of 120 points are removed.*pass clean=False"):
        field, mask = tdf.encode(model, points, return_kept=True)
    np.testing.assert_array_equal(mask, kept)
    assert field is part


@pytest.mark.slow
def test_a_mug_beside_another_is_encoded_alone():
    rng, model = np.random.default_rng(0), tdf.load_model("mug")
    mug, other = tdf.build_mug(), tdf.build_mug(tdf.MugParameters(height=0.09, handle_style="ring", handle_top=0.075))
    own = tdf.sample_surface(mug.mesh, 1500, 0)
    beside = tdf.sample_surface(other.mesh, 3000, 1)
    beside[:, 1] += own[:, 1].max() + 0.03 - beside[:, 1].min()
    beside = beside[np.argsort(beside[:, 1])[:300]]
    points = np.concatenate([own, beside])
    order = rng.permutation(len(points))
    with pytest.warns(tdf.ForeignPointsWarning, match="300 of 1800 points are removed"):
        field, kept = tdf.encode(model, points[order], return_kept=True)
    np.testing.assert_array_equal(kept, order < 1500)
    assert tdf.encode(model, own, return_kept=True)[1].all()
    jax.tree.map(np.testing.assert_array_equal, field, tdf.encode(model, points[order][kept], clean=False))
    whole = tdf.encode(model, points[order], clean=False)
    assert np.linalg.norm(field.origin - own.mean(axis=0)) < 0.004 < np.linalg.norm(whole.origin - own.mean(axis=0))
