import dataclasses
import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import trimesh
from conftest import CARRY, random_cloud

import tdf_jax as tdf
from tdf_jax._internal.errors import InputError
from tdf_jax.networks.model import fingerprint
from tdf_jax.solvers.imitation_scene import SCENE, Weights, weights_of


@pytest.fixture(scope="module")
def result(field, reference):
    return tdf.carry(field, reference, jax.random.key(0), config=CARRY)


@pytest.fixture(scope="module")
def scene(demonstration, result, small_model):
    mesh = trimesh.creation.box((0.1, 0.1, 0.1))
    expected = tdf.Trajectory(result.trajectory.wxyz_xyz[::-1])
    cloud = random_cloud(3).astype(np.float32)
    return tdf.ImitationScene(
        demonstration, cloud, result, cloud + 1, expected, (None, mesh), weights_of("small", small_model)
    )


def arrays_of(value):
    return {field.name: getattr(value, field.name) for field in dataclasses.fields(value)}


def changed(path, **changes):
    """The file with other arrays; None removes one."""
    with np.load(path) as file:
        arrays = dict(file) | {name: value for name, value in changes.items() if value is not None}
    np.savez(
        path, **{name: value for name, value in arrays.items() if name not in changes or changes[name] is not None}
    )


def header(path, **changes):
    with np.load(path) as file:
        kept = json.loads(str(file["header"]))
    changed(path, header=np.array(json.dumps(kept | changes)))


def test_a_scene_is_read_as_it_was_written(tmp_path, scene, small_model):
    tdf.save_imitation(tmp_path / SCENE, scene)
    for path in (tmp_path, tmp_path / SCENE):
        read = tdf.load_imitation(path)
        for name, value in arrays_of(scene.result).items():
            np.testing.assert_array_equal(getattr(read.result, name), value)
            assert np.asarray(getattr(read.result, name)).dtype == np.asarray(value).dtype
        np.testing.assert_array_equal(read.points, scene.points)
        np.testing.assert_array_equal(read.target_points, scene.target_points)
        np.testing.assert_array_equal(read.demonstration.points, scene.demonstration.points)
        np.testing.assert_array_equal(read.demonstration.trajectory.wxyz_xyz, scene.demonstration.trajectory.wxyz_xyz)
        np.testing.assert_array_equal(read.demonstration.query, scene.demonstration.query)
        np.testing.assert_array_equal(read.expected.wxyz_xyz, scene.expected.wxyz_xyz)
        assert read.meshes[0] is None
        np.testing.assert_array_equal(read.meshes[1].triangles, scene.meshes[1].triangles.astype(np.float32))
        assert read.weights == Weights("small", fingerprint(small_model)) and read.target_weights is None
        assert read.result.best == scene.result.best and repr(read.result) == repr(scene.result)


def test_indices_and_what_is_not_known(tmp_path, demonstration, result):
    shown = dataclasses.replace(demonstration, grasp=1, release=2)
    found = dataclasses.replace(result, grasp=1, release=-2)
    tdf.save_imitation(tmp_path / "it.npz", tdf.ImitationScene(shown, demonstration.points, found))
    read = tdf.load_imitation(tmp_path / "it.npz")
    assert (read.demonstration.grasp, read.demonstration.release) == (1, 2)
    assert (read.result.grasp, read.result.release) == (1, -2)
    assert read.expected is read.target_points is read.weights is read.demonstration.target is None


def test_a_target_of_the_demonstration_is_kept(tmp_path, demonstration, result):
    poses = jnp.asarray(demonstration.trajectory.wxyz_xyz)
    motion = poses[-1, 4:] - poses[0, 4:]
    straight = tdf.Trajectory(jnp.stack([poses[0], poses[0].at[4:].add(motion)]))
    placed = np.asarray(demonstration.points) + np.asarray(motion) + np.float32(0.05)
    target = tdf.Target(placed, np.asarray(demonstration.query) + placed.mean(axis=0))
    shown = tdf.Demonstration(demonstration.points, straight, demonstration.query, target=target)
    tdf.save_imitation(tmp_path / "it.npz", tdf.ImitationScene(shown, demonstration.points, result))
    read = tdf.load_imitation(tmp_path / "it.npz").demonstration.target
    for name, value in arrays_of(target).items():
        np.testing.assert_array_equal(getattr(read, name), value)


def test_folders_that_are_none_of_imitate_are_refused(tmp_path):
    with pytest.raises(InputError, match="there is no folder .*nowhere; expected one that `tdf imitate` wrote"):
        tdf.load_imitation(tmp_path / "nowhere")
    with pytest.raises(InputError, match="it is empty"):
        tdf.load_imitation(tmp_path)
    (tmp_path / "notes.txt").touch()
    with pytest.raises(
        InputError, match=r"it has no scene.npz, but notes.txt\); expected one: run `tdf imitate` again"
    ):
        tdf.load_imitation(tmp_path)
    (tmp_path / "result.json").touch()
    with pytest.raises(InputError, match="another command wrote it, or an older tdf_jax"):
        tdf.load_imitation(tmp_path)
    with pytest.raises(InputError, match="there is no file .*nowhere.npz"):
        tdf.load_imitation(tmp_path / "nowhere.npz")
    with pytest.raises(InputError, match="suffix '.txt'; expected .npz"):
        tdf.load_imitation(tmp_path / "notes.txt")


def test_files_of_another_version_and_damaged_ones_are_refused(tmp_path, scene):
    path = tmp_path / SCENE
    for change, message in (
        (lambda: header(path, schema=2), "has schema 2; expected 1. Use the tdf_jax that wrote it"),
        (lambda: header(path, unit="inch"), "has the unit 'inch'; expected 'metre'"),
        (lambda: header(path, frame="camera"), "has the frame 'camera'; expected 'world'"),
        (lambda: changed(path, header=None), "cannot read .*KeyError"),
        (lambda: changed(path, result_energies=None), "has no array result_energies; expected all of a scene"),
        (lambda: changed(path, points=scene.points[:, :2]), r"points has shape \(40, 2\); expected \(points, 3\)"),
        (lambda: path.write_bytes(path.read_bytes()[:5000]), "cannot read .*BadZipFile"),
        (lambda: path.write_text("no archive"), "cannot read"),
    ):
        tdf.save_imitation(path, scene)
        change()
        with pytest.raises(InputError, match=message):
            tdf.load_imitation(tmp_path)


def test_what_a_former_tdf_jax_did_not_know_is_unknown(tmp_path, scene):
    tdf.save_imitation(tmp_path / SCENE, scene)
    changed(tmp_path / SCENE, result_latent=None, result_confidence=None)
    read = tdf.load_imitation(tmp_path).result
    assert np.isnan(read.confidence) and read.latent.shape[0] == 0
    np.testing.assert_array_equal(read.energies, scene.result.energies)


def test_a_batch_is_no_scene(demonstration, result):
    batch = jax.tree.map(lambda x: np.stack([np.asarray(x)] * 2), result)
    with pytest.raises(InputError, match=r"shape \(2, 3, 4, 7\); expected \(candidates, poses, 7\)"):
        tdf.ImitationScene(demonstration, demonstration.points, batch)


def test_what_cannot_be_written_is_refused(tmp_path, scene):
    with pytest.raises(InputError, match=r"save_imitation\(\): .* has suffix '.json'; expected .npz"):
        tdf.save_imitation(tmp_path / "it.json", scene)
    with pytest.raises(InputError, match="cannot write"):
        tdf.save_imitation(tmp_path / "no folder" / "it.npz", scene)
