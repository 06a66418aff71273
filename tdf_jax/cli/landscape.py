"""`tdf landscape`: energies over a grid, for files or a pair of generated objects, in a folder of results."""

import contextlib
import dataclasses
import json
import math
import shutil
import time
from collections.abc import Generator
from pathlib import Path
from typing import Annotated, cast

import jax
import numpy as np
import tyro
from tqdm.auto import tqdm

from tdf_jax._internal.cache import digest
from tdf_jax._internal.errors import InputError
from tdf_jax._internal.files import replace_file, replace_folder
from tdf_jax.cli.options import LandscapeSettings, resolved
from tdf_jax.cli.pictures import Pictures, check_page
from tdf_jax.cli.scenes import make_scene
from tdf_jax.energy.reference import Reference, describe
from tdf_jax.evaluation.scene import Scene
from tdf_jax.geometry import se3
from tdf_jax.geometry.grid import PLANES, Grid, distance_from_polyline, path_grid, plane_grid, volume_grid
from tdf_jax.geometry.query import lattice_query, snapped_query
from tdf_jax.geometry.winding import libigl
from tdf_jax.landscape import shared_lattice
from tdf_jax.landscape.energy_grid import blank, fill, query_change
from tdf_jax.landscape.shortest_path import lowest_cost_path
from tdf_jax.landscape.storage import Landscape, load_landscape, save_landscape
from tdf_jax.networks.checkpoint import load_model
from tdf_jax.networks.encoding import encode
from tdf_jax.networks.field import DescriptorField
from tdf_jax.solvers.initial import default_goal

RESULT = "result.json"
NAMES = (RESULT, "landscape.npz", "map.png", "isosurface.png", "slices.gif", "landscape.html")
SCHEMA = 3  # raised when a key of result.json changes its name or its meaning
STREAM = 0x1A2D5CA9  # number that is folded into the seed's key
SAVE_SECONDS = 20.0  # interval between saves of an unfinished sweep
NUMBER = 4  # bytes of a float32 number
MAX_QUERIES = 4096  # query points of a lattice; each needs tens of kilobytes
MAX_PATH_POINTS = 1_000_000  # grid points for the lowest-cost path, which needs about 1 kB for each


def landscape(settings: Annotated[LandscapeSettings, tyro.conf.arg(name="")] = LandscapeSettings()) -> None:
    """Sweep the query frame over a grid, and compare its descriptors with those of every waypoint.

    Writes a folder with result.json, landscape.npz and pictures; with --page also landscape.html. A sweep that is
    interrupted is kept beside the folder, and the same command continues it.
    """
    settings = resolved(settings)
    began = time.perf_counter()
    model = load_model(cast(str, settings.weights))
    scene = make_scene(settings, jax.random.fold_in(jax.random.key(settings.seed), STREAM))
    field = encode(model, jax.device_put(scene.points))
    given = describe(model, scene.demonstration)
    waypoints = np.asarray(given.trajectory.translations + field.origin, dtype=float)
    rotations = _rotations(settings, np.asarray(given.trajectory.rotations[0], dtype=float))
    axes = rotations[0].T if settings.rotation in ("pick", "identity") else np.eye(3)
    _check_size(settings, waypoints, given.trajectory.num_poses)
    _check_extras(settings)
    grid = _grid(settings, waypoints, axes)
    query = _query(settings, np.asarray(scene.demonstration.query))
    demonstration = dataclasses.replace(scene.demonstration, query=query)
    reference = given if settings.query == "given" else describe(model, demonstration)
    pictures = Pictures("tdf landscape")
    with replace_folder("tdf landscape", settings.out, RESULT, NAMES) as folder:
        swept = time.perf_counter()
        found = _swept(settings, field, reference, grid, rotations)
        seconds = {"sweep": time.perf_counter() - swept}
        goal = default_goal(field, given)
        expected = scene.expected(goal)
        expected = None if expected is None else np.asarray(expected.translations, dtype=float)
        path = None
        if math.prod(grid.shape) <= MAX_PATH_POINTS:
            ends = _ends(grid, waypoints[0] if expected is None else expected[0], np.asarray(goal[4:]))
            path = lowest_cost_path(found, *ends, settings.sharpness)
        change = None if settings.query == "given" else query_change(field, given, reference, grid, rotations[0])
        _draw(settings, folder, scene, found, expected, path, pictures)
        seconds["total"] = time.perf_counter() - began
        record = _record(settings, found, reference, change, waypoints, expected, path, seconds)
        save_landscape(folder / "landscape.npz", found, {"settings": record["settings"]})
        replace_file("tdf landscape", folder / RESULT, json.dumps(record, indent=1).encode())
    _unfinished(settings).unlink(missing_ok=True)
    print(json.dumps(record, indent=1) if settings.json else _table(record, settings.out))
    pictures.check()


def _rotations(settings, at_pick):
    """Orientations R_world_query of the sweep, (rotations, 3, 3)."""
    if settings.rotation == "best":
        return se3.rotation_grid(settings.rotations)
    if settings.rotation == "turns":
        return se3.turns(settings.axis, settings.rotations, at_pick)
    return np.eye(3)[None] if settings.rotation == "identity" else at_pick[None]


def _grid(settings, waypoints, axes) -> Grid:
    if settings.grid == "path":
        return path_grid(waypoints, settings.radius, settings.pitch, axes)
    count = round(2 * settings.half / settings.pitch) + 1
    half = settings.pitch * (count - 1) / 2
    middle = (waypoints.min(axis=0) + waypoints.max(axis=0)) / 2
    if settings.grid == "volume":
        return volume_grid(half, count, middle, axes)
    return plane_grid(half, count, middle, axes[["xyz".index(axis) for axis in settings.grid]])


def _check_size(settings, waypoints, count) -> None:
    """Refuse at once a landscape that would not fit on the disk."""
    sides = (
        np.full(3, 2 * settings.half) if settings.grid != "path" else np.ptp(waypoints, axis=0) + 2 * settings.radius
    )
    points = math.prod(float(side) / settings.pitch + 1 for side in sides[: 2 if settings.grid in PLANES else 3])
    needed = points * NUMBER * 2 * count * 2  # energies and rotations, unfinished and finished
    try:
        parent = settings.out.resolve().parent
    except (OSError, RuntimeError, ValueError) as error:  # a link to itself, a name that cannot be one
        raise InputError(f"tdf landscape: --out {settings.out} is no place ({error}); expected a new folder") from None
    free = shutil.disk_usage(parent).free if parent.is_dir() else math.inf
    if needed > free:
        raise InputError(
            f"tdf landscape: {points:.3g} points with {count} waypoints need {needed / 1e9:.3g} GB, and {parent} has "
            f"{free / 1e9:.3g} GB free; expected a grid that fits: raise --pitch or lower --half"
        )


def _check_extras(settings) -> None:
    """Refuse at once a picture whose extra is not installed."""
    if settings.grid not in PLANES and not (settings.no_plots and not settings.page):
        libigl("tdf landscape")
    if settings.page:
        check_page("tdf landscape")


def _query(settings, query):
    """The query points of the sweep, on the lattice of the grid unless they are given."""
    if settings.query == "given":
        return query
    low, high = query.min(axis=0), query.max(axis=0)
    shape = [max(1, round(float(side) / settings.pitch) + 1) for side in high - low]
    if settings.query == "snapped":
        return np.asarray(snapped_query(query, settings.pitch, (low + high) / 2))
    if math.prod(shape) > MAX_QUERIES:
        raise InputError(
            f"tdf landscape: a lattice of --pitch {settings.pitch} in the query points' box has {math.prod(shape)} "
            f"points; expected at most {MAX_QUERIES}: raise --pitch, or use --query snapped"
        )
    # The lattice has the axes of the query frame, as the grid has in one orientation.
    return np.asarray(lattice_query(shape, settings.pitch, (low + high) / 2))


def _swept(settings, field: DescriptorField, reference: Reference, grid: Grid, rotations) -> Landscape:
    """The landscape; an interrupted sweep of the same landscape is continued."""
    file, about_now = _unfinished(settings), _digest(field, reference, grid, rotations)
    found, done = blank(field, reference, grid, rotations, settings.reduce), 0
    if file.exists():
        kept, about = load_landscape(file)
        if about.get("digest") != about_now:
            raise InputError(
                f"tdf landscape: {file} is an unfinished sweep with other settings; expected the same settings: give "
                "another --out, or delete it"
            )
        found, done = dataclasses.replace(kept, reduce=settings.reduce), about["done"]
    saved = time.monotonic()
    with (
        contextlib.closing(cast(Generator, fill(found, field, reference, done))) as parts,
        tqdm(desc="sweeping", unit="tile", initial=done) as bar,
    ):
        try:
            for done, total in parts:
                bar.total = total
                bar.update(done - bar.n)
                if time.monotonic() - saved > SAVE_SECONDS and done < total:
                    save_landscape(file, found, {"digest": about_now, "done": done})
                    saved = time.monotonic()
        finally:  # a finished sweep is saved too, because the next steps may fail or be interrupted
            save_landscape(file, found, {"digest": about_now, "done": done})
    return found


def _unfinished(settings) -> Path:
    return settings.out.resolve().with_name(f"{settings.out.resolve().name}.unfinished.npz")


def _digest(field, reference, grid, rotations) -> str:
    """A digest of all that the energies depend on."""
    leaves = [*jax.tree.leaves((field, reference)), grid.origin, grid.directions, *grid.coordinates, rotations]
    leaves += [] if grid.mask is None else [grid.mask]
    # Progress is counted in tiles, so the digest has the tiles too.
    query = np.asarray(reference.query, dtype=float)
    tiles = [shared_lattice.tiles(grid, shared_lattice.layers(grid, query @ R.T).span) for R in rotations]
    return digest(*leaves, repr(tiles).encode())[:16]


def _ends(grid, start, goal):
    """Start and goal, moved to the nearest points of the grid, which may be a plane beside them."""
    points = grid.points[np.ones(grid.shape, bool) if grid.mask is None else grid.mask]
    start, goal = (points[np.linalg.norm(points - end, axis=1).argmin()] for end in (start, goal))
    return start, goal


def _draw(settings, folder: Path, scene: Scene, found: Landscape, expected, path, pictures: Pictures) -> None:
    flat = len(found.grid.shape) == 2

    def marks():
        from tdf_jax.viz.landscapes import Marks

        return Marks(np.asarray(scene.points), scene.meshes[1], expected, path)

    if not settings.no_plots:
        with pictures.drawing(folder / ("map.png" if flat else "isosurface.png")) as file:
            from tdf_jax.viz.landscapes import isosurface_figure, map_figure
            from tdf_jax.viz.style import save_figure

            save_figure(file, (map_figure if flat else isosurface_figure)(found, marks()))
    if not settings.no_plots and not flat:
        with pictures.drawing(folder / "slices.gif") as file:
            from tdf_jax.viz.landscapes import save_slices

            save_slices(file, found, marks())
    if settings.page:
        with pictures.drawing(folder / "landscape.html") as file:
            from tdf_jax.viz.landscape_page import save_landscape_page

            save_landscape_page(file, found, marks(), "Energy landscape")


def _record(settings, found: Landscape, reference, change, waypoints, expected, path, seconds) -> dict:
    """The content of result.json."""
    query = np.asarray(reference.query, dtype=float)
    layers = [shared_lattice.layers(found.grid, query @ R.T) for R in found.rotations]
    truth = waypoints if expected is None else expected
    points = math.prod(found.grid.shape) if found.grid.mask is None else int(found.grid.mask.sum())
    return {
        "schema": SCHEMA,
        "settings": {
            name: str(value) if isinstance(value, Path) else value
            for name, value in dataclasses.asdict(settings).items()
        },
        "grid": {"shape": found.grid.shape, "steps": found.grid.steps.tolist(), "first": found.grid.first.tolist()},
        "queries": len(query),
        "rotations": len(found.rotations),
        "evaluations": sum(shared_lattice.evaluations(found.grid, each) for each in layers),
        "one_by_one": points * len(query) * len(found.rotations),
        "query_change": None if change is None else {"median": change[0], "largest": change[1]},
        "energy": {"least": float(np.nanmin(found.combined)), "median": float(np.nanmedian(found.combined))},
        "minimisers": found.minimisers.tolist(),
        "truth": None if expected is None else expected.tolist(),
        "minimiser_metres": np.linalg.norm(found.minimisers - truth, axis=1).tolist(),
        "path": None if path is None else path.tolist(),
        "path_metres": None if path is None else float(distance_from_polyline(path, truth).mean()),
        "seconds": {name: round(value, 3) for name, value in seconds.items()},
    }


def _table(record: dict, out: Path) -> str:
    """The record as a table for the terminal."""
    against = "the true waypoints" if record["truth"] is not None else "the demonstrated ones, moved with the centroid"
    change, route = record["query_change"], record["path_metres"]
    rows = {
        "grid": " x ".join(map(str, record["grid"]["shape"]))
        + f" points, {record['queries']} queries, {record['rotations']} orientations",
        "evaluations": f"{record['evaluations']:,} of the field; one by one {record['one_by_one']:,}",
        "lattice": "none"
        if change is None
        else f"changes the energy by {change['median']:.1%} (median), {change['largest']:.1%} (most)",
        "energy": f"least {record['energy']['least']:.5f}, median {record['energy']['median']:.5f}",
        "minimisers": ", ".join(f"{100 * metres:.1f}" for metres in record["minimiser_metres"]) + f" cm from {against}",
        "lowest-cost path": "not computed, the grid is too large"
        if route is None
        else f"{100 * route:.1f} cm from the polyline through them, mean",
        "time": f"{record['seconds']['total']:.1f} s, sweep {record['seconds']['sweep']:.1f}",
        "written to": str(out),
    }
    return "\n".join(f"{name:<17}{value}" for name, value in rows.items())
