"""An imitation on the screen: what is shown, what the panel says, and what the mouse does."""

import threading
import time
from typing import Any

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from tdf_jax._internal.errors import InputError
from tdf_jax.landscape.storage import Landscape
from tdf_jax.viewer import handles, solving
from tdf_jax.viewer.energies import show_landscape
from tdf_jax.viewer.player import Player
from tdf_jax.viewer.solving import Problem, Solution
from tdf_jax.viewer.worker import Worker
from tdf_jax.viz.imitation_page import above
from tdf_jax.viz.motion import motion_of
from tdf_jax.viz.scene3d import shown_boxes
from tdf_jax.viz.style import CLOUD, COLOURS, CONTACT, ESTIMATE, INK, MARKED, TRUTH, VIEW

STEP = 0.1  # of the time slider, poses
POSES_A_SECOND = 2.0
BESIDE, OVER, HIDDEN = "beside", "over it", "hidden"
BOX, SURFACE, PROBE = COLOURS(0.35), ESTIMATE, MARKED
REACH = 0.006  # metres from the ray of a click within which a point is hit
SHOWN_MODES = 12
SURFACE_NAME, CONTACT_NAME, OTHERS = "reconstructed surface", "contact regions", "other picks"
PAINTING = 2.0  # seconds from a browser's connection to when it has painted
PLANE = 0.6  # opacity of a landscape's plane: the object and the path are behind it
GRIP = 0.5  # length of the arrows at the object, in its diagonal


class Stage:
    """An imitation on the screen.

    Args:
        server: the `viser.ViserServer`.
        problem: the imitation, ready to be solved again.
        landscape: energies to show with it; None if there are none.
    """

    def __init__(self, server: Any, problem: Problem, landscape: Landscape | None = None):
        self.server, self.problem = server, problem
        self.solution = solving.chosen(problem, 0)
        self.worker = Worker(self._say)
        self._centroid = np.asarray(problem.points, float).mean(axis=0)
        self._swept = np.zeros((0, 3)) if landscape is None else landscape.grid.points.reshape(-1, 3)
        self._draw()
        self._panel(landscape)
        self._show(self.solution)
        self._waiting: threading.Timer | None = None
        server.on_client_connect(lambda _: self._seen())

    def prepare(self) -> None:
        """Compile what a drag needs, so that the first answers as fast as the others."""
        self.worker.ask("prepare", self._prepare)

    def _seen(self) -> None:
        """Prepare once the first browser has painted: compilation would take the processor from it."""
        with self.player.lock:
            if self._waiting is None:
                self._waiting = threading.Timer(PAINTING, self.prepare)
                self._waiting.daemon = True
                self._waiting.start()

    def close(self) -> None:
        """Stop what runs beside the server."""
        if self._waiting is not None:
            self._waiting.cancel()
        self.player.stop()
        self.worker.close()

    # What is drawn

    def _draw(self) -> None:
        scene, server = self.problem.scene, self.server
        demonstration = scene.demonstration
        self._object = server.scene.add_frame("/imitation/object", show_axes=False)
        self._nodes = {
            "cloud": [handles.add_cloud(server, "/imitation/object/cloud", scene.points, COLOURS(0.0))],
            "mesh": [handles.add_mesh(server, "/imitation/object/mesh", scene.meshes[1])],
        }
        self._path = handles.add_path(server, "/imitation/path", self.solution.path[:, 4:], INK)
        self._box = handles.add_box(server, "/imitation/box", demonstration.query, BOX, 1.6 * handles.LINE)
        self._boxes: list[Any] = []
        self._boxed = np.zeros(0, int)  # poses that have a box
        self._picks: list[Any] = []
        self._visible: dict[str, bool] = {}  # what is switched, by its name
        self._fit(len(self.solution.path))
        self._draw_picks()
        if scene.expected is not None:
            truth = np.asarray(scene.expected.wxyz_xyz)
            name = "/imitation/object/truth"  # it is a place on the object, and moves with it
            box = handles.add_box(server, name, demonstration.query, TRUTH, 0.7 * handles.LINE)
            handles.place(box, *np.split(truth[scene.result.grasp], [4]))
            self._nodes["true pick"] = [box]
        target = scene.target_points
        if target is None and demonstration.target is not None:
            target = demonstration.target.points
        if target is not None:
            self._nodes["target"] = [handles.add_cloud(server, "/imitation/target", np.asarray(target), CLOUD)]
        self._contact = None
        if demonstration.target is not None and self.problem.placed:
            self._contact = handles.add_box(server, "/imitation/contact", demonstration.target.query, CONTACT)
            self._nodes[CONTACT_NAME] = [self._contact]
        self._draw_demonstration()
        # It is a place on the object, and moves with it.
        self._probe = handles.add_box(server, "/imitation/object/probe", demonstration.query, PROBE)
        self._probe.visible = False
        self._grip = server.scene.add_transform_controls(
            "/imitation/drag_object", scale=GRIP * self._size(), line_width=3.0, depth_test=False
        )
        self._grip.position = self._centroid
        self._goal = server.scene.add_transform_controls(
            "/imitation/drag_goal", scale=0.7 * GRIP * self._size(), line_width=3.0, depth_test=False
        )
        self._grip.on_update(lambda event: self._drag_object(event.target))
        self._goal.on_update(lambda event: self._drag_goal(event.target))
        self._look()

    def _fit(self, poses: int) -> None:
        """Have the boxes of a path with that many poses; of a long one some, which hide less."""
        if self._boxed.size and self._boxed[-1] == poses - 1:
            return
        self._boxed = shown_boxes(poses)
        visible = all(node.visible for node in self._boxes)
        for node in self._boxes:
            node.remove()
        query = self.problem.scene.demonstration.query
        self._boxes = [
            handles.add_box(
                self.server, f"/imitation/boxes/{i}", query, COLOURS(i / max(1, poses - 1)), 0.5 * handles.LINE
            )
            for i in self._boxed
        ]
        for node in self._boxes:
            node.visible = visible
        self._nodes["boxes along the path"] = list(self._boxes)

    def _draw_picks(self) -> None:
        modes = self.problem.modes[:SHOWN_MODES]
        low, high = modes[0].energy, modes[-1].energy
        for number, mode in enumerate(modes):
            colour = tuple(part / 255 for part in handles.energy_colour(mode.energy, low, high))
            query = self.problem.scene.demonstration.query
            node = handles.add_box(self.server, f"/imitation/object/picks/{number}", query, colour, 0.7 * handles.LINE)
            handles.place(node, mode.pose[:4], mode.pose[4:])
            self._picks.append(node)
        self._part_picks(0)

    def _part_picks(self, number: int) -> None:
        """Show all picks as others but one, whose box moves along the path."""
        visible = self._visible.get(OTHERS, True)
        self._nodes[OTHERS] = [node for index, node in enumerate(self._picks) if index != number]
        self._picks[number].visible = False
        self._set_visible(OTHERS, visible)

    def _draw_demonstration(self) -> None:
        scene, server = self.problem.scene, self.server
        demonstration = scene.demonstration
        self._demonstrated = server.scene.add_frame("/demonstration", show_axes=False)
        self._demonstrated_object = server.scene.add_frame("/demonstration/object", show_axes=False)
        cloud = handles.add_cloud(server, "/demonstration/object/cloud", np.asarray(demonstration.points), CLOUD)
        self._nodes["cloud"].append(cloud)
        self._nodes["mesh"].append(handles.add_mesh(server, "/demonstration/object/mesh", scene.meshes[0]))
        handles.add_path(server, "/demonstration/path", np.asarray(demonstration.trajectory.translations), CLOUD)
        self._demonstrated_box = handles.add_box(server, "/demonstration/box", demonstration.query, BOX, handles.LINE)
        if demonstration.target is not None:
            node = handles.add_cloud(server, "/demonstration/target", np.asarray(demonstration.target.points), CLOUD)
            self._nodes["target"].append(node)
            if self._contact is not None:
                box = handles.add_box(server, "/demonstration/contact", demonstration.target.query, CONTACT)
                handles.place(box, *np.split(np.asarray(demonstration.target.T_world_contact, float), [4]))
                self._nodes[CONTACT_NAME].append(box)
        points = np.asarray(demonstration.points, float)
        below = np.array([*points.mean(axis=0)[:2], points[:, 2].min() - 0.02])
        server.scene.add_label("/demonstration/name", "demonstration", position=below)

    def _size(self) -> float:
        return float(np.linalg.norm(np.ptp(self.problem.points, axis=0)))

    def _contents(self) -> np.ndarray:
        return np.concatenate([self.problem.points, self.solution.path[:, 4:]])

    def _look(self) -> None:
        """Place the demonstration to the left of the imitation, and the camera before both."""
        azimuth = np.radians(VIEW["azim"])
        right = np.array([-np.sin(azimuth), np.cos(azimuth), 0.0])
        demonstration = self.problem.scene.demonstration
        shown = np.concatenate([np.asarray(demonstration.points), np.asarray(demonstration.trajectory.translations)])
        contents = self._contents()
        gap = 0.3 * self._size()
        self._beside = right * ((contents @ right).min() - (shown @ right).max() - gap)
        self._beside = self._beside + [0, 0, contents[:, 2].min() - shown[:, 2].min()]
        handles.look(self.server, np.concatenate([contents, shown + self._beside, self._swept]))

    def _add_surface(self) -> None:
        try:
            triangles = solving.reconstructed(self.problem)
        except InputError as error:  # libigl is an extra
            self._say(str(error))
            return
        if not len(triangles):
            self._say("No point is inside: the surface is empty.")
            return
        node = handles.add_triangles(self.server, "/imitation/object/surface", triangles, SURFACE, 0.85)
        node.visible = self._surface_box.value
        self._nodes[SURFACE_NAME] = [node]

    def _prepare(self) -> None:
        last = self.solution
        solving.dragged(self.problem, last.motion, last)
        solving.with_goal(self.problem, last.goal, last)
        self.problem.energy_in_place(last.pick_in_place)
        self._say("Ready: drag the object or its goal.")

    # The panel

    def _panel(self, landscape: Landscape | None) -> None:
        gui, result = self.server.gui, self.problem.scene.result
        self._summary = gui.add_markdown("")
        self._status = gui.add_markdown("Preparing the solver ...")
        with gui.add_folder("Time"):
            last = len(self.solution.path) - 1
            self.player = Player(gui, "pose", last, STEP, result.grasp, POSES_A_SECOND, self._show_time)
        with gui.add_folder("Picks"):
            modes = self.problem.modes[:SHOWN_MODES]
            energies = self.problem.pick_energies[: len(modes)]
            names = [f"{number}: energy {energy:.5f}" for number, energy in enumerate(energies, 1)]
            self._choice = gui.add_dropdown("shown", names, initial_value=names[0])
            gui.add_markdown(_table(self.problem))
        self._choice.on_update(lambda event: self._choose(names.index(event.target.value)))
        with gui.add_folder("Move"):
            self._move_object = gui.add_checkbox("object", True, hint="Drag its arrows, arcs or squares")
            self._move_goal = gui.add_checkbox("goal", True, hint="The path follows while you drag")
            self._reset = gui.add_button("Back to the result")
            self._click = gui.add_checkbox("click a point: energy there", False)
            self._energy = gui.add_markdown("")
        self._move_object.on_update(lambda event: setattr(self._grip, "visible", event.target.value))
        self._move_goal.on_update(lambda event: setattr(self._goal, "visible", event.target.value))
        self._reset.on_click(lambda _: self._choose(names.index(self._choice.value)))
        self._click.on_update(lambda event: setattr(self._probe, "visible", False))
        self.server.scene.on_click()(self._clicked)
        with gui.add_folder("Show"):
            for name, nodes in self._nodes.items():
                if any(node is not None for node in nodes):
                    self._add_switch(name, name != "cloud" or not any(self._nodes["mesh"]))
            self._surface_box = gui.add_checkbox(SURFACE_NAME, False, hint="It takes some seconds the first time")
            self._surface_box.on_update(lambda event: self._show_surface(event.target.value))
            where = gui.add_dropdown("demonstration", (BESIDE, OVER, HIDDEN), initial_value=BESIDE)
        where.on_update(lambda event: self._put_demonstration(event.target.value))
        self._put_demonstration(BESIDE)
        if landscape is not None:
            show_landscape(self.server, landscape, PLANE)

    def _add_switch(self, name: str, value: bool) -> None:
        switch = self.server.gui.add_checkbox(name, value)
        self._set_visible(name, value)
        switch.on_update(lambda event: self._set_visible(name, event.target.value))

    def _set_visible(self, name: str, value: bool) -> None:
        self._visible[name] = value
        for node in self._nodes.get(name, ()):
            if node is not None:
                node.visible = value

    def _show_surface(self, value: bool) -> None:
        if value and SURFACE_NAME not in self._nodes:
            self.worker.ask("surface", self._add_surface)
        self._set_visible(SURFACE_NAME, value)

    def _put_demonstration(self, where: str) -> None:
        self._demonstrated.visible = where != HIDDEN
        self._demonstrated.position = self._beside if where == BESIDE else np.zeros(3)

    def _say(self, text: str) -> None:
        self._status.content = text

    # What the mouse does

    def _drag_object(self, grip: Any) -> None:
        R = Rotation.from_quat(np.asarray(grip.wxyz), scalar_first=True).as_matrix()
        motion = np.concatenate([grip.wxyz, np.asarray(grip.position) - R @ self._centroid])
        with self.player.lock:
            self.player.stop()
            # Later the object is held, and not at its handle.
            self.player.value = self.problem.scene.result.grasp
            handles.place(self._object, motion[:4], motion[4:])
        self.worker.ask("solve", lambda: self._solve(motion))

    def _solve(self, motion: Float[np.ndarray, "7"]) -> None:
        began = time.perf_counter()
        solution = solving.dragged(self.problem, motion, self.solution)
        self._show(solution)
        encoding, search = solution.seconds or (0.0, 0.0)
        how = "" if solution.tracked else " The pick was lost, and is found by a search from many starts."
        seconds = time.perf_counter() - began
        self._say(f"Solved in {seconds:.2f} s: encoding {encoding:.2f} s, search {search:.2f} s.{how}")

    def _drag_goal(self, grip: Any) -> None:
        goal = np.concatenate([grip.wxyz, grip.position])

        def move():
            began = time.perf_counter()
            self._show(solving.with_goal(self.problem, goal, self.solution), goal=False)
            self._say(f"The path follows the goal, in {time.perf_counter() - began:.3f} s.")

        self.worker.ask("goal", move)

    def _choose(self, number: int) -> None:
        self.player.stop()
        self._grip.wxyz, self._grip.position = np.array([1.0, 0, 0, 0]), self._centroid
        self.player.value = self.problem.scene.result.grasp

        def choose():
            self._show(solving.chosen(self.problem, number))
            with self.server.atomic():
                self._part_picks(number)
            self._say(f"Pick {number + 1} of the folder.")

        self.worker.ask("choose", choose)

    def _clicked(self, event: Any) -> None:
        if not self._click.value:
            return
        # In the object's initial pose: the object may be dragged away, and held.
        R = Rotation.from_quat(np.asarray(self._object.wxyz), scalar_first=True).inv()
        origin = R.apply(np.asarray(event.ray_origin) - np.asarray(self._object.position))
        point = solving.point_under(self.problem.points, origin, R.apply(event.ray_direction), REACH)
        if point is None:
            self._energy.content = "No point of the object's cloud is there."
            return
        self.worker.ask("probe", lambda: self._show_energy(point))

    def _show_energy(self, point: Float[np.ndarray, "3"]) -> None:
        """Place the box of query points with its middle at a point, in the orientation of the pick.

        Args:
            point: a point of the object in its initial pose, (3,), metres.
        """
        pick = self.solution.pick_in_place
        R = Rotation.from_quat(pick[:4], scalar_first=True).as_matrix()
        middle = np.asarray(self.problem.reference.query, float).mean(axis=0)
        pose = np.concatenate([pick[:4], point - R @ middle])
        energy = self.problem.energy_in_place(pose)
        handles.place(self._probe, pose[:4], pose[4:])
        self._probe.visible = True
        away = np.linalg.norm(pose[4:] - pick[4:])
        times = f", {energy / self.solution.energy:.1f} times that of the pick" if self.solution.energy > 0 else ""
        self._energy.content = (
            f"Energy **{energy:.4f}** there{times}: {100 * away:.1f} cm from the pick, in its orientation."
        )

    # What changes

    def _show(self, solution: Solution, goal: bool = True) -> None:
        with self.player.lock, self.server.atomic():
            self.solution = solution
            self._path.points = handles.path_segments(solution.path[:, 4:]).astype(np.float32)
            self._fit(len(solution.path))
            self.player.extend(len(solution.path) - 1)
            for node, pose in zip(self._boxes, solution.path[self._boxed], strict=True):
                handles.place(node, pose[:4], pose[4:])
            if goal:
                handles.place(self._goal, solution.goal[:4], solution.goal[4:])
            contact = solving.contact_of(self.problem, solution)
            if self._contact is not None and contact is not None:
                handles.place(self._contact, contact[:4], contact[4:])
            self._summary.content = _words(solution)
            self._show_time()

    def _show_time(self) -> None:
        result, demonstration = self.problem.scene.result, self.problem.scene.demonstration
        index = np.array([min(self.player.value, len(self.solution.path) - 1.0)])
        with self.player.lock, self.server.atomic():
            motion = motion_of(self.solution.path, result.grasp, result.release, index)
            self._put(self._box, motion.rotations[0], motion.translations[0])
            R = Rotation.from_quat(self.solution.motion[:4], scalar_first=True).as_matrix()
            held = motion.object_rotations[0]
            self._put(self._object, held @ R, held @ self.solution.motion[4:] + motion.object_translations[0])
            shown = np.asarray(demonstration.trajectory.wxyz_xyz)
            share = index * (len(shown) - 1) / max(1, len(self.solution.path) - 1)
            motion = motion_of(shown, demonstration.grasp, demonstration.release, share)
            self._put(self._demonstrated_box, motion.rotations[0], motion.translations[0])
            self._put(self._demonstrated_object, motion.object_rotations[0], motion.object_translations[0])

    def _put(self, node: Any, R: np.ndarray, t: np.ndarray) -> None:
        handles.place(node, Rotation.from_matrix(R).as_quat(scalar_first=True), t)


def _words(solution: Solution) -> str:
    """The pick in a few lines."""
    x, y, z = 100 * np.asarray(solution.pick[4:], float)
    lines = [f"**Pick** x {x:.1f}, y {y:.1f}, z {z:.1f} cm", f"**Energy** {solution.energy:.5f}"]
    if np.isfinite(solution.confidence):
        lines.append(f"**Confidence** {solution.confidence:.2f} that it is right to 2 cm and 20°")
    return "  \n".join(lines)


def _table(problem: Problem) -> str:
    """The distinct picks by rising energy: of the pick alone; with a target, by the sum with the contact regions'."""
    modes = problem.modes
    names = ["pick", "energy", "above the best"]
    if problem.placed:  # the order and the percentages are of the sums
        names = ["pick", "energy of the pick", "of pick and contact", "the latter above the best"]
    rows = [f"| {' | '.join(names)} |", "|---" * len(names) + "|"]
    for number, (mode, energy) in enumerate(zip(modes[:SHOWN_MODES], problem.pick_energies), 1):
        both = [f"{mode.energy:.5f}"] * problem.placed
        behind = "" if number == 1 else above(mode, modes[0]).split(" above")[0]
        rows.append(f"| {' | '.join([str(number), f'{energy:.5f}', *both, behind])} |")
    listed = f" (the first {SHOWN_MODES} are listed)" if len(modes) > SHOWN_MODES else ""
    candidates = len(problem.scene.result.energies)
    words = f"{len(modes)} distinct of {candidates} candidate{'s' * (candidates != 1)}{listed}"
    words += "; dark boxes have low energies." if len(modes) > 1 else ": there is no second-best pick."
    return "\n".join([*rows, "", words])
