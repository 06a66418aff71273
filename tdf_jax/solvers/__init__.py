"""Poses that minimise the energy, from many starts.

Modules:
    adam: `optimize`: Adam on SO(3) x R^3
    gauss_newton: damped Gauss-Newton steps on single poses
    imitation_scene: an imitation with all that a picture of it needs, and its file
    initial: random or given starts, and the goal
    multistart: `solve`: Gauss-Newton from many starts in stages
    pick: `carry`: finds the pick and warps the demonstration from there to the goal
    result: result of any solver
    sensitivity: `differentiable_pick`: derivatives of a found pick
    stages: sizes and candidates of the stages of `solve`
    tracking: `track`: the pick on an object that moved, from the last pick
"""
