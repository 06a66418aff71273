"""Files: reading and writing, and nothing else.

Modules:
    demonstrations: demonstrations as .npz
    meshes: meshes: .obj .stl .ply .glb .off
    pointclouds: clouds: .ply .pcd .xyz .npy .npz
    trajectories: trajectories as .npz and .tum
"""
