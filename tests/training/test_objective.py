"""The loss of training: the same whether objects are taken one by one or together, and fair to symmetric objects."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import SMALL, random_cloud

from tdf_jax.geometry.symmetry import about_z
from tdf_jax.training import objective
from tdf_jax.training.batch import QUARTERS
from tdf_jax.training.objective import SHARPNESS, mean_gradient, place_error


@pytest.fixture(scope="module")
def samples():
    """A batch of three pairs, of every symmetry, of random numbers."""
    rng = np.random.default_rng(0)
    clouds = np.stack([random_cloud(seed) for seed in range(6)]).reshape(3, 2, 40, 3)
    clouds -= clouds.mean(axis=2, keepdims=True)
    shapes = {"queries": (8, 3), "inside": (8,), "centres": (3,)}
    queries, inside, centres = (0.1 * rng.normal(size=(3, 2, *shape)) for shape in shapes.values())
    fold = np.array([[1, 1], [0, 0], [4, 2]])
    shown, offered = 0.1 * rng.normal(size=(3, 2, 5, 3)), 0.1 * rng.normal(size=(3, 2, QUARTERS + 2, 5, 3))
    return tuple(
        np.asarray(array, np.float32) for array in (clouds, queries, inside > 0, centres, fold, shown, offered)
    )


@pytest.mark.slow
def test_a_batch_taken_together_has_the_gradients_of_its_pairs_one_by_one(small_model, samples, monkeypatch):
    """With clouds displaced from their farthest points, which the encoder then does as well for all at once."""
    config = dataclasses.replace(SMALL, symmetry_breaking_offset=0.1)
    frame = 0.1 * np.random.default_rng(1).normal(size=(config.latent, 3)).astype(np.float32)
    params = {"network": small_model.params, "frame": jnp.asarray(frame)}
    found = {}
    for one_by_one in (True, False):
        monkeypatch.setattr(objective, "one_at_a_time", lambda one_by_one=one_by_one: one_by_one)
        # A function of its own, for what is compiled is kept by function.
        found[one_by_one] = jax.jit(lambda *arguments: mean_gradient(arguments[0], config, *arguments[1:]))(
            params, *samples
        )
    for a, b in zip(jax.tree.leaves(found[True]), jax.tree.leaves(found[False]), strict=True):
        assert a.shape == b.shape
        np.testing.assert_allclose(a, b, atol=1e-4 * max(1e-2, np.abs(b).max()))
    assert found[True][1]["loss"].shape == (3,) and found[True][1]["place"].shape == (3, 2)


@dataclasses.dataclass
class Field:
    """A field whose descriptor of a point is the point itself."""

    def descriptors(self, x):
        return jnp.asarray(x)


def test_of_the_right_poses_of_a_symmetric_object_the_best_counts():
    rng = np.random.default_rng(0)
    shown, wrong = rng.normal(size=(5, 3)), rng.normal(size=(3, 5, 3))
    near = shown + 0.8 * rng.normal(size=(5, 3))

    def energies(poses):
        return np.abs(poses - shown).mean(axis=(1, 2))

    @jax.jit
    def error(offered):
        return place_error(Field(), Field(), jnp.asarray(shown, jnp.float32), offered)

    expected = -np.log(energies(near[None]) ** -SHARPNESS / np.sum(energies(np.stack([near, *wrong])) ** -SHARPNESS))
    turns = [near @ about_z(quarter * np.pi / 2)[:3, :3].T for quarter in range(QUARTERS)]
    for first in range(QUARTERS):
        offered = np.concatenate([np.roll(turns, first, axis=0), wrong]).astype(np.float32)
        np.testing.assert_allclose(error(offered), expected[0], rtol=1e-3)
    # A wrong pose there is no right one, however near.
    offered = np.concatenate([turns[2:3] * QUARTERS, near[None], wrong]).astype(np.float32)
    assert error(offered) > expected[0] + 0.5
