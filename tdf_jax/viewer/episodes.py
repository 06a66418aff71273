"""A folder of simulated episodes on the screen: the robot, the object and the target, as they moved."""

from pathlib import Path
from typing import Any

import numpy as np

from tdf_jax._internal.errors import InputError
from tdf_jax.sim.playback import RATE, kept_episodes, load_playback
from tdf_jax.sim.playback_page import episode_page
from tdf_jax.sim.workcell import OBJECT, TABLE_NAME, TARGET
from tdf_jax.viewer import handles
from tdf_jax.viewer.player import SPEEDS, Player
from tdf_jax.viz.style import COLOURS, INK

ALL, SUCCESSES, FAILURES = "all", "successes", "failures"
PARTS = {OBJECT: "object", TARGET: "target", TABLE_NAME: "table"}  # every other body is a part of the robot
ROBOT, CLOUD, IMITATED = "robot", "cloud of the object", "imitated path of the gripper"


class EpisodeStage:
    """Episodes on the screen, one at a time.

    Args:
        server: the `viser.ViserServer`.
        folder: folder of `tdf simulate`, or the folder runs of `tdf benchmark --simulation`.
        first: number or file of the episode that is shown first; None for the first of all.

    Raises:
        InputError: the folder keeps no episode, or none of that number, or a file cannot be read.
    """

    def __init__(self, server: Any, folder: Path, first: int | Path | None = None):
        self.server = server
        self._episodes = kept_episodes("tdf view", folder)
        if not self._episodes:
            raise InputError(
                f"tdf view: {folder} keeps outcomes, but no episode to show; expected a folder that this version of "
                "`tdf simulate` wrote: run it again with another --out"
            )
        chosen = 0
        if first is not None:
            found = [
                place
                for place, (file, about) in enumerate(self._episodes)
                if (file.name == first.name if isinstance(first, Path) else about["number"] == first)
            ]
            if not found:
                kept = ", ".join(map(str, sorted({about["number"] for _, about in self._episodes})))
                raise InputError(f"tdf view: there is no episode {first} in {folder}; expected one of {kept}")
            chosen = found[0]
        self.playback = load_playback("tdf view", self._episodes[chosen][0])
        self._bodies: dict[str, Any] = {}
        self._nodes: list[Any] = []
        self._visible: dict[str, bool] = {}
        self._panel(chosen)
        self.show(chosen)

    def close(self) -> None:
        """Stop what runs beside the server."""
        self.player.stop()

    @property
    def frame(self) -> int:
        """Number of the frame that is shown."""
        return int(np.clip(np.searchsorted(self.playback.times, self.player.value + 1e-6) - 1, 0, self._last))

    @property
    def _last(self) -> int:
        return len(self.playback.times) - 1

    def show(self, number: int) -> None:
        """Show an episode from its beginning.

        Args:
            number: its place in the list.
        """
        self.player.stop()
        playback = load_playback("tdf view", self._episodes[number][0])
        with self.player.lock, self.server.atomic():
            self.playback = playback
            for node in self._nodes:
                node.remove()
            self._draw()
            self.player.extend(np.ceil(RATE * playback.times[-1]) / RATE)
            self.player.value = 0.0
            about = playback.about
            words = "**Success**" if not about["cause"] else f"**Failure: {about['cause']}**  \n{about['detail']}"
            moved = (
                ""
                if about["slip"] is None
                else f"  \nIn the hand it moved by {1e3 * about['slip']:.1f} mm and {about['turn']:.1f}°."
            )
            self._verdict.content = (
                f"{playback.title}: {about['clouds']} clouds, {about['method']}, target {about['target']}, starts "
                f"{about['poses']}  \n{words}{moved}"
            )
            self._show_time()

    def _draw(self) -> None:
        playback, scene = self.playback, self.server.scene
        self._bodies = {name: scene.add_frame(f"/episode/{name}", show_axes=False) for name in playback.bodies}
        self._nodes = list(self._bodies.values())
        for number, solid in enumerate(playback.solids):
            colour = handles.rgb(solid.colour)
            scene.add_mesh_simple(
                f"/episode/{solid.body}/{number}",
                solid.vertices,
                solid.faces,
                color=colour,
                side="double",
                flat_shading=solid.angular,
            )
        self._cloud = self._path = None
        if len(playback.points):
            self._cloud = handles.add_cloud(self.server, "/episode_cloud", playback.points, COLOURS(0.0))
            self._nodes.append(self._cloud)
        if len(playback.path):
            self._path = handles.add_path(self.server, "/episode_path", playback.path[:, 4:], INK)
            self._nodes.append(self._path)

    def _panel(self, chosen: int) -> None:
        gui = self.server.gui
        with gui.add_folder("Episodes"):
            kinds = gui.add_dropdown("which", (ALL, SUCCESSES, FAILURES), initial_value=ALL)
            names = self._names(ALL)
            self._choice = gui.add_dropdown("shown", tuple(names), initial_value=names[chosen])
            self._counts = gui.add_markdown(self._counted())
        kinds.on_update(lambda event: self._narrow(event.target.value))
        self._choice.on_update(lambda event: self.show(self._names(ALL).index(event.target.value)))
        self._verdict = gui.add_markdown("")
        with gui.add_folder("Time"):
            last = self.playback.times[-1]
            self.player = Player(gui, "seconds", last, 1 / RATE, 0.0, SPEEDS["real time"], self._show_time)
            speed = gui.add_dropdown("speed", tuple(SPEEDS), initial_value="real time")
            self._phase = gui.add_markdown("")
        speed.on_update(lambda event: self._set_speed(event.target.value))
        with gui.add_folder("Show"):
            for name in (ROBOT, *PARTS.values(), CLOUD, IMITATED):
                self._visible[name] = name != CLOUD
                gui.add_checkbox(name, self._visible[name]).on_update(
                    lambda event, name=name: self._switch(name, event.target.value)
                )
        gui.add_button("Save as a page").on_click(self._save)
        handles.look(self.server, self._contents())

    def _contents(self) -> np.ndarray:
        """What the camera looks at: the ways of all bodies, and the corners of the table."""
        playback = self.playback
        xyz = playback.wxyz_xyz[..., 4:].reshape(-1, 3)
        table = [one.vertices for one in playback.solids if one.body == TABLE_NAME]
        at = playback.wxyz_xyz[0, playback.bodies.index(TABLE_NAME), 4:]
        xyz = np.concatenate([xyz[np.isfinite(xyz).all(axis=1)], *(one + at for one in table)])
        return xyz[xyz[:, 2] > -0.2]  # an object may fall

    def _names(self, kind: str) -> list[str]:
        """The names of the episodes of a kind, which begin with their places in the list."""
        wanted = {ALL: (True, False), SUCCESSES: (True,), FAILURES: (False,)}[kind]
        return [
            f"{place + 1}: {about['cause'] or 'success'} ({about['task']} {about['number']}, {about['mode']})"
            for place, (_, about) in enumerate(self._episodes)
            if (not about["cause"]) in wanted
        ]

    def _counted(self) -> str:
        failed = [about["cause"] for _, about in self._episodes if about["cause"]]
        causes = ", ".join(f"{failed.count(cause)} {cause}" for cause in dict.fromkeys(failed))
        return f"{len(self._episodes)} episodes, {len(self._episodes) - len(failed)} successes" + (
            f"; failures: {causes}." if failed else "."
        )

    def _narrow(self, kind: str) -> None:
        names = self._names(kind)
        if not names:
            self._counts.content = f"{self._counted()} There are no {kind}."
            return
        self._counts.content = self._counted()
        self._choice.options = tuple(names)

    def _set_speed(self, name: str) -> None:
        self.player.stop()
        self.player.speed = SPEEDS[name]

    def _switch(self, name: str, value: bool) -> None:
        self._visible[name] = value
        self._show_time()

    def _show_time(self) -> None:
        with self.player.lock, self.server.atomic():
            playback, frame = self.playback, self.frame
            for name, pose in zip(playback.bodies, playback.wxyz_xyz[frame], strict=True):
                node, there = self._bodies[name], bool(np.isfinite(pose).all())
                node.visible = there and self._visible[PARTS.get(name, ROBOT)]
                if there:
                    handles.place(node, pose[:4], pose[4:])
            for node, name in ((self._cloud, CLOUD), (self._path, IMITATED)):
                if node is not None:
                    node.visible = self._visible[name]
            self._phase.content = f"{playback.times[frame]:.2f} s: {playback.phase(frame)}"

    def _save(self, event: Any) -> None:
        """Send the page of the episode to the browser that asks for it."""
        name = f"{self._episodes[self._names(ALL).index(self._choice.value)][0].stem}.html"
        try:
            page = episode_page("tdf view", self.playback)
        except InputError as error:  # plotly is an extra
            self._phase.content = str(error)
            return
        event.client.send_file_download(name, page.text.encode())
