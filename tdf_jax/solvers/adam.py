"""Trajectory optimisation: Adam on SO(3) x R^3, many random starts in one compiled program.

The energy is a mean over poses, so (starts x poses) are one list of independent poses. It is walked in chunks, each giving its
losses and six-number gradients before the next begins: memory does not grow with the number of starts, and no more than
`chunk` x queries descriptors exist at a time.
"""

import dataclasses
import functools
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Bool, Float, PRNGKeyArray

from tdf_jax._internal import devices
from tdf_jax.geometry import se3 as poses
from tdf_jax.energy.reference import Reference
from tdf_jax.energy.losses import EnergyWeights, pose_energy, waypoint_loss
from tdf_jax._internal.errors import InputError
from tdf_jax.networks.field import DescriptorField
from tdf_jax._internal.checks import check_key
from tdf_jax.geometry.trajectory import Trajectory, check_trajectory

STARTS = ("carried", "scattered")
# 512 descriptors of 2049 numbers are 4 MB, meant to stay in cache; other sizes were not compared.
CHUNK_POINTS = 512
BLOCK = 20  # iterations of one compiled call: progress and cancellation happen between calls


@dataclasses.dataclass(frozen=True)
class OptimizeConfig:
    """Settings of the optimiser.

    Attributes:
        inits: random starts, M.
        iterations: Adam steps; the paper uses 100.
        rotation_rate: Adam's first step size for rotations, radians. The nearest of 10 uniform rotations is 62 degrees from
            a target on average: 100 steps of NDF's 0.01 would not take it there.
        translation_rate: the same for translations, metres.
        final_rate: last step size over the first; the rates fall as a cosine.
        start: "carried" turns the whole demonstrated trajectory about the object's centroid, by one uniform rotation a start;
            "scattered" draws each pose on its own, as the paper does: a uniform rotation, and a place uniform in a ball
            of `start_radius` about the centroid.
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


@functools.partial(
    jax.tree_util.register_dataclass, data_fields=["trajectories", "losses", "energies", "starts", "residual", "confidence", "recognised"], meta_fields=[]
)
@dataclasses.dataclass(frozen=True)
class Result:
    """What every start came to.

    Attributes:
        trajectories: (inits, poses, 7), `wxyz_xyz`, T_world_query.
        losses: (inits, iterations), the energy before each step; the first column is the start's.
        energies: (inits,), the energy of `trajectories`, after the last step.
        starts: (inits, poses, 7), where they began.
        residual: of `carry`: what the best pick leaves of the demonstration's descriptors, see `tdf_jax.confidence`; None of others.
        confidence: of `carry`: how likely the pick is right, in [0, 1], see there; None of others, and of `imitate` with weights that it is not calibrated for.
        recognised: of `imitate` with shipped weights: how likely the object is of the demonstration's category, in [0, 1], see `tdf_jax.recognition`; None of others.
    """

    trajectories: Float[Array, "inits poses 7"]
    losses: Float[Array, "inits iterations"]
    energies: Float[Array, "inits"]
    starts: Float[Array, "inits poses 7"]
    residual: float | None = None
    confidence: float | None = None
    recognised: float | None = None

    @property
    def finite(self) -> Bool[np.ndarray, "inits"]:
        """Which starts stayed finite."""
        return np.isfinite(self.energies) & np.isfinite(self.trajectories).all(axis=(1, 2))

    @property
    def best(self) -> int:
        """Index of the finite start with the least energy.

        Raises:
            InputError: no start stayed finite.
        """
        if not self.finite.any():
            raise InputError(
                f"Result.best: {self.status}; check the weights and the query points, or, with Adam, lower rotation_rate and translation_rate"
            )
        return int(np.argmin(np.where(self.finite, self.energies, np.inf)))

    @property
    def trajectory(self) -> Trajectory:
        """The best trajectory."""
        return Trajectory(self.trajectories[self.best])

    @property
    def loss(self) -> float:
        """Energy of the best trajectory."""
        return float(self.energies[self.best])

    @property
    def status(self) -> str:
        """How the starts ended, in words."""
        failed = np.flatnonzero(~self.finite)
        if len(failed) == 0:
            return f"all {len(self.energies)} starts finite"
        return f"{len(failed)} of {len(self.energies)} starts became non-finite: {', '.join(map(str, failed))}"


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
    progress: Callable[[int, Float[np.ndarray, "inits"]], None] | None = None,
    mesh: jax.sharding.Mesh | None = None,
) -> Result:
    """Minimise `trajectory_energy` from many starts.

    Each pose turns about the mean of the query points, so that turning does not move them away; results are about the query
    frame's origin all the same. Start m is a function of the key and m.

    Args:
        field: the new object's.
        reference: the demonstration's.
        key: random key of the starts.
        goal: last pose of every start, T_world_query; by default, if it is kept, the demonstration's, carried by the centroids.
        fix_last: keep the last pose at the goal; otherwise it is free, and starts at the goal or, without one, at random as the others.
        energy: weights of the terms.
        config: settings.
        starts: use these instead of random ones; their last poses are replaced by the goal only where one is given.
        progress: called between blocks of iterations with the iterations done and the energies; may raise to cancel.
        mesh: devices to share the starts, of this process or of several that make the same call; see docs/scaling.md.

    Returns:
        All starts' results.

    Raises:
        InputError: starts, goal, weights or mesh of a wrong shape, type or value, a reference from another network than the field, or nothing to
            move: one pose, and that kept.
    """
    starts, energy = prepare("optimize()", field, reference, key, goal, fix_last, energy, config, starts, mesh)
    inits, dtype = len(starts), starts.dtype
    starts = jnp.asarray(starts)
    count = config.chunk or max(1, devices.points_at_a_time(CHUNK_POINTS) // len(reference.query))
    program = functools.partial(_run, fix_last=fix_last, chunk=count, mesh=mesh)
    rates = np.array([config.rotation_rate, config.translation_rate, config.final_rate, config.iterations], dtype)
    if mesh is not None:
        starts = devices.placed(devices.padded(starts, mesh), mesh, devices.split(mesh))
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
        raise InputError(f"{function}: energy is {energy!r}; expected EnergyWeights, such as EnergyWeights(correlation=0.02)")
    devices.check_mesh(function, mesh)
    if fix_last and reference.trajectory.poses == 1:
        raise InputError(f"{function}: the trajectory has one pose and fix_last keeps it; expected fix_last=False")
    channels = field.conditioned.config.channels
    if reference.descriptors.shape[-1] != channels:
        raise InputError(
            f"{function}: the reference has {reference.descriptors.shape[-1]} channels and the field {channels}; "
            "expected both from the same model"
        )
    if starts is None:
        check_key(function, key)
        goal = default_goal(field, reference) if goal is None and fix_last else goal
        starts = random_starts(key, field, reference, config.inits, config.start, config.start_radius)
    if goal is not None:
        check_goal(function, goal)
    starts = np.asarray(starts)
    if starts.ndim != 3 or starts.shape[1:] != (reference.trajectory.poses, 7):
        raise InputError(
            f"{function}: starts have shape {starts.shape}; expected (inits, {reference.trajectory.poses}, 7), "
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
    # Here, not where they are made: a gradient with respect to the weights is an EnergyWeights too, and may be negative.
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


@functools.partial(jax.jit, static_argnames=("inits", "start"), compiler_options=devices.ONCE)
def _random_starts(key, origin, reference, radius, *, inits, start):
    return jax.vmap(lambda m: _start(jax.random.fold_in(key, m), origin, reference, start, radius))(jnp.arange(inits))


def _start(key, origin, reference, start, radius):
    n, dtype = reference.trajectory.poses, reference.trajectory.wxyz_xyz.dtype
    turn_key, way_key, far_key = jax.random.split(key, 3)
    if start == "carried":
        turn = poses.uniform_rotations(turn_key, 1)[0].astype(dtype)
        return reference.trajectory.transformed(poses.pose(turn, origin)).wxyz_xyz
    # Uniform in the ball; `jax.random.ball` takes 2 s to compile.
    way = jax.random.normal(way_key, (n, 3), dtype)
    far = radius * jnp.cbrt(jax.random.uniform(far_key, (n, 1), dtype))
    place = far * way / jnp.linalg.norm(way, axis=-1, keepdims=True)
    R = poses.uniform_rotations(turn_key, n).astype(dtype)
    centre = jnp.mean(reference.query, axis=0)
    return poses.pose(R, origin + place - poses.rotate(R, centre[None])[:, 0])


@jax.jit
def _begin(starts, query):
    """The optimiser's state: the variables (rotation vectors away from the starts, places of the query centroid), Adam's moments, steps done."""
    places = poses.transform(starts, jnp.mean(query, axis=0)[None])[..., 0, :]
    variables = (jnp.zeros_like(places), places)
    return variables, optax.scale_by_adam().init(variables), jnp.zeros((), jnp.int32)


def _poses(variables, start_rotations, query):
    """Rotations and translations (of the query frame's origin) of the variables."""
    turn, place = variables
    R = poses.multiply(poses.exp(turn), start_rotations)
    return R, place - poses.rotate(R, jnp.mean(query, axis=0)[None])[..., 0, :]


@functools.partial(jax.jit, static_argnames=("fix_last", "chunk", "mesh"), donate_argnums=0)
def _run(state, starts, field, reference, energy, rates, steps, *, fix_last, chunk, mesh=None):
    work = functools.partial(_steps, fix_last=fix_last, chunk=chunk)
    if mesh is not None:
        split, whole = devices.split(mesh), devices.WHOLE
        states = split, optax.ScaleByAdamState(whole, split, split), whole
        work = jax.shard_map(work, mesh=mesh, in_specs=(states, split, *[whole] * 5), out_specs=(states, split), check_vma=False)
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
    wxyz_xyz = poses.pose(*_poses(state[0], poses.rotation(starts), query))
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

    start_rotations = poses.rotation(starts)
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
        gradient = jax.tree.map(
            lambda a, b: unflat(a) + jnp.where(mask, b, 0.0), gradient, remaining_gradient
        )
        return (losses.reshape(inits, free).sum(axis=1) + fixed) / n + remaining, gradient

    return evaluate
