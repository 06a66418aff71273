"""Poses, trajectories and shapes as numbers; no network.

Modules:
    bars: round bars in a cloud, such as pegs
    demonstration: one trajectory shown on one object
    distance_fields: signed distances of boxes, meshes and clouds, as obstacles
    grid: regular grids along a line, in a plane or in a volume
    paths: demonstrated paths: line, semicircle, wave, lift, tilt, hang
    pinhole: the matrix of a camera, and the pose of one that looks at a point
    query: query points of the gripper or the placing region
    registration: a region of a cloud brought onto another cloud by closest points
    sampling: points of a surface; farthest-point sampling
    se3: rotations and rigid poses
    symmetry: equivalent poses of symmetric objects
    target: the second object of a relation, and the region where the two meet
    trajectory: poses of the query frame; resampling and displacing
    transport: a demonstrated path warped to new ends
    views: what cameras see of an object
    winding: inside and outside of a mesh
"""
