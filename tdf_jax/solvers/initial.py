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
    goal: Float[Array, "7"] | None,
    fix_last: bool,
    energy: EnergyWeights,
    config,
    starts: Float[Array, "inits poses 7"] | None,
    mesh: jax.sharding.Mesh | None,
) -> tuple[Float[np.ndarray, "inits poses 7"], EnergyWeights]:
    """Checked starts, which end at the goal if there is one, and weights of the same type; see `optimize`.

    Args:
        function: name for messages.
        config: with `inits`, `start` and `start_radius`.

    Raises:
        InputError: as for `optimize`.
    """
    if not isinstance(energy, EnergyWeights):
        raise InputError(
            f"{function}: energy is {energy!r}; expected EnergyWeights, such as EnergyWeights(correlation=0.02)"
        )
    devices.check_device_mesh(function, mesh)
    if fix_last and reference.trajectory.num_poses == 1:
        raise InputError(f"{function}: the trajectory has one pose and fix_last keeps it; expected fix_last=False")
    channels = field.conditioned.config.channels
    if reference.descriptors.shape[-1] != channels:
        raise InputError(
            f"{function}: the reference has {reference.descriptors.shape[-1]} channels and the field {channels}; "
            "expected both from the same model"
        )
    if starts is None:
        checks.key(function, key)
        goal = default_goal(field, reference) if goal is None and fix_last else goal
        starts = random_starts(key, field, reference, config.inits, config.start, config.start_radius)
    if goal is not None:
        check_goal(function, goal)
    starts = np.asarray(starts)
    if starts.ndim != 3 or starts.shape[1:] != (reference.trajectory.num_poses, 7):
        raise InputError(
            f"{function}: starts have shape {starts.shape}; expected (inits, {reference.trajectory.num_poses}, 7), "
            "as many poses as the demonstration has"
        )
    # One type of every traced number: mixed ones promote, and a weight of 0 for 0.02 would compile again.
    dtype = jnp.result_type(starts, reference.query, reference.descriptors, field.latent)
    _check_weights(function, energy)
    energy = jax.tree.map(lambda weight: jnp.asarray(weight, dtype), energy)
    starts = np.array(starts, dtype)
    if goal is not None:
        starts[:, -1] = goal
    check_trajectory(Trajectory(starts.reshape(-1, 7)), "starts")
    return starts, energy


def default_goal(field: DescriptorField, reference: Reference) -> Float[Array, "7"]:
    """The demonstration's last pose, carried by the centroids."""
    return reference.trajectory.shifted(field.origin).wxyz_xyz[-1]


def _check_weights(function, energy):
    # Here, not where they are made: a gradient with respect to the weights is an EnergyWeights too, and may be
    # negative.
    for name in ("correlation", "compensator", "lever"):
        value = getattr(energy, name)
        if not isinstance(value, jax.core.Tracer) and not (np.ndim(value) == 0 and 0 <= float(value) < np.inf):
            raise InputError(f"{function}: energy.{name} is {value}; expected one finite number of 0 or more")


def check_goal(function: str, goal: Float[Array, "7"]) -> None:
    """Raise InputError unless a goal is one finite pose."""
    values = np.asarray(goal)
    if values.shape != (7,) or not np.isfinite(values).all() or not values[:4].any():
        raise InputError(
            f"{function}: goal of shape {values.shape} is {values}; expected one finite pose wxyz_xyz, (7,), "
            "its quaternion not zero"
        )


def random_starts(
    key: PRNGKeyArray, field: DescriptorField, reference: Reference, inits: int, start: str, radius: float
) -> Float[Array, "inits poses 7"]:
    """Random trajectories in the world; start m depends on the key and m alone. See `OptimizeConfig`."""
    return _random_starts(key, field.origin, reference, radius, inits=inits, start=start)


@functools.partial(jax.jit, static_argnames=("inits", "start"), compiler_options=devices.FAST_COMPILATION)
def _random_starts(key, origin, reference, radius, *, inits, start):
    return jax.vmap(lambda m: _start(jax.random.fold_in(key, m), origin, reference, start, radius))(jnp.arange(inits))


def _start(key, origin, reference, start, radius):
    n, dtype = reference.trajectory.num_poses, reference.trajectory.wxyz_xyz.dtype
    turn_key, way_key, far_key = jax.random.split(key, 3)
    if start == "carried":
        turn = se3.uniform_rotations(turn_key, 1)[0].astype(dtype)
        return reference.trajectory.transformed(se3.pose(turn, origin)).wxyz_xyz
    # Uniform in the ball; `jax.random.ball` takes 2 s to compile.
    way = jax.random.normal(way_key, (n, 3), dtype)
    far = radius * jnp.cbrt(jax.random.uniform(far_key, (n, 1), dtype))
    place = far * way / jnp.linalg.norm(way, axis=-1, keepdims=True)
    R = se3.uniform_rotations(turn_key, n).astype(dtype)
    centre = jnp.mean(reference.query, axis=0)
    return se3.pose(R, origin + place - se3.rotate(R, centre[None])[:, 0])
