"""Clearance of a motion from obstacles, measured on the way as well as at the poses, and trajectories pushed clear of what they would hit.

A body is a set of points fixed in the query frame: the gripper's, those of the object it holds. Between two poses the
query frame's origin goes straight and its rotation along the geodesic.
"""

import functools
from collections.abc import Sequence
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from tdf_jax._internal.errors import InputError
from tdf_jax.geometry import se3
from tdf_jax.geometry.sampling import farthest_point_indices
from tdf_jax.geometry.trajectory import Trajectory
from tdf_jax.planning.distances import (
    ROUNDING,
    STEP,
    Obstacle,
    body_centres,
    distances_and_normals,
    measure,
    motion_samples,
    path_lengths,
    prepare,
)

POINTS = 64  # of the body that a descent looks at: spread evenly, then some of those that were missed
LOOK = 0.01  # metres that a point of the body moves at most between the looks of a descent, along the given path
# Metres aimed at beyond what is required, in the descents one after the other: a detour is longer than the given path,
# and what it keeps at the looks it does not quite keep between them.
SLACK = 0.0015, 0.003, 0.006
BEST = 4  # detours that are measured with the whole body
# Heights of the detours over the chord's length and twice the body's radius, each in all directions around the chord.
HEIGHTS = 0.3, 0.8, 2.0
STIFF = 1e4, 1e6  # weight of what is missing, squared, first and last, over that of the deviation
LONGEST = 0.1  # metres that a pose moves in one step


@dataclass(frozen=True)
class ClearanceConfig:
    """Settings of `push_clear`.

    Attributes:
        lever: metres; a turn of one radian counts as a shift by as much.
        deviation: weight of the deviation itself, over that of its bending (second derivative along the trajectory,
            whose length counts as 1).
        ramp: metres of clearance gained per metre of way from an end that is closer than the margin.
        contact: how deep an end may be inside of an obstacle, metres: what the pick's own contact and the errors of its
            surface come to.
        directions: of the detours that are tried, around the chord.
        iterations: steps of a descent.
    """

    lever: float = 0.1
    deviation: float = 10.0
    ramp: float = 1.0
    contact: float = 0.01
    directions: int = 8
    iterations: int = 40

    def __post_init__(self):
        for name in ("directions", "iterations"):
            value = getattr(self, name)
            if not isinstance(value, int | np.integer) or isinstance(value, bool) or value < 1:
                raise InputError(f"ClearanceConfig(): {name} is {value!r}; expected a whole number of at least 1")
        for name in ("lever", "deviation", "ramp"):
            if not 0 < getattr(self, name) < np.inf:
                raise InputError(f"ClearanceConfig(): {name} is {getattr(self, name)}; expected a positive number")
        if not 0 <= self.contact < np.inf:
            raise InputError(f"ClearanceConfig(): contact is {self.contact}; expected a depth of 0 or more, metres")


@dataclass(frozen=True)
class Cleared:
    """What `push_clear` came to.

    Attributes:
        trajectory: as many poses as were given, the first and last of them the same.
        clearance: least signed distance along it, metres.
        excess: least of what it keeps beyond what is required, metres; negative where it falls short.
        deviation: the farthest that the middle of the body was moved at a pose, metres.
        clear: whether it keeps what is required everywhere, and no end is deeper in an obstacle than contacts are.
        status: the same in words, with a remedy where it is not clear.
    """

    trajectory: Trajectory
    clearance: float
    excess: float
    deviation: float
    clear: bool
    status: str


def push_clear(
    trajectory: Trajectory,
    body: Float[Array, "points 3"],
    obstacles: Sequence[Obstacle],
    *,
    margin: float = 0.01,
    config: ClearanceConfig = ClearanceConfig(),
) -> Cleared:
    """Push a trajectory clear of obstacles, at its poses and between them; both end poses stay as they are.

    What is required is the margin, from each obstacle; near an end that is closer to it than that, what the end keeps
    plus the way from there (`ramp`). A trajectory that keeps it already comes back as it is. Otherwise the smoothest
    small deviation (shifts, and turns about the middle of the body) that keeps it is sought from the given path and
    from detours to all sides of it: the other side of a wall is another minimum. The four of least cost are measured
    with the whole body, and the first of them that is clear is taken. No draw is made: the result is a function of the
    input, and moves with the scene.

    One program is compiled for each number of poses, body points and obstacles of a kind, and coarseness of the looks.

    Args:
        trajectory: T_world_query.
        body: points of what moves, metres, query frame; see `clearance`.
        obstacles: at least one.
        margin: clearance to keep, 0 or more, metres.
        config: settings.

    Returns:
        The trajectory and how clear it is; `clear` is False, and `status` says why, where none was found.

    Raises:
        InputError: as for `clearance`, or the margin is negative, or config is of another kind.

    Source:
        Trajectory optimisation on signed distances with smoothness as the metric is that of CHOMP: Zucker et al., IJRR
        2013. Steps here are Levenberg and Marquardt's.
    """
    if not isinstance(config, ClearanceConfig):
        raise InputError(f"push_clear(): config is {config!r}; expected a ClearanceConfig")
    if not (np.ndim(margin) == 0 and 0 <= margin < np.inf):
        raise InputError(f"push_clear(): margin is {margin}; expected a length of 0 or more, metres")
    wxyz_xyz, body, groups, order = prepare("push_clear", trajectory, body, obstacles)
    dtype = wxyz_xyz.dtype
    looks = motion_samples(wxyz_xyz, body, STEP)
    found, rows, _ = measure(wxyz_xyz, body, groups, order, looks - 1)
    ends = rows[[0, -1]]  # in the order of the groups
    way = path_lengths(wxyz_xyz, body, config.lever)

    def required(at):
        """Of each obstacle, in the order of the groups, at lengths of the way."""
        return np.minimum(
            margin, np.minimum(ends[0] + config.ramp * at[:, None], ends[1] + config.ramp * (way[-1] - at[:, None]))
        )

    def excess(rows):
        at = np.interp(np.linspace(0, len(way) - 1, len(rows)), np.arange(len(way)), way)
        return rows - required(at)

    short = excess(rows)
    deep = [
        (name, int(order[i]), ends[end, i])
        for end, name in enumerate(("first", "last"))
        for i in range(len(order))
        if ends[end, i] < -config.contact
    ]
    if short.min() >= -ROUNDING:
        return _said(trajectory, found, short, 0.0, deep, True)
    clear, rest = [], [(wxyz_xyz, found, short)]
    if len(wxyz_xyz) > 2:
        looks = motion_samples(wxyz_xyz, body, LOOK)
        at = np.interp(np.arange((len(way) - 1) * looks) / looks, np.arange(len(way)), way)
        wanted = required(at).astype(dtype).reshape(len(way) - 1, looks, -1)
        numbers = np.array([config.lever, config.deviation], dtype)
        spread, u = farthest_point_indices(body, POINTS), _detours(wxyz_xyz, body, config).astype(dtype)
        points = spread
        for slack in SLACK:
            tried = np.resize(body[points], (POINTS, 3))  # one size, so that bodies of all sizes run one program
            u, poses, cost = map(
                np.asarray,
                _push(
                    groups,
                    wxyz_xyz,
                    tried,
                    wanted + dtype.type(slack),
                    u,
                    numbers,
                    np.asarray(config.iterations, dtype),
                ),
            )
            missed = []
            for i in np.argsort(cost, kind="stable")[:BEST]:
                moved = poses[i].copy()
                moved[[0, -1]] = wxyz_xyz[[0, -1]]
                found, rows, nearest = measure(moved, body, groups, order, motion_samples(moved, body, STEP) - 1)
                short = excess(rows)
                missed.append(nearest[short < -ROUNDING])
                (rest if len(missed[-1]) else clear).append((moved, found, short))
            if clear:
                break
            # The next descent goes on from there, and looks at points that came too near as well.
            missed = np.setdiff1d(np.concatenate(missed), points)
            points = np.concatenate([missed[: POINTS // 2], spread])[:POINTS]
    # They come in the order of their costs.
    wxyz_new, found, short = clear[0] if clear else max(rest, key=lambda candidate: candidate[2].min())
    moved = np.linalg.norm(body_centres(wxyz_new, body) - body_centres(wxyz_xyz, body), axis=1).max()
    return _said(Trajectory(jnp.asarray(wxyz_new)), found, short, float(moved), deep, bool(clear))


def _said(trajectory, found, short, deviation, deep, kept):
    """`Cleared`, with the status in words."""
    if deep:
        name, obstacle, distance = deep[0]
        status = (
            f"not clear: the {name} pose is {-distance:.3f} m inside of obstacle {obstacle}, which no push between the ends can change; "
            f"move that end, or allow it with ClearanceConfig(contact={np.ceil(-1e3 * distance) / 1e3:.3f})"
        )
    elif kept:
        status = "already clear: unchanged" if deviation == 0 else f"clear: moved by up to {deviation:.3f} m"
    else:
        looks = found.between + 1
        row = int(short.min(axis=1).argmin())
        where = (
            f"at pose {row // looks}" if row % looks == 0 else f"between poses {row // looks} and {row // looks + 1}"
        )
        n = trajectory.num_poses
        remedy = "lower the margin, thin the body, or move an end or the obstacle"
        if short[::looks].min() >= -ROUNDING or n < 7:
            remedy = f"give it more poses, resample(trajectory, {2 * n + 1}), or {remedy}"
        status = f"not clear: {-short.min():.4f} m less than required {where}; {remedy}"
    return Cleared(trajectory, found.least, float(short.min()), deviation, kept and not deep, status)


def _detours(wxyz_xyz, body, config):
    """Deviations to start from: none, and bumps of several heights to all sides of the chord; (starts, poses, 6)."""
    places = body_centres(wxyz_xyz, body)
    R = np.asarray(se3.rotation(wxyz_xyz[0]), float)
    chord = places[-1] - places[0]
    length = np.linalg.norm(chord)
    # A way that ends where it began is bumped around the query frame's z. All directions turn with the scene.
    along = chord / length if length > 1e-6 else R[:, 2]
    first = R[:, np.abs(along @ R).argmin()]
    first = first - along * (along @ first)
    first /= np.linalg.norm(first)
    angle = 2 * np.pi * np.arange(config.directions) / config.directions
    sides = np.cos(angle)[:, None] * first + np.sin(angle)[:, None] * np.cross(along, first)
    radius = np.linalg.norm(body - body.mean(axis=0), axis=1).max()
    s = np.linspace(0, 1, len(places))
    bump = 1 - (2 * s - 1) ** 4  # flat on top and steep at the ends: an obstacle may stand close to one
    heights = np.array(HEIGHTS) * (length + 2 * radius)
    shifts = (heights[:, None, None, None] * bump[:, None] * sides[:, None]).reshape(-1, len(s), 3)
    return np.concatenate([np.zeros((1, len(s), 6)), np.concatenate([shifts, np.zeros_like(shifts)], axis=-1)])


@jax.jit
def _push(groups, wxyz_xyz, body, wanted, starts, numbers, iterations):
    """Deviations of least cost from each start, their poses, and the costs: of bending, size and what is missing."""
    lever, weight = numbers
    segments, checks, _ = wanted.shape
    n, dtype = segments + 1, wxyz_xyz.dtype
    middle = body.mean(axis=0)
    R_given = se3.rotation(wxyz_xyz)
    given = se3.rotate(R_given, middle[None])[:, 0] + wxyz_xyz[:, 4:]
    required = jnp.moveaxis(wanted, -1, 0)[..., None]
    f = jnp.arange(checks, dtype=dtype) / checks
    exact = functools.partial(jnp.einsum, precision=jax.lax.Precision.HIGHEST)
    # Second derivative and size of a deviation that is zero at both ends, as integrals over the trajectory, of length
    # 1.
    second = np.diff(np.eye(n), n=2, axis=0)[:, 1:-1]
    metric = jnp.asarray(second.T @ second * segments**3, dtype) + weight * jnp.eye(n - 2, dtype=dtype) / segments
    stiffness = jnp.kron(metric, jnp.eye(6, dtype=dtype))
    i = np.arange(segments)

    def applied(u):
        """Rotations, translations and the turned middle of the body: shifts of the middle, and turns about it."""
        R = exact("nij,njk->nik", se3.exp(u[:, 3:] / lever), R_given)
        turned = se3.rotate(R, middle[None])[:, 0]
        return R, given + u[:, :3] - turned, turned

    def missing(u):
        """What is missing: half the mean of its squares, their gradient and their Gauss-Newton matrix with respect to the deviations."""
        R, t, turned = applied(u)
        between = se3.geodesic(R[:-1, None], R[1:, None], f)
        arms = se3.rotate(between, body)
        x = arms + (t[:-1, None] + f[:, None] * (t[1:] - t[:-1])[:, None])[:, :, None]
        apart, normals = distances_and_normals(groups, x)
        short = jnp.maximum(required - apart, 0)
        # A distance's slopes with respect to the shift and the turn of the frame at the look.
        rows = jnp.concatenate([normals, jnp.cross(jnp.broadcast_to(arms, normals.shape), normals)], axis=-1)
        rows = jnp.where((short > 0)[..., None], rows, 0)
        squares, pulls = exact("oscpi,oscpj->scij", rows, rows), -exact("oscpi,oscp->sci", rows, short)
        # The frame at the look shifts and turns by the parts of the two poses'; for turns that is so where the two
        # differ by a small angle, which slows the descent where they do not, and changes nothing else.
        turns = jax.vmap(jax.jacfwd(se3.exp))(u[:, 3:] / lever)
        turns = exact("nijk,nlj->nilk", turns, se3.exp(u[:, 3:] / lever))
        twist = jnp.stack([turns[:, 2, 1], turns[:, 0, 2], turns[:, 1, 0]], axis=1) / lever
        still, across = (
            jnp.broadcast_to(jnp.eye(3, dtype=dtype), twist.shape),
            jnp.cross(turned[:, :, None], twist, axis=1),
        )
        frame = jnp.concatenate(
            [jnp.concatenate([still, across], axis=2), jnp.concatenate([jnp.zeros_like(twist), twist], axis=2)], axis=1
        )

        def block(parts, a, b):
            return exact("c,scij,sik,sjl->skl", parts, squares, frame[a], frame[b])

        def pull(parts, a):
            return exact("c,sci,sik->sk", parts, pulls, frame[a])

        gradient = jnp.zeros((n, 6), dtype).at[i].add(pull(1 - f, i)).at[i + 1].add(pull(f, i + 1))
        aside = block(f * (1 - f), i, i + 1)
        matrix = (
            jnp.zeros((n, n, 6, 6), dtype)
            .at[i, i]
            .add(block((1 - f) ** 2, i, i))
            .at[i + 1, i + 1]
            .add(block(f**2, i + 1, i + 1))
        )
        matrix = matrix.at[i, i + 1].add(aside).at[i + 1, i].add(jnp.swapaxes(aside, 1, 2))
        matrix = jnp.swapaxes(matrix[1:-1, 1:-1], 1, 2).reshape(6 * (n - 2), 6 * (n - 2))
        share = 1 / (segments * checks)
        return 0.5 * share * jnp.sum(short**2), share * gradient[1:-1].ravel(), share * matrix

    def smooth(u):
        inner = u[1:-1].ravel()
        return 0.5 * inner @ jnp.matmul(stiffness, inner, precision=jax.lax.Precision.HIGHEST)

    def step(i, state):
        """Look at what is tried, keep it if it is better, and try the next. One look a step: another one costs its compilation."""
        tried, u, kept, damping = state
        stiff = STIFF[0] * (STIFF[1] / STIFF[0]) ** jnp.minimum(i / (0.6 * iterations), 1)
        new = missing(tried)
        better = smooth(tried) + stiff * new[0] < smooth(u) + stiff * kept[0]
        u, kept = jax.tree.map(lambda a, b: jnp.where(better, a, b), (tried, new), (u, kept))
        damping = jnp.clip(jnp.where(better, damping / 4, damping * 6), 1e-2, 1e8)
        slope = jnp.matmul(stiffness, u[1:-1].ravel(), precision=jax.lax.Precision.HIGHEST) + stiff * kept[1]
        damped = stiffness + stiff * kept[2] + damping * jnp.eye(len(slope), dtype=dtype)
        move = -jax.scipy.linalg.cho_solve(jax.scipy.linalg.cho_factor(damped), slope).reshape(n - 2, 6)
        move = move * jnp.minimum(1, LONGEST / jnp.maximum(jnp.abs(move).max(), 1e-9))
        return u.at[1:-1].add(move), u, kept, damping

    def descend(u):
        size = 6 * (n - 2)
        nothing = (
            jnp.asarray(jnp.finfo(dtype).max / STIFF[1] / 4, dtype),
            jnp.zeros(size, dtype),
            jnp.zeros((size, size), dtype),
        )
        _, u, (value, _, _), _ = jax.lax.fori_loop(
            0, iterations.astype(int), step, (u, u, nothing, jnp.asarray(40.0, dtype))
        )
        R, t, _ = applied(u)
        return u, se3.pose(R, t), smooth(u) + STIFF[1] * value

    return jax.vmap(descend)(starts)
