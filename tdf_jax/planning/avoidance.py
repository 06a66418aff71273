"""Trajectories moved clear of obstacles, at their poses and between them.

A body is a set of points fixed in the query frame: points of the gripper and of the object that it holds. Between two
poses the translation of the query frame is interpolated linearly, and its rotation follows the SO(3) geodesic.
"""

import functools
from collections.abc import Sequence
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from tdf_jax._internal import checks
from tdf_jax._internal.boundary import host
from tdf_jax._internal.deprecation import renamed_fields
from tdf_jax._internal.errors import InputError
from tdf_jax.geometry import se3
from tdf_jax.geometry.sampling import farthest_point_indices
from tdf_jax.geometry.trajectory import Trajectory
from tdf_jax.planning.distances import (
    ROUNDING,
    STEP,
    Clearance,
    Obstacle,
    body_centroids,
    distances_and_normals,
    measure,
    motion_samples,
    path_lengths,
    prepare,
)

# Points of the body in an optimisation: an even subset, then some of the points that violated the margin.
NUM_POINTS = 64
# No point of the body moves farther than this between two samples of an optimisation along the given path, metres.
OPTIMISATION_STEP = 0.01
# Metres added to the required distance in the optimisations one after the other, because a detour is longer than the
# given path, so its samples are farther apart, and it comes slightly closer between the samples than at them.
EXTRA_MARGINS = 0.0015, 0.003, 0.006
NUM_MEASURED = 4  # solutions of least cost that are measured with the whole body
# Heights of the detours relative to the chord's length plus twice the body's radius; each in all directions.
DETOUR_HEIGHTS = 0.3, 0.8, 2.0
# First and last weight of the squared shortfall, relative to the cost of the deviation.
PENALTY_WEIGHTS = 1e4, 1e6
MAX_UPDATE = 0.1  # largest change of a component of a deviation in one step, metres


@renamed_fields(lever="rotation_scale")
@dataclass(frozen=True)
class ClearanceConfig:
    """Settings of `push_clear`.

    Attributes:
        rotation_scale: length that a rotation counts as, metres per radian.
        deviation: weight of the squared deviation relative to the square of its second derivative along the trajectory,
            whose length counts as 1.
        ramp: increase of the required distance per length of the path from an end that is closer than the margin,
            metres per metre.
        contact: depth of an end inside an obstacle that is accepted, metres; it allows for the contact of the pick and
            for errors of surfaces.
        directions: number of directions around the chord in which detours are tried.
        iterations: number of Levenberg-Marquardt steps in an optimisation.

    Raises:
        InputError: a value is out of range.
    """

    rotation_scale: float = 0.1
    deviation: float = 10.0
    ramp: float = 1.0
    contact: float = 0.01
    directions: int = 8
    iterations: int = 40

    def __post_init__(self):
        for name in ("directions", "iterations"):
            checks.count("ClearanceConfig()", name, getattr(self, name))
        for name in ("rotation_scale", "deviation", "ramp"):
            checks.positive("ClearanceConfig()", name, getattr(self, name))
        checks.number("ClearanceConfig()", "contact", self.contact, least=0, unit="metres")


@dataclass(frozen=True)
class Cleared:
    """Result of `push_clear`.

    Attributes:
        trajectory: resulting trajectory, T_world_query, with the number of poses and the ends of the given one.
        clearance: smallest signed distance along the trajectory, metres.
        excess: smallest difference of the distance and the required distance, metres; negative if the trajectory
            violates the requirement.
        deviation: largest distance of the body's centroid from its given position at a pose, metres.
        clear: whether the trajectory keeps the required distance everywhere, and no end is deeper in an obstacle than
            `ClearanceConfig.contact`.
        status: the same in words, with a remedy if the trajectory is not clear.
    """

    trajectory: Trajectory
    clearance: float
    excess: float
    deviation: float
    clear: bool
    status: str


@host
def push_clear(
    trajectory: Trajectory,
    body: Float[Array, "points 3"],
    obstacles: Sequence[Obstacle],
    *,
    margin: float = 0.01,
    config: ClearanceConfig = ClearanceConfig(),
) -> Cleared:
    """Move a trajectory clear of obstacles, at its poses and between them; both end poses are unchanged.

    The required distance from each obstacle is the margin. Near an end that is closer to an obstacle than the margin,
    it is the distance at the end plus `ramp` times the length of the path from there. A trajectory that keeps the
    required distances is returned unchanged.

    Otherwise the smoothest small deviation (translations, and rotations about the body's centroid) is optimised from
    the given path and from detours to all sides of it, because the other side of a wall is another minimum. The
    solutions of least cost are measured with the whole body, and the first one that is clear is returned. The function
    draws no random numbers, and the result moves with the scene.

    One program is compiled for each number of poses, of body points, of obstacles of a kind and of samples in a
    segment.

    Args:
        trajectory: poses of the query frame, T_world_query.
        body: points of the moving body, (points, 3), metres, query frame; see `clearance`.
        obstacles: obstacles, at least one.
        margin: distance to keep from each obstacle, 0 or more, metres.
        config: settings.

    Returns:
        The trajectory and its clearance. If no clear trajectory was found, `clear` is False and `status` says why.

    Raises:
        InputError: as for `clearance`; or the margin is negative, or config is of another type.

    References:
        Zucker et al., "CHOMP: Covariant Hamiltonian optimization for motion planning", IJRR 2013: trajectory
        optimisation on signed distances with smoothness as the metric. The steps here are Levenberg-Marquardt steps.
    """
    if not isinstance(config, ClearanceConfig):
        raise InputError(f"push_clear(): config is {config!r}; expected a ClearanceConfig")
    checks.number("push_clear()", "margin", margin, least=0, unit="metres")
    wxyz_xyz, points, groups, order = prepare("push_clear()", trajectory, body, obstacles)
    measured, distances, _ = measure(wxyz_xyz, points, groups, order, motion_samples(wxyz_xyz, points, STEP) - 1)
    ends = distances[[0, -1]]  # columns are in the order of the groups
    length = path_lengths(wxyz_xyz, points, config.rotation_scale)

    def required(at):
        """Required distance from each obstacle, in the order of the groups, at lengths of the path."""
        from_start = ends[0] + config.ramp * at[:, None]
        from_goal = ends[1] + config.ramp * (length[-1] - at[:, None])
        return np.minimum(margin, np.minimum(from_start, from_goal))

    def excess_of(distances):
        at = np.interp(np.linspace(0, len(length) - 1, len(distances)), np.arange(len(length)), length)
        return distances - required(at)

    excess = excess_of(distances)
    penetrations = [
        (name, int(order[i]), ends[end, i])
        for end, name in enumerate(("first", "last"))
        for i in range(len(order))
        if ends[end, i] < -config.contact
    ]
    if excess.min() >= -ROUNDING:
        return _cleared(trajectory, measured, excess, 0.0, penetrations, True)
    clear, violating = [], [(wxyz_xyz, measured, excess)]
    if len(wxyz_xyz) > 2:
        samples = motion_samples(wxyz_xyz, points, OPTIMISATION_STEP)
        at = np.interp(np.arange((len(length) - 1) * samples) / samples, np.arange(len(length)), length)
        clear, others = _optimised(wxyz_xyz, points, groups, order, required(at), samples, excess_of, config)
        violating += others
    # Clear solutions are in the order of their costs.
    new_wxyz_xyz, measured, excess = clear[0] if clear else max(violating, key=lambda candidate: candidate[2].min())
    offsets = body_centroids(new_wxyz_xyz, points) - body_centroids(wxyz_xyz, points)
    deviation = float(np.linalg.norm(offsets, axis=1).max())
    return _cleared(Trajectory(jnp.asarray(new_wxyz_xyz)), measured, excess, deviation, penetrations, bool(clear))


def _optimised(wxyz_xyz, body, groups, order, required, samples, excess_of, config):
    """Measured solutions that are clear, and those that are not: lists of poses, `Clearance` and excess."""
    dtype = wxyz_xyz.dtype
    required = required.astype(dtype).reshape(len(wxyz_xyz) - 1, samples, -1)
    weights = np.array([config.rotation_scale, config.deviation], dtype)
    spread, u = farthest_point_indices(body, NUM_POINTS), _detours(wxyz_xyz, body, config).astype(dtype)
    indices = spread
    clear, violating = [], []
    for extra in EXTRA_MARGINS:
        subset = np.resize(body[indices], (NUM_POINTS, 3))  # one size, so that bodies of all sizes run one program
        iterations = np.asarray(config.iterations, dtype)
        optimised = _optimise(groups, wxyz_xyz, subset, required + dtype.type(extra), u, weights, iterations)
        u, poses, cost = map(np.asarray, optimised)
        violated = []
        for i in np.argsort(cost, kind="stable")[:NUM_MEASURED]:
            solution = poses[i].copy()
            solution[[0, -1]] = wxyz_xyz[[0, -1]]
            between = motion_samples(solution, body, STEP) - 1
            measured, distances, nearest = measure(solution, body, groups, order, between)
            excess = excess_of(distances)
            violated.append(nearest[excess < -ROUNDING])
            (violating if len(violated[-1]) else clear).append((solution, measured, excess))
        if clear:
            break
        # The next optimisation starts from these deviations and includes points that violated the requirement.
        violated = np.setdiff1d(np.concatenate(violated), indices)
        indices = np.concatenate([violated[: NUM_POINTS // 2], spread])[:NUM_POINTS]
    return clear, violating


def _cleared(
    trajectory: Trajectory,
    measured: Clearance,
    excess: np.ndarray,
    deviation: float,
    penetrations: list[tuple[str, int, float]],
    kept: bool,
) -> Cleared:
    """`Cleared`, with the status in words."""
    if penetrations:
        name, obstacle, distance = penetrations[0]
        status = (
            f"not clear: the {name} pose is {-distance:.3f} m inside obstacle {obstacle}, and end poses are not moved; "
            f"move that end, or accept it by ClearanceConfig(contact={np.ceil(-1e3 * distance) / 1e3:.3f})"
        )
    elif kept:
        status = "already clear: unchanged" if deviation == 0 else f"clear: moved by up to {deviation:.3f} m"
    else:
        samples = measured.between + 1
        row = int(excess.min(axis=1).argmin())
        pose = row // samples
        where = f"at pose {pose}" if row % samples == 0 else f"between poses {pose} and {pose + 1}"
        n = trajectory.num_poses
        remedy = "lower the margin, thin the body, or move an end or the obstacle"
        if excess[::samples].min() >= -ROUNDING or n < 7:
            remedy = f"give it more poses, resample(trajectory, {2 * n + 1}), or {remedy}"
        status = f"not clear: {-excess.min():.4f} m less than required {where}; {remedy}"
    return Cleared(trajectory, measured.min, float(excess.min()), deviation, kept and not penetrations, status)


def _detours(wxyz_xyz, body, config):
    """Initial deviations: none, and bumps of several heights to all sides of the chord; (starts, poses, 6)."""
    centroids = body_centroids(wxyz_xyz, body)
    R = np.asarray(se3.rotation(wxyz_xyz[0]), float)
    chord = centroids[-1] - centroids[0]
    length = np.linalg.norm(chord)
    # If a path ends where it began, bumps are around the query frame's z axis. All directions rotate with the scene.
    along = chord / length if length > 1e-6 else R[:, 2]
    first = R[:, np.abs(along @ R).argmin()]
    first = first - along * (along @ first)
    first /= np.linalg.norm(first)
    angle = 2 * np.pi * np.arange(config.directions) / config.directions
    sides = np.cos(angle)[:, None] * first + np.sin(angle)[:, None] * np.cross(along, first)
    radius = np.linalg.norm(body - body.mean(axis=0), axis=1).max()
    s = np.linspace(0, 1, len(centroids))
    bump = 1 - (2 * s - 1) ** 4  # flat in the middle and steep at the ends, because an obstacle may be close to an end
    heights = np.array(DETOUR_HEIGHTS) * (length + 2 * radius)
    translations = (heights[:, None, None, None] * bump[:, None] * sides[:, None]).reshape(-1, len(s), 3)
    detours = np.concatenate([translations, np.zeros_like(translations)], axis=-1)
    return np.concatenate([np.zeros((1, len(s), 6)), detours])


@jax.jit
def _optimise(groups, wxyz_xyz, body, required, starts, weights, iterations):
    """Optimise deviations from each start; the cost is that of bending, of the deviation and of the shortfall.

    Args:
        groups: obstacles of each kind, stacked.
        wxyz_xyz: given poses, (poses, 7).
        body: points of the body, (points, 3), query frame.
        required: required distances, (segments, samples, obstacles), metres.
        starts: initial deviations, (starts, poses, 6): translation of the centroid, rotation vector times its scale.
        weights: rotation scale in metres per radian, and weight of the deviation.
        iterations: number of steps.

    Returns:
        Deviations, (starts, poses, 6); poses, (starts, poses, 7); costs, (starts,).
    """
    rotation_scale, deviation_weight = weights
    segments, samples, _ = required.shape
    n, dtype = segments + 1, wxyz_xyz.dtype
    centroid = body.mean(axis=0)
    given_R = se3.rotation(wxyz_xyz)
    given_centroids = se3.rotate(given_R, centroid[None])[:, 0] + wxyz_xyz[:, 4:]
    required = jnp.moveaxis(required, -1, 0)[..., None]
    f = jnp.arange(samples, dtype=dtype) / samples
    exact = functools.partial(jnp.einsum, precision=jax.lax.Precision.HIGHEST)
    # Integrals over the trajectory, whose length is 1, of the squared second derivative of a deviation and of its
    # square. The deviation is zero at both ends.
    second = np.diff(np.eye(n), n=2, axis=0)[:, 1:-1]
    bending = jnp.asarray(second.T @ second * segments**3, dtype)
    metric = bending + deviation_weight * jnp.eye(n - 2, dtype=dtype) / segments
    stiffness = jnp.kron(metric, jnp.eye(6, dtype=dtype))
    i = np.arange(segments)

    def applied(u):
        """Rotations, translations, and centroids relative to the query frame's origin in world axes."""
        R = exact("nij,njk->nik", se3.exp(u[:, 3:] / rotation_scale), given_R)
        arms = se3.rotate(R, centroid[None])[:, 0]
        return R, given_centroids + u[:, :3] - arms, arms

    def penalty(u):
        """Half the mean of the squared shortfall, its gradient and its Gauss-Newton matrix."""
        R, t, centroid_arms = applied(u)
        R_samples = se3.geodesic(R[:-1, None], R[1:, None], f)
        arms = se3.rotate(R_samples, body)
        x = arms + (t[:-1, None] + f[:, None] * (t[1:] - t[:-1])[:, None])[:, :, None]
        distances, normals = distances_and_normals(groups, x)
        shortfall = jnp.maximum(required - distances, 0)
        # Derivative of a distance with respect to the translation and the rotation of the query frame at the sample.
        rows = jnp.concatenate([normals, jnp.cross(jnp.broadcast_to(arms, normals.shape), normals)], axis=-1)
        rows = jnp.where((shortfall > 0)[..., None], rows, 0)
        squares, gradients = exact("oscpi,oscpj->scij", rows, rows), -exact("oscpi,oscp->sci", rows, shortfall)
        # The twist of the frame at a sample is interpolated linearly between those of the two poses. For rotations that
        # is exact only if the two differ by a small angle; otherwise the steps are less effective, and the solution is
        # the same.
        dR = jax.vmap(jax.jacfwd(se3.exp))(u[:, 3:] / rotation_scale)
        dR = exact("nijk,nlj->nilk", dR, se3.exp(u[:, 3:] / rotation_scale))
        twist = jnp.stack([dR[:, 2, 1], dR[:, 0, 2], dR[:, 1, 0]], axis=1) / rotation_scale
        identity = jnp.broadcast_to(jnp.eye(3, dtype=dtype), twist.shape)
        translation = jnp.concatenate([identity, jnp.cross(centroid_arms[:, :, None], twist, axis=1)], axis=2)
        rotation = jnp.concatenate([jnp.zeros_like(twist), twist], axis=2)
        frame = jnp.concatenate([translation, rotation], axis=1)

        def block(parts, a, b):
            return exact("c,scij,sik,sjl->skl", parts, squares, frame[a], frame[b])

        def slope(parts, a):
            return exact("c,sci,sik->sk", parts, gradients, frame[a])

        gradient = jnp.zeros((n, 6), dtype).at[i].add(slope(1 - f, i)).at[i + 1].add(slope(f, i + 1))
        off_diagonal = block(f * (1 - f), i, i + 1)
        matrix = jnp.zeros((n, n, 6, 6), dtype)
        matrix = matrix.at[i, i].add(block((1 - f) ** 2, i, i)).at[i + 1, i + 1].add(block(f**2, i + 1, i + 1))
        matrix = matrix.at[i, i + 1].add(off_diagonal).at[i + 1, i].add(jnp.swapaxes(off_diagonal, 1, 2))
        matrix = jnp.swapaxes(matrix[1:-1, 1:-1], 1, 2).reshape(6 * (n - 2), 6 * (n - 2))
        share = 1 / (segments * samples)
        return 0.5 * share * jnp.sum(shortfall**2), share * gradient[1:-1].ravel(), share * matrix

    def smoothness(u):
        inner = u[1:-1].ravel()
        return 0.5 * inner @ jnp.matmul(stiffness, inner, precision=jax.lax.Precision.HIGHEST)

    def step(i, state):
        """Evaluate the candidate, accept it if its cost is less, and propose the next one.

        The penalty is evaluated once in a step, because another evaluation costs its compilation again.
        """
        candidate, u, accepted, damping = state
        weight = PENALTY_WEIGHTS[0] * (PENALTY_WEIGHTS[1] / PENALTY_WEIGHTS[0]) ** jnp.minimum(
            i / (0.6 * iterations), 1
        )
        new = penalty(candidate)
        better = smoothness(candidate) + weight * new[0] < smoothness(u) + weight * accepted[0]
        u, accepted = jax.tree.map(lambda a, b: jnp.where(better, a, b), (candidate, new), (u, accepted))
        damping = jnp.clip(jnp.where(better, damping / 4, damping * 6), 1e-2, 1e8)
        gradient = jnp.matmul(stiffness, u[1:-1].ravel(), precision=jax.lax.Precision.HIGHEST) + weight * accepted[1]
        damped = stiffness + weight * accepted[2] + damping * jnp.eye(len(gradient), dtype=dtype)
        update = -jax.scipy.linalg.cho_solve(jax.scipy.linalg.cho_factor(damped), gradient).reshape(n - 2, 6)
        update = update * jnp.minimum(1, MAX_UPDATE / jnp.maximum(jnp.abs(update).max(), 1e-9))
        return u.at[1:-1].add(update), u, accepted, damping

    def optimised(u):
        size = 6 * (n - 2)
        largest = jnp.asarray(jnp.finfo(dtype).max / PENALTY_WEIGHTS[1] / 4, dtype)
        unevaluated = (largest, jnp.zeros(size, dtype), jnp.zeros((size, size), dtype))
        state = (u, u, unevaluated, jnp.asarray(40.0, dtype))
        _, u, (value, _, _), _ = jax.lax.fori_loop(0, iterations.astype(int), step, state)
        R, t, _ = applied(u)
        return u, se3.pose(R, t), smoothness(u) + PENALTY_WEIGHTS[1] * value

    return jax.vmap(optimised)(starts)
