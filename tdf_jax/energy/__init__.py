"""Descriptors of poses, and how far a trajectory is from the demonstration.

Modules:
    descriptors: eq. 1: descriptors of poses and trajectories
    losses: eq. 2, 3 and 6: the energy of one trajectory
    reference: descriptors and poses to match
    residual: normalised energy of a pick, and how a field fits the points of its own cloud
    seating: how far a placed object is from touching its target
"""
