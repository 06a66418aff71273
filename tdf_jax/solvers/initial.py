"""Initial poses of the solvers: checked or random, and the goal they end at."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from tdf_jax._internal import checks, devices
from tdf_jax._internal.errors import InputError
from tdf_jax.energy.losses import EnergyWeights
from tdf_jax.energy.reference import Reference
from tdf_jax.geometry import se3
from tdf_jax.geometry.trajectory import Trajectory, check_trajectory
from tdf_jax.networks.field import DescriptorField

STARTS = ("carried", "scattered")


def prepare(
    function: str,
    field: DescriptorField,
    reference: Reference,
    key: PRNGKeyArray,
    goal: Float[Array | np.ndarray, "7"] | None,
    fix_last: bool,
    energy: EnergyWeights,
    config,
    starts: Float[Array | np.ndarray, "starts poses 7"] | None,
    device_mesh: jax.sharding.Mesh | None,
    num_starts: int,
) -> tuple[Float[Array | np.ndarray, "starts poses 7"], EnergyWeights]:
    """Check or draw the starts, end them at the goal if there is one, and give the weights the type of the starts.

    Args:
        function: name that begins the messages.
        field: see `optimize`.
        reference: see `optimize`.
        key: see `optimize`.
        goal: see `optimize`.
        fix_last: see `optimize`.
        energy: see `optimize`.
        config: settings with the fields `start` and `start_radius`.
        starts: see `optimize`.
        device_mesh: see `optimize`.
        num_starts: number of random starts, if none are given.

    Returns:
        Initial trajectories, T_world_query, in numpy unless they are traced, and the weights.

    Raises:
        InputError: as for `optimize`.
    """
    if not isinstance(energy, EnergyWeights):
        raise InputError(
            f"{function}: energy is {energy!r}; expected EnergyWeights, such as EnergyWeights(correlation=0.02)"
        )
    devices.check_device_mesh(function, device_mesh)
    if fix_last and reference.trajectory.num_poses == 1:
        raise InputError(f"{function}: the trajectory has one pose and fix_last keeps it; expected fix_last=False")
    check_channels(function, field, reference)
    if starts is None:
        checks.key(function, key)
        goal = default_goal(field, reference) if goal is None and fix_last else goal
        starts = random_starts(key, field, reference, num_starts, config.start, config.start_radius)
    if goal is not None:
        checks.pose(function, "goal", goal)
    given = starts if checks.traced(starts) else np.asarray(starts)
    if given.ndim != 3 or given.shape[1:] != (reference.trajectory.num_poses, 7):
        raise InputError(
            f"{function}: starts have shape {given.shape}; expected (starts, {reference.trajectory.num_poses}, 7), "
            "as many poses as the demonstration has"
        )
    # Every traced number gets one type. Mixed types promote, and a weight of 0 instead of 0.02 would compile again.
    dtype = jnp.result_type(given, reference.query, reference.descriptors, field.latent)
    _check_weights(function, energy)
    energy = jax.tree.map(lambda weight: jnp.asarray(weight, dtype), energy)
    if checks.traced(given, goal):
        if not checks.traced(given) and given.shape[1] > 1:  # the last poses give way to the goal
            _check_poses(given[:, :-1])
        initial = jnp.asarray(given, dtype)
        return initial if goal is None else initial.at[:, -1].set(jnp.asarray(goal, dtype)), energy
    initial = np.array(given, dtype)
    if goal is not None:
        initial[:, -1] = goal
    _check_poses(initial)
    return initial, energy


def check_channels(function: str, field: DescriptorField, reference: Reference) -> None:
    """Raise InputError unless field and reference have descriptors of as many channels."""
    channels = field.conditioned.config.channels
    if reference.descriptors.shape[-1] != channels:
        raise InputError(
            f"{function}: the reference has {reference.descriptors.shape[-1]} channels and the field {channels}; "
            "expected both from the same model"
        )


def _check_poses(starts):
    check_trajectory(Trajectory(starts.reshape(-1, 7)), "starts", anywhere=True)


def default_goal(field: DescriptorField, reference: Reference) -> Float[Array, "7"]:
    """The demonstration's last pose, moved from the demonstration's centroid to the field's origin, T_world_query."""
    return reference.trajectory.shifted(field.origin).wxyz_xyz[-1]


def _check_weights(function, energy):
    # The check is here and not in the constructor: a gradient with respect to the weights is an EnergyWeights too, and
    # may be negative.
    for name in ("correlation", "compensator", "rotation_scale"):
        checks.number(function, f"energy.{name}", getattr(energy, name), least=0)


def random_starts(
    key: PRNGKeyArray, field: DescriptorField, reference: Reference, num_starts: int, start: str, radius: float
) -> Float[Array, "starts poses 7"]:
    """Draw initial trajectories; start m is a function of the key and m alone.

    Args:
        key: random key.
        field: field of the new object; trajectories are drawn about its origin.
        reference: the demonstration.
        num_starts: number of starts.
        start: see `OptimizeConfig`.
        radius: `start_radius` of `OptimizeConfig`, metres.

    Returns:
        Trajectories, T_world_query, metres.
    """
    return _random_starts(key, field.origin, reference, radius, num_starts=num_starts, start=start)


@functools.partial(devices.quickly_compiled, static_argnames=("num_starts", "start"))
def _random_starts(key, origin, reference, radius, *, num_starts, start):
    def draw(m):
        return _start(jax.random.fold_in(key, m), origin, reference, start, radius)

    return jax.vmap(draw)(jnp.arange(num_starts))


def _start(key, origin, reference, start, radius):
    n, dtype = reference.trajectory.num_poses, reference.trajectory.wxyz_xyz.dtype
    rotation_key, direction_key, distance_key = jax.random.split(key, 3)
    if start == "carried":
        rotation = se3.uniform_rotations(rotation_key, 1)[0].astype(dtype)
        return reference.trajectory.transformed(se3.pose(rotation, origin)).wxyz_xyz
    # The offset is uniform in the ball. `jax.random.ball` would be slow to compile.
    direction = jax.random.normal(direction_key, (n, 3), dtype)
    distance = radius * jnp.cbrt(jax.random.uniform(distance_key, (n, 1), dtype))
    offset = distance * direction / jnp.linalg.norm(direction, axis=-1, keepdims=True)
    R = se3.uniform_rotations(rotation_key, n).astype(dtype)
    centroid = jnp.mean(reference.query, axis=0)
    return se3.pose(R, origin + offset - se3.rotate(R, centroid[None])[:, 0])
