"""Damped Gauss-Newton steps on single poses, each of which matches one waypoint.

A step solves (H + damping diag(H)) delta = -gradient for each pose. The gradient is the energy's own; H is that of the
absolute values replaced by r^2 / (2 max(|r|, s)), with s the mean |r| of the query point: iteratively reweighted least
squares, made less steep near zero.

A pose whose next step promises hardly anything leaves: the steps of the others cost less then.
"""

import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from tdf_jax._internal import devices
from tdf_jax._internal.precision import full_precision
from tdf_jax.energy.losses import pose_difference
from tdf_jax.energy.reference import Reference
from tdf_jax.geometry import se3
from tdf_jax.networks.occupancy import NORM_FLOOR, decode

LARGEST_ROTATION, LARGEST_TRANSLATION = 0.7, 0.05  # bounds of one step, radians and metres
DAMPINGS = 1e-3, 1e3  # bounds of the damping
ACCEPTED, REJECTED = 0.3, 4.0  # factors on the damping after a step
# A pose leaves when its next step promises less than this share of the tolerance. With 0.3, which evaluates a fifth
# fewer poses, energies of picks were 0.03 % higher, and rounding changed them by as much; with 0.01, by 0.001 %.
LEAVES = 0.01
# Metres. The curvature of eq. 3's norm grows without bound towards zero, so no smaller difference enters it.
LEAST_DIFFERENCE = 1e-4


class Problem(NamedTuple):
    """What the poses match. The query points lie in blocks, of which a stage evaluates the first or all.

    Attributes:
        query: query points relative to their centroid, (blocks, size, 3), metres, query frame.
        weights: 1 for a query point, 0 for padding of the last block, (blocks, size).
        descriptors: descriptors of the demonstration, (waypoints, blocks, size, channels).
        target: waypoints of the reference, (waypoints, 7), `wxyz_xyz`, relative to the object's origin.
        centre: centroid of the query points, (3,), metres, query frame.
    """

    query: Float[Array, "blocks size 3"]
    weights: Float[Array, "blocks size"]
    descriptors: Float[Array, "waypoints blocks size channels"]
    target: Float[Array, "waypoints 7"]
    centre: Float[Array, "3"]


def in_blocks(
    reference: Reference, order: Int[Array | np.ndarray, "blocks size"], counts: Bool[Array | np.ndarray, "blocks size"]
) -> Problem:
    """Arrange the query points of a reference in blocks.

    Args:
        reference: the demonstration.
        order: indices of the query points, (blocks, size).
        counts: False for padding of the last block, (blocks, size).

    Returns:
        The problem.
    """
    query, descriptors = reference.query, reference.descriptors
    centre = jnp.mean(query, axis=0)
    return Problem(
        query=(query - centre)[order],
        weights=jnp.asarray(counts, query.dtype),
        descriptors=descriptors[:, order],
        target=reference.trajectory.wxyz_xyz,
        centre=centre,
    )


class _State(NamedTuple):
    """Independent poses, their energies, and the quadratic models of these.

    `gradient` and `hessian` are with respect to a rotation about the query points' centroid, applied on the left, and a
    translation.
    """

    R: Float[Array, "poses 3 3"]
    centroid: Float[Array, "poses 3"]
    energy: Float[Array, " poses"]
    gradient: Float[Array, "poses 6"]
    hessian: Float[Array, "poses 6 6"]


@functools.partial(jax.jit, static_argnames=("length", "chunk", "device_mesh"))
def descend(
    R, centroid, waypoint, bounds, damping, tolerance, field, problem, energy, *, length, chunk, device_mesh=None
):
    """Take damped Gauss-Newton steps until no pose promises to gain more than the tolerance.

    A pose that promises less than `LEAVES` of the tolerance takes no further step, and after half of the steps only the
    best ones go on.

    Args:
        R: rotations of the query frame in the world, (poses, 3, 3).
        centroid: positions of the query points' centroid, (poses, 3), metres, world frame.
        waypoint: index of the waypoint that each pose matches, (poses,).
        bounds: number of poses that move, number of poses that are evaluated, number of blocks of query points,
            maximal number of steps, and number of poses that go on after half of them, (5,).
        damping: damping of the first step.
        tolerance: share of a pose's energy that its next step has to promise; the loop ends when no pose promises it.
        field: descriptor field of the new object.
        problem: the demonstration, in blocks of query points.
        energy: weights of the energy's terms.
        length: number of entries of a history.
        chunk: number of query points that are evaluated at a time.
        device_mesh: devices that share the poses, dealt out in turn.

    Returns:
        R, centroid, and energies at the start and after each step, (poses, length); steps that were not taken repeat
        the last energy.
    """
    work = functools.partial(
        _steps, length=length, chunk=chunk, axes=device_mesh.axis_names if device_mesh is not None else ()
    )
    if device_mesh is not None:
        split = devices.sharded(device_mesh)
        work = jax.shard_map(
            work, mesh=device_mesh, in_specs=(*[split] * 3, *[devices.REPLICATED] * 6), out_specs=split, check_vma=False
        )
    return work(R, centroid, waypoint, bounds, damping, tolerance, field, problem, energy)


@full_precision
def _steps(R, centroid, waypoint, bounds, damping, tolerance, field, problem, energy, *, length, chunk, axes):
    """`descend` on one device; `axes` names the axes of the device mesh."""
    if axes:
        parts, part = jax.lax.axis_size(axes), jax.lax.axis_index(axes)
        # Poses assigned to this device.
        bounds = bounds.at[:2].set((bounds[:2] - part + parts - 1) // parts)
    moving, evaluated, blocks, steps, kept = bounds
    moves = jnp.arange(len(R)) < moving

    def rank(energy):
        """How many poses that move have a lower energy, on all devices."""
        every = jnp.where(moves, energy, jnp.inf)
        every = jax.lax.all_gather(every, axes, tiled=True) if axes else every
        return jnp.sum(every < energy[:, None], axis=1)

    def body(carry):
        i, state, damping, step, going, _, history = carry
        R, centroid = se3.multiply(se3.exp(step[:, :3]), state.R), state.centroid + step[:, 3:]
        # A pose that does not move is evaluated once.
        some = jnp.where(i == 0, jnp.arange(len(R)) < evaluated, going)
        trial = _State(R, centroid, *_evaluate(R, centroid, waypoint, some, blocks, field, problem, energy, chunk))
        # Energies of the initial state are infinite, so the first step accepts every finite energy.
        better = some & (trial.energy < state.energy)
        state = jax.tree.map(lambda a, b: jnp.where(better.reshape(-1, *[1] * (a.ndim - 1)), a, b), trial, state)
        factor = jnp.where(i == 0, 1.0, jnp.where(better, ACCEPTED, REJECTED))
        damping = jnp.clip(damping * factor, *DAMPINGS)
        step, promise = _step(state, damping)
        going = going & (promise > LEAVES * tolerance * state.energy)
        going = going & ((i < (steps + 1) // 2) | (rank(state.energy) < kept))
        hopeful = jnp.any(going & (promise > tolerance * state.energy))
        hopeful = jax.lax.pmax(hopeful.astype(jnp.int32), axes) > 0 if axes else hopeful
        history = jnp.where(jnp.arange(length) >= i, state.energy[:, None], history)
        return i + 1, state, damping, jnp.where(going[:, None], step, 0.0), going, hopeful, history

    count, dtype = len(R), R.dtype
    values = (
        jnp.full(count, jnp.inf, dtype),
        jnp.zeros((count, 6), dtype),
        jnp.broadcast_to(jnp.eye(6, dtype=dtype), (count, 6, 6)),
    )
    begin = _State(R, centroid, *values), jnp.full(count, damping, dtype), jnp.zeros((count, 6), dtype)
    carry = (jnp.int32(0), *begin, moves, jnp.bool_(True), jnp.zeros((count, length), dtype))
    _, state, *_, history = jax.lax.while_loop(lambda carry: (carry[0] <= steps) & carry[5], body, carry)
    return state.R, state.centroid, history


def _step(state, damping):
    """The next step of every pose, (poses, 6), and by how much its quadratic model falls."""
    diagonal = jnp.diagonal(state.hessian, axis1=1, axis2=2)
    # Far from the object a field is flat: the floor keeps the system solvable.
    damped = state.hessian + (damping[:, None] * diagonal + 1e-9)[:, :, None] * jnp.eye(6, dtype=diagonal.dtype)
    step = -_solved(damped, state.gradient)
    rotation, translation = (jnp.linalg.norm(part, axis=-1) for part in (step[:, :3], step[:, 3:]))
    longest = jnp.maximum(jnp.maximum(rotation / LARGEST_ROTATION, translation / LARGEST_TRANSLATION), 1.0)
    step = step / longest[:, None]
    curved = jnp.sum(step * jnp.sum(state.hessian * step[:, None], axis=-1), axis=-1)
    return step, -jnp.sum(state.gradient * step, axis=-1) - curved / 2


def _solved(matrix, right):
    """Solutions of positive definite systems (poses, 6, 6), by elimination; no pivots are needed."""

    def eliminate(k, system):
        row = system[:, k] / system[:, k, k][:, None]
        return (system - system[:, :, k, None] * row[:, None]).at[:, k].set(row)

    return jax.lax.fori_loop(0, 6, eliminate, jnp.concatenate([matrix, right[..., None]], axis=-1))[..., -1]


def _evaluate(R, centroid, waypoint, some, blocks, field, problem, energy, chunk):
    """Energies of the poses `some`, a mask, and their quadratic models: (poses,), (poses, 6), (poses, 6, 6).

    What is evaluated at a time are pairs of a pose and a block of query points: few poses with many blocks fill a chunk
    as well as many poses with one.
    """
    every, size = problem.weights.shape
    count, last = min(max(1, chunk // size), len(R) * every), jnp.sum(some) * blocks
    order = jnp.argsort(~some)  # those to evaluate come first
    counted = jnp.arange(every) < blocks
    used = jnp.sum(jnp.where(counted, jnp.sum(problem.weights, axis=1), 0.0))

    def evaluated(j, values):
        pair = j * count + jnp.arange(count)
        pose, block = order[jnp.minimum(pair // blocks, len(R) - 1)], pair % blocks
        terms = _match(
            R[pose],
            centroid[pose],
            field,
            problem.query[block],
            problem.weights[block] / used,
            problem.descriptors[waypoint[pose], block],
        )
        return jax.tree.map(
            lambda whole, part: jax.lax.dynamic_update_slice_in_dim(whole, part, j * count, 0), values, terms
        )

    room = -(-len(R) * every // count) * count
    values = tuple(jnp.zeros((room, *shape), R.dtype) for shape in ((), (6,), (6, 6)))
    values = jax.lax.fori_loop(0, (last + count - 1) // count, evaluated, values)
    # The pairs of each pose; blocks that do not count read the first pair, and are left out.
    pair = jnp.where(counted, jnp.argsort(order)[:, None] * blocks + jnp.arange(every), 0)

    def summed(part):
        return jnp.sum(jnp.where(counted.reshape(1, -1, *[1] * (part.ndim - 1)), part[pair], 0.0), axis=1)

    prior = jax.vmap(lambda R, centroid, target: _prior(R, centroid, target, field.origin, problem.centre, energy))
    return jax.tree.map(lambda part, more: summed(part) + more, values, prior(R, centroid, problem.target[waypoint]))


def _match(R, centroid, field, query, weights, demonstrated):
    """Weighted sum over query points of the mean absolute difference of descriptors, its gradient and its curvature."""
    arm = se3.rotate(R, query)
    x = (arm + centroid[:, None]).reshape(-1, 3)
    activations, products = _activations_and_derivatives(field, x)
    inverse = 1 / jnp.maximum(jnp.sqrt(products[:, :1]), NORM_FLOOR)
    residual = activations[:, 0] * inverse - demonstrated.reshape(len(x), -1)
    size = jnp.abs(residual)
    mean = jnp.mean(size, axis=-1)
    weights = weights.ravel()
    share = (weights / size.shape[-1])[:, None]
    signed = jnp.einsum("pic,pc->pi", activations, jnp.sign(residual) * share)
    weighted = activations * (share / jnp.maximum(jnp.maximum(size, mean[:, None]), 1e-9))[:, None]
    squares = jnp.einsum("pic,pjc->pij", activations, weighted)
    # The derivative of the descriptor is that of the activations without its part along them, over their length.
    along = products[:, 1:] * inverse**2
    slope = inverse * (signed[:, 1:] - along * signed[:, :1])
    mixed = along[:, :, None] * squares[:, :1, 1:]
    parallel = along[:, :, None] * along[:, None] * squares[:, :1, :1]
    curvature = (squares[:, 1:, 1:] - mixed - mixed.swapaxes(1, 2) + parallel) * inverse[:, :, None] ** 2

    slope, curvature = slope.reshape(*arm.shape[:2], 3), curvature.reshape(*arm.shape[:2], 3, 3)
    # A rotation w moves a point by w x arm, a translation v by v: rows of the jacobian (poses, size, 6, 3).
    identity = jnp.broadcast_to(jnp.eye(3, dtype=x.dtype), curvature.shape)
    jacobian = jnp.concatenate([jnp.cross(identity, arm[..., None, :]), identity], axis=-2)
    gradient = jnp.einsum("pqai,pqi->pa", jacobian, slope)
    hessian = jnp.einsum("pqai,pqbi->pab", jacobian, jacobian @ curvature)
    return jnp.sum((weights * mean).reshape(arm.shape[:2]), axis=1), gradient, hessian


def _activations_and_derivatives(field, x):
    """What descriptors are made of: activations and their derivatives along the axes, (points, 4, channels).

    The products of the activations with all four, (points, 4), come with them. Descriptors have unit length; forming
    them and their derivatives took an eighth of the time of an evaluation.
    """

    def along(axis):
        return jax.jvp(
            lambda x: decode(field.conditioned, x - field.origin)[0], (x,), (jnp.broadcast_to(axis, x.shape),)
        )

    value, tangents = jax.vmap(along, out_axes=(None, 1))(jnp.eye(3, dtype=x.dtype))
    value, tangents = jnp.concatenate(value, axis=-1), jnp.concatenate(tangents, axis=-1)
    both = jnp.concatenate([value[:, None], tangents], axis=1)
    return both, jnp.einsum("pic,pc->pi", both, value)


def _prior(R, centroid, target, origin, centre, energy):
    """One pose's weighted part of eq. 3, its gradient and its model's curvature."""

    def difference(R, centroid):
        return pose_difference(R, centroid - R @ centre, origin, target, energy.rotation_scale, energy.pose_norm)

    # Along a rotation about each axis, which changes R by axis x R, and a translation along each.
    identity, zeros = jnp.eye(3, dtype=R.dtype), jnp.zeros((3, 3), R.dtype)
    rotations = jnp.cross(identity[:, None], R.T[None]).swapaxes(1, 2)
    along = jnp.concatenate([rotations, jnp.zeros_like(rotations)]), jnp.concatenate([zeros, identity])
    value, rows = jax.vmap(lambda *step: jax.jvp(difference, (R, centroid), step), out_axes=(None, 0))(*along)
    if energy.pose_norm == "mean_absolute":
        length, share = jnp.abs(value), energy.correlation / len(value)
        loss = share * jnp.sum(length)
    else:
        length, share = jnp.sqrt(jnp.sum(value * value)), energy.correlation
        loss = share * length
    weighted = rows * (share / jnp.maximum(length, LEAST_DIFFERENCE))
    return loss, weighted @ value, weighted @ rows.T
