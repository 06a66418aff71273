"""Joint trajectories: checks, interpolation, files that give back the same bits, and the message of ROS 2."""

from dataclasses import FrozenInstanceError

import jax
import numpy as np
import pytest
import yaml

from tdf_jax._internal.errors import InputError
from tdf_jax.sim.joint_trajectory import JointTrajectory, load_joint_trajectory

NAMES = ("shoulder, pan", 'elbow "1"', "ur5e/wrist_ü")
SEGMENTS = (("approach", 0), ("grasp", 7), ("path", 8), ("approach", 15))


def trajectory(samples=20, segments=SEGMENTS, **changes):
    random = np.random.default_rng(0)
    times = np.concatenate([[0.0], np.cumsum(random.uniform(0.01, 0.3, samples - 1))])
    fields = {
        "times": times,
        "positions": random.normal(size=(samples, 3)) * 10.0 ** random.integers(-12, 1, (samples, 3)),
        "joint_names": NAMES,
        "gripper": random.uniform(0, 0.085, samples),
        "segments": segments,
    }
    return JointTrajectory(**fields | changes)


def same(a, b):
    arrays = all(getattr(a, name).tobytes() == getattr(b, name).tobytes() for name in ("times", "positions", "gripper"))
    return arrays and (a.joint_names, a.segments) == (b.joint_names, b.segments)


def test_a_trajectory_is_a_value():
    positions = np.zeros((2, 1))
    one = JointTrajectory([0, 2], positions, ["elbow"], [0, 0.08], [["path", np.int64(0)]])
    positions[:] = 9
    assert (one.duration, one.num_samples, one.num_joints) == (2.0, 2, 1)
    assert one.joint_names == ("elbow",) and one.segments == (("path", 0),)
    assert one.positions.max() == 0 and one.times.dtype == np.float64
    with pytest.raises(ValueError, match="read-only"):
        one.positions[0] = 1
    with pytest.raises(FrozenInstanceError):
        one.times = np.zeros(2)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"times": np.arange(19.0)}, r"times has shape \(19,\); expected \(20,\)"),
        ({"gripper": np.zeros((20, 1))}, r"gripper has shape \(20, 1\); expected \(20,\)"),
        ({"positions": np.zeros(20)}, r"positions have shape \(20,\); expected \(samples, joints\)"),
        ({"positions": np.zeros((0, 3))}, r"positions have shape \(0, 3\)"),
        ({"positions": np.full((20, 3), 1j)}, r"positions is array\(.*"),
        ({"positions": np.where(np.arange(60) == 17, np.nan, 0).reshape(20, 3)}, "positions of sample 5 is NaN"),
        ({"gripper": np.where(np.arange(20) == 3, np.inf, 0)}, "gripper of sample 3 is NaN or infinite"),
        ({"times": np.arange(20.0) + 1}, "sample 0 has the time 1 s; expected seconds that increase"),
        ({"times": np.arange(20.0) % 9}, "sample 9 has the time 0 s after 8 s"),
        ({"times": np.arange(20) // 2}, "sample 1 has the time 0 s after 0 s"),
        ({"gripper": np.full(20, 85.0)}, "opening of 85; expected metres .* Divide millimetres by 1000"),
        ({"gripper": np.linspace(0.01, -0.01, 20)}, "the gripper of sample 10 has an opening of -0.0005"),
        ({"joint_names": ("a", "b")}, "expected 3 different names"),
        ({"joint_names": ("a", "b", "a")}, "expected 3 different names"),
        ({"joint_names": "abc"}, "joint_names is 'abc'; expected a tuple of names"),
        ({"joint_names": ("a", "b", "c\n")}, "printable"),
        ({"joint_names": (1, 2, 3)}, "printable"),
        ({"segments": "path"}, "segments is 'path'; expected pairs"),
        ({"segments": (("path", 1),)}, "segments begin at .1.; expected indices that increase strictly from 0"),
        ({"segments": (("a", 0), ("b", 20))}, "at most 19"),
        ({"segments": (("a", 0), ("b", 5), ("c", 5))}, "Leave out phases without a sample"),
        ({"segments": (("a", 0), ("b", 5.0))}, "segments begin at"),
        ({"segments": (("a", 0), ("a", 5))}, "two segments in a row are 'a'"),
        ({"segments": (("", 0),)}, "the names of segments is"),
    ],
)
def test_what_is_no_trajectory_is_refused(changes, message):
    with pytest.raises(InputError, match=rf"^JointTrajectory\(\): .*{message}"):
        trajectory(**changes)


def test_traced_numbers_are_refused_by_name():
    with pytest.raises(InputError, match=r"JointTrajectory\(\): .*traced"):
        jax.jit(lambda x: trajectory(positions=x).positions)(np.zeros((20, 3)))


def test_interpolation_is_linear_and_exact_at_samples():
    one = trajectory()
    positions, gripper = one.at(one.times)
    assert (positions == one.positions).all() and (gripper == one.gripper).all()
    times = np.random.default_rng(1).uniform(0, one.duration, (4, 5))
    positions, gripper = one.at(times)
    assert positions.shape == (4, 5, 3)
    for joint in range(3):
        np.testing.assert_allclose(positions[..., joint], np.interp(times, one.times, one.positions[:, joint]))
    np.testing.assert_allclose(gripper, np.interp(times, one.times, one.gripper))
    last = one.at(one.duration + 5)
    assert (last[0] == one.positions[-1]).all() and last[1] == one.gripper[-1] and last[1].shape == ()
    standing = JointTrajectory([0.0], [[1.0, 2.0]], ("a", "b"), [0.01])
    assert standing.duration == 0 and standing.at([0, 3])[0].tolist() == [[1, 2], [1, 2]]
    for wrong in (-1e-9, np.nan, [0, np.inf]):
        with pytest.raises(InputError, match=r"JointTrajectory.at\(\): time is"):
            one.at(wrong)


def test_velocities_are_the_derivative_and_the_ends_are_at_rest():
    times = np.cumsum(np.random.default_rng(0).uniform(0.005, 0.01, 400))
    times -= times[0]
    phase = times / times[-1] * np.pi
    one = JointTrajectory(times, np.stack([np.cos(phase), 2 * np.cos(phase)], axis=1), ("a", "b"), 0 * times)
    speed = -np.sin(phase) * np.pi / times[-1]
    np.testing.assert_allclose(one.velocities(), np.stack([speed, 2 * speed], axis=1), atol=2e-4)
    assert not one.velocities()[[0, -1]].any()
    for few in (1, 2):
        assert not trajectory(few, ()).velocities().any()


def test_the_samples_of_phases():
    one = trajectory(segments=SEGMENTS[:3])
    assert one.segment_slices() == {"approach": slice(0, 7), "grasp": slice(7, 8), "path": slice(8, 20)}
    assert trajectory(segments=()).segment_slices() == {}
    with pytest.raises(InputError, match="expected different names"):
        trajectory().segment_slices()


@pytest.mark.parametrize("suffix", [".npz", ".CSV"])
@pytest.mark.parametrize(("samples", "segments"), [(20, SEGMENTS), (20, ()), (1, (("wait", 0),))])
def test_files_give_back_the_same_bits(tmp_path, suffix, samples, segments):
    one = trajectory(samples, segments)
    path = tmp_path / f"motion{suffix}"
    one.save(path)
    content = path.read_bytes()
    loaded = load_joint_trajectory(path)
    assert same(loaded, one)
    loaded.save(path)
    assert path.read_bytes() == content
    assert [file.name for file in tmp_path.iterdir()] == [path.name]


def test_the_columns_of_a_csv_file(tmp_path):
    JointTrajectory([0, 0.1], [[0.1, -1e-9], [1 / 3, 2]], ("a", "b"), [0.085, 0], (("x", 0), ("y", 1))).save(
        tmp_path / "a.csv"
    )
    assert (tmp_path / "a.csv").read_text().splitlines() == [
        "time,a,b,gripper,segment",
        "0.0,0.1,-1e-09,0.085,x",
        "0.1,0.3333333333333333,2.0,0.0,y",
    ]
    (tmp_path / "b.csv").write_bytes(b"\xef\xbb\xbftime,a,gripper,segment\r\n0,1,0.01,\r\n0.5,2,0.01,\r\n")
    other = load_joint_trajectory(tmp_path / "b.csv")
    assert other.positions.tolist() == [[1], [2]] and other.segments == ()


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("time,", "seconds,", "has a first line of 4 columns, seconds"),
        (",gripper", "", "has a first line of 3 columns"),
        (",", ";", "has a first line of 1 columns"),
        ("0.5,2,", "0.5,2,3,", "has 5 values in line 3; expected 4"),
        ("0.5,2,", "0.5,two,", "has 'two' in line 3; expected numbers"),
        ("0.5,2,", "0.5,1_0,", "has '1_0' in line 3; expected numbers"),
        ("0.5,2,", "0.5,,", "has '' in line 3; expected numbers"),
        ("0.5,2,", "0.5,nan,", "holds no joint trajectory: positions of sample 1 is NaN"),
        ("0.5,2,", "-0.5,2,", "holds no joint trajectory: sample 1 has the time -0.5 s after 0 s"),
        (",y\n", ",\n", "holds no joint trajectory: the names of segments is"),
        (",y\n", ",y", "has a last line without its end, so that it may be cut off"),
        ("\n0,1,0.01,x\n0.5,2,0.01,y\n", "\n", "holds no joint trajectory: positions have shape"),
        (",y\n", ',"y\n', "cannot be read as .csv"),
    ],
)
def test_damaged_csv_files_are_refused(tmp_path, old, new, message):
    text = "time,a,gripper,segment\n0,1,0.01,x\n0.5,2,0.01,y\n"
    path = tmp_path / "a.csv"
    path.write_text(text)
    assert load_joint_trajectory(path).segments == (("x", 0), ("y", 1))
    path.write_text(text.replace(old, new))
    with pytest.raises(InputError, match=rf"^load_joint_trajectory\(\): .*a.csv {message}"):
        load_joint_trajectory(path)


def test_damaged_npz_files_are_refused(tmp_path):
    path = tmp_path / "a.npz"
    trajectory().save(path)
    content = path.read_bytes()
    for size in (0, 10, len(content) // 2, len(content) - 1):
        path.write_bytes(content[:size])
        with pytest.raises(InputError, match=r"a.npz cannot be read as .npz .*; save it again"):
            load_joint_trajectory(path)
    damaged = bytearray(content)
    damaged[len(content) // 3] ^= 1
    path.write_bytes(damaged)
    with pytest.raises(InputError, match=r"load_joint_trajectory\(\): .*a.npz"):
        load_joint_trajectory(path)
    path.write_bytes(content)
    with np.load(path) as file:
        arrays = dict(file)
    for changes, message in (
        ({"gripper": None}, "expected also gripper"),
        ({"times": arrays["times"].astype(str)}, "has times of dtype <U32; expected numbers"),
        ({"starts": arrays["starts"] / 2}, "has starts of dtype float64; expected whole numbers"),
        ({"starts": arrays["starts"][:2]}, r"segments \(4,\) and starts \(2,\)"),
        ({"joint_names": np.array([0, 1, 2])}, "has joint_names of dtype int64; expected text"),
        ({"positions": arrays["positions"] * np.nan}, "holds no joint trajectory: positions of sample 0 is NaN"),
    ):
        np.savez(path, **{name: array for name, array in (arrays | changes).items() if array is not None})
        with pytest.raises(InputError, match=rf"^load_joint_trajectory\(\): .*a.npz .*{message}"):
            load_joint_trajectory(path)


def test_other_files_are_refused(tmp_path):
    with pytest.raises(InputError, match=r"save\(\): .* has suffix '.txt'; expected one of .npz, .csv, .yaml, .yml"):
        trajectory().save(tmp_path / "a.txt")
    with pytest.raises(InputError, match=r"save\(\): cannot write"):
        trajectory().save(tmp_path / "nowhere" / "a.csv")
    trajectory().save(tmp_path / "a.yaml")
    with pytest.raises(InputError, match="has suffix '.yaml'; expected one of .npz, .csv"):
        load_joint_trajectory(tmp_path / "a.yaml")
    with pytest.raises(InputError, match="there is no file"):
        load_joint_trajectory(tmp_path / "b.csv")


def test_the_message_of_ros_2(tmp_path):
    one = trajectory()
    one.save(tmp_path / "a.yaml")
    text = (tmp_path / "a.yaml").read_text(encoding="utf-8")
    assert text == one.to_ros2_yaml()
    message = yaml.safe_load(text)
    # the fields of trajectory_msgs/msg/JointTrajectory and JointTrajectoryPoint, which ROS checks by name and type
    assert list(message) == ["header", "joint_names", "points"]
    assert message["header"] == {"stamp": {"sec": 0, "nanosec": 0}, "frame_id": ""}
    assert message["joint_names"] == list(NAMES)
    points = message["points"]
    for point in points:
        assert list(point) == ["positions", "velocities", "accelerations", "effort", "time_from_start"]
        assert all(type(value) is float for value in point["positions"] + point["velocities"])
        assert point["accelerations"] == point["effort"] == []
        start = point["time_from_start"]
        assert type(start["sec"]) is type(start["nanosec"]) is int and 0 <= start["nanosec"] < 10**9
    seconds = [point["time_from_start"]["sec"] + point["time_from_start"]["nanosec"] / 1e9 for point in points]
    np.testing.assert_allclose(seconds, one.times, rtol=0, atol=6e-10)
    np.testing.assert_allclose([point["positions"] for point in points], one.positions, rtol=0, atol=6e-10)
    np.testing.assert_allclose([point["velocities"] for point in points], one.velocities(), rtol=0, atol=6e-10)
    assert points[-1]["velocities"] == [0, 0, 0]  # controllers refuse a goal with a speed at its end
    assert f"# grasp: from {one.times[7]:.3f} s, commanded opening {one.gripper[7]:.4f} m" in text


def test_a_message_of_fewer_points_keeps_the_ends_of_phases():
    times = np.arange(101) * 0.008
    one = JointTrajectory(times, np.sin(times)[:, None], ("a",), 0 * times, (("x", 0), ("y", 33)))
    points = yaml.safe_load(one.to_ros2_yaml(0.08))["points"]
    samples = [round(point["time_from_start"]["nanosec"] / 8e6) for point in points]
    assert samples == [0, 10, 20, 30, 32, 33, 43, 53, 63, 73, 83, 93, 100]
    np.testing.assert_allclose([point["velocities"] for point in points], one.velocities()[samples], atol=6e-10)
    for wrong in (0, -1, np.nan):
        with pytest.raises(InputError, match=r"to_ros2_yaml\(\): seconds is"):
            one.to_ros2_yaml(wrong)
    close = JointTrajectory([0, 1e-10], [[0], [0]], ("a",), [0, 0])
    with pytest.raises(InputError, match="same nanosecond"):
        close.to_ros2_yaml()
