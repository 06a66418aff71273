"""A demonstration by hand: a box of query points is dragged along key poses. Nobody needs teleoperation for it."""

import dataclasses
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from tdf_jax._internal import checks
from tdf_jax._internal.errors import InputError
from tdf_jax.geometry import se3
from tdf_jax.geometry.demonstration import Demonstration
from tdf_jax.geometry.query import box_query
from tdf_jax.geometry.trajectory import Trajectory
from tdf_jax.io.demonstrations import check_frames, save_demonstration
from tdf_jax.viewer import handles, solving
from tdf_jax.viewer.stage import GRIP, REACH
from tdf_jax.viz.style import COLOURS, INK

QUERIES, NUM_POSES = 128, 20  # query points, and poses from the grasp to the release
EDGES = 0.06  # metres, of the first box
LEAST_EDGE, MOST_EDGE = 0.5, 30.0  # centimetres that the panel accepts


@dataclasses.dataclass(frozen=True, eq=False)
class Draft:
    """Key poses of a demonstration that is not finished.

    Attributes:
        poses: key poses T_world_query in the order of the motion, (poses, 7), metres.
        grasp: index of the pose at which the object is grasped; None if it is not yet.
        release: index of the pose at which it is released; None if it is not yet.
    """

    poses: Float[np.ndarray, "poses 7"] = dataclasses.field(default_factory=lambda: np.zeros((0, 7)))
    grasp: int | None = None
    release: int | None = None


def added(draft: Draft, pose: Float[np.ndarray, "7"], mark: str | None = None) -> Draft:
    """The draft with one more key pose.

    Args:
        draft: the draft.
        pose: the pose, T_world_query, `wxyz_xyz`, (7,).
        mark: "grasp" or "release" to grasp or release the object there; None for neither.

    Raises:
        InputError: the object is grasped or released a second time, or released before it is grasped.
    """
    if mark == "grasp" and draft.grasp is not None:
        raise InputError(f"The object is grasped at pose {draft.grasp + 1} already: undo back to there, or go on.")
    if mark == "release" and draft.grasp is None:
        raise InputError("The object is not grasped yet: drag the box to it, and press Grasp here.")
    if mark == "release" and draft.release is not None:
        raise InputError(f"The object is released at pose {draft.release + 1} already: undo back to there, or save.")
    poses = np.concatenate([draft.poses, np.asarray(pose, float)[None]])
    return dataclasses.replace(draft, poses=poses, **({mark: len(draft.poses)} if mark else {}))


def undone(draft: Draft) -> Draft:
    """The draft without its last key pose; the same if there is none."""
    last = len(draft.poses) - 1
    marks = {name: None for name in ("grasp", "release") if getattr(draft, name) == last}
    return dataclasses.replace(draft, poses=draft.poses[: max(0, last)], **marks)


def demonstration_of(
    draft: Draft,
    points: Float[np.ndarray, "points 3"],
    edges: Float[np.ndarray, "3"],
    num_poses: int = NUM_POSES,
    seed: int = 0,
) -> Demonstration:
    """The demonstration of a finished draft: straight between its key poses, with rotations along SO(3) geodesics.

    Args:
        draft: the draft.
        points: cloud of the object before the grasp, (points, 3), metres, world frame.
        edges: edges of the box of query points, (3,), metres.
        num_poses: number of poses from the grasp to the release.
        seed: seed of the query points.

    Raises:
        InputError: the object is not grasped and released, or the box is not at the object at the grasp.
    """
    if draft.grasp is None or draft.release is None:
        missing = " and ".join(name for name in ("grasp", "release") if getattr(draft, name) is None)
        raise InputError(f"The demonstration has no {missing} yet: mark both, then save.")
    query = np.asarray(box_query(jax.random.key(seed), QUERIES, tuple(map(float, edges))))
    trajectory = Trajectory(jnp.asarray(draft.poses, jnp.float32))
    cloud = np.asarray(points, np.float32)
    check_frames("tdf view", cloud, trajectory, query, draft.grasp)
    return Demonstration(cloud, trajectory, query, draft.grasp, draft.release).resampled(num_poses)


class DemonstrationStage:
    """A cloud on the screen, on which a demonstration is made by hand.

    Args:
        server: the `viser.ViserServer`.
        points: cloud of the object, (points, 3), metres, world frame.
        path: .npz file that the demonstration is saved to.
        mesh: mesh of the object; None if there is none.
    """

    def __init__(self, server: Any, points: Float[np.ndarray, "points 3"], path: Path, mesh: Any | None = None):
        self.server, self.points, self.path = server, np.asarray(points, float), path
        self.draft, self.saved = Draft(), 0
        self._edges = np.full(3, EDGES)
        size = float(np.linalg.norm(np.ptp(self.points, axis=0)))
        middle = self.points.mean(axis=0)
        self._object = server.scene.add_frame("/object", show_axes=False)
        if handles.add_mesh(server, "/object/mesh", mesh) is None:
            handles.add_cloud(server, "/object/cloud", self.points, COLOURS(0.0))
        self._grip = server.scene.add_transform_controls(
            "/box", scale=GRIP * size, line_width=3.0, depth_test=False, position=middle
        )
        self._box = handles.add_box(server, "/box/edges", self._corners(), COLOURS(0.35), 1.6 * handles.LINE)
        self._path = handles.add_path(server, "/path", middle[None], INK)
        self._path.visible = False
        self._keys: list[Any] = []
        self._grip.on_update(lambda _: self._follow())
        room = np.concatenate([self.points, self.points + [0, 0, 1.2 * size], self.points + [0, 2 * size, 0]])
        handles.look(server, room)
        self._panel()

    def _panel(self) -> None:
        gui = self.server.gui
        gui.set_panel_label("tdf view: demonstrate")
        gui.add_markdown(
            "1. Drag the box to the part that the gripper touches, or click a point of the object.\n"
            "2. **Grasp here**; from then on the object moves with the box.\n"
            "3. Drag on, and **Add pose** where the path bends.\n"
            "4. **Release here**, then **Save**."
        )
        self._status = gui.add_markdown("")
        edges = tuple(100 * self._edges)
        low, high = (LEAST_EDGE,) * 3, (MOST_EDGE,) * 3
        size = gui.add_vector3("box (cm)", edges, min=low, max=high, step=0.5)
        size.on_update(lambda event: self._resize(np.asarray(event.target.value) / 100))
        for label, act in (
            ("Grasp here", lambda: added(self.draft, self.pose, "grasp")),
            ("Add pose", lambda: added(self.draft, self.pose)),
            ("Release here", lambda: added(self.draft, self.pose, "release")),
            ("Undo", lambda: undone(self.draft)),
        ):
            gui.add_button(label).on_click(lambda _, act=act: self.change(act))
        gui.add_button("Save").on_click(lambda _: self.save())
        self.server.scene.on_click()(self._clicked)
        self._show()

    @property
    def pose(self) -> Float[np.ndarray, "7"]:
        """Pose of the box, T_world_query, `wxyz_xyz`, (7,), metres."""
        return np.concatenate([self._grip.wxyz, self._grip.position])

    def change(self, act) -> None:
        """Replace the draft by what a function returns, or say why it cannot be."""
        try:
            self.draft = act()
        except InputError as error:
            self._status.content = f"**{error}**"
            return
        self._show()

    def save(self) -> None:
        """Write the demonstration, or say what is missing."""
        try:
            demonstration = demonstration_of(self.draft, self.points, self._edges)
            save_demonstration(self.path, demonstration)
        except InputError as error:
            self._status.content = f"**{error}**"
            return
        self.saved += 1
        self._status.content = (
            f"**Saved {self.path}.** Imitate it: `tdf imitate --demonstration {self.path} --target NEW_OBJECT`, with "
            "`--category` if the object is no mug, or `--weights` of your own"
        )

    def _corners(self) -> np.ndarray:
        return np.stack([-self._edges / 2, self._edges / 2])

    def _resize(self, edges: np.ndarray) -> None:
        self._edges = edges
        self._box = handles.add_box(self.server, "/box/edges", self._corners(), COLOURS(0.35), 1.6 * handles.LINE)
        self._show()

    def _follow(self) -> None:
        """Carry the object with the box between the grasp and the release."""
        motion = solving.IDENTITY
        if self.draft.grasp is not None:
            held = self.pose if self.draft.release is None else self.draft.poses[self.draft.release]
            motion = np.asarray(
                se3.compose(jnp.asarray(held), se3.inverse(jnp.asarray(self.draft.poses[self.draft.grasp])))
            )
        handles.place(self._object, motion[:4], motion[4:])

    def _clicked(self, event: Any) -> None:
        if self.draft.grasp is not None:  # the object may be elsewhere
            return
        point = solving.point_under(self.points, np.array(event.ray_origin), np.array(event.ray_direction), REACH)
        if point is not None:
            self._grip.position = point

    def _show(self) -> None:
        draft = self.draft
        for node in self._keys:
            node.remove()
        self._keys = []
        for index, pose in enumerate(draft.poses):
            node = handles.add_box(
                self.server, f"/key/{index}", self._corners(), COLOURS(index / len(draft.poses)), 0.6 * handles.LINE
            )
            handles.place(node, pose[:4], pose[4:])
            self._keys.append(node)
        self._path.visible = len(draft.poses) > 0
        if len(draft.poses):
            self._path.points = handles.path_segments(draft.poses[:, 4:]).astype(np.float32)
        words = {draft.grasp: " grasp", draft.release: " release"}
        rows = [
            f"{index + 1}:{words.get(index, '')} x {100 * x:.1f}, y {100 * y:.1f}, z {100 * z:.1f} cm"
            for index, (x, y, z) in enumerate(draft.poses[:, 4:])
        ]
        self._status.content = "  \n".join(rows) if rows else "No pose yet."
        self._follow()


def check_demonstration_path(function: str, path: Path) -> None:
    """Refuse a name of a demonstration at once, not after it was made.

    Args:
        function: name that the error message begins with.
        path: the file.

    Raises:
        InputError: the suffix is not .npz, there is no such folder, or the file exists.
    """
    if checks.path(function, path).suffix != ".npz" or path.is_dir() or not path.parent.is_dir():
        raise InputError(f"{function}: --demonstrate is {path}; expected a new .npz file in an existing folder")
    if path.exists():
        raise InputError(f"{function}: --demonstrate is {path}, which exists; expected a new file: another name")
