"""Inputs of all competitors: the shipped weights, and the clouds, poses and query points of one imitation."""

import functools

import jax
import numpy as np
from flax.traverse_util import flatten_dict
from jaxtyping import Float
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

import tdf_jax as tdf
from tdf_jax.evaluation.cases import mug_of

HEIGHT = 0.12  # metres
NEAR = 0.01  # metres from the surface; closer points count as inside, because only the time of the loss matters


def weights(model: tdf.Model) -> dict[str, np.ndarray]:
    """Tensors of a model by the names and with the layout of a PyTorch state_dict, (out, in)."""
    tensors = flatten_dict(model.params, sep=".")
    return {name.replace(".kernel", ".weight"): np.asarray(tensor).T for name, tensor in tensors.items()}


@functools.cache
def surface(index: int, count: int) -> Float[np.ndarray, "points 3"]:
    """Points on the surface of a generated mug, metres, its canonical frame.

    Args:
        index: number of the mug; it is the seed of the points too.
        count: number of points.
    """
    return tdf.sample_surface(mug_of(0, index, HEIGHT).mesh, count, index).astype(np.float32)


def handle() -> Float[np.ndarray, "3"]:
    """The handle of the first generated mug, metres, its canonical frame."""
    return mug_of(0, 0, HEIGHT).handle_frame[:3, 3]


def cloud(points: int) -> Float[np.ndarray, "points 3"]:
    """A centred cloud of a generated mug, metres."""
    sampled = surface(1, points)
    return sampled - sampled.mean(axis=0)


def imitation(num_starts: int, poses: int, queries: int, seed: int = 0) -> dict[str, np.ndarray]:
    """A wave demonstrated at the handle of one mug, and random starts at another mug.

    Clouds have the density of the weights' training clouds, so that a single encoding, the same in all competitors, is
    enough.

    Args:
        num_starts: number of starts.
        poses: number of poses of the trajectory.
        queries: number of query points.
        seed: seed of the query points, the new mug's rotation and the starts.

    Returns:
        "shown" and "new": clouds, (256, 3); "path": the demonstration, (poses, 7); "query": (queries, 3); "goal": (7,);
        "starts": (starts, poses, 7), the whole demonstration rotated about the object by uniform rotations, with the
        goal as the last pose. Metres, `wxyz_xyz`, world frame.
    """
    shown, new = (tdf.thin(surface(index, 1500), 256) for index in (0, 1))
    R_new = Rotation.random(random_state=seed)
    new = (R_new.apply(new) + (0.1, -0.05, 0.02)).astype(np.float32)
    start = handle()
    path = np.asarray(tdf.wave(poses, start=start, end=start + [0.0, 0.3, 0.1]).wxyz_xyz, np.float64)
    origins = shown.mean(axis=0, dtype=np.float64), new.mean(axis=0, dtype=np.float64)
    goal = path[-1] + [0, 0, 0, 0, *(origins[1] - origins[0])]
    starts = []
    for rotation in Rotation.random(num_starts, random_state=seed + 1):
        rotated = (rotation * Rotation.from_quat(path[:, :4], scalar_first=True)).as_quat(scalar_first=True)
        starts.append(np.concatenate([rotated, rotation.apply(path[:, 4:] - origins[0]) + origins[1]], axis=1))
        starts[-1][-1] = goal
    query = tdf.box_query(jax.random.key(seed), count=queries, size=0.08)
    arrays = {"shown": shown, "new": new, "path": path, "query": query, "goal": goal, "starts": np.stack(starts)}
    weights = tdf.EnergyWeights()
    arrays |= {"correlation": weights.correlation, "rotation_scale": weights.rotation_scale}
    return {name: np.asarray(array, np.float32) for name, array in arrays.items()}


def motion(poses: int, queries: int) -> dict[str, np.ndarray]:
    """An imitation, and another sample of the new mug after a motion of 20 degrees and 4 cm.

    Args:
        poses: number of poses of the trajectory.
        queries: number of query points.

    Returns:
        As `imitation` without starts and goal, and "moved": the cloud after the motion, (256, 3).
    """
    arrays = imitation(1, poses, queries)
    R_new, shift = Rotation.random(random_state=0), np.array([0.1, -0.05, 0.02])
    # The query points are about the handle, as users place them, so that they determine the pick.
    arrays["query"] = np.asarray(tdf.box_query(jax.random.key(0), count=queries, size=0.06), np.float32)
    turn = Rotation.from_rotvec(np.radians(20) * np.array([0.6, -0.48, 0.64]))
    again = tdf.thin(tdf.sample_surface(mug_of(0, 1, HEIGHT).mesh, 1500, 2), 256)
    arrays["moved"] = (turn.apply(R_new.apply(again)) + shift + [0.02, 0.02, -0.028]).astype(np.float32)
    del arrays["starts"], arrays["goal"]
    return arrays


def targets(count: int, poses: int, queries: int) -> dict[str, np.ndarray]:
    """A demonstration at the handle of a mug, and other mugs in random orientations.

    Args:
        count: number of the other mugs.
        poses: number of poses of the trajectory.
        queries: number of query points.

    Returns:
        "shown", "path", "query" as `motion`, but with 1500 points; "clouds": (count, 1500, 3), metres.
    """
    arrays = motion(poses, queries)
    turns = Rotation.random(count, random_state=0).as_matrix()
    clouds = [surface(1 + index, 1500) @ R.T for index, R in enumerate(turns)]
    arrays |= {"shown": surface(0, 1500), "clouds": np.stack(clouds)}
    return {name: np.asarray(arrays[name], np.float32) for name in ("shown", "path", "query", "clouds")}


def batch(clouds: int, points: int, queries: int) -> dict[str, np.ndarray]:
    """A training batch.

    Args:
        clouds: number of clouds.
        points: number of points of each cloud.
        queries: number of query points of each cloud.

    Returns:
        "clouds": (clouds, points, 3); "queries": (clouds, queries, 3); "inside": labels, (clouds, queries).
    """
    rng = np.random.default_rng(0)
    centred = np.stack(
        [tdf.thin(cloud(1500) @ Rotation.random(random_state=i).as_matrix().T, points) for i in range(clouds)]
    )
    centred -= centred.mean(axis=1, keepdims=True)
    low, high = centred.min(axis=1, keepdims=True), centred.max(axis=1, keepdims=True)
    x = rng.uniform(low, high, (clouds, queries, 3))
    inside = np.stack([cKDTree(surface).query(some)[0] < NEAR for surface, some in zip(centred, x)])
    return {
        name: np.asarray(array, np.float32) for name, array in (("clouds", centred), ("queries", x), ("inside", inside))
    }


def plane(count: int, pitch: float, points: Float[np.ndarray, "points 3"]) -> tdf.Grid:
    """A square of the horizontal plane through the centroid of a cloud.

    Args:
        count: number of grid points along a side.
        pitch: distance of neighbouring grid points, metres.
        points: the cloud, (points, 3), metres.
    """
    return tdf.plane_grid(pitch * (count - 1) / 2, count, points.mean(axis=0, dtype=np.float64))


def sweep(count: int, rotations: int, poses: int, lattice: tuple[int, int, int], pitch: float) -> dict[str, np.ndarray]:
    """An imitation whose query points are a lattice, a plane grid, and rotations about the vertical.

    Args:
        count: number of grid points along a side.
        rotations: number of rotations.
        poses: number of poses of the trajectory.
        lattice: numbers of query points along the axes.
        pitch: distance of neighbouring grid and query points, metres.

    Returns:
        As `imitation`, and "grid": world points, (count, count, 3); "rotations": (rotations, 3, 3). One or two of the
        rotations put the axes of the lattice along those of the grid, where evaluations can be shared.
    """
    arrays = imitation(1, poses, 1)
    grid = plane(count, pitch, arrays["new"])
    angles = np.arange(rotations) * np.pi / rotations
    matrices = Rotation.from_rotvec(angles[:, None] * [0.0, 0.0, 1.0]).as_matrix()
    arrays |= {"query": np.asarray(tdf.lattice_query(lattice, pitch), np.float32)}
    return arrays | {"grid": grid.points.astype(np.float32), "rotations": matrices.astype(np.float32)}
