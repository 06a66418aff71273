"""Derivatives of picks beside picks that are found again, on generated objects.

On every pair of objects `carry` finds the pick, and `differentiable_pick` gives its derivatives in float32, as users
compute them. The same pick is found again in float64 after a finite change both ways: of the cloud, whose points are
those of one farthest-point subsample; of the latent; of the query points with their descriptors held; and of the box of
query points, which is then described again on the demonstrated object. Half the difference, divided by the step, is
what the derivative is compared with, as twists of six numbers in which a rotation counts as the distance by which it
moves the query points. Free directions are projected out of both. What is measured is kept in a folder, so that an
interrupted run goes on.

    python -m tdf_jax.evaluation.sensitivity_study --pairs 20 --seed 7711 --out derivatives
"""

import argparse
import dataclasses
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation
from tqdm.auto import tqdm

from tdf_jax._internal.cache import kept
from tdf_jax._internal.errors import InputError, TdfWarning
from tdf_jax.energy.descriptors import pose_descriptor
from tdf_jax.energy.losses import EnergyWeights
from tdf_jax.energy.reference import Reference
from tdf_jax.evaluation.cases import QUERIES, QUERY_SIZE, SEED_SPACE, generated_case, place_demonstration
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
from tdf_jax.solvers import gauss_newton
from tdf_jax.solvers.pick import CarryConfig, carry
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
# A minimum is looked for, be it the right one or not.
SEARCH = CarryConfig(num_starts=16, num_candidates=1)
STEPS, TOLERANCE, DAMPING = 60, 1e-9, 1e-3  # of the solver that finds picks again, which ends within a micrometre


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
    clouds = [thin(np.asarray(cloud), model.info.cloud_points) for cloud in (demo.points, case.points_b)]
    fields = [encode(model, cloud, 0, clean=False) for cloud in clouds]
    rng = np.random.default_rng([SEED_SPACE, seed, number, 13])
    axis, towards = rng.normal(size=3), rng.normal(size=fields[1].latent.shape)
    towards *= np.linalg.norm(fields[1].latent) / np.linalg.norm(towards)
    arrays = *clouds, query, demo.trajectory.wxyz_xyz[0], axis / np.linalg.norm(axis), towards
    return _Scene(model, *(np.asarray(part, np.float32) for part in arrays), *fields)


def _in_float64(scene: _Scene) -> _Scene:
    """The same pair; the caller enables float64."""
    model, *arrays = scene[:7]
    params = jax.tree.map(lambda leaf: jnp.asarray(leaf, jnp.float64), model.params)
    model = dataclasses.replace(model, params=params)
    arrays = [part.astype(np.float64) for part in arrays]
    return _Scene(model, *arrays, *(encode(model, cloud, 0, clean=False) for cloud in arrays[:2]))


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
        pick = carry(field, reference, jax.random.key(number), fix_last=False, config=SEARCH).pick
        status = differentiable_pick(field, reference, pick)
        predicted = [
            jax.jvp(
                lambda amount, change=change: differentiable_pick(*scene.changed(change, amount), pick).pose,
                (jnp.float32(0.0),),
                (jnp.float32(1.0),),
            )
            for change in CHANGES
        ]
        with jax.enable_x64(True):
            scene = _in_float64(scene)
            base = _found(pick, *scene.changed("", 0.0))
            found = [_secant(scene, change, base, centre, scale) for change in CHANGES]
            again = [
                _secant(scene, change, base, centre, scale, 1 / 3) if change in REPEATED else np.zeros(6)
                for change in CHANGES
            ]
    free = np.asarray(status.directions, float)[: int(status.num_free)] * ([1.0] * 3 + [1 / scale] * 3)
    return Pair(
        category=category,
        predicted=np.array([_velocity(*map(np.asarray, pair), centre, scale) for pair in predicted]),
        found=np.array(found),
        again=np.array(again),
        free=free,
        offset=float(status.offset),
    )


@jax.jit
def _solved(pick, field, reference):
    count = len(reference.query)
    problem = gauss_newton.in_blocks(reference, np.arange(count)[None], np.ones((1, count), bool))
    bounds = np.array([1, 1, 1, STEPS], np.int32)
    R, centroid, _ = gauss_newton.descend(
        se3.rotation(pick)[None], se3.transform(pick, problem.centre[None]), jnp.zeros(1, jnp.int32), bounds,
        jnp.asarray(DAMPING, pick.dtype), jnp.asarray(TOLERANCE, pick.dtype), field, problem,
        jax.tree.map(lambda weight: jnp.asarray(weight, pick.dtype), EnergyWeights(0.0)),
        length=STEPS + 1, chunk=count,
    )  # fmt: skip
    return se3.pose(R, centroid - se3.rotate(R, problem.centre[None])[:, 0])[0]


def _found(pick, field: DescriptorField, reference: Reference) -> Float[np.ndarray, "7"]:
    """The minimum near a pick, in float64."""
    return np.asarray(_solved(jnp.asarray(pick, jnp.float64), field, reference))


def _secant(scene: _Scene, change: str, base, centre, scale: float, share: float = 1.0) -> Float[np.ndarray, "6"]:
    """Motion of the pick over a change both ways by a share of its step, for a change of 1."""
    step = share * CHANGES[change]
    ends = [_found(base, *scene.changed(change, sign * step)) for sign in (1.0, -1.0)]
    return (_twist(base, ends[0], centre, scale) - _twist(base, ends[1], centre, scale)) / (2 * step)


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


def _spread(errors: Sequence[float]) -> list[str]:
    return [percent(float(value)) for value in np.percentile(errors, (50, 90, 100))]


def main(arguments: Sequence[str] | None = None) -> None:
    """Measure all pairs, and print the report.

    Args:
        arguments: words of the command line; by default those of the process.
    """
    parser = argparse.ArgumentParser(
        prog="python -m tdf_jax.evaluation.sensitivity_study", description=(__doc__ or "").splitlines()[0]
    )
    parser.add_argument("--pairs", type=int, default=20, help="number of pairs (default: 20)")
    parser.add_argument("--seed", type=int, default=0, help="seed of the pairs (default: 0)")
    parser.add_argument("--out", type=Path, required=True, help="folder that keeps what is measured")
    settings = parser.parse_args(arguments)
    if settings.pairs < 1 or settings.seed < 0:
        parser.error("--pairs must be at least 1, and --seed at least 0")
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
                lambda arrays: Pair(
                    **{field.name: arrays[field.name] for field in dataclasses.fields(Pair)}
                    | {"category": arrays["category"].item(), "offset": arrays["offset"].item()}
                ),
            )
            pairs.append(pair)
    except (InputError, OSError) as error:
        parser.error(str(error))
    print(report(pairs))


if __name__ == "__main__":
    main()
