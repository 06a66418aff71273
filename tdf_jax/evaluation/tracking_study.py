"""`track` beside `carry` on generated objects that moved: how often both find one pick, what is lost, and the times.

Every object is sampled twice, before and after a random motion, so that the clouds differ by their noise too. `carry`
finds the pick on both, `track` finds the second from the first. Two picks are one within 1 mm and 1 degree, up to the
symmetry of the object. What is measured is kept in a folder, so that an interrupted run goes on.

    python -m tdf_jax.evaluation.tracking_study --moves 100 --seed 3625 --out moves
"""

import time
import warnings
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation
from tqdm.auto import tqdm

from tdf_jax._internal.cache import kept
from tdf_jax._internal.errors import InputError, TdfWarning
from tdf_jax.energy.reference import describe
from tdf_jax.evaluation.cases import QUERIES, QUERY_SIZE, SEED_SPACE, Case, generated_case, place_demonstration
from tdf_jax.evaluation.conditions import CONDITIONS, observed
from tdf_jax.evaluation.metrics import nearest_place
from tdf_jax.evaluation.study_command import study_parser
from tdf_jax.evaluation.tables import markdown
from tdf_jax.evaluation.tabletop import moved
from tdf_jax.geometry.query import box_query
from tdf_jax.geometry.sampling import sample_surface
from tdf_jax.geometry.trajectory import Trajectory
from tdf_jax.networks.checkpoint import load_model
from tdf_jax.networks.encoding import encode
from tdf_jax.networks.model import Model, fingerprint
from tdf_jax.solvers.pick import carry
from tdf_jax.solvers.tracking import TrackConfig, track

FORMAT = 1  # format number; raise it when the moves or what is measured change
CATEGORIES = ("mug", "bowl", "bottle")  # in turn
SAME = (0.001, 1.0)  # metres and degrees
NUM_POSES, PATH = 7, "wave"
CALLS = 3  # calls of `track`, whose median time counts


class Move(NamedTuple):
    """What was measured of one motion.

    Attributes:
        category: category of the object.
        angle: angle of the motion, degrees.
        distance, turn: difference of the picks of `track` and `carry`, metres and degrees.
        lost: whether `track` says that the pick is lost.
        ratio: residual of `track` over that of the first pick.
        carried: residual of `carry` after the motion over that of the first pick.
        encode, carry, track: times, seconds.
    """

    category: str
    angle: float
    distance: float
    turn: float
    lost: bool
    ratio: float
    carried: float
    encode: float
    carry: float
    track: float

    @property
    def same(self) -> bool:
        """Whether both find one pick."""
        return self.distance <= SAME[0] and self.turn <= SAME[1]


def motion(
    rng: np.random.Generator, T_world_object: Float[np.ndarray, "4 4"], angle: float, distance: float
) -> Float[np.ndarray, "4 4"]:
    """Draw a motion of an object, a rotation about its origin and a translation.

    Args:
        rng: NumPy's generator.
        T_world_object: pose of the object, 4x4.
        angle: largest angle, degrees; angles are uniform.
        distance: largest distance, metres; translations are uniform in the ball.

    Returns:
        The rigid transform of the world that takes the object to its new pose, 4x4.
    """
    axis, direction = (vector / np.linalg.norm(vector) for vector in rng.normal(size=(2, 3)))
    T = np.eye(4)
    T[:3, :3] = Rotation.from_rotvec(axis * np.radians(angle) * rng.uniform()).as_matrix()
    origin = T_world_object[:3, 3]
    T[:3, 3] = origin - T[:3, :3] @ origin + direction * distance * np.cbrt(rng.uniform())
    return T


def measure(
    model: Model, category: str, clouds: str, seed: int, number: int, angle: float, distance: float, config: TrackConfig
) -> Move:
    """Move one object, and find its pick by both.

    Args:
        model: the network.
        category: category of the object.
        clouds: condition of both clouds, one of `CONDITIONS`.
        seed: seed of the objects and motions.
        number: number of the pair of objects.
        angle: largest angle of the motion, degrees.
        distance: largest distance of the motion, metres.
        config: settings of `track`.
    """
    case: Case = generated_case(category, seed, number, clouds=clouds)
    query = box_query(jax.random.key(seed), QUERIES, QUERY_SIZE * case.scale)
    reference = describe(model, place_demonstration(case, PATH, NUM_POSES, query))
    rng = np.random.default_rng([SEED_SPACE, seed, number, 12])
    T = motion(rng, case.T_world_b, angle, distance)
    mesh = case.object_b.mesh
    seen = observed(mesh, clouds, sample_surface(mesh, len(case.points_a), rng), rng)
    points = moved(seen, T @ case.T_world_b).astype(np.float32)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", TdfWarning)
        first = carry(encode(model, case.points_b), reference, jax.random.key(number))
        encoding, field = _timed(lambda: encode(model, points))
    carrying, second = _timed(lambda: carry(field, reference, jax.random.fold_in(jax.random.key(number), 1)))
    tracked = track(field, reference, first, config=config)
    tracking = float(
        np.median([_timed(lambda: track(field, reference, first, config=config))[0] for _ in range(CALLS)])
    )
    found, expected = (Trajectory(pose[None]).matrices[0] for pose in (tracked.picks[0], second.pick))
    found, expected = (np.asarray(pose, float) for pose in (found, expected))
    expected = nearest_place(T @ case.T_world_b, found, expected, case.fold)
    return Move(
        category=category,
        angle=float(np.degrees(Rotation.from_matrix(T[:3, :3]).magnitude())),
        distance=float(np.linalg.norm(found[:3, 3] - expected[:3, 3])),
        turn=float(np.degrees(Rotation.from_matrix(found[:3, :3].T @ expected[:3, :3]).magnitude())),
        lost=bool(tracked.lost),
        ratio=float(tracked.residual / first.residual),
        carried=float(second.residual / first.residual),
        encode=encoding,
        carry=carrying,
        track=tracking,
    )


def report(moves: Sequence[Move]) -> str:
    """How often both find one pick, what is lost, and times, as Markdown.

    Args:
        moves: what was measured.
    """
    rows = []
    for category in (*dict.fromkeys(one.category for one in moves), "all"):
        some = [one for one in moves if category in (one.category, "all")]
        counts = [
            sum(one.same and not one.lost for one in some),
            sum(one.same and one.lost for one in some),
            sum(not one.same and one.lost for one in some),
            sum(not one.same and not one.lost for one in some),
        ]
        rows.append([category, str(len(some)), *map(str, counts)])
    head = ["category", "moves", "same pick", "same pick, lost", "other pick, lost", "other pick, not lost"]
    same = [one for one in moves if one.same]
    lines = [markdown(head, rows), ""]
    for words, values, scale in (
        ("difference of the same picks, mm", [one.distance for one in same], 1e3),
        ("difference of the same picks, degrees", [one.turn for one in same], 1.0),
        ("residual of track over the first pick's, same picks", [one.ratio for one in same], 1.0),
        ("residual of track over the first pick's, other picks", [one.ratio for one in moves if not one.same], 1.0),
        ("residual of carry over the first pick's", [one.carried for one in moves], 1.0),
        ("encode, seconds", [one.encode for one in moves], 1.0),
        ("carry, seconds", [one.carry for one in moves], 1.0),
        ("track, seconds", [one.track for one in moves], 1.0),
    ):
        if values:
            spread = ", ".join(f"{scale * value:.3f}" for value in np.percentile(values, (0, 10, 50, 90, 100)))
            lines.append(f"- {words} (0, 10, 50, 90, 100 %): {spread}")
    return "\n".join(lines)


def _timed(call: Callable[[], Any]) -> tuple[float, Any]:
    """Seconds of a call, and its result."""
    began = time.perf_counter()
    result = jax.block_until_ready(call())
    return time.perf_counter() - began, result


def main(arguments: Sequence[str] | None = None) -> None:
    """Measure all moves, and print the report.

    Args:
        arguments: words of the command line; by default those of the process.
    """
    parser = study_parser(
        "tdf_jax.evaluation.tracking_study", __doc__, "moves", 100, "number of moves", "the objects and motions"
    )
    parser.add_argument("--angle", type=float, default=30.0, help="largest angle, degrees (default: 30)")
    parser.add_argument("--distance", type=float, default=0.05, help="largest distance, metres (default: 0.05)")
    parser.add_argument("--clouds", choices=CONDITIONS, default="full", help="condition of the clouds (default: full)")
    parser.add_argument("--out", type=Path, required=True, help="folder that keeps what is measured")
    settings = parser.parse_args(arguments)
    if not 0 <= settings.angle <= 180 or not 0 <= settings.distance < np.inf:
        parser.error("--angle must be from 0 to 180, and --distance at least 0")
    config = TrackConfig()
    try:
        settings.out.mkdir(parents=True, exist_ok=True)
        models = {category: load_model(category) for category in CATEGORIES}
        about = [settings.clouds, settings.seed, settings.angle, settings.distance]
        moves = []
        for number in tqdm(range(settings.moves), desc="moves"):
            category = CATEGORIES[number % len(CATEGORIES)]
            move = kept(
                "tracking_study",
                settings.out,
                ["tracking", FORMAT, fingerprint(models[category]), repr(config), category, *about, number],
                lambda category=category, number=number: measure(
                    models[category], category, settings.clouds, settings.seed, number,
                    settings.angle, settings.distance, config,
                )._asdict(),
                lambda arrays: Move(*(arrays[name].item() for name in Move._fields)),
            )  # fmt: skip
            moves.append(move)
    except (InputError, OSError) as error:
        parser.error(str(error))
    print(report(moves))


if __name__ == "__main__":
    main()
