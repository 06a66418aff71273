"""Free motions of an arm from one configuration to another: RRT-Connect of the Open Motion Planning Library (OMPL)."""

from collections.abc import Callable

import numpy as np
from jaxtyping import Float

from tdf_jax.sim.physics import extra

MAX_ITERATIONS = 4000  # of the planner, which has no limit of time, so that a rerun finds the same
RANGE = 0.5  # radians, longest branch of a tree
RESOLUTION = 0.03  # radians between tested positions, norm over all joints
SHORTCUTS = 60  # attempts to shorten a path


def connect(
    start: Float[np.ndarray, " joints"],
    goal: Float[np.ndarray, " joints"],
    lower: Float[np.ndarray, " joints"],
    upper: Float[np.ndarray, " joints"],
    free: Callable[[Float[np.ndarray, " joints"]], bool],
    seed: int,
    resolution: float = RESOLUTION,
) -> Float[np.ndarray, "waypoints joints"] | None:
    """Find a path of the joints between two configurations on which nothing collides.

    Args:
        start: positions of the joints at the start, (joints,), radians.
        goal: positions at the end, (joints,), radians.
        lower: lower limits, (joints,).
        upper: upper limits, (joints,).
        free: whether nothing collides at positions (joints,).
        seed: seed of the planner, above 0; the path is a function of it.
        resolution: radians between tested positions, norm over all joints.

    Returns:
        Corners of the path, (waypoints, joints), radians; None if none was found, or an end is not free.

    Raises:
        InputError: OMPL is not installed.
    """
    if not free(start) or not free(goal):
        return None
    steps = max(2, int(np.ceil(np.linalg.norm(goal - start) / resolution)) + 1)
    if all(free(start + share * (goal - start)) for share in np.linspace(0, 1, steps)[1:-1]):
        return np.stack([start, goal])
    base, geometric, util = (extra("plan_joints()", f"ompl.{name}") for name in ("base", "geometric", "util"))
    util.setLogLevel(util.LogLevel.LOG_NONE)
    util.RNG.setSeed(seed)
    count = len(start)
    space = base.RealVectorStateSpace(count)
    bounds = base.RealVectorBounds(count)
    # Around both ends: whole turns of the joints would only lengthen the path.
    for number, (low, high) in enumerate(zip(np.minimum(start, goal) - 2.0, np.maximum(start, goal) + 2.0)):
        bounds.setLow(number, max(float(low), float(lower[number])))
        bounds.setHigh(number, min(float(high), float(upper[number])))
    space.setBounds(bounds)
    setup = geometric.SimpleSetup(space)
    setup.setStateValidityChecker(lambda state: bool(free(np.array([state[number] for number in range(count)]))))
    information = setup.getSpaceInformation()
    information.setStateValidityCheckingResolution(resolution / space.getMaximumExtent())
    ends = []
    for positions in (start, goal):
        state = space.allocState()
        for number in range(count):
            state[number] = float(positions[number])
        ends.append(state)
    setup.setStartAndGoalStates(*ends)
    planner = geometric.RRTConnect(information)
    planner.setRange(RANGE)
    setup.setPlanner(planner)
    iterations = iter(range(MAX_ITERATIONS))
    setup.solve(base.PlannerTerminationCondition(lambda: next(iterations, None) is None))
    if not setup.haveExactSolutionPath():
        return None
    path = setup.getSolutionPath()
    geometric.PathSimplifier(information).partialShortcutPath(path, SHORTCUTS, SHORTCUTS, 0.33, 0.005)
    return np.array([[state[number] for number in range(count)] for state in path.getStates()])
