"""Pictures; matplotlib loads only with these modules.

Modules:
    contact_sheet: many objects side by side
    evaluation: pictures of the benchmark
    html: pages that open in a browser
    imitation: an imitation and its losses
    landscapes: energy landscapes
    paper: the paper's figures
    polygons3d: solids in 3-D axes
    reconstruction: surfaces and transfers
    scene3d: an object with a trajectory
    style: colours, sizes, saving
    training: curves of a training run
"""
