"""The viewer: what it shows and does without a browser, and with one, by a mouse."""

import dataclasses
import threading
import time

import jax
import numpy as np
import pytest
from conftest import CARRY, colours_of, random_cloud
from scipy.spatial.transform import Rotation

import tdf_jax as tdf
from bench.browser import on_screen
from tdf_jax.geometry.grid import plane_grid, volume_grid
from tdf_jax.landscape.storage import Landscape
from tdf_jax.viewer import energies, handles, solving, stage
from tdf_jax.viewer.local_server import address, serving

pytest.importorskip("viser", reason="the extra 'viewer' is not installed")
SECONDS = 120  # that the slowest machine may take


@pytest.fixture(scope="module")
def problem(demonstration, small_model):
    cloud = random_cloud(3).astype(np.float32)
    result = tdf.imitate(small_model, demonstration, cloud, key=jax.random.key(0), config=CARRY, clean=False)
    scene = tdf.ImitationScene(demonstration, cloud, result, expected=result.trajectory)
    return solving.problem_of(scene, small_model)


@pytest.fixture
def shown(problem):
    with serving("test", 0) as server:
        one = stage.Stage(server, problem)
        one.prepare()
        assert one.worker.wait(SECONDS)
        yield one
        one.close()


def test_what_is_placed_on_a_target_is_dragged_as_well(placed_scene, small_model):
    """A path to a target has more poses than the demonstration: at the start, and after either drag."""
    problem = solving.problem_of(placed_scene, small_model)
    with serving("test", 0) as server:
        shown = stage.Stage(server, problem)
        try:
            regions = shown._nodes[stage.CONTACT_NAME]
            poses = placed_scene.result.target_trajectories, placed_scene.demonstration.target.T_world_contact
            best = poses[0][placed_scene.result.best, 0]
            np.testing.assert_allclose([one.position for one in regions], [best[4:], poses[1][4:]], atol=1e-5)
            shown.prepare()
            assert shown.worker.wait(SECONDS)
            assert shown._status.content.startswith("Ready")
            count = placed_scene.result.trajectories.shape[1]
            drag(shown, shown._grip, shown._centroid + [0, 0, 0.05])
            assert "Solved in" in shown._status.content
            drag(shown, shown._goal, shown.solution.goal[4:] + [0.1, 0, 0])
            assert "The path follows" in shown._status.content
            assert count == len(shown.solution.path) == shown.player.slider.max + 1
            np.testing.assert_allclose(shown._boxes[-1].position, shown.solution.path[-1, 4:], atol=1e-6)
            contact = solving.contact_of(problem, shown.solution)
            np.testing.assert_allclose(shown._contact.position, contact[4:], atol=1e-6)
        finally:
            shown.close()


def bowl(grid):
    values = 0.002 + np.linalg.norm(grid.points, axis=-1)[None]
    return Landscape(grid, values, np.zeros((1, 3)), np.eye(3)[None], np.zeros(values.shape, np.int32))


def drag(shown, grip, xyz):
    """What viser does when a handle was dragged."""
    grip.position = np.asarray(xyz, float)
    for call in grip._impl_aux.update_cb:
        call(type("Event", (), {"target": grip, "phase": "update", "client": None, "client_id": None})())
    assert shown.worker.wait(SECONDS)


def test_the_panel_lists_every_distinct_pick_with_how_much_worse_it_is(shown, problem):
    table = stage._table(problem)
    for number, mode in enumerate(problem.modes, 1):
        assert f"| {number} | {mode.energy:.5f} |" in table
    if len(problem.modes) > 1:
        assert f"{problem.modes[1].energy / problem.modes[0].energy - 1:.0%}".replace("%", " %") in table
    assert f"{len(problem.modes)} distinct of {len(problem.scene.result.energies)} candidates" in table
    assert shown._status.content.startswith("Ready")


def test_an_object_that_is_dragged_is_solved_again(shown, problem):
    before = shown.solution
    drag(shown, shown._grip, shown._centroid + [0, 0, 0.05])
    np.testing.assert_allclose(shown.solution.motion, [1, 0, 0, 0, 0, 0, 0.05], atol=1e-9)
    assert shown.solution.energy <= before.energy * 1.05  # the field moves with its cloud
    assert np.linalg.norm(shown.solution.pick[4:] - before.pick[4:]) > 0.01
    assert "Solved in" in shown._status.content and "encoding" in shown._status.content
    x, y, z = 100 * shown.solution.pick[4:]
    assert f"x {x:.1f}, y {y:.1f}, z {z:.1f} cm" in shown._summary.content
    np.testing.assert_allclose(shown._path.points[0, 0], shown.solution.path[0, 4:], atol=1e-6)


def test_a_long_path_has_eight_boxes_from_its_first_pose_to_its_last(shown, problem):
    path = np.repeat(shown.solution.path[:1], 30, axis=0)
    path[:, 4] += np.linspace(0, 1, 30)
    shown._show(dataclasses.replace(shown.solution, path=path))
    xyz = np.array([box.position for box in shown._boxes])
    assert len(xyz) == 8 and shown.player.slider.max == 29
    np.testing.assert_allclose(xyz[[0, -1]], path[[0, -1], 4:], atol=1e-6)
    assert np.diff(xyz[:, 0]).min() > 0.1


def test_a_landscape_with_an_imitation_is_in_view(problem, monkeypatch):
    looked = []
    monkeypatch.setattr(stage.handles, "look", lambda server, contents: looked.append(contents))
    grid = plane_grid(0.7, 3, problem.points.mean(axis=0))
    with serving("test", 0) as server:
        stage.Stage(server, problem, bowl(grid)).close()
        plane = server.scene._handle_from_node_name["/landscape/slice"]
        assert b'"alphaMode":"BLEND"' in plane.glb_data  # the object behind it shows through
    (contents,) = looked
    assert (contents.min(axis=0) <= grid.points.reshape(-1, 3).min(axis=0) + 1e-9).all()
    assert (contents.max(axis=0) >= grid.points.reshape(-1, 3).max(axis=0) - 1e-9).all()


def test_a_goal_that_is_dragged_takes_the_path_along(shown):
    before = shown.solution
    drag(shown, shown._goal, before.goal[4:] + [0.1, 0, 0])
    np.testing.assert_allclose(shown.solution.path[-1, 4:], before.goal[4:] + [0.1, 0, 0], atol=1e-5)
    np.testing.assert_array_equal(shown.solution.pick, before.pick)
    np.testing.assert_allclose(shown._boxes[-1].position, shown.solution.path[-1, 4:], atol=1e-6)


def test_the_object_is_carried_between_grasp_and_release(shown):
    shown.player.value = len(shown.solution.path) - 1
    shown._show_time()
    motion = np.asarray(shown.problem.scene.result.object_motion)
    np.testing.assert_allclose(shown._object.position, motion[4:], atol=1e-5)
    np.testing.assert_allclose(abs(shown._object.wxyz @ motion[:4]), 1, atol=1e-6)
    np.testing.assert_allclose(shown._box.position, shown.solution.path[-1, 4:], atol=1e-6)


def test_an_object_that_is_dragged_while_it_is_held_stays_at_its_handle(shown):
    shown.player.value = len(shown.solution.path) - 1
    drag(shown, shown._grip, shown._centroid + [0, 0, 0.05])
    assert shown.player.value == shown.problem.scene.result.grasp
    np.testing.assert_allclose(shown._object.position, [0, 0, 0.05], atol=1e-6)


def test_the_point_that_is_clicked_is_that_of_the_held_object(shown, problem):
    drag(shown, shown._grip, shown._centroid + [0, 0, 0.05])
    shown.player.value = len(shown.solution.path) - 1
    shown._show_time()
    R = Rotation.from_quat(shown._object.wxyz, scalar_first=True)
    point = R.apply(problem.points[7]) + shown._object.position
    shown._click.value = True
    above = R.apply([0, 0, 1e-3])
    shown._clicked(type("Event", (), {"ray_origin": point + above, "ray_direction": -above})())
    assert shown.worker.wait(SECONDS)
    pose = np.concatenate([shown._probe.wxyz, shown._probe.position])  # on the object
    assert f"**{problem.energy_in_place(pose):.4f}**" in shown._energy.content
    turn = Rotation.from_quat(shown._probe.wxyz, scalar_first=True)
    middle = turn.apply(np.asarray(problem.reference.query).mean(axis=0)) + shown._probe.position
    np.testing.assert_allclose(middle, problem.points[7], atol=1e-6)


def test_the_reconstructed_surface_is_computed_when_it_is_asked_for(shown, monkeypatch):
    triangles = np.random.default_rng(0).normal(size=(7, 3, 3))
    monkeypatch.setattr(solving, "reconstructed", lambda problem: triangles)
    name = "/imitation/object/surface"
    assert name not in shown.server.scene._handle_from_node_name
    shown._show_surface(True)
    assert shown.worker.wait(SECONDS)
    node = shown.server.scene._handle_from_node_name[name]
    assert len(node.faces) == 7
    monkeypatch.setattr(solving, "reconstructed", lambda problem: pytest.fail("it is computed again"))
    shown._show_surface(False)
    assert not node.visible
    shown._show_surface(True)
    assert shown.worker.wait(SECONDS) and node.visible


def test_a_surface_that_cannot_be_computed_is_said(shown, monkeypatch):
    def missing(problem):
        raise tdf.InputError("libigl is not installed")

    monkeypatch.setattr(solving, "reconstructed", missing)
    shown._show_surface(True)
    assert shown.worker.wait(SECONDS) and shown._status.content == "libigl is not installed"


def test_the_solver_is_prepared_once_the_first_browser_has_painted(problem, monkeypatch):
    """Not before, when it would take the processor from the browser, and once for all browsers."""
    monkeypatch.setattr(stage, "PAINTING", 0.0)
    asked, begun = [], threading.Event()
    monkeypatch.setattr(stage.Stage, "prepare", lambda self: asked.append(1) or begun.set())
    with serving("test", 0) as server:
        one = stage.Stage(server, problem)
        assert not asked
        for _ in range(2):
            one._seen()
        assert begun.wait(SECONDS)
        one.close()
    assert len(asked) == 1


def test_a_hand_on_the_slider_stops_the_player(shown):
    shown.player.start()
    shown.player.moved(type("Event", (), {"client_id": None})())
    assert shown.player.playing
    shown.player.moved(type("Event", (), {"client_id": 0})())
    assert not shown.player.playing and shown.player.button.label == "Play"


def test_playing_ends_at_the_last_pose(shown):
    shown.player.speed = 30.0
    shown.player.start()
    assert shown.player.button.label == "Pause"
    until = time.monotonic() + SECONDS
    while shown.player.playing and time.monotonic() < until:
        time.sleep(0.01)
    assert shown.player.button.label == "Play" and shown.player.value == len(shown.solution.path) - 1


def test_an_energy_is_shown_at_the_point_that_is_clicked(shown, problem):
    point = np.asarray(problem.points[7], float)
    event = type("Event", (), {"ray_origin": point + [0, 0, 1e-3], "ray_direction": (0.0, 0.0, -1.0)})()
    shown._clicked(event)  # not ticked
    assert shown._energy.content == "" and not shown._probe.visible
    shown._click.value = True
    shown._clicked(event)
    assert shown.worker.wait(SECONDS)
    R = Rotation.from_quat(shown._probe.wxyz, scalar_first=True)
    middle = R.apply(np.asarray(problem.reference.query).mean(axis=0)) + shown._probe.position
    np.testing.assert_allclose(middle, point, atol=1e-6)
    pose = np.concatenate([shown._probe.wxyz, shown._probe.position])
    assert f"**{problem.energy_in_place(pose):.4f}**" in shown._energy.content
    shown._clicked(type("Event", (), {"ray_origin": (9.0, 9, 9), "ray_direction": (0.0, 0.0, 1.0)})())
    assert shown._energy.content == "No point of the object's cloud is there."


def test_another_pick_is_shown_and_the_result_comes_back(shown, problem):
    drag(shown, shown._grip, shown._centroid + [0, 0, 0.05])
    number = len(problem.modes) - 1
    shown._choose(number)
    assert shown.worker.wait(SECONDS)
    np.testing.assert_array_equal(shown.solution.pick, problem.modes[number].pose)
    np.testing.assert_array_equal(shown._grip.position, shown._centroid)
    np.testing.assert_array_equal(shown.solution.motion, solving.IDENTITY)
    assert shown._status.content == f"Pick {number + 1} of the folder."  # and no longer that of the drag


def test_the_chosen_pick_is_drawn_once_and_all_others_beside_it(shown, problem):
    count = len(problem.modes)
    assert count > 1  # otherwise there are no others
    for number in (count - 1, 0):
        shown._choose(number)
        assert shown.worker.wait(SECONDS)
        assert [node.visible for node in shown._picks] == [index != number for index in range(count)]
    shown._set_visible(stage.OTHERS, False)
    shown._choose(1)
    assert shown.worker.wait(SECONDS)
    assert not any(node.visible for node in shown._picks)


def test_a_volume_without_libigl_says_that_it_has_no_surfaces(monkeypatch):
    def missing(landscape, share):
        raise tdf.InputError("libigl is not installed")

    monkeypatch.setattr(energies, "isosurface", missing)
    with serving("test", 0) as server:
        energies.show_landscape(server, bowl(volume_grid(0.2, 4)))
        words = [getattr(one, "content", "") for one in server.gui._gui_input_handle_from_uuid.values()]
        words += [
            getattr(one, "content", "") for one in server.gui._container_handle_from_uuid["root"]._children.values()
        ]
        folders = [one for one in server.gui._container_handle_from_uuid.values() if hasattr(one, "_children")]
        words += [getattr(child, "content", "") for one in folders for child in one._children.values()]
        assert "There are no surfaces of equal energy: libigl is not installed." in words


@pytest.mark.parametrize("aspect", [0.5, 1.6])
def test_a_narrow_window_has_all_in_it(aspect, problem):
    """The camera is far enough for the smaller of both fields of view."""
    changed = []
    camera = type("Camera", (), {"aspect": 1.6, "position": None, "look_at": None, "on_update": changed.append})()
    with serving("test", 0) as server:
        fits = []
        server.on_client_connect = fits.append
        handles.look(server, problem.points)
        (fit,) = fits
        near = server.initial_camera
        camera.position = near.position
        fit(type("Client", (), {"camera": camera})())
        camera.aspect = aspect  # the panel takes its part of the window
        for call in changed:
            call(camera)
        distance = np.linalg.norm(near.position - near.look_at)
        found = np.linalg.norm(camera.position - near.look_at)
        np.testing.assert_allclose(found, distance / min(1, aspect))
        camera.position, camera.aspect = camera.position + 0.5, 0.4  # the user has moved it
        moved = camera.position
        for call in changed:
            call(camera)
        assert camera.position is moved


@pytest.mark.parametrize("grid", [plane_grid(0.2, 4), volume_grid(0.2, 4)], ids=["plane", "volume"])
def test_a_landscape_is_shown_in_slices(grid):
    with serving("test", 0) as server:
        energies.show_landscape(server, bowl(grid))
        plane = server.scene._handle_from_node_name["/landscape/slice"]
        assert b'"alphaMode":"OPAQUE"' in plane.glb_data
        names = set(server.scene._handle_from_node_name)
        assert {"/landscape/slice", "/landscape/waypoints", "/landscape/minimisers"} <= names
        inputs = server.gui._gui_input_handle_from_uuid.values()
        sliders = [one for one in inputs if type(one).__name__ == "GuiSliderHandle"]
        server.scene._handle_from_node_name["/landscape/slice"].visible = False
        for slider in sliders:
            slider.value = 0
        assert not server.scene._handle_from_node_name["/landscape/slice"].visible
        each = bowl(grid)
        object.__setattr__(each, "values", each.values[:, None])
        object.__setattr__(each, "turned", None)
        with pytest.raises(tdf.InputError, match="expected a grid with two or three axes in one orientation"):
            energies.show_landscape(server, each)


@pytest.mark.slow
def test_a_real_mouse_drags_the_object_in_a_browser_and_the_pick_changes(shown, browser):
    tab = browser.new_page(viewport={"width": 1000, "height": 700})
    received = [0]
    tab.on(
        "websocket",
        lambda socket: socket.on("framereceived", lambda data: received.__setitem__(0, received[0] + len(data))),
    )
    tab.goto(address(shown.server))
    tab.wait_for_selector("canvas", timeout=1000 * SECONDS)
    tab.wait_for_selector("text=Ready", timeout=1000 * SECONDS)
    tab.wait_for_timeout(3000)
    before, text = tab.screenshot(), tab.inner_text("body")
    assert colours_of(before) > 300 and received[0] < 10_000_000
    x, y, z = 100 * shown.solution.pick[4:]
    assert f"x {x:.1f}, y {y:.1f}, z {z:.1f} cm" in text
    pick = shown.solution.pick
    arrow = shown._grip.position + [0, 0, 0.75 * stage.GRIP * shown._size()]  # on the arrow that points up
    begin, end = on_screen(shown.server, arrow), on_screen(shown.server, arrow + [0, 0, 0.06])
    tab.mouse.move(*begin)
    tab.mouse.down()
    tab.mouse.move(*end, steps=8)
    tab.mouse.up()
    tab.wait_for_selector("text=Solved in", timeout=1000 * SECONDS)
    assert shown.worker.wait(SECONDS)
    np.testing.assert_allclose(shown.solution.motion[4:6], 0, atol=1e-6)
    assert 0.02 < shown.solution.motion[6] < 0.15
    assert np.linalg.norm(shown.solution.pick[4:] - pick[4:]) > 0.01
    tab.wait_for_timeout(1000)
    x, y, z = 100 * shown.solution.pick[4:]
    assert f"x {x:.1f}, y {y:.1f}, z {z:.1f} cm" in tab.inner_text("body")
    assert tab.screenshot() != before
    tab.close()


@pytest.mark.slow
def test_the_viewer_works_in_a_frame_of_another_page_such_as_a_cell(shown, browser):
    IPython = pytest.importorskip("IPython.display", reason="the extra 'notebooks' is not installed")
    cell = IPython.IFrame(address(shown.server), width="100%", height=600)  # as the guide to the viewer shows it
    tab = browser.new_page(viewport={"width": 1000, "height": 700})
    tab.set_content(f"<p>A notebook</p>{cell._repr_html_()}")
    frame = tab.frame_locator("iframe")
    frame.locator("canvas").last.wait_for(timeout=1000 * SECONDS)
    frame.locator("text=Energy").first.wait_for(timeout=1000 * SECONDS)
    tab.wait_for_timeout(3000)
    assert colours_of(tab.screenshot()) > 300
    frame.get_by_role("button", name="Play").click()
    frame.get_by_role("button", name="Pause").wait_for(timeout=1000 * SECONDS)
    shown.player.stop()
    tab.close()
