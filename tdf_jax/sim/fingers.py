"""The fingers of a parallel gripper: how they answer to commands, measured in the physics."""

import dataclasses
import warnings
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float

from tdf_jax._internal.errors import InputError
from tdf_jax.sim.physics import TIMESTEP, compiled, extra

if TYPE_CHECKING:
    from tdf_jax.sim.robot import Robot

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
        forces: force of each pad on what keeps the fingers that far open when closing is commanded, (commands,),
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
        """Force of each pad on what keeps the fingers open to an opening, metres, when closing is commanded."""
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


def measured_fingers(robot: "Robot") -> Fingers:
    """Command the fingers from open to closed, and measure the gap by rays from the middle.

    Args:
        robot: the robot, in whose physics they are measured.

    Raises:
        InputError: there are no two fingers on both sides along the site's y axis, or the actuator does not close them.

    Warns:
        UserWarning: they press so little on a thin wall that objects slip.
    """
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
