"""Files: reading and writing, and nothing else.

Modules:
    arrays: .npy and .npz: which numbers of an array are points
    columns: text clouds, and which columns of numbers are coordinates
    content: bytes of files, and the errors of what cannot be read
    demonstrations: demonstrations as .npz
    gltf: scenes in .glb and .gltf
    mesh_folder: meshes in a folder and its subfolders
    meshes: meshes in files of every format
    obj: polygons in .obj
    off: polygons in .off
    pcd: clouds in .pcd
    ply: polygons and clouds in .ply
    pointclouds: clouds in files of every format
    polygons: polygons, cut into triangles
    stl: triangles in .stl
    text: encodings, lines and numbers of text files
    trajectories: trajectories as .npz, .tum and .csv
"""
