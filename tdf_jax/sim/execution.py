"""Execution of a joint trajectory in physics: the actuators follow the planned joints, contacts do the rest."""

import dataclasses
from collections.abc import Callable
from typing import Any

import numpy as np

from tdf_jax.sim.joint_trajectory import JointTrajectory
from tdf_jax.sim.physics import TIMESTEP, extra
from tdf_jax.sim.workcell import Workcell

SLOW = 0.01  # rad/s, below which a joint's friction is compensated in part: its sign is not known at rest


@dataclasses.dataclass(frozen=True, eq=False)
class Controller:
    """Drives a robot's actuators along a trajectory.

    The command of a position actuator is the planned position, with what it takes to keep up: the damping times the
    planned velocity, the joints' friction and the arm's inertia times the planned acceleration, over the actuator's
    stiffness. Without it the
    UR5e's model, by its damping over its stiffness, would be 0.2 s behind. Gravity on the arm itself is compensated
    (`tdf_jax.sim.robot`), that on what it holds is not.

    Attributes:
        cell: the cell, with the arm.
        motion: the trajectory.
        table: what is planned for every step of the physics, by name: position, velocity and acceleration of the
            joints, (steps, joints), and opening, (steps,).
        stiffness: of the arm's actuators, (joints,).
        damping: of the actuators and the joints, (joints,).
        friction: of the joints, whatever their velocity, (joints,), newton metres.
    """

    cell: Workcell
    motion: JointTrajectory
    table: dict[str, np.ndarray] = dataclasses.field(init=False)
    stiffness: np.ndarray = dataclasses.field(init=False)
    damping: np.ndarray = dataclasses.field(init=False)
    friction: np.ndarray = dataclasses.field(init=False)

    def __post_init__(self):
        """Sample the trajectory at every step of the physics."""
        times, q = self.motion.times, self.motion.positions
        # What is planned for the end of a step, which is where its command leads.
        at = np.minimum(np.arange(1, int(round(self.motion.duration / TIMESTEP)) + 2) * TIMESTEP, times[-1])
        from scipy.interpolate import CubicSpline

        spline = CubicSpline(times, q, bc_type="clamped") if len(times) > 1 else None
        zero = np.zeros((len(at), q.shape[1]))
        table = {
            "position": zero + q[0] if spline is None else spline(at),
            "velocity": zero if spline is None else spline(at, 1),
            "acceleration": zero if spline is None else spline(at, 2),
            "opening": np.interp(at, times, self.motion.gripper),
        }
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
        data.ctrl[cell.arm_actuators] = table["position"][step] + ahead / self.stiffness
        data.ctrl[cell.finger_actuator] = cell.fingers.command(float(table["opening"][step]))


def execute(
    cell: Workcell,
    data: Any,
    motion: JointTrajectory,
    watch: Callable[[Any, int, str], None] | None = None,
) -> None:
    """Run the physics along a trajectory; the state is where it ends.

    Args:
        cell: the cell, with the arm.
        data: its state, which changes.
        motion: the trajectory.
        watch: called after every step with the state, the number of the step and the phase.
    """
    mujoco = extra("execute()", "mujoco")
    controller = Controller(cell, motion)
    starts = [(name, motion.times[first]) for name, first in motion.segments] or [("", 0.0)]
    phase = 0
    for step in range(controller.num_steps):
        controller.command(data, step)
        mujoco.mj_step(cell.model, data)
        while phase + 1 < len(starts) and step * TIMESTEP >= starts[phase + 1][1] - 1e-9:
            phase += 1
        if watch is not None:
            watch(data, step, starts[phase][0])
