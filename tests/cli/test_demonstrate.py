"""`tdf demonstrate`: a recording becomes a file that `tdf imitate` takes."""

import json

import numpy as np
import pytest
from conftest import carried, composed, random_cloud, random_poses
from scipy.spatial.transform import Rotation

import tdf_jax as tdf
from tdf_jax.cli.main import main
from tdf_jax.uncertainty.calibration import ONE_NETWORK_CURVES

POSES = random_poses(4, 9) + [0, 0, 0, 0, 0.3, -0.2, 0.1]
CLOUD = random_cloud(0, 60)


@pytest.fixture
def files(tmp_path):
    np.save(tmp_path / "cloud.npy", CLOUD)
    rows = np.column_stack([np.arange(9), POSES[:, [4, 5, 6, 1, 2, 3, 0]]])
    np.savetxt(tmp_path / "path.tum", rows, header="t x y z qx qy qz qw")
    return tmp_path


def call(folder, **changes):
    options = {"points": folder / "cloud.npy", "trajectory": folder / "path.tum", "out": folder / "demo.npz"}
    options |= {"query-box": 0.06, "queries": 8, "grasp": 3, "release": 6} | changes
    words = [f"--{name}" for name in options]
    values = [value.split() if isinstance(value, str) else [str(value)] for value in options.values()]
    main(["demonstrate", *(part for word, value in zip(words, values) for part in (word, *value))])


def test_the_file_holds_the_recording(files, capsys):
    call(files)
    assert "60 points, 3 poses before the grasp, 4 to the release, 2 after" in capsys.readouterr().out
    demo = tdf.load_demonstration(files / "demo.npz")
    np.testing.assert_allclose(demo.points, CLOUD, atol=1e-6)
    np.testing.assert_allclose(demo.trajectory.wxyz_xyz, POSES, atol=1e-6)
    assert (demo.grasp, demo.release, demo.query.shape) == (3, 6, (8, 3))
    assert np.abs(demo.query).max() <= 0.03


def test_the_box_may_have_three_edges_and_a_centre_and_poses_be_resampled(files):
    call(files, **{"query-box": "0.02 0.04 0.06", "query-centre": "0.1 0.0 -0.1", "num-poses": 6, "queries": 400})
    demo = tdf.load_demonstration(files / "demo.npz")
    np.testing.assert_allclose(np.ptp(demo.query, axis=0), [0.02, 0.04, 0.06], rtol=0.05)
    np.testing.assert_allclose(np.mean(demo.query, axis=0), [0.1, 0, -0.1], atol=0.005)
    assert (demo.approach.num_poses, demo.transfer.num_poses, demo.retreat.num_poses) == (3, 6, 2)


@pytest.mark.slow
def test_the_file_is_imitated(files, weights, capsys):
    call(files)
    with_missing = np.insert(random_cloud(3), [5, 9, 20], (0, 0, 0), axis=0)
    np.save(files / "new.npy", with_missing)
    words = ["imitate", "--demonstration", files / "demo.npz", "--target", files / "new.npy", "--weights", weights]
    words += ["--num-starts", "8", "--no-plots", "--out", files / "result"]
    with pytest.raises(SystemExit) as end:
        main([*map(str, words)])
    assert end.value.code == 2
    assert "3 are [0.0, 0.0, 0.0]" in capsys.readouterr().err
    main([*map(str, words), "--drop-invalid"])
    assert "removed 3 of 43 points" in capsys.readouterr().err
    record = json.loads((files / "result" / "result.json").read_text())
    poses = tdf.load_trajectory(files / "result" / "trajectory.npz").wxyz_xyz
    assert len(poses) == 9 and record["demonstration"] | {"grasp": 3, "release": 6} == record["demonstration"]
    np.testing.assert_allclose(record["goal"], poses[6], atol=1e-6)
    assert any(np.allclose(mode["pick"], poses[3], atol=1e-6) for mode in record["modes"])


@pytest.mark.slow
def test_the_goal_is_found_on_a_second_object(files, weights, capsys, monkeypatch):
    motion = composed(POSES[6], inverse(POSES[3])[None])[0]
    released = carried(motion, CLOUD)
    shelf = random_cloud(7, 60) - random_cloud(7, 60).mean(axis=0) + released.mean(axis=0) + [0, 0, -0.15]
    np.save(files / "shelf.npy", shelf)
    call(files, **{"target-object": files / "shelf.npy", "contacts": 8})
    demo = tdf.load_demonstration(files / "demo.npz")
    np.testing.assert_allclose(demo.target.points, shelf, atol=1e-6)
    np.testing.assert_allclose(np.mean(demo.target.query, axis=0), 0, atol=1e-6)  # the contact frame is at its points
    np.testing.assert_allclose(demo.target.T_world_contact[:4], [1, 0, 0, 0])
    assert np.abs(demo.target.T_world_contact[4:] - (released.mean(axis=0) + [0, 0, -0.075])).max() < 0.06

    np.save(files / "new.npy", random_cloud(3))
    np.save(files / "new_shelf.npy", shelf + [0.5, 0.5, 0.0])
    words = ["imitate", "--demonstration", files / "demo.npz", "--target", files / "new.npy", "--weights", weights]
    words += ["--num-starts", "8", "--out", files / "result", "--target-object", files / "new_shelf.npy"]
    monkeypatch.setitem(ONE_NETWORK_CURVES, "small", (-50.0, 0.0, 0.0))
    main([*map(str, words)])
    printed = capsys.readouterr()
    assert "object moves" in printed.out
    assert "the demonstrated target does not look like" in printed.err and "--target-weights" in printed.err
    record = json.loads((files / "result" / "result.json").read_text())
    poses = np.asarray(tdf.load_trajectory(files / "result" / "trajectory.npz").wxyz_xyz, float)
    pick = next(mode["pick"] for mode in record["modes"])
    expected = composed(record["relation"]["object_motion"], np.array([pick]))[0]
    goal = np.array(record["goal"])
    np.testing.assert_allclose(goal[4:], expected[4:], atol=1e-4)
    assert abs(goal[:4] @ expected[:4]) > 1 - 1e-5
    assert np.abs(poses - goal).max(axis=1).min() < 1e-5 and (files / "result" / "imitation.png").exists()
    for extra, message in (
        (["--goal-offset", "0", "0", "0.1"], "goal_offset, and the demonstration has a target"),
        (["--method", "adam"], "config is OptimizeConfig, and the demonstration has a target"),
    ):
        with pytest.raises(SystemExit):
            main([*map(str, words), *extra])
        assert message in capsys.readouterr().err


def inverse(pose):
    turn = Rotation.from_quat(pose[:4], scalar_first=True).inv()
    return np.concatenate([turn.as_quat(scalar_first=True), -turn.apply(pose[4:])])


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--target-object", "shelf.npy"], "--target-object needs a --demonstration with a target"),
        (["--target-weights", "mug"], "--target-weights is for a --demonstration with a target"),
    ],
)
def test_options_of_a_target_need_one(capsys, words, message):
    with pytest.raises(SystemExit) as end:
        main(["imitate", *words])
    assert end.value.code == 2 and message in capsys.readouterr().err


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"query-box": "0.1 0.2"}, "--query-box has 2 numbers; expected one edge, or three"),
        ({"query-box": -1}, "size is"),
        ({"grasp": 9}, "grasp is 9"),
        ({"grasp": 7}, "expected the grasp first"),
        ({"scale": 0.0001}, "diagonal of"),
        ({"query-centre": "9 0 0"}, "expected them at the object"),
        ({"query-box": 60}, "query points have a diagonal of"),
        ({"seed": -1}, "--seed is -1"),
        ({"out": "demo.json"}, "expected .npz"),
        ({"trajectory": "nowhere.tum"}, "there is no file nowhere.tum"),
    ],
)
def test_bad_input_is_refused_and_writes_nothing(files, capsys, changes, message):
    with pytest.raises(SystemExit) as end:
        call(files, **changes)
    assert end.value.code == 2 and message in capsys.readouterr().err
    assert not (files / "demo.npz").exists()
