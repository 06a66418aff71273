"""Clearance of a motion from obstacles, measured on the way as well as at the poses, and trajectories pushed clear of what they would hit.

A body is a set of points fixed in the query frame: the gripper's, those of the object it holds. Between two poses the query frame's origin goes
straight and its rotation along the geodesic.
"""

import functools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from tdf_jax.geometry import se3
from tdf_jax._internal.errors import InputError
from tdf_jax.io.pointclouds import thin_indices
from tdf_jax.geometry.trajectory import Trajectory, check_trajectory

STEP = 0.005  # metres: no point of the body moves farther between two looks, so that a wall seen by none of them is thinner than what it sees in 5 mm
MOST_BETWEEN = 255  # looks between two poses
POINTS = 64  # of the body that a descent looks at: spread evenly, then some of those that were missed
LOOK = 0.01  # metres that a point of the body moves at most between the looks of a descent, along the given path
# Metres aimed at beyond what is required, in the descents one after the other: a detour is longer than the given path, and what it keeps at the
# looks it does not quite keep between them.
SLACK = 0.0015, 0.003, 0.006
ROUNDING = 1e-5  # metres
BEST = 4  # detours that are measured with the whole body
# Heights of the detours over the chord's length and twice the body's radius, each in all directions around the chord.
HEIGHTS = 0.3, 0.8, 2.0
STIFF = 1e4, 1e6  # weight of what is missing, squared, first and last, over that of the deviation
LONGEST = 0.1  # metres that a pose moves in one step


class Obstacle(Protocol):
    """What `tdf_jax.obstacles` makes, or any registered dataclass of arrays with this method."""

    def distance(self, x: Float[Array, "*batch 3"]) -> Float[Array, "*batch"]:
        """Signed distances of points of the world, metres, negative inside."""


@dataclass(frozen=True)
class Clearance:
    """Least signed distances between a body and obstacles along a trajectory, metres, negative inside.

    Attributes:
        waypoints: at each pose, from each obstacle.
        segments: on the way from pose i to pose i + 1, both included.
        between: poses looked at between two.
    """

    waypoints: Float[np.ndarray, "poses obstacles"]
    segments: Float[np.ndarray, "segments obstacles"]
    between: int

    @property
    def least(self) -> float:
        """The least of all, metres."""
        return float(min(self.waypoints.min(), self.segments.min(initial=np.inf)))


@dataclass(frozen=True)
class ClearanceConfig:
    """Settings of `push_clear`.

    Attributes:
        lever: metres; a turn of one radian counts as a shift by as much.
        deviation: weight of the deviation itself, over that of its bending (second derivative along the trajectory, whose length counts as 1).
        ramp: metres of clearance gained per metre of way from an end that is closer than the margin.
        contact: how deep an end may be inside of an obstacle, metres: what the pick's own contact and the errors of its surface come to.
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


def clearance(
    trajectory: Trajectory, body: Float[Array, "points 3"], obstacles: Sequence[Obstacle], *, between: int | None = None
) -> Clearance:
    """Least signed distances between a body that is moved along a trajectory and obstacles, on the way too.

    Args:
        trajectory: T_world_query, at least one pose.
        body: points of what moves, metres, query frame. What is between them is not seen: an obstacle thinner than their distance can pass.
        obstacles: at least one.
        between: poses to look at between two; by default so many that no point moves more than 5 mm (up to 255).

    Returns:
        The distances.

    Raises:
        InputError: the trajectory fails `check_trajectory`, the body is not finite points, there is no obstacle or one of another kind, or between is
            not a whole number of 0 to 255.
    """
    wxyz_xyz, body, groups, order = _prepared("clearance", trajectory, body, obstacles)
    if between is None:
        between = _looks(wxyz_xyz, body, STEP) - 1
    elif not isinstance(between, int | np.integer) or isinstance(between, bool) or not 0 <= between <= MOST_BETWEEN:
        raise InputError(f"clearance(): between is {between!r}; expected a whole number of 0 to {MOST_BETWEEN}, or None")
    return _measured(wxyz_xyz, body, groups, order, int(between))[0]


def push_clear(
    trajectory: Trajectory,
    body: Float[Array, "points 3"],
    obstacles: Sequence[Obstacle],
    *,
    margin: float = 0.01,
    config: ClearanceConfig = ClearanceConfig(),
) -> Cleared:
    """Push a trajectory clear of obstacles, at its poses and between them; both end poses stay as they are.

    What is required is the margin, from each obstacle; near an end that is closer to it than that, what the end keeps plus the way from there
    (`ramp`). A trajectory that keeps it already comes back as it is. Otherwise the smoothest small deviation (shifts, and turns about the
    middle of the body) that keeps it is sought from the given path and from detours to all sides of it: the other side of a wall is
    another minimum. The four of least cost are measured with the whole body, and the first of them that is clear is taken. No draw is made: the result is
    a function of the input, and moves with the scene.

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
        Trajectory optimisation on signed distances with smoothness as the metric is that of CHOMP: Zucker et al., IJRR 2013. Steps here are
        Levenberg and Marquardt's.
    """
    if not isinstance(config, ClearanceConfig):
        raise InputError(f"push_clear(): config is {config!r}; expected a ClearanceConfig")
    if not (np.ndim(margin) == 0 and 0 <= margin < np.inf):
        raise InputError(f"push_clear(): margin is {margin}; expected a length of 0 or more, metres")
    wxyz_xyz, body, groups, order = _prepared("push_clear", trajectory, body, obstacles)
    dtype = wxyz_xyz.dtype
    looks = _looks(wxyz_xyz, body, STEP)
    found, rows, _ = _measured(wxyz_xyz, body, groups, order, looks - 1)
    ends = rows[[0, -1]]  # in the order of the groups
    way = _way(wxyz_xyz, body, config.lever)

    def required(at):
        """Of each obstacle, in the order of the groups, at lengths of the way."""
        return np.minimum(margin, np.minimum(ends[0] + config.ramp * at[:, None], ends[1] + config.ramp * (way[-1] - at[:, None])))

    def excess(rows):
        at = np.interp(np.linspace(0, len(way) - 1, len(rows)), np.arange(len(way)), way)
        return rows - required(at)

    short = excess(rows)
    deep = [(name, int(order[i]), ends[end, i]) for end, name in enumerate(("first", "last")) for i in range(len(order)) if ends[end, i] < -config.contact]
    if short.min() >= -ROUNDING:
        return _said(trajectory, found, short, 0.0, deep, True)
    clear, rest = [], [(wxyz_xyz, found, short)]
    if len(wxyz_xyz) > 2:
        looks = _looks(wxyz_xyz, body, LOOK)
        at = np.interp(np.arange((len(way) - 1) * looks) / looks, np.arange(len(way)), way)
        wanted = required(at).astype(dtype).reshape(len(way) - 1, looks, -1)
        numbers = np.array([config.lever, config.deviation], dtype)
        spread, u = thin_indices(body, POINTS), _detours(wxyz_xyz, body, config).astype(dtype)
        points = spread
        for slack in SLACK:
            tried = np.resize(body[points], (POINTS, 3))  # one size, so that bodies of all sizes run one program
            u, poses, cost = map(np.asarray, _push(groups, wxyz_xyz, tried, wanted + dtype.type(slack), u, numbers, np.asarray(config.iterations, dtype)))
            missed = []
            for i in np.argsort(cost, kind="stable")[:BEST]:
                moved = poses[i].copy()
                moved[[0, -1]] = wxyz_xyz[[0, -1]]
                found, rows, nearest = _measured(moved, body, groups, order, _looks(moved, body, STEP) - 1)
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
    moved = np.linalg.norm(_middles(wxyz_new, body) - _middles(wxyz_xyz, body), axis=1).max()
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
        where = f"at pose {row // looks}" if row % looks == 0 else f"between poses {row // looks} and {row // looks + 1}"
        n = trajectory.poses
        remedy = "lower the margin, thin the body, or move an end or the obstacle"
        if short[::looks].min() >= -ROUNDING or n < 7:
            remedy = f"give it more poses, resample(trajectory, {2 * n + 1}), or {remedy}"
        status = f"not clear: {-short.min():.4f} m less than required {where}; {remedy}"
    return Cleared(trajectory, found.least, float(short.min()), deviation, kept and not deep, status)


def _prepared(function, trajectory, body, obstacles):
    """Checked arrays of the trajectory's type; obstacles of a kind stacked, and where each of these was in the list."""
    wxyz_xyz = np.asarray(check_trajectory(trajectory).wxyz_xyz)
    body = np.asarray(body)
    if body.ndim != 2 or body.shape[1] != 3 or not len(body) or body.dtype.kind not in "fiu" or not np.isfinite(body).all():
        raise InputError(f"{function}(): body has shape {body.shape}; expected points (points, 3) of finite metres in the query frame")
    if not isinstance(obstacles, list | tuple) or not obstacles:
        raise InputError(f"{function}(): obstacles are {obstacles!r}; expected a list of at least one, such as [box_obstacle(...)]")
    kinds: dict[Any, list[int]] = {}
    arrays = []
    for i, obstacle in enumerate(obstacles):
        leaves, tree = jax.tree.flatten(obstacle)
        if not callable(getattr(obstacle, "distance", None)) or not leaves or not all(isinstance(leaf, jax.Array | np.ndarray) for leaf in leaves):
            raise InputError(
                f"{function}(): obstacles[{i}] is a {type(obstacle).__name__}; expected an obstacle of tdf_jax.obstacles, "
                "or a registered dataclass of arrays with a method distance"
            )
        arrays.append([np.asarray(leaf, wxyz_xyz.dtype if jnp.issubdtype(leaf.dtype, jnp.floating) else None) for leaf in leaves])
        kinds.setdefault((tree, *((leaf.shape, leaf.dtype) for leaf in leaves)), []).append(i)
    groups = [jax.tree.unflatten(kind[0], [np.stack(parts) for parts in zip(*(arrays[i] for i in which))]) for kind, which in kinds.items()]
    return wxyz_xyz, body.astype(wxyz_xyz.dtype), groups, np.concatenate([np.array(which) for which in kinds.values()])


def _middles(wxyz_xyz, body):
    """The middle of the body at each pose, in numpy: op by op, jax would compile each."""
    w, v, middle = wxyz_xyz[:, :1].astype(float), wxyz_xyz[:, 1:4].astype(float), body.mean(axis=0, dtype=float)
    return middle + 2 * np.cross(v, np.cross(v, middle) + w * middle) / (w**2 + np.sum(v**2, axis=1, keepdims=True)) + wxyz_xyz[:, 4:]


def _turns(wxyz_xyz):
    """Angles between neighbouring poses."""
    unit = wxyz_xyz[:, :4] / np.linalg.norm(wxyz_xyz[:, :4].astype(float), axis=1, keepdims=True)
    return 2 * np.arccos(np.minimum(np.abs(np.sum(unit[:-1] * unit[1:], axis=1)), 1))


def _looks(wxyz_xyz, body, step):
    """Looks a segment so that no point of the body moves farther than step from one to the next: a power of 2, to compile few programs."""
    shift = np.linalg.norm(np.diff(wxyz_xyz[:, 4:], axis=0), axis=1)
    farthest = np.max(shift + _turns(wxyz_xyz) * np.linalg.norm(body, axis=1).max(), initial=0.0)
    return int(min(2 ** np.ceil(np.log2(max(farthest / step, 1))), MOST_BETWEEN + 1))


def _way(wxyz_xyz, body, lever):
    """Length of the way to each pose, metres, turns counted by the lever."""
    shift = np.linalg.norm(np.diff(_middles(wxyz_xyz, body), axis=0), axis=1)
    return np.concatenate([[0.0], np.cumsum(shift + lever * _turns(wxyz_xyz))])


def _measured(wxyz_xyz, body, groups, order, between):
    """`Clearance`, and the distances at all looks and which point of the body is nearest, in the order of the groups."""
    rows, nearest = map(np.asarray, _distances(groups, wxyz_xyz, body, looks=between + 1))
    rows = rows.astype(float)
    listed = np.empty_like(rows)
    listed[:, order] = rows
    windows = [listed[i : len(listed) - between - 1 + i : between + 1] for i in range(between + 2)]
    return Clearance(listed[:: between + 1], np.min(windows, axis=0), between), rows, nearest


def _apart_and_normals(groups, x):
    """Signed distances (obstacles, ...) of points and their gradients, the obstacles in the order of the groups."""

    def one(obstacle):
        apart, pull = jax.vjp(obstacle.distance, x)
        return apart, pull(jnp.ones_like(apart))[0]

    found = [jax.vmap(one)(group) for group in groups]
    return tuple(jnp.concatenate(parts) for parts in zip(*found))


@functools.partial(jax.jit, static_argnames="looks")
def _distances(groups, wxyz_xyz, body, *, looks):
    R, t = se3.rotation(wxyz_xyz), se3.translation(wxyz_xyz)
    fraction = jnp.arange(looks, dtype=t.dtype) / looks
    turned = se3.geodesic(R[:-1, None], R[1:, None], fraction).reshape(-1, 3, 3)
    shifted = (t[:-1, None] + fraction[:, None] * (t[1:] - t[:-1])[:, None]).reshape(-1, 3)

    def least(pose):
        x = se3.rotate(pose[0], body) + pose[1]
        apart = jnp.concatenate([jax.vmap(lambda one: one.distance(x))(group) for group in groups])
        return apart.min(axis=1), apart.argmin(axis=1)

    all_R, all_t = jnp.concatenate([turned, R[-1:]]), jnp.concatenate([shifted, t[-1:]])
    return jax.lax.map(least, (all_R, all_t))


def _detours(wxyz_xyz, body, config):
    """Deviations to start from: none, and bumps of several heights to all sides of the chord; (starts, poses, 6)."""
    places = _middles(wxyz_xyz, body)
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
    # Second derivative and size of a deviation that is zero at both ends, as integrals over the trajectory, of length 1.
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
        apart, normals = _apart_and_normals(groups, x)
        short = jnp.maximum(required - apart, 0)
        # A distance's slopes with respect to the shift and the turn of the frame at the look.
        rows = jnp.concatenate([normals, jnp.cross(jnp.broadcast_to(arms, normals.shape), normals)], axis=-1)
        rows = jnp.where((short > 0)[..., None], rows, 0)
        squares, pulls = exact("oscpi,oscpj->scij", rows, rows), -exact("oscpi,oscp->sci", rows, short)
        # The frame at the look shifts and turns by the parts of the two poses'; for turns that is so where the two differ by a small angle, which
        # slows the descent where they do not, and changes nothing else.
        turns = jax.vmap(jax.jacfwd(se3.exp))(u[:, 3:] / lever)
        turns = exact("nijk,nlj->nilk", turns, se3.exp(u[:, 3:] / lever))
        twist = jnp.stack([turns[:, 2, 1], turns[:, 0, 2], turns[:, 1, 0]], axis=1) / lever
        still, across = jnp.broadcast_to(jnp.eye(3, dtype=dtype), twist.shape), jnp.cross(turned[:, :, None], twist, axis=1)
        frame = jnp.concatenate([jnp.concatenate([still, across], axis=2), jnp.concatenate([jnp.zeros_like(twist), twist], axis=2)], axis=1)

        def block(parts, a, b):
            return exact("c,scij,sik,sjl->skl", parts, squares, frame[a], frame[b])

        def pull(parts, a):
            return exact("c,sci,sik->sk", parts, pulls, frame[a])

        gradient = jnp.zeros((n, 6), dtype).at[i].add(pull(1 - f, i)).at[i + 1].add(pull(f, i + 1))
        aside = block(f * (1 - f), i, i + 1)
        matrix = jnp.zeros((n, n, 6, 6), dtype).at[i, i].add(block((1 - f) ** 2, i, i)).at[i + 1, i + 1].add(block(f**2, i + 1, i + 1))
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
        nothing = jnp.asarray(jnp.finfo(dtype).max / STIFF[1] / 4, dtype), jnp.zeros(size, dtype), jnp.zeros((size, size), dtype)
        _, u, (value, _, _), _ = jax.lax.fori_loop(0, iterations.astype(int), step, (u, u, nothing, jnp.asarray(40.0, dtype)))
        R, t, _ = applied(u)
        return u, se3.pose(R, t), smooth(u) + STIFF[1] * value

    return jax.vmap(descend)(starts)
