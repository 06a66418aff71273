"""Derivatives of picks beside picks that are found again, on generated objects.

On every pair of objects `carry` finds the pick, and `differentiable_pick` gives its derivatives in float32, as users
compute them. The same pick is found again in float64 after a finite change both ways: of the cloud, whose points are
those of one farthest-point subsample; of the latent; of the query points with their descriptors held; and of the box of
query points, which is then described again on the demonstrated object. Half the difference, divided by the step, is
what the derivative is compared with, as twists of six numbers in which a rotation counts as the distance by which it
moves the query points. Free directions are projected out of the derivatives, and held where picks are found again:
along them a pick may slide far, as about the axis of a bowl. What is measured is kept in a folder, so that an
interrupted run goes on.

    python -m tdf_jax.evaluation.sensitivity_study --pairs 20 --seed 7711 --out derivatives
"""

import dataclasses
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import scipy.optimize
from jaxtyping import Float
from scipy.spatial.transform import Rotation
from tqdm.auto import tqdm

from tdf_jax._internal.cache import kept
from tdf_jax._internal.errors import InputError, TdfWarning
from tdf_jax.energy.descriptors import pose_descriptor
from tdf_jax.energy.losses import waypoint_loss
from tdf_jax.energy.reference import Reference
from tdf_jax.evaluation.cases import QUERIES, QUERY_SIZE, SEED_SPACE, generated_case, place_demonstration
from tdf_jax.evaluation.study_command import study_parser
from tdf_jax.evaluation.tables import markdown, percent
from tdf_jax.geometry import se3
from tdf_jax.geometry.query import box_query
from tdf_jax.geometry.sampling import thin
from tdf_jax.geometry.trajectory import Trajectory
from tdf_jax.networks.checkpoint import load_model
from tdf_jax.networks.encoding import encode
from tdf_jax.networks.field import DescriptorField
from tdf_jax.networks.model import Model, fingerprint
from tdf_jax.networks.occupancy import condition
from tdf_jax.solvers.pick import carry
from tdf_jax.solvers.sensitivity import differentiable_pick

FORMAT = 1  # format number; raise it when the pairs or what is measured change
CATEGORIES = ("mug", "bowl", "bottle")  # in turn
# What changes, and the step: metres of a box that is moved, and shares of the others.
CHANGES = {
    "cloud stretched": 0.02,
    "latent": 0.02,
    "query points stretched": 0.05,
    "box moved": 2e-3,
    "box scaled": 0.05,
}
# Changes that are made again by a third of the step, which says whether the pick moves in proportion.
REPEATED = ("box moved",)
TOLERANCE = 1e-6  # metres, of picks that are found again


@dataclasses.dataclass(frozen=True)
class Pair:
    """What was measured of one pair, for all changes in the order of `CHANGES`.

    Attributes:
        category: category of the objects.
        predicted: derivatives by `differentiable_pick`, as twists, (changes, 6), metres for a change of 1.
        found: the same from picks that are found again.
        again: the same from a third of the step, zero where it is not `REPEATED`.
        free: free directions, orthonormal, (num_free, 6).
        offset: length of the next step from the pick towards its minimum, metres.
    """

    category: str
    predicted: Float[np.ndarray, "changes 6"]
    found: Float[np.ndarray, "changes 6"]
    again: Float[np.ndarray, "changes 6"]
    free: Float[np.ndarray, "num_free 6"]
    offset: float

    def error(self, name: str, by: str = "predicted") -> float:
        """Relative error of the derivative by one change, without free directions: norm of the difference from `found`.

        Args:
            name: what changes.
            by: what is compared, `predicted` or `again`.
        """
        row = list(CHANGES).index(name)
        determined = np.eye(6) - self.free.T @ self.free
        value, found = (part[row] @ determined for part in (getattr(self, by), self.found))
        return float(np.linalg.norm(value - found) / np.linalg.norm(found))


class _Scene(NamedTuple):
    """One pair, and the directions of its changes; all numbers are of one precision."""

    model: Model
    points_a: Float[np.ndarray, "points 3"]
    points_b: Float[np.ndarray, "points 3"]
    query: Float[np.ndarray, "queries 3"]
    pick: Float[np.ndarray, "7"]  # of the demonstration on the first object
    axis: Float[np.ndarray, "3"]
    towards: Float[np.ndarray, "latent 3"]  # of the length of the latent
    field_a: DescriptorField
    field: DescriptorField

    def changed(self, name: str, amount) -> tuple[DescriptorField, Reference]:
        """Field and reference after a change."""
        query, field = jnp.asarray(self.query), self.field
        if name == "cloud stretched":
            points = _stretched(jnp.asarray(self.points_b), self.axis, amount)
            field = encode(self.model, points, 0, clean=False)
        elif name == "latent":
            latent = field.latent + amount * self.towards
            field = DescriptorField(condition(self.model.params, self.model.config, latent), field.origin)
        elif name == "box moved":
            query = query + amount * self.axis
        elif name == "box scaled":
            query = query + amount * (query - jnp.mean(query, axis=0))
        descriptors = pose_descriptor(self.field_a, jnp.asarray(self.pick), query)
        if name == "query points stretched":
            query = _stretched(query, self.axis, amount)
        return field, Reference(descriptors[None], Trajectory(jnp.asarray(self.pick)[None]), query)


def _stretched(points, axis, amount):
    """Points that are stretched by a share along an axis through their mean."""
    along = (points - jnp.mean(points, axis=0)) @ axis
    return points + amount * along[:, None] * axis


def _scene(model: Model, category: str, seed: int, number: int) -> _Scene:
    """The pair of a number, in float32."""
    case = generated_case(category, seed, number)
    query = box_query(jax.random.key(seed), QUERIES, QUERY_SIZE * case.scale)
    demo = place_demonstration(case, "line", 2, query)
    clouds = [thin(np.asarray(cloud), model.info.cloud_points or len(cloud)) for cloud in (demo.points, case.points_b)]
    fields = [encode(model, cloud, 0, clean=False) for cloud in clouds]
    rng = np.random.default_rng([SEED_SPACE, seed, number, 13])
    axis, towards = rng.normal(size=3), rng.normal(size=fields[1].latent.shape)
    towards *= np.linalg.norm(fields[1].latent) / np.linalg.norm(towards)
    return _Scene(
        model=model,
        points_a=clouds[0],
        points_b=clouds[1],
        query=np.asarray(query),
        pick=np.asarray(demo.trajectory.wxyz_xyz[0]),
        axis=(axis / np.linalg.norm(axis)).astype(np.float32),
        towards=towards.astype(np.float32),
        field_a=fields[0],
        field=fields[1],
    )


def _in_float64(scene: _Scene) -> _Scene:
    """The same pair; the caller enables float64."""
    params = jax.tree.map(lambda leaf: jnp.asarray(leaf, jnp.float64), scene.model.params)
    model = dataclasses.replace(scene.model, params=params)
    clouds = [cloud.astype(np.float64) for cloud in (scene.points_a, scene.points_b)]
    fields = [encode(model, cloud, 0, clean=False) for cloud in clouds]
    return _Scene(
        model=model,
        points_a=clouds[0],
        points_b=clouds[1],
        query=scene.query.astype(np.float64),
        pick=scene.pick.astype(np.float64),
        axis=scene.axis.astype(np.float64),
        towards=scene.towards.astype(np.float64),
        field_a=fields[0],
        field=fields[1],
    )


def measure(model: Model, category: str, seed: int, number: int) -> Pair:
    """Measure the derivatives of the pick of one pair.

    Args:
        model: the network.
        category: category of the objects.
        seed: seed of the pairs.
        number: number of the pair.
    """
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", TdfWarning)
        scene = _scene(model, category, seed, number)
        centre = scene.query.mean(axis=0, dtype=float)
        scale = np.sqrt(((scene.query - centre) ** 2).sum(axis=1).mean())
        field, reference = scene.changed("", 0.0)
        pick = carry(field, reference, jax.random.key(number), fix_last=False).pick
        status = differentiable_pick(field, reference, pick)
        predicted = [
            jax.jvp(
                lambda amount, change=change: differentiable_pick(*scene.changed(change, amount), pick).pose,
                (jnp.float32(0.0),),
                (jnp.float32(1.0),),
            )
            for change in CHANGES
        ]
        axes = np.asarray(status.directions, float) * ([1.0] * 3 + [1 / scale] * 3)
        free, determined = np.split(axes, [int(status.num_free)])
        softness = 1 / np.sqrt(np.asarray(status.curvatures, float)[len(free) :])
        # Twists of steps that raise the energy about equally.
        steps = softness[:, None] * determined
        with jax.enable_x64(True):
            scene = _in_float64(scene)
            base = _found(np.asarray(pick, float), *scene.changed("", 0.0), steps, scale)

            def secant(change, share=1.0):
                step = share * CHANGES[change]
                plus, minus = (
                    _twist(base, _found(base, *scene.changed(change, sign * step), steps, scale), centre, scale)
                    for sign in (1.0, -1.0)
                )
                return (plus - minus) / (2 * step)

            found = [secant(change) for change in CHANGES]
            again = [secant(change, 1 / 3) if change in REPEATED else np.zeros(6) for change in CHANGES]
    return Pair(
        category=category,
        predicted=np.array(
            [_velocity(np.asarray(pose), np.asarray(change), centre, scale) for pose, change in predicted]
        ),
        found=np.array(found),
        again=np.array(again),
        free=free,
        offset=float(status.offset),
    )


@jax.jit
def _energy(amounts, pick, steps, scale, field, reference):
    """The energy after steps from a pick, and its gradient."""

    def energy(amounts):
        twist, centre = amounts @ steps, jnp.mean(reference.query, axis=0)
        R = se3.multiply(se3.exp(twist[None, :3] / scale), se3.rotation(pick)[None])[0]
        centroid = se3.transform(pick, centre[None])[0] + twist[3:]
        pose = se3.pose(R, centroid - se3.rotate(R, centre[None])[0])
        return waypoint_loss(R, se3.translation(pose), field, reference.query, reference.descriptors[0]), pose

    (value, pose), slope = jax.value_and_grad(energy, has_aux=True)(amounts)
    return value, slope, pose


def _found(pick, field: DescriptorField, reference: Reference, steps, scale: float) -> Float[np.ndarray, "7"]:
    """The minimum near a pick along some directions, in float64, by BFGS (Nocedal and Wright, 2006, chapter 6)."""

    def energy(amounts):
        value, slope, _ = _energy(amounts, pick, steps, scale, field, reference)
        return float(value) / unit, np.asarray(slope) / unit

    # Steps of a centimetre and their rise make the numbers of the minimiser about one.
    steps, unit, start = 0.01 * steps, 1.0, np.zeros(len(steps))
    unit = energy(start)[0]
    options = {"gtol": TOLERANCE / 0.01, "maxiter": 100}
    amounts = scipy.optimize.minimize(energy, start, jac=True, method="BFGS", options=options).x
    return np.asarray(_energy(amounts, pick, steps, scale, field, reference)[2])


def _twist(begin, end, centre, scale: float) -> Float[np.ndarray, "6"]:
    """Motion from one pose to another: rotation times its scale, and translation of the query points' centre."""
    R, R_end = (Rotation.from_quat(pose[:4], scalar_first=True) for pose in (begin, end))
    translation = R_end.apply(centre) + end[4:] - R.apply(centre) - begin[4:]
    return np.concatenate([scale * (R_end * R.inv()).as_rotvec(), translation])


def _velocity(pose, change, centre, scale: float) -> Float[np.ndarray, "6"]:
    """The same of a derivative of a pose."""
    small = 1e-6
    end = pose.astype(float) + small * change.astype(float)
    return _twist(pose.astype(float), end, centre, scale) / small


def report(pairs: Sequence[Pair]) -> str:
    """Errors of the derivatives, as Markdown.

    Args:
        pairs: what was measured.
    """
    rows = []
    for row, (name, step) in enumerate(CHANGES.items()):
        unit = f"{1e3 * step:g} mm" if name == "box moved" else percent(step)
        motion = 1e3 * step * np.median([np.linalg.norm(pair.found[row]) for pair in pairs])
        errors = _spread([pair.error(name) for pair in pairs])
        again = _spread([pair.error(name, "again") for pair in pairs]) if name in REPEATED else ["", "", ""]
        rows.append([name, unit, f"{motion:.2f} mm", *errors, again[0]])
    free = [len(pair.free) for pair in pairs]
    head = [
        "change",
        "step",
        "the pick moves by",
        "error, median",
        "90 %",
        "largest",
        "found by a third of the step, median",
    ]
    counts = ", ".join(f"{count} in {free.count(count)} pairs" for count in sorted(set(free)))
    offsets = ", ".join(f"{1e3 * value:.2f}" for value in np.percentile([pair.offset for pair in pairs], (50, 90, 100)))
    return "\n".join(
        [markdown(head, rows), "", f"- free directions: {counts}", f"- offset, mm (50, 90, 100 %): {offsets}"]
    )


def _pair(arrays: dict[str, np.ndarray]) -> Pair:
    """What is kept of a pair."""
    measured = (arrays[name] for name in ("predicted", "found", "again", "free"))
    return Pair(str(arrays["category"]), *measured, offset=float(arrays["offset"]))


def _spread(errors: Sequence[float]) -> list[str]:
    return [percent(float(value)) for value in np.percentile(errors, (50, 90, 100))]


def main(arguments: Sequence[str] | None = None) -> None:
    """Measure all pairs, and print the report.

    Args:
        arguments: words of the command line; by default those of the process.
    """
    parser = study_parser("tdf_jax.evaluation.sensitivity_study", __doc__, "pairs", 20, "number of pairs", "the pairs")
    parser.add_argument("--out", type=Path, required=True, help="folder that keeps what is measured")
    settings = parser.parse_args(arguments)
    try:
        settings.out.mkdir(parents=True, exist_ok=True)
        models = {category: load_model(category) for category in CATEGORIES[: settings.pairs]}
        pairs = []
        for number in tqdm(range(settings.pairs), desc="pairs"):
            category = CATEGORIES[number % len(CATEGORIES)]
            pair = kept(
                "sensitivity_study",
                settings.out,
                ["sensitivity", FORMAT, fingerprint(models[category]), CHANGES, category, settings.seed, number],
                lambda category=category, number=number: dataclasses.asdict(
                    measure(models[category], category, settings.seed, number)
                ),
                _pair,
            )
            pairs.append(pair)
    except (InputError, OSError) as error:
        parser.error(str(error))
    print(report(pairs))


if __name__ == "__main__":
    main()
