"""Trajectories of a query frame: checked, moved, resampled and displaced."""

from dataclasses import dataclass
from typing import Literal

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from numpy.typing import ArrayLike

from tdf_jax._internal import checks
from tdf_jax._internal.boundary import is_foreign, public
from tdf_jax._internal.deprecation import renamed_keywords, warn
from tdf_jax._internal.errors import InputError
from tdf_jax.geometry import se3


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Trajectory:
    """Poses of the query frame in the world, in the order of the motion, such as from the pick to the goal.

    A trajectory is a pytree of one array, so `jax.vmap` and `jax.grad` accept it. `T_world_query[i]` is pose i:
    x_world = R_i x_query + t_i.

    Attributes:
        wxyz_xyz: poses, (poses, 7), quaternion then translation in metres, world frame: the layout of `jaxlie.SE3`;
            (..., poses, 7) in a batch of trajectories.
    """

    wxyz_xyz: Float[Array, "*batch poses 7"]

    @property
    def num_poses(self) -> int:
        """Number of poses."""
        return self.wxyz_xyz.shape[-2]

    @property
    def poses(self) -> int:
        """Former name of `num_poses`."""
        warn("Trajectory.poses", "Trajectory.num_poses")
        return self.num_poses

    @public
    def _repr_html_(self) -> str | None:
        from tdf_jax.viz.cards import trajectory_card  # only a notebook asks, see tests/test_layout.py

        if checks.traced(self.wxyz_xyz) or np.ndim(self.wxyz_xyz) != 2 or not len(self.wxyz_xyz):
            return None  # the notebook prints `repr` instead
        return trajectory_card(self)

    @property
    @public
    def rotations(self) -> Float[Array, "poses 3 3"]:
        """Rotation matrices, (poses, 3, 3)."""
        return se3.rotation(self.wxyz_xyz)

    @property
    @public
    def translations(self) -> Float[Array, "poses 3"]:
        """Translations, (poses, 3), metres, world frame."""
        return se3.translation(self.wxyz_xyz)

    @property
    @public
    def matrices(self) -> Float[Array, "poses 4 4"]:
        """Homogeneous matrices, (poses, 4, 4)."""
        return se3.matrix(self.wxyz_xyz)

    @classmethod
    @public
    def from_matrices(cls, T_world_query: Float[Array, "poses 4 4"]) -> "Trajectory":
        """Make a trajectory of homogeneous matrices.

        Args:
            T_world_query: rigid transforms, (poses, 4, 4), metres, world frame.

        Returns:
            The trajectory.

        Raises:
            InputError: the shape is wrong, or a matrix is not rigid or not finite.
        """
        T = (
            T_world_query
            if checks.traced(T_world_query)
            else checks.numbers("Trajectory.from_matrices()", "T_world_query", T_world_query)
        )
        T = jnp.asarray(T)
        if T.ndim != 3 or T.shape[1:] != (4, 4):
            raise InputError(f"Trajectory.from_matrices(): matrices have shape {T.shape}; expected (poses, 4, 4)")
        if not checks.traced(T):
            checks.near("Trajectory.from_matrices()", "T_world_query", np.asarray(T[:, :3, 3]))
            if not np.isfinite(T).all():
                raise InputError("Trajectory.from_matrices(): a matrix is NaN or infinite; expected rigid transforms")
            checks.rotations("Trajectory.from_matrices()", "T_world_query", T[:, :3, :3])
            if not np.allclose(T[:, 3], [0, 0, 0, 1], atol=1e-6):
                raise InputError(
                    "Trajectory.from_matrices(): the last row of a matrix differs from the expected 0 0 0 1; "
                    "transpose matrices that act on row vectors"
                )
        return check_trajectory(cls(se3.pose(T[:, :3, :3], T[:, :3, 3])))

    @public
    def transformed(self, T_new_world: Float[Array, "7"]) -> "Trajectory":
        """Apply a rigid transform of the world: T_new_query = T_new_world T_world_query.

        Args:
            T_new_world: pose `wxyz_xyz` of the world in the new frame, (7,), metres.

        Returns:
            The trajectory in the new frame.

        Raises:
            InputError: T_new_world is not one finite pose.
        """
        T = jnp.asarray(checks.pose("Trajectory.transformed()", "T_new_world", T_new_world))
        return Trajectory(se3.compose(T, self.wxyz_xyz))

    @public
    def shifted(self, offset: ArrayLike) -> "Trajectory":
        """Add a vector to every translation.

        Args:
            offset: vector to add, (3,), metres, world frame.

        Returns:
            The shifted trajectory.

        Raises:
            InputError: the offset is not three finite numbers, or farther than float32 resolves.
        """
        vector = checks.vector("Trajectory.shifted()", "offset", offset).astype(self.wxyz_xyz.dtype)
        return Trajectory(se3.shift(self.wxyz_xyz, vector))

    def displaced(self, offset: ArrayLike, where: Literal["start", "goal"] = "goal") -> "Trajectory":
        """Displace one end of the trajectory, as `displace` does.

        Args:
            offset: vector to add to the translation of that end, (3,), metres, world frame.
            where: end to displace, "goal" (the last pose) or "start" (the first pose).

        Returns:
            The displaced trajectory.
        """
        return displace(self, offset, where)


def check_trajectory(trajectory: Trajectory, name: str = "trajectory", *, anywhere: bool = False) -> Trajectory:
    """Check that a trajectory can be used; nothing is changed.

    Only the shape and the type of traced poses are checked, because their values are not known yet.

    Args:
        trajectory: trajectory to check.
        name: name of the trajectory in error messages.
        anywhere: accept positions that float32 does not resolve, such as those of a solver that diverges.

    Returns:
        The same trajectory.

    Raises:
        InputError: the shape is not (poses, 7) with at least one pose, a number is not finite, or the norm of a
            quaternion differs from 1 by more than 1e-3, as in arrays of another order.
    """
    if not isinstance(trajectory, Trajectory):
        raise InputError(
            f"check_trajectory(): {name} is a {type(trajectory).__name__}; expected a Trajectory, as of tdf.wave() or "
            "tdf.Trajectory(wxyz_xyz) of an array (poses, 7)"
        )
    wxyz_xyz = trajectory.wxyz_xyz
    if not isinstance(wxyz_xyz, jax.Array | np.ndarray) or is_foreign(wxyz_xyz):
        raise InputError(f"check_trajectory(): {name}.wxyz_xyz is a {type(wxyz_xyz).__name__}; expected an array")
    if wxyz_xyz.ndim != 2 or wxyz_xyz.shape[1] != 7:
        raise InputError(f"check_trajectory(): {name}.wxyz_xyz has shape {wxyz_xyz.shape}; expected (poses, 7)")
    if not jnp.issubdtype(wxyz_xyz.dtype, jnp.floating):
        raise InputError(f"check_trajectory(): {name} has dtype {wxyz_xyz.dtype}; expected floating point")
    if not len(wxyz_xyz):
        raise InputError(f"check_trajectory(): {name} has no pose; expected at least one")
    if not checks.traced(wxyz_xyz):
        values = np.asarray(wxyz_xyz)
        finite = np.isfinite(values).all(axis=1)
        if not finite.all():
            raise InputError(
                f"check_trajectory(): pose {np.argmin(finite)} of {name} is NaN or infinite; expected finite poses"
            )
        checks.unit_quaternions("check_trajectory()", name, values)
        if not anywhere:
            checks.near("check_trajectory()", name, values[:, 4:])
    return trajectory


@public
@renamed_keywords(poses="num_poses")
def resample(trajectory: Trajectory, num_poses: int) -> Trajectory:
    """Resample a path to another number of poses, evenly spaced by the length of the translations' polyline.

    Rotations follow the SO(3) geodesic (slerp) between the original poses. The poses of a path without any translation
    are spaced by their index instead.

    Args:
        trajectory: trajectory to resample, at least 2 poses.
        num_poses: new number of poses, at least 2.

    Returns:
        The resampled trajectory, with the ends of the original.

    Raises:
        InputError: num_poses is below 2, the trajectory has one pose, or it fails `check_trajectory`.
    """
    checks.count("resample()", "num_poses", num_poses, least=2)
    if check_trajectory(trajectory).num_poses < 2:
        raise InputError("resample(): the trajectory has one pose; expected at least 2, a path between them")
    R, t = trajectory.rotations, trajectory.translations
    steps = jnp.linalg.norm(jnp.diff(t, axis=0), axis=1)
    steps = jnp.where(steps.sum() > 0, steps, 1.0)
    length = jnp.concatenate([jnp.zeros(1, steps.dtype), jnp.cumsum(steps)])
    even = jnp.linspace(0, 1, num_poses, dtype=length.dtype) * length[-1]
    i = jnp.clip(jnp.searchsorted(length, even, side="left") - 1, 0, trajectory.num_poses - 2)
    fraction = (even - length[i]) / jnp.where(steps[i] > 0, steps[i], 1.0)
    translations = t[i] + fraction[:, None] * (t[i + 1] - t[i])
    return Trajectory(se3.pose(se3.geodesic(R[i], R[i + 1], fraction), translations))


@public
def displace(trajectory: Trajectory, offset: ArrayLike, where: Literal["start", "goal"] = "goal") -> Trajectory:
    """Displace one end of a trajectory; the other poses stay, as in the displacements of the paper's table 1.

    Args:
        trajectory: trajectory to displace.
        offset: vector to add to the translation of that end, (3,), metres, world frame.
        where: end to displace, "goal" (the last pose) or "start" (the first pose).

    Returns:
        The displaced trajectory.

    Raises:
        InputError: `where` is unknown, the offset is not three finite numbers, or the trajectory fails
            `check_trajectory`.
    """
    checks.choice("displace()", "where", where, ("start", "goal"))
    vector = checks.vector("displace()", "offset", offset)
    wxyz_xyz = jnp.asarray(check_trajectory(trajectory).wxyz_xyz)
    return Trajectory(wxyz_xyz.at[0 if where == "start" else -1, 4:].add(jnp.asarray(vector, wxyz_xyz.dtype)))
