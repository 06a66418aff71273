"""Joint trajectories: when each joint of a robot is where, and their files."""

import csv
import io
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from tdf_jax._internal import checks
from tdf_jax._internal.boundary import public
from tdf_jax._internal.errors import InputError
from tdf_jax._internal.files import replace_file
from tdf_jax.io.content import UnsupportedError, file_bytes, known_suffix, reading

WIDEST = 1.0  # metres between the fingers; a wider opening is in millimetres
ARRAYS = {"times": "fiu", "positions": "fiu", "gripper": "fiu", "joint_names": "U", "segments": "U", "starts": "iu"}
ROS_SUFFIXES = (".yaml", ".yml")


@dataclass(frozen=True, eq=False)
class JointTrajectory:
    """Positions of a robot's joints and the opening of its gripper at increasing times.

    The robot stands before the first sample and after the last. All arrays become float64 that cannot be written to.

    Attributes:
        times: times of the samples, (samples,), seconds, strictly increasing from 0.
        positions: joint positions, (samples, joints), radians.
        joint_names: names of the joints, one for each column of the positions.
        gripper: commanded opening between the fingers, (samples,), metres.
        segments: phases of the motion in order, such as `(("approach", 0), ("grasp", 120))`: the name of each and the
            index of its first sample. Empty, or the first begins at sample 0. Two phases in a row have two names.
    """

    times: Float[np.ndarray, " samples"]
    positions: Float[np.ndarray, "samples joints"]
    joint_names: tuple[str, ...]
    gripper: Float[np.ndarray, " samples"]
    segments: tuple[tuple[str, int], ...] = ()

    @public
    def __post_init__(self):
        """Check all arguments and copy the arrays.

        Raises:
            InputError: shapes disagree, a number is not finite, times do not increase from 0, names repeat, an opening
                is outside 0 to 1 m, or segments are not in order.
        """
        function = "JointTrajectory()"
        times = checks.numbers(function, "times", self.times)
        positions = checks.numbers(function, "positions", self.positions)
        gripper = checks.numbers(function, "gripper", self.gripper)
        if positions.ndim != 2 or not positions.size:
            raise InputError(
                f"{function}: positions have shape {positions.shape}; expected (samples, joints), at least one of both"
            )
        for name, array in (("times", times), ("gripper", gripper)):
            if array.shape != positions.shape[:1]:
                raise InputError(
                    f"{function}: {name} has shape {array.shape}; expected {positions.shape[:1]}, one for each row of "
                    "the positions"
                )
        for name, array in (("times", times), ("positions", positions), ("gripper", gripper)):
            if not np.isfinite(array).all():
                sample = int(np.argwhere(~np.isfinite(array))[0, 0])
                raise InputError(f"{function}: {name} of sample {sample} is NaN or infinite; expected finite numbers")
        if times[0] != 0 or (np.diff(times) <= 0).any():
            sample = int(np.argmax(np.diff(times) <= 0)) + 1 if times[0] == 0 else 0
            raise InputError(
                f"{function}: sample {sample} has the time {times[sample]:.9g} s"
                + (f" after {times[sample - 1]:.9g} s" if sample else "")
                + "; expected seconds that increase strictly from 0. Subtract the first time, and drop repeated samples"
            )
        if (gripper < 0).any() or (gripper > WIDEST).any():
            sample = int(np.argmax((gripper < 0) | (gripper > WIDEST)))
            raise InputError(
                f"{function}: the gripper of sample {sample} has an opening of {gripper[sample]:.6g}; expected metres "
                f"between the fingers, from 0 to {WIDEST:g}. Divide millimetres by 1000"
            )
        joint_names = _names(function, "joint_names", self.joint_names)
        if len(joint_names) != positions.shape[1] or len(set(joint_names)) < len(joint_names):
            raise InputError(
                f"{function}: joint_names are {joint_names}; expected {positions.shape[1]} different names, one for "
                "each column of the positions"
            )
        segments = _segments(function, self.segments, len(times))
        for name, value in (("times", times), ("positions", positions), ("gripper", gripper)):
            own = np.array(value, np.float64)
            own.setflags(write=False)
            object.__setattr__(self, name, own)
        object.__setattr__(self, "joint_names", joint_names)
        object.__setattr__(self, "segments", segments)

    @property
    def duration(self) -> float:
        """Time of the last sample, seconds."""
        return float(self.times[-1])

    @property
    def num_samples(self) -> int:
        """Number of samples."""
        return len(self.times)

    @property
    def num_joints(self) -> int:
        """Number of joints."""
        return self.positions.shape[1]

    def velocities(self) -> Float[np.ndarray, "samples joints"]:
        """Compute joint velocities by central differences.

        Returns:
            Velocities, (samples, joints), radians per second; 0 at the first and the last sample, where the robot is
            at rest.
        """
        velocities = np.zeros_like(self.positions)
        if len(self.times) > 2:
            velocities[1:-1] = np.gradient(self.positions, self.times, axis=0)[1:-1]
        return velocities

    @public
    def at(self, time: ArrayLike) -> tuple[Float[np.ndarray, "*times joints"], Float[np.ndarray, "*times"]]:
        """Interpolate linearly between samples.

        Args:
            time: one time or times of any shape, seconds, at least 0. After the end the robot stays at the last sample.

        Returns:
            Joint positions, (*times, joints), radians, and the opening of the gripper, (*times,), metres.

        Raises:
            InputError: a time is negative or not finite.
        """
        time = checks.numbers("JointTrajectory.at()", "time", time)
        if not (np.isfinite(time) & (time >= 0)).all():
            wrong = time[~(np.isfinite(time) & (time >= 0))].flat[0]
            raise InputError(f"JointTrajectory.at(): time is {wrong}; expected finite seconds of 0 or more")
        if len(self.times) == 1:
            index, fraction = np.zeros(time.shape, int), np.zeros(time.shape)
            after = index
        else:
            index = np.clip(np.searchsorted(self.times, time, side="right") - 1, 0, len(self.times) - 2)
            after = index + 1
            fraction = np.minimum((time - self.times[index]) / (self.times[after] - self.times[index]), 1)
        # Exact at both samples, unlike a + fraction * (b - a).
        positions = (1 - fraction)[..., None] * self.positions[index] + fraction[..., None] * self.positions[after]
        return positions, np.asarray((1 - fraction) * self.gripper[index] + fraction * self.gripper[after])

    def segment_slices(self) -> dict[str, slice]:
        """Samples of each phase.

        Returns:
            For each name in `segments`, the slice of its samples.

        Raises:
            InputError: two phases have one name.
        """
        names = [name for name, _ in self.segments]
        if len(set(names)) < len(names):
            raise InputError(
                f"JointTrajectory.segment_slices(): the phases are {names}; expected different names. Take the indices "
                "in segments"
            )
        ends = [start for _, start in self.segments[1:]] + [len(self.times)]
        return {name: slice(start, end) for (name, start), end in zip(self.segments, ends)}

    @public
    def save(self, path: str | Path) -> None:
        """Write the trajectory.

        Args:
            path: .npz file (arrays with the names of the attributes); .csv file (a line `time,<joint names>,gripper,
                segment`, then one for each sample); both are read by `load_joint_trajectory` without loss. Or .yaml
                file, the message of `to_ros2_yaml`.

        Raises:
            InputError: the suffix is unknown, or the file cannot be written.
        """
        path = known_suffix("JointTrajectory.save()", path, (".npz", ".csv", *ROS_SUFFIXES))
        suffix = path.suffix.lower()
        if suffix == ".npz":
            content = self._npz()
        else:
            content = (self._csv() if suffix == ".csv" else self.to_ros2_yaml()).encode()
        replace_file("JointTrajectory.save()", path, content)

    @public
    def to_ros2_yaml(self, seconds: float | None = None) -> str:
        """Write the message `trajectory_msgs/msg/JointTrajectory` of ROS 2 as YAML, without ROS.

        `ros2 topic pub --once TOPIC trajectory_msgs/msg/JointTrajectory "$(cat FILE)"` publishes the text in a file.
        Linux takes at most 128 KiB of such an argument: give `seconds` to write fewer points, between which
        controllers interpolate. The message has no place for the gripper: its openings are in comments.

        Args:
            seconds: least time between two points, seconds; the first and the last sample of each phase are written
                too. None writes all samples.

        Returns:
            The text, with positions in radians and velocities in radians per second, to 1e-9; at the last point 0.

        Raises:
            InputError: seconds is not positive, or two samples are in the same nanosecond.
        """
        if seconds is not None:
            checks.positive("JointTrajectory.to_ros2_yaml()", "seconds", seconds, "seconds")
        nanoseconds = [round(float(time) * 1e9) for time in self.times]
        if any(after <= before for before, after in zip(nanoseconds, nanoseconds[1:])):
            raise InputError(
                "JointTrajectory.to_ros2_yaml(): two samples are in the same nanosecond; expected times that ROS can "
                "tell apart. Resample the trajectory by at()"
            )
        velocities = self.velocities()
        lines = [
            "# trajectory_msgs/msg/JointTrajectory; the gripper is not a part of the message:",
            *(
                f"# {name}: from {self.times[start]:.3f} s, commanded opening {self.gripper[start]:.4f} m to "
                f"{self.gripper[end - 1]:.4f} m"
                for name, start, end in self._phases()
            ),
            "header:",
            "  stamp: {sec: 0, nanosec: 0}",
            "  frame_id: ''",
            "joint_names:",
            *(f"- {json.dumps(name, ensure_ascii=False)}" for name in self.joint_names),
            "points:",
        ]
        for sample in self._chosen(seconds):
            lines += [
                f"- positions: {_flow(self.positions[sample])}",
                f"  velocities: {_flow(velocities[sample])}",
                "  accelerations: []",
                "  effort: []",
                f"  time_from_start: {{sec: {nanoseconds[sample] // 10**9}, nanosec: {nanoseconds[sample] % 10**9}}}",
            ]
        return "\n".join(lines) + "\n"

    def _phases(self) -> list[tuple[str, int, int]]:
        """Name, first sample and the sample after the last of each phase; one phase if there are none."""
        segments = self.segments or (("trajectory", 0),)
        ends = [start for _, start in segments[1:]] + [len(self.times)]
        return [(name, start, end) for (name, start), end in zip(segments, ends)]

    def _chosen(self, seconds: float | None) -> list[int]:
        """Samples that become points of the message: no two nearer than `seconds`, but the ends of phases."""
        if seconds is None:
            return list(range(len(self.times)))
        always = {sample for _, start, end in self._phases() for sample in (start, end - 1)}
        chosen, last = [], -np.inf
        for sample, time in enumerate(self.times):
            if sample in always or time - last >= seconds * (1 - 1e-9):
                chosen.append(sample)
                last = time
        return chosen

    def _npz(self) -> bytes:
        file = io.BytesIO()
        np.savez(
            file,
            times=self.times,
            positions=self.positions,
            gripper=self.gripper,
            joint_names=np.array(self.joint_names, np.str_),
            segments=np.array([name for name, _ in self.segments], np.str_),
            starts=np.array([start for _, start in self.segments], np.int64),
        )
        return file.getvalue()

    def _csv(self) -> str:
        text = io.StringIO()
        writer = csv.writer(text, lineterminator="\n")
        writer.writerow(["time", *self.joint_names, "gripper", "segment"])
        segments = [""] * len(self.times)
        for name, start, end in self._phases() if self.segments else ():
            segments[start:end] = [name] * (end - start)
        rows = np.column_stack([self.times, self.positions, self.gripper]).tolist()
        writer.writerows([*map(repr, row), segment] for row, segment in zip(rows, segments))
        return text.getvalue()


@public
def load_joint_trajectory(path: str | Path) -> JointTrajectory:
    """Read a trajectory that `JointTrajectory.save` wrote as .npz or .csv.

    Args:
        path: .npz or .csv file.

    Returns:
        The trajectory, equal to the one that was written, bit for bit.

    Raises:
        InputError: the file is missing, cut off or of another kind, or its numbers are no trajectory.
    """
    path = known_suffix("load_joint_trajectory()", path, (".npz", ".csv"))
    checks.existing_file("load_joint_trajectory()", path)
    with reading("load_joint_trajectory()", path):
        fields = _read_npz(path) if path.suffix.lower() == ".npz" else _read_csv(path)
    try:
        return JointTrajectory(**fields)
    except InputError as error:
        reason = str(error).removeprefix("JointTrajectory(): ")
        raise InputError(f"load_joint_trajectory(): {path} holds no joint trajectory: {reason}") from None


def _read_npz(path: Path) -> dict[str, Any]:
    data = file_bytes(path)
    with np.lib.npyio.NpzFile(io.BytesIO(data), allow_pickle=False) as arrays:
        missing = [name for name in ARRAYS if name not in arrays]
        if missing:
            raise UnsupportedError(
                f"holds the arrays {', '.join(arrays) or 'of nothing'}; expected also {', '.join(missing)}, as of "
                "JointTrajectory.save()"
            )
        read = {name: arrays[name] for name in ARRAYS}
    for name, kinds in ARRAYS.items():
        if read[name].dtype.kind not in kinds:
            expected = "text" if kinds == "U" else "whole numbers" if kinds == "iu" else "numbers"
            raise UnsupportedError(f"has {name} of dtype {read[name].dtype}; expected {expected}")
    names, starts = read.pop("segments"), read.pop("starts")
    if names.ndim != 1 or names.shape != starts.shape or read["joint_names"].ndim != 1:
        raise UnsupportedError(
            f"has joint_names of shape {read['joint_names'].shape}, segments {names.shape} and starts {starts.shape}; "
            "expected (joints,), (segments,) and (segments,)"
        )
    segments = tuple(zip(names.tolist(), starts.tolist()))
    return {**read, "joint_names": tuple(read["joint_names"].tolist()), "segments": segments}


def _read_csv(path: Path) -> dict[str, Any]:
    text = file_bytes(path).decode("utf-8-sig")
    if not text.endswith(("\n", "\r")):
        raise UnsupportedError(
            "has a last line without its end, so that it may be cut off; expected a whole file. Write it again, or end "
            "the line if you wrote it by hand"
        )
    header, *rows = csv.reader(io.StringIO(text, newline=""), strict=True)
    if len(header) < 4 or header[0] != "time" or header[-2:] != ["gripper", "segment"]:
        raise UnsupportedError(
            f"has a first line of {len(header)} columns, {', '.join(header)[:80]}; expected time, the names of the "
            "joints, gripper, segment, separated by commas"
        )
    numbers = []
    for line, row in enumerate(rows, 2):
        if len(row) != len(header):
            raise UnsupportedError(f"has {len(row)} values in line {line}; expected {len(header)}, as in the first")
        try:
            numbers.append([_number(value) for value in row[:-1]])
        except ValueError as error:
            raise UnsupportedError(f"has {error} in line {line}; expected numbers") from None
    values = np.array(numbers, np.float64).reshape(len(rows), len(header) - 1)
    names = [row[-1] for row in rows]
    starts = [sample for sample, name in enumerate(names) if sample == 0 or name != names[sample - 1]]
    segments = tuple((names[start], start) for start in starts) if any(names) else ()
    return {
        "times": values[:, 0],
        "positions": values[:, 1:-1],
        "gripper": values[:, -1],
        "joint_names": tuple(header[1:-2]),
        "segments": segments,
    }


def _number(text: str) -> float:
    if "_" in text:  # which Python takes in numbers
        raise ValueError(repr(text))
    try:
        return float(text)
    except ValueError:
        raise ValueError(repr(text)) from None


def _flow(values: np.ndarray) -> str:
    """A list of YAML; in fixed notation, because 1e-05 is text for readers of YAML 1.1."""
    return f"[{', '.join(f'{value:.9f}' for value in (np.round(values, 9) + 0.0).tolist())}]"


def _names(function: str, name: str, value) -> tuple[str, ...]:
    """Check that a value is a sequence of printable names."""
    names = () if isinstance(value, str) or not hasattr(value, "__iter__") else tuple(value)
    if not names or not all(isinstance(one, str) and one and one.isprintable() for one in names):
        raise InputError(
            f"{function}: {name} is {value!r}; expected a tuple of names, each of printable characters, such as "
            "('shoulder_pan_joint', 'elbow_joint')"
        )
    return tuple(str(one) for one in names)


def _segments(function: str, value, samples: int) -> tuple[tuple[str, int], ...]:
    """Check that a value is names of phases with increasing indices of their first samples."""
    expected = "expected pairs of a name and the index of its first sample, such as (('approach', 0), ('grasp', 120))"
    try:
        pairs = [(name, start) for name, start in value]
    except (TypeError, ValueError):
        raise InputError(f"{function}: segments is {value!r}; {expected}") from None
    if not pairs:
        return ()
    names = _names(function, "the names of segments", [name for name, _ in pairs])
    whole = all(isinstance(start, int | np.integer) and not isinstance(start, bool) for _, start in pairs)
    starts = [int(start) for _, start in pairs] if whole else []
    if not whole or starts[0] != 0 or starts[-1] >= samples or (np.diff(starts) <= 0).any():
        raise InputError(
            f"{function}: segments begin at {[start for _, start in pairs]}; expected indices that increase strictly "
            f"from 0 to at most {samples - 1}, the last sample. Leave out phases without a sample"
        )
    for before, after in zip(names, names[1:]):
        if before == after:
            raise InputError(f"{function}: two segments in a row are {after!r}; expected one, or two names")
    return tuple(zip(names, starts))
