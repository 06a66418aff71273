"""`tdf view`: an imitation or a landscape in a browser."""

import threading
from pathlib import Path
from typing import Annotated

import tyro

from tdf_jax._internal.errors import InputError

_NONE = "(default: none)"


class Waiting(threading.Event):
    """Waits for Ctrl-C."""


def view(
    folder: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="DIR")],
    landscape: Annotated[Path | None, tyro.conf.arg(metavar="DIR", help_behavior_hint=_NONE)] = None,
    weights: Annotated[
        str | None, tyro.conf.arg(metavar="NAME|FILE", help_behavior_hint="(default: those of the folder)")
    ] = None,
    port: int = 8080,
    share: bool = False,
    no_browser: bool = False,
) -> None:
    """Show a folder of `tdf imitate` or `tdf landscape` in a browser, until Ctrl-C. It needs the extra "viewer".

    The object and its goal can be dragged: the pick is found again, and the path follows. The address is this machine's
    own.

    Args:
        folder: folder that `tdf imitate` or `tdf landscape` wrote.
        landscape: folder of `tdf landscape` to show with an imitation.
        weights: weights of the object, if they are not where the folder says.
        port: port of the address; 0 for any that is free.
        share: make a public link as well, by the relay of viser's authors: whoever has it sees and moves everything.
        no_browser: open no browser; print the address alone.
    """
    import webbrowser

    from tdf_jax.landscape.storage import load_landscape
    from tdf_jax.solvers.imitation_scene import SCENE, load_imitation
    from tdf_jax.viewer.local_server import address, serving, shared_address, viser_of
    from tdf_jax.viewer.solving import model_of, problem_of
    from tdf_jax.viewer.stage import Stage, look, show_landscape

    viser_of("tdf view")
    alone = not (folder / SCENE).exists() and (folder / "landscape.npz").is_file()
    if alone and landscape is not None:
        raise InputError(f"tdf view: {folder} is a landscape, and there is --landscape {landscape}; drop one")
    file = folder / "landscape.npz" if alone else None if landscape is None else landscape / "landscape.npz"
    energies = None if file is None else load_landscape(file)[0]
    problem = None
    if not alone:
        scene = load_imitation(folder)
        problem = problem_of(scene, model_of(scene, weights))
    with serving("tdf view", port) as server:
        stage = None if problem is None else Stage(server, problem, energies)
        if problem is None and energies is not None:
            show_landscape(server, energies)
            look(server, energies.grid.points.reshape(-1, 3))
        try:
            print(f"{address(server)}  (Ctrl-C ends it)", flush=True)
            if share:
                print(f"{shared_address('tdf view', server)}  (public: whoever has it sees and moves everything)")
            if not no_browser:
                webbrowser.open(address(server))
            Waiting().wait()
        finally:
            if stage is not None:
                stage.close()
