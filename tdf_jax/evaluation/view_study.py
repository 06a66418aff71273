"""Does another view help: picks of mugs whose handle is hidden, before and after a view from where the advice says.

A mug in a random orientation is seen by one camera in a random direction; only those are kept of which fewer than 20
points are on the handle. The second view is from `tdf_jax.uncertainty.advice.look_from`, at the same distance.

    python -m tdf_jax.evaluation.view_study --mugs 100 --seed 0
"""

import json
import sys
from collections.abc import Sequence
from typing import NamedTuple, cast

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float
from scipy.spatial.transform import Rotation

from tdf_jax._internal.files import replace_file
from tdf_jax.energy.reference import Reference, describe
from tdf_jax.evaluation.cases import QUERIES, QUERY_SIZE, SEED_SPACE
from tdf_jax.evaluation.statistics import SUCCESS
from tdf_jax.evaluation.study_command import file_to_write, study_parser
from tdf_jax.evaluation.tables import success_rate
from tdf_jax.geometry import se3
from tdf_jax.geometry.demonstration import Demonstration
from tdf_jax.geometry.query import box_query
from tdf_jax.geometry.sampling import sample_surface
from tdf_jax.geometry.trajectory import Trajectory
from tdf_jax.geometry.views import visible
from tdf_jax.networks.checkpoint import load_model
from tdf_jax.networks.encoding import encode
from tdf_jax.networks.model import Model
from tdf_jax.shapes import FAMILIES, Mug
from tdf_jax.solvers.pick import carry
from tdf_jax.uncertainty.advice import SEEN, look_from
from tdf_jax.uncertainty.calibration import confidence

SURFACE, POINTS = 12_000, 1500  # points that a camera may see, and most points of a view
DISTANCE = 0.7  # metres of the camera from the mug
MARGIN = 0.001  # metres outside the body from which a point is the handle's


class Case(NamedTuple):
    """A mug, and what was found before and after the second view.

    Attributes:
        number: number of the mug.
        before, after: whether the pick is right to 2 cm and 20 degrees.
        confident_before, confident_after: confidences.
        seen: points of the handle in the second view.
        turned: degrees between the second view and the opposite of the first; NaN without a second view.
    """

    number: int
    before: bool
    after: bool
    confident_before: float
    confident_after: float
    seen: int
    turned: float


def measure(model: Model, reference: Reference, seed: int, number: int) -> Case | None:
    """Measure one mug.

    Args:
        model: weights of mugs.
        reference: a demonstrated pick at the handle.
        seed: seed of the mugs.
        number: number of the mug.

    Returns:
        The case; None if its handle is seen.
    """
    rng = np.random.default_rng([SEED_SPACE, seed, number, 21])
    family = FAMILIES["mug"]
    mug = cast(Mug, family.build(family.sample(rng)))
    R = Rotation.random(rng=rng).as_matrix()
    surface = sample_surface(mug.mesh, SURFACE, rng)
    away = rng.normal(size=3)
    away /= np.linalg.norm(away)
    middle = surface.mean(axis=0)

    def view(direction: Float[np.ndarray, "3"]) -> Float[np.ndarray, "seen 3"]:
        return surface[visible(mug.mesh, surface, (middle + DISTANCE * direction)[None], rng)[0]][:POINTS]

    first = view(away)
    if handle_points(mug, first) >= SEEN:
        return None
    before, confident_before, direction = picked(model, reference, mug, R, first, number)
    if np.isnan(direction).any():
        return Case(number, before, before, confident_before, confident_before, 0, np.nan)
    local = R.T @ direction
    second = view(local)
    both = np.concatenate([first, second])
    after, confident_after, _ = picked(model, reference, mug, R, both, number)
    turned = float(np.degrees(np.arccos(np.clip(-local @ away, -1, 1))))
    return Case(number, before, after, confident_before, confident_after, handle_points(mug, second), turned)


def on_handle(mug: Mug, points: Float[np.ndarray, "points 3"]) -> Bool[np.ndarray, " points"]:
    """Which points in a mug's frame are on its handle, outside of its body."""
    p = mug.parameters
    return points[:, 0] > max(p.top_radius, p.bottom_radius) + max(p.bulge, 0.0) + MARGIN


def handle_points(mug: Mug, points: Float[np.ndarray, "points 3"]) -> int:
    """Number of points on a mug's handle, outside of its body."""
    return int(on_handle(mug, points).sum())


def picked(
    model: Model, reference: Reference, mug: Mug, R: Float[np.ndarray, "3 3"], points, number: int
) -> tuple[bool, float, Float[np.ndarray, "3"]]:
    """Whether the pick on a rotated cloud is right, its confidence, and where to look from next.

    Args:
        model: weights of mugs.
        reference: the demonstration.
        mug: the mug.
        R: its rotation.
        points: cloud in the mug's frame.
        number: seed of the search.
    """
    cloud = (points @ R.T).astype(np.float32)
    field = encode(model, cloud)
    result = carry(field, reference, jax.random.key(number), fix_last=False)
    pick = np.asarray(result.pick, float)
    error = R.T @ np.asarray(se3.rotation(result.pick), float)
    distance = float(np.linalg.norm(R.T @ pick[4:] - mug.handle_frame[:3, 3]))
    angle = float(np.degrees(Rotation.from_matrix(error).magnitude()))
    right = bool(SUCCESS.holds(distance, angle))
    known = confidence(float(result.residual))
    return right, np.nan if known is None else known, look_from(field, cloud)


def demonstrate(model: Model, seed: int) -> Reference:
    """A demonstrated pick at the middle of a handle, in the mug's orientation."""
    rng = np.random.default_rng([SEED_SPACE, seed, 22])
    family = FAMILIES["mug"]
    mug = cast(Mug, family.build(family.sample(rng)))
    pick = Trajectory(jnp.asarray(np.concatenate([[1, 0, 0, 0], mug.handle_frame[:3, 3]])[None], jnp.float32))
    query = box_query(jax.random.key(seed), QUERIES, QUERY_SIZE)
    return describe(model, Demonstration(sample_surface(mug.mesh, POINTS, rng).astype(np.float32), pick, query))


def main(arguments: Sequence[str] | None = None) -> None:
    """Measure all mugs, and print the rates.

    Args:
        arguments: words of the command line; by default those of the process.
    """
    parser = study_parser(
        "tdf_jax.evaluation.view_study",
        __doc__,
        "mugs",
        100,
        "number of mugs with a hidden handle",
        "the mugs and cameras",
    )
    parser.add_argument("--out", type=file_to_write, help="file for the numbers of every mug (default: none)")
    settings = parser.parse_args(arguments)
    model = load_model("mug")
    reference = demonstrate(model, settings.seed)
    cases: list[Case] = []
    number = 0
    while len(cases) < settings.mugs:
        case = measure(model, reference, settings.seed, number)
        number += 1
        if case is not None:
            cases.append(case)
            print(f"{len(cases)} of {settings.mugs}: {case}", file=sys.stderr, flush=True)
    for words, values in (
        ("right with one view", [case.before for case in cases]),
        ("right with the second view", [case.after for case in cases]),
        ("confidence below 0.5 with one view", [case.confident_before < 0.5 for case in cases]),
        ("handle seen by the second view", [case.seen >= SEEN for case in cases]),
    ):
        print(f"{words}: {success_rate(values)}")
    if settings.out is not None:
        replace_file("view_study", settings.out, json.dumps([case._asdict() for case in cases], indent=1).encode())


if __name__ == "__main__":
    main()
