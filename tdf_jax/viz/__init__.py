"""Pictures; matplotlib loads only with these modules.

Importing this package imports matplotlib and, for that moment, hides MPLBACKEND.

Modules:
    cards: how objects show themselves in a notebook
    contact_sheet: many objects side by side
    evaluation: pictures of the benchmark
    film: frames of a film of an imitation
    film_file: pictures and films as files
    imitation: an imitation and its losses
    imitation_page: page of an imitation, which plays
    landscape_page: page of an energy landscape
    landscapes: energy landscapes
    motion: frames between the poses of a trajectory
    page: the file of a page, which opens without a network
    paper: the paper's figures
    placements: placed objects, cut open
    polygons3d: solids in 3-D axes
    reconstruction: surfaces and transfers
    relations: an object placed on a target
    scene3d: an object with a trajectory
    sides: demonstration and imitation of a moving picture
    single: pictures on given axes, for `tdf.plot`
    style: colours, sizes, saving
    training: curves of a training run
"""

import contextlib
import os
import sys


def _import_matplotlib() -> None:
    """Import matplotlib, also where MPLBACKEND names a backend that does not exist.

    Jupyter sets it for all processes that it starts, and matplotlib then refuses to be imported if it has no such
    backend. Pictures here are drawn by Agg, whatever the backend; a backend that exists stays the user's.
    """
    if "matplotlib" in sys.modules:
        return
    backend = os.environ.pop("MPLBACKEND", None)
    try:
        import matplotlib
    finally:
        if backend is not None:
            os.environ["MPLBACKEND"] = backend
    if backend:
        with contextlib.suppress(ValueError):
            matplotlib.rcParams["backend"] = backend  # as matplotlib does


_import_matplotlib()
