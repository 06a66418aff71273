"""Relations: object and target found each for itself, and the motion between them, against known motions."""

import dataclasses
import functools
from types import SimpleNamespace
from typing import Any, cast

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import QUERIES, carried, composed, random_cloud, random_poses

import tdf_jax as tdf
from tdf_jax._internal.errors import InputError
from tdf_jax.evaluation.relation_success import judge
from tdf_jax.evaluation.relation_tasks import demonstrate, draw_pair, place_pair
from tdf_jax.geometry import se3
from tdf_jax.geometry.transport import BEYOND, NEAR, arrival_depth, arrival_of, carry_to_target
from tdf_jax.relation import object_motion, regions, two_objects
from tdf_jax.uncertainty.calibration import ONE_NETWORK_CURVES, TARGET_CURVES

KEY = jax.random.key(3)
carried_path = jax.jit(carry_to_target)
SEARCH = tdf.CarryConfig(num_starts=256, num_coarse_queries=8, coarse_steps=10, polish_steps=60)
G_OBJECT, G_TARGET = (pose * [1, 1, 1, 1, 3, 3, 3] for pose in random_poses(21, 2))
TARGET_CLOUD = random_cloud(8) * [1.2, 0.8, 1.0] + [0.05, 0.3, 0.0]
CONTACT = np.array([1.0, 0, 0, 0, 0.32, 0.08, 0.11])


@pytest.fixture(scope="module")
def related(demonstration):
    """A demonstration of four poses whose object ends at a target; the contact points are between the two."""
    query = tdf.box_query(jax.random.key(7), count=QUERIES, size=0.08)
    released = carried(motion_of(demonstration), np.asarray(demonstration.points, np.float64))
    contact = CONTACT.copy()
    contact[4:] = released.mean(axis=0)  # the released object's own place, so that it meets the target
    target = tdf.Target(TARGET_CLOUD - TARGET_CLOUD.mean(axis=0) + contact[4:] + [0.05, 0.05, 0.0], query, contact)
    return dataclasses.replace(demonstration, target=target)


def motion_of(demonstration):
    poses = jnp.asarray(demonstration.trajectory.wxyz_xyz)
    return np.asarray(se3.compose(poses[-1], se3.inverse(poses[0])), np.float64)


def matrices(wxyz_xyz):
    return np.asarray(tdf.Trajectory(jnp.asarray(wxyz_xyz, jnp.float32).reshape(-1, 7)).matrices)


def inverted(pose):
    return np.asarray(se3.inverse(jnp.asarray(pose)), np.float64)


@pytest.fixture(scope="module")
def moved(related):
    """The demonstrated objects in other poses, and the motion that repeats the relation."""
    points = carried(G_OBJECT, np.asarray(related.points, np.float64))
    target = carried(G_TARGET, np.asarray(related.target.points, np.float64))
    expected = composed(G_TARGET, composed(motion_of(related), inverted(G_OBJECT)[None]))[0]
    return points, target, expected


@pytest.fixture(scope="module")
def result(small_model, related, moved):
    return tdf.imitate(small_model, related, moved[0], target_points=moved[1], key=KEY, config=SEARCH)


def test_the_object_goes_where_it_was_on_the_target(related, moved, result, small_model):
    # The random network is not as sharp as a trained one: 2 degrees and 3 cm, where a wrong frame is off by all of it.
    np.testing.assert_allclose(matrices(result.object_motion), matrices(moved[2]), atol=0.05)
    np.testing.assert_allclose(
        matrices(result.goal), matrices(composed(moved[2], np.asarray(result.pick)[None])), atol=0.05
    )
    alone = tdf.relate(small_model, related, points=moved[0], target_points=moved[1], key=KEY, config=SEARCH)
    np.testing.assert_allclose(matrices(alone), matrices(result.object_motion), atol=1e-5)


def test_the_pick_for_a_target_is_tracked(small_model, related, moved, result):
    """The path of the result is denser than the demonstration, of which `track` needs the pick alone."""
    reference = tdf.describe(small_model, related)
    assert result.trajectories.shape[1] > reference.trajectory.num_poses
    shift = np.array([1.0, 0, 0, 0, 0.02, -0.01, 0.03])
    field = tdf.encode(small_model, carried(shift, moved[0]).astype(np.float32))
    found = tdf.track(field, reference, result, goal=result.goal)
    assert not found.lost and found.trajectories.shape[1] == reference.trajectory.num_poses
    np.testing.assert_allclose(found.goal, result.goal, atol=1e-5)
    poses = related.trajectory.wxyz_xyz
    approached = dataclasses.replace(related, trajectory=tdf.Trajectory(jnp.concatenate([poses[:1], poses])), grasp=1)
    longer = tdf.describe(small_model, approached)
    with pytest.raises(InputError, match=r"has its grasp at pose 0 .*expected 1 and -1"):
        tdf.track(field, longer, result, goal=result.goal)


def test_every_candidate_ends_where_its_own_pick_and_motion_lead(result):
    """M is X_t inverse(X_o), the same for all picks of one relation."""
    picks, ends = np.asarray(result.picks), np.asarray(result.trajectories)[:, result.release]
    motions = np.stack([composed(end, inverted(pick)[None])[0] for pick, end in zip(picks, ends)])
    contacts = np.asarray(result.target_trajectories)[:, 0]
    assert contacts.shape == (len(picks), 7) and len(picks) > 1
    assert (np.diff(result.energies) >= 0).all() and result.best == 0
    pairs = {(tuple(np.round(pick, 2)), tuple(np.round(motion, 2))) for pick, motion in zip(picks, motions)}
    assert len(pairs) == len(picks)  # no candidate is there twice
    same = np.array([np.allclose(matrices(motion), matrices(motions[0]), atol=1e-4) for motion in motions])
    assert same.sum() > 1  # several picks share the best motion, each with its own end
    assert (
        len({tuple(np.round(pick, 3)) for pick in picks[same]})
        == len({tuple(np.round(end, 3)) for end in ends[same]})
        > 1
    )
    assert np.isfinite(result.target_residual) and np.isnan(result.target_confidence)


def test_the_pick_is_that_of_the_demonstration_without_a_target(small_model, related, moved, result):
    plain = dataclasses.replace(related, target=None)
    alone = tdf.imitate(small_model, plain, moved[0], key=KEY, config=SEARCH, fix_last=False)
    np.testing.assert_allclose(result.pick, alone.pick, atol=1e-6)


def test_a_target_that_stands_where_it_stood_needs_no_cloud(small_model, related, moved):
    found = tdf.imitate(small_model, related, moved[0], key=KEY, config=SEARCH)
    expected = composed(motion_of(related), inverted(G_OBJECT)[None])[0]
    np.testing.assert_allclose(matrices(found.object_motion), matrices(expected), atol=0.02)
    np.testing.assert_allclose(found.target_trajectories[0, 0], related.target.T_world_contact, atol=1e-6)
    assert np.isnan(found.target_residual)


def test_a_network_of_a_target_that_stands_where_it_stood_seats_the_object(small_model, related, moved, monkeypatch):
    seen = []

    def touch(field, target, points, target_points, motions, directions):
        seen.append(target)
        return np.full(len(motions), 0.004)

    monkeypatch.setattr("tdf_jax.relation.object_motion.touch_distances", touch)
    reference = tdf.describe(small_model, related, target_model=small_model)
    reference = dataclasses.replace(reference, contact=dataclasses.replace(reference.contact, touch=jnp.zeros(())))
    options = {"points": moved[0], "key": KEY, "config": SEARCH}
    alone = tdf.relate(small_model, reference, **options)
    both = tdf.relate(small_model, reference, target_model=small_model, **options)
    np.testing.assert_array_equal(alone, both)  # the contact region stays where it was
    assert seen[0] is None
    there = tdf.encode(small_model, related.target.points)
    np.testing.assert_allclose(seen[-1].latent, there.latent, atol=1e-6)


@pytest.mark.parametrize(("distances", "kept"), [((np.nan, 0.004, np.nan, -0.002), [1, 3]), ((np.nan,) * 4, range(4))])
def test_motions_that_do_not_touch_the_target_are_left_out_where_others_do(monkeypatch, distances, kept):
    poses = np.tile(np.float32([1, 0, 0, 0, 0, 0, 0]), (4, 1))
    poses[:, 4] = range(4)
    found = object_motion.Relations(poses, poses, np.arange(4.0), np.full((4, 3), np.nan, np.float32), 0.1)
    contact = cast(Any, SimpleNamespace(touch=0.0, target_points=np.zeros((1, 3)), down=jnp.array([0.0, 0.0, -1.0])))
    objects = two_objects.Objects(np.zeros((1, 3)), None, cast(Any, None), None)
    monkeypatch.setattr(object_motion, "touch_distances", lambda *_: np.array(distances))
    seated = object_motion._seated(objects, found, contact)
    np.testing.assert_array_equal(seated.energies, np.arange(4.0)[list(kept)])
    np.testing.assert_array_equal(seated.target_contacts, poses[list(kept)])
    np.testing.assert_array_equal(seated.object_contacts, poses[list(kept)])
    np.testing.assert_allclose(seated.seatings[:, 2], -np.array(distances)[list(kept)])


def test_along_a_rod_the_nearest_place_is_taken_where_the_object_is_free_of_the_post():
    rng = np.random.default_rng(0)

    def rod():
        angle, along = rng.uniform(0, 2 * np.pi, 900), rng.uniform(-0.1, 0.1, 900)
        return np.stack([along, 0.005 * np.cos(angle), 0.005 * np.sin(angle)], axis=1)

    post = np.stack([np.full(60, -0.05), np.zeros(60), np.linspace(-0.1, 0.1, 60)], axis=1)
    contact = cast(
        Any,
        SimpleNamespace(
            query=rng.uniform(-0.03, 0.03, (200, 3)),
            T_world_contact=np.array([1.0, 0, 0, 0, 0, 0, 0]),
            target_points=rod(),
            down=np.array([0.0, 0.0, -1.0]),
        ),
    )
    found = {}
    for name, centre in {"in the post": -0.04, "free": 0.04}.items():

        def occupancy(x, centre=centre):  # of a ball beside the contact
            return jax.nn.sigmoid(2000 * (0.02 - jnp.linalg.norm(x - jnp.array([centre, 0.0, -0.03]), axis=-1)))

        points = np.concatenate([rod(), post])
        objects = two_objects.Objects(points, points, cast(Any, SimpleNamespace(occupancy=occupancy)), None)
        above = np.float32([[1, 0, 0, 0, 0, 0, 0.012]])
        found[name] = regions.registered_contacts(above, np.float32([1, 0, 0, 0, 0, 0, 0]), objects, contact)[0]
    assert np.abs(found["free"][4:]).max() < 0.004  # on the rod's axis, where it was along it
    moved = found["in the post"][4:] - found["free"][4:]
    assert 0.009 < moved[0] < 0.02 and np.abs(moved[1:]).max() < 0.004


def test_a_target_of_another_category_is_warned_of(small_model, related, moved, monkeypatch):
    reference = tdf.describe(small_model, related, target_model=small_model)
    options = {"points": moved[0], "target_points": moved[1], "key": KEY, "config": SEARCH}
    monkeypatch.setitem(TARGET_CURVES, "small", (-50.0, 0.0, 0.0))
    with pytest.warns(tdf.CategoryWarning, match="the target does not look like one .* check target_points"):
        tdf.imitate(small_model, reference, **options)
    with pytest.warns(tdf.CategoryWarning, match=r"relate\(\): the target does not look like one"):
        tdf.relate(small_model, reference, **options)
    monkeypatch.setitem(TARGET_CURVES, "small", (50.0, 0.0, 0.0))
    tdf.imitate(small_model, reference, **options)  # without a warning, which would be an error
    tdf.relate(small_model, reference, **options)


def test_weights_that_do_not_know_the_demonstrated_target_are_warned_of(small_model, related, moved, monkeypatch):
    options = {"points": moved[0], "target_points": moved[1], "key": KEY, "config": SEARCH}
    reference = tdf.describe(small_model, related, target_model=small_model)
    field, points = tdf.encode(small_model, related.target.points), related.target.points
    logits = np.clip(np.log(field.occupancy(points)) - np.log1p(-field.occupancy(points)), -3, 3)
    np.testing.assert_allclose(reference.contact.target_logits, [logits.mean(), np.abs(logits).mean()], atol=1e-4)
    monkeypatch.setitem(ONE_NETWORK_CURVES, "small", (-50.0, 0.0, 0.0))
    for call in (tdf.imitate, tdf.relate):
        for shown in (related, reference):
            message = rf"{call.__name__}\(\): the demonstrated target does not look like .* expected target_model"
            with pytest.warns(tdf.CategoryWarning, match=message):
                call(small_model, shown, **options)
    # Another network describes the target, or none.
    other = dataclasses.replace(small_model, info=tdf.ModelInfo("other", "random numbers"))
    tdf.relate(small_model, related, target_model=other, **options)  # a warning would be an error
    tdf.relate(small_model, related, **{**options, "target_points": None})
    monkeypatch.setitem(ONE_NETWORK_CURVES, "small", (50.0, 0.0, 0.0))
    tdf.relate(small_model, related, **options)


def test_a_target_is_looked_for_by_the_network_that_described_it(small_model, related, moved):
    other = dataclasses.replace(small_model, info=tdf.ModelInfo("rack", "a training run"))
    reference = tdf.describe(small_model, related, target_model=other)
    options = {"points": moved[0], "target_points": moved[1], "key": KEY, "config": SEARCH}
    for call in (tdf.relate, tdf.imitate):
        message = (
            rf"{call.__name__}\(\): the weights of the target are 'small' .* described by 'rack' \(a training run\)"
        )
        with pytest.raises(InputError, match=message + ".* expected target_model as for describe"):
            call(small_model, reference, **options)
    assert np.isfinite(tdf.relate(small_model, reference, target_model=other, **options)).all()
    # Of a target that has not moved the descriptors are not used.
    assert np.isfinite(tdf.relate(small_model, reference, points=moved[0], key=KEY, config=SEARCH)).all()


def test_a_shared_reference_gives_the_same(small_model, related, moved, result):
    reference = tdf.describe(small_model, related, target_model=small_model)
    again = tdf.imitate(small_model, reference, moved[0], target_points=moved[1], key=KEY, config=SEARCH)
    np.testing.assert_array_equal(again.trajectories, result.trajectories)
    with pytest.raises(InputError, match=r"expected describe\(model, demonstration, target_model"):
        plain = tdf.describe(small_model, related)
        tdf.imitate(small_model, plain, moved[0], target_points=moved[1], key=KEY, config=SEARCH)


def test_foreign_points_of_both_clouds_change_nothing(small_model, related, moved, result):
    points, target = (np.insert(cloud, 5, [3.0, -2.0, 1.0], axis=0) for cloud in moved[:2])
    found = tdf.imitate(small_model, related, points, target_points=target, key=KEY, config=SEARCH)
    assert (found.foreign_points, found.target_foreign_points) == (1, 1)
    assert (result.foreign_points, result.target_foreign_points) == (0, 0)
    np.testing.assert_array_equal(found.trajectories, result.trajectories)
    np.testing.assert_array_equal(found.target_residual, result.target_residual)
    options = {"key": KEY, "config": SEARCH}
    motions = [
        tdf.relate(small_model, related, points=points, target_points=target, **options),
        tdf.relate(small_model, related, points=moved[0], target_points=moved[1], clean=False, **options),
        tdf.relate(small_model, related, points=points, target_points=target, clean=False, **options),
    ]
    np.testing.assert_array_equal(motions[0], motions[1])
    assert np.abs(motions[2] - motions[1]).max() > 1e-3


def test_a_batch_shares_the_target(small_model, related, moved, result):
    options = {"target_points": moved[1], "config": SEARCH}
    (one,) = tdf.imitate_batch(small_model, related, [moved[0]], key=KEY, **options)
    alone = tdf.imitate(small_model, related, moved[0], key=jax.random.fold_in(KEY, 0), **options)
    np.testing.assert_array_equal(one.trajectories, alone.trajectories)


# The path between


def test_a_path_that_does_not_move_ends_at_the_goal():
    poses = np.tile(random_poses(40, 1), (5, 1))
    pick, goal, motion = (jnp.asarray(pose) for pose in random_poses(41, 3))
    found = carried_path(tdf.Trajectory(jnp.asarray(poses)), pick, goal, motion).wxyz_xyz
    np.testing.assert_allclose(matrices(found[jnp.array([0, -1])]), matrices(jnp.stack([pick, goal])), atol=1e-5)


def test_a_path_leaves_upwards_and_arrives_as_demonstrated_relative_to_the_target():
    path = tdf.lift_over(60, (0.4, 0.0, 0.05), (0.0, 0.3, 0.2))
    poses = np.asarray(path.wxyz_xyz, np.float64)
    pick, goal, target_motion = random_poses(30, 3)
    found = np.asarray(carried_path(path, jnp.asarray(pick), jnp.asarray(goal), jnp.asarray(target_motion)).wxyz_xyz)
    length = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(poses[:, 4:], axis=0), axis=1))])
    begin, end = length <= 0.05, length >= length[-1] - 0.08
    A = composed(pick, inverted(poses[0])[None])[0]
    leaving = composed(A, poses[begin])
    # the displacement is turned about the vertical alone: the angle by which A's swing-twist about z turns
    yaw = 2 * np.arctan2(A[3], A[0])
    about_z = np.array([[np.cos(yaw), -np.sin(yaw), 0], [np.sin(yaw), np.cos(yaw), 0], [0, 0, 1]])
    leaving[:, 4:] = pick[4:] + (poses[begin, 4:] - poses[0, 4:]) @ about_z.T
    assert np.ptp(leaving[:, 6]) > 0.04  # it is lifted, however the object lies
    np.testing.assert_allclose(matrices(found[begin]), matrices(leaving), atol=1e-5)
    # D_i inverse(D), conjugated by the motion of the target, then the goal
    relative = np.stack([composed(pose, inverted(poses[-1])[None])[0] for pose in poses[end]])
    moved = [composed(target_motion, composed(D, inverted(target_motion)[None]))[0] for D in relative]
    expected = np.stack([composed(D, goal[None])[0] for D in moved])
    np.testing.assert_allclose(matrices(found[end]), matrices(expected), atol=1e-5)
    assert np.linalg.norm(np.diff(found[:, 4:], axis=0), axis=1).max() < 0.2  # no jump between them


@pytest.mark.parametrize("upright", [True, pytest.param(False, marks=pytest.mark.slow)])
def test_a_target_that_moved_with_the_object_moves_the_whole_path(upright):
    path = tdf.lift_over(60, (0.4, 0.0, 0.05), (0.0, 0.3, 0.2))
    G = random_poses(31, 1)[0]
    if upright:
        G[1:3] = 0  # about the vertical
        G[:4] /= np.linalg.norm(G[:4])
    expected = composed(G, np.asarray(path.wxyz_xyz, np.float64))
    ends = jnp.asarray(expected[0]), jnp.asarray(expected[-1]), jnp.asarray(G)
    carry = carried_path if upright else functools.partial(carry_to_target, upright=False)
    np.testing.assert_allclose(matrices(carry(path, *ends).wxyz_xyz), matrices(expected), atol=1e-5)


# Contact points and bad input


def test_two_clouds_of_one_object_are_no_object_and_target(small_model, related, moved):
    rng = np.random.default_rng(0)
    ball = rng.normal(size=(800, 3))
    ball = 0.05 * ball / np.linalg.norm(ball, axis=1, keepdims=True)
    with pytest.raises(InputError, match=r"relate\(\): the object's points lie on the target's surface"):
        tdf.relate(small_model, related, points=ball[:400], target_points=ball[400:], key=KEY, config=SEARCH)
    with pytest.raises(InputError, match="points"):  # no traceback of what compares the clouds
        tdf.relate(small_model, related, points=ball[:400, :2], target_points=ball[400:], key=KEY, config=SEARCH)
    with pytest.raises(InputError, match=r"relate\(\): config is .*; expected a CarryConfig"):
        tdf.relate(small_model, related, points=moved[0], target_points=moved[1], key=KEY, config=tdf.SolveConfig())


def test_the_touch_of_a_traced_demonstration_is_not_known(small_model, related):
    @jax.jit
    def touch(poses):
        demonstration = dataclasses.replace(related, trajectory=tdf.Trajectory(poses))
        return tdf.describe(small_model, demonstration, target_model=small_model).contact.touch

    assert np.isinf(touch(related.trajectory.wxyz_xyz))


def test_contact_points_are_where_two_clouds_meet():
    rng = np.random.default_rng(0)
    low, high = rng.uniform(-1, 1, (400, 3)) * [0.1, 0.1, 0.05], rng.uniform(-1, 1, (400, 3)) * [0.02, 0.02, 0.05]
    points = tdf.contact_query(low, high + [0.05, 0.02, 0.1], KEY, 200, spread=0.005)
    np.testing.assert_allclose(np.mean(points, axis=0), [0.05, 0.02, 0.05], atol=0.012)
    assert points.shape == (200, 3) and np.std(points, axis=0).max() < 0.03
    with pytest.raises(InputError, match=r"contact_query\(\): the clouds are .* m apart; expected them to meet"):
        tdf.contact_query(low, high + [5, 0, 0], KEY)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"goal": CONTACT}, "goal, and the demonstration has a target"),
        ({"goal_offset": (0, 0, 0.1)}, "goal_offset, and the demonstration has a target"),
        ({"fix_last": False}, "fix_last=False, and the demonstration has a target"),
        ({"config": tdf.SolveConfig()}, "config is SolveConfig, and the demonstration has a target"),
        ({"target_points": np.ones((5, 3))}, "expected at least 21"),
    ],
)
def test_what_contradicts_a_target_is_refused(small_model, related, moved, changes, message):
    with pytest.raises(InputError, match=message):
        tdf.imitate(small_model, related, moved[0], key=KEY, **{"config": SEARCH, **changes})


def test_targets_that_cannot_be_are_refused(small_model, demonstration, related, moved):
    with pytest.raises(InputError, match=r"imitate\(\): there is a target, and the demonstration has none"):
        tdf.imitate(small_model, demonstration, moved[0], target_points=moved[1], key=KEY)
    with pytest.raises(InputError, match=r"relate\(\): the demonstration has no target"):
        tdf.relate(small_model, demonstration, points=moved[0], key=KEY)
    with pytest.raises(InputError, match="40 of the 40 points of the object are points of the target too"):
        tdf.imitate(small_model, related, moved[0], target_points=moved[0], key=KEY, config=SEARCH)
    far = np.array([1.0, 0, 0, 0, 9, 9, 9])
    with pytest.raises(InputError, match=r"Target\(\): the contact points are .* m from the target"):
        dataclasses.replace(related.target, T_world_contact=far)
    query = np.asarray(related.target.query)
    low, high = (side(related.target.points, axis=0) for side in (np.min, np.max))
    beside = np.array([1.0, 0, 0, 0, *(high - query.min(axis=0))]) + 0.25 * np.linalg.norm(high - low) * np.eye(7)[6]
    with pytest.raises(InputError, match=r"Target\(\): the contact points are .* m from the target"):
        dataclasses.replace(related.target, T_world_contact=beside)
    moved_frame = np.asarray(related.target.T_world_contact) + [0, 0, 0, 0, 9, 9, 9]
    away = tdf.Target(np.asarray(related.target.points) + far[4:], related.target.query, moved_frame)
    with pytest.raises(InputError, match="m from the object, moved to the release"):
        dataclasses.replace(related, target=away)
    other = dataclasses.replace(related.target, query=related.target.query + 0.01)
    with pytest.raises(InputError, match="demonstrations differ in their contact points, or some have no target"):
        tdf.describe(small_model, [related, dataclasses.replace(related, target=other)])
    with pytest.raises(InputError, match="demonstrations differ in their contact points, or some have no target"):
        tdf.describe(small_model, [related, demonstration])
    with pytest.raises(InputError, match="target is a str; expected a tdf.Target"):
        dataclasses.replace(demonstration, target="rack")


def test_several_demonstrations_need_a_target_that_is_known(small_model, related, moved):
    """Which of two targets stands there is not known; if they are one, it is."""
    shift = np.array([0.0, 0, 0, 0, 0.6, 0, 0])
    target = related.target
    elsewhere = tdf.Target(
        np.asarray(target.points) + shift[4:], target.query, np.asarray(target.T_world_contact) + shift
    )
    moved_path = tdf.Trajectory(related.trajectory.wxyz_xyz + jnp.asarray(shift, jnp.float32))
    other = dataclasses.replace(related, points=related.points + shift[4:], trajectory=moved_path, target=elsewhere)
    options = {"points": moved[0], "key": KEY, "config": SEARCH}
    described = tdf.describe(small_model, (demo for demo in [related, other, related]), target_model=small_model)
    assert described.contact.num_targets == 2
    for call in (tdf.relate, tdf.imitate):
        for several in ([related, other], described):
            with pytest.raises(InputError, match="have 2 targets, which differ .* and there are no target_points"):
                call(small_model, several, **options)
    assert np.isfinite(tdf.relate(small_model, described, target_points=moved[1], **options)).all()
    again = dataclasses.replace(target, points=np.array(target.points))  # an equal one
    for several in (
        [related, related],
        tdf.describe(small_model, [related, dataclasses.replace(related, target=again)]),
    ):
        assert np.isfinite(tdf.relate(small_model, several, **options)).all()


def test_traced_targets_count_as_different(small_model, related):
    @jax.jit
    def described(poses, points):
        shown = dataclasses.replace(related, trajectory=tdf.Trajectory(poses))
        target = dataclasses.replace(related.target, points=points)
        return tdf.describe(small_model, [shown, dataclasses.replace(shown, target=target)])

    points = jnp.asarray(related.target.points, jnp.float32)
    assert described(related.trajectory.wxyz_xyz, points).contact.num_targets == 2


def test_a_target_survives_the_file(tmp_path, related):
    tdf.save_demonstration(tmp_path / "demo.npz", related)
    again = tdf.load_demonstration(tmp_path / "demo.npz")
    for name in ("points", "query", "T_world_contact"):
        np.testing.assert_allclose(getattr(again.target, name), getattr(related.target, name), atol=1e-6)


def cube(size, count=2000, seed=0):
    """A cloud of a cube's surface, with its corners."""
    points = np.random.default_rng(seed).uniform(-0.5, 0.5, (count, 3))
    points[np.arange(count), np.arange(count) % 3] = np.where(np.arange(count) % 2, 0.5, -0.5)
    corners = np.stack(np.meshgrid(*[[-0.5, 0.5]] * 3), axis=-1).reshape(-1, 3)
    return np.concatenate([points, corners]) * size


def test_the_arrival_is_as_long_as_the_object_is_near_its_target():
    """A small cube comes down 0.3 m into the middle of a hollow one of 8 cm, from 1 m beside it."""
    corners = np.array([[0.0, 0, 0], [0, 0, 0.3], [1, 0, 0.3], [1, 0, 0]])
    steps = [np.linspace(a, b, 150, endpoint=False) for a, b in zip(corners, corners[1:])]
    translations = np.concatenate([*steps, corners[-1:]])
    path = tdf.Trajectory(jnp.asarray(np.column_stack([np.tile([1.0, 0, 0, 0], (len(translations), 1)), translations])))
    query = 0.01 * np.random.default_rng(1).normal(size=(5, 3))
    target = tdf.Target(cube([0.08, 0.08, 0.2]) + [1.0, 0, 0], query, [1, 0, 0, 0, 1, 0, 0.0])
    arrival = arrival_of(tdf.Demonstration(cube(0.02), path, query, target=target))
    # Its lower side is within 5 cm of the upper side of the target, 10 cm up, from 16 cm on.
    assert abs(arrival.length - (0.16 + BEYOND)) < 0.006 and NEAR == 0.05
    np.testing.assert_allclose(arrival.outward, [0, 0, 1], atol=1e-3)
    assert abs(arrival.depth - 0.11) < 1e-3  # from its lower side to the target's upper one
    # Of an object beside the target nothing is in the way.
    assert arrival_depth(cube(0.02) + [0, 0.2, 0], cube(0.08), np.array([0, 0, 1.0])) == 0.0


def test_into_a_deeper_target_the_object_comes_from_farther_out():
    path = tdf.lift_over(60, (0.4, 0.0, 0.05), (0.0, 0.3, 0.2))
    pick, goal, target_motion = (jnp.asarray(pose) for pose in random_poses(30, 3))
    plain, deep = (
        np.asarray(carried_path(path, pick, goal, target_motion, deeper=deeper).wxyz_xyz) for deeper in (0.0, 0.05)
    )
    np.testing.assert_array_equal(plain[:, :4], deep[:, :4])
    np.testing.assert_array_equal(plain[[0, -1]], deep[[0, -1]])
    shift = np.linalg.norm(deep[:, 4:] - plain[:, 4:], axis=1)
    steps = np.linalg.norm(np.diff(np.asarray(path.translations, np.float64), axis=0), axis=1)
    length = np.concatenate([[0.0], np.cumsum(steps)])
    arriving = length >= length[-1] - 0.08
    np.testing.assert_allclose(shift[arriving], 0.05 * (length[-1] - length[arriving]) / 0.08, atol=1e-4)
    assert (np.diff(shift[arriving]) < 0).all() and shift.max() < 0.05 + 1e-6
    outward = (deep - plain)[arriving][0, 4:]
    straight = plain[arriving][0, 4:] - plain[-1, 4:]
    assert outward @ straight > 0.999 * np.linalg.norm(outward) * np.linalg.norm(straight)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::tdf_jax.CategoryWarning")  # a false alarm: the mug is half as large as the other
def test_the_shipped_weights_place_an_unseen_bowl_on_an_unseen_mug():
    bowl, mug = tdf.load_model("bowl"), tdf.load_model("mug")
    shown, pair = (draw_pair("bowl_on_mug", 901, number) for number in (1000, 0))
    placement = place_pair(pair, 901, "tilt60")
    clouds = {"points": placement.points, "target_points": placement.target_points}
    motion = tdf.relate(bowl, demonstrate(shown, 901), **clouds, target_model=mug, key=KEY)
    placed = judge(pair, placement.placed(matrices(motion)[0].astype(float)))
    assert placed.holds() and placed.tilt < 5
