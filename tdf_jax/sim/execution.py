"""Execution of a joint trajectory in physics: the actuators follow the planned joints, contacts do the rest."""

import dataclasses
from collections.abc import Callable
from typing import Any

import numpy as np
from jaxtyping import Float

from tdf_jax.sim.joint_trajectory import JointTrajectory
from tdf_jax.sim.physics import TIMESTEP, extra
from tdf_jax.sim.workcell import Workcell

RAMP = 0.2  # seconds in which the weight of a payload is taken up, and let go
SLOW = 0.01  # rad/s, below which a joint's friction is compensated in part: its sign is not known at rest


@dataclasses.dataclass(frozen=True, eq=False)
class Payload:
    """Mass and centre of mass of the object that the hand will hold, for the controller.

    Attributes:
        mass: mass, kg.
        centre: centre of mass, (3,), metres, in the gripper's frame.
    """

    mass: float
    centre: Float[np.ndarray, "3"]


@dataclasses.dataclass(frozen=True, eq=False)
class Controller:
    """Drives a robot's actuators along a trajectory.

    The command of a position actuator is the planned position, with what it takes to keep up: the damping times the
    planned velocity, the joints' friction and the arm's inertia times the planned acceleration, over the actuator's
    stiffness. Without it the UR5e's model, by its damping over its stiffness, would be 0.2 s behind. Gravity on the arm
    itself is compensated (`tdf_jax.sim.robot`), that on what it holds only if the controller has a payload.

    Attributes:
        cell: the cell, with the arm.
        motion: the trajectory.
        payload: what is held along the path, whose weight is then compensated; nothing by default.
        table: what is planned for every step of the physics, by name: position at its start, and velocity and
            acceleration at its end, of the joints, (steps, joints); opening, and the share of the payload that is
            held, (steps,).
        stiffness: of the arm's actuators, (joints,).
        damping: of the actuators and the joints, (joints,).
        friction: of the joints, whatever their velocity, (joints,), newton metres.
    """

    cell: Workcell
    motion: JointTrajectory
    payload: Payload | None = None
    table: dict[str, np.ndarray] = dataclasses.field(init=False)
    stiffness: np.ndarray = dataclasses.field(init=False)
    damping: np.ndarray = dataclasses.field(init=False)
    friction: np.ndarray = dataclasses.field(init=False)

    def __post_init__(self):
        """Sample the trajectory at every step of the physics."""
        times, q = self.motion.times, self.motion.positions
        # The engine integrates velocities implicitly, but takes positions as they are at the start of a step: with
        # those at its end the arm is a step early.
        ends = np.minimum(np.arange(int(round(self.motion.duration / TIMESTEP)) + 2) * TIMESTEP, times[-1])
        begin, at = ends[:-1], ends[1:]
        from scipy.interpolate import CubicSpline

        spline = CubicSpline(times, q, bc_type="clamped") if len(times) > 1 else None
        zero = np.zeros((len(at), q.shape[1]))
        table = {
            "position": zero + q[0] if spline is None else spline(begin),
            "velocity": zero if spline is None else spline(at, 1),
            "acceleration": zero if spline is None else spline(at, 2),
            "opening": np.interp(at, times, self.motion.gripper),
            "held": np.zeros(len(at)),
        }
        phases = self.motion.segment_slices()
        if "path" in phases:
            lifted, placed = times[phases["path"].start], times[phases["path"].stop - 1]
            table["held"] = np.clip(np.minimum(at - lifted, placed + RAMP - at) / RAMP, 0.0, 1.0)
        object.__setattr__(self, "table", table)
        model = self.cell.model
        arm = self.cell.arm_actuators
        object.__setattr__(self, "stiffness", model.actuator_gainprm[arm, 0].copy())
        dofs = self.cell.arm_dofs
        object.__setattr__(self, "damping", -model.actuator_biasprm[arm, 2] + model.dof_damping[dofs])
        object.__setattr__(self, "friction", model.dof_frictionloss[dofs].copy())

    @property
    def num_steps(self) -> int:
        """Number of steps of the physics."""
        return len(self.table["opening"])

    def command(self, data: Any, step: int) -> None:
        """Set the actuators for a step of the physics."""
        mujoco = extra("Controller", "mujoco")
        cell, table = self.cell, self.table
        model = cell.model
        wanted, inertia = np.zeros(model.nv), np.zeros(model.nv)
        wanted[cell.arm_dofs] = table["acceleration"][step]
        mujoco.mj_mulM(model, data, inertia, wanted)
        velocity = table["velocity"][step]
        ahead = self.damping * velocity + inertia[cell.arm_dofs] + self.friction * np.tanh(velocity / SLOW)
        if self.payload is not None and table["held"][step]:
            T = cell.gripper_pose(data)
            moves = np.zeros((3, model.nv))
            body = int(model.site_bodyid[cell.site])
            mujoco.mj_jac(model, data, moves, None, T[:3, :3] @ self.payload.centre + T[:3, 3], body)
            weight = table["held"][step] * self.payload.mass * model.opt.gravity
            ahead = ahead - moves[:, cell.arm_dofs].T @ weight
        data.ctrl[cell.arm_actuators] = table["position"][step] + ahead / self.stiffness
        data.ctrl[cell.finger_actuator] = cell.fingers.command(float(table["opening"][step]))


def execute(
    cell: Workcell,
    data: Any,
    motion: JointTrajectory,
    watch: Callable[[Any, int, str], None] | None = None,
    payload: Payload | None = None,
) -> None:
    """Run the physics along a trajectory; the state is where it ends.

    Args:
        cell: the cell, with the arm.
        data: its state, which changes.
        motion: the trajectory.
        watch: called after every step with the state, the number of the step and the phase.
        payload: mass and centre of mass of the object that the hand will hold, whose weight is then compensated.
    """
    mujoco = extra("execute()", "mujoco")
    controller = Controller(cell, motion, payload)
    starts = [(name, motion.times[first]) for name, first in motion.segments] or [("", 0.0)]
    phase = 0
    for step in range(controller.num_steps):
        controller.command(data, step)
        mujoco.mj_step(cell.model, data)
        while phase + 1 < len(starts) and step * TIMESTEP >= starts[phase + 1][1] - 1e-9:
            phase += 1
        if watch is not None:
            watch(data, step, starts[phase][0])
