import dataclasses

import jax
import numpy as np
import pytest
from conftest import CARRY, carried, colours_of, opened, page_content, random_cloud, random_poses
from scipy.spatial.transform import Rotation

import tdf_jax as tdf
from tdf_jax._internal.errors import InputError
from tdf_jax.viz.imitation_page import imitation_page, save_imitation_page
from tdf_jax.viz.motion import motion_of

plotly = pytest.importorskip("plotly")


@pytest.fixture(scope="module")
def scene(demonstration, field, reference):
    result = tdf.carry(field, reference, jax.random.key(0), config=CARRY)
    mesh = tdf.build_mug().mesh
    return tdf.ImitationScene(
        demonstration, random_cloud(3).astype(np.float32), result, meshes=(None, mesh), expected=result.trajectory
    )


@pytest.fixture(scope="module")
def page(scene, tmp_path_factory):
    path = tmp_path_factory.mktemp("page") / "imitation.html"
    save_imitation_page(path, scene, "Two <mugs>")
    return path


def test_frames_are_the_poses_and_the_object_is_held_between_grasp_and_release():
    poses, points = random_poses(0, 5), random_cloud(1)
    motion = motion_of(poses, 1, -2, np.arange(5.0))
    for i, pose in enumerate(poses):
        np.testing.assert_allclose(points @ motion.rotations[i].T + motion.translations[i], carried(pose, points))
        held = points @ motion.object_rotations[i].T + motion.object_translations[i]
        at_pick = Rotation.from_quat(poses[1, :4], scalar_first=True).inv().apply(points - poses[1, 4:])
        np.testing.assert_allclose(held, carried(poses[min(max(i, 1), 3)], at_pick), atol=1e-12)
    between = motion_of(poses, 1, -2, np.array([2.5]))
    np.testing.assert_allclose(between.translations[0], (poses[2, 4:] + poses[3, 4:]) / 2)
    still = motion_of(poses[:1], 0, -1)
    np.testing.assert_allclose(still.translations, poses[:1, 4:])


def test_a_page_is_small_and_needs_no_network(page, scene):
    text = page.read_text()
    assert "http" not in text.split('id="plotly"')[0] and "src=" not in text.split('id="plotly"')[0]
    assert len(text) < 5_000_000 and "Two &lt;mugs&gt;" in text
    content = page_content(text)
    names = [one["name"] for one in content["data"]]
    assert {"object", "path of the query frame", "box of query points", "true trajectory and pick"} <= set(names)
    modes = tdf.cluster_poses(scene.result.picks, scene.result.energies)
    assert [name.split(":")[0] for name in names if name.startswith("pick")] == [
        f"pick {number}" for number in range(2, len(modes) + 1)
    ]
    assert {one["type"] for one in content["data"]} == {"scatter3d", "mesh3d"}


def test_contact_regions_are_shown_on_both_targets(placed_scene):
    page = imitation_page("page()", placed_scene)
    content = page_content(page.text)
    regions = [one for one in content["data"] if one["name"] == "contact region"]
    assert [one["scene"] for one in regions] == ["scene", "scene2"] and len(page.text) < 5_000_000
    result = placed_scene.result
    poses = placed_scene.demonstration.target.T_world_contact, result.target_trajectories[result.best, 0]
    query = np.asarray(placed_scene.demonstration.target.query)
    for region, pose in zip(regions, poses):
        drawn = np.array([region[axis] for axis in "xyz"], float).T
        middle = np.unique(np.round(drawn[np.isfinite(drawn).all(axis=1)], 2), axis=0).mean(axis=0)
        expected = carried(pose, [(query.min(axis=0) + query.max(axis=0)) / 2])[0]
        np.testing.assert_allclose(middle, 100 * expected, atol=0.05)
    assert "energy of pick and contact" in page.text


def test_a_doubtful_pick_is_explained_above_the_picture(scene):
    result = dataclasses.replace(scene.result, confidence=np.float32(0.2), points_at_pick=np.int32(3))
    text = imitation_page("page()", dataclasses.replace(scene, result=result)).text
    assert (
        "<p>Confidence 0.20 that the pick is right to 2 cm and 20 degrees. Its place is not seen (3 points of the "
        "cloud are there); compare the other candidates, and check that the cloud shows nothing but the object.</p>"
    ) in text


def test_the_cloud_beside_a_mesh_can_be_shown_and_moves_with_it(page, scene):
    content = page_content(page.read_text())
    names = [one["name"] for one in content["data"]]
    assert names.count("cloud of the object") == 1  # the demonstration has no mesh, so its cloud is its object
    number = names.index("cloud of the object")
    cloud = content["data"][number]
    assert cloud["visible"] == "legendonly" and cloud["scene"] == "scene2"
    np.testing.assert_allclose(np.array([cloud[axis] for axis in "xyz"]).T, 100 * scene.points, atol=6e-3)
    (moving,) = (one for one in content["moving"] if one["trace"] == number)
    assert moving["motions"] == content["moving"][2]["motions"]  # of the mesh


def test_what_moves_begins_where_it_is_drawn_and_ends_at_the_release(page, scene):
    content = page_content(page.read_text())
    for one in content["moving"]:
        drawn = content["data"][one["trace"]]
        points = np.array(one["points"], float)
        R, t = (np.array(part) for part in one["motions"][0])
        np.testing.assert_allclose(R @ points + t[:, None], np.array([drawn[axis] for axis in "xyz"], float), atol=0.02)
        assert len(one["motions"]) == len(content["labels"])
    R, t = (np.array(part) for part in content["moving"][2]["motions"][-1])  # the object of the imitation
    motion = np.asarray(scene.result.object_motion)
    np.testing.assert_allclose(t, 100 * motion[4:], atol=0.02)
    np.testing.assert_allclose(R, Rotation.from_quat(motion[:4], scalar_first=True).as_matrix(), atol=1e-4)


def test_what_cannot_be_drawn_is_refused(scene, tmp_path, monkeypatch):
    monkeypatch.setattr("tdf_jax.viz.page.LARGEST", 1_000_000)
    with pytest.raises(InputError, match=r"the page would have \d.\d MB; expected at most 1 MB"):
        save_imitation_page(tmp_path / "it.html", scene)
    monkeypatch.setitem(__import__("sys").modules, "plotly.graph_objects", None)
    with pytest.raises(InputError, match=r"plotly is not installed; .*pip install 'tdf_jax\[pages\]'"):
        save_imitation_page(tmp_path / "it.html", scene)
    assert not list(tmp_path.iterdir())


@pytest.mark.slow
def test_a_browser_without_a_network_draws_turns_and_plays_it(page, browser):
    tab, errors = opened(browser, page)
    before = tab.screenshot()
    assert colours_of(before) > 500
    tab.mouse.move(650, 300)
    tab.mouse.down()
    tab.mouse.move(750, 340, steps=5)
    tab.mouse.up()
    tab.wait_for_timeout(1000)
    turned = tab.screenshot()
    assert turned != before
    tab.click("#play")
    last = len(page_content(page.read_text())["labels"]) - 1
    tab.wait_for_function(f"document.body.dataset.frame === '{last}'", timeout=60_000)
    tab.wait_for_timeout(1000)
    assert tab.inner_text("#pose").startswith("pose 3.0 of 3")
    assert tab.screenshot() != turned and errors == []
    tab.close()
