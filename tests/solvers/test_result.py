"""A result on canned numbers: what is best, on batches and traced values, and what it prints."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import random_poses

import tdf_jax as tdf
from tdf_jax._internal.errors import InputError
from tdf_jax.solvers.result import Result


@pytest.fixture(autouse=True)
def nan_is_a_value():
    """Of what is unknown, and of candidates that diverged."""
    with jax.debug_nans(False):
        yield


def canned(energies=(0.3, 0.1, 0.2), starts=6, **known):
    """Three candidates of two poses from six starts."""
    trajectories = jnp.asarray(random_poses(0, 6).reshape(3, 2, 7), jnp.float32)
    return Result(
        trajectories=trajectories,
        energies=jnp.asarray(energies, jnp.float32),
        candidate_history=jnp.full((3, 4), 0.5),
        initial_trajectories=jnp.zeros((starts, 2, 7)),
        history=jnp.full((starts, 4), 0.5),
        **known,
    )


def test_the_best_candidate_is_the_finite_one_of_least_energy():
    result = canned()
    assert type(result.best) is int and result.best == 1 and type(result.loss) is float
    assert result.loss == pytest.approx(0.1)
    np.testing.assert_array_equal(result.trajectory.wxyz_xyz, result.trajectories[1])
    assert result.status == "all 3 candidates finite" and canned(starts=3).status == "all 3 starts finite"
    lost = canned((0.3, np.nan, 0.2))
    assert lost.best == 2 and lost.status == "1 of 3 candidates became non-finite: 1"
    far = dataclasses.replace(canned(), trajectories=canned().trajectories.at[1, 0, 4].set(jnp.inf))
    assert far.best == 2 and not far.finite[1]


def test_no_finite_candidate_is_an_error():
    with pytest.raises(
        InputError, match="Result.best: 3 of 3 candidates became non-finite: 0, 1, 2; check the weights"
    ):
        _ = canned((np.nan, np.inf, np.nan)).trajectory


def test_what_is_unknown_is_nan_and_every_other_field_is_an_array():
    result = canned()
    for field in dataclasses.fields(result):
        if field.name in ("grasp", "release"):
            continue
        assert isinstance(getattr(result, field.name), jax.Array | np.ndarray)
    assert np.isnan([result.residual, result.confidence, result.recognised]).all()


def test_properties_work_on_traced_values_and_on_batches():
    results = [canned(), canned((0.1, 0.3, 0.2)), canned((np.nan, 0.3, 0.2))]
    batch = jax.tree.map(lambda *parts: jnp.stack([jnp.asarray(part) for part in parts]), *results)
    np.testing.assert_array_equal(batch.best, [1, 0, 2])
    np.testing.assert_allclose(batch.loss, [0.1, 0.1, 0.2])
    expected = np.stack([one.trajectory.wxyz_xyz for one in results])
    np.testing.assert_array_equal(batch.trajectory.wxyz_xyz, expected)

    def parts(result):
        return result.best, result.loss, result.trajectory.wxyz_xyz, result.finite

    for traced in (jax.jit(jax.vmap(parts)), jax.jit(parts)):
        best, loss, wxyz_xyz, finite = traced(batch)
        np.testing.assert_array_equal(best, [1, 0, 2])
        np.testing.assert_allclose(loss, [0.1, 0.1, 0.2])
        np.testing.assert_array_equal(wxyz_xyz, expected)
        np.testing.assert_array_equal(finite, batch.finite)
    assert int(jax.jit(parts)(canned((np.nan,) * 3))[0]) == 0  # inside a trace nothing can be raised


def test_it_prints_a_summary():
    result = canned(confidence=np.float32(0.93))
    words = repr(result)
    x, y, z = (f"{value:.3f}" for value in result.trajectories[1, 0, 4:])
    assert f"xyz ({x}, {y}, {z}) m" in words
    assert "0.10000 (others: 0.20000, 0.30000)" in words and "6, 3 final candidates" in words
    assert "0.93 that the pick is right" in words and "recognised  unknown" in words
    modes = tdf.cluster_poses(result.picks, result.energies)
    assert f"{len(modes)} distinct picks" in words
    page = result._repr_html_()
    assert "<table>" in page and page.count("<tr>") == len(words.splitlines()) - 1
    assert "src='data:image/png;base64," in page
    assert "3 of 3 candidates became non-finite" in repr(canned((np.nan,) * 3))


def test_a_doubtful_result_says_where_to_look_from():
    doubtful = {"confidence": np.float32(0.3), "points_at_pick": np.int32(4)}
    somewhere = np.array([0.6, -0.8, 0.0], np.float32)
    assert canned().advice == "" and "advice" not in repr(canned())
    assert canned(confidence=np.float32(0.7), look_from=somewhere).advice == ""
    unseen = canned(**doubtful, look_from=somewhere)
    assert unseen.advice == (
        "its place is not seen (4 points of the cloud are there); look from the direction (0.600, -0.800, 0.000), "
        "a unit vector from the object to the camera, world frame"
    )
    assert unseen.advice in repr(unseen)
    seen = canned(**doubtful | {"points_at_pick": np.int32(300)}, look_from=somewhere)
    assert seen.advice.startswith("look from the direction (0.600")
    assert "compare the other candidates" in canned(**doubtful).advice
    uncounted = canned(confidence=np.float32(0.3), look_from=somewhere)
    assert uncounted.advice == seen.advice
    batch = canned(confidence=np.full(2, 0.3, np.float32))
    with pytest.raises(InputError, match="the result is a batch or traced"):
        _ = batch.advice


def test_it_prints_how_many_points_were_foreign():
    assert "foreign" not in repr(canned())
    words = repr(canned(foreign_points=np.int32(7), target_foreign_points=np.int32(3)))
    assert "foreign points  removed 7 of the object's cloud, 3 of the target's cloud" in words
    assert "removed 3 of the target's cloud" in repr(canned(target_foreign_points=np.int32(3)))


def test_a_batch_and_traced_values_print_their_shapes():
    batch = jax.tree.map(lambda part: jnp.asarray(part)[None], canned())
    assert "(1, 3, 2, 7)" in repr(batch)
    jax.jit(lambda result: repr(result) and result.energies)(canned())
