"""Objects of annotated meshes: a generated object, read from a file, is what it is when it is generated."""

import json
from pathlib import Path

import numpy as np
import pytest

import tdf_jax as tdf
from tdf_jax._internal.errors import InputError
from tdf_jax.geometry.symmetry import ROUND
from tdf_jax.sim import scans, tasks
from tdf_jax.sim.bodies import body_of
from tdf_jax.sim.grasps import grip_of
from tdf_jax.sim.scans import Scan, load_scans
from tdf_jax.sim.tasks import NotDrawn, demonstrate_episode, draw_episode

pytest.importorskip("igl", reason="the extra 'mesh' is not installed")
SHAPES = {"mug": tdf.build_mug, "bowl": tdf.build_bowl, "bottle": tdf.build_bottle}


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A folder of a mug in millimetres, its handle along -y, a bowl and a bottle."""
    folder = tmp_path_factory.mktemp("meshes")
    entries = {}
    for category, build in SHAPES.items():
        mesh, entry = build().mesh.copy(), {"category": category, "unit": 1, "up": "+z", "symmetry": "round"}
        if category == "mug":
            mesh.apply_transform(np.array([[0.0, 1, 0, 0], [-1, 0, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]))
            mesh.apply_scale(1000)
            entry = {"unit": 0.001, "up": "+z", "handle": "-y"}
        mesh.export(folder / f"{category}.obj")
        entries[f"{category}.obj"] = entry
    (folder / "meshes.json").write_text(json.dumps(entries))
    return folder


@pytest.fixture
def scan(folder, monkeypatch):
    """An object of a category, with the exact parts of the generated one, for which no search is needed."""
    pytest.importorskip("coacd", reason="the extra 'sim' is not installed")

    def load(category):
        (one,) = load_scans("test()", folder, False, category)
        monkeypatch.setattr(scans, "mesh_body", lambda mesh: body_of(SHAPES[category]()))
        return one

    return load


@pytest.mark.parametrize("category", SHAPES)
def test_a_scan_is_held_as_the_generated_object(robot, scan, category):
    one, shape = scan(category), SHAPES[category]()
    assert (one.name, one.category, one.fold) == (category, category, shape.fold)
    ours, true = (grip_of(each, robot.fingers) for each in (one, shape))
    np.testing.assert_allclose(ours.T_object_grip[:3, :3], true.T_object_grip[:3, :3], atol=0.03)
    np.testing.assert_allclose(ours.T_object_grip[:3, 3], true.T_object_grip[:3, 3], atol=1e-3)
    assert ours.width == pytest.approx(true.width, abs=5e-4) and ours.fold == true.fold
    points = np.random.default_rng(0).uniform(shape.mesh.bounds[0], shape.mesh.bounds[1], (400, 3))
    assert (one.contains(points) == shape.contains(points)).mean() > 0.99
    assert np.ptp(one.mesh.bounds, axis=0) == pytest.approx(np.ptp(shape.mesh.bounds, axis=0), abs=1e-4)


def test_the_finger_hole_of_a_scan_is_that_of_the_mug(scan):
    one, mug = scan("mug"), tdf.build_mug()
    assert one.parameters.handle_thickness == pytest.approx(mug.parameters.handle_thickness, abs=5e-4)
    hole, true = one.finger_hole, mug.finger_hole
    assert hole[:, 0].max() == pytest.approx(true[:, 0].max(), abs=1e-3)  # the middle of the bar
    # Between the surfaces of the arms, whose middles are the ends of the true outline.
    half = mug.parameters.handle_thickness / 2
    inner = true[true[:, 0] > hole[:, 0].min() + 2 * half]
    assert true[:, 1].min() < hole[:, 1].min() < hole[:, 1].max() < true[:, 1].max()
    assert np.ptp(hole[:, 1]) > np.ptp(inner[:, 1]) - 6 * half
    wall = hole[: len(hole) // 2] + (2e-3, 0)  # between the wall and the bar there is nothing
    assert not mug.contains(np.column_stack([wall[:, 0], np.zeros(len(wall)), wall[:, 1]])).any()


def test_a_mug_without_a_finger_hole_is_refused(folder, scan):
    one = scan("mug")
    frames = one.frames | {"handle": one.frames["handle"].copy()}
    frames["handle"][2, 3] = 0.9 * one.height / 2  # at the rim, where there is none
    lost = Scan(type(one.annotated)(**{**vars(one.annotated), "frames": frames}))
    with pytest.raises(InputError, match="no finger hole is found at the handle of mug, .* correct its 'handle'"):
        _ = lost.finger_hole


def test_what_is_kept_depends_on_the_mesh_and_its_places(scan):
    one = scan("mug")
    moved = {name: T + 1e-6 for name, T in one.frames.items()}
    other = Scan(type(one.annotated)(**{**vars(one.annotated), "frames": moved}))
    assert one.digest == scan("mug").digest != other.digest and one.digest != scan("bowl").digest


def test_a_folder_without_the_category_is_refused(folder, tmp_path):
    (tmp_path / "bowl.obj").write_bytes((folder / "bowl.obj").read_bytes())
    entry = {"category": "bowl", "unit": 1, "up": "+z", "symmetry": "round"}
    (tmp_path / "meshes.json").write_text(json.dumps({"bowl.obj": entry}))
    with pytest.raises(InputError, match=r"test\(\): --meshes is .*, which has no mug but bowl; expected at least one"):
        load_scans("test()", tmp_path, False, "mug")
    with pytest.raises(InputError, match="there is no folder nowhere"):
        load_scans("test()", Path("nowhere"), False, "mug")


# ---- episodes ----


def test_an_episode_has_the_scan_and_a_demonstrated_target(robot, drawn, scan):
    one, known = scan("bowl"), drawn("bowl_on_shelf")
    episode = draw_episode("bowl_on_shelf", robot, 900, 3, known=known, scan=one)
    assert episode.object is one and episode.object_body is one.body
    np.testing.assert_array_equal(episode.T_world_target, known.T_world_target)
    np.testing.assert_allclose(episode.grip.T_object_grip, grip_of(one, robot.fingers).T_object_grip)
    again = draw_episode("bowl_on_shelf", robot, 900, 3, known=known, scan=one)
    np.testing.assert_array_equal(again.T_world_object, episode.T_world_object)


@pytest.mark.slow
def test_a_scanned_mug_is_hung_on_a_rack_that_is_drawn(robot, scan):
    one = scan("mug")
    episode = draw_episode("mug_on_rack", robot, 900, 1, scan=one)
    assert episode.object is one and episode.target.category == "rack"
    path = np.asarray(demonstrate_episode(episode, 0, points=60).trajectory.matrices, float)
    np.testing.assert_allclose(path[-1], episode.release, atol=1e-5)


def test_a_scan_that_nothing_fits_is_not_drawn_and_says_why(robot, drawn, scan, monkeypatch):
    def too_wide(shape, fingers):
        raise InputError("grip_of(): the neck of the bottle is wider than the gripper, 85 mm")

    monkeypatch.setattr(tasks, "grip_of", too_wide)
    with pytest.raises(NotDrawn, match=r"no bottle_on_shelf with bottle \(episode 3, .* wider than the gripper"):
        draw_episode("bottle_on_shelf", robot, 900, 3, known=drawn("bowl_on_shelf"), scan=scan("bottle"))


def test_starts_out_of_reach_are_counted_when_nothing_is_drawn(robot, drawn, scan, monkeypatch):
    monkeypatch.setattr(tasks, "within_reach", lambda *arguments: False)
    monkeypatch.setattr(tasks, "MOST_PAIRS", 2)
    with pytest.raises(NotDrawn, match="no bowl_on_shelf with bowl of episode 3") as error:
        draw_episode("bowl_on_shelf", robot, 900, 3, known=drawn("bowl_on_shelf"), scan=scan("bowl"))
    assert (error.value.rejected, error.value.redrawn) == (2 * tasks.STARTS, 2)


def test_a_round_scan_is_round(scan):
    assert scan("bottle").fold == ROUND
