"""The reference that an imitation is compared with: the descriptors of one or several demonstrations."""

import dataclasses
import functools
from collections.abc import Iterable

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from tdf_jax._internal import checks
from tdf_jax._internal.boundary import public
from tdf_jax._internal.errors import InputError
from tdf_jax.energy.descriptors import trajectory_descriptor
from tdf_jax.energy.residual import surface_logits
from tdf_jax.energy.seating import touch_distance
from tdf_jax.geometry import se3
from tdf_jax.geometry.demonstration import Demonstration
from tdf_jax.geometry.target import Target
from tdf_jax.geometry.trajectory import Trajectory
from tdf_jax.geometry.transport import arrival_of
from tdf_jax.networks.encoding import encode
from tdf_jax.networks.model import Model, ModelInfo

COMBINATIONS = ("mean", "median")


@functools.partial(
    jax.tree_util.register_dataclass,
    data_fields=[
        "query",
        "object_descriptors",
        "target_descriptors",
        "T_object_contact",
        "T_target_contact",
        "T_world_contact",
        "target_points",
        "down",
        "touch",
        "arrival",
        "outward",
        "depth",
        "target_logits",
    ],
    meta_fields=["num_targets", "target_info"],
)
@dataclasses.dataclass(frozen=True)
class Contact:
    """Descriptors and poses of the region where object and target of a demonstration meet.

    Attributes:
        query: contact points, (queries, 3), metres, contact frame.
        object_descriptors: descriptors of the region in the object's field, (queries, channels).
        target_descriptors: descriptors of the region in the target's field, (queries, channels); None if the target
            was not encoded, because it has not moved.
        T_object_contact: pose of the contact frame on the object before the grasp, relative to the centroid of its
            cloud, axes of the world, `wxyz_xyz`, (7,).
        T_target_contact: pose of the contact frame relative to the centroid of the target's cloud, (7,).
        T_world_contact: pose of the contact frame at the release, world frame, (7,).
        target_points: cloud of the demonstrated target, world frame, (target_points, 3).
        down: unit vector down (world -z) at the release, contact frame, (3,).
        touch: how far down the demonstrated object touches its target from its pose at the release, metres, see
            `tdf_jax.energy.seating`; the median of several demonstrations. Infinite if it does not touch from above,
            or is not known.
        arrival: length of the first demonstration's path before the release on which the object is near its target,
            metres, see `tdf_jax.geometry.transport.Arrival`.
        outward: direction from the released object to where its arrival begins, contact frame, (3,).
        depth: how far the released object has to go back along it until its target is behind it, metres.
        target_logits: mean logit of the occupancy at the points of the demonstrated target, and mean absolute logit,
            (2,), see `tdf_jax.energy.residual.surface_logits`; infinite unless one network describes object and target.
        num_targets: number of different targets of the demonstrations, or of places of one; traced ones count as
            different. Where the target has not moved, it is known only if this is 1.
        target_info: origin of the network that described the target; None if the target was not encoded.
    """

    query: Float[Array, "queries 3"]
    object_descriptors: Float[Array, "queries channels"]
    target_descriptors: Float[Array, "queries channels"] | None
    T_object_contact: Float[Array, "7"]
    T_target_contact: Float[Array, "7"] | None
    T_world_contact: Float[Array, "7"]
    target_points: Float[Array, "target_points 3"]
    down: Float[Array, "3"]
    touch: Float[Array, ""]
    arrival: Float[Array, ""]
    outward: Float[Array, "3"]
    depth: Float[Array, ""]
    target_logits: Float[Array, "2"]
    num_targets: int
    target_info: ModelInfo | None


def _no_poses() -> Array:
    return jnp.zeros((0, 7))


@functools.partial(
    jax.tree_util.register_dataclass,
    data_fields=["descriptors", "trajectory", "query", "approach", "retreat", "contact"],
    meta_fields=[],
)
@dataclasses.dataclass(frozen=True)
class Reference:
    """Descriptors and poses of one or several demonstrations.

    Attributes:
        descriptors: phi of the demonstration, or the mean or median over demonstrations, (poses, queries, channels).
        trajectory: poses T_object_query of the first demonstration from the grasp to the release, metres; the object
            frame has its origin at the centroid of the demonstrated cloud and the axes of the world.
        query: query points, (queries, 3), metres, query frame.
        approach: poses T_object_query before the grasp, (before, 7), `wxyz_xyz`; usually none.
        retreat: poses T_object_query after the release, (after, 7); usually none.
        contact: region where object and target meet; None if the demonstrations have no target.
    """

    descriptors: Float[Array, "poses queries channels"]
    trajectory: Trajectory
    query: Float[Array, "queries 3"]
    approach: Float[Array, "before 7"] = dataclasses.field(default_factory=_no_poses)
    retreat: Float[Array, "after 7"] = dataclasses.field(default_factory=_no_poses)
    contact: Contact | None = None


@public
def describe(
    model: Model,
    demonstrations: Demonstration | Iterable[Demonstration],
    combine: str = "mean",
    *,
    target_model: Model | None = None,
) -> Reference:
    """Encode one or several demonstrations.

    Args:
        model: network that encodes the demonstrated objects.
        demonstrations: one demonstration, or several with the same query points and number of poses from the grasp to
            the release. The poses before and after are those of the first.
        combine: how the descriptors of several demonstrations are combined, channel by channel: "mean", as in NDF, or
            "median", which minimises the sum of absolute differences of eq. 2 (docs/results/benchmark.md compares
            them).
        target_model: network that encodes the targets of the demonstrations: `model` itself if it knows their category;
            None leaves them out, which is enough for a target that has not moved. `imitate` and `relate` take the same
            one, and warn where it is `model` and probably does not know their category.

    Returns:
        The reference.

    Raises:
        InputError: there is no demonstration, an argument is not a `Demonstration`, demonstrations differ in query
            points, contact points or number of poses, some have a target and some have none, or `combine` is unknown.
    """
    checks.choice("describe()", "combine", combine, COMBINATIONS)
    demonstrations = list(demonstrations) if isinstance(demonstrations, Iterable) else [demonstrations]
    kinds = sorted({type(demo).__name__ for demo in demonstrations})
    if kinds != ["Demonstration"]:
        raise InputError(f"describe(): got {', '.join(kinds) or 'nothing'}; expected one or more of tdf.Demonstration")
    first = demonstrations[0]
    for other in demonstrations[1:]:
        if other.transfer.num_poses != first.transfer.num_poses or not np.array_equal(other.query, first.query):
            raise InputError(
                "describe(): demonstrations differ in their query points or number of poses from the grasp to the "
                "release; expected the same. Use one set of query points, and demonstration.resampled(num_poses)"
            )
    query = jnp.asarray(first.query)
    fields = [encode(model, demo.points) for demo in demonstrations]
    several = [_describe(field, demo.transfer, query) for field, demo in zip(fields, demonstrations)]
    descriptors = _combined(several, combine)
    transfer, approach, retreat = (
        _relative(part.wxyz_xyz, fields[0].origin) for part in (first.transfer, first.approach, first.retreat)
    )
    contact = _contact(demonstrations, fields, model, target_model, combine)
    return Reference(descriptors, Trajectory(transfer), query, approach, retreat, contact)


def _contact(demonstrations, fields, model, target_model, combine) -> Contact | None:
    """The region where object and target meet, in the fields of both."""
    targets = [demo.target for demo in demonstrations]
    if all(target is None for target in targets):
        return None
    first = targets[0]
    for other in targets:
        if first is None or other is None or not np.array_equal(other.query, first.query):
            raise InputError(
                "describe(): demonstrations differ in their contact points, or some have no target; expected one set "
                "of contact points in the contact frame, and a target in each"
            )
    query = jnp.asarray(first.query)
    seen = [
        _describe(field, Trajectory(demo.T_object_contact[None]), query)[0]
        for demo, field in zip(demonstrations, fields, strict=True)
    ]
    on_object = _relative(demonstrations[0].T_object_contact[None], fields[0].origin)[0]
    described = on_target = None
    target_fields = [None] * len(targets)
    if target_model is not None:
        target_fields = [encode(target_model, target.points) for target in targets]
        described = _combined(
            [
                _describe(field, Trajectory(jnp.asarray(target.T_world_contact)[None]), query)[0]
                for field, target in zip(target_fields, targets, strict=True)
            ],
            combine,
        )
        on_target = _relative(np.asarray(first.T_world_contact)[None], target_fields[0].origin)[0]
    T_world_contact = jnp.asarray(first.T_world_contact, on_object.dtype)
    arrival = arrival_of(demonstrations[0])
    return Contact(
        query=query,
        object_descriptors=_combined(seen, combine),
        target_descriptors=described,
        T_object_contact=on_object,
        T_target_contact=on_target,
        T_world_contact=T_world_contact,
        target_points=jnp.asarray(first.points, on_object.dtype),
        down=-se3.rotation(T_world_contact)[2],
        touch=jnp.asarray(_touch(demonstrations, fields, target_fields), on_object.dtype),
        arrival=jnp.asarray(arrival.length, on_object.dtype),
        outward=jnp.asarray(arrival.outward, on_object.dtype) @ se3.rotation(T_world_contact),
        depth=jnp.asarray(arrival.depth, on_object.dtype),
        target_logits=jnp.asarray(_target_logits(targets, target_fields, model, target_model), on_object.dtype),
        num_targets=_num_different(targets),
        target_info=None if target_model is None else target_model.info,
    )


def _target_logits(targets, fields, model: Model, target_model: Model | None) -> Float[np.ndarray, "2"]:
    """See `Contact`; infinite if the targets are traced, or what describes them."""
    known = not checks.in_trace(*jax.tree.leaves([fields, [target.points for target in targets]]))
    if target_model is None or not known or target_model.info != model.info:
        return np.full(2, np.inf)
    logits = [surface_logits(field, target.points) for field, target in zip(fields, targets, strict=True)]
    return np.mean([(one.mean(), np.abs(one).mean()) for one in logits], axis=0)


def _num_different(targets: list[Target]) -> int:
    different = []
    for target in targets:
        if not any(_is_same(target, other) for other in different):
            different.append(target)
    return len(different)


def _is_same(one: Target, other: Target) -> bool:
    """Whether two targets are one at one place."""
    if one is other:
        return True
    if checks.traced(one.points, one.T_world_contact, other.points, other.T_world_contact):
        return False
    return np.array_equal(one.points, other.points) and np.allclose(one.T_world_contact, other.T_world_contact)


def _touch(demonstrations, fields, target_fields) -> float:
    """How far down the demonstrated objects touch their targets, the median; infinite if one does not or is traced."""
    scenes = list(zip(demonstrations, fields, target_fields, strict=True))
    for demo, *fields_of_both in scenes:
        values = demo.points, demo.trajectory.wxyz_xyz, demo.target.points, demo.target.T_world_contact, fields_of_both
        if checks.traced(*jax.tree.leaves(values)):
            return np.inf
    down = np.array([0.0, 0.0, -1.0])
    distances = [
        touch_distance(field, target, demo.points, demo.target.points, demo.object_motion, down)
        for demo, field, target in scenes
    ]
    # Not NaN, which a caller who looks for NaN (jax_debug_nans) would take for an error.
    return float(np.nan_to_num(np.median(distances), nan=np.inf))


def _combined(several: list[Array], combine: str) -> Array:
    if combine == "mean":
        return sum(several[1:], several[0]) / len(several)
    return jnp.median(jnp.stack(several), axis=0)


def _relative(wxyz_xyz, origin) -> Array:
    """Poses relative to an origin; the difference is taken in float64 where the numbers are known."""
    if checks.traced(wxyz_xyz, origin):
        return Trajectory(jnp.asarray(wxyz_xyz)).shifted(-origin).wxyz_xyz
    poses = np.asarray(wxyz_xyz)
    offset = np.concatenate([np.zeros(4), np.asarray(origin, np.float64)])
    return jnp.asarray((poses - offset).astype(jax.dtypes.canonicalize_dtype(poses.dtype)))


_describe = jax.jit(trajectory_descriptor)
