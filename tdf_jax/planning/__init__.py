"""Trajectories that keep clear of obstacles.

Modules:
    avoidance: `push_clear`
    distances: `clearance`: distances of a moving body
    occupied: an obstacle from a field
"""
