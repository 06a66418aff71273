"""`tdf view`: an imitation, a landscape, simulated episodes or a joint trajectory in a browser."""

import contextlib
import re
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Annotated, Any

import tyro

from tdf_jax._internal.errors import InputError

_NONE = "(default: none)"
FUNCTION = re.compile(r"^[\w.]+\(\): ")  # the beginning of an error of the library


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
    robot: Annotated[Path | None, tyro.conf.arg(metavar="FILE", help_behavior_hint="(default: UR5e and 2F-85)")] = None,
    site: Annotated[str | None, tyro.conf.arg(metavar="NAME", help_behavior_hint=_NONE)] = None,
    port: int = 8080,
    share: bool = False,
    no_browser: bool = False,
) -> None:
    """Show a folder of results in a browser until Ctrl-C, or make a demonstration by hand.

    It needs the extra "viewer".

    The object and its goal can be dragged: the pick is found again, and the path follows. Simulated episodes and joint
    trajectories are played. The address is this machine's own.

    Args:
        folder: folder that `tdf imitate`, `tdf landscape`, `tdf simulate` or `tdf benchmark --simulation` wrote, or an
            .npz file in it; a joint trajectory, .npz or .csv; with --demonstrate, mesh or cloud of the object.
        demonstrate: .npz file for a demonstration that is made by hand on the object: drag a box of query points along
            key poses.
        scale: metres per unit of the object's file, such as 0.01 for centimetres.
        landscape: folder of `tdf landscape` to show with an imitation.
        episode: number of the simulated episode that is shown first.
        weights: weights of the object, if they are not where the folder says.
        robot: MJCF of the robot of a joint trajectory, which needs the extra "sim".
        site: site of that file that is the gripper's frame.
        port: port of the address; 0 for any that is free.
        share: make a public link as well, by the relay of viser's authors: whoever has it sees and moves everything.
        no_browser: open no browser; print the address alone.
    """
    options = {
        "--landscape": landscape,
        "--episode": episode,
        "--weights": weights,
        "--robot": robot,
        "--site": site,
    }
    with _named():
        from tdf_jax.viewer.local_server import serving, viser_of

        viser_of("tdf view")
        if demonstrate is not None:
            _refuse_options("--demonstrate", set(), options)
            show = _demonstration(folder, demonstrate, scale)
        elif scale != 1:
            raise InputError("tdf view: --scale is for an object with --demonstrate; give that, or drop --scale")
        else:
            show = _results(folder, options)
        with serving("tdf view", port) as server:
            stage = show(server)
            try:
                _wait(server, share, no_browser)
            finally:
                if stage is not None:
                    stage.close()


@contextlib.contextmanager
def _named() -> Iterator[None]:
    """Name the command in errors, not the function that found them."""
    try:
        yield
    except InputError as error:
        raise InputError(FUNCTION.sub("tdf view: ", str(error))) from None


def _refuse_options(what: str, known: set[str], options: dict[str, Any]) -> None:
    wrong = [name for name, value in options.items() if value is not None and name not in known]
    if wrong:
        raise InputError(
            f"tdf view: {what} has no use for {', '.join(wrong)}; drop {'it' if len(wrong) == 1 else 'them'}"
        )


def _results(folder: Path, options: dict[str, Any]) -> Callable[[Any], Any]:
    """Read what there is to show; what is returned shows it on a server, and returns what is to be closed."""
    from tdf_jax.viewer.sources import EPISODES, IMITATION, LANDSCAPE, source_of

    source = source_of(folder)
    if source.kind == IMITATION:
        _refuse_options(f"{folder}, an imitation,", {"--landscape", "--weights"}, options)
        return _imitation(source.path, options["--landscape"], options["--weights"])
    if source.kind == LANDSCAPE:
        _refuse_options(f"{folder}, a landscape,", set(), options)
        return _landscape(source.path)
    if source.kind == EPISODES:
        _refuse_options(f"{folder}, simulated episodes,", {"--episode"}, options)
        return _episodes(source, options["--episode"])
    _refuse_options(f"{folder}, a joint trajectory,", {"--robot", "--site"}, options)
    return _joints(source.path, options["--robot"], options["--site"])


def _imitation(path: Path, landscape: Path | None, weights: str | None) -> Callable[[Any], Any]:
    from tdf_jax.landscape.storage import load_landscape
    from tdf_jax.solvers.imitation_scene import load_imitation
    from tdf_jax.viewer.energies import check_landscape_of
    from tdf_jax.viewer.solving import model_of, problem_of
    from tdf_jax.viewer.sources import LANDSCAPE_FILE
    from tdf_jax.viewer.stage import Stage

    energies = None
    if landscape is not None:
        energies = load_landscape(landscape / LANDSCAPE_FILE if landscape.suffix != ".npz" else landscape)[0]
    scene = load_imitation(path)
    problem = problem_of(scene, model_of(scene, weights))
    if landscape is not None and energies is not None:
        check_landscape_of(problem, energies, landscape)
    return lambda server: Stage(server, problem, energies)


def _landscape(file: Path) -> Callable[[Any], Any]:
    from tdf_jax.landscape.storage import load_landscape
    from tdf_jax.viewer.energies import show_landscape
    from tdf_jax.viewer.handles import look

    energies = load_landscape(file)[0]

    def show(server):
        show_landscape(server, energies)
        look(server, energies.grid.points.reshape(-1, 3))

    return show


def _episodes(source: Any, number: int | None) -> Callable[[Any], Any]:
    from tdf_jax.viewer.episodes import EpisodeStage

    return lambda server: EpisodeStage(server, source.path, source.episode if number is None else number)


def _joints(file: Path, robot: Path | None, site: str | None) -> Callable[[Any], Any]:
    from tdf_jax.sim.joint_trajectory import load_joint_trajectory
    from tdf_jax.sim.robot import load_robot
    from tdf_jax.viewer.joints import JointStage

    trajectory = load_joint_trajectory(file)
    loaded = load_robot(robot, site)
    return lambda server: JointStage(server, trajectory, loaded)


def _demonstration(file: Path, path: Path, scale: float) -> Callable[[Any], Any]:
    from tdf_jax.io.meshes import load_mesh
    from tdf_jax.io.pointclouds import load_points
    from tdf_jax.viewer.demonstrating import DemonstrationStage, check_demonstration_path

    check_demonstration_path("tdf view", path)
    points = load_points(file, scale=scale)
    try:
        mesh = load_mesh(file, scale)
    except InputError:  # the file has no faces; it has just been read as a cloud
        mesh = None

    def show(server):
        DemonstrationStage(server, points, path, mesh)

    return show


def _wait(server: Any, share: bool, no_browser: bool) -> None:
    """Say where the server is, open it, and wait for Ctrl-C."""
    import webbrowser

    from tdf_jax.viewer.local_server import address, shared_address

    print(f"{address(server)}  (Ctrl-C ends it)", flush=True)
    if share:
        link = shared_address("tdf view", server)
        print(f"{link}  (public: whoever has it sees and moves everything)", flush=True)
    if not no_browser:
        try:
            opened = webbrowser.open(address(server))
        except webbrowser.Error:
            opened = False
        if not opened:
            print("No browser was opened; open the address yourself.", flush=True)
    Waiting().wait()
