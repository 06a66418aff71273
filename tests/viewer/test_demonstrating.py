"""Demonstrations by hand: key poses, marks and the file, and that another object imitates it."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import random_cloud, random_poses

import tdf_jax as tdf
from bench.browser import on_screen
from tdf_jax._internal.errors import InputError
from tdf_jax.geometry import se3
from tdf_jax.viewer import demonstrating
from tdf_jax.viewer.demonstrating import DemonstrationStage, Draft, added, demonstration_of, undone
from tdf_jax.viewer.local_server import address, serving

CLOUD = random_cloud(0)
EDGES = np.array([0.04, 0.05, 0.06])


def key_poses(count=5):
    poses = random_poses(1, count)
    poses[:, 4:] = CLOUD.mean(axis=0) + 0.2 * np.arange(count)[:, None] * [0, 1, 1]
    return poses


def finished():
    first, *others = key_poses()
    draft = added(added(Draft(), first), others[0], "grasp")
    draft = added(added(draft, others[1]), others[2], "release")
    return added(draft, others[3])


def test_a_draft_is_a_demonstration_with_approach_and_retreat():
    draft = finished()
    assert (len(draft.poses), draft.grasp, draft.release) == (5, 1, 3)
    made = demonstration_of(draft, CLOUD, EDGES, num_poses=9)
    assert made.transfer.num_poses == 9 and made.approach.num_poses == made.retreat.num_poses == 1
    poses = key_poses()
    for found, expected in zip((made.approach, made.transfer, made.retreat), (poses[:1], poses[[1, 3]], poses[4:])):
        np.testing.assert_allclose(np.asarray(found.wxyz_xyz)[[0, -1], 4:], expected[[0, -1], 4:], atol=1e-6)
    corner = np.asarray(made.transfer.translations)
    assert np.linalg.norm(corner - poses[2, 4:], axis=1).min() < 0.02  # by the key pose between
    np.testing.assert_allclose(np.ptp(made.query, axis=0), EDGES, rtol=0.1)
    assert len(made.query) == demonstrating.QUERIES


def test_what_is_undone_is_gone():
    draft = finished()
    for poses, grasp, release in ((4, 1, 3), (3, 1, None), (2, 1, None), (1, None, None), (0, None, None)):
        draft = undone(draft)
        assert (len(draft.poses), draft.grasp, draft.release) == (poses, grasp, release)
    assert len(undone(draft).poses) == 0


def test_what_is_out_of_order_is_refused():
    pose = key_poses()[0]
    with pytest.raises(InputError, match="not grasped yet"):
        added(Draft(), pose, "release")
    grasped = added(Draft(), pose, "grasp")
    with pytest.raises(InputError, match="grasped at pose 1 already"):
        added(grasped, pose, "grasp")
    with pytest.raises(InputError, match="released at pose 4 already"):
        added(finished(), pose, "release")
    with pytest.raises(InputError, match="no release yet"):
        demonstration_of(grasped, CLOUD, EDGES)
    with pytest.raises(InputError, match="no grasp and release yet"):
        demonstration_of(Draft(), CLOUD, EDGES)
    far = added(added(Draft(), pose + [0, 0, 0, 0, 9, 0, 0], "grasp"), pose, "release")
    with pytest.raises(InputError, match="expected them at the object"):
        demonstration_of(far, CLOUD, EDGES)


def test_a_name_that_cannot_be_saved_is_refused_at_once(tmp_path):
    demonstrating.check_demonstration_path("tdf view", tmp_path / "it.npz")
    for path in (tmp_path / "it.txt", tmp_path / "nowhere" / "it.npz"):
        with pytest.raises(InputError, match="expected a new .npz file in an existing folder"):
            demonstrating.check_demonstration_path("tdf view", path)
    (tmp_path / "it.npz").touch()
    with pytest.raises(InputError, match="it.npz, which exists; expected a new file"):
        demonstrating.check_demonstration_path("tdf view", tmp_path / "it.npz")


@pytest.fixture
def by_hand(tmp_path):
    pytest.importorskip("viser", reason="the extra 'viewer' is not installed")
    with serving("test", 0) as server:
        yield DemonstrationStage(server, CLOUD, tmp_path / "demo.npz")


def put(stage, pose):
    """What a drag of the box does."""
    stage._grip.wxyz, stage._grip.position = np.asarray(pose[:4], float), np.asarray(pose[4:], float)
    stage._follow()


def test_the_object_moves_with_the_box_between_grasp_and_release(by_hand):
    first, grasp, corner, release, last = key_poses()
    put(by_hand, first)
    np.testing.assert_array_equal(by_hand._object.position, 0)
    by_hand.save()
    assert "no grasp and release yet" in by_hand._status.content and not by_hand.path.exists()
    put(by_hand, grasp)
    by_hand.change(lambda: added(by_hand.draft, by_hand.pose, "grasp"))
    assert "1: grasp" in by_hand._status.content
    by_hand.change(lambda: added(by_hand.draft, by_hand.pose, "grasp"))
    assert "already" in by_hand._status.content and len(by_hand.draft.poses) == 1
    put(by_hand, release)
    motion = np.asarray(se3.compose(jnp.asarray(release), se3.inverse(jnp.asarray(grasp))))
    np.testing.assert_allclose(by_hand._object.position, motion[4:], atol=1e-5)
    by_hand.change(lambda: added(by_hand.draft, by_hand.pose, "release"))
    put(by_hand, last)
    np.testing.assert_allclose(by_hand._object.position, motion[4:], atol=1e-5)
    by_hand.save()
    assert by_hand.saved == 1 and f"Saved {by_hand.path}" in by_hand._status.content
    assert "`--category`" in by_hand._status.content
    by_hand._resize(np.array([0.1, 0.02, 0.02]))
    for key in by_hand._keys:  # they are as large as the box
        np.testing.assert_allclose(np.ptp(key.points.reshape(-1, 3), axis=0), [0.1, 0.02, 0.02], atol=1e-6)
    read = tdf.load_demonstration(by_hand.path)
    assert read.transfer.num_poses == demonstrating.NUM_POSES
    np.testing.assert_allclose(read.transfer.wxyz_xyz[0, 4:], grasp[4:], atol=1e-6)


def test_a_click_places_the_box_until_the_object_is_grasped(by_hand):
    point = CLOUD[5]
    event = type("Event", (), {"ray_origin": point + [0, 0, 1e-3], "ray_direction": (0.0, 0.0, -1.0)})()
    by_hand._clicked(event)
    np.testing.assert_allclose(by_hand._grip.position, point)
    by_hand.change(lambda: added(by_hand.draft, by_hand.pose, "grasp"))
    put(by_hand, key_poses()[3])
    by_hand._clicked(event)
    np.testing.assert_allclose(by_hand._grip.position, key_poses()[3, 4:])


@pytest.mark.slow
def test_another_mug_imitates_what_was_made_by_hand(tmp_path):
    """A box at the handle, dragged away: the pick on the other mug is at its handle, within 2 cm and 20 degrees."""
    from tdf_jax.evaluation.cases import generated_case
    from tdf_jax.evaluation.metrics import pose_error

    pytest.importorskip("viser", reason="the extra 'viewer' is not installed")
    pair = generated_case("mug", 61, 0, points=1500)
    handle = np.asarray(tdf.Trajectory.from_matrices(np.stack([pair.T_world_place_a] * 2)).wxyz_xyz[0], float)
    with serving("test", 0) as server:
        stage = DemonstrationStage(server, pair.points_a, tmp_path / "demo.npz")
        for offset, mark in (((0, 0, 0), "grasp"), ((0, 0, 0.15), None), ((0.2, 0, 0.15), "release")):
            put(stage, handle + np.array([0, 0, 0, 0, *offset]))
            stage.change(lambda mark=mark: added(stage.draft, stage.pose, mark))
        stage.save()
    made = tdf.load_demonstration(tmp_path / "demo.npz")
    result = tdf.imitate(tdf.load_model("mug"), made, pair.points_b, key=jax.random.key(0))
    expected = tdf.Trajectory.from_matrices(np.stack([pair.T_world_place_b] * 2)).wxyz_xyz[0]
    metres, radians = pose_error(result.pick, expected)
    assert metres < 0.02 and np.degrees(radians) < 20


@pytest.mark.slow
def test_a_real_mouse_grasps_in_a_browser(by_hand, browser):
    tab = browser.new_page(viewport={"width": 1000, "height": 700})
    tab.goto(address(by_hand.server))
    tab.wait_for_selector("canvas", timeout=120_000)
    tab.get_by_role("button", name="Grasp here").click(timeout=120_000)
    tab.wait_for_selector("text=1: grasp", timeout=60_000)
    tab.wait_for_timeout(2000)
    arrow = by_hand._grip.position + [0, 0, 0.75 * by_hand._grip.scale]
    begin, end = (on_screen(by_hand.server, point) for point in (arrow, arrow + [0, 0, 0.06]))
    tab.mouse.move(*begin)
    tab.mouse.down()
    tab.mouse.move(*end, steps=8)
    tab.mouse.up()
    tab.wait_for_timeout(1000)
    assert by_hand._object.position[2] > 0.02
    tab.get_by_role("button", name="Release here").click()
    tab.get_by_role("button", name="Save").click()
    tab.wait_for_selector("text=Saved", timeout=60_000)
    moved = tdf.load_demonstration(by_hand.path).object_motion
    np.testing.assert_allclose(moved[4:], by_hand._object.position, atol=1e-4)
    tab.close()
