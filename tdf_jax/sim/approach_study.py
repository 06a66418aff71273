"""How many objects a gripper can approach: with the demonstrated grasp, open as demonstrated, along a straight line.

The object stands alone on the table. The hand floats, so that reach does not count, and what it meets by more than the
tolerance of the planner, the object or the table, is a collision. An object without a grasp counts as one too.

python -m tdf_jax.sim.approach_study --objects 100
"""

import sys
from collections.abc import Sequence

import numpy as np

from tdf_jax._internal.errors import InputError
from tdf_jax.evaluation.study_command import study_parser
from tdf_jax.evaluation.tables import markdown, success_rate
from tdf_jax.shapes import FAMILIES, Shape
from tdf_jax.sim.bodies import body_of
from tdf_jax.sim.collision import TOUCHING
from tdf_jax.sim.grasping import FloatingHand
from tdf_jax.sim.grasps import grip_of
from tdf_jax.sim.motion import APPROACH
from tdf_jax.sim.robot import PREFIX, Robot, load_robot
from tdf_jax.sim.workcell import Workcell, build_workcell

CATEGORIES = ("mug", "bowl", "bottle")
STEPS = 11  # poses of the hand along the approach, a centimetre apart


def approach_depth(shape: Shape, robot: Robot) -> float:
    """The deepest penetration of the open hand into the object and the table along the approach, metres.

    Args:
        shape: the object, upright.
        robot: the robot, of which the hand alone is in the cell.

    Raises:
        InputError: the object has no grasp for this gripper.
    """
    grip = grip_of(shape, robot.fingers)
    T_world_object = np.eye(4)
    T_world_object[2, 3] = -shape.mesh.bounds[0, 2]
    cell = build_workcell(robot, body_of(shape), T_world_object, floating=True, fixture=True)
    pick = T_world_object @ grip.T_object_grip
    deepest = 0.0
    for back in np.linspace(APPROACH, 0, STEPS):
        pose = pick.copy()
        pose[:3, 3] -= back * pick[:3, 2]
        deepest = max(deepest, _depth(cell, FloatingHand(cell, pose, grip.opening).data))
    return deepest


def _depth(cell: Workcell, data) -> float:
    """Deepest penetration of the hand into anything else, metres."""
    depth = 0.0
    for pair, distance in zip(data.contact.geom[: data.ncon], data.contact.dist[: data.ncon]):
        names = [cell.model.body(int(cell.model.geom_bodyid[geom])).name for geom in pair]
        if sum(name.startswith(PREFIX) for name in names) == 1:
            depth = max(depth, -float(distance))
    return depth


def main(arguments: Sequence[str] | None = None) -> None:
    """Approach generated objects of each category, and print the share that is reached without a collision.

    Args:
        arguments: words of the command line; by default those of the process.
    """
    parser = study_parser(
        "tdf_jax.sim.approach_study", __doc__, "objects", 100, "number of objects of each category", "the objects"
    )
    settings = parser.parse_args(arguments)
    rows = []
    try:
        robot = load_robot()
    except InputError as error:
        parser.error(str(error))
    for category in CATEGORIES:
        family, free = FAMILIES[category], []
        for number in range(settings.objects):
            shape = family.build(family.sample(np.random.default_rng([settings.seed, number])))
            try:
                depth = approach_depth(shape, robot)
                reason = f"the hand is {1e3 * depth:.1f} mm deep" if depth > TOUCHING else ""
            except InputError as error:
                reason = str(error)
            free.append(not reason)
            if reason:
                print(f"{category} {number}: {reason}", file=sys.stderr, flush=True)
        rows.append([category, str(len(free)), success_rate(free)])
    print(markdown(["category", "objects", "approached without a collision"], rows))


if __name__ == "__main__":
    main()
