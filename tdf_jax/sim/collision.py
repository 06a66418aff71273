"""What touches what in a cell at planned positions: arm, hand, object, target, table; what a plan may touch."""

import dataclasses
import functools
from collections.abc import Callable, Iterable
from typing import Any

import numpy as np
from jaxtyping import Float

from tdf_jax.sim.gripper_path import GripperPath
from tdf_jax.sim.kinematics import Kinematics
from tdf_jax.sim.physics import extra
from tdf_jax.sim.robot import PREFIX
from tdf_jax.sim.workcell import OBJECT, TABLE_NAME, TARGET, Workcell

ARM, HAND_KIND, OBJECT_KIND, TARGET_KIND, TABLE_KIND, OTHER = range(6)
NAMES = ("arm", "hand", "object", "target", "table", "surroundings")
DEPTH = 0.0005  # metres of penetration that count as contact
# Penetrations that a plan may have, metres. Clouds and fields know surfaces to a millimetre or two.
TOUCHING = 0.002
ITSELF = 0.0  # of the robot with itself, whose shape is known: with an overlap of 1 mm the arm got stuck at its wrist
RESTING = 0.006  # of the object and what it stands on or is placed on, near both ends
ENDS = 0.08  # metres from an end in which the object may touch its support or the target


@dataclasses.dataclass(frozen=True, eq=False)
class Collisions:
    """Finds collisions of planned positions in a cell, in a state of its own.

    Attributes:
        cell: the cell, with the arm.
    """

    cell: Workcell

    @functools.cached_property
    def _data(self) -> Any:
        return self.cell.data()

    @functools.cached_property
    def _start(self) -> np.ndarray:
        return self._data.qpos.copy()

    @functools.cached_property
    def _kinds(self) -> np.ndarray:
        return geom_kinds(self.cell)

    @functools.cached_property
    def T_world_object(self) -> Float[np.ndarray, "4 4"] | None:
        """Pose of the object where it starts, 4x4; None if there is none."""
        names = [self.cell.model.body(number).name for number in range(self.cell.model.nbody)]
        return self.cell.body_pose(self.cell.data(), OBJECT) if OBJECT in names else None

    def depths(
        self,
        joints: Float[np.ndarray, " joints"],
        opening: float,
        T_world_object: Float[np.ndarray, "4 4"] | None = None,
        T_world_target: Float[np.ndarray, "4 4"] | None = None,
    ) -> dict[tuple[str, str], float]:
        """Penetrations of the pairs that touch, metres, by the names of the two, in the order of `NAMES`.

        Args:
            joints: positions of the arm's joints, (joints,), radians.
            opening: opening of the fingers, metres.
            T_world_object: pose of the object, 4x4; where it starts by default.
            T_world_target: pose of the target, 4x4, if it is free; where it starts by default.
        """
        mujoco = extra("plan_joints()", "mujoco")
        cell, data = self.cell, self._data
        data.qpos[:] = self._start
        data.qpos[cell.arm] = joints
        cell.open_fingers(data, opening)
        if T_world_object is not None:
            cell.set_body_pose(data, OBJECT, T_world_object)
        if T_world_target is not None and not cell.fixed_target:
            cell.set_body_pose(data, TARGET, T_world_target)
        mujoco.mj_kinematics(cell.model, data)
        mujoco.mj_collision(cell.model, data)
        found: dict[tuple[str, str], float] = {}
        if data.ncon:
            pairs = np.sort(self._kinds[data.contact.geom], axis=1)
            for (a, b), distance in zip(pairs, data.contact.dist):
                if -distance > DEPTH:
                    key = NAMES[a], NAMES[b]
                    found[key] = max(found.get(key, 0.0), -float(distance))
        return found


def first_collision(
    collisions: Collisions | None,
    path: GripperPath,
    joints: Float[np.ndarray, "rows joints"],
    rows: Iterable[int],
    opening: float,
) -> str | None:
    """The first collision that a plan may not have at some rows of a path, in words; None if there is none.

    Args:
        collisions: of the cell; None if there is nothing to stay clear of. The object is where it starts up to the
            pick, in the hand up to the release, and where it was released from then on.
        path: the path.
        joints: positions of the joints along it, (rows, joints), radians.
        rows: rows that are looked at, in order.
        opening: opening of the fingers, metres.
    """
    if collisions is None:
        return None
    T_object = collisions.T_world_object
    T_grip_object = path.in_hand(T_object)
    near = {*path.near_pick(ENDS), *path.near_release(ENDS)}
    for row in rows:
        held = path.pick < row <= path.release
        T = T_object
        if T_grip_object is not None and row > path.pick:
            T = path.poses[min(row, path.release)] @ T_grip_object
        where = "on the way to the pick" if row <= path.pick else ("along the path" if held else "on the retreat")
        for (a, b), depth in collisions.depths(joints[row], opening, T).items():
            pair = {a, b}
            if pair in ({"hand"}, {"target", "table"}):
                continue
            if "object" in pair and "hand" in pair and held:
                continue
            allowed = ITSELF if pair <= {"arm", "hand"} else TOUCHING
            if pair in ({"object", "table"}, {"object", "target"}):
                allowed = np.inf if not held else (RESTING if row in near else TOUCHING)
            if depth > allowed:
                return f"{a} and {b} collide {where} (by {1e3 * depth:.0f} mm)"
    return None


def free_positions(
    collisions: Collisions,
    opening: float,
    kinematics: Kinematics | None = None,
    T_object: Float[np.ndarray, "4 4"] | None = None,
) -> Callable[[Float[np.ndarray, " joints"]], bool]:
    """A function of positions of the joints, (joints,), radians: whether a free motion may pass there.

    Args:
        collisions: of the cell.
        opening: opening of the fingers, metres.
        kinematics: of the arm, if the object is in the hand.
        T_object: pose of the object, 4x4: in the gripper's frame if it is in the hand, else in the world's; None if
            there is none.
    """
    meets = (("object", "table"), ("object", "target")) if kinematics is None else (("hand", "object"),)
    passed = (*meets, ("hand", "hand"), ("target", "table"))

    def free(positions) -> bool:
        T = T_object if kinematics is None or T_object is None else kinematics.pose(positions) @ T_object
        depths = collisions.depths(positions, opening, T)
        return all(
            pair in passed or depth <= (ITSELF if set(pair) <= {"arm", "hand"} else TOUCHING)
            for pair, depth in depths.items()
        )

    return free


def geom_kinds(cell: Workcell) -> np.ndarray:
    """The kind of every geom of a cell, an index in `NAMES`: (geoms,)."""
    model, robot = cell.model, cell.robot
    last = -1
    if robot is not None and not cell.floating:
        last = int(model.jnt_bodyid[model.joint(PREFIX + robot.joints[-1]).id])
    kinds = np.full(model.ngeom, OTHER)
    for number in range(model.ngeom):
        body = int(model.geom_bodyid[number])
        name = model.body(body).name
        if name.startswith(PREFIX):
            kinds[number] = HAND_KIND if cell.floating or _carried(model, body, last) else ARM
        elif name in (OBJECT, TARGET):
            kinds[number] = OBJECT_KIND if name == OBJECT else TARGET_KIND
        elif model.geom(number).name == TABLE_NAME:
            kinds[number] = TABLE_KIND
    return kinds


def _carried(model, body: int, by: int) -> bool:
    """Whether a body is another one or hangs on it."""
    while body:
        if body == by:
            return True
        body = int(model.body_parentid[body])
    return False
