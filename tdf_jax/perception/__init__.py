"""From a depth camera to the cloud of one object.

Modules:
    depth: points of a depth image
    support: the plane that objects stand on, found and removed
    clusters: objects that stand apart from each other
    choice: the demonstration's object and target among several clouds
    outliers: points far from all others
    voxels: points in the cells of a fixed grid
"""
