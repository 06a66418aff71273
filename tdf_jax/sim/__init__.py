"""A robot in physics: trajectories as motions of joints, executed in MuJoCo, and counted by the field's protocols.

Modules:
    physics: settings of the physics in one place, and the import of the engine
    robot: an arm and a gripper, from a package or from a file
    joint_trajectory: a timed motion of the joints, and its files
    retiming: times of a path of the joints within limits of velocity and acceleration
"""
