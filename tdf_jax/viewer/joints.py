"""A joint trajectory on the screen: the robot, moving through it."""

from typing import Any

import numpy as np
from jaxtyping import Float

from tdf_jax._internal.errors import InputError
from tdf_jax.sim.joint_trajectory import JointTrajectory
from tdf_jax.sim.physics import extra
from tdf_jax.sim.playback import RATE
from tdf_jax.sim.robot import Robot
from tdf_jax.sim.solids import robot_solids
from tdf_jax.sim.workcell import COLOURS, TABLE, build_workcell
from tdf_jax.viewer import handles
from tdf_jax.viewer.player import SPEEDS, Player
from tdf_jax.viz.style import INK

PATH, TABLE_NAME = "path of the gripper", "table"


class JointStage:
    """A robot on the screen that moves through a joint trajectory.

    The fingers have the commanded opening. Nothing is simulated: what they would hold is not shown.

    Args:
        server: the `viser.ViserServer`.
        trajectory: the joint trajectory.
        robot: the robot that it is of.

    Raises:
        InputError: the trajectory is of other joints than the robot's.
    """

    def __init__(self, server: Any, trajectory: JointTrajectory, robot: Robot):
        if set(trajectory.joint_names) != set(robot.joints):
            raise InputError(
                f"tdf view: the trajectory has the joints {', '.join(trajectory.joint_names)}; expected those of "
                f"{robot.name}, {', '.join(robot.joints)}: give --robot FILE --site NAME"
            )
        self.server, self.trajectory = server, trajectory
        self._cell = build_workcell(robot)
        self._data = self._cell.data()
        self._order = [trajectory.joint_names.index(name) for name in robot.joints]
        self._draw()
        self._panel()
        self._show_time()

    def close(self) -> None:
        """Stop what runs beside the server."""
        self.player.stop()

    def gripper_at(self, time: float) -> Float[np.ndarray, "4 4"]:
        """Move the robot to where it is at a time.

        Args:
            time: seconds from the beginning.

        Returns:
            Pose of the gripper's frame, T_world_gripper, 4x4, metres.
        """
        positions, opening = self.trajectory.at(time)
        self._data.qpos[self._cell.arm] = positions[self._order]
        self._cell.open_fingers(self._data, float(opening))
        extra("tdf view", "mujoco").mj_kinematics(self._cell.model, self._data)
        return self._cell.gripper_pose(self._data)

    def _draw(self) -> None:
        scene, solids = self.server.scene, robot_solids(self._cell.model)
        names = dict.fromkeys(one.body for one in solids)
        self.bodies = {name: scene.add_frame(f"/joints/{name}", show_axes=False) for name in names}
        for number, solid in enumerate(solids):
            scene.add_mesh_simple(
                f"/joints/{solid.body}/{number}",
                solid.vertices,
                solid.faces,
                color=handles.rgb(solid.colour),
                side="double",
                flat_shading=solid.angular,
            )
        top = scene.add_box(
            "/table",
            color=handles.rgb(COLOURS["table"][:3]),
            dimensions=tuple(2 * np.array(TABLE[1])),
            position=TABLE[0],
        )
        times = np.append(np.arange(0, self.trajectory.duration, 1 / RATE), self.trajectory.duration)
        path = np.array([self.gripper_at(time)[:3, 3] for time in times])
        self._shown = {TABLE_NAME: top, PATH: handles.add_path(self.server, "/path", path, INK)}
        corners = np.array(TABLE[0]) + np.array(TABLE[1]) * [[-1, -1, 1], [1, 1, 1]]
        handles.look(self.server, np.concatenate([path, corners, np.zeros((1, 3))]))

    def _panel(self) -> None:
        gui, trajectory = self.server.gui, self.trajectory
        phases = f", {len(trajectory.segments)} phases" if trajectory.segments else ""
        gui.add_markdown(f"{trajectory.duration:.2f} s, {trajectory.num_samples} samples{phases}")
        with gui.add_folder("Time"):
            last = np.ceil(RATE * trajectory.duration) / RATE
            self.player = Player(gui, "seconds", last, 1 / RATE, 0.0, SPEEDS["real time"], self._show_time)
            speed = gui.add_dropdown("speed", tuple(SPEEDS), initial_value="real time")
            self.state = gui.add_markdown("")
        speed.on_update(lambda event: self._set_speed(event.target.value))
        with gui.add_folder("Show"):
            for name, node in self._shown.items():
                box = gui.add_checkbox(name, True)
                box.on_update(lambda event, node=node: setattr(node, "visible", event.target.value))

    def _set_speed(self, name: str) -> None:
        self.player.stop()
        self.player.speed = SPEEDS[name]

    def _show_time(self) -> None:
        with self.player.lock, self.server.atomic():
            trajectory = self.trajectory
            time = min(self.player.value, trajectory.duration)
            T = self.gripper_at(time)
            for name, node in self.bodies.items():
                body = self._data.body(name)
                handles.place(node, body.xquat, body.xpos)
            sample = int(np.searchsorted(trajectory.times, time + 1e-9, side="right")) - 1
            phase = next((name for name, first in reversed(trajectory.segments) if first <= sample), "")
            x, y, z = 100 * T[:3, 3]
            opening = 100 * float(trajectory.at(time)[1])
            self.state.content = (
                f"{time:.2f} s{': ' * bool(phase)}{phase}  \n"
                f"gripper x {x:.1f}, y {y:.1f}, z {z:.1f} cm, opening {opening:.1f} cm"
            )
