"""Pictures of an object on a target: clouds where the motions put them, and close-ups with the demonstrated axes."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest
from conftest import carried, composed, random_cloud, random_poses

import tdf_jax as tdf
from tdf_jax._internal.errors import InputError
from tdf_jax.viz.relations import AFTER, BEFORE, TARGET, relation_figure
from tdf_jax.viz.style import CONTACT

PATH = random_poses(1, 4) + [0, 0, 0, 0, 0.3, -0.2, 0.1]
CLOUD, SHELF = random_cloud(0), random_cloud(5, 50)
QUERY = np.random.default_rng(3).uniform(-0.03, 0.03, (8, 3))
AT = np.array([1.0, 0, 0, 0, 0.3, -0.2, 0.1])
NEW, NEW_SHELF = random_cloud(6), random_cloud(7, 60)


@pytest.fixture(scope="module")
def related():
    motion = composed(PATH[-1], inverse(PATH[0])[None])[0]
    contact = np.concatenate([[1.0, 0, 0, 0], carried(motion, CLOUD).mean(axis=0)])
    target = tdf.Target(SHELF - SHELF.mean(axis=0) + contact[4:], QUERY, contact)
    return tdf.Demonstration(
        CLOUD.astype(np.float32), tdf.Trajectory(jnp.asarray(PATH, jnp.float32)), QUERY, target=target
    )


@pytest.fixture(scope="module")
def result():
    """Two candidates; the second is the best."""
    poses = np.stack([random_poses(10, 3), random_poses(11, 3)]).astype(np.float32)
    empty = np.zeros((1, 3, 7), np.float32)
    contacts = random_poses(12, 2)[:, None].astype(np.float32)
    energies = np.array([0.5, 0.2], np.float32)
    return tdf.Result(poses, energies, energies[:, None], empty, energies[:1, None], target_trajectories=contacts)


def inverse(pose):
    turned = np.concatenate([pose[:1], -pose[1:4]])
    return np.concatenate([turned, -carried(np.concatenate([turned, np.zeros(3)]), pose[None, 4:])[0]])


def drawn(axes, colour):
    """Points of a colour, metres."""
    from matplotlib.colors import to_rgba

    (scatter,) = (one for one in axes.collections if hasattr(one, "_offsets3d"))
    chosen = np.all(np.isclose(scatter._facecolors, to_rgba(colour)), axis=1)
    return np.column_stack(scatter._offsets3d)[chosen] / 100


def close(found, expected):
    """The same points, in any order."""
    found, expected = (np.asarray(one)[np.lexsort(np.round(one, 4).T)] for one in (found, expected))
    np.testing.assert_allclose(found, expected, atol=2e-5)


@pytest.mark.parametrize("candidate", [None, 0])
def test_clouds_lie_where_the_motions_put_them(related, result, candidate):
    figure = relation_figure(related, NEW, result, NEW_SHELF, candidate=candidate, title="loss 0.2")
    shown, imitation, shown_close, close_up = figure.axes
    assert figure.get_suptitle() == "loss 0.2"
    motion = composed(PATH[-1], inverse(PATH[0])[None])[0]
    for axes in (shown, shown_close):
        close(drawn(axes, AFTER), carried(motion, CLOUD))
        close(drawn(axes, TARGET), related.target.points)
    contact = carried(related.target.T_world_contact, QUERY)
    close(drawn(shown, BEFORE), CLOUD)
    close(drawn(shown, CONTACT), np.concatenate([contact, carried(inverse(motion), contact)]))

    number = 1 if candidate is None else candidate
    poses, at = result.trajectories[number], result.target_trajectories[number, 0].astype(float)
    motion = composed(poses[-1].astype(float), inverse(poses[0].astype(float))[None])[0]
    contact = carried(at, QUERY)
    close(drawn(imitation, BEFORE), NEW)
    close(drawn(imitation, AFTER), carried(motion, NEW))
    close(drawn(imitation, TARGET), NEW_SHELF)
    close(drawn(imitation, CONTACT), np.concatenate([contact, carried(inverse(motion), contact)]))
    (path,) = imitation.lines
    np.testing.assert_allclose(np.column_stack(path.get_data_3d()), 100 * poses[:, 4:], rtol=1e-5)

    # The close-up is rotated, so that the contact points are where they were demonstrated.
    close(drawn(close_up, CONTACT), drawn(shown_close, CONTACT))
    back = composed(related.target.T_world_contact, inverse(at)[None])[0]
    close(drawn(close_up, TARGET), carried(back, NEW_SHELF))
    close(drawn(close_up, AFTER), carried(back, carried(motion, NEW)))
    assert len(drawn(close_up, BEFORE)) == 0 and not close_up.lines


@pytest.mark.slow
def test_a_target_that_has_not_moved_is_on_both_sides(related, result):
    _, imitation, _, _ = relation_figure(related, NEW, result).axes
    close(drawn(imitation, TARGET), related.target.points)


@pytest.mark.slow
def test_what_has_no_target_or_candidate_is_refused(related, result):
    with pytest.raises(InputError, match=r"relation_figure\(\): the demonstration or the result has no target"):
        relation_figure(dataclasses.replace(related, target=None), NEW, result)
    with pytest.raises(InputError, match="the demonstration or the result has no target"):
        relation_figure(related, NEW, dataclasses.replace(result, target_trajectories=np.zeros((0, 1, 7))))
    with pytest.raises(InputError, match="candidate is 2; expected a whole number from 0 to 1"):
        relation_figure(related, NEW, result, candidate=2)
