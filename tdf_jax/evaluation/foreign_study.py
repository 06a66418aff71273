"""Foreign points in the cloud of a mug: what `encode` removes of them, and whether the pick is right.

A fifth of each cloud is foreign: 375 points beside 1500 of the mug, and denser than these.
The rows of one seed have the same mugs, demonstrations and poses.

    python -m tdf_jax.evaluation.foreign_study --pairs 24 --seed 0
"""

import dataclasses
import json
import sys
import warnings
from collections.abc import Sequence
from typing import NamedTuple, cast

import jax
import numpy as np
from jaxtyping import Array, Bool, Float
from scipy.spatial import Delaunay, KDTree

from tdf_jax._internal.errors import ForeignPointsWarning, SizeWarning
from tdf_jax._internal.files import replace_file
from tdf_jax.energy.reference import Reference
from tdf_jax.evaluation import view_study
from tdf_jax.evaluation.cases import QUERIES, QUERY_SIZE, SEED_SPACE, Case, generated_case, size_of
from tdf_jax.evaluation.pick_transfer import place_errors, place_reference
from tdf_jax.evaluation.statistics import FINE, SUCCESS
from tdf_jax.evaluation.study_command import file_to_write, study_parser
from tdf_jax.evaluation.tables import markdown
from tdf_jax.evaluation.tabletop import build_tabletop, moved
from tdf_jax.geometry.query import box_query
from tdf_jax.geometry.sampling import sample_surface
from tdf_jax.networks.checkpoint import load_model
from tdf_jax.networks.encoding import encode
from tdf_jax.networks.field import DescriptorField
from tdf_jax.networks.model import Model
from tdf_jax.shapes import FAMILIES, Mug
from tdf_jax.shapes.shape import scaled
from tdf_jax.solvers.pick import carry

POINTS, FOREIGN = 1500, 375  # of the mug, which come first, and of anything else
NONE, STRAY, OUTLIERS, TABLE = "none", "one point, 3 m away", "outliers", "strip of the table"
# Category of a neighbour, and the gap to it, metres.
NEIGHBOURS = {
    "bottle, 3 cm away": ("bottle", 0.03),
    "bottle that touches the mug": ("bottle", 0.002),
    "mug, 3 cm away": ("mug", 0.03),
    "mug that touches it": ("mug", 0.002),
}
ROWS = (NONE, STRAY, OUTLIERS, TABLE, *NEIGHBOURS)
AWAY = 3.0  # metres to the single point
NEAR, FAR = (0.01, 0.06), (0.1, 2.0)  # metres from the surface, and from the middle: outliers
STRIP, FOOT = 0.02, 0.01  # metres: width of the strip of the table, height of the points that are the foot
NEIGHBOUR_POINTS = 3000  # of a whole neighbour; those that are nearest to the mug are in the cloud
TRIED = 40 * FOREIGN  # points among which those of the table and outliers are chosen
TRUTH = 20_000  # points that stand for the surface of the mug


class Pick(NamedTuple):
    """What became of one cloud.

    Attributes:
        row: kind of foreign points, one of `ROWS`.
        pair: number of the pair.
        clean: whether foreign points were removed.
        own_lost: the mug's points that were removed.
        handle_lost: those of them that are on the handle.
        foreign_left: foreign points that stayed.
        metres, degrees: errors of the pick.
    """

    row: str
    pair: int
    clean: bool
    own_lost: int
    handle_lost: int
    foreign_left: int
    metres: float
    degrees: float


def foreign_case(seed: int, pair: int, row: str) -> Case:
    """A pair of mugs, the second with foreign points; those of the mug come first, and `own` says how many they are.

    Args:
        seed: seed of the pairs.
        pair: number of the pair.
        row: kind of foreign points, one of `ROWS`.
    """
    case = generated_case("mug", seed, pair, points=POINTS)
    rng = np.random.default_rng([SEED_SPACE, seed, pair, 31 + ROWS.index(row)])
    own = moved(case.points_b.astype(float), np.linalg.inv(case.T_world_b))
    points = np.concatenate([own, _foreign(case, own, row, rng)])
    return dataclasses.replace(case, points_b=moved(points, case.T_world_b).astype(np.float32), own=len(own))


def on_handle(case: Case) -> Bool[np.ndarray, " points"]:
    """Which points of `points_b` are on the mug's handle, (points,)."""
    local = moved(case.points_b.astype(float), np.linalg.inv(case.T_world_b))
    return view_study.on_handle(cast(Mug, case.object_b), local) & (np.arange(len(local)) < POINTS)


def measure(model: Model, case: Case, row: str, pair: int, query: Float[Array, "queries 3"]) -> list[Pick]:
    """The pick on a cloud as it is, and with its foreign points removed; of a clean cloud only the latter.

    Args:
        model: weights of mugs.
        case: the pair, see `foreign_case`.
        row: its kind of foreign points.
        pair: its number, which seeds the search.
        query: query points, (queries, 3), metres, query frame.
    """
    reference = place_reference(model, case, query)
    handle = on_handle(case)
    picks = []
    for clean in (True,) if row == NONE else (False, True):
        with warnings.catch_warnings():  # the record has the numbers
            for kind in (ForeignPointsWarning, SizeWarning):
                warnings.simplefilter("ignore", kind)
            field, kept = encode(model, case.points_b, clean=clean, return_kept=True)
        distance, angle = picked(field, reference, case, pair)
        lost = int((~kept[: case.own]).sum()), int((~kept & handle).sum())
        picks.append(Pick(row, pair, clean, *lost, int(kept[case.own :].sum()), distance, angle))
    return picks


def picked(field: DescriptorField, reference: Reference, case: Case, seed: int) -> tuple[float, float]:
    """Errors of the pick in a field: metres and degrees.

    Args:
        field: field of the second mug's cloud.
        reference: the demonstration.
        case: the pair.
        seed: seed of the search.
    """
    result = carry(field, reference, jax.random.key(seed), fix_last=False)
    distance, angle = place_errors(np.asarray(result.trajectory.wxyz_xyz)[:1], [case])
    return float(distance[0]), float(angle[0])


def table(picks: Sequence[Pick]) -> str:
    """Markdown: of each row the right picks by both measures, without and with removal, and what was removed.

    Args:
        picks: all picks.
    """
    lines = []
    for row in dict.fromkeys(pick.row for pick in picks):
        raw, clean = ([pick for pick in picks if pick.row == row and pick.clean is which] for which in (False, True))
        lost = sum(pick.own_lost for pick in clean), sum(pick.handle_lost for pick in clean)
        left = [pick.foreign_left for pick in clean]
        means = [f"{number / len(clean):.0f}" for number in (*lost, sum(left))]
        lines.append([row, _right(raw) if raw else "same field", _right(clean), str(len(clean)), *means])
    heads = ["foreign points", "`clean=False`", "default", "pairs", "own lost", "of the handle", "foreign left"]
    return markdown(heads, lines)


def _right(picks: Sequence[Pick]) -> str:
    metres, degrees = np.array([[pick.metres, pick.degrees] for pick in picks]).T
    return ", ".join(str(int(bound.holds(metres, degrees).sum())) for bound in (SUCCESS, FINE))


def _foreign(case: Case, own, row: str, rng) -> Float[np.ndarray, "foreign 3"]:
    """Foreign points, (foreign, 3), metres, frame of the second mug, which stands upright."""
    middle = own.mean(axis=0)
    if row == NONE:
        return np.zeros((0, 3))
    if row == STRAY:
        return middle + AWAY * _directions(1, rng)
    if row == OUTLIERS:
        near = own[rng.integers(len(own), size=TRIED)] + rng.uniform(*NEAR, (TRIED, 1)) * _directions(TRIED, rng)
        gap = KDTree(sample_surface(case.object_b.mesh, TRUTH, rng)).query(near)[0]
        near = near[(gap >= NEAR[0]) & (gap <= NEAR[1])][: FOREIGN // 2]
        count = FOREIGN - len(near)
        return np.concatenate([near, middle + rng.uniform(*FAR, (count, 1)) * _directions(count, rng)])
    if row == TABLE:
        ground = own[:, 2].min()
        foot = own[own[:, 2] < ground + FOOT, :2]
        around = rng.uniform(foot.min(axis=0) - STRIP, foot.max(axis=0) + STRIP, (TRIED, 2))
        seen = (Delaunay(foot).find_simplex(around) < 0) & (KDTree(foot).query(around)[0] <= STRIP)
        strip = around[seen][:FOREIGN]
        return np.column_stack([strip, np.full(len(strip), ground)])
    category, gap = NEIGHBOURS[row]
    drawn = FAMILIES[category].build(FAMILIES[category].sample(rng))
    size = size_of(case.object_b) if category == "mug" else FAMILIES[category].size
    beside = scaled(drawn, size / size_of(drawn)).mesh
    lifted = np.eye(4)
    lifted[2, 3] = -case.object_b.mesh.bounds[0, 2]
    scene = build_tabletop(case.object_b.mesh, lifted, 1, rng, beside, gap)
    assert scene.neighbour is not None
    points = sample_surface(scene.neighbour, NEIGHBOUR_POINTS, rng) - lifted[:3, 3]
    return points[np.argsort(KDTree(own).query(points)[0], kind="stable")[:FOREIGN]]


def _directions(count: int, rng) -> Float[np.ndarray, "count 3"]:
    directions = rng.standard_normal((count, 3))
    return directions / np.linalg.norm(directions, axis=1, keepdims=True)


def main(arguments: Sequence[str] | None = None) -> None:
    """Measure all pairs, and print the table.

    Args:
        arguments: words of the command line; by default those of the process.
    """
    parser = study_parser(
        "tdf_jax.evaluation.foreign_study", __doc__, "pairs", 24, "number of pairs of every row", "the pairs"
    )
    parser.add_argument("--rows", nargs="+", choices=ROWS, default=ROWS, help="kinds of foreign points (default: all)")
    parser.add_argument("--out", type=file_to_write, help="file for the numbers of every pick (default: none)")
    settings = parser.parse_args(arguments)
    model = load_model("mug")
    query = box_query(jax.random.key(settings.seed), QUERIES, QUERY_SIZE)
    picks: list[Pick] = []
    for pair in range(settings.pairs):
        for row in settings.rows:
            found = measure(model, foreign_case(settings.seed, pair, row), row, pair, query)
            print(*found, sep="\n", file=sys.stderr, flush=True)
            picks += found
    print(table(sorted(picks, key=lambda pick: ROWS.index(pick.row))))
    if settings.out is not None:
        replace_file("foreign_study", settings.out, json.dumps([pick._asdict() for pick in picks], indent=1).encode())


if __name__ == "__main__":
    main()
