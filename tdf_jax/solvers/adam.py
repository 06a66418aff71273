"""Trajectory optimisation: Adam on SO(3) x R^3, many random starts in one compiled program.

The energy is a mean over poses, so (starts x poses) are one list of independent poses. It is walked in chunks, each
giving its losses and six-number gradients before the next begins: memory does not grow with the number of starts, and
no more than `chunk` x queries descriptors exist at a time.
"""

import dataclasses
import functools
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Float, PRNGKeyArray

from tdf_jax._internal import devices
from tdf_jax._internal.errors import InputError
from tdf_jax.energy.losses import EnergyWeights, pose_energy, waypoint_loss
from tdf_jax.energy.reference import Reference
from tdf_jax.geometry import se3
from tdf_jax.networks.field import DescriptorField
from tdf_jax.solvers.initial import STARTS, prepare
from tdf_jax.solvers.result import Result

# 512 descriptors of 2049 numbers are 4 MB, meant to stay in cache; other sizes were not compared.
CHUNK_POINTS = 512
BLOCK = 20  # iterations of one compiled call: progress and cancellation happen between calls


@dataclasses.dataclass(frozen=True)
class OptimizeConfig:
    """Settings of the optimiser.

    Attributes:
        inits: random starts, M.
        iterations: Adam steps; the paper uses 100.
        rotation_rate: Adam's first step size for rotations, radians. The nearest of 10 uniform rotations is 62 degrees
            from a target on average: 100 steps of NDF's 0.01 would not take it there.
        translation_rate: the same for translations, metres.
        final_rate: last step size over the first; the rates fall as a cosine.
        start: "carried" turns the whole demonstrated trajectory about the object's centroid, by one uniform rotation a
            start; "scattered" draws each pose on its own, as the paper does: a uniform rotation, and a place uniform in
            a ball of `start_radius` about the centroid.
        start_radius: metres, for "scattered".
        chunk: poses evaluated at a time; None chooses. Changes speed and memory, not the result.
    """

    inits: int = 10
    iterations: int = 100
    rotation_rate: float = 0.1
    translation_rate: float = 0.01
    final_rate: float = 0.05
    start: str = "carried"
    start_radius: float = 0.1
    chunk: int | None = None

    def __post_init__(self):
        for name in ("inits", "iterations", "chunk"):
            value = getattr(self, name)
            if value is None and name == "chunk":
                continue
            if not isinstance(value, int | np.integer) or isinstance(value, bool) or value < 1:
                raise InputError(f"OptimizeConfig(): {name} is {value!r}; expected a whole number of at least 1")
        for name in ("rotation_rate", "translation_rate", "final_rate", "start_radius"):
            if not 0 < getattr(self, name) < np.inf:
                raise InputError(f"OptimizeConfig(): {name} is {getattr(self, name)}; expected a positive number")
        if self.start not in STARTS:
            raise InputError(f"OptimizeConfig(): start is {self.start!r}; expected one of {', '.join(STARTS)}")


def optimize(
    field: DescriptorField,
    reference: Reference,
    key: PRNGKeyArray,
    *,
    goal: Float[Array, "7"] | None = None,
    fix_last: bool = True,
    energy: EnergyWeights = EnergyWeights(),
    config: OptimizeConfig = OptimizeConfig(),
    starts: Float[Array, "inits poses 7"] | None = None,
    progress: Callable[[int, Float[np.ndarray, " inits"]], None] | None = None,
    mesh: jax.sharding.Mesh | None = None,
) -> Result:
    """Minimise `trajectory_energy` from many starts.

    Each pose turns about the mean of the query points, so that turning does not move them away; results are about the
    query frame's origin all the same. Start m is a function of the key and m.

    Args:
        field: the new object's.
        reference: the demonstration's.
        key: random key of the starts.
        goal: last pose of every start, T_world_query; by default, if it is kept, the demonstration's, carried by the
            centroids.
        fix_last: keep the last pose at the goal; otherwise it is free, and starts at the goal or, without one, at
            random as the others.
        energy: weights of the terms.
        config: settings.
        starts: use these instead of random ones; their last poses are replaced by the goal only where one is given.
        progress: called between blocks of iterations with the iterations done and the energies; may raise to cancel.
        mesh: devices to share the starts, of this process or of several that make the same call; see docs/guide/scaling.md.

    Returns:
        All starts' results.

    Raises:
        InputError: starts, goal, weights or mesh of a wrong shape, type or value, a reference from another network than
            the field, or nothing to move: one pose, and that kept.
    """
    starts, energy = prepare("optimize()", field, reference, key, goal, fix_last, energy, config, starts, mesh)
    inits, dtype = len(starts), starts.dtype
    starts = jnp.asarray(starts)
    count = config.chunk or max(1, devices.points_at_a_time(CHUNK_POINTS) // len(reference.query))
    program = functools.partial(_run, fix_last=fix_last, chunk=count, mesh=mesh)
    rates = np.array([config.rotation_rate, config.translation_rate, config.final_rate, config.iterations], dtype)
    if mesh is not None:
        starts = devices.placed(devices.padded(starts, mesh), mesh, devices.sharded(mesh))
        field, reference, energy, rates = devices.placed((field, reference, energy, rates), mesh)
    state = _begin(starts, reference.query)
    losses = []
    for done in range(0, config.iterations, BLOCK):
        steps = min(BLOCK, config.iterations - done)
        state, block = program(state, starts, field, reference, energy, rates, steps)
        losses.append(block[:, :steps])
        if progress is not None:
            progress(done + steps, devices.gathered(block)[:inits, steps - 1])
    trajectories = _trajectories(state, starts, reference.query, fix_last=fix_last)
    # One more step, not kept: the energies after the last one, by the program that is compiled already.
    _, block = program(state, starts, field, reference, energy, rates, 1)
    result = Result(trajectories, jnp.concatenate(losses, axis=1), block[:, 0], starts)
    return result if mesh is None else jax.tree.map(lambda part: jnp.asarray(devices.gathered(part)[:inits]), result)


@jax.jit
def _begin(starts, query):
    """The optimiser's state: the variables (rotation vectors away from the starts, places of the query centroid), Adam's moments, steps done."""
    places = se3.transform(starts, jnp.mean(query, axis=0)[None])[..., 0, :]
    variables = (jnp.zeros_like(places), places)
    return variables, optax.scale_by_adam().init(variables), jnp.zeros((), jnp.int32)


def _poses(variables, start_rotations, query):
    """Rotations and translations (of the query frame's origin) of the variables."""
    turn, place = variables
    R = se3.multiply(se3.exp(turn), start_rotations)
    return R, place - se3.rotate(R, jnp.mean(query, axis=0)[None])[..., 0, :]


@functools.partial(jax.jit, static_argnames=("fix_last", "chunk", "mesh"), donate_argnums=0)
def _run(state, starts, field, reference, energy, rates, steps, *, fix_last, chunk, mesh=None):
    work = functools.partial(_steps, fix_last=fix_last, chunk=chunk)
    if mesh is not None:
        split, whole = devices.sharded(mesh), devices.REPLICATED
        states = split, optax.ScaleByAdamState(whole, split, split), whole
        work = jax.shard_map(
            work, mesh=mesh, in_specs=(states, split, *[whole] * 5), out_specs=(states, split), check_vma=False
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
    inits, n = starts.shape[:2]
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
        fixed = jax.lax.map(lambda pose: waypoint_loss(*pose, field, query, reference.descriptors[-1]), last)

    def flat(x):
        return x[:, :free].reshape(inits * free, *x.shape[2:])

    def unflat(gradient):
        gradient = gradient.reshape(inits, free, 3) / n
        return jnp.concatenate([gradient, jnp.zeros((inits, n - free, 3), gradient.dtype)], axis=1)

    def rest(variables, start_rotation):
        return pose_energy(*_poses(variables, start_rotation, query), field.origin, reference, energy)

    def evaluate(variables):
        indices = jnp.tile(jnp.arange(free), inits)
        inputs = (jax.tree.map(flat, variables), flat(start_rotations), indices)
        # One pose at a time is mapped plainly: a batch of one took 15 ms a pose of 500 query points instead of 8.5.
        losses, gradient = jax.lax.map(indexed, inputs, batch_size=chunk if chunk > 1 else None)
        remaining, remaining_gradient = jax.vmap(jax.value_and_grad(rest))(variables, start_rotations)
        mask = (jnp.arange(n) < free)[:, None]
        gradient = jax.tree.map(lambda a, b: unflat(a) + jnp.where(mask, b, 0.0), gradient, remaining_gradient)
        return (losses.reshape(inits, free).sum(axis=1) + fixed) / n + remaining, gradient

    return evaluate
