"""`optimize`: Adam on SO(3) x R^3, many random starts in one compiled program.

The energy is a mean over poses, so (starts x poses) are one list of independent poses. The list is evaluated in chunks,
and each chunk yields its losses and six-number gradients before the next begins. So memory does not grow with the
number of starts, and at most `chunk_poses` x queries descriptors exist at a time.
"""

import dataclasses
import functools
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Float, PRNGKeyArray

from tdf_jax._internal import checks, devices
from tdf_jax._internal.boundary import host
from tdf_jax._internal.deprecation import renamed_fields, renamed_keywords
from tdf_jax.energy.losses import EnergyWeights, pose_energy, waypoint_loss
from tdf_jax.energy.reference import Reference
from tdf_jax.geometry import se3
from tdf_jax.networks.field import DescriptorField
from tdf_jax.solvers.initial import STARTS, prepare
from tdf_jax.solvers.result import Result, with_ends

# 512 descriptors of 2049 numbers are 4 MB, which are meant to stay in cache. Other sizes were not compared.
CHUNK_POINTS = 512
BLOCK = 20  # iterations of one compiled call; progress and cancellation happen between calls


@renamed_fields(inits="num_starts", chunk="chunk_poses")
@dataclasses.dataclass(frozen=True)
class OptimizeConfig:
    """Settings of `optimize`.

    Attributes:
        num_starts: number of random starts, M in the paper.
        iterations: number of Adam steps; the paper takes 100.
        rotation_rate: first step size of Adam for rotations, radians. With NDF's 0.01 and 100 steps, most starts would
            end before they reach the target (docs/results/code_notes.md#solversadam).
        translation_rate: first step size of Adam for translations, metres.
        final_rate: ratio of the last step size to the first; the rates decay as a cosine.
        start: distribution of the starts. "carried" rotates the whole demonstrated trajectory about the object's
            centroid, by one uniform rotation a start. "scattered" draws each pose on its own, as the paper does: a
            uniform rotation, and a position uniform in a ball of `start_radius` about the centroid.
        start_radius: radius of the ball of "scattered", metres.
        chunk_poses: number of poses that are evaluated at a time; None chooses. It changes speed and memory, not the
            result.

    Raises:
        InputError: a setting is out of its range.
    """

    num_starts: int = 10
    iterations: int = 100
    rotation_rate: float = 0.1
    translation_rate: float = 0.01
    final_rate: float = 0.05
    start: str = "carried"
    start_radius: float = 0.1
    chunk_poses: int | None = None

    def __post_init__(self):
        function = "OptimizeConfig()"
        checks.count(function, "num_starts", self.num_starts)
        checks.count(function, "iterations", self.iterations)
        if self.chunk_poses is not None:
            checks.count(function, "chunk_poses", self.chunk_poses)
        for name in ("rotation_rate", "translation_rate", "final_rate", "start_radius"):
            checks.positive(function, name, getattr(self, name))
        checks.choice(function, "start", self.start, STARTS)

    @property
    def num_steps(self) -> int:
        """Number of steps, which is `iterations`."""
        return self.iterations


@host
@renamed_keywords(mesh="device_mesh")
def optimize(
    field: DescriptorField,
    reference: Reference,
    key: PRNGKeyArray,
    *,
    goal: Float[Array | np.ndarray, "7"] | None = None,
    fix_last: bool = True,
    energy: EnergyWeights = EnergyWeights(),
    config: OptimizeConfig = OptimizeConfig(),
    starts: Float[Array | np.ndarray, "starts poses 7"] | None = None,
    progress: Callable[[int, Float[np.ndarray, " starts"]], None] | None = None,
    device_mesh: jax.sharding.Mesh | None = None,
) -> Result:
    """Minimise `trajectory_energy` from many starts.

    Each pose rotates about the centroid of the query points, so that a rotation does not move them away. Results are
    poses of the query frame all the same. Start m is a function of the key and m.

    Args:
        field: descriptor field of the new object.
        reference: the demonstration.
        key: random key of the starts.
        goal: pose of every start at the release, (7,), T_world_query; by default, with `fix_last`, the demonstration's,
            moved by the centroids.
        fix_last: keep the last pose at the goal. Otherwise it is free, and starts at the goal or, without one, at
            random like the others.
        energy: weights of the energy's terms.
        config: settings.
        starts: initial trajectories from the grasp to the release that replace the random ones, (starts, poses, 7),
            T_world_query. A goal that is given replaces their last poses.
        progress: function that is called between blocks of iterations with the number of iterations so far and the
            energies. It may raise to cancel.
        device_mesh: devices that share the starts, of this process or of several that make the same call.

    Returns:
        The result; its candidates are all starts, in their order.

    Raises:
        InputError: starts, goal, weights or device mesh of a wrong shape, type or value, a reference from another
            network than the field, or a single pose that is fixed.
    """
    checked, energy = prepare(
        "optimize()", field, reference, key, goal, fix_last, energy, config, starts, device_mesh, config.num_starts
    )
    num_starts, dtype, demonstrated = len(checked), checked.dtype, reference
    initial = jnp.asarray(checked)
    count = config.chunk_poses or max(1, devices.points_at_a_time(CHUNK_POINTS) // len(reference.query))
    program = functools.partial(_run, fix_last=fix_last, chunk=count, device_mesh=device_mesh)
    rates = np.array([config.rotation_rate, config.translation_rate, config.final_rate, config.iterations], dtype)
    if device_mesh is not None:
        initial = devices.placed(devices.padded(checked, device_mesh), device_mesh, devices.sharded(device_mesh))
        field, reference, energy, rates = devices.placed((field, reference, energy, rates), device_mesh)
    state = _begin(initial, reference.query)
    losses = []
    for done in range(0, config.iterations, BLOCK):
        steps = min(BLOCK, config.iterations - done)
        state, block = program(state, initial, field, reference, energy, rates, steps)
        losses.append(block[:, :steps])
        if progress is not None:
            progress(done + steps, devices.gathered(block)[:num_starts, steps - 1])
    trajectories = _trajectories(state, initial, reference.query, fix_last=fix_last)
    # An extra step evaluates the final energies; its update is discarded.
    _, block = program(state, initial, field, reference, energy, rates, 1)
    history = jnp.concatenate(losses, axis=1)
    result = Result(trajectories, block[:, 0], history, initial, history)
    if device_mesh is None:
        return with_ends(result, reference)
    # Fields that are unknown or empty are numpy arrays of this process.
    result = jax.tree.map(
        lambda part: part if isinstance(part, np.ndarray) else jnp.asarray(devices.gathered(part)[:num_starts]), result
    )
    return with_ends(result, demonstrated)


@jax.jit
def _begin(starts, query):
    """Initial state of the optimiser: the variables, Adam's moments and the number of steps.

    The variables are rotation vectors relative to the starts, and positions of the query points' centroid.
    """
    centroids = se3.transform(starts, jnp.mean(query, axis=0)[None])[..., 0, :]
    variables = (jnp.zeros_like(centroids), centroids)
    return variables, optax.scale_by_adam().init(variables), jnp.zeros((), jnp.int32)


def _poses(variables, start_rotations, query):
    """Rotations and translations (of the query frame's origin) of the variables."""
    rotation_vector, centroid = variables
    R = se3.multiply(se3.exp(rotation_vector), start_rotations)
    return R, centroid - se3.rotate(R, jnp.mean(query, axis=0)[None])[..., 0, :]


@functools.partial(jax.jit, static_argnames=("fix_last", "chunk", "device_mesh"), donate_argnums=0)
def _run(state, starts, field, reference, energy, rates, steps, *, fix_last, chunk, device_mesh=None):
    work = functools.partial(_steps, fix_last=fix_last, chunk=chunk)
    if device_mesh is not None:
        split, whole = devices.sharded(device_mesh), devices.REPLICATED
        states = split, optax.ScaleByAdamState(count=whole, mu=split, nu=split), whole  # pyright: ignore[reportArgumentType]
        work = jax.shard_map(
            work, mesh=device_mesh, in_specs=(states, split, *[whole] * 5), out_specs=(states, split), check_vma=False
        )
    return work(state, starts, field, reference, energy, rates, steps)


def _steps(state, starts, field, reference, energy, rates, steps, *, fix_last, chunk):
    evaluate = _evaluator(starts, field, reference, energy, fix_last, chunk)
    rotation_rate, translation_rate, final_rate, iterations = rates

    def step(i, carry):
        (variables, adam, done), losses = carry
        energies, gradient = evaluate(variables)
        direction, adam = optax.scale_by_adam().update(gradient, adam)
        cosine = 0.5 * (1 + jnp.cos(jnp.pi * done / iterations))
        decay = final_rate + (1 - final_rate) * cosine
        rate = (rotation_rate * decay, translation_rate * decay)
        variables = jax.tree.map(lambda x, r, d: x - r * d, variables, rate, direction)
        return (variables, adam, done + 1), losses.at[:, i].set(energies)

    # The number of steps is traced, so the last, shorter block runs the same program.
    return jax.lax.fori_loop(0, steps, step, (state, jnp.zeros((len(starts), BLOCK), starts.dtype)))


@functools.partial(jax.jit, static_argnames="fix_last")
def _trajectories(state, starts, query, *, fix_last):
    wxyz_xyz = se3.pose(*_poses(state[0], se3.rotation(starts), query))
    return wxyz_xyz.at[:, -1].set(starts[:, -1]) if fix_last else wxyz_xyz


def _evaluator(starts, field, reference, energy, fix_last, chunk):
    """Function from variables to every start's energy and its gradient with respect to the variables.

    Equal to `jax.vmap(jax.value_and_grad(trajectory_energy))`, but a chunk of poses at a time. A fixed last pose is
    evaluated once a call, not in every step, and has gradient zero.
    """
    num_starts, n = starts.shape[:2]
    free = n - 1 if fix_last else n
    query = reference.query

    def waypoint(variables, start_rotation, descriptors):
        R, t = _poses(variables, start_rotation, query)
        return waypoint_loss(R, t, field, query, descriptors)

    def indexed(pose):
        variables, start_rotation, index = pose
        return jax.value_and_grad(waypoint)(variables, start_rotation, reference.descriptors[index])

    start_rotations = se3.rotation(starts)
    fixed = 0.0
    if fix_last:
        last = start_rotations[:, -1], starts[:, -1, 4:]  # given starts may end apart
        fixed = jax.lax.map(lambda pose: waypoint_loss(pose[0], pose[1], field, query, reference.descriptors[-1]), last)

    def flat(x):
        return x[:, :free].reshape(num_starts * free, *x.shape[2:])

    def unflat(gradient):
        gradient = gradient.reshape(num_starts, free, 3) / n
        return jnp.concatenate([gradient, jnp.zeros((num_starts, n - free, 3), gradient.dtype)], axis=1)

    def rest(variables, start_rotation):
        return pose_energy(*_poses(variables, start_rotation, query), field.origin, reference, energy)

    def evaluate(variables):
        indices = jnp.tile(jnp.arange(free), num_starts)
        inputs = (jax.tree.map(flat, variables), flat(start_rotations), indices)
        # Single poses are mapped without a batch axis, because a batch of one is slower.
        losses, gradient = jax.lax.map(indexed, inputs, batch_size=chunk if chunk > 1 else None)
        remaining, remaining_gradient = jax.vmap(jax.value_and_grad(rest))(variables, start_rotations)
        mask = (jnp.arange(n) < free)[:, None]
        gradient = jax.tree.map(lambda a, b: unflat(a) + jnp.where(mask, b, 0.0), gradient, remaining_gradient)
        return (losses.reshape(num_starts, free).sum(axis=1) + fixed) / n + remaining, gradient

    return evaluate
