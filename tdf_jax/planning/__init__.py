"""Trajectories that keep clear of obstacles.

Modules:
    avoidance: `push_clear`: a trajectory moved clear of obstacles
    distances: `clearance`: distances of a moving body from obstacles
    occupied: `field_obstacle`: an obstacle made of a descriptor field
"""
