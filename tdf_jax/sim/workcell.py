"""A cell in MuJoCo: the table, an arm or a floating gripper, the object and the target."""

import dataclasses
from typing import Any

import numpy as np
from jaxtyping import Float

from tdf_jax.sim.bodies import Body
from tdf_jax.sim.fingers import Fingers
from tdf_jax.sim.physics import FRICTION, SOLIMP, SOLREF, compiled, extra, set_options
from tdf_jax.sim.robot import PREFIX, Robot

TABLE = ((0.55, 0.0, -0.02), (0.40, 0.60, 0.02))  # centre and half edges, metres; its top is at z = 0
# Weld between the floating gripper and the frame that drives it: as stiff as an arm's actuators hold a wrist.
DRIVE_SOLREF = (0.01, 1.0)
# Anchor at the origin of the second body, the pose between both as it is at the start, and the weight of rotations. The
# default of a new equality is that of a joint: as a weld, an anchor 1 m away.
WELD = (*[0.0] * 10, 1.0, 0.0)
COLOURS = {"object": (0.85, 0.45, 0.25, 1.0), "target": (0.35, 0.55, 0.75, 1.0), "table": (0.75, 0.72, 0.68, 1.0)}
OBJECT, TARGET, TABLE_NAME, HAND, FIXTURE = "object", "target", "table", "hand", "fixture"


@dataclasses.dataclass(frozen=True, eq=False)
class Workcell:
    """A compiled cell; its state is in `mujoco.MjData`, of which any number can be made.

    Attributes:
        model: the `mujoco.MjModel`.
        robot: the robot; None if there is none.
        floating: whether the gripper floats, driven by a frame, instead of being carried by the arm.
        fixed_target: whether the target is fixed to the world.
    """

    model: Any
    robot: Robot | None
    floating: bool
    fixed_target: bool

    def data(self) -> Any:
        """A new state: the arm at home, the fingers open, object and target at their places."""
        mujoco = extra("Workcell", "mujoco")
        data = mujoco.MjData(self.model)
        if self.robot is not None:
            if not self.floating:
                data.qpos[self.arm], data.ctrl[self.arm_actuators] = self.robot.home, self.robot.home
            self.open_fingers(data, self.robot.fingers.widest)
        mujoco.mj_forward(self.model, data)
        return data

    def open_fingers(self, data, opening: float) -> None:
        """Set the fingers' joints and their command to an opening, metres."""
        for name, position in zip(self.fingers.joints, self.fingers.joint_positions(opening)):
            data.joint(PREFIX + name).qpos = position
        data.ctrl[self.finger_actuator] = self.fingers.command(opening)

    @property
    def _own(self) -> Robot:
        if self.robot is None:
            raise ValueError("the cell has no robot")
        return self.robot

    @property
    def fingers(self) -> Fingers:
        """How the robot's gripper answers to commands."""
        return self._own.fingers

    @property
    def arm(self) -> list[int]:
        """Indices of the arm's joints in qpos."""
        return [int(self.model.joint(PREFIX + name).qposadr[0]) for name in self._own.joints]

    @property
    def arm_dofs(self) -> list[int]:
        """Indices of the arm's joints in qvel."""
        return [int(self.model.joint(PREFIX + name).dofadr[0]) for name in self._own.joints]

    @property
    def arm_actuators(self) -> list[int]:
        """Indices of the arm's actuators."""
        return [self.model.actuator(PREFIX + name).id for name in self._own.actuators]

    @property
    def finger_actuator(self) -> int:
        """Index of the fingers' actuator."""
        return self.model.actuator(PREFIX + self._own.finger_actuator).id

    @property
    def site(self) -> int:
        """Index of the gripper's frame."""
        return self.model.site(PREFIX + self._own.site).id

    def body_pose(self, data, name: str) -> Float[np.ndarray, "4 4"]:
        """Pose of a body, 4x4, metres, world frame."""
        body, T = data.body(name), np.eye(4)
        T[:3, :3], T[:3, 3] = body.xmat.reshape(3, 3), body.xpos
        return T

    def gripper_pose(self, data) -> Float[np.ndarray, "4 4"]:
        """Pose of the gripper's frame, 4x4, metres, world frame."""
        T = np.eye(4)
        T[:3, :3], T[:3, 3] = data.site_xmat[self.site].reshape(3, 3), data.site_xpos[self.site]
        return T

    def set_body_pose(self, data, name: str, T: Float[np.ndarray, "4 4"]) -> None:
        """Set the pose of a free body, at rest; of states for planning, and of the start."""
        joint = data.joint(name)
        joint.qpos[:3], joint.qpos[3:] = T[:3, 3], quaternion(T)
        joint.qvel[:] = 0


def quaternion(T: Float[np.ndarray, "4 4"]) -> Float[np.ndarray, "4"]:
    """Quaternion wxyz of the rotation of a pose, 4x4."""
    wxyz = np.empty(4)
    extra("quaternion()", "mujoco").mju_mat2Quat(wxyz, np.ascontiguousarray(T[:3, :3], float).ravel())
    return wxyz


def build_workcell(
    robot: Robot | None,
    one: Body | None = None,
    T_world_object: Float[np.ndarray, "4 4"] | None = None,
    target: Body | None = None,
    T_world_target: Float[np.ndarray, "4 4"] | None = None,
    *,
    floating: bool = False,
    fixture: bool = False,
    fixed_target: bool = True,
    table: bool = True,
) -> Workcell:
    """Build and compile a cell.

    Args:
        robot: the robot; None for the bodies alone.
        one: the object.
        T_world_object: its pose at the start, 4x4, metres, world frame.
        target: the target.
        T_world_target: its pose at the start, 4x4.
        floating: only the gripper, driven by a frame, instead of the arm.
        fixture: whether a fixture holds the object where it starts until it is opened (`data.eq_active`).
        fixed_target: whether the target is fixed to the world.
        table: whether there is a table.

    Raises:
        InputError: the extra "sim" is not installed.
    """
    mujoco = extra("build_workcell()", "mujoco")
    if robot is None:
        spec = mujoco.MjSpec()
        set_options(spec)
    elif floating:
        spec = robot.hand_spec()
        root = spec.bodies[1]
        root.add_freejoint(name=HAND)
        spec.worldbody.add_body(name=HAND, mocap=True)
        weld = spec.add_equality(
            type=mujoco.mjtEq.mjEQ_WELD, objtype=mujoco.mjtObj.mjOBJ_BODY, name1=HAND, name2=root.name
        )
        weld.solref, weld.data = DRIVE_SOLREF, WELD
    else:
        spec = mujoco.MjSpec()
        set_options(spec)
        robot.attach_to(spec)
    if table:
        centre, half = TABLE
        box = mujoco.mjtGeom.mjGEOM_BOX
        top = spec.worldbody.add_geom(name=TABLE_NAME, type=box, pos=centre, size=half, rgba=COLOURS["table"])
        _set_contact(top)
    spec.worldbody.add_light(pos=(0.3, -0.5, 2.0), dir=(0.1, 0.2, -1.0))
    for name, body, pose, free in (
        (OBJECT, one, T_world_object, True),
        (TARGET, target, T_world_target, not fixed_target),
    ):
        if body is not None:
            _add_body(mujoco, spec, name, body, np.eye(4) if pose is None else pose, free)
    if fixture:
        # Fixed to a body at the object, not to the world: a weld is soft about its anchor, the second body's origin.
        pose = np.eye(4) if T_world_object is None else T_world_object
        spec.worldbody.add_body(name=FIXTURE, pos=pose[:3, 3], quat=quaternion(pose))
        kind, bodies = mujoco.mjtEq.mjEQ_WELD, mujoco.mjtObj.mjOBJ_BODY
        hold = spec.add_equality(name=FIXTURE, type=kind, objtype=bodies, name1=FIXTURE, name2=OBJECT)
        hold.solref, hold.solimp, hold.data = SOLREF, (*SOLIMP, 0.5, 2.0), WELD
    return Workcell(compiled(spec), robot, floating, fixed_target)


def _add_body(mujoco, spec, name: str, body: Body, T, free: bool) -> None:
    made = spec.worldbody.add_body(name=name, pos=T[:3, 3], quat=quaternion(T))
    if free:
        made.add_freejoint(name=name)
        made.mass, made.ipos, made.explicitinertial = body.mass, body.centre, True
        values, axes = np.linalg.eigh(body.inertia)
        axes[:, 0] *= np.sign(np.linalg.det(axes))
        turn = np.eye(4)
        turn[:3, :3] = axes
        made.inertia, made.iquat = values, quaternion(turn)
    for number, corners in enumerate(body.parts):
        mesh = f"{name}{number}"
        spec.add_mesh(
            name=mesh, uservert=np.asarray(corners, float).ravel(), inertia=mujoco.mjtMeshInertia.mjMESH_INERTIA_CONVEX
        )
        geom = made.add_geom(name=mesh, type=mujoco.mjtGeom.mjGEOM_MESH, meshname=mesh, rgba=COLOURS[name], mass=0.0)
        _set_contact(geom)


def _set_contact(geom) -> None:
    geom.friction, geom.solref, geom.solimp = FRICTION, SOLREF, (*SOLIMP, 0.5, 2.0)
