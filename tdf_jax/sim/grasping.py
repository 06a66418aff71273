"""The grasp test: does a pose of the gripper hold the object, lifted, turned and held, by friction alone."""

import dataclasses
from collections.abc import Callable
from typing import Any

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from tdf_jax.sim.bodies import Body
from tdf_jax.sim.physics import TIMESTEP, extra
from tdf_jax.sim.robot import PREFIX, Robot
from tdf_jax.sim.swing import level_rotations
from tdf_jax.sim.workcell import FIXTURE, HAND, OBJECT, Workcell, build_workcell, quaternion

CLOSE, LIFT, TURN_TIME, HOLD = 1.0, 1.0, 1.5, 2.0  # seconds of the phases
LET_GO = 0.2  # seconds after a fixture lets go
LIFTED = 0.15  # metres
MOST_SLIP, MOST_TURN = 0.01, 10.0  # metres and degrees that an object may move in the hand after closing


@dataclasses.dataclass(frozen=True)
class Grasp:
    """How a grasp held.

    Attributes:
        held: whether fingers of both sides still touch the object, and it moved in the hand by less than `MOST_SLIP`
            and `MOST_TURN`.
        slip: movement of the object in the hand after closing, metres, of its centre of mass.
        turn: rotation of the object in the hand after closing, degrees.
        pulled: movement of the object while the fingers closed, metres.
        struck: penetration of hand and object before the fingers close, metres.
        T_grip_object: pose of the object in the gripper's frame after closing, 4x4.
    """

    held: bool
    slip: float
    turn: float
    pulled: float
    struck: float
    T_grip_object: Float[np.ndarray, "4 4"]


def evaluate_grasp(
    robot: Robot,
    one: Body,
    T_world_object: Float[np.ndarray, "4 4"],
    T_world_grip: Float[np.ndarray, "4 4"],
    opening: float,
    grip: float = 0.0,
    rotation: Float[np.ndarray, "3 3"] | None = None,
    fixture: bool = False,
    watch: Callable[[Workcell, Any, str], None] | None = None,
) -> Grasp:
    """Close a floating gripper on an object, lift it by 15 cm, turn it as at the release, and hold it for 2 s.

    Args:
        robot: the robot, whose gripper floats.
        one: the object.
        T_world_object: its pose, 4x4, metres, world frame.
        T_world_grip: pose of the gripper's frame at the pick, 4x4.
        opening: opening of the fingers before they close, metres.
        grip: opening that is commanded to hold, metres.
        rotation: orientation of the gripper's frame at the release, 3x3, world frame; that of the pick by default.
        fixture: whether a fixture holds the object until the fingers have closed.
        watch: called after every step with the cell, the state and the phase.
    """
    cell = build_workcell(robot, one, T_world_object, floating=True, fixture=fixture)
    hand = FloatingHand(cell, T_world_grip, opening, watch)
    data = hand.data
    struck = hand.penetration()
    before = cell.body_pose(data, OBJECT)
    hand.close(grip, CLOSE)
    closed, now = hand.T_grip_object, cell.body_pose(data, OBJECT)
    pulled = float(np.linalg.norm((now @ _point(one.centre) - before @ _point(one.centre))[:3]))
    if fixture:
        data.eq_active[cell.model.equality(FIXTURE).id] = 0
        hand.wait(LET_GO)
    lifted = np.array(T_world_grip, float)
    lifted[2, 3] += LIFTED
    hand.move(lifted, LIFT)
    if rotation is not None:
        turned = lifted.copy()
        turned[:3, :3] = rotation
        hand.move(turned, TURN_TIME)
    hand.wait(HOLD)
    moved = np.linalg.inv(closed) @ hand.T_grip_object
    slip = float(np.linalg.norm((hand.T_grip_object @ _point(one.centre) - closed @ _point(one.centre))[:3]))
    turn = float(np.degrees(Rotation.from_matrix(moved[:3, :3]).magnitude()))
    held = hand.holds() and slip < MOST_SLIP and turn < MOST_TURN
    return Grasp(held, slip, turn, pulled, struck, closed)


class FloatingHand:
    """A gripper that floats, driven by a frame: it is moved as an ideal arm would.

    Attributes:
        cell: the cell.
        data: its state.
    """

    def __init__(
        self,
        cell: Workcell,
        T_world_grip: Float[np.ndarray, "4 4"],
        opening: float,
        watch: Callable[[Workcell, Any, str], None] | None = None,
    ):
        """Place the gripper, its fingers open; `watch` is called as by `evaluate_grasp`."""
        mujoco = extra("FloatingHand", "mujoco")
        self.cell, self.data, self._mujoco, self._watch = cell, cell.data(), mujoco, watch
        model = cell.model
        root = model.body(int(model.joint(HAND).bodyid[0])).name
        self._T_site_root = np.linalg.inv(cell.gripper_pose(self.data)) @ cell.body_pose(self.data, root)
        self._pose = np.array(T_world_grip, float)
        cell.open_fingers(self.data, opening)
        start = self._pose @ self._T_site_root
        cell.set_body_pose(self.data, HAND, start)
        self._drive(self._pose)
        mujoco.mj_forward(model, self.data)

    @property
    def T_grip_object(self) -> Float[np.ndarray, "4 4"]:
        """Pose of the object in the gripper's frame, 4x4."""
        return np.linalg.inv(self.cell.gripper_pose(self.data)) @ self.cell.body_pose(self.data, OBJECT)

    def close(self, grip: float, seconds: float) -> None:
        """Command an opening and wait."""
        self.data.ctrl[self.cell.finger_actuator] = self.cell.fingers.command(grip)
        self.wait(seconds)

    def wait(self, seconds: float) -> None:
        """Let time pass."""
        for _ in range(int(round(seconds / TIMESTEP))):
            self._step()

    def move(self, T: Float[np.ndarray, "4 4"], seconds: float) -> None:
        """Move the gripper's frame to a pose, 4x4, straight and turning as `level_rotations` does, smoothly."""
        start, steps = self._pose, int(round(seconds / TIMESTEP))
        shares = np.arange(1, steps + 1) / steps
        shares = shares**3 * (10 - 15 * shares + 6 * shares**2)  # at rest at both ends
        for share, rotation in zip(shares, level_rotations(start[:3, :3], T[:3, :3], shares)):
            pose = np.eye(4)
            pose[:3, :3], pose[:3, 3] = rotation, start[:3, 3] + share * (T[:3, 3] - start[:3, 3])
            self._drive(pose)
            self._step()
        self._pose = np.array(T, float)

    def _step(self) -> None:
        self._mujoco.mj_step(self.cell.model, self.data)
        if self._watch is not None:
            self._watch(self.cell, self.data, "grasp test")

    def penetration(self) -> float:
        """Deepest penetration of hand and object, metres."""
        return max((-distance for _, distance in self._contacts()), default=0.0)

    def holds(self) -> bool:
        """Whether geoms on both sides of the closing direction touch the object."""
        frame = np.linalg.inv(self.cell.gripper_pose(self.data))
        sides = {bool((frame @ _point(self.data.xpos[body]))[1] > 0) for body, _ in self._contacts()}
        return len(sides) == 2

    def _contacts(self):
        model, contact = self.cell.model, self.data.contact
        target = model.body(OBJECT).id
        for (a, b), distance in zip(contact.geom[: self.data.ncon], contact.dist[: self.data.ncon]):
            bodies = int(model.geom_bodyid[a]), int(model.geom_bodyid[b])
            if target in bodies:
                other = bodies[0] if bodies[1] == target else bodies[1]
                if model.body(other).name.startswith(PREFIX):
                    yield other, float(distance)

    def _drive(self, T) -> None:
        root = T @ self._T_site_root
        self.data.mocap_pos[0], self.data.mocap_quat[0] = root[:3, 3], quaternion(root)


def _point(x) -> np.ndarray:
    return np.append(np.asarray(x, float), 1.0)
