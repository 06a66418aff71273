"""Demonstrations in files: one .npz file of named arrays."""

import os

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from tdf_jax._internal import checks
from tdf_jax._internal.boundary import public
from tdf_jax._internal.errors import InputError
from tdf_jax._internal.files import replace_file
from tdf_jax._internal.units import CENTIMETRES, MILLIMETRES
from tdf_jax.geometry import se3
from tdf_jax.geometry.demonstration import Demonstration
from tdf_jax.geometry.target import Target
from tdf_jax.geometry.trajectory import Trajectory, check_trajectory
from tdf_jax.io.content import known_suffix

ARRAYS = ("points", "wxyz_xyz", "query")
INDICES = {"grasp": 0, "release": -1}  # with the values that files without them have
TARGET_ARRAYS = ("target_points", "contact_query", "T_world_contact")
# Files with a target are of schema 3, so that an older tdf_jax does not ignore it, others of schema 2; files without a
# number are of schema 1.
SCHEMA, TARGET_SCHEMA = 2, 3
# Diagonals of a cloud between which its unit may be metres: a grain of rice and a van.
SMALLEST, LARGEST = 0.003, 10.0
# Without inches, because the size of the object is unknown here, and inches and centimetres are both plausible then.
PROBABLE_UNITS = (MILLIMETRES, CENTIMETRES)
LARGEST_QUERY = 3.0  # largest diagonal of the query points, diagonals of the cloud
# Largest distance of the query points' centroid from the object at the grasp, diagonals of the cloud. Remote query
# points are legitimate, but descriptors fade with the distance (figure 3 of the paper).
FARTHEST_GRASP = 2.0


@public
def save_demonstration(path: str | os.PathLike, demonstration: Demonstration) -> None:
    """Write a demonstration.

    Args:
        path: .npz file in an existing folder. It holds the arrays `points`, the object point cloud before the grasp,
            (points, 3), metres, world frame; `wxyz_xyz`, the poses T_world_query, (poses, 7); `query`, the query
            points, (queries, 3), metres, query frame; and the integers `grasp` and `release`, the indices of the poses
            at which the object is grasped and released, and `schema`. With a target it also holds `target_points`,
            (points, 3), `contact_query`, (queries, 3), and `T_world_contact`, (7,), see `Target`.
        demonstration: demonstration to write.

    Raises:
        InputError: the suffix is not .npz, or the file cannot be written.
    """
    path = known_suffix("save_demonstration()", path, (".npz",))
    arrays = {
        "points": np.asarray(demonstration.points),
        "wxyz_xyz": np.asarray(demonstration.trajectory.wxyz_xyz),
        "query": np.asarray(demonstration.query),
        "grasp": np.int64(demonstration.grasp),
        "release": np.int64(demonstration.release),
        "schema": np.int64(SCHEMA),
    }
    target = demonstration.target
    if target is not None:
        values = (target.points, target.query, target.T_world_contact)
        arrays |= {name: np.asarray(value) for name, value in zip(TARGET_ARRAYS, values, strict=True)}
        arrays["schema"] = np.int64(TARGET_SCHEMA)
    replace_file("save_demonstration()", path, lambda file: np.savez(file, **arrays))


@public
def load_demonstration(path: str | os.PathLike) -> Demonstration:
    """Read a demonstration that `save_demonstration` wrote, or any .npz file with its first three arrays.

    Units and frames are checked as far as the numbers show them: the cloud has the size of an object in metres, and
    the query points at the grasp lie at the object.

    Args:
        path: .npz file.

    Returns:
        The demonstration, float32.

    Raises:
        InputError: the file is missing, unreadable or of a newer tdf_jax, an array is missing, the arrays are not a
            demonstration, or its unit or frames are wrong.
    """
    path = known_suffix("load_demonstration()", path, (".npz",))
    checks.existing_file("load_demonstration()", path)
    try:
        with path.open("rb") as file, np.lib.npyio.NpzFile(file, allow_pickle=False) as archive:
            names = (*ARRAYS, *INDICES, *TARGET_ARRAYS, "schema")
            arrays = {name: archive[name] for name in names if name in archive}
    except Exception as error:  # damaged archives raise errors of many kinds
        raise InputError(f"load_demonstration(): {path} cannot be read as .npz ({error}); save it again") from None
    expected = (*ARRAYS, *INDICES) if "schema" in arrays else ARRAYS
    absent = ", ".join(name for name in expected if name not in arrays)
    if absent:
        raise InputError(f"load_demonstration(): {path} has no array {absent}; expected {', '.join(expected)}")
    for name, array in arrays.items():
        if array.dtype.kind not in "fiu":
            raise InputError(f"load_demonstration(): {name} in {path} has dtype {array.dtype}; expected numbers")
    integers = INDICES | {"schema": 1}
    for name in integers.keys() & arrays.keys():
        if arrays[name].shape != () or arrays[name].dtype.kind not in "iu":
            raise InputError(f"load_demonstration(): {name} in {path} is {arrays[name]}; expected one integer")
        integers[name] = int(arrays[name])
    if not 1 <= integers["schema"] <= TARGET_SCHEMA:
        raise InputError(
            f"load_demonstration(): {path} has schema {arrays['schema']}; expected 1 to {TARGET_SCHEMA}. Use the "
            "tdf_jax that wrote it, or a newer one"
        )
    given = [name for name in TARGET_ARRAYS if name in arrays]
    if given and len(given) < len(TARGET_ARRAYS):
        raise InputError(
            f"load_demonstration(): {path} has a target, but of its arrays only {', '.join(given)}; expected all of "
            f"{', '.join(TARGET_ARRAYS)}"
        )
    points, wxyz_xyz, query = (arrays[name].astype(np.float64) for name in ARRAYS)
    grasp, release = integers["grasp"], integers["release"]
    try:
        # Checked in float64, because far coordinates and bad norms would be rounded away.
        target = Target(*(arrays[name].astype(np.float64) for name in TARGET_ARRAYS)) if given else None
        trajectory = Trajectory(wxyz_xyz)  # pyright: ignore[reportArgumentType]
        check_frames("load_demonstration()", points, trajectory, query, grasp)
        Demonstration(points, trajectory, query, grasp, release, target)
    except InputError as error:
        raise InputError(f"load_demonstration(): {path}: {error}") from None
    if target is not None:
        target = Target(*(arrays[name].astype(np.float32) for name in TARGET_ARRAYS))
    trajectory = Trajectory(jnp.asarray(wxyz_xyz, jnp.float32))
    return Demonstration(points.astype(np.float32), trajectory, query.astype(np.float32), grasp, release, target)


def check_frames(
    function: str,
    points: Float[np.ndarray, "points 3"],
    trajectory: Trajectory,
    query: Float[Array | np.ndarray, "queries 3"],
    grasp: int,
) -> None:
    """Check that a demonstration's unit can be metres, and that its query points are at the object at the grasp.

    Args:
        function: name that the messages begin with.
        points: object point cloud before the grasp, (points, 3), world frame.
        trajectory: poses of the query frame, T_world_query.
        query: query points, (queries, 3), query frame.
        grasp: index of the pose at which the object is grasped.

    Raises:
        InputError: the arrays are not a demonstration's, the cloud is smaller or larger than any object, or the query
            points are far larger than it or far from it; the message names the unit or the frame that would explain it.
    """
    points = np.asarray(checks.points(function, points), np.float64)
    query = np.asarray(checks.query(function, query), np.float64)
    num_poses = check_trajectory(trajectory).num_poses
    index = checks.count(function, "grasp", grasp, -num_poses, num_poses - 1)
    pose = np.asarray(trajectory.wxyz_xyz, np.float64)[index]
    diagonal = _diagonal(points)
    if not SMALLEST <= diagonal <= LARGEST:
        unit = next((unit for unit in PROBABLE_UNITS if 0.05 <= diagonal * unit.metres <= 1), None)
        hint = f"It is probably in {unit.name}: multiply it by {unit.metres:g}" if unit else "Check its unit"
        raise InputError(
            f"{function}: the cloud has a diagonal of {diagonal:.3g} m; expected an object in metres. {hint}"
        )
    if _diagonal(query) > LARGEST_QUERY * diagonal:
        raise InputError(
            f"{function}: the query points have a diagonal of {_diagonal(query):.3g} m, and the cloud one of "
            f"{diagonal:.3g} m; expected a part of the object, in metres"
        )
    reach = FARTHEST_GRASP * diagonal
    gap = _gap(points, pose, query)
    if gap <= reach:
        return
    inverse = np.asarray(se3.inverse(jnp.asarray(pose)), float)
    explanations = {"the poses are probably T_query_world: invert them": (points, inverse)}
    for unit, metres, _ in PROBABLE_UNITS:
        smaller = np.concatenate([pose[:4], metres * pose[4:]])
        explanations[f"the cloud is probably in {unit}: multiply it by {metres:g}"] = (metres * points, pose)
        explanations[f"the positions are probably in {unit}: multiply them by {metres:g}"] = (points, smaller)
    hint = "check that cloud and poses are in one frame and in metres, and that grasp is the index of the grasp"
    gaps = {
        text: _gap(cloud, pose, query) / _diagonal(cloud)
        for text, (cloud, pose) in explanations.items()
        if _diagonal(cloud) >= 0.02
    }
    likely = min(gaps, key=lambda text: gaps[text])
    if gaps[likely] <= FARTHEST_GRASP / 2:
        hint = likely
    raise InputError(
        f"{function}: at the grasp, pose {grasp}, the query points are {gap:.3g} m from the object, "
        f"whose diagonal is {diagonal:.3g} m; expected them at the object; {hint}"
    )


def _diagonal(points: np.ndarray) -> float:
    return float(np.linalg.norm(np.ptp(points, axis=0)))


def _gap(points: np.ndarray, wxyz_xyz: np.ndarray, query: np.ndarray) -> float:
    """Distance from the centroid of the query points, carried by a pose, to the nearest point."""
    centroid = np.asarray(se3.transform(jnp.asarray(wxyz_xyz), jnp.asarray(query.mean(axis=0)[None])))[0]
    return float(np.linalg.norm(points - centroid, axis=1).min())
