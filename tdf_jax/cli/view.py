"""`tdf view`: an imitation, a landscape or simulated episodes in a browser."""

import threading
from pathlib import Path
from typing import Annotated

import tyro

from tdf_jax._internal.errors import InputError

_NONE = "(default: none)"


class Waiting(threading.Event):
    """Waits for Ctrl-C."""


def view(
    folder: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="DIR|FILE")],
    demonstrate: Annotated[Path | None, tyro.conf.arg(metavar="FILE", help_behavior_hint=_NONE)] = None,
    scale: float = 1.0,
    landscape: Annotated[Path | None, tyro.conf.arg(metavar="DIR", help_behavior_hint=_NONE)] = None,
    episode: Annotated[int | None, tyro.conf.arg(metavar="INT", help_behavior_hint="(default: the first)")] = None,
    weights: Annotated[
        str | None, tyro.conf.arg(metavar="NAME|FILE", help_behavior_hint="(default: those of the folder)")
    ] = None,
    port: int = 8080,
    share: bool = False,
    no_browser: bool = False,
) -> None:
    """Show a folder of results in a browser until Ctrl-C, or make a demonstration by hand.

    It needs the extra "viewer".

    The object and its goal can be dragged: the pick is found again, and the path follows. Simulated episodes are
    played. The address is this machine's own.

    Args:
        folder: folder that `tdf imitate`, `tdf landscape`, `tdf simulate` or `tdf benchmark --simulation` wrote; with
            --demonstrate, mesh or cloud of the object.
        demonstrate: .npz file for a demonstration that is made by hand on the object: drag a box of query points along
            key poses.
        scale: metres per unit of the object's file, such as 0.01 for centimetres.
        landscape: folder of `tdf landscape` to show with an imitation.
        episode: number of the simulated episode that is shown first.
        weights: weights of the object, if they are not where the folder says.
        port: port of the address; 0 for any that is free.
        share: make a public link as well, by the relay of viser's authors: whoever has it sees and moves everything.
        no_browser: open no browser; print the address alone.
    """
    from tdf_jax.landscape.storage import load_landscape
    from tdf_jax.solvers.imitation_scene import SCENE, load_imitation
    from tdf_jax.viewer.energies import show_landscape
    from tdf_jax.viewer.episodes import EpisodeStage
    from tdf_jax.viewer.handles import look
    from tdf_jax.viewer.local_server import serving, viser_of
    from tdf_jax.viewer.solving import model_of, problem_of
    from tdf_jax.viewer.stage import Stage

    viser_of("tdf view")
    if demonstrate is not None:
        if landscape is not None or weights is not None or episode is not None:
            raise InputError("tdf view: --demonstrate has no use for --landscape, --episode and --weights; drop them")
        _demonstrate(folder, demonstrate, scale, port, share, no_browser)
        return
    if scale != 1:
        raise InputError("tdf view: --scale is for an object with --demonstrate; give that, or drop --scale")
    if folder.is_file() and folder.suffix != ".npz":
        raise InputError(
            f"tdf view: {folder} is a file; expected a folder of `tdf imitate`, `tdf landscape` or `tdf simulate`. To "
            "make a demonstration on an object, add --demonstrate FILE"
        )
    simulated = _simulated(folder)
    if simulated is not None:
        if landscape is not None or weights is not None:
            raise InputError(f"tdf view: {folder} holds simulated episodes; drop --landscape and --weights")
        with serving("tdf view", port) as server:
            episodes = EpisodeStage(server, simulated, episode)
            try:
                _wait(server, share, no_browser)
            finally:
                episodes.close()
        return
    if episode is not None:
        raise InputError(f"tdf view: {folder} is no folder of `tdf simulate`; expected one for --episode; drop it")
    alone = not (folder / SCENE).exists() and (folder / "landscape.npz").is_file()
    if alone and landscape is not None:
        raise InputError(f"tdf view: {folder} is a landscape, and there is --landscape {landscape}; drop one")
    if not alone and folder.is_dir() and not (folder / SCENE).is_file() and any(folder.iterdir()):
        raise InputError(
            f"tdf view: {folder} has no {SCENE}, landscape.npz or episodes; expected a folder of `tdf imitate`, "
            "`tdf landscape` or `tdf simulate` of this version. Of other commands, see the pictures"
        )
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
            _wait(server, share, no_browser)
        finally:
            if stage is not None:
                stage.close()


def _simulated(folder: Path) -> Path | None:
    """The folder of simulated episodes: this one, or that of the runs in the folder of a benchmark."""
    from tdf_jax.sim.playback import FOLDER

    return next((one for one in (folder, folder / "runs") if (one / FOLDER).is_dir()), None)


def _demonstrate(file: Path, path: Path, scale: float, port: int, share: bool, no_browser: bool) -> None:
    from tdf_jax.io.meshes import load_mesh
    from tdf_jax.io.pointclouds import load_points
    from tdf_jax.viewer.demonstrating import DemonstrationStage, check_demonstration_path
    from tdf_jax.viewer.local_server import serving

    check_demonstration_path("tdf view", path)
    points = load_points(file, scale=scale)
    try:
        mesh = load_mesh(file, scale)
    except InputError:  # the file has no faces; it has just been read as a cloud
        mesh = None
    with serving("tdf view", port) as server:
        DemonstrationStage(server, points, path, mesh)
        _wait(server, share, no_browser)


def _wait(server, share: bool, no_browser: bool) -> None:
    """Say where the server is, open it, and wait for Ctrl-C."""
    import webbrowser

    from tdf_jax.viewer.local_server import address, shared_address

    print(f"{address(server)}  (Ctrl-C ends it)", flush=True)
    if share:
        link = shared_address("tdf view", server)
        print(f"{link}  (public: whoever has it sees and moves everything)", flush=True)
    if not no_browser:
        webbrowser.open(address(server))
    Waiting().wait()
