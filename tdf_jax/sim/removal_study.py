"""What the removal of the table and of flying pixels costs: the share of an object's own points that is lost.

Objects stand on a table, and a depth camera sees them. A pixel is the mean of four rays, so that pixels at edges lie
between two surfaces, with normal noise of 1 mm.

python -m tdf_jax.sim.removal_study --objects 20
"""

import dataclasses
import json
import sys
from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float

from tdf_jax._internal.files import replace_file
from tdf_jax.evaluation.depth_images import four_rays
from tdf_jax.evaluation.study_command import file_to_write, study_parser
from tdf_jax.evaluation.tables import markdown
from tdf_jax.evaluation.tabletop import rows_of
from tdf_jax.perception.clusters import separate_objects
from tdf_jax.perception.depth import points_from_depth
from tdf_jax.perception.support import find_support
from tdf_jax.shapes import (
    FAMILIES,
    BowlParameters,
    Mug,
    Rack,
    Shape,
    build_bowl,
)
from tdf_jax.sim.bodies import body_of
from tdf_jax.sim.cameras import NOISE, Camera, depth_image, look_at
from tdf_jax.sim.workcell import OBJECT, build_workcell

PLACE = (0.5, 0.0)  # metres, on the table
DISTANCES, ELEVATIONS = (0.4, 1.0), (20.0, 70.0)  # metres and degrees
SPREAD = 0.01  # metres between the rays of a pixel that is between two surfaces
LOW_BOWL = BowlParameters(height=0.022, radius=0.06, wall_thickness=0.0035, bottom_thickness=0.004)
MARGIN = 0.001  # metres around a part
ROWS = (*FAMILIES, "bowl of 22 mm")


@dataclasses.dataclass(frozen=True, eq=False)
class View:
    """What a camera sees of an object on a table.

    Attributes:
        camera: the camera.
        depth: noisy depths, (height, width), metres; 0 where nothing is hit.
        own: pixels that show the object alone, (height, width).
        part: pixels that show the object's handle or pegs alone, (height, width); none of other objects.
        flying: pixels between two surfaces, (height, width).
    """

    camera: Camera
    depth: Float[np.ndarray, "height width"]
    own: Bool[np.ndarray, "height width"]
    part: Bool[np.ndarray, "height width"]
    flying: Bool[np.ndarray, "height width"]


def draw_object(row: str, rng: np.random.Generator) -> Shape:
    """An object of a row of the table.

    Args:
        row: one of `ROWS`.
        rng: random generator.
    """
    if row not in FAMILIES:
        return build_bowl(LOW_BOWL)
    family = FAMILIES[row]
    return family.build(family.sample(rng))


def draw_view(shape: Shape, rng: np.random.Generator, noise: float = NOISE) -> View:
    """Draw a camera and what it sees of an object that stands on a table.

    Args:
        shape: the object.
        rng: random generator of its yaw, of the camera and of the noise.
        noise: standard deviation of a depth, metres.
    """
    turn = rng.uniform(0, 2 * np.pi)
    T = np.eye(4)
    T[:2, :2] = [[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]]
    T[:3, 3] = (*PLACE, -shape.mesh.bounds[0, 2])
    cell = build_workcell(None, body_of(shape), T)
    data = cell.data()
    up, around, distance = np.radians(rng.uniform(*ELEVATIONS)), rng.uniform(0, 2 * np.pi), rng.uniform(*DISTANCES)
    middle = np.array([*PLACE, shape.height / 2])
    away = np.array([np.cos(up) * np.cos(around), np.cos(up) * np.sin(around), np.sin(up)])
    camera = look_at(middle + distance * away, middle)
    fine = Camera(camera.T_world_camera, camera.fovy, 2 * camera.width, 2 * camera.height)
    image = depth_image(cell.model, data, fine)
    rays = four_rays(image.depth)
    spread = np.ptp(np.where(rays > 0, rays, 1e3), axis=-1)
    hit = (rays > 0).all(axis=-1)
    depth = np.where(hit, rays.mean(axis=-1) + noise * rng.normal(size=hit.shape), 0.0)
    own = four_rays(image.mask(cell.model, OBJECT)).all(axis=-1) & (spread <= SPREAD)
    rows, columns = np.nonzero(own)
    pixels = np.stack([columns, rows, np.ones(len(rows))], axis=1)
    seen = pixels @ np.linalg.inv(camera.intrinsics).T * rays[rows, columns].mean(axis=-1)[:, None]
    T_object_camera = np.linalg.inv(T) @ camera.T_world_camera
    part = np.zeros_like(own)
    part[rows, columns] = part_of(shape, seen @ T_object_camera[:3, :3].T + T_object_camera[:3, 3])
    return View(camera, depth, own, part, hit & (spread > SPREAD))


def part_of(shape: Shape, points: Float[np.ndarray, "points 3"]) -> Bool[np.ndarray, " points"]:
    """Which points of an object's surface are on a mug's handle, outside of its body, or on a rack's pegs.

    Args:
        shape: the object.
        points: points of its surface, (points, 3), metres, object frame.
    """
    if isinstance(shape, Mug):
        p = shape.parameters
        body = max(p.top_radius, p.bottom_radius) + max(p.bulge, 0.0) + MARGIN
        return (points[:, 0] > body) & (np.abs(points[:, 1]) < p.handle_width * p.handle_flare)
    found = np.zeros(len(points), bool)
    if isinstance(shape, Rack):
        for start, end in shape.peg_lines:
            along = (end - start) / np.linalg.norm(end - start)
            share = (points - start) @ along
            off = np.linalg.norm(points - start - share[:, None] * along, axis=1)
            found |= (share > MARGIN) & (off < shape.parameters.peg_thickness / 2 + MARGIN)
    return found


def measure(view: View) -> dict[str, float]:
    """Shares of the object's pixels, and of its handle's or pegs', that are lost, and what is left of the rest.

    Args:
        view: what a camera sees.

    Returns:
        Shares of the object's own pixels that are lost with the edges, with the table, and in all, those of its part;
        the share of flying pixels that is removed; the share of the object's cluster that is not the object's. NaN
        where there is nothing to share.
    """
    camera = view.camera
    T = camera.T_world_camera
    points, rows, columns = _points(view)
    cluster = separate_objects(points, camera=T[:3, 3])
    inside = np.zeros(view.depth.shape, bool)
    largest = max(cluster, key=lambda one: int(view.own[rows, columns][rows_of(points, one)].sum()))
    chosen = rows_of(points, largest)
    inside[rows[chosen], columns[chosen]] = True
    kept = np.zeros(view.depth.shape, bool)
    kept[rows, columns] = True
    support = find_support("measure()", points, T[:3, 3])
    above = np.zeros(view.depth.shape, bool)
    if support is not None:
        high = support.in_front(points)
        above[rows[high], columns[high]] = True
    pure = np.count_nonzero(inside & (view.own | view.flying))
    return {
        "edges": _share(view.own & ~kept, view.own),
        "table": _share(view.own & kept & ~above, view.own),
        "lost": _share(view.own & ~inside, view.own),
        "part, edges": _share(view.part & ~kept, view.part),
        "part, lost": _share(view.part & ~inside, view.part),
        "flying removed": _share(view.flying & ~inside, view.flying),
        "foreign": 1 - pure / max(1, np.count_nonzero(inside)),
        "flying left": np.count_nonzero(inside & view.flying) / max(1, np.count_nonzero(inside)),
    }


def _points(view: View):
    """Points of an image, and their rows and columns: the noise makes all coordinates different."""
    camera = view.camera
    points = points_from_depth(view.depth, camera.intrinsics, camera.T_world_camera)
    T = np.linalg.inv(camera.T_world_camera)
    pixels = (points @ T[:3, :3].T + T[:3, 3]) @ camera.intrinsics.T
    columns, rows = np.round(pixels[:, :2] / pixels[:, 2:]).astype(int).T
    return points, rows, columns


def _share(part, whole) -> float:
    total = np.count_nonzero(whole)
    return np.count_nonzero(part) / total if total else float("nan")


def main(arguments: Sequence[str] | None = None) -> None:
    """Measure all rows, and print the table.

    Args:
        arguments: words of the command line; by default those of the process.
    """
    parser = study_parser(
        "tdf_jax.sim.removal_study", __doc__, "objects", 20, "number of objects of each row", "the objects and cameras"
    )
    parser.add_argument("--rows", nargs="*", default=ROWS, choices=ROWS, help="rows (default: all)")
    parser.add_argument("--out", type=file_to_write, help="file for the numbers of every view (default: none)")
    settings = parser.parse_args(arguments)
    table, record, names = [], {}, []
    for row in settings.rows:
        measured = []
        for number in range(settings.objects):
            rng = np.random.default_rng([settings.seed, ROWS.index(row), number])
            measured.append(measure(draw_view(draw_object(row, rng), rng)))
        record[row] = measured
        names = list(measured[0])
        values = np.array([[one[name] for name in names] for one in measured])
        cells = [
            "-" if np.isnan(column).all() else f"{100 * np.nanmean(column):.1f} ({100 * np.nanmax(column):.1f})"
            for column in values.T
        ]
        table.append([row, *cells])
        print(f"{row}: {settings.objects} views", file=sys.stderr, flush=True)
    print(markdown(["object", *names], table))
    if settings.out is not None:
        replace_file("removal_study", settings.out, json.dumps(record, indent=1).encode())


if __name__ == "__main__":
    main()
