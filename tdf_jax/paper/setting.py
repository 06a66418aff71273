"""The numbers of one imitation of the paper: those that the paper gives, and those that it leaves open."""

import dataclasses
import functools
from typing import Literal, cast

import jax
import numpy as np
from jaxtyping import Array, Float

from tdf_jax._internal import checks
from tdf_jax._internal.deprecation import renamed_fields, warn
from tdf_jax.energy.losses import COMPENSATOR_ORDERS, POSE_NORMS, EnergyWeights
from tdf_jax.energy.reference import Reference
from tdf_jax.evaluation.cases import mug_of
from tdf_jax.evaluation.scene import Scene
from tdf_jax.geometry.demonstration import Demonstration
from tdf_jax.geometry.paths import SHAPES
from tdf_jax.geometry.query import box_query, gaussian_query
from tdf_jax.geometry.sampling import sample_surface
from tdf_jax.geometry.trajectory import Trajectory
from tdf_jax.networks.field import DescriptorField
from tdf_jax.shapes import Mug, scaled
from tdf_jax.solvers.adam import OptimizeConfig
from tdf_jax.solvers.initial import STARTS, default_goal

QUERIES = ("box", "gaussian")
CORRELATED = ("demonstration", "stretched")
FIELD_ENERGIES = ("min", "mean")
# Choices of the release before; they are accepted for one release, with a warning.
DEPRECATED_FIELD_ENERGIES = {"least": "min"}
END = (0.0, 0.83, 0.0)  # vector between first and last pose, paper's unit; figure 2 marks (0, 0) and (0, 0.83)
POINTS = 1500  # number of points of a cloud, before `describe` and `imitate` subsample it
STREAM = 0x7AB1E1  # number that is folded into all random keys of a setting


@renamed_fields(poses="num_poses", inits="num_starts", lever="rotation_scale")
@dataclasses.dataclass(frozen=True)
class Setting:
    """One imitation of the paper.

    The paper gives trajectory, displacement, k, iterations and distance. The other numbers are read from its figures or
    left open; docs/results/paper.md gives the reasons for them.

    Attributes:
        trajectory: shape of the demonstration, from the handle to a goal 0.83 units along y; it bows to +x, the side of
            the handle.
        displacement: displacement vector, in the paper's unit, world frame.
        displaced: what the displacement moves: the endpoint ("goal", table 1), or the test mug and therefore the
            starting point ("start", section 3.1).
        k: weight of the correlation term, per unit.
        num_poses: number of poses of the trajectory, n.
        iterations: number of optimisation steps; the paper's epochs.
        distance: distance of the first pose from the centroid of the cloud, on the side of the handle, in the paper's
            unit (figure 3); by default the first pose is at the handle.
        correlated: what the correlation term compares with: the demonstration, or the demonstration stretched to the
            displaced goal, which moves waypoint i of n by i / (n - 1) of the displacement.
        pose_norm: norm of the correlation term, see docs/guide/energy.md.
        rotation_scale: metres per radian of a rotation in the correlation term.
        compensator: weight of eq. 6.
        compensator_order: eq. 6 summed over steps ("frobenius"), or its largest step ("infinity").
        fix_last: whether the last pose stays at the goal or only starts there.
        query: query points uniform in a cube ("box"), or normally distributed as in NDF's demonstrations ("gaussian").
        query_size: edge of the cube, or standard deviation, metres; by default 0.1 and 0.025.
        queries: number of query points.
        start: every pose random ("scattered"), or the whole demonstration rotated at random ("carried").
        translation_rate: first step size of Adam for translations, metres. A pose can move by at most half of
            `iterations` steps; the default of `tdf_jax.OptimizeConfig` is for a path of 0.3 m.
        num_starts: number of random starts; the one with the lowest energy counts.
        diagonal: diagonal of both mugs, metres.
        unit: the paper's unit, metres.
        turn: rotation of the test mug about a random axis, degrees; "any" is a uniform rotation.
        field_energy: E(x) of figure 2: the minimum of the energies of the waypoints at x, or their mean.
        seed: seed of the mugs, the axis, the clouds, the query points and the starts.
    """

    trajectory: Literal["line", "semicircle", "wave"] = "wave"
    displacement: tuple[float, float, float] = (0.0, 0.0, 0.0)
    displaced: Literal["goal", "start"] = "goal"
    k: float = 0.02
    num_poses: int = 7
    iterations: int = 100
    distance: float | None = None
    correlated: Literal["demonstration", "stretched"] = "demonstration"
    pose_norm: Literal["frobenius", "metres_radians", "mean_absolute"] = "frobenius"
    rotation_scale: float = 0.05
    compensator: float = 0.0
    compensator_order: Literal["frobenius", "infinity"] = "frobenius"
    fix_last: bool = True
    query: Literal["box", "gaussian"] = "box"
    query_size: float | None = None
    queries: int = 128
    start: Literal["carried", "scattered"] = "scattered"
    translation_rate: float = 0.03
    num_starts: int = 4
    diagonal: float = 0.3
    unit: float = 1.0
    turn: float | Literal["any"] = 60.0
    field_energy: Literal["min", "mean"] = "min"
    seed: int = 0

    def __post_init__(self):
        if isinstance(self.field_energy, str) and self.field_energy in DEPRECATED_FIELD_ENERGIES:
            current = DEPRECATED_FIELD_ENERGIES[self.field_energy]
            warn(f"Setting(field_energy={self.field_energy!r})", f"field_energy={current!r}")
            object.__setattr__(self, "field_energy", current)
        choices = {"trajectory": SHAPES, "displaced": ("goal", "start"), "query": QUERIES, "start": STARTS}
        choices |= {"pose_norm": POSE_NORMS, "compensator_order": COMPENSATOR_ORDERS}
        choices |= {"correlated": CORRELATED, "field_energy": FIELD_ENERGIES}
        for name, known in choices.items():
            checks.choice("Setting()", name, getattr(self, name), known)
        for name, least in {"num_poses": 2, "iterations": 1, "queries": 1, "num_starts": 1}.items():
            checks.count("Setting()", name, getattr(self, name), least)
        checks.seed("Setting()", self.seed)
        optional = [name for name in ("query_size", "distance") if getattr(self, name) is not None]
        for name in ("diagonal", "unit", "translation_rate", *optional):
            checks.positive("Setting()", name, getattr(self, name))
        for name in ("k", "rotation_scale", "compensator"):
            checks.number("Setting()", name, getattr(self, name), 0)
        if self.turn != "any":
            checks.number("Setting()", "turn", self.turn, 0, 180, "degrees, or 'any'")
        checks.vector("Setting()", "displacement", self.displacement, unit="")

    @property
    def energy(self) -> EnergyWeights:
        """Weights of the energy; k per unit becomes k per metre."""
        return EnergyWeights(
            self.k / self.unit, self.compensator, self.rotation_scale, self.pose_norm, self.compensator_order
        )

    @property
    def optimiser(self) -> OptimizeConfig:
        """Settings of the optimiser; scattered starts fill a ball of one diagonal."""
        return OptimizeConfig(
            num_starts=self.num_starts,
            iterations=self.iterations,
            translation_rate=self.translation_rate,
            start=self.start,
            start_radius=self.diagonal,
        )

    @property
    def offset(self) -> Float[np.ndarray, "3"]:
        """The displacement, metres."""
        return self.unit * np.array(self.displacement)


def mug(setting: Setting, which: int) -> Mug:
    """The reference mug (0) or the test mug (1), unseen in training, at the size of the setting."""
    return _mug(setting.seed, which, setting.diagonal)


@functools.lru_cache(8)
def _mug(seed, which, diagonal):
    drawn = mug_of(seed, 2 * STREAM + which, 0.1)
    return cast(Mug, scaled(drawn, float(diagonal / np.linalg.norm(drawn.mesh.extents))))


def rotation(setting: Setting) -> Float[np.ndarray, "3 3"]:
    """Orientation of the test mug."""
    from scipy.spatial.transform import Rotation

    rng = np.random.default_rng([STREAM, setting.seed, 0])
    if setting.turn == "any":
        return Rotation.random(None, rng).as_matrix()
    axis = rng.normal(size=3)
    return Rotation.from_rotvec(np.radians(setting.turn) * axis / np.linalg.norm(axis)).as_matrix()


def demonstrated(setting: Setting, handle: Float[np.ndarray, "4 4"], centre: Float[np.ndarray, "3"]) -> Trajectory:
    """The demonstration, from the handle or from a distance on its side; the query frame has the axes of the handle.

    Args:
        setting: the shape, its number of poses and its distance.
        handle: T_world_handle, 4x4.
        centre: centroid of the cloud, (3,), metres, world frame.
    """
    start = handle[:3, 3]
    if setting.distance is not None:
        outward = start - centre
        start = centre + setting.distance * setting.unit * outward / np.linalg.norm(outward)
    end = start + setting.unit * np.array(END)
    return SHAPES[setting.trajectory](setting.num_poses, start, end, rotation=handle[:3, :3])


def query(setting: Setting) -> Float[Array, "queries 3"]:
    """Query points in the query frame."""
    key = jax.random.fold_in(jax.random.key(setting.seed), STREAM)
    if setting.query == "gaussian":
        return gaussian_query(key, setting.queries, setting.query_size or 0.025)
    return box_query(key, setting.queries, setting.query_size or 0.1)


def scene(setting: Setting) -> Scene:
    """The demonstration, and the test mug in its pose in the world."""
    a, b = (mug(setting, which) for which in range(2))
    points_a, points_b = (
        sample_surface(one.mesh, POINTS, np.random.default_rng([STREAM, setting.seed, 1 + which])).astype(np.float32)
        for which, one in enumerate((a, b))
    )
    T_world_b = np.eye(4)
    T_world_b[:3, :3] = rotation(setting)
    if setting.displaced == "start":
        T_world_b[:3, 3] = setting.offset
    trajectory = demonstrated(setting, a.handle_frame, points_a.mean(axis=0))
    return Scene(
        demonstration=Demonstration(jax.device_put(points_a), trajectory, query(setting)),
        points=(points_b @ T_world_b[:3, :3].T + T_world_b[:3, 3]).astype(np.float32),
        T_world_target=T_world_b,
        T_world_places=(a.handle_frame, T_world_b @ b.handle_frame),
        meshes=(a.mesh, b.mesh.copy().apply_transform(T_world_b)),
    )


def aim(setting: Setting, reference: Reference) -> Reference:
    """The reference with the trajectory that the correlation term compares with, see `Setting.correlated`."""
    if setting.correlated == "demonstration":
        return reference
    offset = setting.offset if setting.displaced == "goal" else -setting.offset
    s = np.linspace(0, 1, setting.num_poses)[:, None]
    wxyz_xyz = reference.trajectory.wxyz_xyz
    stretched = Trajectory(wxyz_xyz.at[:, 4:].add(np.asarray(s * offset, wxyz_xyz.dtype)))
    return dataclasses.replace(reference, trajectory=stretched)


def goal(setting: Setting, field: DescriptorField, reference: Reference) -> Float[Array, "7"]:
    """The last pose: the last pose of the demonstration, moved with the centroid and then displaced.

    Where the mug is displaced instead, the goal stays where it was without the displacement.
    """
    offset = setting.offset if setting.displaced == "goal" else -setting.offset
    carried = default_goal(field, reference)
    return carried.at[4:].add(np.asarray(offset, carried.dtype))
